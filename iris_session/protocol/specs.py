"""Robots and objects of a session by name. Found in a model by `physics`, used by every other room."""

from __future__ import annotations

import msgspec

from iris_session.protocol.common import Name


class RobotSpec(msgspec.Struct, frozen=True):
    """A named group of joints, actuators, end-effector site and gripper that is controlled as one.

    `joints` and `actuators` have the same order (one actuator per arm joint). `gripper_actuator` is empty without a
    gripper; `gripper_open` and `gripper_closed` are its ctrl values. `finger_bodies`: bodies whose geoms count as the
    gripper (contacts, handover). `base_body`: root of the robot's subtree. `hold`: declared hold law for torque
    actuators (`gravity_pd`), empty for none (then torque actuators are refused at start).
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


class ObjectSpec(msgspec.Struct, frozen=True):
    """A free body that people or robots can take. `body` is its name in the model."""

    name: Name
    body: Name
