"""Estimate of session time from four-timestamp exchanges. Pure: the caller passes its own monotonic clock in.

Each exchange gives an offset `((t1 - t0) + (t2 - t3)) / 2` whose error is at most half its round trip, for any
asymmetry of the path, plus drift since. The estimate is the median offset of the quickest quarter of a window, kept
within the intersection of those intervals (Marzullo), which is also the stated error bound. After the first exchange it
is slewed, so that session time does not run backwards. It is stepped only when the exchanges prove it impossible, as
after sleep of the machine, during which its clock stood still.
"""

from __future__ import annotations

from collections import deque
from statistics import median
from typing import NamedTuple

WINDOW = 32  # exchanges; a quarter of a minute at two per second
MAX_AGE_NS = 60_000_000_000  # older exchanges no longer count
SETTLED = 4  # exchanges before the estimate is used: a single one may have been delayed by a busy machine
SLEW = 0.01  # the estimate moves by 10 ms per second: invisible in 150 ms freshness, monotonic
LARGE_NS = 5_000_000  # samples from further in the future are rejected, so larger corrections are slewed ...
SLEW_LARGE = 0.1  # ... by 100 ms per second, so that a busy link at the start does not prevent driving for seconds
DRIFT = 100e-6  # two quartz clocks of +-50 ppm each
JUMP = 4  # exchanges in a row that contradict all earlier ones: the local clock has jumped, earlier ones are invalid
BURST = 8  # exchanges at the start and after a reset ...
BURST_PERIOD_NS = 5_000_000  # ... at this period, then
PERIOD_NS = 500_000_000  # at this one; pongs also show that the front is alive


class Exchange(NamedTuple):
    """One exchange: `at_ns` on the client's clock, offset session - client clock, round trip without server time."""

    at_ns: int
    offset_ns: int
    rtt_ns: int


