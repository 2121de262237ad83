"""Franka Emika Panda arms around a round table: the scene of `iris-session demo panda`.

The model is that of MuJoCo Menagerie, with its hand. World, names and objects as in `n_arms_scene`.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

from iris_session.demo.scenes.generators import (
    add_object,
    add_round_table,
    arm_names,
    compute_bearing,
    compute_circle_radius,
    make_room,
    place_arm,
)
from iris_session.demo.scenes.models import find_model_file, load_model_spec
from iris_session.demo.scenes.parts import add_sheet, get_sheet_position

#: Joint positions with the gripper pointing down, 0.50 m in front of the base and 0.35 m above it [rad].
PANDA_HOME: Final = (0.0, -0.1582, 0.0, -2.1932, 0.0, 2.0350, math.pi / 4)
FINGER_OPEN: Final = 0.04  # m, of one finger
GRIPPER_OPEN: Final = 255.0  # of the actuator of the gripper
MAX_ARMS: Final = 8
#: Between the pads of the fingers, in the frame of the hand [m].
_P_HAND_TCP: Final = (0.0, 0.0, 0.1029)
#: Stiffness and damping of the gripper, over those of Menagerie, whose fingers press an object of this scene with less
#: than 1 N: now 50 N, and the data sheet of the real hand has 70 N.
_STIFFER: Final = 100.0
_MORE_DAMPED: Final = 10.0
_FINGER_DAMPING: Final = 6.0  # N s/m, as of arm.xml
#: Distance of two arms from the middle [m]; of more arms, the least distance, and the spacing between adjacent arms.
_TWO: Final = 0.75
_LEAST_RADIUS, _APART = 1.0, 1.1
_REACH: Final = 0.62  # from a base to the object in front of it [m]


def compute_panda_radius(n: int) -> float:
    """Return the radius [m] of the circle on which `n` arms stand."""
    return _TWO if n <= 2 else compute_circle_radius(n, _LEAST_RADIUS, _APART)


def panda_scene(n: int = 2) -> Any:
    """Return an `mujoco.MjSpec` with `n` (1 to 8) arms, a hammer or board for every two, a sheet, keyframe `home`.

    Raises `ValueError` when `n` is out of range, `ModelNotFoundError` when no source has the model.
    """
    if not 1 <= n <= MAX_ARMS:
        raise ValueError(f"panda_scene makes 1 to {MAX_ARMS} arms, not {n}")
    path = find_model_file("franka_emika_panda", "panda.xml")
    radius = compute_panda_radius(n)
    spec = make_room("panda")
    add_round_table(spec, radius + 0.30)
    for i, name in enumerate(arm_names(n)):
        spec.attach(_arm(path), prefix=f"{name}/", frame=place_arm(spec, radius, compute_bearing(i, n)))
    if hasattr(spec, "dedup_assets"):  # MuJoCo 4: the meshes of the arms once
        spec.dedup_assets()
    qpos = [*PANDA_HOME, FINGER_OPEN, FINGER_OPEN] * n
    n_objects = (n + 1) // 2
    for k in range(n_objects):
        qpos += add_object(spec, k, n_objects, radius - _REACH)
    add_sheet(spec, get_sheet_position(n))
    spec.add_key(name="home", qpos=qpos, ctrl=[*PANDA_HOME, GRIPPER_OPEN] * n)
    return spec


def _arm(path: Path) -> Any:
    """Return one arm. Its controller compensates gravity, as the real one does."""
    import mujoco

    arm = load_model_spec(path)
    for light in list(arm.lights):
        arm.delete(light)
    for body in arm.bodies:
        if body.name != "world":
            body.gravcomp = 1.0
    arm.body("hand").add_site(  # z along the fingers, y the closing direction
        name="tcp", pos=list(_P_HAND_TCP), size=[0.004, 0.004, 0.004], group=4
    )
    gripper = arm.actuator("actuator8")
    gripper.gainprm[0] *= _STIFFER
    gripper.biasprm[1] *= _STIFFER
    gripper.biasprm[2] *= _MORE_DAMPED
    for finger in ("left_finger", "right_finger"):
        arm.body(finger).joints[0].damping[0] = _FINGER_DAMPING
        for pad in arm.body(finger).geoms:
            if int(pad.type) == int(mujoco.mjtGeom.mjGEOM_BOX):  # rubber, as the pads of arm.xml
                pad.condim, pad.priority = 4, 1
                pad.friction = [1.2, 0.008, 0.0001]
                pad.solref, pad.solimp = [0.005, 1.0], [0.95, 0.99, 0.001, 0.5, 2.0]
    return arm
