"""Most probable `T_tracking_world` of one headset, given merged observations of anchors of known pose: the second stage
behind `anchors.alignment`.

Unknown are translation (3), rotation (3) and the drift of the tracking frame: its velocity (3) and its turn rate about
the vertical, through the middle of what was seen (1). Gravity is an observation
too: the tilt of the frame is zero with the stated sigma; so is the drift. Gauss-Newton on whitened residuals; where a
group does not fit, the largest set of groups that agree with one of them is solved instead, or all but one sheet, and
what then lies outside its 99.9 % ellipsoid is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from anchors.lie import (
    Array,
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_to_matrix,
    skew,
    swing,
)
from anchors.uncertainty import Z999, SourceBias, chi2_quantile
from anchors.viewpoints import MergedObservation, circular_median

_CHI2_6_999: Final = 22.458
_CHI2_3_999: Final = 16.266
_CHI2_2_999: Final = 13.816
_ITERATIONS: Final = 6
_STEADY_S: Final = 60.0  # for so long the drift is taken as steady, later the frame also wanders
N_FRAME: Final = 10  # translation, rotation, drift; errors of scale follow
_CONVERGED: Final = 2e-4  # [m], [rad]; with residuals of milliradians the step after would be below 1e-6
_MAX_LEFT_OUT: Final = 4  # sheets that are left out in turn
_MIN_SURE: Final = 2  # more sheets than this do not agree by chance
_EYE: Final = np.eye(6)
#: Of an error of scale that is an unknown, share of the distance: far beyond careful prints, so that data decide.
SCALE_SIGMA: Final = 0.03
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class AlignmentPrior:
    """Prior of the alignment, standard deviations per axis.

    `tilt_sigma_rad`: tilt against gravity, infinite to measure it. `drift_m_per_s`, `yaw_rad_per_s`: velocity and turn
    rate of the tracking frame. `walk_m_per_sqrt_s`, `yaw_walk_rad_per_sqrt_s`: its random walk.
    """

    tilt_sigma_rad: float
    drift_m_per_s: float
    walk_m_per_sqrt_s: float
    yaw_rad_per_s: float = 0.0
    yaw_walk_rad_per_sqrt_s: float = 0.0

    @property
    def gravity(self) -> bool:
        return math.isfinite(self.tilt_sigma_rad)


@dataclass(frozen=True)
class AlignmentProblem:
    """Merged observations as arrays, one row per group: anchor in the world, observed pose, age [s] (at most 0)."""

    anchor: tuple[str, ...]
    p_world: Array  # (G, 3)
    p: Array  # (G, 3) tracking
    q: Array  # (G, 4) T_tracking_world as each group alone has it
    covariance: Array  # (G, 6, 6)
    information: Array  # (G, 6, 6), the inverse
    age_s: Array  # (G,)
    yaw: Array  # (G, 6): shifts of the observed poses by a turn of the frame [1 rad]
    bias: Array  # (G, 6, K): shifts of the observed poses by one standard deviation of each of K common biases
    untested: Array  # (G, 6, U): the same, of the untested scale of each source
    sources: tuple[str, ...]  # (U,) their names
    tested: Array  # (U,) how well earlier looks have tested it: variance of the prior over that by the looks
    scale: Array | None = None  # (G, 6, S): lines of sight of what shares each of S unknown errors of scale

    @property
    def size(self) -> int:
        return len(self.age_s)


@dataclass(frozen=True)
class AlignmentSolution:
    """`T_tracking_world` at the time of the newest observation. `covariance` (6, 6) of translation and rotation
    (tracking axes, rotation on the left), `inside` (G,): which groups agree, `chi2` of those, `freedom` of that,
    `distance2` (G,) and `turns` (G, 3): how far each group is off, squared in units of its noise, and in rotation."""

    t: Array
    q: Array
    covariance: Array
    inside: Mask
    chi2: float
    freedom: float
    drift: Array
    distance2: Array
    turns: Array
    weighted: Array  # (6 G, 10 + S) information times Jacobian of the groups inside
    inverse: Array  # (10 + S, 10 + S) covariance of everything unknown
    scale: Array  # (S,) errors of scale, share of the distance
    tested: Array  # (U,) how well these looks, or earlier ones, test the scale of each source

    def measure_tilt(self, b: AlignmentProblem, tilt_sigma_rad: float) -> tuple[float, float]:
        """Return the tilt [rad] that the agreeing groups show together, without the gravity prior, and the 99.9 %
        quantile of what noise alone would show that way; `tilt_sigma_rad`: of the headset's vertical, per axis.
        """
        weight = self.inside / np.add.reduce(b.covariance[:, 3:, 3:].reshape(-1, 9)[:, ::4], axis=1)
        weight = weight / float(weight.sum())
        x, y = (_tilt(self.q) + weight @ self.turns[:, :2]).tolist()
        shift = np.tensordot(weight, b.bias[:, 3:5], 1)
        C = np.tensordot(weight**2, b.covariance[:, 3:5, 3:5], 1) + shift @ shift.T
        (xx, xy), (_, yy) = C.tolist()
        if not math.isfinite(tilt_sigma_rad):
            tilt_sigma_rad = 0.0
        xx, yy = xx + tilt_sigma_rad**2, yy + tilt_sigma_rad**2
        chi2 = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
        tilt = math.hypot(x, y)
        return tilt, tilt * math.sqrt(_CHI2_2_999 / chi2) if chi2 > 0.0 else 0.0


def build_problem(
    anchor: Sequence[str],
    p_world: Array,
    q_world: Array,
    merged: Sequence[MergedObservation],
    age_s: Array,
    prior: AlignmentPrior,
    biases: Mapping[str, SourceBias] = MappingProxyType({}),
    tested: Mapping[str, float] = MappingProxyType({}),
) -> AlignmentProblem:
    """Return merged observations as arrays. Older ones are less certain: the tracking frame wanders. `biases`: what all
    observations of one source share; `tested`: how well earlier looks have tested the scale of each."""
    # Joined, not stacked: of small arrays that takes a third of the time.
    p = np.concatenate([m.p for m in merged]).reshape(-1, 3)
    q = quat_multiply(np.concatenate([m.q for m in merged]).reshape(-1, 4), quat_conjugate(q_world))
    covariance = np.concatenate([m.covariance for m in merged]).reshape(-1, 6, 6)
    yaw = _compute_yaw_shifts(p)
    if float(age_s.min()) < -_STEADY_S:
        wandered_s = np.maximum(-age_s - _STEADY_S, 0.0)
        covariance[:, [0, 1, 2], [0, 1, 2]] += prior.walk_m_per_sqrt_s**2 * wandered_s[:, None]
        turned = prior.yaw_walk_rad_per_sqrt_s * np.sqrt(wandered_s)[:, None] * yaw
        covariance += turned[:, :, None] * turned[:, None, :]
    information = np.linalg.inv(covariance)
    sources = tuple(sorted({m.source for m in merged} & biases.keys()))
    bias, untested = _compute_biases(merged, biases, sources)
    known = np.array([tested.get(name, 0.0) for name in sources])
    return AlignmentProblem(
        tuple(anchor), p_world, p, q, covariance, information, age_s, yaw, bias, untested, sources, known
    )


def _compute_yaw_shifts(p: Array) -> Array:
    """Return by how much poses at `p` (G, 3) shift when the frame turns about the vertical through their middle."""
    arm = p - p.mean(axis=0)
    out = np.zeros((len(p), 6))
    out[:, 0], out[:, 1], out[:, 5] = -arm[:, 1], arm[:, 0], 1.0
    return out


def _compute_biases(
    merged: Sequence[MergedObservation], biases: Mapping[str, SourceBias], sources: tuple[str, ...]
) -> tuple[Array, Array]:
    """Return the shifts (G, 6, K) of all groups, and those (G, 6, U) by an untested scale; sources have no bias in
    common."""
    out, untested = np.zeros((len(merged), 6, 9 * len(sources))), np.zeros((len(merged), 6, len(sources)))
    for g, m in enumerate(merged):
        if m.source in sources:
            i = sources.index(m.source)
            out[g, :, 9 * i : 9 * i + 9] = biases[m.source].compute_shifts(m.p_head, m.p, m.q)
            if m.p_head is not None:
                untested[g, :3, i] = biases[m.source].untested_scale * (m.p - m.p_head)
    return out, untested


def select_groups(b: AlignmentProblem, which: Mask) -> AlignmentProblem:
    """Return the problem with some of its groups."""
    return replace(
        b,
        anchor=tuple(name for name, ok in zip(b.anchor, which.tolist(), strict=True) if ok),
        p_world=b.p_world[which],
        p=b.p[which],
        q=b.q[which],
        covariance=b.covariance[which],
        information=b.information[which],
        age_s=b.age_s[which],
        yaw=b.yaw[which],
        bias=b.bias[which],
        untested=b.untested[which],
        scale=None if b.scale is None else b.scale[which],
    )


def find_fitting_groups(b: AlignmentProblem, s: AlignmentSolution) -> Mask:
    """Return which groups that took no part agree with a solution (G,)."""
    r, _ = _residuals(b, s.q, s.t, s.drift)
    return np.asarray(np.einsum("gi,gij,gj->g", r, b.information, r) <= _CHI2_6_999)


def score_scale(b: AlignmentProblem, s: AlignmentSolution, columns: Array) -> Array:
    """Return how significant errors of scale (G, 6, S) are beside a solution without them, in standard deviations
    (S,): Rao's score test."""
    c = columns.reshape(-1, columns.shape[2])
    r, _ = _residuals(b, s.q, s.t, s.drift)
    weighted = (b.information @ columns * s.inside[:, None, None]).reshape(len(c), -1)
    mixed = s.weighted.T @ c
    information = np.sum(c * weighted, axis=0) - np.sum(mixed * (s.inverse @ mixed), axis=0)
    return np.asarray((weighted.T @ r.ravel()) / np.sqrt(np.maximum(information, 1e-12)))


