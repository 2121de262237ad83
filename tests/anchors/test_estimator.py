"""The estimator with the noise model of docs/anchors.md: gravity, mirrored poses, several sheets, drift, snapshots."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from anchors.alignment import AlignmentConfig, AlignmentEstimate, AlignmentEstimator, mirror_pose
from anchors.lie import quat_from_matrix
from anchors.pose import (
    IDENTITY_QUAT,
    PoseTuple,
    Vec3,
    apply,
    compose,
    distance,
    inverse,
    quat_angle,
    quat_from_rotvec,
    quat_from_yaw,
)
from anchors.uncertainty import length_p95, validate_covariance
from tests.anchors.worlds import Viewpoint, axis, shifted, tracking_frame, viewpoint_around

SHEET: PoseTuple = ((0.1, -0.4, 0.72), quat_from_yaw(0.3))
TRIANGLE: dict[str, PoseTuple] = {
    "a": ((0.0, 0.0, 0.7), quat_from_yaw(0.1)),
    "b": ((1.5, 0.0, 0.7), quat_from_yaw(2.0)),
    "c": ((0.75, 1.3, 0.7), quat_from_yaw(-1.0)),
}
SECOND = 1_000_000_000


def _observe(
    estimator: AlignmentEstimator,
    rng: np.random.Generator,
    T: PoseTuple,
    name: str = "sheet",
    viewpoint: int = 0,
    at_s: float = 0.0,
    place: PoseTuple | None = None,
    n: int = 20,
    noise: float = 1.0,
) -> None:
    """Add `n` observations from a new viewpoint; `place` is the true pose of the sheet."""
    anchor = place or estimator.anchors[name]
    view = Viewpoint(rng, anchor, viewpoint_around(rng, anchor[0], rng.uniform(0.4, 1.2)), noise)
    for i in range(n):
        ns = round((at_s + 0.1 * i) * SECOND)
        estimator.add(name, view.observe(T), ns, 0, viewpoint, p_tracking_head=view.head_pose(T))


def _error_at(got: AlignmentEstimate, T: PoseTuple, at: Vec3) -> float:
    return distance(apply(got.T_world_tracking, apply(inverse(T), at)), at)


def test_stated_error_covers_the_error_at_the_sheet_and_2_m_away() -> None:
    inside = {0.0: 0, 2.0: 0}
    for seed in range(100):
        rng = np.random.default_rng(seed)
        estimator, T = AlignmentEstimator({"sheet": SHEET}), tracking_frame(rng)
        for viewpoint in range(3):
            _observe(estimator, rng, T, viewpoint=viewpoint, n=8)
        got = estimator.estimate()
        for far in inside:
            at = (SHEET[0][0] + far, SHEET[0][1], SHEET[0][2])
            inside[far] += _error_at(got, T, at) <= got.error_at(at)
    assert all(0.87 <= n / 100 <= 0.99 for n in inside.values()), inside


def test_distant_sheets_measure_the_tilt_that_one_sheet_takes_from_gravity() -> None:
    """A tilt of 0.6 deg is three standard deviations of what gravity allows."""
    tilted: PoseTuple = ((1.0, 0.5, 0.2), quat_from_rotvec((math.radians(0.6), 0.0, 0.0)))
    left = {}
    for names in ("a", "abc"):
        rng = np.random.default_rng(2)
        estimator = AlignmentEstimator({name: TRIANGLE[name] for name in names})
        for viewpoint in range(9):
            _observe(estimator, rng, tilted, names[viewpoint % len(names)], viewpoint)
        got = estimator.estimate()
        up = axis(got.T_world_tracking[1], 2)
        left[names] = math.degrees(math.acos(float(np.clip(up @ axis(tilted[1], 2), -1.0, 1.0))))
        assert length_p95(np.reshape(got.covariance, (6, 6))[3:, 3:]) < math.radians(0.9)
    assert left["abc"] < 0.15
    assert left["abc"] < left["a"]


def test_six_degrees_of_freedom_on_request() -> None:
    tilted: PoseTuple = ((1.0, 0.5, 0.2), quat_from_rotvec((0.9, -0.7, 1.0)))
    estimator = AlignmentEstimator(TRIANGLE, AlignmentConfig(dof=6))
    rng = np.random.default_rng(0)
    for viewpoint, name in enumerate("abc"):
        _observe(estimator, rng, tilted, name, viewpoint, noise=0.0)
    got = estimator.estimate()
    assert distance(got.T_world_tracking[0], tilted[0]) < 1e-6
    assert quat_angle(got.T_world_tracking[1], tilted[1]) < 1e-6
    with pytest.raises(ValueError, match=r"it is 4 .* or 6"):
        AlignmentEstimator(TRIANGLE, AlignmentConfig(dof=5))


def test_mirrored_pose_is_the_second_pose_of_opencv() -> None:
    """IPPE returns both poses of a flat sheet: mirror images along the line of sight."""
    half = 0.05
    corners = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
    K = np.array([[900.0, 0.0, 640.0], [0.0, 900.0, 360.0], [0.0, 0.0, 1.0]])
    for tilt in (0.5, 0.8, 1.1):
        true = (np.array([math.pi + tilt, 0.1, 0.2]), np.array([0.1, -0.05, 1.2]))
        image, _ = cv2.projectPoints(corners, *true, K, None)
        n, turns, places, _ = cv2.solvePnPGeneric(corners, image, K, None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
        assert n == 2
        poses = []
        for r, t in zip(turns, places, strict=True):
            q = quat_from_matrix(cv2.Rodrigues(r)[0]).tolist()
            p = t.ravel().tolist()
            poses.append(((p[0], p[1], p[2]), (q[0], q[1], q[2], q[3])))
        other = mirror_pose(poses[0], (0.0, 0.0, 0.0))
        # Finite distance changes the result by a few degrees.
        assert quat_angle(other[1], poses[1][1]) < math.radians(6.0)
        assert quat_angle(poses[0][1], poses[1][1]) > math.radians(40.0)
        assert quat_angle(mirror_pose(other, (0.0, 0.0, 0.0))[1], poses[0][1]) < 1e-6


@pytest.mark.parametrize("evidence", ["head", "alternative", "nothing"])
def test_mirrored_viewpoint_is_corrected(evidence: str) -> None:
    rng = np.random.default_rng(8)
    T = tracking_frame(rng)
    estimator = AlignmentEstimator({"sheet": SHEET})
    view = Viewpoint(rng, SHEET, viewpoint_around(rng, SHEET[0], 0.6))
    for i in range(20):
        good, head = view.observe(T), view.head_pose(T)
        seen = mirror_pose(good, head)
        used = estimator.add(
            "sheet",
            seen,
            i,
            0,
            p_tracking_head=head if evidence == "head" else None,
            alternative=good if evidence == "alternative" else None,
        )
        assert used is (evidence != "nothing")
    got = estimator.estimate()
    assert got.refused is (evidence == "nothing")
    if got.refused:
        assert estimator.against_gravity == 20
        assert "mounted as configured" in got.advice
    else:
        assert estimator.unmirrored == 20
        assert _error_at(got, T, SHEET[0]) < 0.01


@pytest.mark.parametrize("order", ["abc", "bca", "cab"])
@pytest.mark.parametrize("apart_s", [0.0, 5.0])
def test_sheet_of_three_moved_by_3_cm_is_named_in_any_order(order: str, apart_s: float) -> None:
    """So close that each other sheet, with its weak rotation, could agree with it."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        T = tracking_frame(rng)
        estimator = AlignmentEstimator(TRIANGLE)
        for viewpoint, name in enumerate(order):
            place = shifted(TRIANGLE["b"], (0.03, 0.0, 0.0)) if name == "b" else None
            _observe(estimator, rng, T, name, viewpoint, at_s=apart_s * viewpoint, place=place)
        got = estimator.estimate()
        assert not got.refused, got.advice
        assert got.moved == ("b",)
        assert all(_error_at(got, T, TRIANGLE[name][0]) < 0.015 for name in "ac")


