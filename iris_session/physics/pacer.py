"""The pacing of our own loop as pure arithmetic on session time: no clock is read here.

Tick k (1, 2, ...) is due at `start + k * period`, a grid that is never moved except by `resume` and, when another scene
has another timestep, by `change_period`. A tick
is late when it finishes more than one period after it was due; one that never ran is late too.

Falling behind: overdue ticks are run one after the other, each still late by its own deadline, so a short hiccup is
caught up and the simulation stays on the wall clock. Catching up more than `max_backlog_ns` (1 s) would be seen as
fast motion, so beyond it `skip_backlog` gives up the overdue ticks: they count as late, simulated time stays behind by
them, and the grid stays where it is.
"""

from __future__ import annotations

from typing import Final, NamedTuple

MAX_BACKLOG_NS: Final = 1_000_000_000
#: Sub-buckets per octave: a percentile is overstated by at most 1/32.
_SUB_BITS: Final = 5
_MAX_BITS: Final = 42  # lateness above 2^42 ns (73 min) falls into the last bucket


class PacerStats(NamedTuple):
    """Since the start, pauses excluded. `ticks` includes the missing ones (overdue by more than a period, or skipped).

    Percentiles [ns] are over the lateness of finished ticks, rounded up by at most 3 %.
    """

    ticks: int
    finished: int
    late: int
    missing: int
    late_share: float
    p50_ns: int
    p99_ns: int
    max_ns: int


class Pacer:
    """Deadlines `start_ns + k * period_ns`. All times are session time [ns]."""

    def __init__(self, period_ns: int, start_ns: int, max_backlog_ns: int = MAX_BACKLOG_NS) -> None:
        if period_ns <= 0 or max_backlog_ns < period_ns:
            raise ValueError(f"period {period_ns} ns must be positive and at most the backlog {max_backlog_ns} ns")
        self.period_ns = period_ns
        self.max_backlog_ns = max_backlog_ns
        self.paused = False
        self._start_ns = start_ns
        self._done = 0  # grid index of the last tick that was finished or skipped
        self._finished = self._late = self._missing = self._max_ns = 0
        self._buckets = [0] * ((_MAX_BITS - _SUB_BITS + 1) << _SUB_BITS)

    @property
    def next_deadline_ns(self) -> int:
        """Session time at which the next tick is due [ns]."""
        return self._start_ns + (self._done + 1) * self.period_ns

    def count_ticks_due(self, now_ns: int) -> int:
        """Return how many ticks are due and not done; 0 while paused. Run one per step and call `finish_tick` after
        each.
        """
        if self.paused:
            return 0
        return max(0, (now_ns - self._start_ns) // self.period_ns - self._done)

    def finish_tick(self, now_ns: int) -> int:
        """Account one tick as done at `now_ns`; return its lateness [ns], 0 when not after its deadline."""
        lateness = max(0, now_ns - self.next_deadline_ns)
        self._done += 1
        self._finished += 1
        self._late += lateness > self.period_ns
        self._max_ns = max(self._max_ns, lateness)
        self._buckets[_find_bucket(lateness)] += 1
        return lateness

    def skip_backlog(self, now_ns: int) -> int:
        """Skip all overdue ticks but the newest when more than `max_backlog_ns` behind; return how many.
        Once a step.
        """
        if self.paused or now_ns - self.next_deadline_ns <= self.max_backlog_ns:
            return 0
        ticks = self.count_ticks_due(now_ns) - 1
        self._done += ticks
        self._missing += ticks
        return ticks

    def pause(self, now_ns: int) -> None:
        """Stop the grid; ticks that are overdue by more than a period now are missing for good."""
        if not self.paused:
            self._missing += self._count_overdue(now_ns)
            self.paused = True

    def resume(self, now_ns: int) -> None:
        """Start a new grid at `now_ns`. Nothing happens when not paused."""
        if self.paused:
            self.paused = False
            self._start_ns = now_ns
            self._done = 0

    def change_period(self, period_ns: int, began_ns: int, now_ns: int) -> None:
        """Start a new grid after a tick from `began_ns` to `now_ns` that loaded a scene with ticks of `period_ns`.

        By the old grid this tick is as late as it began, so that loading the scene makes nothing late; other ticks
        overdue then by more than a period are missing for good. While paused no tick is accounted.
        """
        if not 0 < period_ns <= self.max_backlog_ns:
            raise ValueError(f"period {period_ns} ns must be positive and at most the backlog {self.max_backlog_ns} ns")
        if not self.paused:
            self.finish_tick(began_ns)
            self._missing += self._count_overdue(began_ns)
        self.period_ns = period_ns
        self._start_ns = now_ns
        self._done = 0

    def _count_overdue(self, now_ns: int) -> int:
        """Return the ticks that can only be late now: due more than a period ago and not done."""
        return max(0, -(-(now_ns - self._start_ns) // self.period_ns) - 2 - self._done)

    def get_stats(self, now_ns: int, *, anew: bool = False) -> PacerStats:
        """Return the accounting up to `now_ns`; ticks overdue by more than a period count as missing.

        `anew`: percentiles and maximum are of the ticks from here on; the counts stay.
        """
        missing = self._missing + (0 if self.paused else self._count_overdue(now_ns))
        ticks, late = self._finished + missing, self._late + missing
        share = late / ticks if ticks else 0.0
        p50, p99 = self._get_percentile(0.50), self._get_percentile(0.99)
        stats = PacerStats(ticks, self._finished, late, missing, share, p50, p99, self._max_ns)
        if anew:
            self._max_ns = 0
            self._buckets = [0] * len(self._buckets)
        return stats

    def _get_percentile(self, share: float) -> int:
        """Return the upper edge of the bucket that holds the share, 0 without ticks."""
        wanted = share * sum(self._buckets)
        count = 0
        for index, n in enumerate(self._buckets):
            count += n
            if n and count >= wanted:
                return min(_upper_edge(index), self._max_ns)
        return 0


def _find_bucket(value: int) -> int:
    """Return the index in a histogram with exact counts below 2^6 ns and 32 buckets per octave above."""
    value = min(value, (1 << _MAX_BITS) - 1)
    shift = max(0, value.bit_length() - _SUB_BITS - 1)
    return (shift << _SUB_BITS) + (value >> shift)


def _upper_edge(index: int) -> int:
    """Return the largest value of a bucket."""
    shift = max(0, (index >> _SUB_BITS) - 1)
    return ((index - (shift << _SUB_BITS) + 1) << shift) - 1
