"""Objects and arms of the demo scenes as known to scripted operators: their size, and where to grasp and offer them.

Frames as in `demo/scenes/handover.xml`: x along the handle towards its free end, y across (the closing direction of
a gripper), z up when it lies on the table, origin in the middle of the length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from anchors.pose import (
    PoseTuple,
    Quat,
    Vec3,
    apply,
    compose,
    quat_from_rotvec,
    quat_from_yaw,
    quat_mul,
    quat_rotate,
)

#: Turn of a tip that points straight down, its x axis along that of the world.
DOWN: Quat = (0.0, 1.0, 0.0, 0.0)
#: Distance above a grasp at which the approach begins, and distance of the retreat afterwards [m].
CLEAR_ABOVE = 0.11
#: How far above the middle of a thing's thickness the pads take it [m]: keeps the finger tips clear of the table.
_GRASP_ABOVE = 0.003


@dataclass(frozen=True, slots=True)
class HandoverObject:
    """An object that can be handed over.

    `giver_x`, `receiver_x`: where along x the giver and the receiver take it [m]. `half_width`: along y at both places
    [m]. `corners`: points of its outline that can touch a table. `symmetric`: either end may be given.
    """

    giver_x: float
    receiver_x: float
    half_width: float
    half_thickness: float
    corners: tuple[Vec3, ...]
    symmetric: bool = False

    def compute_lowest(self, T_world_thing: PoseTuple) -> float:
        """Return the height of its lowest point [m]."""
        return min(apply(T_world_thing, corner)[2] for corner in self.corners)


def _outline(*boxes: tuple[float, float, float, float]) -> tuple[Vec3, ...]:
    """Return the corners of boxes given as (x from, x to, half width, half thickness)."""
    return tuple((x, y, z) for a, b, w, t in boxes for x in (a, b) for y in (-w, w) for z in (-t, t))


HAMMER = HandoverObject(
    giver_x=-0.080,
    receiver_x=0.085,
    half_width=0.0123,
    half_thickness=0.016,
    corners=_outline((-0.164, -0.132, 0.062, 0.016), (0.036, 0.140, 0.0125, 0.0155)),
)
BOARD = HandoverObject(
    giver_x=-0.080,
    receiver_x=0.080,
    half_width=0.028,
    half_thickness=0.012,
    corners=_outline((-0.150, 0.150, 0.028, 0.012)),
    symmetric=True,
)
#: Of the ALOHA scene: light enough for the points of its finger tips.
SLAT = HandoverObject(
    giver_x=-0.100,
    receiver_x=0.100,
    half_width=0.016,
    half_thickness=0.0125,
    corners=_outline((-0.145, 0.145, 0.016, 0.0125)),
    symmetric=True,
)
KNOWN_OBJECTS: dict[str, HandoverObject] = {"hammer": HAMMER, "board": BOARD, "red_board": SLAT, "blue_board": SLAT}

#: Objects that may lie in the scene as obstacles.
COMMON_OBJECTS = (*KNOWN_OBJECTS, *(f"object{i}" for i in range(1, 9)))


def find_object(name: str) -> HandoverObject:
    """Return the object of body `name`: one of `KNOWN`, or `objectN` of a generated scene (odd N: hammers)."""
    if name.startswith("object") and name[6:].isdigit():
        return HAMMER if int(name[6:]) % 2 else BOARD
    if name not in KNOWN_OBJECTS:
        raise ValueError(f"unknown object '{name}'. Known objects: {', '.join(KNOWN_OBJECTS)}, object1, object2, ...")
    return KNOWN_OBJECTS[name]


def get_face_up(T_world_thing: PoseTuple) -> float:
    """Return 1 when the object's z axis points up, -1 when it lies on its other face."""
    return 1.0 if quat_rotate(T_world_thing[1], (0.0, 0.0, 1.0))[2] >= 0.0 else -1.0


def compute_tilt(T_world_thing: PoseTuple) -> float:
    """Return the angle [rad] between the object's z axis and the vertical, 0 on either face."""
    return math.acos(min(1.0, abs(quat_rotate(T_world_thing[1], (0.0, 0.0, 1.0))[2])))


def make_level_pose(p_world: Vec3, yaw: float, up: float) -> PoseTuple:
    """Return the pose of an object that lies level with its x axis along `yaw` [rad], on the face given by `up`."""
    q = quat_from_yaw(yaw)
    return (p_world, q if up > 0.0 else quat_mul(q, (0.0, 1.0, 0.0, 0.0)))


def compute_grasps(T_world_thing: PoseTuple, x: float, lean: float = 0.0) -> list[PoseTuple]:
    """Return the two tip poses that grasp the object at `x` [m] from above, half a turn from each other. The fingers
    lean
    towards its middle by `lean` [rad]."""
    up = get_face_up(T_world_thing)
    ways: tuple[Quat, Quat] = ((0.0, 0.0, 1.0, 0.0), (0.0, 1.0, 0.0, 0.0))
    if up < 0.0:
        ways = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    # About the thing's y axis: brings the fingers, along -up z, towards the middle, along -x.
    leaning = quat_from_rotvec((0.0, math.copysign(lean, x) * up, 0.0))
    return [compose(T_world_thing, ((x, 0.0, up * _GRASP_ABOVE), quat_mul(leaning, way))) for way in ways]


def raise_pose(pose: PoseTuple, height: float) -> PoseTuple:
    """Return the same pose `height` [m] higher."""
    (x, y, z), q = pose
    return ((x, y, z + height), q)


# --- arms -------------------------------------------------------------------------------------------------------------


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
