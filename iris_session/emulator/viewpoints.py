"""Where the head goes to look at the sheet, and how it gets there."""

from __future__ import annotations

import math

from anchors.pose import PoseTuple, quat_conj, quat_from_rotvec, quat_mul, quat_to_rotvec
from iris_session.emulator.headset import look_at
from iris_session.emulator.specs import HeadsetSpec


def between(a: PoseTuple, b: PoseTuple, fraction: float) -> PoseTuple:
    """The pose at `fraction` of the way from `a` to `b`: straight line and shortest turn."""
    r = quat_to_rotvec(quat_mul(quat_conj(a[1]), b[1]))
    turn = quat_from_rotvec((fraction * r[0], fraction * r[1], fraction * r[2]))
    p, q = a[0], b[0]
    return (
        (p[0] + fraction * (q[0] - p[0]), p[1] + fraction * (q[1] - p[1]), p[2] + fraction * (q[2] - p[2])),
        quat_mul(a[1], turn),
    )


def viewpoint_pose(spec: HeadsetSpec, index: int) -> PoseTuple:
    """Where the head goes for the `index`-th look: 0.4 to 0.6 m from the sheet, spread +-50 deg about the seat."""
    x, y, z = spec.T_world_anchor[0]
    seat = math.atan2(spec.eye[1] - y, spec.eye[0] - x)
    share = 0.5 if spec.viewpoints == 1 else index / (spec.viewpoints - 1)
    azimuth = seat + math.radians(100.0) * (share - 0.5)
    elevation = math.radians(40.0 if index % 2 else 60.0)
    reach = 0.4 + 0.1 * (index % 3)
    flat = reach * math.cos(elevation)
    eye = (x + flat * math.cos(azimuth), y + flat * math.sin(azimuth), z + reach * math.sin(elevation))
    return look_at(eye, (x, y, z))
