"""Estimates `T_world_tracking` of one headset from observations of anchors whose world pose is known.

First useful form: 4 degrees of freedom (yaw and translation; headset frames and the world are gravity-aligned to about
0.2 deg), robust against wrong detections, with a covariance that counts what is systematic within one viewpoint once.
Pure: time and observations are passed in, nothing is read.

Two stages. (1) Observations of one anchor from one viewpoint share half of their variance, so they are merged into one
by a robust mean with covariance `S * (1/2 + 1/(2 n))`. (2) Merged observations are solved together by iteratively
reweighted Gauss-Newton over (yaw, x, y, z): the position of each anchor and its yaw are the residuals, weights are
those of Tukey's biweight (a redescending loss: mirrored poses get weight zero; Huber 2009, section 4.8).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from anchors.pose import PoseTuple, Vec3, compose, inverse, quat_from_yaw, quat_rotate

Array = NDArray[np.float64]

_TUKEY: Final = 4.685  # 95 % efficiency for Gaussian noise


@dataclass(frozen=True)
class AlignmentConfig:
    """Bounds and noise model of the estimator.

    `position_sigma_m` and `rotation_sigma_rad` are used per axis when an observation carries no covariance.
    `tilt_sigma_rad`: how far a headset's vertical may be off. `max_error_m`: the stated p95 at the anchor above which
    the estimate is refused. `max_observations`: the oldest are forgotten (counted in `forgotten`).
    """

    position_sigma_m: float = 0.005
    rotation_sigma_rad: float = math.radians(0.6)
    tilt_sigma_rad: float = math.radians(0.2)
    tilt_warning_rad: float = math.radians(1.0)
    max_error_m: float = 0.03
    min_observations: int = 5
    max_observations: int = 600
    max_iterations: int = 20


@dataclass(frozen=True)
class AlignmentEstimate:
    """Result, or the reason why there is none (`refused`, with `advice` for the person who wears the headset).

    `covariance`: 36 values, 6x6 row-major, order (x, y, z [m], rx, ry, rz [rad]), world frame, at `pivot_world`.
    """

    T_world_tracking: PoseTuple
    tracking_epoch: int
    covariance: tuple[float, ...]
    pivot_world: Vec3
    error_at_anchor_m: float
    residual_tilt_rad: float
    n_observations: int
    n_viewpoints: int
    refused: bool
    advice: str


@dataclass(frozen=True)
class _Observation:
    anchor_id: str
    viewpoint_id: int
    p_tracking_anchor: Array  # (3,)
    T_world_tracking_yaw: float
    tilt_rad: float
    position_var: float  # per axis [m^2]
    yaw_var: float  # [rad^2]


@dataclass(frozen=True)
class _Merged:
    p_world_anchor: Array
    p_tracking_anchor: Array
    yaw: float
    position_var: float
    yaw_var: float
    n: int


def position_error_p95(covariance: tuple[float, ...], pivot_world: Vec3, point_world: Vec3) -> float:
    """Stated 95 % bound [m] of the position error at `point_world`, lever arm from `pivot_world` included.

    The squared length of a Gaussian error is approximated by a scaled chi-square with the same mean and variance
    (Satterthwaite), its quantile by Wilson and Hilferty.
    """
    cov = np.asarray(covariance, dtype=np.float64).reshape(6, 6)
    rx, ry, rz = (point_world[i] - pivot_world[i] for i in range(3))
    # d(point) = d(pivot) + rot x r  =>  J = [I, -[r]x]
    J = np.array(
        [
            [1.0, 0.0, 0.0, 0.0, rz, -ry],
            [0.0, 1.0, 0.0, -rz, 0.0, rx],
            [0.0, 0.0, 1.0, ry, -rx, 0.0],
        ]
    )
    S = J @ cov @ J.T
    mean = float(np.trace(S))
    if mean <= 0.0:
        return 0.0
    variance = 2.0 * float(np.sum(S * S))
    scale = variance / (2.0 * mean)
    dof = 2.0 * mean * mean / variance
    chi2 = dof * (1.0 - 2.0 / (9.0 * dof) + 1.6449 * math.sqrt(2.0 / (9.0 * dof))) ** 3
    return math.sqrt(scale * chi2)


def wrap_angle(a: float) -> float:
    """Angle in (-pi, pi]."""
    return math.remainder(a, 2.0 * math.pi)


@dataclass
class AlignmentEstimator:
    """Collects observations of one headset; `estimate()` solves what is there. A new `tracking_epoch` starts anew."""

    anchors: Mapping[str, PoseTuple]
    config: AlignmentConfig = field(default_factory=AlignmentConfig)
    tracking_epoch: int = 0
    unknown_anchors: int = 0
    stale_epochs: int = 0
    invalid: int = 0
    forgotten: int = 0
    _observations: list[_Observation] = field(default_factory=list)

    def add(
        self,
        anchor_id: str,
        T_tracking_anchor: PoseTuple,
        capture_ns: int,
        tracking_epoch: int,
        viewpoint_id: int = 0,
        quality: float = 1.0,
        size_m: float = 0.0,
        covariance: tuple[float, ...] = (),
    ) -> bool:
        """Takes one observation. False when it is not used: unknown anchor, older epoch, or not a rigid transform."""
        T_world_anchor = self.anchors.get(anchor_id)
        if T_world_anchor is None:
            self.unknown_anchors += 1
            return False
        if tracking_epoch < self.tracking_epoch:
            self.stale_epochs += 1
            return False
        p, q = T_tracking_anchor
        norm = math.sqrt(sum(c * c for c in q))
        if not all(map(math.isfinite, (*p, *q, quality))) or abs(norm - 1.0) > 1e-2 or max(map(abs, p)) > 1e3:
            self.invalid += 1
            return False
        if tracking_epoch > self.tracking_epoch:
            self.tracking_epoch = tracking_epoch
            self._observations.clear()
        yaw, tilt = _yaw_and_tilt(T_world_anchor, (p, (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)))
        position_var, yaw_var = self._variances(covariance, quality)
        if len(self._observations) >= self.config.max_observations:
            del self._observations[0]
            self.forgotten += 1
        self._observations.append(_Observation(anchor_id, viewpoint_id, np.array(p), yaw, tilt, position_var, yaw_var))
        return True

    def _variances(self, covariance: tuple[float, ...], quality: float) -> tuple[float, float]:
        default = (self.config.position_sigma_m**2, self.config.rotation_sigma_rad**2)
        if len(covariance) == 36 and all(map(math.isfinite, covariance)):
            position = (covariance[0] + covariance[7] + covariance[14]) / 3.0
            rotation = (covariance[21] + covariance[28] + covariance[35]) / 3.0
            if position > 0.0 and rotation > 0.0:
                # Nobody is better than this: printing and mounting of a sheet alone.
                return max(position, 1e-8), max(rotation, 1e-7)
        weight = min(max(quality, 0.05), 1.0)
        return default[0] / weight, default[1] / weight

    def estimate(self) -> AlignmentEstimate:
        """Solves all observations of the current epoch. Cost grows with their number, bounded by the configuration."""
        if len(self._observations) < self.config.min_observations:
            return self._refusal("look at the anchor sheet for a few seconds, from about half a metre")
        merged = self._merge()
        yaw, t_world, weights, H = _solve(merged, self.config.max_iterations)
        used = [m for m, w in zip(merged, weights, strict=True) if w > 0.05]
        if sum(m.n for m in used) < self.config.min_observations:
            return self._refusal("the observations of the anchor contradict each other: step closer, hold still")
        T_world_tracking: PoseTuple = (
            (float(t_world[0]), float(t_world[1]), float(t_world[2])),
            quat_from_yaw(yaw),
        )
        pivot = np.mean([m.p_world_anchor for m in used], axis=0)
        pivot_world = (float(pivot[0]), float(pivot[1]), float(pivot[2]))
        covariance = self._covariance(H, pivot, t_world)
        error = position_error_p95(covariance, pivot_world, pivot_world)
        tilt = float(np.median([o.tilt_rad for o in self._observations]))
        advice, refused = "", False
        if error > self.config.max_error_m:
            refused, advice = True, f"the error would be {error * 1e3:.0f} mm: step closer to the sheet"
        elif tilt > self.config.tilt_warning_rad:
            advice = f"the headset's vertical is off by {math.degrees(tilt):.1f} deg: is the sheet level as configured?"
        return AlignmentEstimate(
            T_world_tracking,
            self.tracking_epoch,
            covariance,
            pivot_world,
            error,
            tilt,
            len(self._observations),
            len({o.viewpoint_id for o in self._observations}),
            refused,
            advice,
        )

    def _merge(self) -> list[_Merged]:
        groups: dict[tuple[str, int], list[_Observation]] = {}
        for o in self._observations:
            groups.setdefault((o.anchor_id, o.viewpoint_id), []).append(o)
        merged = []
        for (anchor_id, _), group in groups.items():
            p = np.array([o.p_tracking_anchor for o in group])
            yaws = np.array([o.T_world_tracking_yaw for o in group])
            position_var = float(np.mean([o.position_var for o in group]))
            yaw_var = float(np.mean([o.yaw_var for o in group]))
            centre = np.median(p, axis=0)
            yaw0 = _circular_median(yaws)
            dy = np.array([wrap_angle(float(y) - yaw0) for y in yaws])
            w = _tukey(np.linalg.norm(p - centre, axis=1) / math.sqrt(3.0 * position_var))
            w = w * _tukey(np.abs(dy) / math.sqrt(yaw_var))
            total = float(np.sum(w))
            if total < 1.0:
                continue
            share = 0.5 + 0.5 / total  # half of each variance is common to the viewpoint
            merged.append(
                _Merged(
                    np.array(self.anchors[anchor_id][0]),
                    (w @ p) / total,
                    yaw0 + float(w @ dy) / total,
                    position_var * share,
                    yaw_var * share,
                    int(np.count_nonzero(w > 0.05)),
                )
            )
        return merged

    def _covariance(self, H: Array, pivot: Array, t_world: Array) -> tuple[float, ...]:
        """6x6 at the pivot from the 4x4 information `H` over (yaw about the origin of tracking, x, y, z)."""
        S4 = np.linalg.inv(H)
        rx, ry = float(pivot[0] - t_world[0]), float(pivot[1] - t_world[1])
        J = np.array([[-ry, 1.0, 0.0, 0.0], [rx, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0]])
        S = J @ S4 @ J.T  # order x, y, z, yaw at the pivot
        cov = np.zeros((6, 6))
        index = [0, 1, 2, 5]
        cov[np.ix_(index, index)] = S
        cov[3, 3] = cov[4, 4] = self.config.tilt_sigma_rad**2
        return tuple(float(v) for v in cov.ravel())

    def _refusal(self, advice: str) -> AlignmentEstimate:
        identity: PoseTuple = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        viewpoints = len({o.viewpoint_id for o in self._observations})
        n = len(self._observations)
        return AlignmentEstimate(
            identity, self.tracking_epoch, (0.0,) * 36, (0.0, 0.0, 0.0), math.inf, 0.0, n, viewpoints, True, advice
        )


def _yaw_and_tilt(T_world_anchor: PoseTuple, T_tracking_anchor: PoseTuple) -> tuple[float, float]:
    """Yaw of `T_world_tracking` as this one observation has it, and the tilt [rad] that yaw does not explain."""
    _, q = compose(T_world_anchor, inverse(T_tracking_anchor))
    # Swing-twist about Z: the twist is (w, 0, 0, z) normalised; what is left over is the swing (tilt).
    yaw = 2.0 * math.atan2(q[3], q[0])
    up = quat_rotate(q, (0.0, 0.0, 1.0))
    tilt = math.atan2(math.hypot(up[0], up[1]), up[2])
    return wrap_angle(yaw), tilt


def _circular_median(angles: Array) -> float:
    """The angle among `angles` with the least sum of absolute differences: unharmed by a minority of outliers."""
    candidates = angles if len(angles) <= 64 else angles[:: len(angles) // 64]
    differences = np.abs((candidates[:, None] - angles[None, :] + math.pi) % (2.0 * math.pi) - math.pi)
    return float(candidates[int(np.argmin(np.sum(differences, axis=1)))])


def _tukey(standardized: Array) -> Array:
    """Tukey's biweight of residuals in units of their sigma."""
    u = np.minimum(np.abs(standardized) / _TUKEY, 1.0)
    return np.asarray((1.0 - u * u) ** 2, dtype=np.float64)


def _solve(merged: list[_Merged], max_iterations: int) -> tuple[float, Array, Array, Array]:
    """Robust Gauss-Newton over (yaw, t). Returns yaw, t_world (3,), weights (m,), information H (4, 4)."""
    if not merged:
        return 0.0, np.zeros(3), np.zeros(0), np.eye(4)
    p_w = np.array([m.p_world_anchor for m in merged])
    p_t = np.array([m.p_tracking_anchor for m in merged])
    yaws = np.array([m.yaw for m in merged])
    ip = 1.0 / np.array([m.position_var for m in merged])
    iy = 1.0 / np.array([m.yaw_var for m in merged])
    yaw = _circular_median(yaws)
    t = np.median(p_w - _rotate_z(yaw, p_t), axis=0)
    weights = np.ones(len(merged))
    H = np.eye(4)
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
    return yaw, t, weights, H


def _rotate_z(yaw: float, points: Array) -> Array:
    """Points (n, 3) turned about Z by `yaw`."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1], points[:, 2]], axis=1)
