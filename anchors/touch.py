"""Alignment by touching marked points with the calibrated tip of a controller, or with a fingertip.

Collinear points do not determine the alignment, and points touched in the wrong order do not fit; the advice names
the points, and the one to touch next. The order that was touched is found by trying the others. What is wrong in the
calibration of a tip is wrong in all of its touches, turned with the controller; the noise of each mark is its own, and
touching it again does not reduce it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, permutations
from typing import Final

import numpy as np

from anchors.alignment import AlignmentConfig, AlignmentEstimate
from anchors.lie import Array, quat_exp, quat_multiply, quat_to_matrix, skew, swing, to_quat, to_vec3
from anchors.pose import IDENTITY_POSE, Quat, Vec3, distance, inverse
from anchors.solver import to_world_covariance
from anchors.uncertainty import Z99, chi2_quantile, position_error_p95

_CHI2_3_999: Final = 16.266
_MAX_PERMUTED: Final = 6  # of more points only pairs are tried in exchange
_MIN_WIDTH_M: Final = 0.05  # how far a point must lie beside the line through the others
_MIN_EXTENT_M: Final = 0.10  # how far apart the outermost points must lie
_REACH_M: Final = 1e3  # no tracking frame is larger
_MAX_LISTED: Final = 5  # wrong distances that are listed, the largest first
TOUCH_SIGMA_M: Final = 0.0015
_NO_TIP: Final = (0.0,) * 9


@dataclass(frozen=True)
class Touch:
    """The tip rested on a marked point: `p_tracking_tip` averaged over that time.

    `sigma_m`: noise of this touch per axis. `tip`: the device that touched; if the covariance of its tip is known, that
    counts too, turned by `q_tracking_tip`, the rotation of that controller. `capture_ns`: when it touched.
    """

    point: str
    p_tracking_tip: Vec3
    sigma_m: float = TOUCH_SIGMA_M
    tip: str = ""
    q_tracking_tip: Quat = IDENTITY_POSE[1]
    capture_ns: int = 0


@dataclass(frozen=True)
class TouchNoise:
    """Noise of n touched points: `covariance` (3n, 3n) [m^2] in tracking axes."""

    covariance: Array
    information: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "information", np.asarray(np.linalg.inv(self.covariance)))

    @staticmethod
    def of_touches(touches: Sequence[Sequence[Touch]], tips: Mapping[str, Sequence[float]]) -> TouchNoise:
        """Return the noise of the mean of the touches of each point; `tips`: covariances of tips, 3x3 row-major.

        Touches of one point share their error: it may be one contact that was reported in several frames, and a tracker
        is wrong by the same at the same place.
        """
        n = len(touches)
        C = np.diag(np.repeat([sum(t.sigma_m**2 for t in same) / len(same) for same in touches], 3))
        for tip, stated in tips.items():
            turn = np.zeros((n, 3, 3))
            for i, same in enumerate(touches):
                turned = [quat_to_matrix(np.array(t.q_tracking_tip)) for t in same if t.tip == tip]
                turn[i] = np.sum(turned, axis=0) / len(same) if turned else 0.0
            G = turn.reshape(3 * n, 3)
            C = C + G @ np.reshape(stated, (3, 3)) @ G.T
        return TouchNoise(C)

    @property
    def sigma(self) -> Array:
        """Standard deviation of each point (n,) [m], the mean of its axes."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance).reshape(-1, 3).mean(axis=1)))

    def select(self, points: Sequence[int]) -> TouchNoise:
        """Return the noise of some of the points."""
        index = (3 * np.array(points)[:, None] + np.arange(3)).ravel()
        return TouchNoise(self.covariance[np.ix_(index, index)])


@dataclass(frozen=True)
class TouchRegistration:
    """The alignment and the residual of each touched point [m]. `suspects`: points that caused a refusal."""

    estimate: AlignmentEstimate
    residuals_m: dict[str, float]
    suspects: tuple[str, ...] = ()


