"""A motion controller as an anchor: in a holder of known pose, and as a pointer whose tip is calibrated by pivoting.

In its holder a controller is an anchor like any other: `T_world_controller = holder_anchor(...)` goes into the anchors
of `anchors.alignment`, and its tracked poses are the observations. Touching marked points: `anchors.touch`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from anchors.lie import Array, quat_conjugate, quat_log, quat_multiply, quat_to_matrix, to_vec3
from anchors.pose import PoseTuple, Vec3, compose, is_rigid, quat_normalize
from anchors.uncertainty import isotropic_covariance, length_p95

_ZERO: Final[Vec3] = (0.0, 0.0, 0.0)
_TRIM: Final = 4.0  # residuals beyond this many sigmas are wrong readings
# Rotation [rad] over which the errors of readings are alike: a tracker's error changes with the view of the controller
# and over tenths of a second. 15 degrees covers errors that last 0.5 s while it is turned (tests/anchors).
_ALIKE_RAD: Final = math.radians(15.0)
_MIN_DISTINCT: Final = 4.0


def holder_anchor(T_world_holder: PoseTuple, T_holder_controller: PoseTuple) -> PoseTuple:
    """Return `T_world_anchor` of a controller that stands in a holder fixed in the room. `T_holder_controller` is a
    property of the printed holder and of what the run time calls the pose of that controller (its grip or aim pose)."""
    return compose(T_world_holder, T_holder_controller)


def controller_covariance(
    position_sigma_m: float = 0.0015, rotation_sigma_rad: float = math.radians(0.3)
) -> tuple[float, ...]:
    """Return the covariance of an observation of a tracked controller (36 values, the form of an observation)."""
    return tuple(float(v) for v in isotropic_covariance(position_sigma_m, rotation_sigma_rad).ravel())


@dataclass(frozen=True)
class TipCalibration:
    """Position of the tip of a controller (`p_controller_tip`), or why it is unknown (`refused`, `advice`).

    `sigma_m`: standard deviation of the tip along its least certain direction; `residual_m`: how far the readings
    scatter about the pivot (root mean square, 3D). `covariance`: of the tip, 3x3 row-major in the controller's frame
    [m^2], empty when refused.
    """

    p_controller_tip: Vec3
    sigma_m: float
    residual_m: float
    n_used: int
    refused: bool
    advice: str
    covariance: tuple[float, ...] = ()

    @property
    def error_m(self) -> float:
        """Stated p95 [m] of the position of the tip, infinite when refused."""
        return math.inf if self.refused else length_p95(np.reshape(self.covariance, (3, 3)))


def calibrate_tip(
    poses: Sequence[PoseTuple],
    min_poses: int = 20,
    min_turn_rad: float = math.radians(20.0),
    max_sigma_m: float = 0.002,
    max_residual_m: float = 0.006,
) -> TipCalibration:
    """Calibrate a tip by pivoting: it rests in a dent while the controller is turned about it (Yaniv 2015, algebraic
    one-step method).

    Each pose `T_tracking_controller` = (R, t) says R p_tip + t = p_pivot: linear in both unknown points. Outliers
    and invalid poses are left out. The errors of readings are correlated by exp(-angle between them / 15 deg), so more
    readings of the same motion do not reduce the stated error. Refused if the rotations do not determine all three
    coordinates, or the tip slipped.
    """
    poses = [T for T in poses if is_rigid(T)]
    if len(poses) < min_poses:
        return _refuse(f"{len(poses)} poses of at least {min_poses}: keep the tip in place and go on turning")
    q = np.array([quat_normalize(T[1]) for T in poses])
    t = np.array([T[0] for T in poses])
    weak = _second_axis_rotation(q)
    if weak < min_turn_rad:
        return _refuse(
            f"turned by {math.degrees(weak):.0f} deg about the least used direction, {math.degrees(min_turn_rad):.0f} "
            "are needed: tilt the controller to the front and to the side while its tip stays"
        )
    A = np.concatenate([quat_to_matrix(q), np.broadcast_to(-np.eye(3), (len(q), 3, 3))], axis=2)  # (n, 3, 6)
    keep = np.ones(len(q), dtype=bool)
    x, errors, sigma = np.zeros(6), np.zeros(len(q)), 0.0
    for _ in range(5):
        x = np.linalg.lstsq(A[keep].reshape(-1, 6), -t[keep].ravel(), rcond=None)[0]
        errors = np.linalg.norm(A @ x + t, axis=1)
        # The median length of a Gaussian error in 3D is 1.538 sigma.
        sigma = max(float(np.median(errors)) / 1.538, 1e-6)
        now = errors <= _TRIM * sigma
        if bool(np.all(now == keep)):
            break
        keep = now
    n = int(np.count_nonzero(keep))
    residual = math.sqrt(float(np.mean(errors[keep] ** 2)))
    covariance, distinct = _correlated_covariance(A[keep], q[keep], float(np.sum(errors[keep] ** 2)))
    tip_sigma = math.sqrt(float(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    advice = ""
    if residual > max_residual_m or 2 * n < len(poses):
        advice = f"the readings scatter by {residual * 1e3:.1f} mm: the tip slipped; rest it in a dent and turn slowly"
    elif distinct < _MIN_DISTINCT:
        advice = f"the readings are of about {distinct:.0f} different rotations only: go on turning, in every direction"
    elif tip_sigma > max_sigma_m:
        advice = f"the tip is known to {tip_sigma * 1e3:.1f} mm only: turn further, in every direction"
    stated = () if advice else tuple(covariance[:3, :3].ravel().tolist())
    return TipCalibration(to_vec3(x[:3]), tip_sigma, residual, n, bool(advice), advice, stated)


def _correlated_covariance(A: Array, q: Array, squares: float) -> tuple[Array, float]:
    """Return the covariance (6, 6) of the least squares with design `A` (n, 3, 6) and correlated errors, and how many
    independent readings the mean of the readings is worth. `squares`: sum of the squared residuals [m^2]."""
    turns = _relative_rotations(q)
    alike = np.exp(-np.linalg.norm(turns[:, None] - turns, axis=2) / _ALIKE_RAD)
    inverse = np.linalg.inv(np.einsum("nij,nik->jk", A, A))
    middle = np.einsum("nij,nik->jk", A, np.tensordot(alike, A, axes=1))
    # Expected sum of squared residuals per variance of a coordinate: tr((1 - P) S), P projection, S correlation.
    freedom = max(3.0, 3.0 * len(A) - float(np.trace(inverse @ middle)))
    return inverse @ middle @ inverse * (squares / freedom), len(A) ** 2 / float(np.sum(alike))


def _relative_rotations(q: Array) -> Array:
    """Return rotation vectors (n, 3) [rad] from the reading in the middle."""
    return quat_log(quat_multiply(q, quat_conjugate(q[len(q) // 2])))


def _second_axis_rotation(q: Array) -> float:
    """Return the rotation [rad] about the second principal axis: rotations about one axis leave the tip free along it.

    It is twice the standard deviation, which for even rotations from end to end is 0.58 of the range.
    """
    spread = np.linalg.eigvalsh(np.cov(_relative_rotations(q).T))
    return 2.0 * math.sqrt(max(0.0, float(spread[1])))


def _refuse(advice: str) -> TipCalibration:
    return TipCalibration(_ZERO, math.inf, math.inf, 0, True, advice)