def solve_with_scale(
    b: AlignmentProblem, prior: AlignmentPrior, near: tuple[Array, Array], columns: Array
) -> tuple[AlignmentProblem, AlignmentSolution]:
    """Return the problem with errors of scale (G, 6, S) as unknowns, and the solution by all groups that agree."""
    b = replace(b, scale=columns)
    return b, _refine_inliers(b, np.ones(b.size, dtype=bool), near, prior)


def solve_alignment(
    b: AlignmentProblem, prior: AlignmentPrior, near: tuple[Array, Array] | None = None
) -> AlignmentSolution:
    """Return the robust solution; `inside` is all false if there are only two groups and they disagree.

    `near`: rotation (4,) and translation (3,) of an earlier solution, used as the initial guess.
    """
    everyone = np.ones(b.size, dtype=bool)
    solution = _fit(b, everyone, near or _initial_guess(b, prior), prior)
    if bool(np.all(solution.distance2 <= _CHI2_6_999)) and (b.size != 2 or solution.chi2 <= _CHI2_6_999):
        return solution
    if b.size == 1:
        return solution
    if b.size == 2:
        return _reject_all(solution)
    inside, start = _consensus(b, prior)
    if not inside.any():  # each is tilted so far that it contradicts gravity
        return _reject_all(solution)
    found = _refine_inliers(b, inside, start, prior)
    if count_agreeing_anchors(b.anchor, found.inside) > _MIN_SURE and _is_likely(found):
        return found
    others = [one for one in _solve_without_sheet(b, solution, prior) if _is_likely(one)]
    return max([found, *others], key=lambda one: _votes(b, one.inside, one.chi2))