def test_three_contradicting_sheets_fail() -> None:
    rng = np.random.default_rng(5)
    T = tracking_frame(rng)
    estimator = AlignmentEstimator(TRIANGLE)
    away = {"a": (0.0, 0.0, 0.0), "b": (0.2, 0.0, 0.0), "c": (0.0, 0.3, 0.0)}
    for viewpoint, name in enumerate(away):
        _observe(estimator, rng, T, name, viewpoint, place=shifted(TRIANGLE[name], away[name]))
    got = estimator.estimate()
    assert got.refused
    assert got.advice.endswith("one of these was moved: a, b, c")


def test_two_contradicting_sheets_fail_however_often_one_was_observed() -> None:
    rng = np.random.default_rng(5)
    T = tracking_frame(rng)
    estimator = AlignmentEstimator(TRIANGLE)
    for viewpoint, name in enumerate("aaab"):
        place = shifted(TRIANGLE[name], (0.05, 0.0, 0.0)) if name == "b" else None
        _observe(estimator, rng, T, name, viewpoint, place=place)
    assert estimator.estimate().refused


@pytest.mark.parametrize("names", ["a", "abc"])
@pytest.mark.parametrize(("tilt_deg", "followed"), [(1.5, True), (2.5, True), (4.0, False), (8.0, False)])
def test_tilt_in_all_observations_is_no_contradiction(names: str, tilt_deg: float, followed: bool) -> None:
    rng = np.random.default_rng(2)
    level = tracking_frame(rng, 0.0)
    T = compose(level, ((0.0, 0.0, 0.0), quat_from_rotvec((math.radians(tilt_deg), 0.0, 0.0))))
    estimator = AlignmentEstimator({name: TRIANGLE[name] for name in names})
    for viewpoint in range(3):
        _observe(estimator, rng, T, names[viewpoint % len(names)], viewpoint, at_s=5.0 * viewpoint)
    got = estimator.estimate()
    assert got.refused != followed
    assert ("vertical is off" if followed else "lay it level") in got.advice
    if followed:
        assert math.degrees(got.residual_tilt_rad) == pytest.approx(tilt_deg, abs=0.6)
        assert _error_at(got, T, TRIANGLE["a"][0]) < 0.01


