"""Intervals of a window: plans, and the age of state within them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from iris_session.bench.cloud_stream import plan_stream
from iris_session.bench.harness import (
    BASELINE,
    SHORTEST_STALL_S,
    Interval,
    compute_age_p99_ms,
    measure_after_stall,
    plan_rounds,
    summarize_runs,
    summarize_stalls,
)
from iris_session.bench.slow_client import STALLED, STOPPED
from iris_session.bench.web import FROZEN, LENGTHS_S, LOADING

MS = 1_000_000
BEGIN = 5_000 * MS
STRETCH = Interval(STOPPED, 10.0, 15.0)  # stall from 10.5 to 13.5 s


def _log(frames: list[tuple[float, float]]) -> dict[str, np.ndarray]:
    """Frames as (handed out, age), both ms, from the beginning of the window."""
    handed = np.array([BEGIN + round(at * MS) for at, _ in frames], np.int64)
    return {"handed_ns": handed, "state_ns": handed - np.array([round(age * MS) for _, age in frames], np.int64)}


def test_first_and_first_fresh_frame_after_a_stall() -> None:
    steady = [(10_000.0 + 16 * i, 2.0) for i in range(30)]
    log = _log([*steady, (13_504.0, 900.0), (13_510.0, 40.0), (13_512.0, 21.0), (13_530.0, 2.0), (14_999.0, 2.0)])
    resumed = {STRETCH: BEGIN + 13_502 * MS}
    # 21 ms are within 20 ms of the usual 2 ms
    assert measure_after_stall(log, BEGIN, STRETCH, resumed[STRETCH]) == (900.0, 10.0)
    expected = {"link_resume_first_age_ms": 900.0, "link_resume_fresh_after_ms": 10.0}
    assert summarize_stalls(log, BEGIN, resumed, STOPPED, "link_") == expected
    for late in ([], [(15_001.0, 2.0)]):  # the last belongs to the next interval
        nothing = measure_after_stall(_log([*steady, *late]), BEGIN, STRETCH, resumed[STRETCH])
        assert nothing == (math.inf, math.inf)


def test_ages_are_those_between_two_times() -> None:
    calm = _log([(10_000.0 + i, 50.0 if i < 500 else 3.0) for i in range(5_000)])
    assert compute_age_p99_ms([calm], BEGIN, STRETCH.stall_s, STRETCH.end_s) == 3.0
    assert compute_age_p99_ms([calm], BEGIN, 0.0, 9.0) == math.inf
    assert summarize_runs("age", [1.0, 9.0, 2.0]) == {"age": 2.0, "age_runs": {"1": 1.0, "2": 9.0, "3": 2.0}}


@pytest.mark.parametrize("seconds", [50.0, 1.0])
def test_rounds_fill_the_time_and_leave_room_for_the_stalls(seconds: float) -> None:
    plan = plan_rounds(dict.fromkeys((BASELINE, STOPPED, STALLED), SHORTEST_STALL_S), seconds, 3)
    assert [one.kind for one in plan] == [BASELINE, STOPPED, STALLED] * (3 if seconds == 50.0 else 1)
    assert plan[-1].end_s == max(seconds, 3 * SHORTEST_STALL_S)
    assert all(one.end_s - one.resume_s >= 1.0 - 1e-9 for one in plan)


def test_plans_of_streams_and_browsers() -> None:
    assert [one.kind for one in plan_stream(20.0)] == ["without", "with"] * 4
    assert plan_stream(20.0)[-1].end_s == pytest.approx(20.0)
    assert [one.kind for one in plan_stream(20.0, slow=True)] == ["with", "slow", "slow_without"]
    plan = plan_rounds(LENGTHS_S, 57.0, 3)
    assert [one.kind for one in plan] == [BASELINE, FROZEN, LOADING] * 3
    assert plan[-1].end_s == 57.0
    assert [len(plan_rounds(LENGTHS_S, seconds, 3)) for seconds in (1.0, 300.0)] == [3, 9]
