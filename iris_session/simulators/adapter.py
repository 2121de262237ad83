"""`Adapter`: a simulation of another simulator as a session sees it: its scene, its poses, its step, its targets.

One file per simulator beside this one. None of them imports its simulator before it is given something of it, so that
looking for the right adapter costs nothing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.common import Pose
from iris_session.protocol.specs import RobotSpec
from iris_session.scene.builder import SceneBuilder

Floats = NDArray[np.float64]
#: Longest name of a body in the state stream.
MAX_NAME: Final = 64
#: Links that slide or turn at the end of an arm, beside one another: fewer are an arm, more a hand.
_FINGERS: Final = range(2, 6)


class TipTarget(NamedTuple):
    """Target of an end effector: `T_world_tip` [m], and of its gripper, 0 open to 1 closed, or `None`.

    `stops`: the robot is driven no longer, and stays where it is: `pose` is measured.
    """

    pose: Pose
    gripper: float | None = None
    stops: bool = False


@dataclass
class SimulationState:
    """State of a simulation.

    Attributes:
        time_s: Time of the simulation [s]; `None`: it has no clock of its own.
        positions: Of `Adapter.bodies`, in the world frame, shape (n, 3) [m].
        quaternions: Rotations from body to world, (w, x, y, z), shape (n, 4).
        vertices: Vertices of deformables by name, in the world frame, shape (m, 3) [m].
    """

    time_s: float | None
    positions: Floats
    quaternions: Floats
    vertices: Mapping[str, Floats] = field(default_factory=dict)


class Adapter(ABC):
    """One simulation.

    Attributes:
        name: Name of the scene.
        bodies: Names of moving bodies, in the order of `read_state`; known after `build`.
        robots: End effectors that participants can lease; known after `build`.
        notes: What is not shown, one line each; known after `build`.
        drives: `apply_targets` moves robots. Otherwise the program itself does it, with the targets of the session.
    """

    name: str = "scene"
    bodies: Sequence[str] = ()
    robots: tuple[RobotSpec, ...] = ()
    notes: tuple[str, ...] = ()
    drives: bool = False

    @abstractmethod
    def build(self, scene: SceneBuilder) -> None:
        """Add everything that is drawn to `scene`."""

    @abstractmethod
    def read_state(self) -> SimulationState:
        """Return the present state."""

    def apply_targets(self, targets: Mapping[str, TipTarget]) -> None:
        """Move the robots of `targets` towards them, with the simulator's own control, by the next steps."""
        raise NotImplementedError

    def wrap_step(self, before: Callable[[], None], after: Callable[[], None]) -> Callable[[], None] | None:
        """Call `before` and `after` around every step of the simulation.

        Returns:
            A function that ends this; `None` where the simulation has no step, and the program calls `sync()`.
        """
        return None


class Names:
    """Unique names of bodies."""

    def __init__(self) -> None:
        self._taken: set[str] = {"world"}

    def add(self, wanted: str) -> str:
        """Return `wanted`, or it with a number when it is taken; cut to the longest name from the left."""
        wanted = "".join(c for c in wanted if c.isprintable()) or "body"
        name, number = wanted[-MAX_NAME:], 1
        while name in self._taken:
            number += 1
            suffix = f"_{number}"
            name = wanted[-(MAX_NAME - len(suffix)) :] + suffix
        self._taken.add(name)
        return name


def find_gripper(parents: Sequence[int], moves: Sequence[bool]) -> tuple[int, tuple[int, ...]] | None:
    """Return the link that carries the gripper of an arm, and the fingers; `None` for what is no arm.

    An arm is one chain of links, that may end in fingers: links beside one another which move against the same link. A
    robot with several chains (legs, two arms) is none: no rule here can tell which of them people want.

    Args:
        parents: Number of the parent of every link, -1 for the root; parents come first.
        moves: Whether a link moves against its parent.
    """
    n = len(parents)
    if not n:
        return None
    children: list[list[int]] = [[] for _ in range(n)]
    for link, parent in enumerate(parents):
        if parent >= 0:
            children[parent].append(link)
    below = [bool(moves[i]) for i in range(n)]  # whether something moves at or below a link
    for link in range(n - 1, -1, -1):
        if parents[link] >= 0:
            below[parents[link]] |= below[link]
    at = next((i for i, parent in enumerate(parents) if parent < 0), 0)
    joints = 0
    while True:
        ahead = [child for child in children[at] if below[child]]
        if len(ahead) == 1:
            at = ahead[0]
            joints += bool(moves[at])
            continue
        if not ahead:  # no fingers: the last link of all, a flange or a tool that is fixed
            while len(children[at]) == 1:
                at = children[at][0]
            return (at, ()) if joints >= _FEWEST_JOINTS else None
        if joints < _FEWEST_JOINTS or len(ahead) not in _FINGERS:
            return None
        return at, tuple(ahead)


#: Joints of the smallest arm.
_FEWEST_JOINTS: Final = 3


def make_robot(name: str, bodies: Sequence[str], gripper: tuple[int, tuple[int, ...]], root: int = 0) -> RobotSpec:
    """Return an end effector that participants can lease, and that the program moves.

    Args:
        name: Name of the robot.
        bodies: Names of the bodies of its links.
        gripper: The link that carries the gripper, and the fingers, of `find_gripper`.
        root: Its first link.
    """
    tip, fingers = gripper
    return RobotSpec(
        name=name,
        joints=(),
        actuators=(),
        site="",
        base_body=bodies[root],
        tip_body=bodies[tip],
        finger_bodies=tuple(bodies[finger] for finger in fingers),
    )


def from_xyzw(quaternions: Any) -> Floats:
    """Return quaternions (..., 4) as (w, x, y, z)."""
    array = np.asarray(quaternions, np.float64)
    return array[..., [3, 0, 1, 2]]
