"""The solver: its covariance against repeated draws, and merged observations."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from anchors.lie import Array, quat_conjugate, quat_exp, quat_multiply, quat_to_matrix
from anchors.solver import AlignmentPrior, AlignmentProblem, build_problem, solve_alignment
from anchors.viewpoints import MergedObservation, fast_median, merge_poses

PRIOR = AlignmentPrior(math.radians(0.2), 0.003 / 60.0, 0.0, yaw_rad_per_s=math.radians(1.0) / 60.0)
P_WORLD = np.array([[0.0, 0.0, 0.7], [1.5, 0.1, 0.7], [0.6, 1.2, 0.8], [0.0, 0.0, 0.7]])
AGES = np.array([-45.0, -30.0, -15.0, 0.0])


def _problem(rng: np.random.Generator) -> tuple[AlignmentProblem, Array, Array]:
    """Four observations with their own covariances in a tilted frame that drifts and turns; the true pose at age 0."""
    tilt = quat_exp(np.append(rng.normal(0.0, PRIOR.tilt_sigma_rad, 2), 0.0))
    q = quat_multiply(tilt, quat_exp(np.array([0.0, 0.0, rng.uniform(-3.0, 3.0)])))
    t = rng.uniform(-2.0, 2.0, 3)
    drift, yaw_rate = rng.normal(0.0, PRIOR.drift_m_per_s, 3), rng.normal(0.0, PRIOR.yaw_rad_per_s)
    middle = quat_to_matrix(q) @ P_WORLD.mean(axis=0) + t
    merged = []
    for p, age in zip(P_WORLD, AGES, strict=True):
        root = rng.normal(size=(6, 6)) * np.repeat([0.001, 0.002], 3)[:, None]
        C = root @ root.T + np.diag([1e-7] * 6)
        noise = np.linalg.cholesky(C) @ rng.normal(size=6)
        turn = quat_exp(np.array([0.0, 0.0, age * yaw_rate]))
        seen = middle + quat_to_matrix(turn) @ (quat_to_matrix(q) @ p + t - middle) + age * drift + noise[:3]
        turned = quat_multiply(quat_exp(noise[3:]), quat_multiply(turn, q))
        merged.append(MergedObservation(seen, turned, C, 20, 20))
    level = np.tile([1.0, 0.0, 0.0, 0.0], (4, 1))
    return build_problem("abca", P_WORLD, level, merged, AGES, PRIOR), t, q


def test_errors_scatter_as_the_covariance_states() -> None:
    """Mean squared Mahalanobis distance of the truth: 6, with a standard deviation of sqrt(12 / n)."""
    distances = []
    for seed in range(200):
        b, t, q = _problem(np.random.default_rng(seed))
        got = solve_alignment(b, PRIOR)
        turn = Rotation.from_quat(np.roll(quat_multiply(q, quat_conjugate(got.q)), -1)).as_rotvec()
        e = np.concatenate([t - got.t, turn])
        distances.append(float(e @ np.linalg.solve(got.covariance, e)))
    assert abs(np.mean(distances) - 6.0) < 4.0 * math.sqrt(12.0 / 200.0)


def test_merge_is_the_mean_of_agreeing_observations() -> None:
    rng = np.random.default_rng(3)
    C = np.diag([1e-6] * 3 + [1e-5] * 3)
    p = rng.normal(0.0, 0.001, (21, 3))
    q = quat_exp(rng.normal(0.0, math.sqrt(1e-5), (21, 3)))
    q[::2] *= -1.0  # the same rotations
    p[4] += 0.1
    q[9] = quat_exp(np.array([0.5, 0.0, 0.0]))
    got = merge_poses(p, q, C, C, 0.6)
    assert got is not None
    assert (got.n, got.n_total) == (19, 21)
    keep = [i for i in range(21) if i not in (4, 9)]
    assert np.allclose(got.p, p[keep].mean(axis=0))
    assert np.allclose(got.covariance, C + C / 19)
    assert merge_poses(p, quat_exp(rng.uniform(-3.0, 3.0, (21, 3))), C, C, 0.6) is None
    assert np.allclose(fast_median(p), np.median(p, axis=0))
