"""Token buckets and drop counters. Pure: time comes in as nanoseconds."""

from __future__ import annotations

from typing import Final

import msgspec

_TOKEN: Final = 1_000_000_000


class TokenBucket:
    """Allows `burst` at once and `rate` per second on average. Counts in nano-tokens, so it is exact."""

    __slots__ = ("_full", "_last_ns", "_rate", "_tokens")

    def __init__(self, rate: float, burst: int, now_ns: int = 0) -> None:
        self._rate = rate
        self._full = burst * _TOKEN
        self._tokens = self._full
        self._last_ns = now_ns

    def take(self, now_ns: int) -> bool:
        """Uses one token; false when there is none."""
        self._tokens = min(self._full, self._tokens + int((now_ns - self._last_ns) * self._rate))
        self._last_ns = now_ns
        if self._tokens < _TOKEN:
            return False
        self._tokens -= _TOKEN
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
