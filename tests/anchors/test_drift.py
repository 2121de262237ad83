"""Drift monitor of an alignment in force: 10 mm within 2 s, jumps at once, no false alarms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchors.alignment import AlignmentEstimate
from anchors.drift import Alarm, DriftConfig, DriftMonitor
from anchors.looks import Look
from anchors.pose import PoseTuple, Vec3, compose, interpolate_about_pivot, inverse, quat_from_rotvec, quat_from_yaw
from tests.anchors.worlds import Viewpoint, align_to_sheet, shifted, tracking_frame, viewpoint_around

SHEET: PoseTuple = ((0.2, -0.4, 0.75), quat_from_yaw(0.5))
OTHER: PoseTuple = ((1.2, 0.4, 0.75), quat_from_yaw(-2.0))
ANCHORS = {"sheet": SHEET, "other": OTHER}
ONE: PoseTuple = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
AT_ZERO = Look(0, (0.0, 0.0, 0.0))
PERIOD = 100_000_000


def _monitor(
    monitor: DriftMonitor,
    view: Viewpoint,
    T_world_tracking: PoseTuple,
    frames: range,
    alignment: AlignmentEstimate | None = None,
    wrong: np.random.Generator | None = None,
    viewpoint: int = 0,
) -> list[Alarm]:
    """Return the alarms raised by detections at 10 Hz; with `wrong` one in twenty of them is wrong."""
    alarms = []
    for i in frames:
        p, q = view.observe(T_world_tracking)
        if wrong is not None and wrong.random() < 0.05:
            p = (p[0] + wrong.normal(0.0, 0.25), p[1] + wrong.normal(0.0, 0.25), p[2])
        alarm = monitor.add_observation(
            "sheet", (p, q), Look(viewpoint, view.head_pose(T_world_tracking)), i * PERIOD, 0, alignment
        )
        if alarm is not None:
            alarms.append(alarm)
    return alarms


@pytest.mark.parametrize("seed", range(6))
def test_change_of_10_mm_at_70_cm_raises_an_alarm_within_2_s(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_world_tracking = tracking_frame(rng)
    view = Viewpoint(rng, SHEET, viewpoint_around(rng, SHEET[0], 0.7))
    monitor = DriftMonitor(ANCHORS)
    assert _monitor(monitor, view, T_world_tracking, range(40), wrong=rng) == []
    way = rng.normal(size=3)
    x, y, z = (0.010 * way / np.linalg.norm(way)).tolist()
    alarms = _monitor(monitor, view, shifted(T_world_tracking, (x, y, z)), range(40, 80), wrong=rng)
    assert alarms[0].kind == "changed"
    assert alarms[0].capture_ns <= (40 + 20) * PERIOD
    assert alarms[0].size_m == pytest.approx(0.010, abs=0.005)
    assert len(alarms) == 1, "reported once"


@pytest.mark.parametrize("seed", range(3))
def test_slow_drift_and_head_motion_raise_no_alarm(seed: int) -> None:
    """One minute, 3 mm/min, a new viewpoint every 4 s, wrong detections."""
    rng = np.random.default_rng(100 + seed)
    T_world_tracking = tracking_frame(rng)
    alignment = align_to_sheet(rng, SHEET, T_world_tracking)
    monitor, alarms = DriftMonitor(ANCHORS), []
    for viewpoint in range(15):
        view = Viewpoint(rng, SHEET, viewpoint_around(rng, SHEET[0], rng.uniform(0.4, 1.2)))
        now = shifted(T_world_tracking, (0.0002 * viewpoint, 0.0, 0.0))
        frames = range(40 * viewpoint, 40 * viewpoint + 40)
        alarms += _monitor(monitor, view, now, frames, alignment, rng, viewpoint)
    assert alarms == []


def test_change_while_the_sheet_was_out_of_sight_raises_an_alarm() -> None:
    rng = np.random.default_rng(3)
    T_world_tracking = tracking_frame(rng)
    alignment = align_to_sheet(rng, SHEET, T_world_tracking)
    monitor = DriftMonitor(ANCHORS)
    view = Viewpoint(rng, SHEET, viewpoint_around(rng, SHEET[0], 0.5))
    alarms = _monitor(monitor, view, shifted(T_world_tracking, (0.03, 0.0, 0.0)), range(20), alignment)
    assert [a.kind for a in alarms] == ["differs"]
    assert alarms[0].size_m == pytest.approx(0.03, abs=0.01)
    assert not alarms[0].invalidates


@pytest.mark.parametrize("turn_deg", [0.0, 4.0])
def test_turn_of_the_frame_about_the_sheet_differs(turn_deg: float) -> None:
    """The sheet is where it was: only its heading shows that everything 2 m away is displayed elsewhere."""
    rng = np.random.default_rng(5)
    T_world_tracking = tracking_frame(rng)
    alignment = align_to_sheet(rng, SHEET, T_world_tracking)
    about: PoseTuple = (SHEET[0], quat_from_yaw(math.radians(turn_deg)))
    turned = compose(compose(about, inverse((SHEET[0], (1.0, 0.0, 0.0, 0.0)))), T_world_tracking)
    view = Viewpoint(rng, SHEET, viewpoint_around(rng, SHEET[0], 0.5))
    alarms = _monitor(DriftMonitor(ANCHORS), view, turned, range(20), alignment)
    assert [a.kind for a in alarms] == (["differs"] if turn_deg else [])
    assert all(a.size_m == pytest.approx(math.radians(turn_deg), abs=0.02) for a in alarms)


def test_few_detections_that_disagree_raise_no_alarm() -> None:
    """A slow source: five detections, three of which are wrong, each elsewhere."""
    rng = np.random.default_rng(6)
    T_world_tracking = tracking_frame(rng)
    alignment = align_to_sheet(rng, SHEET, T_world_tracking)
    view, monitor = Viewpoint(rng, SHEET, viewpoint_around(rng, SHEET[0], 0.7)), DriftMonitor(ANCHORS)
    for i, off in enumerate((0.0, 0.2, 0.0, 0.4, 0.3)):
        (x, y, z), q = view.observe(T_world_tracking)
        look = Look(0, view.head_pose(T_world_tracking))
        assert monitor.add_observation("sheet", ((x + off, y, z), q), look, i * 10 * PERIOD, 0, alignment) is None


@pytest.mark.parametrize("weight", [0.2, 0.5])
@pytest.mark.parametrize("seed", range(2))
def test_smoothed_source_smears_a_wrong_detection_but_shows_a_change(weight: float, seed: int) -> None:
    """At 1 Hz; `weight`: of a new pose. What a wrong detection leaves goes back, a change stays."""
    rng = np.random.default_rng(seed)
    frame = tracking_frame(rng)
    alignment = align_to_sheet(rng, SHEET, frame)
    view, monitor = Viewpoint(rng, SHEET, viewpoint_around(rng, SHEET[0], 0.7)), DriftMonitor(ANCHORS)
    moved = shifted(frame, (0.03, 0.04, 0.0))
    look = Look(0, view.head_pose(frame))
    last, alarms = view.observe(frame), []
    for i in range(80):
        p, q = view.observe(moved if i >= 40 else frame)
        if i == 15:
            p = (p[0] + 0.3, p[1] - 0.3, p[2])
        last = interpolate_about_pivot(last, (p, q), (0.0, 0.0, 0.0), weight)
        alarm = monitor.add_observation("sheet", last, look, i * 10 * PERIOD, 0, alignment)
        alarms += [i] if alarm is not None else []
    assert alarms
    assert 40 <= alarms[0] <= 55


def test_jump_alarm_needs_three_detections() -> None:
    rng = np.random.default_rng(4)
    T_world_tracking = tracking_frame(rng)
    view, monitor = Viewpoint(rng, SHEET, viewpoint_around(rng, SHEET[0], 0.7)), DriftMonitor(ANCHORS)
    assert _monitor(monitor, view, T_world_tracking, range(30)) == []
    far = shifted(T_world_tracking, (0.0, 0.3, 0.0))
    assert _monitor(monitor, view, far, range(30, 32)) == []
    assert _monitor(monitor, view, T_world_tracking, range(32, 45)) == []
    alarms = _monitor(monitor, view, far, range(45, 48))
    assert [a.kind for a in alarms] == ["jump"]
    assert alarms[0].invalidates
    assert alarms[0].size_m == pytest.approx(0.3, abs=0.02)


def test_new_tracking_epoch_is_a_jump_and_restarts_monitoring() -> None:
    monitor = DriftMonitor(ANCHORS)
    zero: Vec3 = (0.0, 0.0, 0.0)
    alarm = monitor.add_observation("sheet", ONE, AT_ZERO, 0, 1)
    assert alarm is not None
    assert (alarm.kind, alarm.invalidates) == ("epoch", True)
    assert monitor.add_observation("sheet", ONE, AT_ZERO, 1, 1) is None
    assert monitor.add_observation("sheet", ONE, AT_ZERO, 2, 0) is None, "what is older is of no use"
    assert monitor.add_head_pose((zero, ONE[1]), 3, 2) is not None
    assert monitor.add_head_pose(((2.0, 0.0, 0.0), ONE[1]), 4, 1) is None, "late, of the frame before"
    assert monitor.add_head_pose(((math.nan, 0.0, 0.0), ONE[1]), 5, 2) is None
    assert monitor.add_head_pose(((4.0, 0.0, 0.0), ONE[1]), 6, 2) is not None, "a jump from the pose before"


def test_implausible_head_speed_is_a_jump() -> None:
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


def test_invalid_numbers_and_unknown_anchors_raise_no_alarm_and_memory_is_bounded() -> None:
    monitor = DriftMonitor(ANCHORS, config=DriftConfig(max_detections=50))
    assert monitor.add_observation("sheet", ((math.nan, 0.0, 0.0), ONE[1]), AT_ZERO, 0, 0) is None
    assert monitor.add_observation("nobody", ONE, AT_ZERO, 0, 0) is None
    for i in range(200):
        monitor.add_observation("sheet", ONE, AT_ZERO, 5, 0)
        monitor.add_observation("sheet", ONE, AT_ZERO, 5 - i, 0)
    assert len(monitor._detections["sheet"]) <= 50


def _monitor_two_sheets(
    monitor: DriftMonitor, rng: np.random.Generator, frame: PoseTuple, bump: Vec3 = (0.0, 0.0, 0.0), moved: float = 0.0
) -> list[tuple[int, Alarm]]:
    """Monitor both sheets at 10 Hz in alternation; at the 30th detection the frame is bumped or a sheet moved."""
    views, alarms = {name: Viewpoint(rng, T, viewpoint_around(rng, T[0], 0.6)) for name, T in ANCHORS.items()}, []
    for i in range(60):
        now = shifted(frame, bump) if i >= 30 else frame
        for k, (name, view) in enumerate(views.items()):
            place = shifted(SHEET, (moved, 0.0, 0.0)) if name == "sheet" and i >= 30 else None
            pose = view.observe(now, place)
            alarm = monitor.add_observation(name, pose, Look(0, view.head_pose(now)), i * PERIOD + k * PERIOD // 2, 0)
            alarms += [(i, alarm)] if alarm is not None else []
    return alarms


@pytest.mark.parametrize("seed", range(3))
def test_removed_sheet_is_no_jump_of_the_headset(seed: int) -> None:
    rng = np.random.default_rng(seed)
    alarms = _monitor_two_sheets(DriftMonitor(ANCHORS), rng, tracking_frame(rng), moved=0.3)
    assert [(a.kind, a.anchor_id, a.beside) for _, a in alarms] == [("changed", "sheet", ("other",))]


@pytest.mark.parametrize("seed", range(3))
def test_bump_in_sight_of_two_sheets_is_no_moved_sheet(seed: int) -> None:
    rng = np.random.default_rng(seed)
    jump, *_ = _monitor_two_sheets(DriftMonitor(ANCHORS), rng, tracking_frame(rng), bump=(0.03, 0.03, 0.03))
    assert (jump[0] <= 32, jump[1].kind) == (True, "jump")
    rng = np.random.default_rng(seed)
    alarms = _monitor_two_sheets(DriftMonitor(ANCHORS), rng, tracking_frame(rng), bump=(0.012, 0.0, 0.0))
    assert {(a.kind, a.beside) for _, a in alarms} == {("changed", ())}
