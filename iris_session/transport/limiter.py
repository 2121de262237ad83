"""Token buckets and drop counters. Pure: time comes in as nanoseconds."""

from __future__ import annotations

import msgspec


class TokenBucket:
    """Allows `burst` at once and `rate` per second on average."""

    __slots__ = ("_burst", "_last_ns", "_rate", "_tokens")

    def __init__(self, rate: float, burst: float) -> None:
        self._rate = rate
        self._burst = burst
        self._tokens = burst
        self._last_ns = 0

    def take(self, now_ns: int) -> bool:
        """Uses one token; false when there is none."""
        tokens = min(self._burst, self._tokens + (now_ns - self._last_ns) * 1e-9 * self._rate)
        self._last_ns = now_ns
        if tokens < 1.0:
            self._tokens = tokens
            return False
        self._tokens = tokens - 1.0
        return True


class Drops(msgspec.Struct):
    """What was thrown away: by reason, and by connection. `version` grows with every drop.

    The connection map keeps the connections that exist: `forget` moves one out when it is gone.
    """

    by_reason: dict[str, int] = {}
    by_connection: dict[int, int] = {}
    version: int = 0

    def count(self, reason: str, connection: int = 0, n: int = 1) -> None:
        self.by_reason[reason] = self.by_reason.get(reason, 0) + n
        if connection:
            self.by_connection[connection] = self.by_connection.get(connection, 0) + n
        self.version += 1

    def forget(self, connection: int) -> None:
        self.by_connection.pop(connection, None)
