"""Head motion: on the work, with glances at the sheet at the configured rate, and a viewpoint at every stop."""

from __future__ import annotations

import pytest

from iris_session.emulator.gaze import Gaze
from iris_session.emulator.headset import EmulatedHeadset, HeadsetModel
from iris_session.emulator.specs import HeadsetSpec

MS = 1_000_000
SECOND = 1000 * MS
AWAY = (0.0, -3.0, 0.6)  # behind the person


def glances(gaze: Gaze, spec: HeadsetSpec, seconds: float) -> list[tuple[int, int]]:
    """Return (time, viewpoint) at which the sheet is in view of a head at rest, sampled 50 times a second."""
    headset, seen = EmulatedHeadset(HeadsetModel(), 0), []
    for now_ns in range(SECOND, SECOND + int(seconds * SECOND), 20 * MS):
        gaze.look_at_work(now_ns)
        if gaze.is_still(now_ns) and headset.can_see(gaze.pose, spec.T_world_anchor):
            seen.append((now_ns, gaze.viewpoint_id))
    return seen


def test_working_head_sees_the_sheet_in_glances_only() -> None:
    spec = HeadsetSpec(name="ann", gaze=AWAY, glance_every_s=3.0, glance_s=1.0)
    seen = glances(Gaze(spec), spec, 20.0)
    assert len({viewpoint for _, viewpoint in seen}) == 4
    assert len(seen) * 0.02 == pytest.approx(4.0, abs=0.2), "a second each"
    assert glances(Gaze(HeadsetSpec(name="ann", gaze=AWAY)), spec, 20.0) == []


def test_moving_head_detects_nothing_and_a_stop_is_a_viewpoint() -> None:
    spec = HeadsetSpec(name="ann")
    gaze = Gaze(spec)
    assert glances(gaze, spec, 1.0), "by default the sheet is in view of those who work"
    at_rest = gaze.viewpoint_id
    now_ns = 10 * SECOND
    gaze.move_to_viewpoint(0, now_ns)
    assert gaze.viewpoint_id == at_rest + 1
    assert not gaze.is_still(now_ns + 300 * MS)
    gaze.move_to_viewpoint(0, now_ns + 700 * MS)
    assert gaze.is_still(now_ns + 700 * MS)
    assert gaze.viewpoint_id == at_rest + 1
