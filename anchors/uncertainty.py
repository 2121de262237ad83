"""Uncertainty: noise model of observations, covariances at other points, and quantiles of Gaussian errors.

Covariances of alignments are 6x6, order (x, y, z [m], rx, ry, rz [rad]), world frame, at a pivot.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np

from anchors.lie import Array, quat_to_matrix
from anchors.pose import Vec3

#: 95 % quantile of the standard normal distribution.
Z95: Final = 1.6448536269514722
#: 99 % and 99.9 % quantiles of the standard normal distribution.
Z99: Final = 2.3263478740408408
Z999: Final = 3.090232306167813


def chi2_quantile(freedom: float, z: float) -> float:
    """Return the quantile of chi-square at the standard normal quantile `z` (Wilson and Hilferty 1931)."""
    a = 2.0 / (9.0 * freedom)
    return freedom * max(0.0, 1.0 - a + z * math.sqrt(a)) ** 3


def length_p95(S: Array) -> float:
    """Return the 95 % quantile of the length of an error with covariance `S` (3, 3).

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
    """Return the covariance (3, 3) of the position error at `point_world`: d(point) = d(pivot) + rot x (point -
    pivot)."""
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
    """Return the stated 95 % bound [m] of the position error at `point_world`, lever arm from `pivot_world`
    included."""
    return length_p95(covariance_at_point(covariance, pivot_world, point_world))


# --- noise of observations --------------------------------------------------------------------------------------------
#
# Covariances of observations are 6x6, position [m] then rotation [rad], in the axes of the tracking frame. The part
# that is common to all observations from one viewpoint is separate from the part that is new in each.

#: No observation is better than this: printing and mounting of a sheet alone. [m^2], [rad^2]
FLOOR: Final = np.diag([1e-8, 1e-8, 1e-8, 1e-7, 1e-7, 1e-7])


@dataclass(frozen=True)
class NoiseModel:
    """Detection of a printed sheet by the cameras of a headset (docs/anchors.md, "Noise").

    Seen from `d` metres the position is off by `along_m + along_m_per_m2 * d^2` along the view and `across` times that
    across it, the rotation by `rotation_rad_per_m * d` about each axis (standard deviations). The share
    `viewpoint_share` of each variance is the same for all observations from one viewpoint, and so is an error of scale
    (`scale`, share of the distance).
    """

    along_m: float = 0.0004
    along_m_per_m2: float = 0.0044
    across: float = 1.0 / 3.0
    rotation_rad_per_m: float = math.radians(0.3) / 0.5
    scale: float = 0.003
    viewpoint_share: float = 0.5

    def compute_covariances(self, p_head: Array, p_anchor: Array) -> tuple[Array, Array]:
        """Return the covariances (6, 6) of one observation of an anchor from `p_head`: (common to the viewpoint, new in
        each observation)."""
        ray = p_anchor - p_head
        d2 = float(ray @ ray)
        d = math.sqrt(d2)
        view = ray[:, None] * ray / max(d2, 1e-12)
        along = self.along_m + self.along_m_per_m2 * d2
        noise = np.zeros((6, 6))
        noise[:3, :3] = along**2 * (1.0 - self.across**2) * view
        noise.flat[:21:7] += (along * self.across) ** 2
        noise.flat[21::7] = (self.rotation_rad_per_m * d) ** 2
        common, each = self.split_covariance(noise)
        common[:3, :3] += (self.scale * d) ** 2 * view
        return common, each

    def split_covariance(self, noise: Array) -> tuple[Array, Array]:
        """Split a covariance (6, 6) into (common to the viewpoint, new in each observation)."""
        whole = noise + FLOOR
        common = self.viewpoint_share * whole
        return common, whole - common


@dataclass(frozen=True)
class SourceBias:
    """Errors that all looks of one headset share, standard deviations: more looks do not reduce them.

    `scale`: share of the distance, along the view (size of a print, focal length); `untested_scale`: as much more,
    until looks from several places have tested it. `direction_rad`: of the line of sight, along either axis of the
    picture. `position_m`, `turn_rad`: per axis of the anchor (how a maker defines the
    pose of a controller, corners that a detector puts too far out).
    """

    scale: float = 0.0
    direction_rad: float = 0.0
    position_m: float = 0.0
    turn_rad: float = 0.0
    untested_scale: float = 0.0

    def compute_shifts(self, p_head: Array | None, p_anchor: Array, q_anchor: Array) -> Array:
        """Return by how much one standard deviation of each bias shifts an observed pose, tracking axes: (6, 9).

        Without the position of the head, scale and direction count as at `_UNKNOWN_DISTANCE_M`, along any axis.
        """
        out = np.zeros((6, 9))
        position = self.position_m
        if p_head is None:
            position = math.hypot(position, max(self.scale, self.direction_rad) * _UNKNOWN_DISTANCE_M)
        else:
            ray = p_anchor - p_head
            right = np.array([ray[1], -ray[0], 0.0])
            level = math.sqrt(float(right @ right))
            right = right / level if level > 1e-6 else np.array([1.0, 0.0, 0.0])
            d = math.sqrt(float(ray @ ray))
            out[:3, 0] = self.scale * ray
            out[:3, 1] = self.direction_rad * d * right
            out[:3, 2] = self.direction_rad * np.cross(right, ray)
        axes = quat_to_matrix(q_anchor)
        out[:3, 3:6] = position * axes
        out[3:, 6:] = self.turn_rad * axes
        return out


_UNKNOWN_DISTANCE_M: Final = 0.7
#: By source of observations; docs/anchors.md, "Biases", says where the figures come from.
SOURCE_BIASES: Final[Mapping[str, SourceBias]] = MappingProxyType(
    {
        "qr_camera": SourceBias(scale=0.005, direction_rad=0.001, turn_rad=math.radians(0.25), untested_scale=0.012),
        "qr_system": SourceBias(
            scale=0.006,
            direction_rad=0.002,
            position_m=0.002,
            turn_rad=math.radians(0.4),
            untested_scale=0.012,
        ),
        "holder": SourceBias(position_m=0.002, turn_rad=math.radians(0.6)),
    }
)


def isotropic_covariance(position_sigma_m: float, rotation_sigma_rad: float) -> Array:
    """Return a covariance (6, 6) with the same uncertainty along every axis."""
    return np.diag([position_sigma_m**2] * 3 + [rotation_sigma_rad**2] * 3)


def validate_covariance(covariance: Sequence[float]) -> tuple[float, ...]:
    """Return a client's covariance (36 values) made symmetric; empty if it is not finite, symmetric and positive
    definite."""
    return _validate(covariance, 6)


def validate_position_covariance(covariance: Sequence[float]) -> tuple[float, ...]:
    """Return the covariance of the position (9 values) in that of a pose (36 values), of which the rest does not count;
    empty if it is not finite, symmetric and positive definite."""
    return _validate([covariance[6 * i + k] for i in range(3) for k in range(3)], 3) if len(covariance) == 36 else ()


def _validate(covariance: Sequence[float], n: int) -> tuple[float, ...]:
    if len(covariance) != n * n or not all(map(math.isfinite, covariance)) or max(map(abs, covariance)) > 1e3:
        return ()
    C = np.array(covariance, dtype=np.float64).reshape(n, n)
    if not float(np.abs(C - C.T).max()) <= 1e-3 * float(np.abs(C).max()):
        return ()
    C = 0.5 * (C + C.T)
    return tuple(C.ravel().tolist()) if float(np.linalg.eigvalsh(C)[0]) > 0.0 else ()
