"""Who waits for which bytes of which asset, and whose turn it is. Pure: no sockets, no files, time comes in.

What waits are requests, not bytes: a chunk is looked up when its turn has come and its reader takes something. Turns go
around among the readers, a chunk each, so nobody waits for more than one chunk of everybody else.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from iris_session.protocol.assets import (
    MAX_ASSET_CHUNK_BYTES,
    MAX_ASSET_REQUESTS,
    MAX_ASSET_WINDOW_BYTES,
    AssetRequest,
)
from iris_session.protocol.limits import TokenBucket
from iris_session.protocol.names import AssetRefusal

MILLISECOND: Final = 1_000_000  # [ns]

#: Requests of one reader: 1000 chunks of half a MiB are more than a gigabit link carries in a second.
REQUESTS_PER_S: Final = 1000.0
REQUEST_BURST: Final = 1000
#: Answers that wait for one reader, refusals among them: beyond, refusals are dropped.
MAX_QUEUED: Final = 2 * MAX_ASSET_REQUESTS
#: Connections to the channel that name the same participant: an old one may not have ended yet.
MAX_READERS_EACH: Final = 2
#: A reader whose connection is full is tried again after so long, then after twice that.
FIRST_PAUSE_NS: Final = 2 * MILLISECOND
LONGEST_PAUSE_NS: Final = 64 * MILLISECOND

#: What a client can do about each refusal.
ADVICE: Final[Mapping[str, str]] = {
    AssetRefusal.UNKNOWN: "it belongs neither to the present scene nor to the one before: read scene_hash anew",
    AssetRefusal.BAD_RANGE: f"ask for 1 to {MAX_ASSET_CHUNK_BYTES} bytes, from an offset up to the asset's size",
    AssetRefusal.VERSION: "this session speaks protocol version 1: update the older side",
    AssetRefusal.MALFORMED: "one frame: [version, connection_epoch, request_id, address, offset, length]",
    AssetRefusal.TOO_MANY: f"at most {MAX_ASSET_REQUESTS} requests and {MAX_ASSET_WINDOW_BYTES} bytes may wait: "
    "ask for more as chunks come",
    AssetRefusal.NOT_ALLOWED: "say hello on the control channel, with the same key, and name its connection_epoch",
    AssetRefusal.RATE: f"at most {REQUESTS_PER_S:g} requests per second",
    AssetRefusal.BUSY: "ask again in a moment",
}


class Wanted(NamedTuple):
    """One request that waits. `length`: bytes that will be sent; `total`: of the asset. `refused`: why none will."""

    request_id: int
    address: str
    offset: int
    length: int
    total: int
    refused: str = ""


class Reader:
    """One connection to the channel. `number`: of the participant's connection that it named last."""

    __slots__ = ("bucket", "descriptor", "number", "pause_ns", "queue", "queued_bytes", "retry_ns", "route")

    def __init__(self, route: bytes, descriptor: int, number: int, now_ns: int) -> None:
        self.route = route
        self.descriptor = descriptor
        self.number = number
        self.queue: deque[Wanted] = deque()
        self.queued_bytes = 0
        self.pause_ns = self.retry_ns = 0
        self.bucket = TokenBucket(REQUESTS_PER_S, REQUEST_BURST, now_ns)


