"""`bench alignment`: distance at which two headsets place the same physical point, compared with the stated error.

Simulated headsets with tilted, drifting tracking frames observe sheets, with the noise of docs/anchors.md. The
simulation knows the truth; estimators get only what a headset reports (`ReportedObservation`). The same seed gives the
same observations. Each pair of headsets shares the anchors and nothing else. The error of a pair at a point is the
distance between the places at which its headsets put it; the stated error is the p95 of the sum of their covariances
there. Naive alignments are computed beside ours for comparison.
"""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from typing import Any, Final, NamedTuple

import numpy as np

from anchors.alignment import AlignmentEstimate, AlignmentEstimator
from anchors.controller import controller_covariance
from anchors.lie import Array, quat_conjugate, quat_exp, quat_log, quat_multiply, quat_to_matrix, to_quat, to_vec3
from anchors.pose import PoseTuple, Vec3
from anchors.touch import Touch, register_touches
from anchors.uncertainty import length_p95
from iris_session.bench.alignment_sources import (
    HEAD_SIGMA_M,
    HOLDER_SIGMA_RAD,
    MARKS,
    ONE,
    TILT_SIGMA_RAD,
    TIP_SIGMA_M,
    TRIANGLE,
)
from iris_session.bench.alignment_worlds import make_world_bars, run_worlds, select_worlds
from iris_session.bench.report import Bar, BenchReport, make_bar
from iris_session.emulator.sheet_noise import SheetNoise, mix_viewpoint_noise

# --- simulated headsets -----------------------------------------------------------------------------------------------

PER_VIEWPOINT: Final = 20  # 2 s at 10 Hz
PERIOD_S: Final = 0.1
WALK_S: Final = 3.0  # from one viewpoint to the next
DISTANCE_M: Final = (0.4, 1.2)
ELEVATION_DEG: Final = (40.0, 80.0)
NOISE: Final = SheetNoise()
DRIFT_M_PER_S: Final = 0.003 / 60.0


@dataclass(frozen=True)
class ReportedObservation:
    """One observation as a headset reports it."""

    anchor_id: str
    pose: PoseTuple
    p_head: Vec3
    capture_ns: int
    viewpoint_id: int


