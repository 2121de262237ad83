"""`bench slow-client`: evaluation of logs."""

from __future__ import annotations

import math

import numpy as np

from iris_session.bench.slow_client import (
    BASELINE,
    STALLED,
    STOPPED,
    StallInterval,
    measure_after_stall,
    measure_others_p99,
    plan_intervals,
)

MS = 1_000_000
BEGIN = 5_000 * MS
STRETCH = StallInterval(STOPPED, 10.0, 15.0)  # stall from 10.5 to 13.5 s


def _log(frames: list[tuple[float, float]]) -> dict[str, np.ndarray]:
    """Frames as (handed out, age), both ms, from the beginning of the window."""
    handed = np.array([BEGIN + round(at * MS) for at, _ in frames], np.int64)
    return {"handed_ns": handed, "state_ns": handed - np.array([round(age * MS) for _, age in frames], np.int64)}


def test_first_and_first_fresh_frame_after_a_stall() -> None:
    steady = [(10_000.0 + 16 * i, 2.0) for i in range(30)]
    log = _log([*steady, (13_504.0, 900.0), (13_510.0, 40.0), (13_512.0, 21.0), (13_530.0, 2.0), (14_999.0, 2.0)])
    first, fresh = measure_after_stall(log, BEGIN, STRETCH, BEGIN + 13_502 * MS)
    assert first == 900.0
    assert fresh == 10.0  # 21 ms are within 20 ms of the usual 2 ms
    assert measure_after_stall(_log(steady), BEGIN, STRETCH, BEGIN + 13_502 * MS) == (math.inf, math.inf)
    late = _log([*steady, (15_001.0, 2.0)])  # belongs to the next interval
    assert measure_after_stall(late, BEGIN, STRETCH, BEGIN + 13_502 * MS) == (math.inf, math.inf)


def test_age_of_other_clients_counts_from_the_stall() -> None:
    calm = _log([(10_000.0 + i, 50.0 if i < 500 else 3.0) for i in range(5_000)])
    assert measure_others_p99({"a": calm}, ["a"], BEGIN, STRETCH) == 3.0


def test_intervals_alternate_and_fill_the_time() -> None:
    plan = plan_intervals(50.0)
    assert [s.kind for s in plan] == [BASELINE, STOPPED, STALLED] * 3
    assert plan[-1].end_s == 50.0
    assert all(s.end_s - s.resume_s >= 1.0 - 1e-9 for s in plan_intervals(1.0))
    assert len(plan_intervals(1.0)) == 3
