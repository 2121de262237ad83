"""Messages that a client sends: checked encoding, the bounded queue, requests that wait for replies, and the e-stop."""

from __future__ import annotations

import re
from collections import deque
from typing import Final

import msgspec

from iris_session.client.core.status import ConnectionCounters
from iris_session.client.errors import InvalidMessageError
from iris_session.protocol.client_messages import (
    Bye,
    ClientMessage,
    EStop,
    Hello,
    Release,
    Sample,
    Samples,
    wrap_message,
)
from iris_session.protocol.codec import decode_client, encode_client
from iris_session.protocol.common import Lease
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.server_messages import Reply

MAX_OUTGOING: Final = 256
MAX_PENDING: Final = 64
MAX_GRANTED: Final = 4096  # targets named in replies
#: Place of an error in the text of msgspec: after the three fields of the envelope before the message.
_PLACE: Final = re.compile(r" - at `\$\[3\]\.?([^`]*)`$")


def encode_checked(message: ClientMessage, connection_epoch: int = 0) -> bytes:
    """Encode a message in its envelope, and decode it once as the session will do.

    Args:
        message: The message.
        connection_epoch: Number of the connection, 0 before the first welcome.

    Returns:
        The encoded envelope.

    Raises:
        InvalidMessageError: A value does not fit the protocol; the text names the field.
    """
    kind = type(message).__name__
    try:
        data = encode_client(wrap_message(message, connection_epoch))
        decode_client(data)
    except ProtocolError as error:
        text = str(error).removeprefix(f"{kind.lower()}: ")
        place = _PLACE.search(text)
        where = f"{place[1]}: " if place and place[1] else ""
        raise InvalidMessageError(f"{kind} cannot be sent: {where}{_PLACE.sub('', text)}") from None
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidMessageError(f"{kind} cannot be sent: {_find_unencodable(message) or error}") from None
    return data


def _find_unencodable(message: ClientMessage) -> str:
    """Describe the first field that MessagePack cannot carry."""
    for name, value in msgspec.structs.asdict(message).items():
        try:
            msgspec.msgpack.encode(value)
        except (TypeError, ValueError, OverflowError):
            return f"{name}: {type(value).__name__} {str(value)[:40]!r} is not of a type that the protocol has"
    return ""


class Outbox:
    """Bounded queue of `(may be dropped when the socket is full, bytes)`. Drops are counted in `counters`.

    An e-stop passes everything but a hello. A release passes samples only: it may refer to an acquire before it.
    """

    def __init__(self, counters: ConnectionCounters) -> None:
        self.counters = counters
        self._queue: deque[tuple[bool, bytes]] = deque()
        self._has_hello = False  # always as the first

    def push(self, message: ClientMessage, data: bytes) -> bool:
        """Queue `data`, which is `message` encoded. False: the queue is full, and the message is not urgent."""
        droppable = isinstance(message, Sample | Samples)
        if len(self._queue) >= MAX_OUTGOING:
            if not isinstance(message, EStop | Release | Bye):
                self._count_drop(droppable)
                return False
            self._make_room()
        if isinstance(message, EStop):
            self._queue.insert(int(self._has_hello), (False, data))
        elif isinstance(message, Release):
            self._queue.insert(self._index_before_samples(), (False, data))
        else:
            self._has_hello = self._has_hello or isinstance(message, Hello)
            self._queue.append((droppable, data))
        return True

    def peek(self) -> tuple[bool, bytes] | None:
        """Return the next message to send, `None` when the queue is empty."""
        return self._queue[0] if self._queue else None

    def pop(self, *, sent: bool) -> None:
        """Remove the message of `peek`, which was sent or is dropped."""
        self._queue.popleft()
        self._has_hello = False
        if sent:
            self.counters.sent += 1
        else:
            self.counters.samples_not_sent += 1

    def clear(self) -> None:
        """Empty the queue: its messages are not for the next connection."""
        self._queue.clear()
        self._has_hello = False

    def _index_before_samples(self) -> int:
        """Return the index of the first of the samples at the end of the queue."""
        at = len(self._queue)
        while at and self._queue[at - 1][0]:
            at -= 1
        return at

    def _make_room(self) -> None:
        """Drop the newest sample; without any, the newest message."""
        at = next((i for i in range(len(self._queue) - 1, -1, -1) if self._queue[i][0]), len(self._queue) - 1)
        self._count_drop(self._queue[at][0])
        del self._queue[at]

    def _count_drop(self, sample: bool) -> None:
        self.counters.samples_not_sent += sample
        self.counters.outgoing_dropped += not sample