def _solve_without_sheet(
    b: AlignmentProblem, everyone: AlignmentSolution, prior: AlignmentPrior
) -> Iterator[AlignmentSolution]:
    """Yield solutions without one of the worst fitting sheets each, for three or more sheets.

    A sheet may have been moved so little that each other one alone agrees with it, since the rotation of one sheet
    determines the positions of the others badly.
    """
    off = dict.fromkeys(b.anchor, 0.0)
    for name, distance2 in zip(b.anchor, everyone.distance2.tolist(), strict=True):
        off[name] = max(off[name], distance2)
    if len(off) < 3:
        return
    start = _initial_guess(b, prior)
    for out in sorted(off, key=lambda name: -off[name])[:_MAX_LEFT_OUT]:
        yield _refine_inliers(b, np.array([name != out for name in b.anchor]), start, prior)


def _is_likely(s: AlignmentSolution) -> bool:
    """Return whether the residuals are explained by noise (chi-square below its 99.9 % quantile)."""
    return s.freedom > 0.0 and s.chi2 <= chi2_quantile(s.freedom, Z999)


def _refine_inliers(
    b: AlignmentProblem, inside: Mask, start: tuple[Array, Array], prior: AlignmentPrior
) -> AlignmentSolution:
    """Fit to the given inliers, then repeatedly to the groups that agree with the fit."""
    for _ in range(3):
        solution = _fit(b, inside, start, prior)
        now = solution.distance2 <= _CHI2_6_999
        if not now.any():
            return _reject_all(solution)
        if bool(np.all(now == inside)):
            break
        inside, start = now, (solution.q, solution.t)
    return solution


