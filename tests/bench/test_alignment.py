"""`bench alignment`: every key and bar, equal results for equal seeds. The benchmark itself measures accuracy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchors.pose import apply
from iris_session.bench.alignment import CASES, MARKS, TIP_SIGMA_M, SimulatedHeadset, run_alignment
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


def test_touch_is_at_the_mark() -> None:
    rng = np.random.default_rng(0)
    off = []
    for _ in range(200):
        headset = SimulatedHeadset(rng)
        (tip,) = headset.touch_mark(np.array(MARKS["a"]), TIP_SIGMA_M)
        p, q = headset.T_world_tracking(0.0)
        off.append(np.array(apply((tuple(p.tolist()), tuple(q.tolist())), tip)) - MARKS["a"])
    assert np.std(off) == pytest.approx(TIP_SIGMA_M, rel=0.15)