@dataclass
class SimulatedHeadset:
    """True motion of one headset, from which its reports are computed. `now_s`: present time of its run."""

    rng: np.random.Generator
    now_s: float = 0.0
    viewpoints: int = 0
    q0: Array = field(init=False)
    p0: Array = field(init=False)
    velocity: Array = field(init=False)

    def __post_init__(self) -> None:
        yaw = quat_exp(np.array([0.0, 0.0, self.rng.uniform(-math.pi, math.pi)]))
        tilt = quat_exp(np.append(self.rng.normal(0.0, TILT_SIGMA_RAD, 2), 0.0))
        self.q0 = quat_multiply(tilt, yaw)
        self.p0 = np.append(self.rng.uniform(-3.0, 3.0, 2), self.rng.uniform(-1.5, 0.5))
        way = self.rng.normal(size=3)
        self.velocity = DRIFT_M_PER_S * way / np.linalg.norm(way)

    def T_world_tracking(self, at_s: float) -> tuple[Array, Array]:
        """Return the true pose of the tracking frame at a time."""
        return self.p0 + at_s * self.velocity, self.q0

    def observe_sheet(self, anchor_id: str, p_anchor: Array, q_anchor: Array) -> list[ReportedObservation]:
        """Return 2 s of observations from a new viewpoint around the sheet, 0.4 to 1.2 m away."""
        rng, n = self.rng, PER_VIEWPOINT
        d = rng.uniform(*DISTANCE_M)
        elevation, azimuth = math.radians(rng.uniform(*ELEVATION_DEG)), rng.uniform(-math.pi, math.pi)
        e1 = -np.array(
            [
                math.cos(elevation) * math.cos(azimuth),
                math.cos(elevation) * math.sin(azimuth),
                math.sin(elevation),
            ]
        )
        e2 = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        axes = np.stack([e1, e2, np.cross(e1, e2)])
        noise = mix_viewpoint_noise(rng.normal(size=3), rng.normal(size=(n, 3)))
        turns = mix_viewpoint_noise(rng.normal(size=3), rng.normal(size=(n, 3)))
        p, q = NOISE.observe(p_anchor, q_anchor, axes, d, np.hstack([noise, turns]), rng.normal())
        for i in np.flatnonzero(rng.random(n) < NOISE.wrong_share):
            p[i], q[i] = NOISE.make_wrong_detection(p[i], q[i], e1, rng)
        heads = p_anchor - d * e1 + rng.normal(0.0, HEAD_SIGMA_M, (n, 3))
        return self._report(anchor_id, p, q, heads)

    def observe_controller(self, anchor_id: str, p_anchor: Array, q_anchor: Array) -> list[ReportedObservation]:
        """Return 2 s of observations of a tracked controller in its holder."""
        rng, n = self.rng, PER_VIEWPOINT
        noise = TIP_SIGMA_M * mix_viewpoint_noise(rng.normal(size=3), rng.normal(size=(n, 3)))
        turns = HOLDER_SIGMA_RAD * mix_viewpoint_noise(rng.normal(size=3), rng.normal(size=(n, 3)))
        q = quat_multiply(quat_exp(turns), np.broadcast_to(q_anchor, (n, 4)))
        return self._report(anchor_id, p_anchor + noise, q, np.broadcast_to(p_anchor, (n, 3)))

    def touch_mark(self, p_mark: Array, sigma_m: float) -> list[Vec3]:
        """Return the position of a controller's tip that touches a mark once."""
        p = p_mark + self.rng.normal(0.0, sigma_m, (1, 3))
        origin, q = self.T_world_tracking(self.now_s)
        return [to_vec3(v) for v in (p - origin) @ quat_to_matrix(q)]

    def _report(self, anchor_id: str, p: Array, q: Array, heads: Array) -> list[ReportedObservation]:
        """Transform observations from world to tracking, each at its time, and go to the next viewpoint."""
        times = self.now_s + PERIOD_S * np.arange(len(p))
        q_inv = quat_conjugate(self.q0)
        R = quat_to_matrix(q_inv)
        origin = self.p0 + times[:, None] * self.velocity
        p_tracking, head_tracking = (p - origin) @ R.T, (heads - origin) @ R.T
        q_tracking = quat_multiply(q_inv, q)
        out = [
            ReportedObservation(anchor_id, (to_vec3(a), to_quat(b)), to_vec3(h), round(t * 1e9), self.viewpoints)
            for a, b, h, t in zip(p_tracking, q_tracking, head_tracking, times.tolist(), strict=True)
        ]
        self.viewpoints += 1
        self.now_s = float(times[-1]) + PERIOD_S
        return out

    def walk(self) -> None:
        """Advance the time by a walk to the next viewpoint."""
        self.now_s += WALK_S


# --- benchmark --------------------------------------------------------------------------------------------------------

CASES: Final = ("one_sheet", "three_sheets", "three_sheets_quick", "holder", "touch")
#: (case, key, bound): the issue's bars; the share of refused pairs and the coverage are added for every case.
BOUNDS: Final = (
    *(("one_sheet", "sheet_mm_p95", 5.0), ("one_sheet", "sheet_deg_p95", 0.9)),
    *(("one_sheet", "at_1m_mm_p95", 14.0), ("one_sheet", "at_2m_mm_p95", 26.0)),
    *(("three_sheets", "hull_mm_p95", 6.0), ("holder", "sheet_mm_p95", 5.0), ("touch", "hull_mm_p95", 5.0)),
)
_TIMED: Final = 8  # headsets, at most, whose updates are timed one by one
_PAIRS_AT_ONCE: Final = 100  # of one job; fewer are not worth another process


class HeadsetError(NamedTuple):
    """Error of one headset: it places the true point X at R X + t. `estimate`: its stated error."""

    R: Array
    t: Array
    q: Array
    estimate: AlignmentEstimate | None


@dataclass
class CaseStatistics:
    """Errors of all pairs of one case."""

    errors: dict[str, list[float]] = field(default_factory=dict)
    covered: dict[str, list[bool]] = field(default_factory=dict)
    pairs: int = 0
    refused: int = 0

    def add(self, other: CaseStatistics) -> None:
        """Add the errors of more pairs."""
        for name, errors in other.errors.items():
            self.errors.setdefault(name, []).extend(errors)
        for name, covered in other.covered.items():
            self.covered.setdefault(name, []).extend(covered)
        self.pairs += other.pairs
        self.refused += other.refused


#: Of our estimate, of the last observation alone, and of the mean of all.
CaseResult = tuple[CaseStatistics, CaseStatistics, CaseStatistics]


