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
from numpy.typing import NDArray

from anchors.lie import Array, quat_conjugate, quat_exp, quat_log, quat_multiply
from anchors.uncertainty import Z99, chi2_quantile

_CHI2_3_MEDIAN: Final = 2.366
_CHI2_3_999: Final = 16.266
_MAX_SCATTER: Final = 100.0  # variance ratio beyond which it is no longer noise


@dataclass(frozen=True)
class Merged:
    """Observations of one anchor from one viewpoint as one: mean `T_tracking_anchor` (`p`, `q`), its covariance (6, 6)
    in tracking axes, how many agree (`n`) and how many there were (`of`)."""

    p: Array
    q: Array
    covariance: Array
    n: int
    of: int


def merge(p: Array, q: Array, common: Array, each: Array, min_agreeing: float) -> Merged | None:
    """Robust mean of poses `T_tracking_anchor`, positions (n, 3) and quaternions (n, 4).

    `common`, `each`: covariance (6, 6) of the error that all share, and of the one that is new in each. `None` when
    less than the share `min_agreeing` of them agree.
    """
    count = len(p)
    centre = np.where((q @ q[0])[:, None] < 0.0, -q, q)
    centre_q = np.median(centre, axis=0)
    norm = math.sqrt(float(centre_q @ centre_q))
    if norm < 0.1:
        return None  # orientations all over the sphere
    centre_q = centre_q / norm
    turns = quat_log(quat_multiply(q, quat_conjugate(centre_q)))
    keep = _within(p, each[:3, :3]) & _within(turns, each[3:, 3:])
    n = int(np.count_nonzero(keep))
    if n == 0 or n < min_agreeing * count:
        return None
    p_kept, turns_kept = p[keep], turns[keep]
    p_mean, turn_mean = p_kept.mean(axis=0), turns_kept.mean(axis=0)
    covariance = common + each / n
    wider = np.ones(6)
    wider[:3] = math.sqrt(_excess(p_kept - p_mean, each[:3, :3]))
    wider[3:] = math.sqrt(_excess(turns_kept - turn_mean, each[3:, 3:]))
    covariance = covariance * wider[:, None] * wider
    return Merged(p_mean, quat_multiply(quat_exp(turn_mean), centre_q), covariance, n, count)


def _within(x: Array, cov: Array) -> NDArray[np.bool_]:
    """Which of `x` (n, 3) lie within the 99.9 % ellipsoid of their scatter, at least that of `cov`, about the
    median."""
    d2 = _distance2(x - np.median(x, axis=0), cov)
    scatter = min(max(1.0, float(np.median(d2)) / _CHI2_3_MEDIAN), _MAX_SCATTER)
    return np.asarray(d2 <= _CHI2_3_999 * scatter)


def _excess(residuals: Array, cov: Array) -> float:
    """By what factor the variance is larger than stated; 1 unless chi-square says so at 99 %: never narrower, that so
    few residuals happen to be small proves nothing."""
    freedom = 3.0 * (len(residuals) - 1)
    if freedom < 1.0:
        return 1.0
    chi2 = float(np.sum(_distance2(residuals, cov)))
    return chi2 / freedom if chi2 > chi2_quantile(freedom, Z99) else 1.0


def _distance2(x: Array, cov: Array) -> Array:
    """Squared Mahalanobis distances of rows (n, 3)."""
    return np.asarray(np.sum((x @ np.linalg.inv(cov)) * x, axis=1))


def circular_median(angles: Array) -> float:
    """The angle among `angles` with the least sum of absolute differences: unharmed by a minority of outliers."""
    differences = np.abs((angles[:, None] - angles[None, :] + math.pi) % (2.0 * math.pi) - math.pi)
    return float(angles[int(np.argmin(np.sum(differences, axis=1)))])
