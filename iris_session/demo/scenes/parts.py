"""Parts of generated scenes: boards to hand over, and the printed sheet that headsets align to."""

from __future__ import annotations

import math
from typing import Any

from iris_session.protocol.common import Vec3

#: The dark squares of the drawn sheet: x, y, half width in x [m].
_INK = ((-0.06, 0.06, 0.02), (0.06, 0.06, 0.02), (-0.06, -0.06, 0.02), (0.01, 0.01, 0.03))


def add_board(spec: Any, name: str, p_world: Vec3, yaw: float, half_size: Vec3, mass: float, rgb: Vec3) -> list[float]:
    """Add a free board: x along its length, y across (where a gripper takes it). Returns its `qpos`, 7 numbers.

    Its contacts have the friction that ALOHA's model gives its finger tips; priority makes them stiffer than the
    model's, which are so soft for a light thing that fingers sink 2 mm into it.
    """
    import mujoco

    quat = [math.cos(yaw / 2.0), 0.0, 0.0, math.sin(yaw / 2.0)]
    body = spec.worldbody.add_body(name=name, pos=list(p_world), quat=quat)
    body.add_freejoint(name=name)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=list(half_size),
        mass=mass,
        rgba=[*rgb, 1.0],
        condim=4,
        friction=[1.0, 0.005, 0.0001],
        priority=1,
        solref=[0.005, 1.0],
        solimp=[0.95, 0.99, 0.001, 0.5, 2.0],
    )
    return [*p_world, *quat]


def add_sheet(spec: Any, p_world: Vec3) -> None:
    """Add a printed sheet, face up, its middle at `p_world`. It is visual only and has no contacts."""
    import mujoco

    sheet = spec.worldbody.add_body(name="sheet", pos=list(p_world))
    parts = [([0.105, 0.1], [0.0, 0.0], 0.0002, [0.97, 0.97, 0.97, 1.0])]
    parts += [([width, 0.02], [x, y], 0.0004, [0.05, 0.05, 0.05, 1.0]) for x, y, width in _INK]
    for half, (x, y), z, rgba in parts:
        sheet.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[*half, 0.0004],
            pos=[x, y, z],
            rgba=rgba,
            contype=0,
            conaffinity=0,
        )


def get_sheet_position(n_arms: int) -> Vec3:
    """Return the sheet position for `n_arms` around a round table: before two arms as in `handover.xml`, else the
    middle."""
    return (0.0, -0.45, 0.0) if n_arms <= 2 else (0.0, 0.0, 0.0)