def register_touches(
    points_world: Mapping[str, Vec3],
    touches: Sequence[Touch],
    tracking_epoch: int = 0,
    tips: Mapping[str, Sequence[float]] | None = None,
    config: AlignmentConfig | None = None,
) -> TouchRegistration:
    """Estimate `T_world_tracking` from at least three touched points.

    Args:
        points_world: Positions of the marks.
        touches: Touches in the tracking frame, any number per mark.
        tracking_epoch: Tracking frame of the touches.
        tips: Covariance of each calibrated tip, 3x3 row-major in the frame of its controller [m^2].
        config: Bounds, as for the estimate by sheets.

    Returns:
        The alignment, or a refusal whose advice names what is wrong.
    """
    config = config or AlignmentConfig()
    wrong = [t for t in touches if t.point not in points_world or not all(abs(c) <= _REACH_M for c in t.p_tracking_tip)]
    if wrong:
        known = ", ".join(sorted(points_world))
        return _refuse(tracking_epoch, f"point '{wrong[0].point}' is not marked, or was not read; marked are {known}")
    tips = tips or {}
    names = sorted({t.point for t in touches})
    if len(names) < 3:
        left = ", ".join(sorted(set(points_world) - set(names)))
        return _refuse(tracking_epoch, f"{len(names)} points touched, 3 are needed; not yet touched: {left}")
    world = np.array([points_world[name] for name in names])
    next_point = suggest_point(points_world, names)
    extent = max(distance(points_world[a], points_world[b]) for a, b in combinations(names, 2))
    if extent < _MIN_EXTENT_M:
        mend = f"touch '{next_point}' next" if next_point else f"mark one {_MIN_EXTENT_M * 1e3:.0f} mm away"
        text = f"points {', '.join(names)} lie within {extent * 1e3:.0f} mm, too close to tell a rotation: {mend}"
        return _refuse(tracking_epoch, text, names)
    in_line = _describe_collinear(names, world, next_point)
    if in_line:
        return _refuse(tracking_epoch, in_line, names)
    by_name = [[t for t in touches if t.point == name] for name in names]
    inconsistent = [name for name, same in zip(names, by_name, strict=True) if _has_inconsistent_touches(same, tips)]
    if inconsistent:
        return _refuse(
            tracking_epoch, f"point '{inconsistent[0]}' was touched in two places: touch it again", inconsistent
        )
    tip = np.array([np.mean([t.p_tracking_tip for t in same], axis=0) for same in by_name])
    noise = TouchNoise.of_touches(by_name, tips)
    fit = _fit(world, tip, noise, config)
    residuals = {name: float(r) for name, r in zip(names, np.linalg.norm(fit.residuals, axis=1), strict=True)}
    if not fit.good:
        advice, suspects = _diagnose(names, world, tip, noise, config)
        return TouchRegistration(AlignmentEstimate.refusal(tracking_epoch, advice, len(touches)), residuals, suspects)
    alike = _find_symmetry(names, world, noise, config)
    found = _estimate(fit, world, tracking_epoch, len(touches), config, alike, next_point)
    return TouchRegistration(found, residuals)


def suggest_point(points_world: Mapping[str, Vec3], touched: Sequence[str]) -> str:
    """Return the point to touch next: of those not touched, the one that spreads the set most; empty if all are.

    Points that lie further from the line through the touched ones determine the rotation better.
    """
    left = sorted(set(points_world) - set(touched))
    if not touched or not left:
        return left[0] if left else ""
    known = [points_world[name] for name in touched if name in points_world]
    if len(known) < 2:
        return max(left, key=lambda name: distance(points_world[name], known[0]) if known else 0.0)

    def spread(name: str) -> float:
        points = np.array([*known, points_world[name]])
        return float(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1])

    return max(left, key=spread)


def _has_inconsistent_touches(same: Sequence[Touch], tips: Mapping[str, Sequence[float]]) -> bool:
    """Return whether the touches of one point lie further apart than their noise."""
    p = np.array([t.p_tracking_tip for t in same])
    variance = max(t.sigma_m**2 + float(np.trace(np.reshape(tips.get(t.tip, _NO_TIP), (3, 3)))) for t in same)
    return float(np.max(np.linalg.norm(p - p.mean(axis=0), axis=1))) > 4.0 * math.sqrt(2.0 * variance)


@dataclass(frozen=True)
class _Fit:
    q: Array  # T_tracking_world
    t: Array
    covariance: Array  # (6, 6) tracking axes
    residuals: Array  # (n, 3)
    chi2: float
    freedom: float
    good: bool


