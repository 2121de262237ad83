"""Arm models known to scripted operators: finger pads, mounting, and preferred grasps. Names of bodies follow the
robot's name and a slash."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from anchors.pose import Vec3


@dataclass(frozen=True, slots=True)
class ArmKind:
    """One kind of arm with its gripper. Its tip has z along the fingers and y in the closing direction.

    `base`, `fingers`: names of bodies. `pads`: middle of the face of each finger in the frame of its body [m].
    `above_table`: height of the base above the table [m]. `exchange_height`: of the hands above the bases when a thing
    changes hands [m]; `exchange_inward`: from the line between the bases towards where both arms face [m]. `lean`: how
    far the gripper leans away from its arm when it takes things from above [rad]. `reach`: how far in front of its base
    it lays things down [m]. `grasp_above`: how far above its middle an object that lies on the table is grasped [m], so
    that the fingertips do not stand on the table. `speed`: of free movements [m/s]. `near_m`, `near_rad`: how near the
    tip can be brought to where it should be.
    """

    base: str = "base"
    fingers: tuple[str, str] = ("finger_left", "finger_right")
    pads: tuple[Vec3, Vec3] = ((0.0, 0.0, 0.045), (0.0, 0.0, 0.045))
    above_table: float = 0.0
    exchange_height: float = 0.34
    exchange_inward: float = 0.2
    lean: float = 0.0
    reach: float = 0.43
    grasp_above: float = 0.0
    speed: float = 0.40
    near_m: float = 0.0025
    near_rad: float = 0.025


#: The arm of `arm.xml`, in the handover demo.
ARM: Final = ArmKind()
#: Franka Emika Panda with its own hand.
PANDA: Final = ArmKind(
    base="link0",
    fingers=("left_finger", "right_finger"),
    pads=((0.0, 0.0, 0.0445), (0.0, 0.0, 0.0445)),
    exchange_height=0.30,
    exchange_inward=0.35,
    lean=math.radians(20.0),
    reach=0.62,
    speed=0.33,
)
#: ViperX 300 of an ALOHA station. The camera above its gripper is in the way of a partner's unless both lean; leaning
#: farther, its wrist would be stretched (singular) at the table. Its light servos are compliant and lag: it is moved
#: slowly.
VIPERX: Final = ArmKind(
    base="base_link",
    fingers=("left_finger_link", "right_finger_link"),
    pads=((0.0146, -0.080, 0.0332), (0.0146, 0.080, 0.0332)),
    above_table=0.02,
    exchange_height=0.22,
    exchange_inward=0.15,
    lean=math.radians(20.0),
    grasp_above=0.006,
    speed=0.25,
    near_m=0.004,
    near_rad=0.04,
)
ARM_KINDS: Final[dict[str, ArmKind]] = {"arm": ARM, "panda": PANDA, "viperx": VIPERX}


def get_arm_kind(name: str) -> ArmKind:
    """Return the arm model of that name. Raises `ValueError` listing the kinds."""
    if name not in ARM_KINDS:
        raise ValueError(f"unknown arm '{name}'. Known arms: {', '.join(ARM_KINDS)}")
    return ARM_KINDS[name]
