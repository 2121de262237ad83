"""Head motion of an emulated operator: around the sheet, towards the work, and glances in between.

The cameras detect a sheet only while the head is at rest: every resting pose is a viewpoint.
"""

from __future__ import annotations

import math
from typing import Final

from anchors.pose import PoseTuple, quat_conj, quat_from_rotvec, quat_mul, quat_to_rotvec
from iris_session.emulator.headset import compute_look_at
from iris_session.emulator.specs import HeadsetSpec

MOVE_S: Final = 0.6  # the head moves from one place to the next, at about 1 m/s


class Gaze:
    """Pose of one head over time. `pose`: `T_world_head`. `viewpoint_id`: of the pose that it has or moves to."""

    def __init__(self, spec: HeadsetSpec) -> None:
        self._spec = spec
        self._seat = compute_look_at(spec.eye, spec.T_world_anchor[0])
        self._at_work = self._seat if spec.gaze is None else compute_look_at(spec.eye, spec.gaze)
        self.pose = self._from = self._to = self._seat
        self.viewpoint_id = 0
        self._moved_ns = 0
        self._glances = 0
        self._glance_ns: int | None = None  # when the next one begins, or the present one began

    def move_to_viewpoint(self, index: int, now_ns: int) -> None:
        """Move to the `index`-th viewpoint around the sheet."""
        self._move(compute_viewpoint_pose(self._spec, index), now_ns)

    def look_at_sheet(self, now_ns: int) -> None:
        """Move to the seat, facing the sheet."""
        self._glance_ns = None
        self._move(self._seat, now_ns)

    def look_at_work(self, now_ns: int) -> None:
        """Move to the seat, facing the work; now and then glance at the sheet, from another viewpoint each time."""
        spec = self._spec
        every_ns, glance_ns = int(spec.glance_every_s * 1e9), int((MOVE_S + spec.glance_s) * 1e9)
        if self._glance_ns is None:
            self._glance_ns = now_ns + every_ns
        if every_ns <= 0 or now_ns < self._glance_ns:
            self._move(self._at_work, now_ns)
        elif now_ns < self._glance_ns + glance_ns:
            self.move_to_viewpoint(self._glances % max(1, spec.viewpoints), now_ns)
        else:
            self._glances += 1
            self._glance_ns = now_ns + every_ns
            self._move(self._at_work, now_ns)

    def is_still(self, now_ns: int) -> bool:
        """Return True when the head has come to rest."""
        return now_ns - self._moved_ns >= MOVE_S * 1e9

    def _move(self, to: PoseTuple, now_ns: int) -> None:
        """Move the head towards a pose, which it reaches `MOVE_S` after the first call."""
        if to != self._to:
            self._from, self._to, self._moved_ns = self.pose, to, now_ns
            self.viewpoint_id += 1
        s = min(1.0, (now_ns - self._moved_ns) / (MOVE_S * 1e9))
        self.pose = interpolate_pose(self._from, self._to, s * s * (3.0 - 2.0 * s))


def interpolate_pose(a: PoseTuple, b: PoseTuple, fraction: float) -> PoseTuple:
    """Return the pose at `fraction` of the way from `a` to `b`: straight line and shortest turn."""
    r = quat_to_rotvec(quat_mul(quat_conj(a[1]), b[1]))
    turn = quat_from_rotvec((fraction * r[0], fraction * r[1], fraction * r[2]))
    p, q = a[0], b[0]
    return (
        (p[0] + fraction * (q[0] - p[0]), p[1] + fraction * (q[1] - p[1]), p[2] + fraction * (q[2] - p[2])),
        quat_mul(a[1], turn),
    )


def compute_viewpoint_pose(spec: HeadsetSpec, index: int) -> PoseTuple:
    """Return the head pose of the `index`-th viewpoint: 0.4 to 0.6 m from the sheet, spread +-50 deg about the seat."""
    x, y, z = spec.T_world_anchor[0]
    seat = math.atan2(spec.eye[1] - y, spec.eye[0] - x)
    share = 0.5 if spec.viewpoints == 1 else index / (spec.viewpoints - 1)
    azimuth = seat + math.radians(100.0) * (share - 0.5)
    elevation = math.radians(40.0 if index % 2 else 60.0)
    reach = 0.4 + 0.1 * (index % 3)
    flat = reach * math.cos(elevation)
    eye = (x + flat * math.cos(azimuth), y + flat * math.sin(azimuth), z + reach * math.sin(elevation))
    return compute_look_at(eye, (x, y, z))