def median_tilt(b: AlignmentProblem) -> float:
    """Return the median tilt [rad] of the groups, each by itself and without the gravity prior."""
    middle = np.median(swing(b.q), axis=0)
    return math.hypot(float(middle[0]), float(middle[1]))


def _reject_all(s: AlignmentSolution) -> AlignmentSolution:
    return replace(s, inside=np.zeros(len(s.inside), dtype=bool))


def _keep_yaw(q: Array) -> Array:
    """Return the rotation about Z in quaternions `(..., 4)`."""
    out = q * np.array([1.0, 0.0, 0.0, 1.0])
    return np.asarray(out / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), 1e-12))


def _initial_guess(b: AlignmentProblem, prior: AlignmentPrior) -> tuple[Array, Array]:
    """Return an initial guess (rotation, translation) by medians, robust to a minority of outliers."""
    yaws = 2.0 * np.arctan2(b.q[:, 3], b.q[:, 0])
    k = int(np.argmin(np.abs(yaws - circular_median(yaws))))
    q = _keep_yaw(b.q[k]) if prior.gravity else b.q[k]
    return q, np.median(b.p - b.p_world @ quat_to_matrix(q).T, axis=0)


def _fit(b: AlignmentProblem, inside: Mask, start: tuple[Array, Array], prior: AlignmentPrior) -> AlignmentSolution:
    """Run Gauss-Newton over (t, left rotation, drift) with the inliers; return distances of all groups too."""
    q, t = start
    drift = np.zeros(4)
    n = N_FRAME if b.scale is None else N_FRAME + b.scale.shape[2]
    scale = np.zeros(n - N_FRAME)
    J = np.zeros((b.size, 6, n))
    J[:, :, :6] = _EYE
    if b.scale is not None:
        J[:, :, N_FRAME:] = b.scale
    J[:, 0, 6] = J[:, 1, 7] = J[:, 2, 8] = b.age_s
    J[:, :, 9] = b.age_s[:, None] * b.yaw
    weights = inside.astype(np.float64)
    tilt_information = 1.0 / prior.tilt_sigma_rad**2 if prior.gravity else 0.0
    diagonal = np.zeros(n)
    diagonal[3:5] = tilt_information
    diagonal[6:9] = 1.0 / max(prior.drift_m_per_s, 1e-9) ** 2
    diagonal[9] = 1.0 / max(prior.yaw_rad_per_s, 1e-9) ** 2
    diagonal[N_FRAME:] = 1.0 / SCALE_SIGMA**2
    for _ in range(_ITERATIONS):
        r, P = _residuals(b, q, t, drift)
        if b.scale is not None:
            r = r - b.scale @ scale
        J[:, 0, 4], J[:, 0, 5] = P[:, 2], -P[:, 1]  # minus the cross-product matrix of the turned anchor
        J[:, 1, 3], J[:, 1, 5] = -P[:, 2], P[:, 0]
        J[:, 2, 3], J[:, 2, 4] = P[:, 1], -P[:, 0]
        A = (b.information @ J * weights[:, None, None]).reshape(-1, n)
        g = A.T @ r.ravel()
        H = A.T @ J.reshape(-1, n)
        H.flat[:: n + 1] += diagonal
        if prior.gravity:
            g[3:5] -= tilt_information * _tilt(q)
        g[6:N_FRAME] -= diagonal[6:N_FRAME] * drift
        g[N_FRAME:] -= diagonal[N_FRAME:] * scale
        inverse = np.asarray(np.linalg.inv(H), dtype=np.float64)
        step = inverse @ g
        t, drift, scale = t + step[:3], drift + step[6:N_FRAME], scale + step[N_FRAME:]
        q = quat_multiply(quat_exp(step[3:6]), q)
        if float(np.abs(step[:6]).max()) < _CONVERGED:
            break
    r = r - J @ step  # the last step was small: its linear effect is all there is
    covariance, tested = _cover_biases(b, weights, A, inverse)
    distance2 = np.add.reduce((b.information @ r[:, :, None])[:, :, 0] * r, axis=1)
    prior_d2 = np.concatenate([drift, scale]) ** 2 @ diagonal[6:]
    chi2 = float(weights @ distance2) + float(prior_d2)
    freedom = 6.0 * float(weights.sum()) - 6.0
    if prior.gravity:
        tilt = _tilt(q)
        chi2 += tilt_information * float(tilt @ tilt)
        freedom += 2.0
    return AlignmentSolution(
        t, q, covariance, inside, chi2, freedom, drift, distance2, r[:, 3:], A, inverse, scale, tested
    )


