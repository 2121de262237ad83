"""`bench alignment`: distance at which two headsets place the same physical point, compared with the stated error.

Simulated headsets (`alignment_sources`) observe sheets, with the noise of docs/anchors.md. The simulation knows the
truth; estimators get only what a headset reports. The same seed gives the same observations. Each pair of headsets
shares the anchors and nothing else. The error of a pair at a point is the distance between the places at which its
headsets put it; the stated error is the p95 of the sum of their covariances there. Naive alignments are computed beside
ours for comparison.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from multiprocessing import get_context
from typing import Any, Final, NamedTuple

import numpy as np

from anchors.alignment import AlignmentEstimate, AlignmentEstimator
from anchors.controller import controller_covariance
from anchors.lie import Array, quat_conjugate, quat_log, quat_multiply, quat_to_matrix, to_vec3
from anchors.pose import IDENTITY_QUAT, PoseTuple, Vec3
from anchors.touch import Touch, register_touches
from anchors.uncertainty import length_p95
from iris_session.bench.alignment_sources import (
    MARKS,
    ONE,
    TIP_SIGMA_M,
    TRIANGLE,
    HeadsetMotion,
    SheetSource,
    draw_held_poses,
    to_array_pose,
    to_poses,
)
from iris_session.bench.alignment_worlds import make_world_bars, run_worlds, select_worlds
from iris_session.bench.report import BenchReport, make_bar

HZ: Final = 10.0
LOOK_S: Final = 2.0
WALK_S: Final = 3.0  # from one viewpoint to the next
#: The noise of docs/anchors.md, and nothing else.
SOURCE: Final = SheetSource(shake_m=0.0)
CASES: Final = ("one_sheet", "three_sheets", "three_sheets_quick", "holder", "touch")
#: Bars by case and key; the share of refused pairs and the coverage are added for every case.
BOUNDS: Final = (
    *(("one_sheet", "sheet_mm_p95", 5.0), ("one_sheet", "sheet_deg_p95", 0.9)),
    *(("one_sheet", "at_1m_mm_p95", 14.0), ("one_sheet", "at_2m_mm_p95", 26.0)),
    *(("three_sheets", "hull_mm_p95", 6.0), ("holder", "sheet_mm_p95", 5.0), ("touch", "hull_mm_p95", 5.0)),
)
#: Alignments that are compared, as prefixes of keys: our estimate, the last observation alone, the mean of all.
METHODS: Final = ("", "naive_last_", "naive_mean_")
_TIMED: Final = 8  # headsets, at most, whose updates are timed one by one
_PAIRS_AT_ONCE: Final = 100  # of one job; fewer are not worth another process


def run_alignment(
    pairs: int = 2000,
    seed: int = 0,
    worlds: str = "none",
    headsets: int = 200,
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Run every case with `pairs` pairs of headsets, then worlds in which an alignment can go wrong.

    Raises:
        BenchError: A world is unknown.
    """
    names = select_worlds(worlds)
    timed = _measure_update_times(seed, min(_TIMED, pairs))  # while nothing else runs
    results: dict[str, Any] = _run_cases(pairs, seed, progress) | timed
    bars = [make_bar(results, f"{case}.{key}", "<=", bound) for case, key, bound in BOUNDS]
    for case in CASES:
        bars.append(make_bar(results, f"{case}.refused_share", "<=", 0.02))
        bars.append(make_bar(results, f"{case}.coverage_share", ">=", 0.93))
        bars.append(make_bar(results, f"{case}.coverage_share", "<=", 0.97))
    bars += [make_bar(results, f"{load}update_us_p50", "<=", 200.0) for load in ("", "loaded_")]
    if names:
        results |= run_worlds(names, headsets, seed, progress)
        bars += make_world_bars(names, results)
    return BenchReport(results, bars)


# --- headsets ---------------------------------------------------------------------------------------------------------