class AssetHub:
    """`size_of`: bytes of an asset that may be served, `None` of any other."""

    def __init__(self, size_of: Callable[[str], int | None]) -> None:
        self._size_of = size_of
        self._listeners: Mapping[int, str] = {}
        self._readers: dict[bytes, Reader] = {}
        self._ring: deque[Reader] = deque()  # those that wait, each once, in the order of their turns

    def allow(self, listeners: Mapping[int, str]) -> list[int]:
        """Connections that may ask, with the key by which they must come. The descriptors of readers that may no more:
        what they waited for is forgotten."""
        self._listeners = listeners
        gone = [one for one in self._readers.values() if one.number not in listeners]
        for reader in gone:
            self.forget(reader.route)
        return [reader.descriptor for reader in gone]

    def ask(self, route: bytes, descriptor: int, user: str, request: AssetRequest, now_ns: int) -> str:
        """Takes a request. Not empty: it is refused, and why (`AssetRefusal`)."""
        if self._listeners.get(request.connection_epoch) != user:
            return AssetRefusal.NOT_ALLOWED
        reader = self._reader(route, descriptor, request.connection_epoch, now_ns)
        if reader is None:
            return AssetRefusal.BUSY
        if not reader.bucket.take(now_ns):
            return AssetRefusal.RATE
        total = self._size_of(request.address)
        if total is None:
            return AssetRefusal.UNKNOWN
        if request.offset > total or not 0 < request.length <= MAX_ASSET_CHUNK_BYTES:
            return AssetRefusal.BAD_RANGE
        length = min(request.length, total - request.offset)
        if len(reader.queue) >= MAX_ASSET_REQUESTS or reader.queued_bytes + length > MAX_ASSET_WINDOW_BYTES:
            return AssetRefusal.TOO_MANY
        self._queue(reader, Wanted(request.request_id, request.address, request.offset, length, total))
        reader.retry_ns = 0  # who asks has read something
        return ""

    def _queue(self, reader: Reader, wanted: Wanted) -> None:
        if not reader.queue:
            self._ring.append(reader)
        reader.queue.append(wanted)
        reader.queued_bytes += wanted.length

    def queues(self, route: bytes) -> bool:
        """Whether a reader waits for something: what it is told now has to wait behind that."""
        reader = self._readers.get(route)
        return reader is not None and bool(reader.queue)

    def refuse(self, route: bytes, request_id: int, address: str, reason: str) -> bool:
        """Keeps a refusal until its turn. False: too many wait already, or nobody is there by that name."""
        reader = self._readers.get(route)
        if reader is None or len(reader.queue) >= MAX_QUEUED:
            return False
        self._queue(reader, Wanted(request_id, address, 0, 0, 0, reason))
        return True

    def _reader(self, route: bytes, descriptor: int, number: int, now_ns: int) -> Reader | None:
        reader = self._readers.get(route)
        if reader is not None and reader.descriptor != descriptor:
            self.forget(route)
            reader = None
        if reader is not None and reader.number == number:
            return reader
        if sum(one.number == number for one in self._readers.values()) >= MAX_READERS_EACH:
            return None
        if reader is not None:  # a gateway that asks for several: nothing that waits is lost
            reader.number = number
            return reader
        reader = self._readers[route] = Reader(route, descriptor, number, now_ns)
        return reader

    def turn(self, now_ns: int) -> Reader | None:
        """Whose turn it is; its chunk is the first of its `queue`. Tell what became of it by `sent` or `full`."""
        for _ in range(len(self._ring)):
            self._ring.rotate(-1)
            reader = self._ring[-1]
            if reader.retry_ns <= now_ns:
                return reader
        return None

    def sent(self, reader: Reader) -> None:
        """Its chunk is on its way, or cannot be had any more."""
        wanted = reader.queue.popleft()
        reader.queued_bytes -= wanted.length
        reader.pause_ns = 0
        if not reader.queue:
            self._ring.remove(reader)

    def full(self, reader: Reader, now_ns: int) -> None:
        """Its connection takes nothing now."""
        reader.pause_ns = min(max(FIRST_PAUSE_NS, 2 * reader.pause_ns), LONGEST_PAUSE_NS)
        reader.retry_ns = now_ns + reader.pause_ns

    def forget(self, route: bytes) -> None:
        """A reader is gone."""
        reader = self._readers.pop(route, None)
        if reader is not None and reader.queue:
            self._ring.remove(reader)

    def begin_anew(self) -> list[int]:
        """Forgets every reader. Their descriptors."""
        descriptors = [reader.descriptor for reader in self._readers.values()]
        self._readers.clear()
        self._ring.clear()
        return descriptors

    def left(self, descriptor: int) -> None:
        """A TCP connection has ended, or its descriptor is another's."""
        for route in [route for route, one in self._readers.items() if one.descriptor == descriptor]:
            self.forget(route)

    @property
    def waiting(self) -> int:
        """Readers that wait for something."""
        return len(self._ring)

    def next_turn_ns(self) -> int | None:
        """When somebody's turn comes; `None` when nobody waits."""
        return min((reader.retry_ns for reader in self._ring), default=None)
