"""Robots and objects of a session by name. Found in a model by `physics`, used by every other room."""

from __future__ import annotations

from typing import Final

import msgspec

from iris_session.protocol.common import IDENTITY, Count, Name, Pose, Text

#: Kinds of robots: an arm follows poses and joints; a hand, whose fingers are no chain, follows joints only.
ARM: Final = "arm"
HAND: Final = "hand"
#: What a robot does whose lease ends: it holds where it is, or moves to where it stood when its scene began.
ON_RELEASE_HOLD: Final = "hold"
ON_RELEASE_HOME: Final = "home"


class GripperActuator(msgspec.Struct, frozen=True):
    """One of several actuators that open and close a gripper together.

    Attributes:
        actuator: Its name in the model, or `#` and its number.
        open, closed: Values of its `ctrl`.
    """

    actuator: Name
    open: float
    closed: float


class RobotSpec(msgspec.Struct, frozen=True):
    """A named group of joints, actuators, end-effector site and gripper that is controlled as one.

    What has no name in the model is called `#` and its number there: `#7`.

    Attributes:
        name: Name of the robot.
        joints, actuators: Names in the model, in the same order: one actuator per arm joint; no actuators for a robot
            that only its owner's program moves.
        site: Site of the end effector; empty: it is given by `tip_body`.
        base_body: Root of the robot's subtree.
        gripper_actuator: Empty without a gripper.
        gripper_open, gripper_closed: Values of its `ctrl`.
        finger_bodies: Bodies whose geoms count as the gripper (contacts, handover).
        mode: Lease mode (`LeaseMode`).
        hold: Declared hold law of torque actuators (`gravity_pd`); empty: none, and torque actuators are refused.
        tip_body: Body that carries the end effector where there is no site.
        T_body_tip: Pose of the end effector in the frame of `tip_body`.
        gripper_partners: Further actuators of the same gripper. Its opening is measured at `gripper_actuator`.
        kind: `arm`, or `hand`: fingers that are controlled in joint space only.
        on_release: What it does when its lease ends: `hold`, or `home`.
    """

    name: Name
    joints: tuple[Name, ...]
    actuators: tuple[Name, ...]
    site: Name
    base_body: Name
    gripper_actuator: Name = ""
    gripper_open: float = 0.0
    gripper_closed: float = 0.0
    finger_bodies: tuple[Name, ...] = ()
    mode: Name = "exclusive"
    hold: Name = ""
    tip_body: Name = ""
    T_body_tip: Pose = IDENTITY
    gripper_partners: tuple[GripperActuator, ...] = ()
    kind: Name = ARM
    on_release: Name = ON_RELEASE_HOLD

    @property
    def gripper_actuators(self) -> tuple[GripperActuator, ...]:
        """All actuators of the gripper, `gripper_actuator` first; empty without a gripper."""
        if not self.gripper_actuator:
            return ()
        first = GripperActuator(self.gripper_actuator, self.gripper_open, self.gripper_closed)
        return (first, *self.gripper_partners)


class ObjectSpec(msgspec.Struct, frozen=True):
    """A free body that people or robots can take.

    Attributes:
        name: Name of the object.
        body: Name of the body in the model.
    """

    name: Name
    body: Name


class ObjectRange(msgspec.Struct, frozen=True):
    """Range of places where an object of a task lies at the beginning of an episode.

    Attributes:
        object: Name of the object.
        x, y: Range of its position in the world, or a single value twice [m].
        z: Likewise its height; `None`: as in the scene.
        yaw: Range of the turn about the vertical axis, added to how it lies in the scene [rad].
    """

    object: Name
    x: tuple[float, float]
    y: tuple[float, float]
    z: tuple[float, float] | None = None
    yaw: tuple[float, float] = (0.0, 0.0)


class TaskSpec(msgspec.Struct, frozen=True):
    """A task of which episodes are recorded.

    Attributes:
        name: Name of the task.
        instruction: What is to be done, for people and for the training data.
        wanted: Number of successes that are wanted; 0: no number.
        robots: Robots that belong to its episodes; empty: those that are held when an episode begins.
        objects: Objects that lie elsewhere in each episode.
        seed: From which, with the number of the episode, their places are drawn.
        reset: The scene is reset after each episode.
        recorded: Number of the last episode of earlier sessions.
        successes: Number of their successes.
    """

    name: Name
    instruction: Text = ""
    wanted: Count = 0
    robots: tuple[Name, ...] = ()
    objects: tuple[ObjectRange, ...] = ()
    seed: Count = 0
    reset: bool = True
    recorded: Count = 0
    successes: Count = 0