def run_alignment(
    pairs: int = 2000,
    seed: int = 0,
    worlds: str = "none",
    headsets: int = 200,
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Run every case with `pairs` pairs of headsets, then worlds in which an alignment can go wrong.

    Args:
        pairs: Pairs of headsets per case.
        seed: Random seed.
        worlds: Names of worlds (`alignment_worlds`) with commas between them; `all`, `rows`, `mixes`, `none`.
        headsets: Headsets per world.
        progress: Called with a short text before each case.

    Raises:
        BenchError: A world is unknown.
    """
    names = select_worlds(worlds)
    results: dict[str, Any] = {}
    bars: list[Bar] = []
    timed = _measure_update_times(seed, min(_TIMED, pairs))  # while nothing else runs
    results |= _run_cases(pairs, seed, progress) | timed
    for case, key, bound in BOUNDS:
        bars.append(make_bar(results, f"{case}.{key}", "<=", bound))
    for case in CASES:
        bars.append(make_bar(results, f"{case}.refused_share", "<=", 0.02))
        bars.append(make_bar(results, f"{case}.coverage_share", ">=", 0.93))
        bars.append(make_bar(results, f"{case}.coverage_share", "<=", 0.97))
    bars += [make_bar(results, f"{load}update_us_p50", "<=", 200.0) for load in ("", "loaded_")]
    params: dict[str, Any] = {"pairs": pairs, "seed": seed}
    if names:
        results |= run_worlds(names, headsets, seed, progress)
        bars += make_world_bars(names, results)
        params |= {"worlds": worlds, "headsets": headsets}
    return BenchReport("alignment", params, results, tuple(bars))


def _run_cases(pairs: int, seed: int, progress: Callable[[str], None]) -> dict[str, Any]:
    """Return the figures of all cases, computed on all processors where that is worth it."""
    jobs = []
    for k, case in enumerate(CASES):
        seeds = np.random.SeedSequence((seed, k)).spawn(3 * pairs)
        step = 3 * _PAIRS_AT_ONCE
        jobs += [(case, seeds[i : i + step]) for i in range(0, len(seeds), step)]
    found = {case: (CaseStatistics(), CaseStatistics(), CaseStatistics()) for case in CASES}
    workers = min(os.cpu_count() or 1, pairs // _PAIRS_AT_ONCE)
    with contextlib.ExitStack() as stack:
        run_all: Callable[..., Iterator[CaseResult]] = map
        if workers > 1:
            run_all = stack.enter_context(ProcessPoolExecutor(workers, get_context("spawn"))).map
        begun = ""
        for (case, _), result in zip(jobs, run_all(_run_case, *zip(*jobs, strict=True)), strict=True):
            if case != begun:
                begun = case
                progress(f"{case}, {pairs} pairs")
            for total, part in zip(found[case], result, strict=True):
                total.add(part)
    return {case: _summarize_case(case, *result) for case, result in found.items()}


def _summarize_case(case: str, ours: CaseStatistics, last: CaseStatistics, mean: CaseStatistics) -> dict[str, float]:
    hull = case not in ("one_sheet", "holder")
    out = _summarize(ours, "", hull)
    if case != "touch":
        out |= _summarize(last, "naive_last_", hull) | _summarize(mean, "naive_mean_", hull)
    return out


def _run_case(case: str, seeds: Sequence[np.random.SeedSequence]) -> CaseResult:
    """Run pairs of one case, from three seeds each."""
    rngs = [np.random.default_rng(s) for s in seeds]
    anchors: dict[str, PoseTuple] = TRIANGLE if case.startswith("three") else ONE
    hull = [np.array(p) for p in MARKS.values()] if case == "touch" else [np.array(p) for p, _ in anchors.values()]
    ours, last, mean = CaseStatistics(), CaseStatistics(), CaseStatistics()
    for a, b, free in zip(rngs[::3], rngs[1::3], rngs[2::3], strict=True):
        turn = free.uniform(-math.pi, math.pi)
        centre = np.mean(hull, axis=0)
        way = np.array([math.cos(turn), math.sin(turn), 0.0])
        points = {
            "sheet": hull[0] if case != "touch" else centre,
            "at_1m": centre + way,
            "at_2m": centre + 2.0 * way,
        }
        found = [
            _simulate_touching_headset(rng) if case == "touch" else _simulate_looking_headset(case, rng, anchors)
            for rng in (a, b)
        ]
        for tally, (x, y) in zip((ours, last, mean), zip(*found, strict=True), strict=False):
            _evaluate_pair(tally, x, y, points, hull)
    return ours, last, mean


def _simulate_looking_headset(
    case: str, rng: np.random.Generator, anchors: dict[str, PoseTuple]
) -> tuple[HeadsetError, HeadsetError, HeadsetError]:
    """Return the errors of one headset: of our estimate, of its last observation, and of the mean of all."""
    headset = SimulatedHeadset(rng)
    estimator = AlignmentEstimator(anchors)
    seen = _simulate_observations(case, headset, anchors)
    for o in seen:
        _add_observation(estimator, case, o)
    now = headset.T_world_tracking(seen[-1].capture_ns * 1e-9)
    estimate = estimator.estimate()
    p, q = _align_each_observation(seen, anchors)
    return (
        _compute_error(_to_arrays(estimate.T_world_tracking), now, estimate),
        _compute_error((p[-1], q[-1]), now, None),
        _compute_error(_average_alignments(seen, anchors, q), now, None),
    )


def _simulate_observations(
    case: str, headset: SimulatedHeadset, anchors: dict[str, PoseTuple]
) -> list[ReportedObservation]:
    """Return observations from three viewpoints of every sheet or holder (`quick`: one viewpoint)."""
    seen: list[ReportedObservation] = []
    for name, (p, q) in anchors.items():
        for _ in range(1 if case == "three_sheets_quick" else 3):
            look = headset.observe_controller if case == "holder" else headset.observe_sheet
            seen += look(name, np.array(p), np.array(q))
            headset.walk()
    return seen


def _add_observation(estimator: AlignmentEstimator, case: str, o: ReportedObservation) -> None:
    """Add an observation with what a headset reports, and nothing else."""
    if case == "holder":
        estimator.add(o.anchor_id, o.pose, o.capture_ns, 0, o.viewpoint_id, covariance=controller_covariance())
    else:
        estimator.add(o.anchor_id, o.pose, o.capture_ns, 0, o.viewpoint_id, p_tracking_head=o.p_head)


def _simulate_touching_headset(rng: np.random.Generator) -> tuple[HeadsetError]:
    """Return the error of one headset whose wearer touches every mark once."""
    headset = SimulatedHeadset(rng)
    touches = []
    for name, p in MARKS.items():
        (tip,) = headset.touch_mark(np.array(p), TIP_SIGMA_M)
        touches.append(Touch(name, tip, TIP_SIGMA_M))
        at = headset.now_s
        headset.walk()
    estimate = register_touches(MARKS, touches).estimate
    return (_compute_error(_to_arrays(estimate.T_world_tracking), headset.T_world_tracking(at), estimate),)


def _align_each_observation(seen: Sequence[ReportedObservation], anchors: dict[str, PoseTuple]) -> tuple[Array, Array]:
    """Return `T_world_tracking` for every single observation."""
    pw = np.array([anchors[o.anchor_id][0] for o in seen])
    qw = np.array([anchors[o.anchor_id][1] for o in seen])
    q = quat_multiply(qw, quat_conjugate(np.array([o.pose[1] for o in seen])))
    return pw - np.einsum("nij,nj->ni", quat_to_matrix(q), np.array([o.pose[0] for o in seen])), q


def _average_alignments(
    seen: Sequence[ReportedObservation], anchors: dict[str, PoseTuple], q: Array
) -> tuple[Array, Array]:
    """Return the mean in 6 degrees of freedom: of the rotations (Markley 2007), then of the rotated positions."""
    q_mean = np.linalg.eigh(q.T @ q)[1][:, -1]
    p = np.array([o.pose[0] for o in seen])
    pw = np.array([anchors[o.anchor_id][0] for o in seen])
    return np.mean(pw - p @ quat_to_matrix(q_mean).T, axis=0), q_mean


def _to_arrays(T: PoseTuple) -> tuple[Array, Array]:
    return np.array(T[0]), np.array(T[1])


def _compute_error(
    found: tuple[Array, Array], true: tuple[Array, Array], estimate: AlignmentEstimate | None
) -> HeadsetError:
    q = quat_multiply(found[1], quat_conjugate(true[1]))
    R = quat_to_matrix(q)
    return HeadsetError(R, found[0] - R @ true[0], q, estimate)


def _evaluate_pair(
    tally: CaseStatistics, a: HeadsetError, b: HeadsetError, points: dict[str, Array], hull: list[Array]
) -> None:
    """Add the errors of a pair at the points, and the largest within the hull (at a corner: the error is affine)."""
    tally.pairs += 1
    stated = [o.estimate for o in (a, b) if o.estimate is not None]
    if any(e.refused for e in stated):
        tally.refused += 1
        return

    def error(X: Array) -> float:
        return float(np.linalg.norm((a.R - b.R) @ X + a.t - b.t))

    for name, X in points.items():
        tally.errors.setdefault(name, []).append(error(X))
        if stated:
            at = to_vec3(X)
            p95 = length_p95(stated[0].covariance_at(at) + stated[1].covariance_at(at))
            tally.covered.setdefault(name, []).append(error(X) <= p95)
    tally.errors.setdefault("hull", []).append(max(error(X) for X in hull))
    turn = quat_log(quat_multiply(a.q, quat_conjugate(b.q)))
    tally.errors.setdefault("turn", []).append(math.degrees(float(np.linalg.norm(turn))))


def _summarize(tally: CaseStatistics, prefix: str, hull: bool) -> dict[str, float]:
    names = ("sheet", "at_1m", "at_2m", *(("hull",) if hull else ()))
    out = {f"{prefix}{name}_mm_p95": _p95(tally.errors.get(name, []), 1e3) for name in names}
    out[f"{prefix}sheet_deg_p95"] = _p95(tally.errors.get("turn", []), 1.0)
    if not prefix:
        out["refused_share"] = round(tally.refused / tally.pairs, 4)
        for name, covered in tally.covered.items():
            out[f"coverage_{name}_share"] = round(float(np.mean(covered)), 4)
        everywhere = [c for covered in tally.covered.values() for c in covered]
        out["coverage_share"] = round(float(np.mean(everywhere)), 4) if everywhere else float("nan")
    return out


def _p95(values: Sequence[float], scale: float) -> float:
    return round(float(np.quantile(values, 0.95)) * scale, 3) if len(values) else float("inf")


def _measure_update_times(seed: int, headsets: int) -> dict[str, float]:
    """Measure processor time of updates on the server: with one sheet and up to three viewpoints, and `loaded`: with
    three sheets and the last of 15 viewpoints."""
    few: dict[str, list[float]] = {"update": [], "add": [], "estimate": []}
    many: dict[str, list[float]] = {"update": [], "add": [], "estimate": []}
    for k, rng in enumerate(np.random.default_rng(s) for s in np.random.SeedSequence((seed, 99)).spawn(headsets + 2)):
        one, three = AlignmentEstimator(ONE), AlignmentEstimator(TRIANGLE)
        seen = _simulate_observations("one_sheet", SimulatedHeadset(rng), ONE)
        headset = SimulatedHeadset(rng)
        before = [o for _ in range(4) for o in _simulate_observations("three_sheets_quick", headset, TRIANGLE)]
        _time_estimator(three, before, {name: [] for name in many})
        last = _simulate_observations("three_sheets_quick", headset, TRIANGLE)
        for estimator, looks, spent in ((one, seen, few), (three, last, many)):
            _time_estimator(
                estimator, looks, spent if k >= 2 else {name: [] for name in spent}
            )  # the first two warm up
    return {
        f"{prefix}{name}_us_p50": round(float(np.median(ns)) * 1e-3, 1)
        for prefix, spent in (("", few), ("loaded_", many))
        for name, ns in spent.items()
    }


def _time_estimator(
    estimator: AlignmentEstimator, seen: Sequence[ReportedObservation], spent: dict[str, list[float]]
) -> None:
    """Time updates of an estimator.

    The server adds every observation and renews the estimate at most five times a second, which is every second
    observation at 10 Hz. An update is one observation with half of an estimate.
    """
    for first, second in zip(seen[::2], seen[1::2], strict=True):
        start = time.thread_time_ns()
        _add_observation(estimator, "one_sheet", first)
        _add_observation(estimator, "one_sheet", second)
        middle = time.thread_time_ns()
        estimator.estimate()
        end = time.thread_time_ns()
        spent["add"].append((middle - start) / 2.0)
        spent["estimate"].append(end - middle)
        spent["update"].append((end - start) / 2.0)
