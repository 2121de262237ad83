"""What a `SceneBuilder` has collected, in plain values: bodies to be, what is on them, and how files come onto them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from anchors.pose import compose
from iris_session.protocol.common import Pose
from iris_session.protocol.scene import Camera, Light
from iris_session.scene.articulation import Articulation
from iris_session.scene.meshes import MeshArrays
from iris_session.scene.parts import (
    Item,
    Loaded,
    Look,
    Matrix,
    Picture,
    matrix_of,
    pose_of,
    rigid_and_rest,
    solid,
    vec3,
)
from iris_session.scene.urdf import Robot


@dataclass(frozen=True)
class Thing:
    """A body to be. `parent`: an earlier thing by its place, -1 for the world. `pose`: T_world_body at first."""

    name: str
    parent: int
    pose: Pose
    moving: bool


@dataclass(frozen=True, eq=False)
class Flexible:
    """A deformable to be; `uv` (n, 2) of the vertices."""

    name: str
    vertices: NDArray[np.float32]
    elements: NDArray[np.uint32]
    uv: NDArray[np.float32] | None
    radius: float
    flat: bool
    look: Look


@dataclass
class World:
    """All that was added. `names`: those that are taken. Bodies of `items`, `lights`, `cameras`: places in `things`."""

    name: str
    things: list[Thing] = field(default_factory=list)
    items: list[Item] = field(default_factory=list)
    lights: list[tuple[int, Light]] = field(default_factory=list)
    cameras: list[tuple[int, Camera]] = field(default_factory=list)
    flexibles: list[Flexible] = field(default_factory=list)
    articulations: dict[str, Articulation] = field(default_factory=dict)
    skybox: Picture | None = None
    names: set[str] = field(default_factory=set)
    skipped: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @contextmanager
    def whole(self) -> Iterator[None]:
        """What is added within is added whole, or, where something is raised, not at all."""
        lists: tuple[list[Any], ...] = (self.things, self.items, self.lights, self.cameras, self.skipped, self.notes)
        lengths, names = [len(one) for one in lists], self.names.copy()
        try:
            yield
        except BaseException:
            for one, length in zip(lists, lengths, strict=True):
                del one[length:]
            self.names = names
            raise

    def skip(self, texts: tuple[str, ...]) -> None:
        """What clients will not see, each line once."""
        self.skipped += dict.fromkeys(text for text in texts if text not in self.skipped)

    def note(self, texts: tuple[str, ...]) -> None:
        """What looks like a mistake, each line once."""
        self.notes += dict.fromkeys(text for text in texts if text not in self.notes)

    def add_robot(self, robot: Robot) -> None:
        """An articulation with its bodies, at rest."""
        articulation = robot.articulation
        first = len(self.things)
        for name, pose in articulation.poses({}).items():
            self.things.append(Thing(name, -1, composed(articulation.T_world_root, pose), moving=True))
        self.items += [replace(item, body=first + item.body) for item in robot.items]
        self.articulations[articulation.name] = articulation
        self.names.update((articulation.name, *articulation.bodies))
        self.skip(robot.skipped)
        self.note(robot.notes)

    def add_nodes(self, loaded: Loaded, body: int, T_body_file: Matrix, look: Look | None, *, flat: bool) -> None:
        """A file on `body`. `flat`: everything on that one, else nodes with something on or below them become bodies.

        `look`, if there is one, replaces those of the file, and colours at vertices.
        """
        self.skip(loaded.skipped)
        bare: dict[int, MeshArrays] = {}
        places = [body] * len(loaded.nodes)
        T_world_body = matrix_of(self.things[body].pose) if body >= 0 else np.eye(4)
        used = _with_content(loaded)
        several = len(used) > 1
        for k, node in enumerate(loaded.nodes):
            matrix = T_body_file @ node.matrix
            if k in used and not solid(matrix):
                self.skip((f"{self.things[body].name}: node {node.name!r} is scaled to nothing",))
                used.discard(k)
                continue
            if not flat and several and k in used:
                pose, rest = rigid_and_rest(T_world_body @ matrix)
                self.things.append(Thing(node.name, places[node.parent] if node.parent >= 0 else body, pose, False))
                places[k] = len(self.things) - 1
                matrix = np.eye(4)
                if rest is not None:
                    matrix[:3, :3] = rest
            for surface in node.surfaces:
                mesh = surface.mesh
                if look is not None and mesh.color is not None:
                    mesh = bare.setdefault(id(mesh), replace(mesh, color=None))
                self.items.append(Item(places[k], surface.name, matrix, look or surface.look or Look(), mesh))
            self.lights += [(places[k], _light_at(matrix, light)) for light in node.lights]
            if node.cameras:
                T = _looking(matrix)
                self.cameras += [
                    (places[k], msgspec.structs.replace(camera, T_body_camera=composed(T, camera.T_body_camera)))
                    for camera in node.cameras
                ]


def _with_content(loaded: Loaded) -> set[int]:
    """Nodes with something on or below them, by their places."""
    used: set[int] = set()
    for k, node in enumerate(loaded.nodes):
        at = k if node.surfaces or node.lights or node.cameras else -1
        while at >= 0 and at not in used:
            used.add(at)
            at = loaded.nodes[at].parent
    return used


def _light_at(matrix: Matrix, light: Light) -> Light:
    """A light in the frame of its body, which `matrix` leads to. It shines where that turns it, mirrored or not."""
    p = matrix @ [*light.p_body, 1.0]
    along = matrix[:3, :3] @ light.direction_body
    along /= np.linalg.norm(along)
    return msgspec.structs.replace(light, p_body=vec3(p), direction_body=vec3(along))


def _looking(matrix: Matrix) -> Pose:
    """T_body_camera of a camera that `matrix` leads from: it looks along its -z with its y up, mirrored or not."""
    back, up = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2]), matrix[:3, 1]
    up = up - (up @ back) * back
    up /= np.linalg.norm(up)
    return pose_of(np.stack([np.cross(up, back), up, back], axis=1), matrix[:3, 3])


def composed(a: Pose, b: Pose) -> Pose:
    """T_a_c of T_a_b and T_b_c."""
    return Pose(*compose((a.p, a.q), (b.p, b.q)))