def _fit(world: Array, tip: Array, noise: TouchNoise, config: AlignmentConfig) -> _Fit:
    """Solve `tip = R world + t` by Gauss-Newton with gravity as in `anchors.solver`; the initial guess is level (`dof`
    4) or Kabsch's (6)."""
    gravity = 1.0 / config.tilt_sigma_rad**2 if config.dof == 4 else 0.0
    sigma, W = noise.sigma, noise.information
    q = _fit_yaw(world, tip, sigma) if gravity else _fit_rotation(world, tip, sigma)
    w = 1.0 / sigma**2
    centre = w @ world / np.sum(w)
    t = w @ tip / np.sum(w) - quat_to_matrix(q) @ centre
    H = np.eye(6)
    for _ in range(8):
        turned = world @ quat_to_matrix(q).T
        r = tip - turned - t
        J = np.concatenate([np.broadcast_to(np.eye(3), (len(world), 3, 3)), -skew(turned)], axis=2).reshape(-1, 6)
        H = J.T @ W @ J
        g = J.T @ W @ r.ravel()
        H[3, 3] += gravity
        H[4, 4] += gravity
        g[3:5] -= gravity * swing(q)
        step = np.linalg.solve(H, g)
        t = t + step[:3]
        q = quat_multiply(quat_exp(step[3:]), q)
        if float(np.max(np.abs(step))) < 1e-10:
            break
    r = tip - world @ quat_to_matrix(q).T - t
    d2 = np.sum(r * r, axis=1) * w
    tilt2 = float(np.sum(swing(q) ** 2)) * gravity
    freedom = 3.0 * len(world) - (4.0 if gravity else 6.0)
    chi2 = float(r.ravel() @ W @ r.ravel()) + tilt2
    good = bool(np.all(d2 <= _CHI2_3_999)) and tilt2 <= _CHI2_3_999 and chi2 <= 2.0 * chi2_quantile(freedom, Z99)
    return _Fit(q, t, np.asarray(np.linalg.inv(H), dtype=np.float64), r, chi2, freedom, good)


def _fit_yaw(world: Array, tip: Array, sigma: Array) -> Array:
    """Return the best rotation (4,) about Z: planar Procrustes."""
    w = 1.0 / sigma**2
    a, b = world - w @ world / np.sum(w), tip - w @ tip / np.sum(w)
    cross = float(w @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
    dot = float(w @ (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]))
    return quat_exp(np.array([0.0, 0.0, math.atan2(cross, dot)]))


def _fit_rotation(world: Array, tip: Array, sigma: Array) -> Array:
    """Return the best rotation (4,) of centred points (Kabsch 1976)."""
    from scipy.spatial.transform import Rotation

    w = 1.0 / sigma**2
    a, b = world - w @ world / np.sum(w), tip - w @ tip / np.sum(w)
    return np.roll(Rotation.align_vectors(b, a, w)[0].as_quat(), 1)


def _describe_collinear(names: Sequence[str], world: Array, next_point: str = "") -> str:
    """Return the advice for points on one line, with the point to touch next; empty if one lies well beside it."""
    centred = world - world.mean(axis=0)
    _, _, axes = np.linalg.svd(centred)
    beside = np.linalg.norm(centred - np.outer(centred @ axes[0], axes[0]), axis=1)
    spread = float(np.max(beside))
    if spread >= 0.5 * _MIN_WIDTH_M:
        return ""
    most = names[int(np.argmax(beside))]
    mend = f"touch '{next_point}' next, " if next_point else "mark and touch one "
    return (
        f"points {', '.join(names)} lie on one line ('{most}' is {spread * 1e3:.0f} mm beside it): {mend}"
        f"that lies at least {_MIN_WIDTH_M * 1e3:.0f} mm beside the others"
    )


def _diagnose(
    names: Sequence[str], world: Array, tip: Array, noise: TouchNoise, config: AlignmentConfig
) -> tuple[str, tuple[str, ...]]:
    """Return advice and suspects for points that do not fit: another order, or one touched elsewhere."""
    n = len(names)
    fits = [(order, _fit(world[list(order)], tip, noise, config)) for order in _likely_orders(world, tip, noise.sigma)]
    order, best = min(fits, key=lambda one: one[1].chi2, default=((), None))
    if best is not None and best.good:
        mixed = [i for i in range(n) if order[i] != i]
        swaps = ", ".join(f"'{names[i]}' was touched at '{names[order[i]]}'" for i in mixed)
        return f"points are mixed up: {swaps}; touch them again by their names", tuple(names[i] for i in mixed)
    if n > 3:
        alone = []
        for i in range(n):
            rest = [k for k in range(n) if k != i]
            if not _describe_collinear([names[k] for k in rest], world[rest]):
                fit = _fit(world[rest], tip[rest], noise.select(rest), config)
                if fit.good:
                    off = float(np.linalg.norm(tip[i] - quat_to_matrix(fit.q) @ world[i] - fit.t))
                    alone.append((fit.chi2, i, off))
        if alone:
            _, i, off = min(alone)
            return f"point '{names[i]}' is {off * 1e3:.0f} mm off: touch it again", (names[i],)
    return _diagnose_distances(names, world, tip, float(np.max(noise.sigma)))


