"""Hellos within bounds, of which everybody has a share: whoever says too many uses up only what is for all."""

from __future__ import annotations

from typing import Final

from iris_session.link.config import FrontLimits
from iris_session.protocol.limits import TokenBucket

MAX_SOURCES: Final = 256


class HelloShares:
    """A source is an allowed key, or on a session without keys an address. Each has a few hellos of its own, so that a
    newcomer gets in whatever another one does; beyond them it takes of those that all share."""

    def __init__(self, limits: FrontLimits) -> None:
        self._limits = limits
        self._shared = TokenBucket(limits.hellos_per_second, limits.hello_burst)
        self._own: dict[str, TokenBucket] = {}  # the one that was used last comes last

    def take(self, source: str, now_ns: int) -> bool:
        """Whether one more hello may be looked at."""
        own = self._own.pop(source, None)
        if own is None:
            own = TokenBucket(self._limits.hellos_per_source, self._limits.hello_source_burst, now_ns)
            while len(self._own) >= MAX_SOURCES:
                del self._own[next(iter(self._own))]
        self._own[source] = own
        return own.take(now_ns) or self._shared.take(now_ns)


def connections_of_one(limit: int) -> int:
    """Of `limit` connections, how many one key (or one gateway) may have: the rest is for others."""
    return limit - limit // 4
