"""`bench alignment`: better than naive methods, equal observations for equal seeds. The benchmark measures accuracy."""

from __future__ import annotations

import numpy as np
import pytest

from anchors.pose import IDENTITY_POSE
from iris_session.bench.alignment import observe_anchor, run_alignment
from iris_session.bench.alignment_sources import HeadsetMotion, SheetSource
from iris_session.bench.report import BenchReport


@pytest.fixture(scope="module")
def report() -> BenchReport:
    return run_alignment(pairs=5, seed=5)


def test_estimator_is_better_than_naive_methods(report: BenchReport) -> None:
    got = report.results["one_sheet"]
    assert got["sheet_mm_p95"] < 0.5 * min(got["naive_last_sheet_mm_p95"], got["naive_mean_sheet_mm_p95"])


def test_same_seed_gives_the_same_observations() -> None:
    one, same, other = (
        observe_anchor("one_sheet", HeadsetMotion(np.random.default_rng(seed), SheetSource()), "a", IDENTITY_POSE, 0)
        for seed in (1, 1, 2)
    )
    assert one == same != other
