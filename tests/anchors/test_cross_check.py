"""Cross-check of two headsets on one sheet or one controller: the measured difference."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from anchors.alignment import AlignmentEstimator
from anchors.cross_check import CrossCheck, CrossCheckConfig
from anchors.pose import PoseTuple, apply, compose, inverse, quat_from_yaw
from anchors.uncertainty import length_p95
from tests.anchors.worlds import Viewpoint, align_to_sheet, tracking_frame, viewpoint_around

SHEET: PoseTuple = ((0.2, -0.4, 0.75), quat_from_yaw(0.5))
PERIOD = 100_000_000


def _observe(
    check: CrossCheck, name: str, view: Viewpoint, T: PoseTuple, n: int = 20, epoch: int = 0, start: int = 1
) -> None:
    for i in range(start, start + n):
        check.add_observation(name, "sheet", view.observe(T), view.head_pose(T), i * PERIOD, epoch)


def test_aligned_headsets_differ_within_expectation() -> None:
    sizes, expected = [], []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        check, alignments = CrossCheck(), {}
        for name in "ab":
            T = tracking_frame(rng)
            alignments[name] = align_to_sheet(rng, SHEET, T)
            _observe(check, name, Viewpoint(rng, SHEET, viewpoint_around(rng, SHEET[0], 0.6)), T)
        (got,) = check.compare(alignments, 30 * PERIOD)
        assert (got.a, got.b, got.target, got.n) == ("a", "b", "sheet", 20)
        assert got.error_m <= 2.0 * got.expected_p95_m
        assert got.error_rad < math.radians(3.0)
        assert math.dist(got.p_world, SHEET[0]) < 0.01
        sizes.append(got.error_m)
        expected.append(got.expected_p95_m)
    assert sum(s <= e for s, e in zip(sizes, expected, strict=True)) >= 21


def test_moving_controller_is_compared_at_equal_times() -> None:
    rng = np.random.default_rng(2)
    frames = {name: tracking_frame(rng) for name in "ab"}
    exact = {name: replace(align_to_sheet(rng, SHEET, T), T_world_tracking=T) for name, T in frames.items()}
    check = CrossCheck(config=CrossCheckConfig(max_gap_ns=30_000_000))
    for i in range(200):
        name = "ab"[i % 2]  # 72 Hz each, never at the same time; 1 m/s
        at: PoseTuple = ((i * 0.00694, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
        pose = compose(inverse(frames[name]), at)
        check.add_observation(name, "controller", pose, (0.0, 0.0, 0.0), i * 6_940_000, 0)
    (got,) = check.compare(exact, 200 * 6_940_000, moving=frozenset({"controller"}))
    assert got.error_m < 1e-6
    assert check.compare(exact, 200 * 6_940_000 + 61 * 10**9, moving=frozenset({"controller"})) == []


def test_recentred_failed_or_stale_headset_is_not_compared() -> None:
    rng = np.random.default_rng(3)
    T = tracking_frame(rng)
    good = align_to_sheet(rng, SHEET, T)
    check = CrossCheck()
    view = Viewpoint(rng, SHEET, viewpoint_around(rng, SHEET[0], 0.6))
    _observe(check, "a", view, T)
    _observe(check, "b", view, T)
    refused = AlignmentEstimator({}).estimate()
    assert len(check.compare({"a": good, "b": good}, 30 * PERIOD)) == 1
    assert check.compare({"a": good, "b": refused}, 30 * PERIOD) == []
    assert check.compare({"a": good, "b": good}, 700 * 10**9) == [], "too long ago"
    _observe(check, "b", view, T, epoch=1, start=40)
    assert check.compare({"a": good, "b": good}, 60 * PERIOD) == [], "its alignment is of another tracking frame"
    check.discard_headset("a")
    assert check.compare({"a": good}, 60 * PERIOD) == []


def test_memory_is_bounded_and_unusable_input_is_refused() -> None:
    check = CrossCheck(config=CrossCheckConfig(max_targets=2, max_observations=10))
    pose, zero = SHEET, (0.0, 0.0, 0.0)
    used = [check.add_observation("a", f"thing{i}", pose, zero, i, 0) for i in range(100)]
    assert used == [True, True] + [False] * 98
    assert not check.add_observation("a", "thing0", ((math.nan, 0.0, 0.0), pose[1]), zero, 1000, 0)
    assert check.add_observation("a", "thing0", pose, zero, 6, 1), "a new tracking frame begins empty"
    assert not check.add_observation("a", "thing0", pose, zero, 5, 1), "out of order"
    assert not check.add_observation("a", "thing0", pose, zero, 7, 0), "of an older tracking frame"


def test_anchors_out_of_sight_are_removed() -> None:
    check = CrossCheck(config=CrossCheckConfig(max_targets=2, max_age_ns=10 * PERIOD))
    used = [check.add_observation("h", thing, SHEET, (0.0, 0.0, 1.0), i, 0) for i, thing in enumerate("abcd")]
    assert used == [True, True, False, False]
    assert check.add_observation("h", "c", SHEET, (0.0, 0.0, 1.0), 20 * PERIOD, 0)


def test_a_point_that_both_touch_measures_how_far_apart_their_worlds_are() -> None:
    rng = np.random.default_rng(0)
    check, alignments = CrossCheck(config=CrossCheckConfig(max_points=2)), {}
    point = (1.2, 0.1, 0.7)
    for i, name in enumerate("ab"):
        T = tracking_frame(rng)
        p, q = inverse(T)
        alignments[name] = replace(align_to_sheet(rng, SHEET, T), T_world_tracking=((p[0] + 0.02 * i, p[1], p[2]), q))
        assert check.add_point(name, "cross", apply(T, point), 0.0015, PERIOD, 0)
        assert not check.add_point(name, "cross", (math.nan, 0.0, 0.0), 0.0015, 2 * PERIOD, 0)
    (got,) = check.compare_points(alignments, 2 * PERIOD)
    assert (got.a, got.b, got.target) == ("a", "b", "cross")
    assert abs(got.error_m - 0.02) < 1e-9
    assert math.dist(got.p_world, (1.21, 0.1, 0.7)) < 1e-9
    own = [alignments[name].covariance_at(got.p_world) for name in "ab"]
    assert got.expected_p95_m > length_p95(own[0] + own[1])
    assert check.copy_headsets("ab").compare_points(alignments, 2 * PERIOD) == [got]
    assert check.compare_points(alignments, 62 * 10**9) == [], "too long ago"
    assert check.compare_points(alignments, 2 * PERIOD, since_ns=PERIOD) == [], "no news"
    for name in ("x", "y"):
        check.add_point("a", name, point, 0.0015, 2 * PERIOD, 0)
    assert check.compare_points(alignments, 2 * PERIOD) == [], "the oldest point is forgotten"
    check.add_point("b", "x", point, 0.0015, 3 * PERIOD, 1)
    assert check.compare_points(alignments, 3 * PERIOD) == [], "its alignment is of another tracking frame"
