"""`TickTimes`: laps between the parts of a tick, and for each late tick the part that caused it.

Between two waits of the pacing loop lies a chain of ticks: one while all is well, several while it catches up. A late
tick is attributed to the part whose time in its chain exceeds its usual time the most. Time in which the thread was
ready but did not run counts as the scheduler's, in any part; time in which it waited for something, such as a disk,
stays with its part.

Cost per tick: eight laps and one reading of what the system counts for the thread, about 3 us.
"""

from __future__ import annotations

import os
import threading
import time
from array import array
from collections import deque
from collections.abc import Callable
from typing import Final

import numpy as np

from iris_session.physics import PacerStats
from iris_session.protocol.names import LateCause
from iris_session.protocol.status import Quantiles

CAUSES: Final = (
    LateCause.SCHEDULER,
    LateCause.PHYSICS,
    LateCause.CONTROL,
    LateCause.AUTHORITY,
    LateCause.OUTPUT,
    LateCause.SUPERVISION,
    LateCause.OWNER,
)
#: Ticks that were skipped because a single one took more than a second: suspended, stopped.
SKIPPED: Final = "skipped"
WINDOW_S: Final = 10
MAX_WINDOW_TICKS: Final = 20_000
#: Every so many ticks the usual time of each part is updated, and with which weight.
USUAL_EVERY: Final = 8
USUAL_WEIGHT: Final = 0.05


class TickTimes:
    """Measures one pacing loop with ticks of `period_ns`, from the thread that takes them.

    `delayed` returns how long the thread was ready and did not run so far [ns]; the default asks the system.
    """

    def __init__(self, period_ns: int, clock: Callable[[], int], delayed: Callable[[], int] | None = None) -> None:
        self._clock = clock
        self._delayed = delayed or make_run_delay_reader()
        self._last_ns = clock()
        self._spent = dict.fromkeys(CAUSES, 0)
        self._delayed_ns = self._delayed()
        self._chain = 0
        self._begin(period_ns)
        self._causes = dict.fromkeys((*CAUSES, SKIPPED), 0)
        #: Once a second: ticks and late ones so far, and the causes so far.
        self._marks: deque[tuple[int, int, dict[str, int]]] = deque(maxlen=WINDOW_S + 1)

    def _begin(self, period_ns: int) -> None:
        """Forget usual times and measured ticks."""
        self._period_ns = period_ns
        self._usual = dict.fromkeys(CAUSES, 0.0)
        self._ticks = 0
        size = min(MAX_WINDOW_TICKS, max(1, WINDOW_S * 1_000_000_000 // period_ns))
        self._lateness = array("q", bytes(8 * size))

    def change_period(self, period_ns: int) -> None:
        """Begin anew with the ticks of another scene, which have other costs. Causes and marks stay."""
        self._begin(period_ns)
        self.restart_chain()

    def lap(self, cause: str) -> None:
        """Count the time since the last lap as `cause`."""
        now_ns = self._clock()
        self._spent[cause] += now_ns - self._last_ns
        self._last_ns = now_ns

    def begin_chain(self, due_ns: int) -> None:
        """Begin a chain: the loop has waited for a tick that is due at `due_ns`."""
        spent = self._spent
        for cause in CAUSES:
            spent[cause] = 0
        self._chain = 0
        self._last_ns = now_ns = self._clock()
        spent[LateCause.SCHEDULER] = max(0, now_ns - due_ns)
        self._delayed_ns = self._delayed()

    def restart_chain(self) -> None:
        """Begin a chain after a time without ticks (a pause)."""
        self.begin_chain(self._clock())

    def finish_tick(self, lateness_ns: int) -> None:
        """Count a tick that ended `lateness_ns` after its deadline."""
        self._lateness[self._ticks % len(self._lateness)] = lateness_ns
        self._ticks += 1
        self._chain += 1
        if lateness_ns > self._period_ns:
            self._causes[self._find_cause()] += 1
        elif self._chain == 1 and not self._ticks % USUAL_EVERY:
            for cause in CAUSES:
                self._usual[cause] += USUAL_WEIGHT * (self._spent[cause] - self._usual[cause])

    def count_skipped(self, ticks: int) -> None:
        """Count ticks that were skipped because the loop is too far behind."""
        if ticks:
            self._causes[self._find_cause() if self._chain > 1 else SKIPPED] += ticks

    def _find_cause(self) -> str:
        """Return the part with the largest excess; the scheduler's share is taken from the others in proportion."""
        excess = {cause: max(0.0, self._spent[cause] - self._chain * self._usual[cause]) for cause in CAUSES}
        delayed_ns = self._delayed() - self._delayed_ns
        others = sum(excess.values()) - excess[LateCause.SCHEDULER]
        left = max(0.0, 1.0 - delayed_ns / others) if others else 0.0
        for cause in CAUSES[1:]:
            excess[cause] *= left
        excess[LateCause.SCHEDULER] += delayed_ns
        return max(CAUSES, key=excess.__getitem__)

    def mark(self, stats: PacerStats) -> None:
        """Store the counters; call once a second. Shares of the last ten seconds are differences to a mark."""
        self._marks.append((stats.ticks, stats.late, dict(self._causes)))

    def compute_late_share(self) -> float:
        """Return the share of late ticks of the last ten seconds (between the marks)."""
        if len(self._marks) < 2:
            return 0.0
        (ticks0, late0, _), (ticks1, late1, _) = self._marks[0], self._marks[-1]
        return max(0, late1 - late0) / (ticks1 - ticks0) if ticks1 > ticks0 else 0.0

    def count_late_causes(self) -> dict[str, int]:
        """Return the late ticks of the last ten seconds by cause, without zeros."""
        if len(self._marks) < 2:
            return {}
        before, now = self._marks[0][2], self._marks[-1][2]
        return {cause: now[cause] - before[cause] for cause in now if now[cause] > before[cause]}

    def compute_lateness(self) -> Quantiles | None:
        """Return the lateness of the ticks of the last ten seconds [ms], `None` before the first."""
        n = min(self._ticks, len(self._lateness))
        if not n:
            return None
        last = n - 1
        ranks = (last // 2, -(-last * 99 // 100))
        values = np.partition(np.frombuffer(self._lateness, np.int64)[:n], ranks)
        return Quantiles(float(values[ranks[0]]) * 1e-6, float(values[ranks[1]]) * 1e-6)


def make_run_delay_reader() -> Callable[[], int]:
    """Return a function that reads how long the calling thread was ready and did not run [ns].

    Linux counts exactly that; elsewhere it is the time in which the thread did not run, so waiting for a disk counts
    too.
    """
    try:
        return _RunDelay(threading.get_native_id())
    except OSError:
        return lambda: time.monotonic_ns() - time.thread_time_ns()


class _RunDelay:
    """Second number of `/proc/<pid>/task/<tid>/schedstat` (Documentation/scheduler/sched-stats.rst)."""

    def __init__(self, thread: int) -> None:
        self._fd = -1
        self._fd = os.open(f"/proc/self/task/{thread}/schedstat", os.O_RDONLY | os.O_CLOEXEC)

    def __call__(self) -> int:
        return int(os.pread(self._fd, 64, 0).split()[1])

    def __del__(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
