"""Robust mean of the observations of one anchor from one viewpoint: the first stage behind `anchors.alignment`.

Wrong detections are a minority and far off: what lies outside the 99.9 % ellipsoid about the median is left out, the
rest counts in full (trimming keeps Gaussian noise efficient). Where the observations scatter more than stated, the
ellipsoid grows with their median distance, and the covariance with what is left over.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from anchors.lie import Array, quat_conjugate, quat_log, quat_multiply, quat_perturb
from anchors.uncertainty import Z999, chi2_quantile

_CHI2_3_MEDIAN: Final = 2.366
_CHI2_3_999: Final = 16.266
_MAX_SCATTER: Final = 100.0  # variance ratio beyond which it is no longer noise


@dataclass(frozen=True)
class MergedObservation:
    """Observations of one anchor from one viewpoint as one: mean `T_tracking_anchor` (`p`, `q`), its covariance (6, 6)
    in tracking axes, how many agree (`n`) and how many there were (`of`)."""

    p: Array
    q: Array
    covariance: Array
    n: int
    n_total: int


def merge_poses(p: Array, q: Array, common: Array, each: Array, min_agreeing: float) -> MergedObservation | None:
    """Robust mean of poses `T_tracking_anchor`, positions (n, 3) and quaternions (n, 4).

    `common`, `each`: covariance (6, 6) of the error that all share, and of the one that is new in each. `None` when
    less than the share `min_agreeing` of them agree.
    """
    count = len(p)
    towards = q @ q[0]
    centre = fast_median(q if float(towards.min()) >= 0.0 else np.where(towards[:, None] < 0.0, -q, q))
    norm = math.sqrt(float(centre @ centre))
    if norm < 0.1:
        return None  # orientations all over the sphere
    centre = centre / norm
    x = np.empty((2, count, 3))  # positions, and turns from the median
    x[0], x[1] = p, quat_log(quat_multiply(q, quat_conjugate(centre)))
    about = fast_median(x)
    x -= about[:, None, :]
    information = np.linalg.inv(np.array([each[:3, :3], each[3:, 3:]]))
    d2 = np.add.reduce((x @ information) * x, axis=2)  # (2, n)
    bounds = [_CHI2_3_999 * min(max(m / _CHI2_3_MEDIAN, 1.0), _MAX_SCATTER) for m in fast_median(d2.T).tolist()]
    keep = ((d2[0] <= bounds[0]) & (d2[1] <= bounds[1])).astype(np.float64)
    n = int(keep.sum())
    if n == 0 or n < min_agreeing * count:
        return None
    mean = keep @ x / n
    # About the mean, from that about the median.
    chi2 = d2 @ keep - n * np.add.reduce((mean[:, None, :] @ information)[:, 0, :] * mean, axis=1)
    wider = _excess(chi2.tolist(), n)
    covariance = common + each / n
    if wider is not None:
        covariance = covariance * wider[:, None] * wider
    mean += about
    return MergedObservation(mean[0], quat_perturb(centre, mean[1]), covariance, n, count)


def fast_median(x: Array) -> Array:
    """Median over the last but one axis (numpy's own costs more than everything else here)."""
    n = x.shape[-2]
    x = np.sort(x, axis=-2)
    return np.asarray(0.5 * (x[..., (n - 1) // 2, :] + x[..., n // 2, :]))


def _excess(chi2: list[float], n: int) -> Array | None:
    """By what factors standard deviations are larger than stated, `None` unless chi-square says so at 99.9 %: never
    narrower, that so few residuals happen to be small proves nothing."""
    freedom = 3.0 * (n - 1)
    if freedom < 1.0:
        return None
    bound = chi2_quantile(freedom, Z999)
    if max(chi2) <= bound:
        return None
    return np.repeat([math.sqrt(c / freedom) if c > bound else 1.0 for c in chi2], 3)


def circular_median(angles: Array) -> float:
    """The angle among `angles` with the least sum of absolute differences: unharmed by a minority of outliers."""
    differences = np.abs((angles[:, None] - angles[None, :] + math.pi) % (2.0 * math.pi) - math.pi)
    return float(angles[int(np.argmin(np.sum(differences, axis=1)))])
