"""Robust estimation of yaw and translation, the two stages behind `anchors.alignment`.

(1) Observations of one anchor from one viewpoint share half of their variance, so they are merged into one by a robust
mean with covariance `S * (1/2 + 1/(2 n))`. (2) Merged observations are solved together by iteratively reweighted
Gauss-Newton over (yaw, x, y, z): the position of each anchor and its yaw are the residuals, weights are those of
Tukey's biweight (a redescending loss: mirrored poses get weight zero; Huber 2009, section 4.8).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TUKEY: Final = 4.685  # 95 % efficiency for Gaussian noise
_MAX_SCATTER: Final = 10.0


@dataclass(frozen=True)
class Merged:
    """Observations of one anchor from one viewpoint as one. Variances per axis [m^2], [rad^2]; `n`: how many agree."""

    p_world_anchor: Array
    p_tracking_anchor: Array
    yaw: float
    position_var: float
    yaw_var: float
    n: int


def wrap_angle(a: float) -> float:
    """The same angle within [-pi, pi]."""
    return math.remainder(a, 2.0 * math.pi)


def merge(
    p_world_anchor: Array, p: Array, yaws: Array, position_var: float, yaw_var: float, min_agreeing: float
) -> Merged | None:
    """Robust mean of positions `p_tracking_anchor` (n, 3) and `yaws` (n,) of one viewpoint.

    `None` when less than the share `min_agreeing` of them agree. They scatter more than stated: the variance grows.
    """
    centre = np.median(p, axis=0)
    yaw0 = circular_median(yaws)
    dy = np.array([wrap_angle(float(y) - yaw0) for y in yaws])
    w = _tukey(_unscattered(np.linalg.norm(p - centre, axis=1) / math.sqrt(3.0 * position_var), 0.888))
    w = w * _tukey(_unscattered(np.abs(dy) / math.sqrt(yaw_var), 0.674))
    total, n = float(np.sum(w)), int(np.count_nonzero(w > 0.05))
    if total < 1.0 or n < min_agreeing * len(p):
        return None
    p_mean, dy_mean = (w @ p) / total, float(w @ dy) / total
    chi2 = float(w @ np.sum((p - p_mean) ** 2, axis=1)) / position_var + float(w @ (dy - dy_mean) ** 2) / yaw_var
    wider = max(1.0, chi2 / (4.0 * total - 4.0)) if total > 2.0 else 1.0
    share = wider * (0.5 + 0.5 / total)  # half of each variance is common to the viewpoint
    return Merged(p_world_anchor, p_mean, yaw0 + dy_mean, position_var * share, yaw_var * share, n)


def _unscattered(standardized: Array, expected: float) -> Array:
    """Residuals in units of the scatter there is, if that is larger than stated: the median shows it, `expected` is
    that of Gaussian noise as stated. Beyond ten times as large it is no longer noise."""
    return standardized / min(max(1.0, float(np.median(standardized)) / expected), _MAX_SCATTER)


def circular_median(angles: Array) -> float:
    """The angle among `angles` with the least sum of absolute differences: unharmed by a minority of outliers."""
    candidates = angles if len(angles) <= 64 else angles[:: len(angles) // 64]
    differences = np.abs((candidates[:, None] - angles[None, :] + math.pi) % (2.0 * math.pi) - math.pi)
    return float(candidates[int(np.argmin(np.sum(differences, axis=1)))])


def _tukey(standardized: Array) -> Array:
    """Tukey's biweight of residuals in units of their sigma."""
    u = np.minimum(np.abs(standardized) / _TUKEY, 1.0)
    return np.asarray((1.0 - u * u) ** 2, dtype=np.float64)


def solve(merged: list[Merged], max_iterations: int) -> tuple[float, Array, Array, Array, float]:
    """Robust Gauss-Newton over (yaw, t). Returns yaw, t_world (3,), weights (m,), information H (4, 4), chi-square."""
    if not merged:
        return 0.0, np.zeros(3), np.zeros(0), np.eye(4), 0.0
    p_w = np.array([m.p_world_anchor for m in merged])
    p_t = np.array([m.p_tracking_anchor for m in merged])
    yaws = np.array([m.yaw for m in merged])
    ip = 1.0 / np.array([m.position_var for m in merged])
    iy = 1.0 / np.array([m.yaw_var for m in merged])
    yaw = circular_median(yaws)
    t = np.median(p_w - _rotate_z(yaw, p_t), axis=0)
    weights = np.ones(len(merged))
    H, distance2 = np.eye(4), np.zeros(len(merged))
    for _ in range(max_iterations):
        turned = _rotate_z(yaw, p_t)
        r_p = p_w - turned - t
        r_y = np.array([wrap_angle(float(y) - yaw) for y in yaws])
        distance2 = np.sum(r_p * r_p, axis=1) * ip + r_y * r_y * iy
        if len(merged) > 2:  # with two there is no majority to trust
            weights = _tukey(np.sqrt(distance2 / 4.0))
        d = np.stack([-turned[:, 1], turned[:, 0], np.zeros(len(merged))], axis=1)  # d(turned)/d(yaw)
        wp, wy = weights * ip, weights * iy
        H = np.zeros((4, 4))
        H[0, 0] = np.sum(wp * np.sum(d * d, axis=1)) + np.sum(wy)
        H[0, 1:] = H[1:, 0] = wp @ d
        H[1:, 1:] = np.eye(3) * np.sum(wp)
        H += np.eye(4) * 1e-9
        g = np.concatenate([[np.sum(wp * np.sum(d * r_p, axis=1)) + np.sum(wy * r_y)], wp @ r_p])
        step = np.linalg.solve(H, g)
        yaw = wrap_angle(yaw + float(step[0]))
        t = t + step[1:]
        if float(np.max(np.abs(step))) < 1e-10:
            break
    return yaw, t, weights, H, float(weights @ distance2)


def _rotate_z(yaw: float, points: Array) -> Array:
    """Points (n, 3) turned about Z by `yaw`."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1], points[:, 2]], axis=1)
