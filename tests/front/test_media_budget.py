"""The budget controller against simulated links: which levels fall and rise, how often, and what never happens."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iris_session.front.media.budget import (
    NONE_LEVEL,
    RAISE_NS,
    BudgetController,
    BudgetGrant,
    LinkMeasure,
    Rates,
    StateReport,
    build_ladder,
    compute_cost,
    select_levels,
)

MBIT = 125_000.0  # bytes per second
STEP_NS = 250_000_000
SECOND = 1_000_000_000
CLOUD = {"cloud": (20 * MBIT, 10 * MBIT, 5 * MBIT)}
BOTH = {**CLOUD, "cloth": (2 * MBIT, 1 * MBIT, 0.5 * MBIT)}


class Link:
    """One way for state and media: what does not fit waits, up to 256 KiB, and state waits behind it."""

    def __init__(self, mbit: float, age_ms: float = 10.0) -> None:
        self.capacity = mbit * MBIT
        self.age_ms = age_ms
        self.waiting = 0.0
        self.controller = BudgetController()
        self.now_ns = 0
        self.grants: list[tuple[int, BudgetGrant]] = []
        self._taken = (0, 0)

    def play(self, seconds: float, rates: Rates = CLOUD, limit: float = 0.0) -> BudgetGrant:
        """The last grant of that time. A report every second, a look every quarter."""
        for _ in range(int(seconds * 4)):
            self.now_ns += STEP_NS
            levels = self.grants[-1][1].levels if self.grants else dict.fromkeys(rates, 0)
            sent = compute_cost(rates, levels) / 4
            room = max(0.0, 262_144 - self.waiting + self.capacity / 4)
            taken = min(sent, room)
            self.waiting = max(0.0, self.waiting + taken - self.capacity / 4)
            report = None
            if self.now_ns % SECOND == 0 and self.capacity:
                report = StateReport(self.age_ms + 1e3 * self.waiting / self.capacity, 0.0)
            due = 15 if sent else 0
            look = LinkMeasure(report, round(due * taken / sent) if sent else 0, due, limit)
            self.grants.append((self.now_ns, self.controller.update(7, look, rates, self.now_ns)))
        return self.grants[-1][1]

    def rises(self) -> list[int]:
        """When a stream was given more."""
        pairs = itertools.pairwise(self.grants)
        return [b[0] for a, b in pairs if any(b[1].levels[s] < a[1].levels.get(s, NONE_LEVEL) for s in b[1].levels)]


def test_enough_for_everything_stays_so() -> None:
    grant = Link(100).play(60, BOTH)
    assert grant == BudgetGrant({"cloud": 0, "cloth": 0})


def test_a_link_for_a_part_gets_a_part_within_two_seconds_and_no_more() -> None:
    link = Link(8)
    link.play(1.75)
    assert link.grants[-1][1].levels["cloud"] > 0, "lowered within 1.75 s"
    assert link.grants[-1][1].reason
    assert link.grants[-1][1].bytes_per_s <= 8 * MBIT
    link.play(20)
    assert link.grants[-1][1].levels["cloud"] == 2
    held = [grant.levels["cloud"] for now, grant in link.grants if now > 10 * SECOND]
    assert held.count(2) > 0.8 * len(held)


def test_what_was_lowered_comes_back_when_the_link_does() -> None:
    link = Link(6)
    link.play(20)
    link.capacity = 100 * MBIT
    link.play(60)
    assert link.grants[-1][1] == BudgetGrant({"cloud": 0})


def test_a_dead_link_gets_nothing_and_a_silent_client_neither() -> None:
    link = Link(8)
    link.play(5)
    link.capacity = 0.0
    assert link.play(4).levels == {"cloud": NONE_LEVEL}
    silent = BudgetController()
    silent.update(1, LinkMeasure(StateReport(10.0, 0.0)), CLOUD, 0)
    grant = silent.update(1, LinkMeasure(None), CLOUD, 4 * SECOND)
    assert (grant.levels, grant.reason) == ({"cloud": NONE_LEVEL}, "the client has not reported for 3 s")


def test_trouble_that_media_do_not_make_is_learnt() -> None:
    """The client has moved to a network with 200 ms: that is how it is now."""
    link = Link(100)
    link.play(10)
    link.age_ms = 210.0
    link.play(10)
    assert any(grant.levels["cloud"] == NONE_LEVEL for _, grant in link.grants)
    link.play(60)
    assert link.grants[-1][1].levels == {"cloud": 0}


def test_missed_state_counts() -> None:
    controller = BudgetController()
    controller.update(1, LinkMeasure(StateReport(10.0, 0.0)), CLOUD, 0)
    grant = controller.update(1, LinkMeasure(StateReport(10.0, 0.7)), CLOUD, SECOND)
    assert (grant.levels["cloud"], grant.reason) == (1, "70 % of state was missed")


def test_a_display_of_30_hz_misses_half_of_it_always() -> None:
    controller = BudgetController()
    for second in range(30):
        grant = controller.update(1, LinkMeasure(StateReport(18.0, 0.5)), CLOUD, second * SECOND)
    assert grant.levels["cloud"] == 0


def test_a_client_may_ask_for_less_and_take_it_back() -> None:
    link = Link(100)
    grant = link.play(10, limit=6 * MBIT)
    assert (grant.levels, grant.bytes_per_s, grant.reason) == (
        {"cloud": 2},
        6 * MBIT,
        "the client asked for no more",
    )
    assert link.play(20).levels == {"cloud": 0}


def test_a_new_stream_waits_where_there_is_too_much() -> None:
    link = Link(8)
    link.play(5)
    link.play(0.25, BOTH)
    assert link.grants[-1][1].levels["cloth"] == NONE_LEVEL
    controller = link.controller
    controller.remove(7)
    assert controller.update(7, LinkMeasure(None), BOTH, link.now_ns).levels == {"cloud": 0, "cloth": 0}


def test_the_ladder_begins_with_what_costs_most() -> None:
    steps = build_ladder(BOTH)
    assert (steps[0], steps[1], steps[-1]) == (
        {"cloth": 0, "cloud": 0},
        {"cloth": 0, "cloud": 1},
        {"cloth": NONE_LEVEL, "cloud": NONE_LEVEL},
    )
    assert select_levels(BOTH, 8 * MBIT) == {"cloth": 0, "cloud": 2}
    assert select_levels(BOTH, 0.0) == {"cloth": NONE_LEVEL, "cloud": NONE_LEVEL}


rates_of_streams = st.dictionaries(
    st.sampled_from("abcd"), st.tuples(*[st.floats(0.0, 1e7)] * 3), min_size=1, max_size=4
)


@given(rates_of_streams, st.floats(0.0, 5e7), st.floats(0.0, 5e7))
@settings(max_examples=40, deadline=None)
def test_more_budget_is_never_less_of_any_stream(rates: dict[str, tuple[float, ...]], one: float, other: float) -> None:
    less, more = sorted((one, other))
    low, high = select_levels(rates, less), select_levels(rates, more)
    assert all(high[stream] <= low[stream] for stream in rates)
    assert compute_cost(rates, low) <= less


@given(st.floats(0.3, 60.0), st.floats(1.0, 120.0))
@settings(max_examples=12, deadline=None)
def test_a_constant_link_is_not_tried_often(mbit: float, age_ms: float) -> None:
    link = Link(mbit, age_ms)
    link.play(120)
    rises = link.rises()
    assert all(b - a >= RAISE_NS for a, b in itertools.pairwise(rises))
    last_minute = [now for now in rises if now > 60 * SECOND]
    assert len(last_minute) <= 8
    fitting = compute_cost(CLOUD, select_levels(CLOUD, 0.95 * link.capacity))
    means = [compute_cost(CLOUD, grant.levels) for now, grant in link.grants if now > 60 * SECOND]
    assert sum(means) / len(means) >= 0.5 * fitting, "what fits is given most of the time"


@given(st.floats(0.3, 100.0), st.floats(2.0, 30.0))
@settings(max_examples=12, deadline=None)
def test_a_link_that_dies_gets_nothing(mbit: float, after_s: float) -> None:
    link = Link(mbit)
    link.play(after_s)
    link.capacity = 0.0
    link.play(5)
    assert all(level == NONE_LEVEL for level in link.play(20).levels.values())


@pytest.mark.parametrize("mbit", [0.0, 1.0])
def test_no_streams_no_grant(mbit: float) -> None:
    assert Link(mbit).play(5, {}).levels == {}