class ReportedObservation(NamedTuple):
    """One observation as a headset reports it. `p_head`: of the head at a sheet."""

    anchor_id: str
    pose: PoseTuple
    p_head: Vec3 | None
    capture_ns: int
    viewpoint_id: int


class HeadsetError(NamedTuple):
    """Error of one headset: it places the true point X at R X + t. `estimate`: its stated error."""

    R: Array
    t: Array
    q: Array
    estimate: AlignmentEstimate | None


def observe_anchor(
    case: str, motion: HeadsetMotion, name: str, T_world_anchor: PoseTuple, viewpoint: int
) -> list[ReportedObservation]:
    """Return what a headset reports of an anchor from one viewpoint; it walks from each to the next."""
    anchor, start_s = to_array_pose(T_world_anchor), viewpoint * (LOOK_S + WALK_S)
    heads: list[Vec3 | None]
    if case == "holder":
        times = start_s + np.arange(round(LOOK_S * HZ)) / HZ
        poses = to_poses(*motion.to_tracking(times, *draw_held_poses(motion.rng, anchor, len(times))))
        seen_s, heads = times.tolist(), [None] * len(poses)
    else:
        look = motion.look(name, anchor, start_s, LOOK_S, head_hz=HZ)
        seen_s, poses, heads = look.seen_s, look.poses, [p for p, _ in look.heads]
    return [
        ReportedObservation(name, pose, head, round(at_s * 1e9), viewpoint)
        for at_s, pose, head in zip(seen_s, poses, heads, strict=True)
    ]


def _observe_anchors(
    case: str, motion: HeadsetMotion, anchors: Mapping[str, PoseTuple], viewpoint: int = 0
) -> list[ReportedObservation]:
    """Return observations from three viewpoints of every anchor (`quick`: one), the first of which has that number."""
    names = [name for name in anchors for _ in range(1 if case == "three_sheets_quick" else 3)]
    seen = [observe_anchor(case, motion, name, anchors[name], i) for i, name in enumerate(names, viewpoint)]
    return [one for look in seen for one in look]


def _add_observation(estimator: AlignmentEstimator, case: str, o: ReportedObservation) -> None:
    """Add an observation with what a headset reports, and nothing else."""
    covariance = controller_covariance() if case == "holder" else ()
    estimator.add(o.anchor_id, o.pose, o.capture_ns, 0, o.viewpoint_id, p_tracking_head=o.p_head, covariance=covariance)


def _simulate_headset(case: str, rng: np.random.Generator, anchors: Mapping[str, PoseTuple]) -> list[HeadsetError]:
    """Return the errors of one headset by the methods: of our estimate, its last observation, and the mean of all."""
    motion = HeadsetMotion(rng, SOURCE)
    if case == "touch":
        return [_touch_marks(motion)]
    estimator = AlignmentEstimator(anchors)
    seen = _observe_anchors(case, motion, anchors)
    for o in seen:
        _add_observation(estimator, case, o)
    now = motion.T_world_tracking(seen[-1].capture_ns * 1e-9)
    estimate = estimator.estimate()
    p, q = _align_each_observation(seen, anchors)
    return [
        _compute_error(to_array_pose(estimate.T_world_tracking), now, estimate),
        _compute_error((p[-1], q[-1]), now, None),
        _compute_error(_average_alignments(seen, anchors, q), now, None),
    ]


def _touch_marks(motion: HeadsetMotion) -> HeadsetError:
    """Return the error of one headset whose wearer touches every mark once."""
    touches = []
    for i, (name, p) in enumerate(MARKS.items()):
        at_s = WALK_S * i
        tip = np.array(p) + motion.rng.normal(0.0, TIP_SIGMA_M, 3)
        touches.append(Touch(name, motion.place(at_s, (to_vec3(tip), IDENTITY_QUAT))[0], TIP_SIGMA_M))
    estimate = register_touches(MARKS, touches).estimate
    return _compute_error(to_array_pose(estimate.T_world_tracking), motion.T_world_tracking(at_s), estimate)