def test_steady_drift_is_followed() -> None:
    """3 mm/min for a minute: the estimate is for the present, not for the middle of the time."""
    errors = {}
    for drift in (AlignmentConfig().drift_m_per_s, 1e-9):
        far = []
        for seed in range(10):
            rng = np.random.default_rng(seed)
            estimator = AlignmentEstimator(TRIANGLE, AlignmentConfig(drift_m_per_s=drift))
            T = tracking_frame(rng)
            for viewpoint in range(12):
                now = shifted(T, (0.003 * 5.0 * viewpoint / 60.0, 0.0, 0.0))
                _observe(estimator, rng, now, "abc"[viewpoint % 3], viewpoint, 5.0 * viewpoint, n=6, noise=0.3)
            far.append(_error_at(estimator.estimate(), now, (0.75, 0.4, 0.7)))
        errors[drift] = float(np.median(far))
    assert min(errors, key=errors.__getitem__) == AlignmentConfig().drift_m_per_s


def test_glance_at_one_sheet_does_not_renew_a_yaw_that_has_drifted() -> None:
    """0.2 degrees a minute: earlier looks at three sheets know the yaw no longer, and one glance does not measure it
    well."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        estimator, T = AlignmentEstimator(TRIANGLE), tracking_frame(rng)
        for viewpoint in range(6):
            _observe(estimator, rng, T, "abc"[viewpoint % 3], viewpoint, 5.0 * viewpoint)
        sure = estimator.estimate().error_at((0.0, 2.0, 0.7))
        about, back = TRIANGLE["a"][0], shifted(((0.0, 0.0, 0.0), IDENTITY_QUAT), (0.0, 0.0, -0.7))
        T = compose(compose((about, quat_from_yaw(math.radians(1.0))), back), T)
        _observe(estimator, rng, T, "a", 6, 330.0)
        got = estimator.estimate()
        assert _error_at(got, T, (0.0, 2.0, 0.7)) < 1.5 * got.error_at((0.0, 2.0, 0.7))
        assert got.error_at((0.0, 2.0, 0.7)) > 2.0 * sure
        assert got.error_at_anchor_m < 0.012


def test_number_of_viewpoints_is_bounded() -> None:
    estimator = AlignmentEstimator({"sheet": SHEET}, AlignmentConfig(max_groups=4))
    for i in range(50):
        estimator.add("sheet", SHEET, i, 0, viewpoint_id=i)
    assert estimator.estimate().n_viewpoints == 4
    assert estimator.forgotten == 46


def test_invalid_covariances_are_ignored() -> None:
    good = tuple(np.diag([1e-6] * 6).ravel().tolist())
    assert validate_covariance(good) == good
    assert all(
        validate_covariance(bad) == () for bad in ((), good[:35], (*good[:35], math.nan), tuple(-x for x in good))
    )
    lopsided = list(good)
    lopsided[1] = 1.0
    assert validate_covariance(lopsided) == ()


def test_new_viewpoint_is_no_contradiction() -> None:
    """Its first detection may be wrong; two groups alone have no majority."""
    rng = np.random.default_rng(12)
    T = tracking_frame(rng)
    estimator = AlignmentEstimator({"sheet": SHEET})
    _observe(estimator, rng, T, viewpoint=0)
    _observe(estimator, rng, T, viewpoint=1, place=shifted(SHEET, (0.3, 0.0, 0.0)), n=2)
    assert not estimator.estimate().refused
    _observe(estimator, rng, T, viewpoint=1, place=shifted(SHEET, (0.3, 0.0, 0.0)), n=6)
    assert estimator.estimate().refused


def test_many_observations_of_one_sheet_displace_only_that_sheet() -> None:
    rng = np.random.default_rng(13)
    T = tracking_frame(rng)
    estimator = AlignmentEstimator(TRIANGLE)
    for viewpoint, name in enumerate("abc"):
        _observe(estimator, rng, T, name, viewpoint, at_s=2.0 * viewpoint)
    most = estimator.config.max_in_group
    _observe(estimator, rng, T, "a", 3, at_s=6.0, n=800)
    got = estimator.estimate()
    assert (got.n_viewpoints, got.n_observations, estimator.forgotten) == (4, 60 + most, 800 - most)
    assert got.error_at(TRIANGLE["c"][0]) < 0.008
