"""The pacer against a simple model of the same ticks, and its rules for pauses and hiccups."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iris_session.physics import Pacer

MS = 1_000_000
PERIOD = 2 * MS


def run(pacer: Pacer, now_ns: int, costs: list[int]) -> int:
    """Run a session loop: wait for the next deadline, one tick per step. Return the time at the end."""
    for cost in costs:
        now_ns = max(now_ns, pacer.next_deadline_ns)
        assert pacer.count_ticks_due(now_ns) >= 1
        now_ns += cost
        pacer.finish_tick(now_ns)
    return now_ns


def test_late_is_more_than_one_period_after_the_deadline() -> None:
    pacer = Pacer(PERIOD, 0)
    assert pacer.finish_tick(2 * PERIOD) == PERIOD
    assert pacer.get_stats(2 * PERIOD).late == 0
    assert pacer.finish_tick(3 * PERIOD + 1) == PERIOD + 1
    stats = pacer.get_stats(3 * PERIOD + 1)
    assert (stats.ticks, stats.finished, stats.late, stats.missing) == (2, 2, 1, 0)
    assert stats.late_share == 0.5
    assert pacer.finish_tick(3 * PERIOD - 5) == 0


def test_suspended_process_does_not_fast_forward() -> None:
    pacer = Pacer(PERIOD, 0)
    now = run(pacer, 0, [MS // 2] * 10) + 5_000 * MS
    overdue = pacer.count_ticks_due(now)
    gap = pacer.skip_backlog(now)
    assert gap == overdue - 1
    assert pacer.count_ticks_due(now) == 1
    assert pacer.next_deadline_ns % PERIOD == 0, "the grid stays where it was"
    end = run(pacer, now, [MS // 2] * 10)
    stats = pacer.get_stats(end)
    assert stats.missing == overdue - 1
    assert stats.ticks == 20 + overdue - 1
    assert pacer.skip_backlog(end) == 0


def test_pause_and_resume_rebase_deadlines() -> None:
    pacer = Pacer(PERIOD, 0)
    run(pacer, 0, [0] * 5)
    pacer.resume(5 * PERIOD)
    assert pacer.next_deadline_ns == 6 * PERIOD
    pacer.pause(8 * PERIOD)
    pacer.pause(9 * PERIOD)
    assert pacer.count_ticks_due(100 * PERIOD) == 0
    assert pacer.skip_backlog(10_000 * PERIOD) == 0
    assert pacer.get_stats(100 * PERIOD).missing == 1
    pacer.resume(100 * PERIOD + 7)
    assert pacer.next_deadline_ns == 101 * PERIOD + 7
    end = run(pacer, 100 * PERIOD + 7, [0] * 3)
    stats = pacer.get_stats(end)
    assert (stats.finished, stats.missing) == (8, 1)


def test_percentiles_are_within_three_percent() -> None:
    pacer = Pacer(PERIOD, 0)
    rng = random.Random(3)
    lateness = [int(rng.expovariate(1 / MS)) for _ in range(5000)]
    for late in lateness:
        pacer.finish_tick(pacer.next_deadline_ns + late)
    lateness.sort()
    stats = pacer.get_stats(0)
    assert lateness[2499] <= stats.p50_ns <= 1.04 * lateness[2500]
    assert lateness[4949] <= stats.p99_ns <= 1.04 * lateness[4950]
    assert stats.max_ns == lateness[-1]


spells = st.tuples(st.sampled_from([MS // 2, MS, PERIOD, 5 * MS]), st.lists(st.integers(0, 12 * MS), max_size=40))


@settings(max_examples=80)
@given(st.lists(spells, min_size=1, max_size=6), st.integers(0, 10**12), st.integers(0, 50 * MS))
def test_accounting_matches_a_simple_model_across_period_changes(
    parts: list[tuple[int, list[int]]], start: int, swap_ns: int
) -> None:
    """Every part has its own grid; the tick that ends it costs `swap_ns`, which is not counted."""
    pacer = Pacer(parts[0][0], start)
    now, ticks, late = start, 0, 0
    for (period, costs), (next_period, _) in zip(parts, [*parts[1:], parts[0]], strict=True):
        assert pacer.period_ns == period
        for k, cost in enumerate(costs, 1):
            now = max(now, start + k * period) + cost
            pacer.finish_tick(now)
            ticks, late = ticks + 1, late + (now > start + (k + 1) * period)
        done = len(costs) + 1
        began = max(now, start + done * period)
        never_ran = sum(began > start + (k + 1) * period for k in range(done + 1, done + 4000))
        ticks, late = ticks + 1 + never_ran, late + (began > start + (done + 1) * period) + never_ran
        now = start = began + swap_ns
        pacer.change_period(next_period, began, now)
    stats = pacer.get_stats(now)
    assert (stats.ticks, stats.late) == (ticks, late)


def test_invalid_arguments_are_rejected() -> None:
    with pytest.raises(ValueError, match="must be positive"):
        Pacer(0, 0)
    with pytest.raises(ValueError, match="the backlog"):
        Pacer(PERIOD, 0, max_backlog_ns=PERIOD - 1)
    for period in (0, 2_000 * MS):
        with pytest.raises(ValueError, match=r"positive .*the backlog"):
            Pacer(PERIOD, 0).change_period(period, 0, 0)
    assert Pacer(PERIOD, 0).get_stats(0) == (0, 0, 0, 0, 0.0, 0, 0, 0)
    assert Pacer(PERIOD, 0).finish_tick(2**50) > 2**49
