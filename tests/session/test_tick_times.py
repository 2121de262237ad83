"""Causes of late ticks: a pacing loop with its own clock, whose parts take too long in turn."""

from __future__ import annotations

import pytest

from iris_session.physics import PacerStats
from iris_session.protocol.names import LateCause
from iris_session.session.tick_times import CAUSES, SKIPPED, TickTimes

MS = 1_000_000
PERIOD = 2 * MS
#: How long the parts take when all is well [ns].
USUAL = {LateCause.AUTHORITY: 100_000, LateCause.CONTROL: 150_000, LateCause.PHYSICS: 600_000, LateCause.OUTPUT: 80_000}


class Loop:
    """The pacing of `Session.run`, with a clock that moves only when something is done, and with time in which the
    thread was kept from running."""

    def __init__(self) -> None:
        self.now_ns = 0
        self.delayed_ns = 0
        self.due_ns = PERIOD
        self.late = 0
        self.ticks = 0
        self.times = TickTimes(PERIOD, lambda: self.now_ns, lambda: self.delayed_ns)

    def work(self, ns: int, *, delayed: bool = False) -> None:
        self.now_ns += ns
        self.delayed_ns += ns * delayed

    def tick(self, extra: dict[str, int] | None = None, *, delayed: bool = False, overslept_ns: int = 0) -> None:
        """Take one tick; `extra`: time per part in which the thread worked, waited or got no processor."""
        extra = extra or {}
        if self.now_ns < self.due_ns:
            self.now_ns = self.due_ns + overslept_ns
            self.times.begin_chain(self.due_ns)
        for cause in (LateCause.AUTHORITY, LateCause.CONTROL, LateCause.PHYSICS, LateCause.OUTPUT):
            self.work(USUAL[cause])
            self.work(extra.get(cause, 0), delayed=delayed)
            self.times.lap(cause)
        lateness = self.now_ns - self.due_ns
        self.times.finish_tick(lateness)
        self.ticks += 1
        self.late += lateness > PERIOD
        self.due_ns += PERIOD
        for cause in (LateCause.SUPERVISION, LateCause.OWNER):
            self.work(extra.get(cause, 0), delayed=delayed)
            self.times.lap(cause)

    def mark(self, missing: int = 0) -> None:
        none = PacerStats._make([0] * len(PacerStats._fields))
        ticks = self.ticks + missing
        self.times.mark(none._replace(ticks=ticks, finished=self.ticks, late=self.late, missing=missing))


@pytest.fixture
def loop() -> Loop:
    loop = Loop()
    for _ in range(2000):
        loop.tick()
    loop.mark()
    return loop


@pytest.mark.parametrize("cause", [c for c in CAUSES if c not in (LateCause.SCHEDULER, LateCause.OWNER)])
def test_slow_part_is_the_cause(loop: Loop, cause: str) -> None:
    loop.tick({cause: 7 * MS})
    for _ in range(50):
        loop.tick()
    loop.mark()
    assert loop.late > 2, "a pause of 7 ms makes several ticks late: those are caught up one after the other"
    assert loop.times.count_late_causes() == {cause: loop.late}


@pytest.mark.parametrize("cause", [c for c in CAUSES if c != LateCause.SCHEDULER])
def test_preempted_part_is_not_the_cause(loop: Loop, cause: str) -> None:
    loop.tick({cause: 7 * MS}, delayed=True)
    for _ in range(50):
        loop.tick()
    loop.mark()
    assert set(loop.times.count_late_causes()) == {LateCause.SCHEDULER}


def test_suspended_process_is_a_cause_of_its_own(loop: Loop) -> None:
    loop.tick(overslept_ns=3_000 * MS)
    loop.times.count_skipped(1400)
    loop.mark(missing=1400)
    assert loop.times.count_late_causes() == {LateCause.SCHEDULER: 1, SKIPPED: 1400}


def test_shares_cover_the_last_ten_marks() -> None:
    loop = Loop()
    loop.mark()
    loop.tick({LateCause.PHYSICS: 7 * MS})
    for _ in range(10):
        loop.tick()
    loop.mark()
    assert loop.times.compute_late_share() > 0.0
    for _ in range(10):
        loop.tick()
        loop.mark()
    assert loop.times.compute_late_share() == 0.0
    assert loop.times.count_late_causes() == {}
