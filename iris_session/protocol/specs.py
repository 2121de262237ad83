"""Robots and objects of a session by name. Found in a model by `physics`, used by every other room."""

from __future__ import annotations

import msgspec

from iris_session.protocol.common import Name


class RobotSpec(msgspec.Struct, frozen=True):
    """A named group of joints, actuators, end-effector site and gripper that is controlled as one.

    Attributes:
        name: Name of the robot.
        joints, actuators: Names in the model, in the same order: one actuator per arm joint.
        site: Site of the end effector.
        base_body: Root of the robot's subtree.
        gripper_actuator: Empty without a gripper.
        gripper_open, gripper_closed: Values of its `ctrl`.
        finger_bodies: Bodies whose geoms count as the gripper (contacts, handover).
        mode: Lease mode (`LeaseMode`).
        hold: Declared hold law of torque actuators (`gravity_pd`); empty: none, and torque actuators are refused.
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
    """A free body that people or robots can take.

    Attributes:
        name: Name of the object.
        body: Name of the body in the model.
    """

    name: Name
    body: Name
