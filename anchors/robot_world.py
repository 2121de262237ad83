"""Robot-world calibration: the pose of a camera in the frame of a robot, from a marker on the moving hand.

Two chains lead to the marker, `T_base_ee T_ee_marker = T_base_camera T_camera_marker`: kinematics gives the first
factor, the camera the last one, and many poses determine the other two. (Robot-world and hand-eye calibration: Park and
Martin 1994 for the initial guess, then weighted least squares over both, as in Dornaika and Horaud 1998, section V.)

The same equation holds for a camera on the hand (`solve_camera_on_hand`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from anchors.camera import apply_increment, pose_from_matrix, pose_to_matrix
from anchors.lie import Array, skew
from anchors.pose import PoseTuple, inverse

MIN_POSES: Final = 3
#: Rotations of the marker, rms about the second of its main axes: with less, the position along the first is free.
MIN_SPREAD_RAD: Final = math.radians(5.0)
_OUTLIER: Final = 5.0  # whitened residual over that of the median picture
_MIN_AGREEING: Final = 0.6
_TURN_ADVICE: Final = (
    "turn the hand by 30 degrees or more about at least two axes that are not parallel, and take ten pictures or more"
)
_MIXED_UP: Final = (
    "are the poses those of these pictures (metres, quaternion w first), and did the marker stay fixed on the hand?"
)
#: Median residual of the pictures used, [m] and [rad]: beyond this the result is refused at any stated noise.
MAX_RESIDUAL: Final = (0.02, math.radians(3.0))


class CalibrationError(ValueError):
    """The poses do not determine a result."""


@dataclass(frozen=True)
class CalibrationNoise:
    """Standard deviations per axis of the robot's poses (repeatability and kinematics), and of the camera's poses
    that have no covariance."""

    robot_m: float = 0.0005
    robot_rad: float = math.radians(0.05)
    seen_m: float = 0.001
    seen_rad: float = math.radians(0.3)


@dataclass(frozen=True)
class RobotWorldCalibration:
    """`covariance`: 36 values, (x, y, z [m], rx, ry, rz [rad]) of the camera in the frame of the base; scaled up where
    residuals are larger than stated. `residuals`: per picture, distance [m] and angle [rad] between both chains.
    `left_out`: pictures that contradict the others. `spread_rad`: rotation of the hand about its second axis."""

    T_base_camera: PoseTuple
    T_ee_marker: PoseTuple
    covariance: tuple[float, ...]
    residuals: tuple[tuple[float, float], ...]
    left_out: tuple[int, ...]
    spread_rad: float


def solve_robot_world(
    T_base_ee: Sequence[PoseTuple],
    T_camera_marker: Sequence[PoseTuple],
    covariances: Sequence[Sequence[float]] | None = None,
    noise: CalibrationNoise | None = None,
) -> RobotWorldCalibration:
    """Estimate `T_base_camera` and `T_ee_marker` from many poses; neither needs to be known.

    Args:
        T_base_ee: Poses of the hand by kinematics, one per picture.
        T_camera_marker: Poses of the marker by the camera, one per picture.
        covariances: Of each `T_camera_marker` (36 values), camera frame.
        noise: Standard deviations where no covariance is given, and of the robot.

    Raises:
        CalibrationError: Too few pictures agree, or the hand rotated too little.
    """
    if len(T_base_ee) != len(T_camera_marker):
        raise CalibrationError(f"{len(T_base_ee)} poses of the robot, {len(T_camera_marker)} of the marker")
    data = _Data.from_poses(T_base_ee, T_camera_marker, covariances, noise or CalibrationNoise())
    kept = list(range(len(data.A)))
    while True:
        if len(kept) < max(MIN_POSES, math.ceil(_MIN_AGREEING * len(data.A))):
            raise CalibrationError(_disagreement_text(len(kept), len(data.A)))
        spread = _rotation_spread(data.A[kept])
        if spread < MIN_SPREAD_RAD:
            raise CalibrationError(
                f"the hand turned by {math.degrees(spread):.1f} deg about its second axis, which leaves the result "
                f"open: {_TURN_ADVICE}"
            )
        X, Y, normal = _least_squares(data.select(kept))
        whitened = np.linalg.norm(data.whiten(X, Y), axis=1)
        # One at a time: a wrong picture drags the result towards it, and others away.
        limit = _OUTLIER * max(float(np.median(whitened[kept])), math.sqrt(6.0) / 2.0)
        worst = max(kept, key=lambda k: whitened[k])
        if whitened[worst] <= limit:
            break
        kept.remove(worst)
    differences = data.residuals(X, Y)
    residuals = np.column_stack(
        [np.linalg.norm(differences[:, :3], axis=1), np.linalg.norm(differences[:, 3:], axis=1)]
    )
    if np.any(np.median(residuals[kept], axis=0) > MAX_RESIDUAL):
        m, rad = np.median(residuals[kept], axis=0)
        raise CalibrationError(
            f"the pictures do not agree: they differ by {1e3 * m:.0f} mm and {math.degrees(rad):.1f} deg; {_MIXED_UP}"
        )
    birge = max(1.0, float(np.sum(whitened[kept] ** 2)) / max(6 * len(kept) - 12, 1))
    covariance = (np.linalg.inv(normal) * birge)[:6, :6]
    return RobotWorldCalibration(
        pose_from_matrix(X),
        pose_from_matrix(Y),
        tuple(float(v) for v in covariance.ravel()),
        tuple((float(m), float(rad)) for m, rad in residuals),
        tuple(k for k in range(len(data.A)) if k not in kept),
        spread,
    )


def solve_camera_on_hand(
    T_base_ee: Sequence[PoseTuple],
    T_camera_sheet: Sequence[PoseTuple],
    covariances: Sequence[Sequence[float]] | None = None,
    noise: CalibrationNoise | None = None,
) -> RobotWorldCalibration:
    """Calibrate a camera on the hand that sees a sheet in the room.

    `T_base_camera` of the result is `T_base_sheet`, and `T_ee_marker` is `T_ee_camera`.
    """
    turned = None
    if covariances is not None:
        turned = [_invert_covariance(T, cov) for T, cov in zip(T_camera_sheet, covariances, strict=True)]
    return solve_robot_world(T_base_ee, [inverse(T) for T in T_camera_sheet], turned, noise)


@dataclass(frozen=True)
class _Data:
    A: Array  # T_base_ee, shape (n, 4, 4)
    B: Array  # T_camera_marker
    whitener: Array  # of the difference between both chains, shape (n, 6, 6)

    @classmethod
    def from_poses(
        cls,
        robot: Sequence[PoseTuple],
        camera: Sequence[PoseTuple],
        covariances: Sequence[Sequence[float]] | None,
        noise: CalibrationNoise,
    ) -> _Data:
        seen = np.tile(np.diag([noise.seen_m**2] * 3 + [noise.seen_rad**2] * 3), (len(camera), 1, 1))
        if covariances is not None:
            seen = np.reshape(np.asarray(covariances, dtype=np.float64), (-1, 6, 6))
        floor = np.diag([noise.robot_m**2] * 3 + [noise.robot_rad**2] * 3)
        whitener = np.linalg.inv(np.linalg.cholesky(seen + floor)) if len(seen) else seen
        A, B = (np.array([pose_to_matrix(T) for T in poses]).reshape(-1, 4, 4) for poses in (robot, camera))
        return cls(A, B, whitener)

    def residuals(self, X: Array, Y: Array) -> Array:
        """Return position and rotation of the marker by kinematics minus observed, camera frame, shape (n, 6)."""
        from scipy.spatial.transform import Rotation

        P = np.linalg.inv(X) @ self.A @ Y
        turn = Rotation.from_matrix(P[:, :3, :3] @ self.B[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
        return np.concatenate([P[:, :3, 3] - self.B[:, :3, 3], turn], axis=1)

    def whiten(self, X: Array, Y: Array) -> Array:
        return np.asarray(np.einsum("nij,nj->ni", self.whitener, self.residuals(X, Y)))

    def select(self, kept: list[int]) -> _Data:
        return _Data(self.A[kept], self.B[kept], self.whitener[kept])


def _closed_form(data: _Data) -> tuple[Array, Array]:
    """Return (X, Y) in closed form from relative motions `A Y = Y B`: rotation by aligning axes, then position
    linearly."""
    from scipy.spatial.transform import Rotation

    i, j = np.triu_indices(len(data.A), 1)
    a, b = np.linalg.inv(data.A[j]) @ data.A[i], np.linalg.inv(data.B[j]) @ data.B[i]
    alpha, beta = (Rotation.from_matrix(m[:, :3, :3]).as_rotvec() for m in (a, b))
    u, _, vt = np.linalg.svd(alpha.T @ beta)
    R = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    left = (a[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (b[:, :3, 3] @ R.T - a[:, :3, 3]).ravel()
    X, Y = np.eye(4), np.eye(4)
    Y[:3, :3], Y[:3, 3] = R, np.linalg.lstsq(left, right, rcond=None)[0]
    each = data.A @ Y @ np.linalg.inv(data.B)
    X[:3, :3] = Rotation.from_matrix(each[:, :3, :3]).mean().as_matrix()
    X[:3, 3] = np.median(each[:, :3, 3], axis=0)
    return X, Y


def _least_squares(data: _Data) -> tuple[Array, Array, Array]:
    """Return both unknowns and the normal matrix (12, 12) of (camera, marker)."""
    from scipy.optimize import least_squares

    X, Y = _closed_form(data)
    solved = least_squares(
        lambda p: data.whiten(apply_increment(X, p[:6]), apply_increment(Y, p[6:])).ravel(),
        np.zeros(12),
        loss="huber",
        f_scale=3.0,
        x_scale="jac",
    )
    return apply_increment(X, solved.x[:6]), apply_increment(Y, solved.x[6:]), np.asarray(solved.jac.T @ solved.jac)


def _rotation_spread(A: Array) -> float:
    """Return the root mean square rotation [rad] between poses about the second of the main axes."""
    from scipy.spatial.transform import Rotation

    i, j = np.triu_indices(len(A), 1)
    turns = Rotation.from_matrix(A[i, :3, :3].transpose(0, 2, 1) @ A[j, :3, :3]).as_rotvec()
    return math.sqrt(max(float(np.linalg.eigvalsh(turns.T @ turns / len(turns))[1]), 0.0))


def _disagreement_text(agreeing: int, n: int) -> str:
    if n < MIN_POSES:
        return f"{n} pictures in which the marker was found: at least {MIN_POSES} are needed; {_TURN_ADVICE}"
    return f"only {agreeing} of {n} pictures agree; {_MIXED_UP}"


def _invert_covariance(T: PoseTuple, covariance: Sequence[float]) -> tuple[float, ...]:
    """Return the covariance (36 values) of the inverse of a pose."""
    M = pose_to_matrix(T)
    R = M[:3, :3]
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = -R.T
    J[:3, 3:] = -R.T @ skew(M[:3, 3])
    C = J @ np.asarray(covariance, dtype=np.float64).reshape(6, 6) @ J.T
    return tuple(float(v) for v in C.ravel())
