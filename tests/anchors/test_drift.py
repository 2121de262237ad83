"""The watch over an alignment in force: 10 mm within 2 s, jumps at once, and quiet when nothing happens."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchors.alignment import AlignmentEstimate, AlignmentEstimator
from anchors.drift import Alarm, DriftConfig, DriftMonitor
from anchors.pose import PoseTuple, Vec3, quat_from_rotvec, quat_from_yaw
from tests.anchors.worlds import Look, around, headset, shifted

SHEET: PoseTuple = ((0.2, -0.4, 0.75), quat_from_yaw(0.5))
OTHER: PoseTuple = ((1.2, 0.4, 0.75), quat_from_yaw(-2.0))
ANCHORS = {"sheet": SHEET, "other": OTHER}
PERIOD = 100_000_000


def _estimate(rng: np.random.Generator, T_world_tracking: PoseTuple) -> AlignmentEstimate:
    estimator = AlignmentEstimator({"sheet": SHEET})
    for viewpoint in range(3):
        look = Look(rng, SHEET, around(rng, SHEET[0], rng.uniform(0.4, 1.0)))
        for _ in range(20):
            head = look.head(T_world_tracking)
            estimator.add("sheet", look.new(T_world_tracking), 0, 0, viewpoint, p_tracking_head=head)
    return estimator.estimate()


def _watch(
    monitor: DriftMonitor,
    look: Look,
    T_world_tracking: PoseTuple,
    frames: range,
    alignment: AlignmentEstimate | None = None,
    wrong: np.random.Generator | None = None,
    viewpoint: int = 0,
) -> list[Alarm]:
    """Detections at 10 Hz, one in twenty of them wrong where `wrong` is given; the alarms raised meanwhile."""
    alarms = []
    for i in frames:
        p = look.new(T_world_tracking)[0]
        if wrong is not None and wrong.random() < 0.05:
            p = (p[0] + wrong.normal(0.0, 0.25), p[1] + wrong.normal(0.0, 0.25), p[2])
        alarm = monitor.add_observation("sheet", p, look.head(T_world_tracking), i * PERIOD, 0, viewpoint, alignment)
        if alarm is not None:
            alarms.append(alarm)
    return alarms


@pytest.mark.parametrize("seed", range(12))
def test_a_change_of_10_mm_seen_from_70_cm_is_told_within_2_s(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_world_tracking = headset(rng)
    look = Look(rng, SHEET, around(rng, SHEET[0], 0.7))
    monitor = DriftMonitor(ANCHORS)
    assert _watch(monitor, look, T_world_tracking, range(40), wrong=rng) == []
    way = rng.normal(size=3)
    x, y, z = (0.010 * way / np.linalg.norm(way)).tolist()
    alarms = _watch(monitor, look, shifted(T_world_tracking, (x, y, z)), range(40, 80), wrong=rng)
    assert alarms[0].kind == "changed"
    assert alarms[0].capture_ns <= (40 + 20) * PERIOD
    assert alarms[0].size_m == pytest.approx(0.010, abs=0.005)
    assert len(alarms) == 1, "it is told once"


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_told_while_the_frame_drifts_slowly_and_the_head_moves_about(seed: int) -> None:
    """One minute, 3 mm/min, a new viewpoint every 4 s, wrong detections."""
    rng = np.random.default_rng(100 + seed)
    T_world_tracking = headset(rng)
    alignment = _estimate(rng, T_world_tracking)
    monitor, alarms = DriftMonitor(ANCHORS), []
    for viewpoint in range(15):
        look = Look(rng, SHEET, around(rng, SHEET[0], rng.uniform(0.4, 1.2)))
        now = shifted(T_world_tracking, (0.0002 * viewpoint, 0.0, 0.0))
        frames = range(40 * viewpoint, 40 * viewpoint + 40)
        alarms += _watch(monitor, look, now, frames, alignment, rng, viewpoint)
    assert alarms == []


def test_a_change_while_the_sheet_was_out_of_sight_is_told_from_the_alignment() -> None:
    rng = np.random.default_rng(3)
    T_world_tracking = headset(rng)
    alignment = _estimate(rng, T_world_tracking)
    monitor = DriftMonitor(ANCHORS)
    look = Look(rng, SHEET, around(rng, SHEET[0], 0.5))
    alarms = _watch(monitor, look, shifted(T_world_tracking, (0.03, 0.0, 0.0)), range(20), alignment)
    assert [a.kind for a in alarms] == ["differs"]
    assert alarms[0].size_m == pytest.approx(0.03, abs=0.01)
    assert not alarms[0].invalidates


def test_a_jump_invalidates_after_three_detections_and_one_wrong_detection_does_not() -> None:
    rng = np.random.default_rng(4)
    T_world_tracking = headset(rng)
    look, monitor = Look(rng, SHEET, around(rng, SHEET[0], 0.7)), DriftMonitor(ANCHORS)
    assert _watch(monitor, look, T_world_tracking, range(30)) == []
    far = shifted(T_world_tracking, (0.0, 0.3, 0.0))
    assert _watch(monitor, look, far, range(30, 32)) == []
    assert _watch(monitor, look, T_world_tracking, range(32, 45)) == []
    alarms = _watch(monitor, look, far, range(45, 48))
    assert [a.kind for a in alarms] == ["jump"]
    assert alarms[0].invalidates
    assert alarms[0].size_m == pytest.approx(0.3, abs=0.02)


def test_the_sheet_that_was_moved_is_told_from_the_others_that_stayed() -> None:
    rng = np.random.default_rng(5)
    T_world_tracking = headset(rng)
    looks = {name: Look(rng, T, around(rng, T[0], 0.6)) for name, T in ANCHORS.items()}
    monitor, alarms = DriftMonitor(ANCHORS), []
    for i in range(60):
        for name, look in looks.items():
            place = shifted(SHEET, (0.02, 0.0, 0.0)) if name == "sheet" and i >= 30 else None
            p = look.new(T_world_tracking, place)[0]
            alarm = monitor.add_observation(name, p, look.head(T_world_tracking), i * PERIOD, 0)
            alarms += [alarm] if alarm is not None else []
    assert [(a.anchor_id, a.beside) for a in alarms] == [("sheet", ("other",))]


def test_a_new_tracking_epoch_is_a_jump_and_starts_anew() -> None:
    monitor = DriftMonitor(ANCHORS)
    zero: Vec3 = (0.0, 0.0, 0.0)
    alarm = monitor.add_observation("sheet", (0.0, 0.0, 1.0), zero, 0, 1)
    assert alarm is not None
    assert (alarm.kind, alarm.invalidates) == ("epoch", True)
    assert monitor.add_observation("sheet", (0.0, 0.0, 1.0), zero, 1, 1) is None
    assert monitor.add_observation("sheet", (0.0, 0.0, 1.0), zero, 2, 0) is None, "what is older is of no use"
    assert monitor.add_head_pose((zero, (1.0, 0.0, 0.0, 0.0)), 3, 2) is not None


def test_a_head_faster_than_people_is_a_jump() -> None:
    monitor = DriftMonitor(ANCHORS)
    pose: PoseTuple = ((0.0, 0.0, 1.6), (1.0, 0.0, 0.0, 0.0))
    turned: PoseTuple = (pose[0], quat_from_rotvec((0.0, 0.0, 1.0)))
    assert monitor.add_head_pose(pose, 0, 0) is None
    assert monitor.add_head_pose(shifted(pose, (0.03, 0.0, 0.0)), 14_000_000, 0) is None
    alarm = monitor.add_head_pose(shifted(pose, (0.5, 0.0, 0.0)), 28_000_000, 0)
    assert alarm is not None
    assert alarm.kind == "jump"
    assert monitor.add_head_pose(pose, 42_000_000, 0) is None, "after a jump a new count begins"
    assert monitor.add_head_pose(turned, 56_000_000, 0) is not None
    assert monitor.add_head_pose(pose, 2_000_000_000, 0) is None, "after a pause anything may have happened"


def test_hostile_numbers_and_unknown_anchors_say_nothing_and_memory_is_bounded() -> None:
    monitor = DriftMonitor(ANCHORS, config=DriftConfig(max_detections=50))
    zero: Vec3 = (0.0, 0.0, 0.0)
    assert monitor.add_observation("sheet", (math.nan, 0.0, 0.0), zero, 0, 0) is None
    assert monitor.add_observation("nobody", zero, zero, 0, 0) is None
    for i in range(200):
        monitor.add_observation("sheet", (0.0, 0.0, 1.0), zero, 5, 0)
        monitor.add_observation("sheet", (0.0, 0.0, 1.0), zero, 5 - i, 0)
    assert len(monitor._detections["sheet"]) <= 50


def test_heads_of_a_void_frame_and_heads_that_are_no_pose_are_no_jump() -> None:
    monitor = DriftMonitor(ANCHORS)
    place: PoseTuple = ((0.0, 0.0, 1.6), (1.0, 0.0, 0.0, 0.0))
    assert monitor.add_head_pose(place, 0, 0) is None
    moved = monitor.add_head_pose(shifted(place, (2.0, 0.0, 0.0)), PERIOD, 1)
    assert moved is not None
    assert moved.kind == "epoch"
    assert monitor.add_head_pose(shifted(place, (2.0, 0.0, 0.0)), 2 * PERIOD, 1) is None
    assert monitor.add_head_pose(place, 2 * PERIOD + 1, 0) is None, "late, of the frame before"
    assert monitor.add_head_pose(((math.nan, 0.0, 0.0), place[1]), 2 * PERIOD + 2, 1) is None
    jumped = monitor.add_head_pose(shifted(place, (4.0, 0.0, 0.0)), 3 * PERIOD, 1)
    assert jumped is not None
    assert jumped.kind == "jump"


def test_a_clock_that_was_set_back_after_an_alarm_does_not_silence_the_next_one() -> None:
    rng = np.random.default_rng(1)
    T = headset(rng)
    look = Look(rng, SHEET, around(rng, SHEET[0], 0.7))
    monitor = DriftMonitor(ANCHORS)
    late = 36_000
    assert _watch(monitor, look, T, range(late, late + 40)) == []
    assert _watch(monitor, look, shifted(T, (0.03, 0.0, 0.0)), range(late + 40, late + 60))
    assert _watch(monitor, look, shifted(T, (0.03, 0.0, 0.0)), range(40)) == []
    assert _watch(monitor, look, T, range(40, 60))


def _watch_both(
    monitor: DriftMonitor, rng: np.random.Generator, frame: PoseTuple, bump: Vec3 = (0.0, 0.0, 0.0), moved: float = 0.0
) -> list[tuple[int, Alarm]]:
    """Both sheets at 10 Hz, one after the other; from the 30th look on the frame is bumped, or a sheet moved."""
    looks, alarms = {name: Look(rng, T, around(rng, T[0], 0.6)) for name, T in ANCHORS.items()}, []
    for i in range(60):
        now = shifted(frame, bump) if i >= 30 else frame
        for k, (name, look) in enumerate(looks.items()):
            place = shifted(SHEET, (moved, 0.0, 0.0)) if name == "sheet" and i >= 30 else None
            p = look.new(now, place)[0]
            alarm = monitor.add_observation(name, p, look.head(now), i * PERIOD + k * PERIOD // 2, 0)
            alarms += [(i, alarm)] if alarm is not None else []
    return alarms


@pytest.mark.parametrize("seed", range(5))
def test_a_bump_of_5_cm_is_a_jump_at_the_third_look(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frame = headset(rng)
    look, monitor = Look(rng, SHEET, around(rng, SHEET[0], 0.7)), DriftMonitor(ANCHORS)
    assert _watch(monitor, look, frame, range(30)) == []
    way = rng.normal(size=3)
    x, y, z = (0.05 * way / np.linalg.norm(way)).tolist()
    assert _watch(monitor, look, shifted(frame, (x, y, z)), range(30, 32)) == []
    (alarm,) = _watch(monitor, look, shifted(frame, (x, y, z)), range(32, 33))
    assert (alarm.kind, alarm.capture_ns) == ("jump", 30 * PERIOD), "the first that was of the new frame"


@pytest.mark.parametrize("seed", range(5))
def test_a_sheet_that_was_carried_away_is_no_jump_of_the_headset(seed: int) -> None:
    rng = np.random.default_rng(seed)
    alarms = _watch_both(DriftMonitor(ANCHORS), rng, headset(rng), moved=0.3)
    assert [(a.kind, a.anchor_id, a.beside) for _, a in alarms] == [("changed", "sheet", ("other",))]


@pytest.mark.parametrize("seed", range(5))
def test_a_bump_in_sight_of_two_sheets_is_no_moved_sheet(seed: int) -> None:
    rng = np.random.default_rng(seed)
    jump, *_ = _watch_both(DriftMonitor(ANCHORS), rng, headset(rng), bump=(0.03, 0.03, 0.03))
    assert (jump[0] <= 32, jump[1].kind) == (True, "jump")
    rng = np.random.default_rng(seed)
    alarms = _watch_both(DriftMonitor(ANCHORS), rng, headset(rng), bump=(0.012, 0.0, 0.0))
    assert {(a.kind, a.beside) for _, a in alarms} == {("changed", ())}


def test_without_a_head_changes_must_be_larger_to_be_told() -> None:
    rng = np.random.default_rng(2)
    frame, monitor = headset(rng), DriftMonitor(ANCHORS)
    look, alarms = Look(rng, SHEET, around(rng, SHEET[0], 0.6)), []
    for i in range(80):
        p = look.new(shifted(frame, (0.025 if i >= 40 else 0.0, 0.0, 0.0)))[0]
        alarm = monitor.add_observation("sheet", p, None, i * PERIOD, 0)
        alarms += [alarm] if alarm is not None else []
    assert [a.kind for a in alarms] == ["changed"]
