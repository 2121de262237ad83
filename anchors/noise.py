"""What is known of the noise of one observation of an anchor: covariances 6x6, position [m] then rotation [rad], in the
axes of the tracking frame; what is common to all observations from one viewpoint apart from what is new in each.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from anchors.lie import Array

#: Nobody is better than this: printing and mounting of a sheet alone. [m^2], [rad^2]
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
        """Covariances (common to the viewpoint, new in each observation) of an anchor seen from `p_head`."""
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
        """A whole covariance as (common to the viewpoint, new in each observation)."""
        whole = noise + FLOOR
        common = self.viewpoint_share * whole
        return common, whole - common


def isotropic_covariance(position_sigma_m: float, rotation_sigma_rad: float) -> Array:
    """Covariance with the same uncertainty along every axis."""
    return np.diag([position_sigma_m**2] * 3 + [rotation_sigma_rad**2] * 3)


def validate_covariance(covariance: Sequence[float]) -> tuple[float, ...]:
    """The covariance that an observer sent with its observation, made symmetric; empty when it is none (not finite,
    not symmetric and positive)."""
    if len(covariance) != 36 or not all(map(math.isfinite, covariance)) or max(map(abs, covariance)) > 1e3:
        return ()
    C = np.array(covariance, dtype=np.float64).reshape(6, 6)
    if not float(np.abs(C - C.T).max()) <= 1e-3 * float(np.abs(C).max()):
        return ()
    C = 0.5 * (C + C.T)
    return tuple(C.ravel().tolist()) if float(np.linalg.eigvalsh(C)[0]) > 0.0 else ()