class PendingRequests:
    """Requests that wait for replies, replies to be fetched, and leases that replies granted. Bounded.

    Of one connection: `clear` for the next one. Request numbers continue.
    """

    def __init__(self, counters: ConnectionCounters) -> None:
        self._counters = counters
        self._pending: set[int] = set()
        self._replies: dict[int, Reply] = {}
        self._granted: dict[str, Lease] = {}
        self.next_request = 1

    def clear(self) -> None:
        """Remove everything: requests of another connection get no reply."""
        self._granted.clear()
        self._pending.clear()
        self._replies.clear()

    def add_pending(self) -> None:
        """Count the request `next_request` as sent. Beyond `MAX_PENDING` the oldest one is dropped."""
        if len(self._pending) >= MAX_PENDING:
            self._pending.discard(min(self._pending))
        self._pending.add(self.next_request)
        self.next_request += 1

    def pop_reply(self, request_id: int) -> Reply | None:
        """Return the reply to a request once, `None` while there is none."""
        return self._replies.pop(request_id, None)

    def discard(self, request_id: int) -> None:
        """Remove a request and its reply."""
        self._pending.discard(request_id)
        self._replies.pop(request_id, None)

    def process_reply(self, reply: Reply) -> bool:
        """Store a reply. False: it is a denial of a message that expects no reply, to be passed on otherwise."""
        self._granted.update((lease.target, lease) for lease in reply.leases)
        while len(self._granted) > MAX_GRANTED:
            del self._granted[next(iter(self._granted))]
        if reply.request_id in self._pending:
            self._pending.discard(reply.request_id)
            while len(self._replies) >= MAX_PENDING:
                del self._replies[next(iter(self._replies))]
                self._counters.inbox_dropped += 1
            self._replies[reply.request_id] = reply
            return True
        if reply.request_id:
            self._counters.unexpected_replies += 1
            return True
        return reply.denial is None

    def granted_lease(self, target: str) -> Lease | None:
        """Return the lease in the newest reply that names `target`: it may be ahead of the event."""
        return self._granted.get(target)


class PendingEStop:
    """An e-stop of ours until the session is known to have it: a connection may end with it on the way.

    The session has it when it reports a stop of ours; the stop of another is no proof, as it may be cleared before ours
    arrives. When the report was missed, the pong of a ping that was sent after the e-stop proves it too, if the session
    is stopped.
    """

    def __init__(self) -> None:
        #: To be sent again on the next connection, `None` when there is none or the session has it.
        self.message: EStop | None = None
        self._proof_ns: int | None = None

    def begin(self, message: EStop) -> None:
        """Keep an e-stop that is sent now, for the first time or again."""
        self.message, self._proof_ns = message, None

    def withdraw(self) -> None:
        """Forget the e-stop: the user clears it, or the session has it."""
        self.message = None

    def on_ping(self, t0_ns: int) -> None:
        """Note a ping that was queued."""
        if self.message is not None and self._proof_ns is None:
            self._proof_ns = t0_ns

    def on_pong(self, t0_ns: int, *, stopped: bool) -> None:
        """Note the pong of a ping, while the session is `stopped` as far as we know."""
        if stopped and self._proof_ns is not None and t0_ns >= self._proof_ns:
            self.message = None
