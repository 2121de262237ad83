"""The pacer against a plain reckoning of the same ticks, and its rules for pauses and hiccups."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iris_session.physics import Pacer
from iris_session.physics.pacer import _bucket, _upper_edge

MS = 1_000_000
PERIOD = 2 * MS


def run(pacer: Pacer, now_ns: int, costs: list[int]) -> int:
    """The loop of a session: waits for the next deadline, takes one tick per step. Returns the time at the end."""
    for cost in costs:
        now_ns = max(now_ns, pacer.next_deadline_ns)
        assert pacer.ticks_due(now_ns) >= 1
        now_ns += cost
        pacer.finished(now_ns)
    return now_ns


def test_deadlines_are_never_rebased() -> None:
    pacer = Pacer(PERIOD, start_ns=17)
    assert pacer.next_deadline_ns == 17 + PERIOD
    assert pacer.ticks_due(17 + PERIOD - 1) == 0
    assert pacer.ticks_due(17 + PERIOD) == 1
    run(pacer, 17, [MS, 50 * MS, MS // 10])
    assert pacer.next_deadline_ns == 17 + 4 * PERIOD
    assert pacer.ticks_due(17 + 30 * PERIOD) == 27


def test_late_is_more_than_one_period_after_the_deadline() -> None:
    pacer = Pacer(PERIOD, 0)
    assert pacer.finished(2 * PERIOD) == PERIOD
    assert pacer.stats(2 * PERIOD).late == 0
    assert pacer.finished(3 * PERIOD + 1) == PERIOD + 1
    stats = pacer.stats(3 * PERIOD + 1)
    assert (stats.ticks, stats.finished, stats.late, stats.missing) == (2, 2, 1, 0)
    assert stats.late_share == 0.5
    assert pacer.finished(3 * PERIOD - 5) == 0


def test_missing_ticks_are_late() -> None:
    pacer = Pacer(PERIOD, 0)
    assert pacer.stats(2 * PERIOD).missing == 0
    assert pacer.stats(2 * PERIOD + 1).missing == 1
    stats = pacer.stats(10 * PERIOD)
    assert (stats.ticks, stats.late, stats.missing, stats.late_share) == (8, 8, 8, 1.0)


def test_a_hiccup_is_caught_up_and_counted() -> None:
    pacer = Pacer(PERIOD, 0)
    end = run(pacer, 0, [MS // 2] * 10 + [100 * MS] + [MS // 2] * 200)
    stats = pacer.stats(end)
    assert stats.missing == 0
    assert pacer.skip_backlog(end) == 0
    assert 40 < stats.late < 80
    assert stats.max_ns == 100 * MS
    assert end - pacer.next_deadline_ns < PERIOD


def test_a_suspended_process_is_no_fast_forward() -> None:
    pacer = Pacer(PERIOD, 0)
    now = run(pacer, 0, [MS // 2] * 10) + 5_000 * MS
    overdue = pacer.ticks_due(now)
    gap = pacer.skip_backlog(now)
    assert gap == overdue - 1
    assert pacer.ticks_due(now) == 1
    assert pacer.next_deadline_ns % PERIOD == 0, "the grid stays where it was"
    end = run(pacer, now, [MS // 2] * 10)
    stats = pacer.stats(end)
    assert stats.missing == overdue - 1
    assert stats.ticks == 20 + overdue - 1
    assert pacer.skip_backlog(end) == 0


def test_overload_is_late_with_a_bounded_backlog() -> None:
    """Ticks that cost 1.5 periods: everything is late."""
    pacer = Pacer(PERIOD, 0)
    now, skipped = 0, 0
    for _ in range(4000):
        now = run(pacer, now, [3 * MS])
        skipped += pacer.skip_backlog(now)
        assert now - pacer.next_deadline_ns <= 1_000 * MS
    stats = pacer.stats(now)
    assert skipped > 1000
    assert stats.ticks == pytest.approx(now // PERIOD, abs=3)
    assert stats.late_share > 0.99


def test_pause_and_resume_anchor_anew() -> None:
    pacer = Pacer(PERIOD, 0)
    run(pacer, 0, [0] * 5)
    pacer.resume(5 * PERIOD)
    assert pacer.next_deadline_ns == 6 * PERIOD
    pacer.pause(8 * PERIOD)
    pacer.pause(9 * PERIOD)
    assert pacer.ticks_due(100 * PERIOD) == 0
    assert pacer.skip_backlog(10_000 * PERIOD) == 0
    assert pacer.stats(100 * PERIOD).missing == 1
    pacer.resume(100 * PERIOD + 7)
    assert pacer.next_deadline_ns == 101 * PERIOD + 7
    end = run(pacer, 100 * PERIOD + 7, [0] * 3)
    stats = pacer.stats(end)
    assert (stats.finished, stats.missing) == (8, 1)


def test_percentiles_are_right_within_three_percent() -> None:
    pacer = Pacer(PERIOD, 0)
    rng = random.Random(3)
    lateness = [int(rng.expovariate(1 / MS)) for _ in range(5000)]
    for late in lateness:
        pacer.finished(pacer.next_deadline_ns + late)
    lateness.sort()
    stats = pacer.stats(0)
    assert lateness[2499] <= stats.p50_ns <= 1.04 * lateness[2500]
    assert lateness[4949] <= stats.p99_ns <= 1.04 * lateness[4950]
    assert stats.max_ns == lateness[-1]


@given(st.integers(0, 2**42 - 1))
def test_buckets_hold_their_values_within_three_percent(value: int) -> None:
    edge = _upper_edge(_bucket(value))
    assert value <= edge <= value * (1 + 1 / 32)
    assert _bucket(edge) == _bucket(value)
    assert _bucket(edge + 1) == _bucket(value) + 1 or edge == 2**42 - 1


@settings(max_examples=60)
@given(st.lists(st.integers(0, 20 * MS), min_size=1, max_size=300), st.integers(0, 10**12))
def test_accounting_matches_a_plain_reckoning(costs: list[int], start: int) -> None:
    pacer = Pacer(PERIOD, start)
    now, late = start, 0
    for k, cost in enumerate(costs, 1):
        due = start + k * PERIOD
        now = max(now, due) + cost
        late += now > due + PERIOD
        pacer.finished(now)
    never_ran = [k for k in range(len(costs) + 1, len(costs) + 4000) if now > start + k * PERIOD + PERIOD]
    stats = pacer.stats(now)
    assert (stats.ticks, stats.late) == (len(costs) + len(never_ran), late + len(never_ran))


def test_percentiles_of_a_part_are_of_that_part() -> None:
    pacer = Pacer(PERIOD, 0)
    now = run(pacer, 0, [100 * MS] + [0] * 60)
    assert pacer.stats(now, anew=True).max_ns >= 98 * MS
    now = run(pacer, now, [MS // 2] * 50)
    stats = pacer.stats(now)
    assert stats.p99_ns == stats.max_ns == MS // 2
    assert stats.finished == 111


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="must be positive"):
        Pacer(0, 0)
    with pytest.raises(ValueError, match="at most the backlog"):
        Pacer(PERIOD, 0, max_backlog_ns=PERIOD - 1)
    assert Pacer(PERIOD, 0).stats(0) == (0, 0, 0, 0, 0.0, 0, 0, 0)
    assert Pacer(PERIOD, 0).finished(2**50) > 2**49
