"""Corrections are applied gradually, wait while a clutch is engaged, and need consent when large."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from anchors.alignment import AlignmentEstimate
from anchors.correction import CorrectionConfig, CorrectionFilter, interpolate_about_pivot
from anchors.pose import PoseTuple, Vec3, apply, distance, inverse, quat_from_rotvec, quat_from_yaw

PIVOT: Vec3 = (0.5, 2.0, 0.7)
SECOND = 1_000_000_000


def _estimate(x: float = 0.0, yaw: float = 0.3, epoch: int = 0, refused: bool = False) -> AlignmentEstimate:
    T: PoseTuple = ((x, 0.0, 0.0), quat_from_yaw(yaw))
    return AlignmentEstimate(T, epoch, (1e-6,) * 36, PIVOT, 0.004, 0.0, 60, 3, refused, "")


def test_first_estimate_applies_at_once() -> None:
    smooth = CorrectionFilter()
    assert smooth.update(_estimate(refused=True), 0) is None
    got = smooth.update(_estimate(), 1)
    assert got is not None
    assert (got.step, got.T_world_tracking) == ("first", _estimate().T_world_tracking)


def test_small_correction_is_applied_at_the_speed_limit() -> None:
    smooth = CorrectionFilter(CorrectionConfig(slide_m_per_s=0.004))
    smooth.update(_estimate(), 0)
    last, steps = 0.0, 0
    for i in range(1, 200):
        got = smooth.update(_estimate(0.008), i * SECOND // 60)
        assert got is not None
        x = got.T_world_tracking[0][0]
        assert 0.0 <= x - last <= 0.004 / 60 * 1.001
        steps += x > last
        last = x
    assert last == pytest.approx(0.008, abs=1e-9)
    assert steps == pytest.approx(120, abs=2)


def test_correction_waits_while_engaged_and_is_gradual_after_release() -> None:
    smooth = CorrectionFilter()
    smooth.update(_estimate(), 0)
    for i in range(1, 10):
        got = smooth.update(_estimate(0.009), i * SECOND, engaged=True)
        assert got is not None
        assert (got.step, got.T_world_tracking) == ("none", _estimate().T_world_tracking)
        assert got.pending_m == pytest.approx(0.009)
    got = smooth.update(_estimate(0.009), 9 * SECOND + SECOND // 60)
    assert got is not None
    assert got.step == "slide"
    assert got.T_world_tracking[0][0] < 0.0001


@pytest.mark.parametrize("estimate", [_estimate(0.05), _estimate(0.0, 0.3 + math.radians(3.0))])
def test_large_correction_waits_for_acceptance(estimate: AlignmentEstimate) -> None:
    smooth = CorrectionFilter()
    smooth.update(_estimate(), 0)
    got = smooth.update(estimate, SECOND)
    assert got is not None
    assert (got.step, got.T_world_tracking) == ("announced", _estimate().T_world_tracking)
    smooth.accept()
    got = smooth.update(estimate, 2 * SECOND)
    assert got is not None
    assert (got.step, got.T_world_tracking) == ("jump", estimate.T_world_tracking)


def test_new_tracking_epoch_clears_the_correction_and_a_failure_within_one_keeps_it() -> None:
    smooth = CorrectionFilter()
    smooth.update(_estimate(), 0)
    kept = smooth.update(_estimate(refused=True), 1)
    assert kept is not None
    assert kept.T_world_tracking == _estimate().T_world_tracking
    assert smooth.update(_estimate(refused=True, epoch=1), 2) is None
    got = smooth.update(_estimate(0.5, epoch=1), 3)
    assert got is not None
    assert got.step == "first"


def test_pivot_moves_on_a_straight_line() -> None:
    old: PoseTuple = ((0.0, 0.0, 0.0), quat_from_yaw(0.3))
    new: PoseTuple = ((0.02, -0.01, 0.0), quat_from_rotvec((0.01, 0.0, 0.33)))
    pivot = apply(inverse(new), PIVOT)
    a, b = apply(old, pivot), apply(new, pivot)
    for share in (0.0, 0.25, 0.5, 1.0):
        expected = tuple(x + share * (y - x) for x, y in zip(a, b, strict=True))
        assert (
            distance(
                apply(interpolate_about_pivot(old, new, pivot, share), pivot), (expected[0], expected[1], expected[2])
            )
            < 1e-12
        )
    assert replace(_estimate(), refused=True).error_at(PIVOT) == math.inf
