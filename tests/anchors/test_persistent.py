"""Alignment by a persistent anchor: honest about its error, confirmed or contradicted by touched marks."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchors.alignment import AlignmentEstimate
from anchors.lie import quat_exp, quat_multiply, quat_to_matrix, to_quat, to_vec3
from anchors.persistent import (
    PersistentConfig,
    align_persistent,
    confirm_alignment,
    covariance_at_anchor,
    inflate_covariance,
)
from anchors.pose import PoseTuple, Vec3, apply, compose, distance, inverse, quat_from_rotvec, quat_from_yaw
from anchors.sheet import compute_marks
from anchors.touch import Touch
from anchors.uncertainty import isotropic_covariance, length_p95

T_WORLD_ANCHOR: PoseTuple = ((0.1, -0.45, 0.0), quat_from_yaw(0.3))
T_WORLD_TRACKING: PoseTuple = ((1.0, -2.0, 0.4), quat_from_yaw(2.2))
T_TRACKING_ANCHOR = compose(inverse(T_WORLD_TRACKING), T_WORLD_ANCHOR)
MARKS: dict[str, Vec3] = {name: apply(T_WORLD_ANCHOR, p) for name, p in compute_marks(0.14).items()}
EARLIER = tuple(isotropic_covariance(0.001, math.radians(0.2)).ravel().tolist())
ROBOT: Vec3 = (0.3, 0.2, 0.3)
SIGMA_M = 0.0015


def _turn_p95(estimate: AlignmentEstimate) -> float:
    return length_p95(np.reshape(estimate.covariance, (6, 6))[3:, 3:])


def _found_again(rng: np.random.Generator, T_world_tracking: PoseTuple) -> PoseTuple:
    """Return where a device sees the anchor, wrong as the inflated covariance says."""
    p, q = compose(inverse(T_world_tracking), T_WORLD_ANCHOR)
    d = rng.multivariate_normal(np.zeros(6), inflate_covariance(EARLIER))
    return to_vec3(np.array(p) + d[:3]), to_quat(quat_multiply(quat_exp(d[3:]), np.array(q)))


def _touch(name: str, rng: np.random.Generator | None = None, T: PoseTuple = T_WORLD_TRACKING) -> Touch:
    p = np.array(apply(inverse(T), MARKS[name]))
    return Touch(name, to_vec3(p if rng is None else p + rng.normal(0.0, SIGMA_M, 3)), SIGMA_M)


@pytest.mark.parametrize("marks", ["", "1", "14"])
def test_stated_error_is_honest(marks: str) -> None:
    """Monte Carlo: 95 % of the errors are within the stated error, at the anchor and at a robot, before and after."""
    rng = np.random.default_rng(7)
    inside = {"anchor": 0, "robot": 0}
    points = {"anchor": T_WORLD_ANCHOR[0], "robot": ROBOT}
    n = 300
    for _ in range(n):
        tilt = rng.normal(0.0, math.radians(0.2), 2)
        leaning = quat_from_rotvec((float(tilt[0]), float(tilt[1]), 0.0))
        T = compose(((0.0, 0.0, 0.0), leaning), T_WORLD_TRACKING)
        got = align_persistent(T_WORLD_ANCHOR, _found_again(rng, T), EARLIER, 0)
        assert got is not None
        if marks:
            got = confirm_alignment(got, MARKS, [_touch(name, rng, T) for name in marks])
        for where, point in points.items():
            at = apply(got.T_world_tracking, apply(inverse(T), point))
            inside[where] += not got.refused and distance(at, point) <= got.error_at(point)
    assert all(0.925 <= count / n <= 0.98 for count in inside.values()), inside


@pytest.mark.parametrize("yaw", [0.0, 1.5])
def test_covariance_is_stored_in_the_axes_of_the_anchor(yaw: float) -> None:
    """Monte Carlo: an alignment that is uncertain along one axis, about a pivot beside the anchor; afterwards the
    world lies otherwise, and one mark is touched."""
    rng = np.random.default_rng(5)
    sigma = np.array([0.012, 0.002, 0.002, *np.radians([0.2, 0.2, 0.8])])
    pivot = (0.6, -0.2, 0.1)
    stored = covariance_at_anchor(tuple(np.diag(sigma**2).ravel().tolist()), pivot, T_WORLD_ANCHOR)
    T_NOW_WORLD: PoseTuple = ((0.2, 0.1, 0.0), quat_from_yaw(yaw))
    anchor = compose(T_NOW_WORLD, T_WORLD_ANCHOR)
    marks = {name: apply(T_NOW_WORLD, p) for name, p in MARKS.items()}
    far, T_tracking_now = apply(T_NOW_WORLD, ROBOT), inverse(compose(T_NOW_WORLD, T_WORLD_TRACKING))
    config = PersistentConfig(inflation=1.0, position_sigma_m=1e-4, rotation_sigma_rad=1e-4)
    inside = refused = 0
    n = 200
    for _ in range(n):
        d = rng.multivariate_normal(np.zeros(6), np.diag(sigma**2))
        turn = quat_exp(d[3:])
        p = np.array(T_WORLD_ANCHOR[0])
        place = np.array(pivot) + quat_to_matrix(turn) @ (p - np.array(pivot)) + d[:3]
        found = (to_vec3(place), to_quat(quat_multiply(turn, np.array(T_WORLD_ANCHOR[1]))))
        seen = compose(inverse(T_WORLD_TRACKING), found)
        kept = align_persistent(anchor, seen, stored, 0, config)
        assert kept is not None
        at = np.array(apply(T_tracking_now, marks["1"])) + rng.normal(0.0, SIGMA_M, 3)
        got = confirm_alignment(kept, marks, [Touch("1", to_vec3(at), SIGMA_M)])
        refused += got.refused
        off = [distance(apply(one.T_world_tracking, apply(T_tracking_now, far)), far) for one in (kept, got)]
        inside += off[0] <= kept.error_at(far)
    assert 0.92 <= inside / n <= 0.98
    assert refused <= 0.01 * n


def test_a_touch_reduces_the_error_there_and_leaves_the_rotation_open() -> None:
    kept = align_persistent(T_WORLD_ANCHOR, T_TRACKING_ANCHOR, EARLIER, 0)
    assert kept is not None
    got = confirm_alignment(kept, MARKS, [_touch("1")])
    assert got.error_at(MARKS["1"]) < 0.3 * kept.error_at(MARKS["1"])
    assert _turn_p95(got) == pytest.approx(_turn_p95(kept), rel=0.3)
    assert got.n_observations == 1


def test_a_mark_far_from_where_the_anchor_says_contradicts_it() -> None:
    x, y, z = T_TRACKING_ANCHOR[0]
    kept = align_persistent(T_WORLD_ANCHOR, ((x + 0.12, y, z), T_TRACKING_ANCHOR[1]), EARLIER, 0)
    assert kept is not None
    got = confirm_alignment(kept, MARKS, [_touch("2")])
    assert got.refused
    assert got.advice.startswith("'2' lies 120 mm from where the kept anchor says")


def test_unknown_covariance_is_assumed_and_gravity_contradicts() -> None:
    known, unknown = inflate_covariance(EARLIER), inflate_covariance((math.nan,) * 36)
    assert np.all(np.diagonal(unknown) > np.diagonal(known))
    assert np.sqrt(np.diagonal(known))[:3] == pytest.approx(np.hypot(0.002, PersistentConfig().position_sigma_m))
    on_a_wall = compose(T_TRACKING_ANCHOR, ((0.0, 0.0, 0.0), quat_from_rotvec((0.5, 0.0, 0.0))))
    assert align_persistent(T_WORLD_ANCHOR, on_a_wall, EARLIER, 0) is None
