"""The bounded queue of encoded control messages that wait for the socket. What is urgent goes first and never waits."""

from __future__ import annotations

from collections import deque
from typing import Final

from iris_session.client.status import ConnectionCounters
from iris_session.protocol.client_messages import Bye, ClientMessage, EStop, Release, Sample

MAX_OUTGOING: Final = 256


class Outgoing:
    """Messages as `(may be dropped when the socket is full, bytes)`. Drops are counted in `counters`."""

    def __init__(self, counters: ConnectionCounters) -> None:
        self.counters = counters
        self._queue: deque[tuple[bool, bytes]] = deque()

    def push(self, message: ClientMessage, data: bytes) -> bool:
        """Queues `data`, which is `message` encoded. A full queue: false, unless it is urgent."""
        droppable = isinstance(message, Sample)
        if len(self._queue) >= MAX_OUTGOING:
            urgent = isinstance(message, EStop | Release | Bye)
            lost_sample = self._queue.pop()[0] if urgent else droppable
            self.counters.samples_not_sent += lost_sample
            self.counters.outgoing_dropped += not lost_sample
            if not urgent:
                return False
        if isinstance(message, EStop | Release):
            self._queue.appendleft((droppable, data))
        else:
            self._queue.append((droppable, data))
        return True

    def peek(self) -> tuple[bool, bytes] | None:
        """The next message to send."""
        return self._queue[0] if self._queue else None

    def pop(self, *, sent: bool) -> None:
        """The message of `peek` is done with: sent, or dropped."""
        self._queue.popleft()
        if sent:
            self.counters.sent += 1
        else:
            self.counters.samples_not_sent += 1

    def clear(self) -> None:
        """Nothing that waits is for the next connection."""
        self._queue.clear()
