"""Estimates `T_world_tracking` of one headset from observations of anchors whose world pose is known.

First useful form: 4 degrees of freedom (yaw and translation; headset frames and the world are gravity-aligned to about
0.2 deg), robust against wrong detections, with a covariance that counts what is systematic within one viewpoint once.
Pure: time and observations are passed in, nothing is read. How observations are merged and solved: `anchors.robust`.

Noise models are optimistic, so both stages check them against what is left over: residuals larger than stated widen
the covariance (Birge ratio: chi-square per degree of freedom). Where no majority agrees there is no result: fewer than
`min_agreeing` of one viewpoint's observations, or two viewpoints that chi-square tells apart at 99.9 %.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from anchors.pose import PoseTuple, Vec3, compose, inverse, quat_from_yaw, quat_rotate
from anchors.robust import Array, Merged, merge, solve, wrap_angle

_CHI2_4_999: Final = 18.467  # 99.9 % quantile of chi-square with 4 degrees of freedom
_CONTRADICT: Final = (
    "observations contradict each other: did the sheet move, or the headset lose tracking? hold still, look at the "
    "sheet again"
)


@dataclass(frozen=True)
class AlignmentConfig:
    """Bounds and noise model of the estimator.

    `position_sigma_m` and `rotation_sigma_rad` are used per axis when an observation carries no covariance.
    `tilt_sigma_rad`: how far a headset's vertical may be off. `max_error_m`: the stated p95 at the anchor above which
    the estimate is refused. `max_observations`: the oldest are forgotten (counted in `forgotten`), as are those older
    than the newest by more than `max_age_ns` (`outdated`): tracking drifts. `min_agreeing`: share of one viewpoint's
    observations that must agree. `size_tolerance`: by what share a sheet may measure otherwise than it should.
    """

    position_sigma_m: float = 0.005
    rotation_sigma_rad: float = math.radians(0.6)
    tilt_sigma_rad: float = math.radians(0.2)
    tilt_warning_rad: float = math.radians(1.0)
    max_error_m: float = 0.03
    min_observations: int = 5
    max_observations: int = 600
    max_age_ns: int = 600 * 1_000_000_000
    max_iterations: int = 20
    min_agreeing: float = 0.6
    size_tolerance: float = 0.03


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
    capture_ns: int
    size_m: float
    p_tracking_anchor: Array  # (3,)
    T_world_tracking_yaw: float
    tilt_rad: float
    position_var: float  # per axis [m^2]
    yaw_var: float  # [rad^2]


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


@dataclass
class AlignmentEstimator:
    """Collects observations of one headset; `estimate()` solves what is there. A new `tracking_epoch` starts anew.

    `anchors`: `T_world_anchor`. `sizes`: edge of the printed sheets [m], of those whose size is known.
    """

    anchors: Mapping[str, PoseTuple]
    config: AlignmentConfig = field(default_factory=AlignmentConfig)
    sizes: Mapping[str, float] = field(default_factory=dict)
    tracking_epoch: int = 0
    unknown_anchors: int = 0
    stale_epochs: int = 0
    invalid: int = 0
    forgotten: int = 0
    outdated: int = 0
    wrong_size: int = 0
    _misprint: str = ""
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
        """Takes one observation. False when it is not used: unknown anchor, older epoch, not a rigid transform, or a
        sheet of another size than it should have. `size_m` 0: not measured."""
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
            self._misprint = ""
        if not self._is_of_size(anchor_id, size_m):
            return False
        self._forget_outdated(capture_ns)
        yaw, tilt = _yaw_and_tilt(T_world_anchor, (p, (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)))
        position_var, yaw_var = self._variances(covariance, quality)
        if len(self._observations) >= self.config.max_observations:
            del self._observations[0]
            self.forgotten += 1
        self._observations.append(
            _Observation(anchor_id, viewpoint_id, capture_ns, size_m, np.array(p), yaw, tilt, position_var, yaw_var)
        )
        return True

    def _is_of_size(self, anchor_id: str, size_m: float) -> bool:
        """A sheet printed too large is seen too near: its pose is off by the same share."""
        size = self.sizes.get(anchor_id, 0.0)
        if size <= 0.0 or not size_m > 0.0 or abs(size_m - size) <= self.config.size_tolerance * size:
            return True
        self.wrong_size += 1
        self._misprint = (
            f"sheet '{anchor_id}' measures {size_m * 1e3:.0f} mm, not {size * 1e3:.0f} mm: printed at the wrong scale?"
        )
        return False

    def _forget_outdated(self, capture_ns: int) -> None:
        """What comes last counts, also when the sender's clock was set in between."""
        kept = [o for o in self._observations if abs(capture_ns - o.capture_ns) <= self.config.max_age_ns]
        self.outdated += len(self._observations) - len(kept)
        self._observations = kept

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
            return self._refusal(
                self._misprint or "look at the anchor sheet for a few seconds, from about half a metre"
            )
        merged, dropped = self._merge()
        yaw, t_world, weights, H, chi2 = solve(merged, self.config.max_iterations)
        used = [m for m, w in zip(merged, weights, strict=True) if w > 0.05]
        n_groups = len(merged) + dropped
        if 2 * len(used) <= n_groups or sum(m.n for m in used) < self.config.min_observations:
            return self._refusal(_CONTRADICT)
        if len(merged) == 2 and chi2 > _CHI2_4_999:  # with two there is no majority to trust
            return self._refusal(_CONTRADICT)
        # Never narrower: that so few residuals happen to be small proves nothing.
        freedom = 4.0 * float(np.sum(weights)) - 4.0
        H = H / max(1.0, chi2 / freedom if freedom > 0.0 else 1.0)
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
        else:
            advice = self._size_advice()
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

    def _size_advice(self) -> str:
        """Warns about a sheet that is seen in several sizes; single measurements that are off do not count."""
        sizes: dict[str, list[float]] = {}
        for o in self._observations:
            if o.size_m > 0.0 and math.isfinite(o.size_m):
                sizes.setdefault(o.anchor_id, []).append(o.size_m)
        for anchor_id, seen in sizes.items():
            low, high = np.quantile(seen, (0.1, 0.9))
            if high - low > self.config.size_tolerance * low:
                return (
                    f"sheet '{anchor_id}' is seen in different sizes: is there a second one, printed at another scale?"
                )
        return self._misprint

    def _merge(self) -> tuple[list[Merged], int]:
        """One merged observation per anchor and viewpoint, and the number of those whose observations do not agree."""
        groups: dict[tuple[str, int], list[_Observation]] = {}
        for o in self._observations:
            groups.setdefault((o.anchor_id, o.viewpoint_id), []).append(o)
        merged = []
        for (anchor_id, _), group in groups.items():
            one = merge(
                np.array(self.anchors[anchor_id][0]),
                np.array([o.p_tracking_anchor for o in group]),
                np.array([o.T_world_tracking_yaw for o in group]),
                float(np.mean([o.position_var for o in group])),
                float(np.mean([o.yaw_var for o in group])),
                self.config.min_agreeing,
            )
            if one is not None:
                merged.append(one)
        return merged, len(groups) - len(merged)

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
