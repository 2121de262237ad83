"""Results of `parse_mujoco` and of a `SceneBuilder`: a specification with its assets in a store, and what moves its
bodies.

Publishing code reads this; nothing here knows files, sessions or clocks. Body 0 is the world; moving bodies have the
ids 1..n in the order of `ComposedScene.moving` and no parent but the world; static bodies come after them.

`Articulation` is a tree of rigid bodies on joints. It computes with plain floats: a robot of ten joints takes some tens
of microseconds at every published tick.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from anchors.pose import compose, quat_from_rotvec
from iris_session.protocol.common import IDENTITY, Pose, Vec3
from iris_session.protocol.scene import SceneSpec, list_assets
from iris_session.scene.errors import SceneBuildError
from iris_session.streams.deformable_topology import DeformableTopology

_NONE: Final[Mapping[str, Pose]] = {}


@dataclass(frozen=True)
class DeformableSource:
    """Mesh whose vertices are published.

    `name`: name in the scene. `stream`: its media stream. `topology`: the plan of the stream for `DeformableEncoder`.
    `vertices`: initial vertices, float32 (n, 3) [m], world frame, read-only; all later ones have the same shape and
    order.
    """

    name: str
    stream: str
    topology: DeformableTopology
    vertices: NDArray[np.float32]


@dataclass(frozen=True)
class ParsedScene:
    """Scene whose assets, the specification among them, are in the store: hold `addresses` there while it is served.

    Attributes:
        spec: The specification.
        scene_hash: Address of the specification.
        skipped: Content that clients will not see, one line each.
        built: Number of meshes, textures and other content that were encoded.
        recalled: Number of those whose encoding the store already had.
    """

    spec: SceneSpec
    scene_hash: str
    skipped: tuple[str, ...]
    built: int
    recalled: int

    @property
    def addresses(self) -> tuple[str, ...]:
        """Addresses of all assets in the order in which they become visible, to be kept in the store and served."""
        return (self.scene_hash, *list_assets(self.spec))


@dataclass(frozen=True)
class ComposedScene(ParsedScene):
    """Scene with what is needed to move it.

    Attributes:
        moving: Names of the streamed bodies, each once; body `i + 1` is `moving[i]`. Bodies of an articulation are
            among them; its root is moved by `Articulation.name`.
        poses: Initial poses T_world_body, in the order of `moving`.
        articulations: Articulations by name.
        deformables: Deformables by name.
        notes: A likely mistake of units, with the correction, or nothing.
    """

    moving: tuple[str, ...]
    poses: tuple[Pose, ...]
    articulations: Mapping[str, Articulation]
    deformables: Mapping[str, DeformableSource]
    notes: tuple[str, ...] = ()


# --- articulations ----------------------------------------------------------------------------------------------------


class Joint(NamedTuple):
    """One joint that can be set.

    `kind`: revolute, continuous or prismatic. `low`, `high`: limits [rad] or [m], infinite without any; positions
    beyond them are drawn as set. `rest`: position until it is set, the nearest to 0 within the limits.
    """

    name: str
    kind: str
    low: float
    high: float
    rest: float


class ArticulatedBody(NamedTuple):
    """One moving body on its joint. `parent`: index of an earlier part, -1 for the root, which is part 0.

    `T_parent_joint`: pose of the joint in the parent's frame, and of the body at position 0. `axis`: unit vector in the
    joint's frame. `sliding`: along the axis, else around it; a `joint` of -1 is fixed. The position is that of `joint`
    (index in `Articulation.joints`) times `multiplier` plus `offset`: 1 and 0 unless it mimics another joint.
    """

    body: str
    parent: int = -1
    T_parent_joint: Pose = IDENTITY
    axis: Vec3 = (0.0, 0.0, 1.0)
    sliding: bool = False
    joint: int = -1
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Articulation:
    """Tree of bodies on joints. `name`: name that the root is moved by. `T_world_root`: its initial pose.

    `parts`: parents first. `joints`: those that can be set. `mimics`: the joint that each mimic joint follows, by name;
    mimic joints cannot be set. `loose`: floating and planar joints, each with its body, which stays at its initial pose
    until its pose is set.
    """

    name: str
    T_world_root: Pose
    parts: tuple[ArticulatedBody, ...]
    joints: tuple[Joint, ...]
    mimics: Mapping[str, str]
    loose: Mapping[str, str] = field(default_factory=dict)

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the moving bodies, the root's first."""
        return tuple(part.body for part in self.parts)

    def compute_poses(self, q: Mapping[str, float]) -> dict[str, Pose]:
        """Return T_articulation_body of every body, for positions of joints by name [rad] or [m].

        Joints that are not in `q` are at rest. Raises `SceneBuildError` for names that cannot be set, and for positions
        that are not finite.
        """
        return self.compute_world_poses(IDENTITY, q)

    def compute_world_poses(
        self, T_world_root: Pose, q: Mapping[str, float], loose: Mapping[str, Pose] = _NONE
    ) -> dict[str, Pose]:
        """Return T_world_body of every body, by `compute_poses`.

        `loose`: T_world_body of bodies on floating and planar joints, by name; bodies below move with them.
        """
        self.check_positions(q)
        at = [float(q.get(joint.name, joint.rest)) for joint in self.joints]
        placed: list[tuple[Vec3, tuple[float, float, float, float]]] = []
        for part in self.parts:
            above = placed[part.parent] if part.parent >= 0 else (T_world_root.p, T_world_root.q)
            T_world_body = compose(above, (part.T_parent_joint.p, part.T_parent_joint.q))
            if part.joint >= 0:
                T_world_body = compose(T_world_body, _joint_motion(part, at[part.joint]))
            elif part.body in loose:
                T_world_body = (loose[part.body].p, loose[part.body].q)
            placed.append(T_world_body)
        return {part.body: Pose(*T) for part, T in zip(self.parts, placed, strict=True)}

    def check_positions(self, q: Mapping[str, float]) -> None:
        """Raise `SceneBuildError` unless every name is one of `joints` with a finite position."""
        known = {joint.name for joint in self.joints}
        for name, value in q.items():
            if name in self.mimics:
                raise SceneBuildError(f"joint {name!r} of {self.name!r} follows {self.mimics[name]!r}: set that one")
            if name in self.loose:
                body = self.loose[name]
                raise SceneBuildError(
                    f"joint {name!r} of {self.name!r} has no position: set_pose({body!r}, ...) moves it"
                )
            if name not in known:
                names = ", ".join(joint.name for joint in self.joints) or "none"
                raise SceneBuildError(f"{self.name!r} has no joint {name!r} that can be set. Joints: {names}")
            try:
                finite = math.isfinite(value)
            except TypeError:
                finite = False
            if not finite:
                raise SceneBuildError(f"joint {name!r} of {self.name!r} at {value!r}: a finite number is needed")


def _joint_motion(part: ArticulatedBody, position: float) -> tuple[Vec3, tuple[float, float, float, float]]:
    """Return T_joint_body."""
    along = part.multiplier * position + part.offset
    x, y, z = part.axis
    step = (along * x, along * y, along * z)
    if part.sliding:
        return step, (1.0, 0.0, 0.0, 0.0)
    return (0.0, 0.0, 0.0), quat_from_rotvec(step)