def _cover_biases(b: AlignmentProblem, weights: Array, A: Array, inverse: Array) -> tuple[Array, Array]:
    """Return the covariance (6, 6) with the biases, which are considered, not estimated (Schmidt 1966): by how much
    each shifts the solution. And how well the scale of each source is tested (U,): by looks from opposite sides or
    several distances it is, by looks from one place not at all."""
    covariance = inverse[:6, :6]
    if not b.bias.size:
        return covariance, b.tested
    shift = inverse[:6] @ (A.T @ b.bias.reshape(len(A), -1))
    c = b.untested.reshape(len(A), -1)
    mixed = A.T @ c
    tested = np.sum(c * (b.information @ b.untested * weights[:, None, None]).reshape(c.shape), axis=0)
    tested = np.maximum(tested - np.sum(mixed * (inverse @ mixed), axis=0), b.tested)
    more = inverse[:6] @ (mixed / np.sqrt(1.0 + tested))
    return covariance + shift @ shift.T + more @ more.T, tested


def _tilt(q: Array) -> Array:
    """`swing` of one quaternion near the vertical or anywhere, in plain floats."""
    w, x, y, z = q.tolist()
    n = math.hypot(w, z)
    if n < 1e-12:
        return np.array([math.pi, 0.0])
    sx, sy = (x * w - y * z) / n, (y * w + x * z) / n
    s = math.hypot(sx, sy)
    scale = 2.0 if s < 1e-12 else 2.0 * math.atan2(s, n) / s
    return np.array([scale * sx, scale * sy])


def _residuals(b: AlignmentProblem, q: Array, t: Array, drift: Array) -> tuple[Array, Array]:
    """Observed minus predicted, positions then rotation vectors (G, 6); and the turned anchor positions (G, 3)."""
    P = b.p_world @ quat_to_matrix(q).T
    r = np.empty((b.size, 6))
    r[:, :3] = b.p - P - t - b.age_s[:, None] * drift[:3]
    r[:, 3:] = quat_log(quat_multiply(b.q, quat_conjugate(q)))
    r -= (b.age_s * drift[3])[:, None] * b.yaw
    return r, P