class ClockSync:
    """Maps the client's monotonic clock to session time.

    All `local_ns` arguments are nanoseconds of one monotonic clock of the caller.
    """

    def __init__(self) -> None:
        self.rejected = 0
        self.reset()

    def reset(self) -> None:
        """Clear everything, for another session."""
        self._target = 0
        self._offset = 0
        self._offset_at = 0
        self._rtt = 0
        # No exchange agrees with this interval, so the first one is taken as it is.
        self._low, self._high = 2**62, -(2**62)
        self.restart()

    def restart(self) -> None:
        """Measure again after a new connection to the session: the machine may have slept.

        Until the first exchange the old estimate stays, and after it too unless it has become impossible.
        """
        self._window: deque[Exchange] = deque(maxlen=WINDOW)
        self._contradicting: list[Exchange] = []
        self._next_ping = 0
        self._sent = 0

    @property
    def synced(self) -> bool:
        """True after the first exchange."""
        return bool(self._window)

    @property
    def settled(self) -> bool:
        """True when there were enough exchanges to stamp samples."""
        return len(self._window) >= SETTLED

    @property
    def rtt_ns(self) -> int:
        """Shortest round trip in the window [ns], 0 before the first exchange."""
        return self._rtt

    def poll_ping(self, local_ns: int) -> bool:
        """Return whether a `ClockPing` is to be sent now, and count it as sent."""
        if local_ns < self._next_ping:
            return False
        self._sent += 1
        self._next_ping = local_ns + (BURST_PERIOD_NS if self._sent < BURST else PERIOD_NS)
        return True

    @property
    def next_ping_ns(self) -> int:
        """Time at which the next ping is due [local ns]."""
        return self._next_ping

    def process_pong(self, t0_ns: int, t1_ns: int, t2_ns: int, t3_ns: int) -> None:
        """Count one exchange: `t0`, `t3` on the client's clock, `t1`, `t2` in session time.

        Impossible ones (time runs backwards, or the server held it longer than the round trip) are rejected.
        """
        rtt = (t3_ns - t0_ns) - (t2_ns - t1_ns)
        if t3_ns < t0_ns or t2_ns < t1_ns or rtt < 0:
            self.rejected += 1
            return
        exchange = Exchange(t3_ns, ((t1_ns - t0_ns) + (t2_ns - t3_ns)) // 2, rtt)
        if self._window and self._contradicts(exchange):
            self._contradicting.append(exchange)
            if len(self._contradicting) < JUMP:
                self._sent = 0  # another burst
                self._next_ping = min(self._next_ping, t3_ns)
                return
            self._window.clear()
            self._window.extend(self._contradicting[:-1])
            jumped = True
        else:
            jumped = not self._window and self._contradicts(exchange)
        self._contradicting = []
        self._window.append(exchange)
        self._estimate(t3_ns, jumped=jumped)

    def _contradicts(self, exchange: Exchange) -> bool:
        """Return whether this exchange and the estimate cannot both be right."""
        reach = _uncertainty(exchange, exchange.at_ns) + int(DRIFT * (exchange.at_ns - self._offset_at))
        return exchange.offset_ns + reach < self._low or exchange.offset_ns - reach > self._high

    def _estimate(self, now_ns: int, *, jumped: bool) -> None:
        offset = self._slewed_offset(now_ns)
        fresh = sorted((e for e in self._window if now_ns - e.at_ns <= MAX_AGE_NS), key=lambda e: e.rtt_ns)
        quickest = fresh[: max(1, len(fresh) // 4)]
        self._low, self._high = _intersect(fresh, now_ns)
        self._target = max(self._low, min(self._high, int(median(e.offset_ns for e in quickest))))
        self._rtt = quickest[0].rtt_ns
        self._offset, self._offset_at = self._target if jumped else offset, now_ns

    def session_ns(self, local_ns: int) -> int:
        """Return session time [ns] at `local_ns`. Meaningless before `synced`."""
        return local_ns + self._slewed_offset(local_ns)

    def local_ns(self, session_ns: int) -> int:
        """Return the client's clock at session time `session_ns`, by the present estimate."""
        return session_ns - self._target

    def error_bound_ns(self, local_ns: int) -> int:
        """Return the bound of the error of `session_ns(local_ns)` [ns]: round trips, drift, and remaining slew."""
        offset = self._slewed_offset(local_ns)
        doubts = [(e.offset_ns, _uncertainty(e, local_ns)) for e in self._contradicting]  # these may be right
        low = min(self._low, *(at - reach for at, reach in doubts)) if doubts else self._low
        high = max(self._high, *(at + reach for at, reach in doubts)) if doubts else self._high
        return max(high - offset, offset - low) + int(DRIFT * abs(local_ns - self._offset_at))

    def _slewed_offset(self, local_ns: int) -> int:
        elapsed, way = max(0, local_ns - self._offset_at), self._target - self._offset
        quick = min(elapsed, max(0, abs(way) - LARGE_NS) / SLEW_LARGE)  # nanoseconds of quick movement
        room = int(SLEW_LARGE * quick + SLEW * (elapsed - quick))
        return self._offset + max(-room, min(room, way))


def _uncertainty(exchange: Exchange, now_ns: int) -> int:
    """Return how far the offset can be from that of an exchange [ns]."""
    return exchange.rtt_ns // 2 + int(DRIFT * (now_ns - exchange.at_ns)) + 1


def _intersect(exchanges: list[Exchange], now_ns: int) -> tuple[int, int]:
    """Return the lowest and highest offset that agree with the exchanges, quickest first, without contradicting
    ones.
    """
    low, high = -(2**63), 2**63
    for exchange in exchanges:
        reach = _uncertainty(exchange, now_ns)
        if exchange.offset_ns - reach <= high and exchange.offset_ns + reach >= low:
            low, high = max(low, exchange.offset_ns - reach), min(high, exchange.offset_ns + reach)
    return low, high
