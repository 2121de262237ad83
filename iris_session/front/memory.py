"""The bound of everything that waits in the front: in libzmq's queues, in ours, in those of subscriptions.

What waits in libzmq cannot be asked for, and a sum of worst cases would let nobody in. So the process is measured: when
it holds more than `bound` above what it had once its sockets were open, those are closed for whom most waits.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Final

import psutil

from iris_session.link.config import MILLISECOND

LOOK_NS: Final = 100 * MILLISECOND
#: libzmq frees what a closed connection held in its own thread.
PATIENCE_NS: Final = 500 * MILLISECOND


class MemoryWatch:
    """A `Service`. `shed` closes somebody and says whom; `told` hears of it."""

    def __init__(
        self,
        bound: int,
        shed: Callable[[], str],
        told: Callable[[str, int], None],
        resident: Callable[[], int] | None = None,
        trim: Callable[[], None] | None = None,
    ) -> None:
        self._bound = bound
        self._shed = shed
        self._told = told
        self._resident = resident or _resident_of_us()
        self._trim = trim or _give_back
        self._base = -1
        self._next_ns = 0

    def turn(self, now_ns: int) -> None:
        """Measures, and makes room where it is needed."""
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + LOOK_NS
        if self._base < 0:
            self._base = self._resident()
        if self._resident() - self._base <= self._bound:
            return
        self._trim()  # what was freed counts until the system has it back
        if self._resident() - self._base <= self._bound:
            return
        whom = self._shed()
        if whom:
            self._told(whom, now_ns)
        self._next_ns = now_ns + PATIENCE_NS

    def close(self) -> None:
        """Nothing was opened."""


def _resident_of_us() -> Callable[[], int]:
    """Without what is mapped from files: assets are, and the system takes those pages back as it likes."""
    process = psutil.Process()

    def resident() -> int:
        info = process.memory_info()
        return int(info.rss - getattr(info, "shared", 0))

    return resident


def _give_back() -> None:
    """Free memory of the C library to the system, where it can (glibc)."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (OSError, AttributeError):
        return
