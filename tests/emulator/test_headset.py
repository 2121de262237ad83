"""The emulated headset: its stated noise, its own tracking frame, and reproducibility."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchors.alignment import mirror_pose
from anchors.pose import (
    PoseTuple,
    apply,
    compose,
    distance,
    inverse,
    quat_angle,
    quat_conj,
    quat_from_rotvec,
    quat_mul,
    quat_rotate,
    quat_to_rotvec,
)
from iris_session.emulator.headset import (
    DEFAULT_T_WORLD_ANCHOR,
    DelayLine,
    EmulatedHeadset,
    HeadsetModel,
    LinkModel,
    compute_look_at,
)
from iris_session.emulator.sheet_noise import SheetNoise

SECOND = 1_000_000_000
MINUTE = 60 * SECOND
SHEET = DEFAULT_T_WORLD_ANCHOR
#: No drift, no wrong detections, no scale error: only the noise of single observations.
STILL = HeadsetModel(drift_m_per_min=0.0, drift_rad_per_min=0.0, sheet=SheetNoise(wrong_share=0.0, scale=0.0))


def above(d: float, aside: float = 0.2) -> PoseTuple:
    """Return a head pose at distance `d` from the sheet, looking at it from above and slightly aside."""
    x, y, z = SHEET[0]
    return compute_look_at((x, y - d * math.sin(aside), z + d * math.cos(aside)), SHEET[0])


def errors(headset: EmulatedHeadset, head: PoseTuple, n: int, viewpoint: int | None = None) -> np.ndarray:
    """Return (n, 4): position error along and across (2) the view, angle about one axis; one viewpoint each."""
    rows = []
    e1 = np.subtract(SHEET[0], head[0]) / distance(SHEET[0], head[0])
    e2 = np.cross(e1, (1.0, 0.0, 0.0))
    e2 /= np.linalg.norm(e2)
    e3 = np.cross(e1, e2)
    for i in range(n):
        seen = headset.observe(head, SHEET, 0, i if viewpoint is None else viewpoint)
        assert seen is not None
        world = compose(headset.get_T_world_tracking(0), seen)
        off = np.subtract(world[0], SHEET[0])
        turn = quat_to_rotvec(quat_mul(quat_conj(SHEET[1]), world[1]))
        rows.append((off @ e1, off @ e2, off @ e3, turn[2]))
    return np.array(rows)


@pytest.mark.parametrize(("d", "along_mm", "degrees"), [(0.5, 1.5, 0.3), (1.0, 4.8, 0.6)])
def test_sheet_noise_matches_the_model(d: float, along_mm: float, degrees: float) -> None:
    spread = errors(EmulatedHeadset(STILL, seed=1), above(d), 3000).std(axis=0)
    assert spread[0] == pytest.approx(along_mm * 1e-3, rel=0.06)
    assert spread[1] == pytest.approx(along_mm * 1e-3 / 3.0, rel=0.06)
    assert spread[2] == pytest.approx(along_mm * 1e-3 / 3.0, rel=0.06)
    assert spread[3] == pytest.approx(math.radians(degrees), rel=0.06)


def test_some_detections_are_wrong_and_half_of_those_mirrored() -> None:
    headset, head = EmulatedHeadset(HeadsetModel(sheet=SheetNoise(wrong_share=1.0)), seed=2), above(0.5)
    there = compose(inverse(headset.get_T_world_tracking(0)), head)[0]
    back = []
    for viewpoint in range(400):
        seen = headset.observe(head, SHEET, 0, viewpoint)
        assert seen is not None
        right_way_round = compose(headset.get_T_world_tracking(0), mirror_pose(seen, there))
        back.append(distance(right_way_round[0], SHEET[0]) + quat_angle(right_way_round[1], SHEET[1]))
    assert sum(b < 1e-6 for b in back) == pytest.approx(200, abs=40)
    assert sum(b > 0.05 for b in back) == pytest.approx(200, abs=40)


def test_same_seed_gives_the_same_readings() -> None:
    a, b, c = (EmulatedHeadset(HeadsetModel(), seed) for seed in (3, 3, 4))
    for headset in (a, b, c):
        headset.recentre_frame(SECOND)
    readings = [[h.observe(above(0.5), SHEET, i * SECOND, 0) for i in range(5)] for h in (a, b, c)]
    assert readings[0] == readings[1]
    assert readings[0] != readings[2]


@pytest.mark.parametrize(
    "head",
    [
        above(2.0),
        above(0.5, aside=1.3),
        compose(above(0.5), ((0.0, 0.0, 0.0), quat_from_rotvec((0.0, 0.0, 1.0)))),
        compute_look_at((0.0, -0.55, -0.5), SHEET[0]),
    ],
    ids=["far", "from the side", "looking away", "from below"],
)
def test_sheet_out_of_view_is_not_detected(head: PoseTuple) -> None:
    assert EmulatedHeadset(HeadsetModel(), 0).observe(head, SHEET, 0, 0) is None


def test_drift_and_tilt_are_small_and_stated() -> None:
    headset = EmulatedHeadset(HeadsetModel(), seed=5)
    start, later = headset.get_T_world_tracking(0), headset.get_T_world_tracking(10 * MINUTE)
    assert distance(start[0], later[0]) == pytest.approx(0.010)
    assert quat_angle(start[1], later[1]) == pytest.approx(math.radians(0.2))
    tilts = []
    for seed in range(200):
        up = quat_rotate(EmulatedHeadset(HeadsetModel(), seed).get_T_world_tracking(0)[1], (0.0, 0.0, 1.0))
        tilts.append(math.acos(min(1.0, up[2])))
    assert np.sqrt(np.mean(np.square(tilts))) == pytest.approx(math.radians(0.2) * math.sqrt(2.0), rel=0.15)


@pytest.mark.parametrize("yaw", [0.0, 0.1])
def test_bump_moves_the_frame_about_the_head_and_keeps_the_epoch(yaw: float) -> None:
    headset, head = EmulatedHeadset(HeadsetModel(drift_m_per_min=0.06), seed=6), above(0.5)
    before = headset.get_T_world_tracking(MINUTE)
    tracked = compose(inverse(before), SHEET)
    T_new_old = headset.bump_frame((0.05, 0.0, 0.0), yaw, head[0], MINUTE)
    after = headset.get_T_world_tracking(MINUTE)
    assert headset.tracking_epoch == 0
    now_at = compose(inverse(after), SHEET)
    expected = compose(T_new_old, tracked)
    assert distance(now_at[0], expected[0]) < 1e-9
    assert quat_angle(now_at[1], expected[1]) < 1e-7
    at_head = apply(after, apply(inverse(before), head[0]))
    assert at_head == pytest.approx((head[0][0] + 0.05, head[0][1], head[0][2]))
    assert quat_angle(before[1], after[1]) == pytest.approx(yaw, abs=1e-7)
    later = headset.get_T_world_tracking(2 * MINUTE)
    assert distance(after[0], later[0]) == pytest.approx(0.06), "it drifts on from there"


def test_samples_have_the_configured_rate_and_missed_ones_are_counted() -> None:
    headset = EmulatedHeadset(HeadsetModel(rate_hz=90.0), seed=8)
    assert sum(headset.is_sample_due(t) for t in range(0, 10 * SECOND, SECOND // 1000)) == pytest.approx(900, abs=1)
    assert headset.late_samples == 0
    assert headset.is_sample_due(11 * SECOND)
    assert headset.late_samples == pytest.approx(89, abs=1)


def test_stalls_delay_all_messages_and_release_them_together() -> None:
    model = LinkModel(latency_s=0.001, jitter_s=0.0, stall_every_s=0.5, stall_s=0.1)
    line: DelayLine[int] = DelayLine(model, np.random.default_rng(1))
    bursts = []
    for now in range(0, 20 * SECOND, SECOND // 1000):
        if now % (SECOND // 100) == 0:
            line.push(now, now)
        bursts.append(len(line.pop(now)))
    assert line.stalls > 10
    assert max(bursts) == pytest.approx(10, abs=2)
    assert line.next_arrival_ns is None or line.next_arrival_ns >= 20 * SECOND - SECOND // 5
    assert len(line) <= 12
