"""The path from a headset to the session: latency, jitter and stalls, in the order that TCP keeps. Reads no clock."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

import msgspec
import numpy as np

T = TypeVar("T")


class LinkModel(msgspec.Struct, frozen=True):
    """Delay of one direction of a wireless link.

    `latency_s`: tracking run time and radio, least. `jitter_s`: mean of the exponential part on top. `stall_every_s`:
    mean time between stalls (0: none), in which nothing passes for `stall_s`; then everything arrives at once.
    """

    latency_s: float = 0.008
    jitter_s: float = 0.002
    stall_every_s: float = 0.0
    stall_s: float = 0.03


class DelayLine(Generic[T]):
    """A queue that releases items when they arrive, in order: a late item delays those behind it."""

    def __init__(self, model: LinkModel, rng: np.random.Generator) -> None:
        self.model = model
        self.stalls = 0
        self._rng = rng
        self._items: deque[tuple[int, T]] = deque()
        self._last_ns = 0
        self._next_stall_ns: int | None = None

    def __len__(self) -> int:
        return len(self._items)

    def push(self, item: T, now_ns: int) -> None:
        """Send an item at `now_ns`."""
        model = self.model
        arrives = now_ns + int((model.latency_s + self._rng.exponential(1.0) * model.jitter_s) * 1e9)
        arrives = max(arrives, self._last_ns, self._compute_stall_end_ns(now_ns))
        self._last_ns = arrives
        self._items.append((arrives, item))

    def pop(self, now_ns: int) -> list[T]:
        """Return and remove the items that have arrived by `now_ns`."""
        arrived: list[T] = []
        while self._items and self._items[0][0] <= now_ns:
            arrived.append(self._items.popleft()[1])
        return arrived

    @property
    def next_arrival_ns(self) -> int | None:
        """Arrival time of the next item, `None` when the line is empty."""
        return self._items[0][0] if self._items else None

    def _compute_stall_end_ns(self, now_ns: int) -> int:
        model = self.model
        if model.stall_every_s <= 0.0:
            return 0
        if self._next_stall_ns is None:
            self._next_stall_ns = now_ns + self._draw_wait_ns()
        if now_ns < self._next_stall_ns:
            return 0
        end = self._next_stall_ns + int(model.stall_s * 1e9)
        if now_ns >= end:
            self._next_stall_ns = now_ns + self._draw_wait_ns()
            self.stalls += 1
        return end

    def _draw_wait_ns(self) -> int:
        return int(self._rng.exponential(self.model.stall_every_s) * 1e9)
