"""Limit on the memory of the front: which connections are closed when its queues hold too much.

Connections of all sockets are compared: the owner (a key, or an address before the key is known) with the most pending
bytes loses its largest connection. A connection that holds little is never closed, however slow it is: that would not
help. `TcpGuard` counts the pending bytes of each socket.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Final

import psutil

from iris_session.link.config import MEBIBYTE, MILLISECOND
from iris_session.link.tcp_guard import PendingConnection
from iris_session.protocol.limits import Drops

MEMORY_PERIOD_NS: Final = 100 * MILLISECOND
#: Pause after an eviction: libzmq frees what a closed connection held in its own thread.
EVICTION_PAUSE_NS: Final = 500 * MILLISECOND
#: Pending bytes of one owner from which it is evicted when memory is short, unless all owners together hold most of
#: what is too much: more than an honest client on a slow link leaves pending.
MIN_EVICT_BYTES: Final = MEBIBYTE // 4
MIN_EVICT_SHARE: Final = 1 / 32  # of the bytes that the front may hold
#: Above this many bytes, freed memory is given back to the system from time to time, so that a flood leaves nothing.
TRIM_BYTES: Final = 16 * MEBIBYTE
TRIM_PERIOD_NS: Final = 5000 * MILLISECOND


def select_largest(connections: Iterable[PendingConnection], min_bytes: int) -> PendingConnection | None:
    """Return the largest connection of the owner with the most pending bytes, `None` when that is below `min_bytes`.

    Of equal ones the last counts: it is the newest.
    """
    sums: dict[str, int] = {}
    largest: dict[str, PendingConnection] = {}
    for one in connections:
        sums[one.owner] = sums.get(one.owner, 0) + one.bytes
        if one.owner not in largest or one.bytes >= largest[one.owner].bytes:
            largest[one.owner] = one
    best = max(sums, key=lambda owner: (sums[owner], largest[owner].bytes), default=None)
    return largest[best] if best is not None and sums[best] >= min_bytes else None


class MemoryGuard:
    """Bound the memory of the front: queues of libzmq, our own, and those of subscriptions. A `Service`.

    libzmq does not report the size of its queues, and a sum of worst cases would admit no client. So the process is
    measured: when it holds more than `max_bytes` above what it held once its sockets were open, the connection is
    closed that `select_largest` returns of those of `sources`. If no connection holds much, `release_media` may free
    memory elsewhere and returns a text that names it. If that frees nothing either, the case is only counted: closing a
    connection would not help.

    Args:
        max_bytes: Bytes that the front may hold above those at its start.
        sources: Each returns the connections of one socket.
        release_media: Frees what the media proxy holds.
        on_evicted: Called with the name of what was closed and the session time.
        drops: Drop counters.
        read_resident, trim: Measure the process and free its unused memory; others in tests.
    """

    def __init__(
        self,
        max_bytes: int,
        sources: Sequence[Callable[[], Iterable[PendingConnection]]],
        release_media: Callable[[], str],
        on_evicted: Callable[[str, int], None],
        drops: Drops,
        read_resident: Callable[[], int] | None = None,
        trim: Callable[[], None] | None = None,
    ) -> None:
        self._max_bytes = max_bytes
        self._sources = sources
        self._release_media = release_media
        self._on_evicted = on_evicted
        self._drops = drops
        self._read_resident = read_resident or _make_resident_reader()
        self._trim = trim or _trim_heap
        self._base = -1
        self._next_ns = self._next_trim_ns = 0

    def tick(self, now_ns: int) -> None:
        """Measure, and evict a connection where memory is short."""
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + MEMORY_PERIOD_NS
        if self._base < 0:
            self._base = self._read_resident()
        if self._base < 0:  # it could not be read yet
            return
        held = self._read_resident() - self._base
        if held > self._max_bytes or (held > TRIM_BYTES and now_ns >= self._next_trim_ns):
            self._next_trim_ns = now_ns + TRIM_PERIOD_NS
            self._trim()  # freed memory counts until the system has it back
            held = self._read_resident() - self._base
        if held <= self._max_bytes:
            return
        evicted = self._evict(held)
        if evicted:
            self._on_evicted(evicted, now_ns)
        self._next_ns = now_ns + EVICTION_PAUSE_NS

    def _evict(self, held_bytes: int) -> str:
        """Close the largest connection, or release media. Return what was evicted, empty for nothing."""
        connections = [one for source in self._sources for one in source()]
        min_bytes = max(MIN_EVICT_BYTES, int(self._max_bytes * MIN_EVICT_SHARE))
        if sum(one.bytes for one in connections) > held_bytes // 2:
            min_bytes = MIN_EVICT_BYTES  # many hold a little: together they hold most of it
        largest = select_largest(connections, min_bytes)
        if largest is None:
            released = self._release_media()
            if not released:
                self._drops.count("memory_elsewhere")
            return released
        closed = largest.close()
        if closed:
            self._drops.count("memory", n=closed)
        return largest.label if closed else ""


def _make_resident_reader() -> Callable[[], int]:
    """Return a function that reads resident bytes without mapped files: assets are mapped, and the system takes those
    pages back when it needs them. Where they cannot be read now, it returns what it read before, at first -1."""
    process, resident = psutil.Process(), -1

    def read_resident() -> int:
        nonlocal resident
        with suppress(OSError, psutil.Error):  # no descriptor is free now, until connections are closed
            info = process.memory_info()
            resident = int(info.rss - getattr(info, "shared", 0))
        return resident

    return read_resident


def _trim_heap() -> None:
    """Return free memory of the C library to the system, where it can (glibc)."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (OSError, AttributeError):
        return