def _find_symmetry(names: Sequence[str], world: Array, noise: TouchNoise, config: AlignmentConfig) -> str:
    """Return a warning if the layout is symmetric under a rotation about the vertical, so that a wrong order would not
    be noticed."""
    sigma = noise.sigma
    for order in _likely_orders(world, world, sigma):
        moved = world[list(order)]
        sides = np.linalg.norm(world - world.mean(axis=0), axis=1) - np.linalg.norm(moved - world.mean(axis=0), axis=1)
        if float(np.max(np.abs(sides))) < 4.0 * float(np.max(sigma)) and _fit(world, moved, noise, config).good:
            mixed = ", ".join(f"'{names[i]}'" for i in range(len(names)) if order[i] != i)
            return f"the marks {mixed} look the same in another order: move one by 50 mm, else a mix-up goes unnoticed"
    return ""


def _likely_orders(world: Array, tip: Array, sigma: Array) -> list[tuple[int, ...]]:
    """Return other orders that keep all distances between points within noise: no other can fit, since a rotation
    changes no distance. Fitting all orders would take seconds."""
    n = len(world)
    orders = np.array(_list_orders(n), dtype=np.int64).reshape(-1, n)
    marks = np.linalg.norm(world[:, None] - world, axis=2)
    tips = np.linalg.norm(tip[:, None] - tip, axis=2)
    slack = math.sqrt(_CHI2_3_999) * (sigma[:, None] + sigma)  # each may miss its mark by so much, see `_fit`
    off = np.abs(marks[orders[:, :, None], orders[:, None, :]] - tips)
    return [tuple(order) for order in orders[np.all(off <= slack, axis=(1, 2))].tolist()]


def _list_orders(n: int) -> list[tuple[int, ...]]:
    """Return orders other than the given one: all for few points, exchanged pairs for many."""
    identity = tuple(range(n))
    if n <= _MAX_PERMUTED:
        return [p for p in permutations(identity) if p != identity]
    out = []
    for i, j in combinations(range(n), 2):
        order = list(identity)
        order[i], order[j] = j, i
        out.append(tuple(order))
    return out


def _diagnose_distances(names: Sequence[str], world: Array, tip: Array, sigma: float) -> tuple[str, tuple[str, ...]]:
    """Return advice and suspects by distances: of three points, one is wrong if both of its distances are and the third
    is not."""
    bad = []
    for i, j in combinations(range(len(names)), 2):
        off = float(np.linalg.norm(tip[i] - tip[j])) - float(np.linalg.norm(world[i] - world[j]))
        if abs(off) > 3.3 * math.sqrt(2.0) * sigma:
            bad.append((i, j, off))
    shared = [k for k in range(len(names)) if bad and all(k in (i, j) for i, j, _ in bad)]
    if len(bad) > 1 and len(shared) == 1:
        return f"point '{names[shared[0]]}' does not fit the others: touch it again", (names[shared[0]],)
    worst = sorted(bad, key=lambda one: -abs(one[2]))[:_MAX_LISTED]
    pairs = ", ".join(f"'{names[i]}'-'{names[j]}' by {off * 1e3:+.0f} mm" for i, j, off in worst)
    return (
        f"distances between points are wrong ({pairs or 'not any: the order is reversed'}): touch all of them again",
        tuple(names),
    )


def _estimate(
    fit: _Fit, world: Array, epoch: int, n: int, config: AlignmentConfig, alike: str, next_point: str
) -> AlignmentEstimate:
    """Return the fit in the form of an estimate by sheets."""
    pivot = world.mean(axis=0)
    wider = fit.chi2 / fit.freedom if fit.chi2 > chi2_quantile(fit.freedom, Z99) else 1.0
    covariance = tuple(float(v) for v in (wider * to_world_covariance(fit.q, fit.covariance, pivot)).ravel())
    at = to_vec3(pivot)
    error = position_error_p95(covariance, at, at)
    tilt = float(np.linalg.norm(swing(fit.q)))
    refused = not error <= config.max_error_m
    mend = f"touch '{next_point}' next" if next_point else "touch more points, further apart"
    return AlignmentEstimate(
        inverse((to_vec3(fit.t), to_quat(fit.q))),
        epoch,
        covariance,
        at,
        error,
        tilt,
        n,
        1,
        refused,
        f"the error would be {error * 1e3:.0f} mm: {mend}" if refused else alike,
    )


def _refuse(epoch: int, advice: str, suspects: Sequence[str] = ()) -> TouchRegistration:
    return TouchRegistration(AlignmentEstimate.refusal(epoch, advice), {}, tuple(suspects))
