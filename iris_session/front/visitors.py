"""TCP connections of one listening socket, by descriptor, in the order they came; and who has to make room."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Protocol

from iris_session.link.sockets import close_tcp, peer_of
from iris_session.protocol.limits import Drops, TokenBucket


class Visitor:
    """One TCP connection. `quiet_ns`: when it was last somebody's who said hello (or when it was opened). `who`: whom
    it counts for."""

    __slots__ = ("address", "excess", "inside", "opened_ns", "quiet_ns", "who")

    def __init__(self, address: tuple[str, int], now_ns: int) -> None:
        self.address = address
        self.who = address[0]
        self.opened_ns = self.quiet_ns = now_ns
        self.excess: TokenBucket | None = None
        self.inside = False  # it got through the handshake


class Visitors:
    """`drops` counts who was closed, by reason."""

    def __init__(self, drops: Drops) -> None:
        self._drops = drops
        self._table: dict[int, Visitor] = {}

    def __len__(self) -> int:
        return len(self._table)

    def __iter__(self) -> Iterator[int]:
        return iter(self._table)

    def items(self) -> Iterable[tuple[int, Visitor]]:
        return self._table.items()

    def find(self, descriptor: int) -> Visitor | None:
        return self._table.get(descriptor)

    def opened(self, descriptor: int, now_ns: int) -> Visitor:
        """A TCP connection was accepted."""
        self._table.pop(descriptor, None)
        visitor = self._table[descriptor] = Visitor(peer_of(descriptor), now_ns)
        return visitor

    def closed(self, descriptor: int) -> None:
        """A TCP connection has ended."""
        self._table.pop(descriptor, None)

    def clear(self) -> None:
        """The listening socket was closed, and all its connections with it."""
        self._table.clear()

    def close(self, descriptor: int, reason: str) -> None:
        """Closes a TCP connection. One that is there and cannot be closed stays in the table, to be tried again."""
        visitor = self._table[descriptor]
        if close_tcp(descriptor, visitor.address):
            self._drops.count(reason)
        elif peer_of(descriptor) == visitor.address:
            self._drops.count("close_failed")
            return
        del self._table[descriptor]


class _Counted(Protocol):
    who: str


def crowd(visitors: Iterable[tuple[int, _Counted]], limit: int) -> list[int]:
    """Who has to go so that `limit` are left: one after the other, of whoever has most, in the given order."""
    queues: dict[str, deque[tuple[int, int]]] = {}
    n = 0
    for descriptor, visitor in visitors:
        queues.setdefault(visitor.who, deque()).append((n, descriptor))
        n += 1
    fullest = [(-len(queue), queue[0], who) for who, queue in queues.items()]
    heapq.heapify(fullest)
    gone: list[int] = []
    while n - len(gone) > max(0, limit):
        who = fullest[0][2]
        queue = queues[who]
        gone.append(queue.popleft()[1])
        if queue:
            heapq.heapreplace(fullest, (-len(queue), queue[0], who))
        else:
            heapq.heappop(fullest)
    return gone
