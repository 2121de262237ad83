"""How large an error is stated: quantiles of the length of a Gaussian error, and covariances carried to other points.

Covariances of alignments are 6x6, order (x, y, z [m], rx, ry, rz [rad]), world frame, at a pivot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from anchors.lie import Array
from anchors.pose import Vec3

#: 95 % quantile of the standard normal distribution.
Z95: Final = 1.6448536269514722
#: 99 % and 99.9 % quantiles of the standard normal distribution.
Z99: Final = 2.3263478740408408
Z999: Final = 3.090232306167813


def chi2_quantile(freedom: float, z: float) -> float:
    """Quantile of chi-square at the standard normal quantile `z` (Wilson and Hilferty 1931)."""
    a = 2.0 / (9.0 * freedom)
    return freedom * max(0.0, 1.0 - a + z * math.sqrt(a)) ** 3


def length_p95(S: Array) -> float:
    """95 % quantile of the length of an error with covariance `S` (3, 3).

    The squared length is a weighted sum of chi-square variables, approximated by a scaled chi-square with the same mean
    and variance (Satterthwaite 1946).
    """
    elements = S.ravel().tolist()
    mean = elements[0] + elements[4] + elements[8]
    if mean <= 0.0:
        return 0.0
    freedom = mean * mean / sum([s * s for s in elements])
    return math.sqrt(mean / freedom * chi2_quantile(freedom, Z95))


def covariance_at_point(covariance: Sequence[float] | Array, pivot_world: Vec3, point_world: Vec3) -> Array:
    """Covariance (3, 3) of the position error at `point_world`: d(point) = d(pivot) + rot x (point - pivot)."""
    cov = np.asarray(covariance, dtype=np.float64).reshape(6, 6)
    rx, ry, rz = (point_world[i] - pivot_world[i] for i in range(3))
    J = np.array(
        [
            [1.0, 0.0, 0.0, 0.0, rz, -ry],
            [0.0, 1.0, 0.0, -rz, 0.0, rx],
            [0.0, 0.0, 1.0, ry, -rx, 0.0],
        ]
    )
    return np.asarray(J @ cov @ J.T)


def position_error_p95(covariance: Sequence[float] | Array, pivot_world: Vec3, point_world: Vec3) -> float:
    """Stated 95 % bound [m] of the position error at `point_world`, lever arm from `pivot_world` included."""
    return length_p95(covariance_at_point(covariance, pivot_world, point_world))


def rotation_error_p95(covariance: Sequence[float] | Array) -> float:
    """Stated 95 % bound [rad] of the rotation error."""
    return length_p95(np.asarray(covariance, dtype=np.float64).reshape(6, 6)[3:, 3:])
