"""The budget controller against simulated links: which levels fall and rise, and how often."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

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
    """A link for state and media: up to 256 KiB are queued, and state waits behind media."""

    def __init__(self, mbit: float, age_ms: float = 10.0) -> None:
        self.capacity = mbit * MBIT
        self.age_ms = age_ms
        self.waiting = 0.0
        self.controller = BudgetController()
        self.now_ns = 0
        self.grants: list[tuple[int, BudgetGrant]] = []
        self._taken = (0, 0)

    def play(
        self, seconds: float, rates: Rates = CLOUD, limit: float = 0.0, newest: Mapping[str, int] | None = None
    ) -> BudgetGrant:
        """Return the last grant of that time, with a report every second and a decision every quarter."""
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
            look = LinkMeasure(report, round(due * taken / sent) if sent else 0, due, limit, newest or {})
            self.grants.append((self.now_ns, self.controller.update(7, look, rates, self.now_ns)))
        return self.grants[-1][1]

    def rises(self) -> list[int]:
        """Return the times at which a stream got more."""
        pairs = itertools.pairwise(self.grants)
        return [b[0] for a, b in pairs if any(b[1].levels[s] < a[1].levels.get(s, NONE_LEVEL) for s in b[1].levels)]


def test_sufficient_link_keeps_full_level() -> None:
    grant = Link(100).play(60, BOTH)
    assert grant == BudgetGrant({"cloud": 0, "cloth": 0})


def test_narrow_link_gets_a_lower_level_within_two_seconds() -> None:
    link = Link(8)
    link.play(1.75)
    assert link.grants[-1][1].levels["cloud"] > 0, "lowered within 1.75 s"
    assert link.grants[-1][1].reason
    assert compute_cost(CLOUD, link.grants[-1][1].levels) <= 8 * MBIT
    link.play(20)
    assert link.grants[-1][1].levels["cloud"] == 2
    held = [grant.levels["cloud"] for now, grant in link.grants if now > 10 * SECOND]
    assert held.count(2) > 0.8 * len(held)


@pytest.mark.parametrize(("mbit", "levels"), [(300, {1}), (20, {4, 5}), (60, {2, 3})])
def test_cloud_on_a_link_that_becomes_slow_is_coarser_or_rarer_but_goes_on(mbit: float, levels: set[int]) -> None:
    """100,000 points of 8 bytes at 60 Hz, with two coarser classes."""
    rates = {"cloud": tuple(384.0 * MBIT * share for share in (1.0, 0.5, 0.25, 0.125, 0.0625, 0.03125))}
    link = Link(1000)
    link.play(5, rates)
    link.capacity = mbit * MBIT
    assert link.play(1, rates).levels["cloud"] > 0, "lowered within a second"
    link.play(2, rates)
    held = [grant.levels["cloud"] for _, grant in link.grants[-8:]]
    link.play(10, rates)
    assert link.grants[-1][1].levels["cloud"] in levels
    assert NONE_LEVEL not in held


def test_frames_are_paced_below_what_a_slow_link_carries() -> None:
    link = Link(1000)
    assert link.play(5).pace == 0.0, "no limit on a link that is fast enough"
    link.capacity = 8 * MBIT
    link.play(15)
    lowered = next(i for i, (_, grant) in enumerate(link.grants) if grant.levels["cloud"])
    drains, later = link.grants[lowered][1].pace, link.grants[-1][1].pace
    assert compute_cost(CLOUD, link.grants[-1][1].levels) < later < 8 * MBIT
    assert 0 < drains < later, "what fills the link drains first"
    link.capacity = 1000 * MBIT
    assert link.play(120) == BudgetGrant({"cloud": 0}), "the link has recovered"


def test_dead_link_and_silent_client_get_nothing() -> None:
    link = Link(8)
    link.play(5)
    link.capacity = 0.0
    assert link.play(4).levels == {"cloud": NONE_LEVEL}
    silent = BudgetController()
    silent.update(1, LinkMeasure(StateReport(10.0, 0.0)), CLOUD, 0)
    grant = silent.update(1, LinkMeasure(None), CLOUD, 4 * SECOND)
    assert (grant.levels, grant.reason) == ({"cloud": NONE_LEVEL}, "the client has not reported for 3 s")


def test_delay_not_caused_by_media_becomes_the_baseline() -> None:
    """The client has moved to a network with a delay of 200 ms."""
    link = Link(100)
    link.play(10)
    link.age_ms = 210.0
    link.play(10)
    assert any(grant.levels["cloud"] == NONE_LEVEL for _, grant in link.grants)
    link.play(60)
    assert link.grants[-1][1].levels == {"cloud": 0}


def test_client_may_lower_and_restore_its_level() -> None:
    link = Link(100)
    grant = link.play(10, limit=6 * MBIT)
    assert (grant.levels, grant.bytes_per_s, grant.reason) == (
        {"cloud": 2},
        6 * MBIT,
        "the client asked for no more",
    )
    assert link.play(20).levels == {"cloud": 0}


MAPS = {**CLOUD, "map": (0.0, 0.0, 0.0), "plan": (0.0, 0.0, 0.0)}


@pytest.mark.parametrize("limit", [0.0, 2 * MBIT])
def test_stream_at_rest_is_given_on_a_full_link_within_half_a_second(limit: float) -> None:
    link = Link(8)
    link.play(5)
    link.play(2, limit=limit)
    cloud = link.grants[-1][1].levels["cloud"]
    assert cloud > 0
    link.play(0.5, MAPS, limit)
    assert link.grants[-1][1].levels == {"cloud": cloud, "map": 0, "plan": 0}


def test_most_expensive_stream_is_lowered_first() -> None:
    steps = build_ladder(BOTH)
    assert (steps[0], steps[1], steps[-1]) == (
        {"cloth": 0, "cloud": 0},
        {"cloth": 0, "cloud": 1},
        {"cloth": NONE_LEVEL, "cloud": NONE_LEVEL},
    )
    assert select_levels(BOTH, 8 * MBIT) == {"cloth": 0, "cloud": 2}
    assert select_levels(BOTH, 0.0) == {"cloth": NONE_LEVEL, "cloud": NONE_LEVEL}


@given(st.floats(0.3, 60.0), st.floats(1.0, 120.0))
@settings(max_examples=12, deadline=None)
def test_constant_link_is_probed_rarely(mbit: float, age_ms: float) -> None:
    link = Link(mbit, age_ms)
    link.play(120)
    rises = link.rises()
    assert all(b - a >= RAISE_NS for a, b in itertools.pairwise(rises))
    last_minute = [now for now in rises if now > 60 * SECOND]
    assert len(last_minute) <= 8
    fitting = compute_cost(CLOUD, select_levels(CLOUD, 0.95 * link.capacity))
    means = [compute_cost(CLOUD, grant.levels) for now, grant in link.grants if now > 60 * SECOND]
    assert sum(means) / len(means) >= 0.5 * fitting, "what fits is given most of the time"
