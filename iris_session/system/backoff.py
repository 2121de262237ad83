"""Growing delays between attempts. Pure: the caller keeps the time, in its own unit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, TypeVar

Delay = TypeVar("Delay", int, float)


class Backoff(Generic[Delay]):
    """Delays before successive attempts; the last one repeats until `reset`.

    Args:
        delays: In the caller's unit, at least one.
    """

    __slots__ = ("_delays", "failures")

    def __init__(self, delays: Sequence[Delay]) -> None:
        self._delays: tuple[Delay, ...] = tuple(delays)
        #: Attempts since the last `reset`.
        self.failures = 0

    def next_delay(self) -> Delay:
        """Return the delay before the next attempt, and count it."""
        delay: Delay = self._delays[min(self.failures, len(self._delays) - 1)]
        self.failures += 1
        return delay

    def reset(self) -> None:
        """Begin again with the first delay."""
        self.failures = 0