def _align_each_observation(
    seen: Sequence[ReportedObservation], anchors: Mapping[str, PoseTuple]
) -> tuple[Array, Array]:
    """Return `T_world_tracking` for every single observation."""
    pw = np.array([anchors[o.anchor_id][0] for o in seen])
    qw = np.array([anchors[o.anchor_id][1] for o in seen])
    q = quat_multiply(qw, quat_conjugate(np.array([o.pose[1] for o in seen])))
    return pw - np.einsum("nij,nj->ni", quat_to_matrix(q), np.array([o.pose[0] for o in seen])), q


def _average_alignments(
    seen: Sequence[ReportedObservation], anchors: Mapping[str, PoseTuple], q: Array
) -> tuple[Array, Array]:
    """Return the mean in 6 degrees of freedom: of the rotations (Markley 2007), then of the rotated positions."""
    q_mean = np.linalg.eigh(q.T @ q)[1][:, -1]
    p = np.array([o.pose[0] for o in seen])
    pw = np.array([anchors[o.anchor_id][0] for o in seen])
    return np.mean(pw - p @ quat_to_matrix(q_mean).T, axis=0), q_mean


def _compute_error(
    found: tuple[Array, Array], true: tuple[Array, Array], estimate: AlignmentEstimate | None
) -> HeadsetError:
    q = quat_multiply(found[1], quat_conjugate(true[1]))
    R = quat_to_matrix(q)
    return HeadsetError(R, found[0] - R @ true[0], q, estimate)


# --- pairs ------------------------------------------------------------------------------------------------------------


class PairResult(NamedTuple):
    """Errors of a pair by point [mm], and `turn` [deg]; points at which they are within what is stated.

    Both are empty if an estimate is refused.
    """

    errors: dict[str, float]
    covered: dict[str, bool]