def _consensus(b: AlignmentProblem, prior: AlignmentPrior) -> tuple[Mask, tuple[Array, Array]]:
    """The largest set of groups that agree with one of them: first counted in anchors, then in groups. Every group is
    tried, so nothing is left to chance."""
    q = _keep_yaw(b.q) if prior.gravity else b.q  # (H, 4)
    t = b.p - np.einsum("hij,hj->hi", quat_to_matrix(q), b.p_world)
    predicted = np.einsum("hij,gj->hgi", quat_to_matrix(q), b.p_world) + t[:, None, :]
    r = b.p[None, :, :] - predicted
    turn_var = np.trace(b.covariance[:, 3:, 3:], axis1=1, axis2=2) / 3.0
    tilt_var = prior.tilt_sigma_rad**2 if prior.gravity else 0.0
    lever2 = np.sum((b.p_world[None, :, :] - b.p_world[:, None, :]) ** 2, axis=2)
    C = b.covariance[:, None, :3, :3] + b.covariance[None, :, :3, :3]
    apart_s2 = (b.age_s[:, None] - b.age_s[None, :]) ** 2
    yaw_var = prior.yaw_rad_per_s**2 * apart_s2
    spread = lever2 * (turn_var[:, None] + tilt_var + yaw_var) + prior.drift_m_per_s**2 * apart_s2
    C = C + spread[:, :, None, None] * np.eye(3)
    d2 = np.einsum("hgi,hgi->hg", r, np.linalg.solve(C, r[:, :, :, None])[:, :, :, 0])
    turns = quat_log(quat_multiply(b.q[None, :, :], quat_conjugate(q)[:, None, :]))
    turn_d2 = np.sum(turns * turns, axis=2) / (turn_var[:, None] + turn_var[None, :] + 2.0 * tilt_var + yaw_var)
    agree = (d2 <= _CHI2_3_999) & (turn_d2 <= _CHI2_3_999)
    best = max(range(b.size), key=lambda h: _votes(b, agree[h], float(np.sum(d2[h][agree[h]]))))
    return agree[best], (q[best], t[best])


def _votes(b: AlignmentProblem, agree: Mask, misfit: float) -> tuple[int, int, float]:
    """Return a sort key, larger is better: agreeing sheets, agreeing groups, negative misfit."""
    return count_agreeing_anchors(b.anchor, agree), int(np.count_nonzero(agree)), -misfit


def count_agreeing_anchors(anchor: Sequence[str], agree: Mask) -> int:
    """Return the number of anchors of which most groups agree."""
    return sum(1 for votes in count_votes(anchor, agree).values() if votes > 0)


def list_agreeing_anchors(anchor: Sequence[str], agree: Mask) -> set[str]:
    """Return the anchors of which most groups agree."""
    return {name for name, votes in count_votes(anchor, agree).items() if votes > 0}


def count_votes(anchor: Sequence[str], agree: Mask) -> dict[str, int]:
    """Return by anchor how many more of its groups agree than do not."""
    balance: dict[str, int] = {}
    for name, ok in zip(anchor, agree.tolist(), strict=True):
        balance[name] = balance.get(name, 0) + (1 if ok else -1)
    return balance


def to_world_covariance(q: Array, covariance: Array, pivot_world: Array) -> Array:
    """Return the covariance (6, 6) of `T_world_tracking` at the pivot, world axes, from that of `T_tracking_world`.

    A tracking frame off by (d, w) shows the point X of the world off by R^T d + (R^T w) x X.
    """
    R_world_tracking = quat_to_matrix(q).T
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = R_world_tracking
    J[:3, 3:] = -skew(pivot_world) @ R_world_tracking
    S = J @ covariance @ J.T
    return np.asarray(0.5 * (S + S.T))
