"""Two arms and deformables on the table between them: the scenes of `iris-session demo cloth` and `demo soft`.

The files hold table and flexes, which only MJCF text can describe; the arms of `arm.xml` are put there here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from iris_session.demo.scenes.generators import ARM_FILE, ARM_HOME, FINGER_OPEN, arm_names, compute_bearing, place_arm
from iris_session.demo.scenes.parts import add_sheet, get_sheet_position
from iris_session.protocol.common import Vec3

#: Two arms stand so far from the middle [m], as in handover.xml.
RADIUS: Final = 0.6
#: The corners of the inside of the box of `soft.xml` [m, world].
BOX_LOW: Final[Vec3] = (-0.240, 0.075, 0.0)
BOX_HIGH: Final[Vec3] = (0.240, 0.265, 0.074)
#: Pairs of corners of the cloth (vertices) that come together when its near edge is folded over to the far one.
FOLD_PAIRS: Final = ((0, 16), (272, 288))
_COLOURS: Final[tuple[Vec3, ...]] = ((0.16, 0.45, 0.70), (0.88, 0.47, 0.13))
_OPTIONS: Final = ("timestep", "integrator", "cone", "impratio", "solver", "iterations", "tolerance")


def cloth_scene() -> Any:
    """Return an `mujoco.MjSpec`: arms `left` and `right`, a `cloth` of 17 x 17 vertices, a sheet, keyframe `home`."""
    return _with_two_arms("cloth", _round_tips)


def soft_scene() -> Any:
    """Return an `mujoco.MjSpec`: arms `left` and `right`, soft bodies `rose` and `mint`, a body `box`, a sheet,
    keyframe
    `home`."""
    return _with_two_arms("soft")


def _round_tips(arm: Any) -> None:
    """Replace the finger tips by rubber rods as thick as the pad above them.

    Square tips pierce cloth with their edges, and a low wrinkle slips from under a thicker rod. Faces and ends stay
    where those of the pads were.
    """
    import mujoco

    for side in ("left", "right"):
        pad, tip = arm.geom(f"pad_{side}"), arm.geom(f"finger_{side}_tip")
        pad.size, pad.pos = [0.011, 0.004, 0.010], [0.0, 0.004, 0.043]
        tip.type = mujoco.mjtGeom.mjGEOM_CAPSULE
        tip.size, tip.pos, tip.quat = [0.004, 0.011, 0.0], [0.0, 0.004, 0.053], [0.5**0.5, 0.0, 0.5**0.5, 0.0]
        for attribute in ("condim", "priority", "friction", "solref", "solimp", "material"):
            setattr(tip, attribute, getattr(pad, attribute))


def _with_two_arms(file: str, change: Callable[[Any], None] | None = None) -> Any:
    """Return the packaged `file` with an arm on either side of its table. `change`: applied to each arm before."""
    import mujoco

    spec = mujoco.MjSpec.from_file(str(ARM_FILE.parent / f"{file}.xml"))
    resting = [0.0] * len(spec.joints)  # slides of the flexes, which lie where the file says
    for i, name in enumerate(arm_names(2)):
        arm = mujoco.MjSpec.from_file(str(ARM_FILE))
        arm.material("accent").rgba = [*_COLOURS[i], 1.0]
        if change is not None:
            change(arm)
        for option in _OPTIONS:  # MuJoCo warns where they differ
            setattr(arm.option, option, getattr(spec.option, option))
        place_arm(spec, RADIUS, compute_bearing(i, 2)).attach_body(arm.body("base"), f"{name}/", "")
    add_sheet(spec, get_sheet_position(2))
    qpos = [*resting, *([*ARM_HOME, FINGER_OPEN, FINGER_OPEN] * 2)]
    spec.add_key(name="home", qpos=qpos, ctrl=[*ARM_HOME, FINGER_OPEN] * 2)
    return spec
