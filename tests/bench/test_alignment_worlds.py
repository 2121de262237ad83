"""Worlds of `bench alignment`: simulated headsets are exact where nothing is wrong with them, constant errors have the
stated effect, and what the real service and authority do in a room is counted as stated."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from anchors.pose import Vec3, compose, distance, quat_angle
from iris_session.bench.alignment_room import ProbeResult, Room
from iris_session.bench.alignment_sources import ONE, HeadsetMotion, SheetSource, to_array_pose
from iris_session.bench.alignment_worlds import WORLDS, RoomResult, select_worlds, summarize, survey
from iris_session.bench.report import BenchError
from iris_session.emulator.sheet_noise import SheetNoise

EXACT = SheetSource(noise=SheetNoise(along_m=0.0, along_m_per_m2=0.0, turn_rad=0.0, scale=0.0, wrong_share=0.0))
SHEET = ((0.5, -0.2, 0.7), (math.cos(0.3), 0.0, 0.0, math.sin(0.3)))


def see(source: SheetSource, print_scale: float = 0.0, **how: float) -> list[tuple[float, float, float]]:
    """Errors of one look: position [m], along the line of sight away from the head [m], rotation [rad]."""
    motion = HeadsetMotion(np.random.default_rng(3), source)
    look = motion.look("a", to_array_pose(SHEET), 5.0, 2.0, head_hz=10.0, print_scale=print_scale, **how)
    out = []
    for t, T in zip(look.seen_s, look.poses, strict=True):
        frame = motion.T_world_tracking(t)
        world = compose((as_vec(frame[0]), tuple(frame[1].tolist())), T)
        k = min(range(len(look.head_s)), key=lambda i: abs(look.head_s[i] - t))
        head = compose((as_vec(frame[0]), tuple(frame[1].tolist())), look.heads[k])[0]
        away = distance(world[0], head) - distance(SHEET[0], head)
        out.append((distance(world[0], SHEET[0]), away, quat_angle(world[1], SHEET[1])))
    return out


def as_vec(v: np.ndarray) -> Vec3:
    return float(v[0]), float(v[1]), float(v[2])


def test_source_without_errors_reports_the_sheet_where_it_is() -> None:
    for far, _, turned in see(EXACT):
        assert far < 0.003  # the head's own pose is noisy
        assert turned < 1e-6


def test_constant_errors_have_their_stated_effect() -> None:
    """A print that is 2 % too large looks 2 % nearer; a late picture turns the sheet as the head goes round it."""
    near = np.mean([away for _, away, _ in see(EXACT, print_scale=0.02)])
    assert -0.026 < near < -0.006
    late = replace(EXACT, late_s=(0.05, 0.05))
    walking, standing = (np.mean([turned for *_, turned in see(late, walk_m_per_s=v)]) for v in (0.5, 0.0))
    assert walking > 0.02 > 2.0 * standing > 0.0
    assert np.mean([turned for *_, turned in see(replace(EXACT, corner_px=0.5))]) > math.radians(0.1)


def test_smoothed_and_repeated_poses() -> None:
    smooth = HeadsetMotion(np.random.default_rng(3), SheetSource(hz=2.0, repeats=3, weight=0.2))
    poses = smooth.look("a", to_array_pose(SHEET), 5.0, 3.0, head_hz=1.0).poses
    assert [len(set(poses[k : k + 3])) for k in range(0, 18, 3)] == [1] * 6
    assert len(set(poses)) == 6


def test_wearers_of_a_plain_source_are_aligned_and_move_robots() -> None:
    room = Room(np.random.default_rng(1), ONE, SheetSource(), drift_m_per_min=0.003, marks={})
    room.probe()
    assert [f.is_allowed for _, f in room.findings] == [False] * 3, "nobody is aligned yet"
    survey()(room)
    room.probe("then")
    for _, found in room.findings[3:]:
        assert found.is_allowed
        assert not found.is_told
        assert len(found.errors) == 3
        assert found.ratio < 2.0


def test_who_is_told_of_a_jump_is_counted_and_does_not_drive() -> None:
    room = WORLDS["W3"][0].run(np.random.default_rng(2))
    first = [f for label, f in room.findings if not label]
    assert all(f.is_told for f in first)
    assert [p.false_alarms for p in room.people] == [0, 0]


def test_figures_of_a_world() -> None:
    right = ProbeResult((1, 2), True, False, (0.001, 0.002, 0.004), (0.002, 0.004, 0.003))
    wrong = ProbeResult((1,), True, False, (0.03, 0.0, 0.0), (0.009, 1.0, 1.0))
    held = ProbeResult((2,), False, True, (0.03, 0.0, 0.0), (0.009, 1.0, 1.0))
    got = summarize([RoomResult("v", [("", right), ("", wrong), ("", held), ("after", right)], [2, 0], 0.5)])
    assert got["wrong_and_confident_share"] == got["v_wrong_and_confident_share"] == pytest.approx(1 / 3, abs=1e-3)
    assert got["coverage_share"] == pytest.approx(2 / 3, abs=1e-3)
    assert got["told_share"] == pytest.approx(1 / 3, abs=1e-3)
    assert got["after_wrong_and_confident_share"] == 0.0
    assert (got["sheet_mm_p95"], got["stated_at_1m_mm_p50"]) == (1.0, 4.0)
    assert (got["false_alarm_share"], got["false_alarms_per_hour"]) == (0.5, 4.0)


def test_worlds_are_selected_by_name() -> None:
    assert select_worlds("none") == ()
    assert set(select_worlds("all")) == set(WORLDS) >= {f"W{n}" for n in range(1, 13)}
    assert select_worlds("W3,mixes,W3")[:2] == ("W3", "lab_own_detector")
    with pytest.raises(BenchError, match="W99"):
        select_worlds("W99")