def _run_cases(pairs: int, seed: int, progress: Callable[[str], None]) -> dict[str, Any]:
    """Return the figures of all cases, computed on all processors where that is worth it."""
    jobs = []
    for k, case in enumerate(CASES):
        seeds = np.random.SeedSequence((seed, k)).spawn(3 * pairs)
        step = 3 * _PAIRS_AT_ONCE
        jobs += [(case, seeds[i : i + step]) for i in range(0, len(seeds), step)]
    found: dict[str, dict[str, list[PairResult]]] = {}
    workers = min(os.cpu_count() or 1, pairs // _PAIRS_AT_ONCE)
    with ProcessPoolExecutor(workers, get_context("spawn")) if workers > 1 else nullcontext() as pool:
        run_all: Callable[..., Any] = map if pool is None else pool.map
        for (case, _), result in zip(jobs, run_all(_run_case, *zip(*jobs, strict=True)), strict=True):
            if case not in found:
                progress(f"{case}, {pairs} pairs")
            for method, part in result.items():
                found.setdefault(case, {}).setdefault(method, []).extend(part)
    return {
        case: {key: value for method, own in by_method.items() for key, value in _summarize(case, method, own).items()}
        for case, by_method in found.items()
    }


def _run_case(case: str, seeds: Sequence[np.random.SeedSequence]) -> dict[str, list[PairResult]]:
    """Run pairs of one case, from three seeds each. Return the results by method."""
    rngs = [np.random.default_rng(s) for s in seeds]
    anchors = TRIANGLE if case.startswith("three") else ONE
    hull = [np.array(p) for p in (MARKS.values() if case == "touch" else [p for p, _ in anchors.values()])]
    centre = np.mean(hull, axis=0)
    found: dict[str, list[PairResult]] = {}
    for a, b, free in zip(rngs[::3], rngs[1::3], rngs[2::3], strict=True):
        turn = free.uniform(-math.pi, math.pi)
        way = np.array([math.cos(turn), math.sin(turn), 0.0])
        sheet = centre if case == "touch" else hull[0]
        points = {"sheet": sheet, "at_1m": centre + way, "at_2m": centre + 2.0 * way}
        errors = zip(*(_simulate_headset(case, rng, anchors) for rng in (a, b)), strict=True)
        for method, (x, y) in zip(METHODS, errors, strict=False):
            found.setdefault(method, []).append(_evaluate_pair(x, y, points, hull))
    return found


def _evaluate_pair(a: HeadsetError, b: HeadsetError, points: dict[str, Array], hull: list[Array]) -> PairResult:
    """Return the errors of a pair at the points, and the largest within the hull (at a corner: the error is affine)."""
    stated = [one.estimate for one in (a, b) if one.estimate is not None]
    if any(estimate.refused for estimate in stated):
        return PairResult({}, {})

    def compute_error_mm(X: Array) -> float:
        return 1e3 * float(np.linalg.norm((a.R - b.R) @ X + a.t - b.t))

    errors = {name: compute_error_mm(X) for name, X in points.items()}
    covered = {}
    if stated:
        for name, X in points.items():
            covariance = sum((one.covariance_at(to_vec3(X)) for one in stated), np.zeros((3, 3)))
            covered[name] = errors[name] <= 1e3 * length_p95(covariance)
    turn = quat_log(quat_multiply(a.q, quat_conjugate(b.q)))
    errors |= {"hull": max(map(compute_error_mm, hull)), "turn": math.degrees(float(np.linalg.norm(turn)))}
    return PairResult(errors, covered)


def _summarize(case: str, method: str, pairs: Sequence[PairResult]) -> dict[str, float]:
    used = [pair for pair in pairs if pair.errors]
    keys = {"sheet": "sheet_mm_p95", "at_1m": "at_1m_mm_p95", "at_2m": "at_2m_mm_p95"}
    keys |= {} if case in ("one_sheet", "holder") else {"hull": "hull_mm_p95"}
    out = {}
    for name, key in (keys | {"turn": "sheet_deg_p95"}).items():
        out[method + key] = round(float(np.quantile([p.errors[name] for p in used], 0.95)), 3) if used else math.inf
    if not method:
        out["refused_share"] = round(1.0 - len(used) / len(pairs), 4)
        for name in used[0].covered if used else ():
            out[f"coverage_{name}_share"] = round(float(np.mean([pair.covered[name] for pair in used])), 4)
        everywhere = [covered for pair in used for covered in pair.covered.values()]
        out["coverage_share"] = round(float(np.mean(everywhere)), 4) if everywhere else math.nan
    return out


# --- processor time ---------------------------------------------------------------------------------------------------


def _measure_update_times(seed: int, headsets: int) -> dict[str, float]:
    """Measure processor time of updates on the server: with one sheet and up to three viewpoints, and `loaded`: with
    three sheets and the last of 15 viewpoints."""
    spent: dict[str, list[float]] = {}
    for k, rng in enumerate(np.random.default_rng(s) for s in np.random.SeedSequence((seed, 99)).spawn(headsets + 2)):
        kept = spent if k >= 2 else {}  # the first two warm up
        looks = _observe_anchors("one_sheet", HeadsetMotion(rng, SOURCE), ONE)
        _time_estimator(AlignmentEstimator(ONE), looks, "", kept)
        motion, loaded = HeadsetMotion(rng, SOURCE), AlignmentEstimator(TRIANGLE)
        for viewpoint in range(0, 15, 3):
            looks = _observe_anchors("three_sheets_quick", motion, TRIANGLE, viewpoint)
            _time_estimator(loaded, looks, "loaded_", kept if viewpoint == 12 else {})
    return {f"{name}_us_p50": round(float(np.median(ns)) * 1e-3, 1) for name, ns in spent.items()}


def _time_estimator(
    estimator: AlignmentEstimator, seen: Sequence[ReportedObservation], prefix: str, spent: dict[str, list[float]]
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
        for name, ns in (("update", (end - start) / 2.0), ("add", (middle - start) / 2.0), ("estimate", end - middle)):
            spent.setdefault(prefix + name, []).append(ns)
