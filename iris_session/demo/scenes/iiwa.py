"""KUKA LBR iiwa 14 arms around a round table: the scene of `iris-session demo iiwa`.

The model is that of MuJoCo Menagerie, from `IRIS_DATA`. The arm comes without a gripper: it gets the parallel gripper
of our own `arm.xml` on its flange. World, names and objects as in `n_arms_scene`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from iris_session.demo.scenes.generators import (
    ARM_FILE,
    FINGER_OPEN,
    add_object,
    add_round_table,
    arm_names,
    compute_bearing,
    compute_circle_radius,
    compute_hue,
    make_room,
    place_arm,
)
from iris_session.demo.scenes.models import find_model_file, load_model_spec
from iris_session.demo.scenes.parts import add_sheet, get_sheet_position
from iris_session.protocol.common import Vec3

#: Joint positions with the gripper pointing down, 0.50 m in front of the base and 0.35 m above it [rad].
IIWA_HOME: Final = (0.0, 0.3225, 0.0, -1.658, 0.0, 1.1611, 0.0)
MAX_ARMS: Final = 8
#: Distance of two arms from the middle [m]; of more arms, the least distance, and the spacing between adjacent arms.
_TWO: Final = 0.75
_LEAST_RADIUS, _APART = 1.0, 1.1
_REACH: Final = 0.62  # from a base to the object in front of it [m]


def compute_iiwa_radius(n: int) -> float:
    """Return the radius [m] of the circle on which `n` arms stand."""
    return _TWO if n <= 2 else compute_circle_radius(n, _LEAST_RADIUS, _APART)


def iiwa_scene(n: int = 2) -> Any:
    """Return an `mujoco.MjSpec` with `n` (1 to 8) arms, a hammer or board for every two, a sheet, keyframe `home`.

    Raises `ValueError` when `n` is out of range, `ModelNotFoundError` when `IRIS_DATA` lacks the model.
    """
    if not 1 <= n <= MAX_ARMS:
        raise ValueError(f"iiwa_scene makes 1 to {MAX_ARMS} arms, not {n}")
    path = find_model_file("kuka_iiwa_14", "iiwa14.xml")
    radius = compute_iiwa_radius(n)
    spec = make_room("iiwa")
    add_round_table(spec, radius + 0.30)
    for i, name in enumerate(arm_names(n)):
        spec.attach(_arm(path), prefix=f"{name}/", frame=place_arm(spec, radius, compute_bearing(i, n)))
        flange = spec.site(f"{name}/attachment_site")
        frame = spec.body(f"{name}/link7").add_frame(pos=flange.pos, quat=flange.quat)
        frame.attach_body(_gripper(compute_hue(i / n)).body("hand"), f"{name}/", "")
    if hasattr(spec, "dedup_assets"):  # MuJoCo 4: the meshes of the arms once
        spec.dedup_assets()
    qpos = [*IIWA_HOME, FINGER_OPEN, FINGER_OPEN] * n
    n_objects = (n + 1) // 2
    for k in range(n_objects):
        qpos += add_object(spec, k, n_objects, radius - _REACH)
    add_sheet(spec, get_sheet_position(n))
    spec.add_key(name="home", qpos=qpos, ctrl=[*IIWA_HOME, FINGER_OPEN] * n)
    return spec


def _arm(path: Path) -> Any:
    """Return one arm. Its controller compensates gravity, as the real one does."""
    arm = load_model_spec(path)
    for light in list(arm.lights):
        arm.delete(light)
    for body in arm.bodies:
        if body.name != "world":
            body.gravcomp = 1.0
    return arm


def _gripper(rgb: Vec3) -> Any:
    """Return the arm of `arm.xml` reduced to its hand, to be attached."""
    import mujoco

    gripper = mujoco.MjSpec.from_file(str(ARM_FILE))
    gripper.material("accent").rgba = [*rgb, 1.0]
    for actuator in [a for a in gripper.actuators if a.name != "gripper"]:
        gripper.delete(actuator)
    return gripper
