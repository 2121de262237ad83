"""The gravity-aligned estimator: exact without noise, robust, with an honest stated error and advice on failure."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchors.alignment import AlignmentConfig, AlignmentEstimator, position_error_p95
from anchors.pose import PoseTuple, apply, compose, distance, inverse, quat_angle, quat_from_rotvec, quat_from_yaw

SHEET: PoseTuple = ((0.1, -0.4, 0.02), quat_from_rotvec((0.0, 0.0, 0.3)))
WALL: PoseTuple = ((1.2, 0.5, 0.8), quat_from_rotvec((math.pi / 2, 0.0, 0.0)))


def _noisy(rng: np.random.Generator, pose: PoseTuple, sigma_m: float, sigma_rad: float) -> PoseTuple:
    dp = rng.normal(0.0, sigma_m, 3)
    dr = rng.normal(0.0, sigma_rad, 3)
    q = compose(((0.0, 0.0, 0.0), quat_from_rotvec((dr[0], dr[1], dr[2]))), ((0.0, 0.0, 0.0), pose[1]))[1]
    return ((pose[0][0] + dp[0], pose[0][1] + dp[1], pose[0][2] + dp[2]), q)


@pytest.mark.parametrize("yaw", [-3.1, -1.0, 0.0, 2.0, math.pi])
def test_exact_without_noise(yaw: float) -> None:
    T_world_tracking: PoseTuple = ((3.0, -2.0, 0.1), quat_from_yaw(yaw))
    estimator = AlignmentEstimator({"sheet": SHEET, "wall": WALL})
    for i in range(10):
        anchor_id, T_world_anchor = ("sheet", SHEET) if i % 2 else ("wall", WALL)
        assert estimator.add(anchor_id, compose(inverse(T_world_tracking), T_world_anchor), i, 0, viewpoint_id=i // 5)
    got = estimator.estimate()
    assert not got.refused
    assert distance(got.T_world_tracking[0], T_world_tracking[0]) < 1e-9
    assert quat_angle(got.T_world_tracking[1], T_world_tracking[1]) < 1e-9
    assert got.residual_tilt_rad < 1e-7


def test_mirrored_and_wrong_detections_are_excluded() -> None:
    rng = np.random.default_rng(4)
    T_world_tracking: PoseTuple = ((1.0, 0.5, -0.2), quat_from_yaw(1.1))
    estimator = AlignmentEstimator({"sheet": SHEET})
    true = compose(inverse(T_world_tracking), SHEET)
    for i in range(60):
        seen = _noisy(rng, true, 0.003, math.radians(0.5))
        if i % 10 == 3:
            seen = compose(seen, ((0.0, 0.0, 0.0), quat_from_rotvec((math.pi, 0.0, 0.4))))
        if i % 10 == 7:
            seen = ((seen[0][0] + 0.4, seen[0][1], seen[0][2]), seen[1])
        estimator.add("sheet", seen, i, 0, viewpoint_id=i // 20)
    got = estimator.estimate()
    assert not got.refused
    at_sheet = distance(apply(got.T_world_tracking, true[0]), SHEET[0])
    assert at_sheet < 0.004
    assert quat_angle(got.T_world_tracking[1], T_world_tracking[1]) < math.radians(0.6)


def test_bad_observations_are_counted_and_not_used() -> None:
    estimator = AlignmentEstimator({"sheet": SHEET})
    assert not estimator.add("nobody", SHEET, 0, 0)
    assert not estimator.add("sheet", ((math.nan, 0.0, 0.0), SHEET[1]), 0, 0)
    assert not estimator.add("sheet", (SHEET[0], (0.0, 0.0, 0.0, 0.0)), 0, 0)
    assert not estimator.add("sheet", (SHEET[0], (2.0, 0.0, 0.0, 0.0)), 0, 0)
    assert (estimator.unknown_anchors, estimator.invalid) == (1, 3)


def test_new_tracking_epoch_restarts_and_old_epochs_are_ignored() -> None:
    estimator = AlignmentEstimator({"sheet": SHEET})
    for i in range(10):
        estimator.add("sheet", SHEET, i, 1)
    assert not estimator.estimate().refused
    assert estimator.add("sheet", SHEET, 11, 2)
    assert estimator.estimate().refused
    assert not estimator.add("sheet", SHEET, 12, 1)
    assert estimator.stale_epochs == 1


def test_memory_is_bounded() -> None:
    estimator = AlignmentEstimator({"sheet": SHEET}, AlignmentConfig(max_observations=50))
    for i in range(120):
        estimator.add("sheet", SHEET, i, 0)
    assert estimator.estimate().n_observations == 50
    assert estimator.forgotten == 70


def _observe(
    estimator: AlignmentEstimator,
    T_world_tracking: PoseTuple,
    viewpoint: int,
    sigma_m: float = 0.002,
    n: int = 20,
    **more: object,
) -> None:
    """Add `n` observations of the sheet by a headset at `T_world_tracking`."""
    rng = np.random.default_rng(viewpoint)
    for i in range(n):
        seen = _noisy(rng, compose(inverse(T_world_tracking), SHEET), sigma_m, math.radians(0.2))
        fields = {"capture_ns": i, "tracking_epoch": 0, "viewpoint_id": viewpoint, **more}
        estimator.add("sheet", seen, **fields)  # type: ignore[arg-type]


def _pose_at(x: float, yaw: float = 0.4) -> PoseTuple:
    return ((x, 0.0, 0.0), quat_from_yaw(yaw))


@pytest.mark.parametrize(
    "places",
    [
        [_pose_at(0.0), _pose_at(5.0)],
        [_pose_at(0.0), _pose_at(0.0, 0.7)],
        [_pose_at(0.0), _pose_at(0.1)],
        [_pose_at(0.0), _pose_at(1.0), _pose_at(2.0)],
        [_pose_at(0.0), _pose_at(0.0), _pose_at(1.0), _pose_at(1.0)],
    ],
)
def test_contradicting_viewpoints_fail(places: list[PoseTuple]) -> None:
    estimator = AlignmentEstimator({"sheet": SHEET})
    for viewpoint, T_world_tracking in enumerate(places):
        _observe(estimator, T_world_tracking, viewpoint)
    got = estimator.estimate()
    assert got.refused
    assert got.advice.startswith("observations contradict each other: ")


def test_single_viewpoint_without_clear_majority_fails() -> None:
    """The tracking frame jumped without a new epoch: the larger group is not right for being larger."""
    estimator = AlignmentEstimator({"sheet": SHEET})
    _observe(estimator, _pose_at(0.0), 0, n=55)
    _observe(estimator, _pose_at(2.0), 0, n=45)
    assert estimator.estimate().refused
    assert estimator.estimate().advice.startswith("observations contradict each other: ")


@pytest.mark.parametrize("viewpoints", [1, 3])
def test_noise_above_the_stated_covariance_widens_the_stated_error(viewpoints: int) -> None:
    """Independent scatter of four times the stated covariance: coverage stays."""
    stated = np.diag([1e-6] * 3 + [3e-6] * 3).ravel()
    rng, inside, tried = np.random.default_rng(3), 0, 0
    for _ in range(100):
        estimator = AlignmentEstimator({"sheet": SHEET})
        T_world_tracking = _pose_at(float(rng.normal()), float(rng.uniform(-3.0, 3.0)))
        true = compose(inverse(T_world_tracking), SHEET)
        for i in range(12 * viewpoints):
            seen = _noisy(rng, true, 0.004, 0.004)
            estimator.add("sheet", seen, i, 0, viewpoint_id=i % viewpoints, covariance=tuple(stated.tolist()))
        got = estimator.estimate()
        if not got.refused:
            tried += 1
            error = distance(apply(got.T_world_tracking, true[0]), SHEET[0])
            inside += error <= position_error_p95(got.covariance, got.pivot_world, SHEET[0])
    assert tried > 30
    assert inside >= 0.9 * tried


def test_old_observations_are_dropped() -> None:
    minute = 60 * 10**9
    estimator = AlignmentEstimator({"sheet": SHEET})
    _observe(estimator, _pose_at(0.0), 0, capture_ns=minute)
    _observe(estimator, _pose_at(0.2), 1, capture_ns=8 * minute)
    assert estimator.estimate().refused
    _observe(estimator, _pose_at(0.2), 2, capture_ns=12 * minute)
    got = estimator.estimate()
    assert not got.refused
    assert (got.n_observations, estimator.outdated) == (40, 20)
    assert distance(got.T_world_tracking[0], _pose_at(0.2)[0]) < 0.01


def test_sheet_of_another_size_than_configured_fails_with_advice() -> None:
    estimator = AlignmentEstimator({"sheet": SHEET}, sizes={"sheet": 0.2})
    _observe(estimator, _pose_at(0.0), 0, size_m=0.19)
    got = estimator.estimate()
    assert got.refused
    assert "190 mm, not 200 mm" in got.advice
    assert estimator.wrong_size == 20
    _observe(estimator, _pose_at(0.0), 0, size_m=0.204)
    assert not estimator.estimate().refused


def test_varying_measured_sheet_size_produces_a_warning() -> None:
    estimator = AlignmentEstimator({"sheet": SHEET})
    _observe(estimator, _pose_at(0.0), 0, size_m=0.2)
    _observe(estimator, _pose_at(0.0), 0, n=1, size_m=0.4)  # a single wrong measurement does not count
    assert estimator.estimate().advice == ""
    _observe(estimator, _pose_at(0.0), 0, size_m=0.19)
    got = estimator.estimate()
    assert not got.refused
    assert "different sizes" in got.advice
