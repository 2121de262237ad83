"""Display buffer: interpolates between frames, never extrapolates, never goes back."""

from __future__ import annotations

import numpy as np
import pytest

from anchors.pose import quat_angle, quat_from_rotvec
from iris_session.client.core.interpolation import PoseBuffer, interpolate

MS = 1_000_000


def frame(x: float, angle: float = 0.0) -> np.ndarray:
    return np.array([[x, 0.0, 0.0, *quat_from_rotvec((0.0, 0.0, angle))]])


def test_slerp_has_constant_speed_and_takes_the_short_way() -> None:
    a, b = frame(0.0, 0.0), frame(1.0, 2.0)
    b[:, 3:] *= -1.0  # the same orientation, opposite sign
    for fraction in (0.0, 0.25, 0.5, 1.0):
        pose = interpolate(a, b, fraction)
        assert pose[0, 0] == pytest.approx(fraction)
        assert np.linalg.norm(pose[0, 3:]) == pytest.approx(1.0, abs=1e-12)
        assert quat_angle(tuple(pose[0, 3:]), tuple(a[0, 3:])) == pytest.approx(2.0 * fraction, abs=1e-9)


def test_past_is_interpolated_with_its_age() -> None:
    buffer = PoseBuffer(delay_ns=30 * MS)
    assert buffer.poses_at(0) is None
    for i in range(6):
        buffer.add(i * 16 * MS, frame(0.016 * i))
    shown = buffer.poses_at(70 * MS)
    assert shown is not None
    assert shown.poses[0, 0] == pytest.approx(0.040)
    assert (shown.session_time_ns, shown.age_ns, shown.starved) == (40 * MS, 30 * MS, False)


def test_starved_display_keeps_the_newest_frame_and_reports_it() -> None:
    buffer = PoseBuffer(delay_ns=10 * MS)
    buffer.add(0, frame(1.0))
    shown = buffer.poses_at(500 * MS)
    assert shown is not None
    assert shown.poses[0, 0] == 1.0
    assert shown.age_ns == 500 * MS
    assert shown.starved
    assert buffer.starvations == 1


def test_displayed_time_never_goes_back_and_old_frames_are_counted() -> None:
    buffer = PoseBuffer(delay_ns=10 * MS)
    for i in range(4):
        buffer.add(i * 10 * MS, frame(float(i)))
    first = buffer.poses_at(35 * MS)
    again = buffer.poses_at(25 * MS)
    assert first is not None
    assert again is not None
    assert again.session_time_ns == first.session_time_ns
    buffer.add(5 * MS, frame(9.0))
    assert buffer.late == 1
    buffer.clear()
    assert buffer.poses_at(40 * MS) is None
