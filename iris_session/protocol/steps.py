"""Contracts between authority, control and physics within one step. Plain data, no behaviour.

`Authority.step(now_ns, entries, n_ticks, view) -> Decision`; control turns `Decision.commands` into `ctrl` for each of
the `n_ticks` ticks; physics gives the next `WorldView`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import msgspec

from iris_session.protocol.common import Alignment, Applied, Count, Name, Nanoseconds, Pose, Quat, Vec3
from iris_session.protocol.server_messages import Event, PresenceItem, ServerMessage


class CommandSource(msgspec.Struct, frozen=True, array_like=True):
    """The newest counted sample of one holder behind a command, in the world frame.

    `engagement` changes whenever this holder engages anew: control then latches the device pose and the robot's own
    target, so that motion is relative. Exactly one of `pose_world`, `twist_world`, `q` is set.
    `new`: this sample was first counted in this step.
    """

    participant: Name
    device: Name
    engagement: Count
    seq: Count
    capture_ns: Nanoseconds
    receive_ns: Nanoseconds
    weight: float = 1.0
    new: bool = True
    pose_world: Pose | None = None
    twist_world: tuple[float, float, float, float, float, float] | None = None
    q: tuple[float, ...] = ()
    qd: tuple[float, ...] = ()
    absolute: bool = False  # device `target`: the pose is the end-effector target itself, not relative motion


class Command(msgspec.Struct, frozen=True, array_like=True):
    """Command of one robot for this step. Exactly one per robot and step.

    `kind`: `CommandKind`; with `hold` a `hold_reason` and no sources. More than one source only in lease mode `shared`.
    `gripper`: 0 open to 1 closed, `None`: unchanged. `scale`: motion scaling, 1 = as the hand moves.
    """

    robot: Name
    kind: Name
    hold_reason: Name = ""
    sources: tuple[CommandSource, ...] = ()
    gripper: float | None = None
    scale: float = 1.0


class ObjectCommand(msgspec.Struct, frozen=True, array_like=True):
    """A free object that hands hold without a robot: follow `T_world_object` (spring), until no command names it.

    The authority computes the pose from the hand that leads (first holder); when it releases while a second hand holds,
    the offset is latched anew, so that the object does not jump. `grasp` changes with every change of the leading hand.
    """

    object: Name
    grasp: Count
    T_world_object: Pose


class OutgoingMessage(msgspec.Struct, frozen=True, array_like=True):
    """A message for one connection."""

    connection: Count
    message: ServerMessage


class Admitted(msgspec.Struct, frozen=True, array_like=True):
    """The authority admitted a connection; the front makes `Welcome` and the resume token from it."""

    connection: Count
    participant_id: Name
    role: Name
    resumed: bool


class Dropped(msgspec.Struct, frozen=True, array_like=True):
    """The authority has ended a connection (replaced by a resume, expired, left): the front closes it.

    `key_id`: of a key that a director has revoked; `connection` is `HOST` then when no connection used it.
    """

    connection: Count
    reason: Name
    key_id: Name = ""


class Decision(msgspec.Struct, frozen=True):
    """Everything one authority step decides. `events` carry consecutive `event_seq`.

    `reset`: reload the initial state before the ticks of this step. `paused`: the pacing loop takes zero-tick steps
    until it is false again; `step_ticks`: ticks to take while paused (asked by a director), once.
    """

    commands: tuple[Command, ...]
    objects: tuple[ObjectCommand, ...] = ()
    outgoing: tuple[OutgoingMessage, ...] = ()
    admitted: tuple[Admitted, ...] = ()
    dropped: tuple[Dropped, ...] = ()
    events: tuple[Event, ...] = ()
    presence: tuple[PresenceItem, ...] = ()
    scene_epoch: Count = 1
    scene_revision: Count = 0
    event_seq: Count = 0
    reset: bool = False
    paused: bool = False
    estop: bool = False
    step_ticks: Count = 0


class ObjectContact(msgspec.Struct, frozen=True, array_like=True):
    """Contacts of an object. `grippers`: robots that hold it (contact on at least two finger bodies, or on its only
    one); `touching`: robots of which any geom touches it; `others`: bodies (not robots) that touch it.
    """

    object: Name
    grippers: tuple[Name, ...]
    touching: tuple[Name, ...]
    others: tuple[Name, ...]


class WorldView(Protocol):
    """The world after the last tick, as visible to the authority and control. Deterministic, read only.

    Frames: world. `joints` in the order of `RobotSpec.joints`.
    """

    @property
    def tick(self) -> int: ...

    @property
    def sim_time(self) -> float: ...

    @property
    def tick_period_ns(self) -> int: ...

    def tip_pose(self, robot: str) -> Pose: ...

    def joints(self, robot: str) -> tuple[float, ...]: ...

    def object_pose(self, name: str) -> Pose: ...

    def object_contacts(self) -> Sequence[ObjectContact]: ...

    def gripper_force(self, robot: str) -> float:
        """Return the sum of the normal contact forces on the gripper [N]."""
        ...


class ControlStatus(msgspec.Struct, frozen=True, array_like=True):
    """Report of control after a step, for feedback: active limits per robot, leader apart, tracking error."""

    robot: Name
    limits: tuple[Name, ...] = ()
    applied: Applied | None = None


class FixedView(msgspec.Struct, frozen=True):
    """A `WorldView` from plain values: for tests, and for open recordings whose plant is not re-simulated."""

    tick: int = 0
    sim_time: float = 0.0
    tips: Mapping[str, Pose] = {}
    q: Mapping[str, tuple[float, ...]] = {}
    objects: Mapping[str, Pose] = {}
    contacts: tuple[ObjectContact, ...] = ()
    forces: Mapping[str, float] = {}
    tick_period_ns: int = 2_000_000

    def tip_pose(self, robot: str) -> Pose:
        return self.tips[robot]

    def joints(self, robot: str) -> tuple[float, ...]:
        return self.q[robot]

    def object_pose(self, name: str) -> Pose:
        return self.objects[name]

    def object_contacts(self) -> Sequence[ObjectContact]:
        return self.contacts

    def gripper_force(self, robot: str) -> float:
        return self.forces.get(robot, 0.0)


__all__ = [
    "Admitted",
    "Alignment",
    "Applied",
    "Command",
    "CommandSource",
    "ControlStatus",
    "Decision",
    "Dropped",
    "FixedView",
    "ObjectCommand",
    "ObjectContact",
    "OutgoingMessage",
    "Quat",
    "Vec3",
    "WorldView",
]
