"""The bounded queue of encoded control messages that wait for the socket, and the e-stop that must not be lost."""

from __future__ import annotations

from collections import deque
from typing import Final

from iris_session.client.core.status import ConnectionCounters
from iris_session.protocol.client_messages import Bye, ClientMessage, EStop, Hello, Release, Sample, Samples

MAX_OUTGOING: Final = 256


class Outbox:
    """Messages as `(may be dropped when the socket is full, bytes)`. Drops are counted in `counters`.

    An e-stop passes everything but a hello. A release passes samples only: it may mean what an acquire before it asks
    for.
    """

    def __init__(self, counters: ConnectionCounters) -> None:
        self.counters = counters
        self._queue: deque[tuple[bool, bytes]] = deque()
        self._hello_waits = False  # always as the first

    def push(self, message: ClientMessage, data: bytes) -> bool:
        """Queues `data`, which is `message` encoded. A full queue: false, unless it is urgent."""
        droppable = isinstance(message, Sample | Samples)
        if len(self._queue) >= MAX_OUTGOING:
            if not isinstance(message, EStop | Release | Bye):
                self._dropped(droppable)
                return False
            self._make_room()
        if isinstance(message, EStop):
            self._queue.insert(int(self._hello_waits), (False, data))
        elif isinstance(message, Release):
            self._queue.insert(self._before_samples(), (False, data))
        else:
            self._hello_waits = self._hello_waits or isinstance(message, Hello)
            self._queue.append((droppable, data))
        return True

    def _before_samples(self) -> int:
        """Where the samples begin that wait behind everything else."""
        at = len(self._queue)
        while at and self._queue[at - 1][0]:
            at -= 1
        return at

    def _make_room(self) -> None:
        """The newest sample goes; without any, the newest message."""
        at = next((i for i in range(len(self._queue) - 1, -1, -1) if self._queue[i][0]), len(self._queue) - 1)
        self._dropped(self._queue[at][0])
        del self._queue[at]

    def _dropped(self, sample: bool) -> None:
        self.counters.samples_not_sent += sample
        self.counters.outgoing_dropped += not sample

    def peek(self) -> tuple[bool, bytes] | None:
        """The next message to send."""
        return self._queue[0] if self._queue else None

    def pop(self, *, sent: bool) -> None:
        """The message of `peek` is done with: sent, or dropped."""
        self._queue.popleft()
        self._hello_waits = False
        if sent:
            self.counters.sent += 1
        else:
            self.counters.samples_not_sent += 1

    def clear(self) -> None:
        """Nothing that waits is for the next connection."""
        self._queue.clear()
        self._hello_waits = False


class PendingEStop:
    """An e-stop of ours until the session is known to have it: a connection may die with it on the way.

    The session has it when it says that it is stopped, after we asked. Where it was stopped already it has nothing to
    say: then the answer to a ping that was sent after the e-stop proves that it came that far.
    """

    def __init__(self) -> None:
        #: To be sent again on the next connection, `None` when there is none or the session has it.
        self.message: EStop | None = None
        self._proof_ns: int | None = None

    def begin(self, message: EStop) -> None:
        """The user stops; also called when it is sent again."""
        self.message, self._proof_ns = message, None

    def withdraw(self) -> None:
        """The user clears the e-stop, or the session has it."""
        self.message = None

    def on_ping(self, t0_ns: int) -> None:
        """A ping was queued."""
        if self.message is not None and self._proof_ns is None:
            self._proof_ns = t0_ns

    def on_pong(self, t0_ns: int, *, stopped: bool) -> None:
        """A ping was answered, while the session is `stopped` as far as we know."""
        if stopped and self._proof_ns is not None and t0_ns >= self._proof_ns:
            self.message = None
