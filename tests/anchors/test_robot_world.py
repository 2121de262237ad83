"""Camera against robot: exact without noise, honest with noise, refused where the poses do not determine it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchors.camera import pose_from_matrix, pose_from_rvec_tvec, pose_to_matrix
from anchors.pose import PoseTuple, compose, distance, inverse, quat_angle, quat_from_rotvec, quat_to_rotvec
from anchors.robot_world import (
    CalibrationError,
    CalibrationNoise,
    RobotWorldCalibration,
    solve_camera_on_hand,
    solve_robot_world,
)

T_BASE_CAMERA: PoseTuple = ((1.4, -0.3, 0.9), quat_from_rotvec((-1.9, 0.4, 0.3)))
T_EE_MARKER: PoseTuple = ((0.02, -0.05, 0.11), quat_from_rotvec((0.3, -2.1, 0.5)))
NOISE = CalibrationNoise(robot_m=0.0004, robot_rad=math.radians(0.05), seen_m=0.001, seen_rad=math.radians(0.2))


def _robot_poses(rng: np.random.Generator, n: int, turn: float = 0.6, axes: int = 3) -> list[PoseTuple]:
    poses: list[PoseTuple] = []
    for _ in range(n):
        r = rng.normal(0.0, turn, 3) * (np.arange(3) < axes)
        p = np.array([0.5, 0.0, 0.4]) + rng.uniform(-0.25, 0.25, 3)
        poses.append(pose_from_rvec_tvec(r, p))
    return poses


def _noisy(rng: np.random.Generator, pose: PoseTuple, m: float, rad: float) -> PoseTuple:
    M = pose_to_matrix(pose)
    M[:3, :3] = pose_to_matrix(pose_from_rvec_tvec(rng.normal(0.0, rad, 3), np.zeros(3)))[:3, :3] @ M[:3, :3]
    M[:3, 3] += rng.normal(0.0, m, 3)
    return pose_from_matrix(M)


def _marker_poses(robot: list[PoseTuple], X: PoseTuple = T_BASE_CAMERA) -> list[PoseTuple]:
    return [compose(inverse(X), compose(T, T_EE_MARKER)) for T in robot]


def _observed(rng: np.random.Generator, n: int) -> tuple[list[PoseTuple], list[PoseTuple]]:
    robot = _robot_poses(rng, n)
    seen = [_noisy(rng, T, NOISE.seen_m, NOISE.seen_rad) for T in _marker_poses(robot)]
    return [_noisy(rng, T, NOISE.robot_m, NOISE.robot_rad) for T in robot], seen


def _errors(solved: RobotWorldCalibration) -> tuple[float, float]:
    at = solved.T_base_camera
    return distance(at[0], T_BASE_CAMERA[0]), quat_angle(at[1], T_BASE_CAMERA[1])


@pytest.mark.parametrize("n", [3, 12])
def test_exact_without_noise(n: int) -> None:
    robot = _robot_poses(np.random.default_rng(n), n)
    solved = solve_robot_world(robot, _marker_poses(robot))
    assert max(_errors(solved)) < 1e-7
    assert distance(solved.T_ee_marker[0], T_EE_MARKER[0]) < 1e-7
    assert solved.left_out == ()
    assert np.max(solved.residuals) < 1e-7


@pytest.mark.long
def test_stated_covariance_matches_the_errors() -> None:
    """Mahalanobis distance over 30 calibrations: mean 6 with 6 degrees of freedom, within 4 standard deviations."""
    distances = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        solved = solve_robot_world(*_observed(rng, 15), noise=NOISE)
        difference = pose_to_matrix(solved.T_base_camera) @ np.linalg.inv(pose_to_matrix(T_BASE_CAMERA))
        turn = quat_to_rotvec(pose_from_matrix(difference)[1])
        d = np.concatenate([np.subtract(solved.T_base_camera[0], T_BASE_CAMERA[0]), turn])
        C = np.reshape(solved.covariance, (6, 6))
        distances.append(float(d @ np.linalg.solve(C, d)))
        assert _errors(solved)[0] < 0.006
    assert abs(float(np.mean(distances)) - 6.0) < 4.0 * math.sqrt(12.0 / 30.0), np.mean(distances)


def test_wrong_pictures_are_named_and_excluded() -> None:
    rng = np.random.default_rng(3)
    robot, seen = _observed(rng, 14)
    seen[4] = _noisy(rng, seen[4], 0.05, 0.3)
    robot[9], robot[10] = robot[10], robot[9]
    solved = solve_robot_world(robot, seen, noise=NOISE)
    assert set(solved.left_out) == {4, 9, 10}
    assert _errors(solved)[0] < 0.004
    assert solved.residuals[4][0] > 5.0 * max(
        m for k, (m, _) in enumerate(solved.residuals) if k not in solved.left_out
    )


def test_camera_on_the_hand() -> None:
    robot = _robot_poses(np.random.default_rng(5), 8)
    T_base_sheet, T_ee_camera = T_BASE_CAMERA, T_EE_MARKER
    seen = [compose(inverse(compose(T, T_ee_camera)), T_base_sheet) for T in robot]
    covariance = [tuple(np.diag([1e-6] * 6).ravel())] * 8
    solved = solve_camera_on_hand(robot, seen, covariance)
    assert distance(solved.T_ee_marker[0], T_ee_camera[0]) < 1e-7
    assert distance(solved.T_base_camera[0], T_base_sheet[0]) < 1e-7


@pytest.mark.parametrize(("turn", "axes"), [(0.01, 3), (0.8, 1)])
def test_small_rotations_are_refused_with_advice(turn: float, axes: int) -> None:
    robot = _robot_poses(np.random.default_rng(7), 10, turn, axes)
    with pytest.raises(CalibrationError, match=r"second axis.*30 degrees"):
        solve_robot_world(robot, _marker_poses(robot))


def test_too_few_pictures_are_refused() -> None:
    rng = np.random.default_rng(8)
    robot = _robot_poses(rng, 10)
    with pytest.raises(CalibrationError, match=r"2 pictures .*at least 3"):
        solve_robot_world(robot[:2], _marker_poses(robot[:2]))
    with pytest.raises(CalibrationError, match=r"3 poses .*2 of"):
        solve_robot_world(robot[:3], _marker_poses(robot[:2]))


def test_shuffled_pictures_are_refused() -> None:
    rng = np.random.default_rng(9)
    robot, seen = _observed(rng, 12)
    with pytest.raises(CalibrationError, match=r"pictures (do not )?agree"):
        solve_robot_world(robot, [seen[(k * 5) % 12] for k in range(12)], noise=NOISE)
