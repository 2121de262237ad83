"""`bench alignment`: every key and bar, equal results for equal seeds. The benchmark itself measures accuracy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchors.lie import quat_log, quat_multiply
from anchors.pose import PoseTuple, apply
from iris_session.bench.alignment import CASES, MARKS, PER_VIEWPOINT, TIP_SIGMA_M, SimulatedHeadset, run_alignment
from iris_session.bench.report import BenchReport, flatten

KEYS = {"sheet_mm_p95", "sheet_deg_p95", "at_1m_mm_p95", "at_2m_mm_p95", "refused_share", "coverage_share"}


@pytest.fixture(scope="module")
def report() -> BenchReport:
    return run_alignment(pairs=5, seed=5)


def test_every_case_has_every_key_and_bar(report: BenchReport) -> None:
    assert report.params == {"pairs": 5, "seed": 5}
    for case in CASES:
        got = report.results[case]
        assert set(got) >= KEYS
        assert ("hull_mm_p95" in got) is (case not in ("one_sheet", "holder"))
        assert all(math.isfinite(v) for v in got.values())
        assert got["refused_share"] == 0.0
        if case != "touch":
            assert {f"naive_{way}_sheet_mm_p95" for way in ("last", "mean")} <= set(got)
    held = {(b.key, b.op) for b in report.bars}
    assert held >= {(f"{case}.coverage_share", op) for case in CASES for op in ("<=", ">=")}
    assert {b.key: b.bound for b in report.bars}["one_sheet.at_2m_mm_p95"] == 26.0
    timed = {f"{load}{what}_us_p50" for load in ("", "loaded_") for what in ("update", "add", "estimate")}
    assert timed <= set(report.results)
    assert ("loaded_update_us_p50", "<=") in held
    values = flatten(report.as_dict()["results"])
    assert all(b.value == values[b.key] for b in report.bars)
    assert "one_sheet.sheet_mm_p95" in report.format()


def test_estimator_is_better_than_naive_methods(report: BenchReport) -> None:
    got = report.results["one_sheet"]
    assert got["sheet_mm_p95"] < 0.5 * min(got["naive_last_sheet_mm_p95"], got["naive_mean_sheet_mm_p95"])


def test_same_seed_gives_the_same_observations() -> None:
    one, same, other = (
        SimulatedHeadset(np.random.default_rng(seed)).observe_sheet("a", np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        for seed in (1, 1, 2)
    )
    assert one == same != other


def test_headsets_report_with_the_stated_noise() -> None:
    """Standard deviations of 150 observations; wrong detections identified by their size."""
    errors, turns, wrong, n = [], [], 0, 0
    for seed in range(150):
        headset = SimulatedHeadset(np.random.default_rng(seed))
        p0, q0 = headset.T_world_tracking(0.0)
        assert abs(float(np.linalg.norm(headset.velocity)) - 0.003 / 60.0) < 1e-12
        for o in headset.observe_sheet("a", np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])):
            T = (tuple(p0.tolist()), tuple(q0.tolist()))
            seen, head = apply(T, o.pose[0]), np.array(apply(T, o.p_head))
            d = float(np.linalg.norm(head))
            assert 0.38 < d < 1.22
            turn = quat_log(quat_multiply(q0, np.array(o.pose[1])))
            n += 1
            if float(np.linalg.norm(turn)) > 0.15:
                wrong += 1
                continue
            turns.append(turn / (math.radians(0.3) * d / 0.5))
            along = float(np.array(seen) @ head) / d
            if abs(along) < 0.03:
                errors.append(along / math.hypot(0.0004 + 0.0044 * d * d, 0.003 * d))
    assert n == 150 * PER_VIEWPOINT
    assert wrong / n == pytest.approx(0.05, abs=0.015)
    assert np.std(turns) == pytest.approx(1.0, rel=0.1)
    assert np.std(errors) == pytest.approx(1.0, rel=0.15)


def test_variance_shares_per_viewpoint_and_across_the_view() -> None:
    """Half of each variance is constant per viewpoint, a third of the sigma is across the view."""
    means, about = [], []
    for seed in range(200):
        headset = SimulatedHeadset(np.random.default_rng(seed))
        T: PoseTuple = (tuple(headset.p0.tolist()), tuple(headset.q0.tolist()))
        seen = headset.observe_sheet("a", np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        view = -np.median([apply(T, o.p_head) for o in seen], axis=0)
        d = float(np.linalg.norm(view))
        p = np.array([apply(T, o.pose[0]) for o in seen])
        p = p[np.linalg.norm(p, axis=1) < 0.05]
        across = np.array([-view[1], view[0], 0.0]) / math.hypot(view[0], view[1])
        e = np.stack([p @ view / d, 3.0 * (p @ across)], axis=1) / (0.0004 + 0.0044 * d * d)
        means.append(np.mean(e, axis=0))
        about.append(np.var(e, axis=0, ddof=1))
    assert np.median(about, axis=0) == pytest.approx([0.5, 0.5], rel=0.15)
    assert np.var([m[1] for m in means]) == pytest.approx(0.5 + 0.5 / 19, rel=0.25)


def test_touch_is_at_the_mark() -> None:
    rng = np.random.default_rng(0)
    off = []
    for _ in range(200):
        headset = SimulatedHeadset(rng)
        (tip,) = headset.touch_mark(np.array(MARKS["a"]), TIP_SIGMA_M)
        p, q = headset.T_world_tracking(0.0)
        off.append(np.array(apply((tuple(p.tolist()), tuple(q.tolist())), tip)) - MARKS["a"])
    assert np.std(off) == pytest.approx(TIP_SIGMA_M, rel=0.15)
