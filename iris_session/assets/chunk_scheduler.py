"""Order in which chunks of assets are sent to readers. Pure: no sockets, no files, time is an argument.

Requests are queued, not bytes: a chunk is looked up when it is due and its reader has room. Readers are served in a
round robin, a chunk each, so that a reader waits for at most one chunk of every other reader.
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
#: Queued answers of one reader, refusals among them; beyond that, refusals are dropped.
MAX_QUEUED: Final = 2 * MAX_ASSET_REQUESTS
#: Connections to the channel that name the same connection epoch: an old one may not have ended yet.
MAX_READERS_EACH: Final = 2
#: A reader whose connection is full is tried again after so long, then after twice that.
FIRST_PAUSE_NS: Final = 2 * MILLISECOND
LONGEST_PAUSE_NS: Final = 64 * MILLISECOND

#: Advice to the client by refusal.
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


class PendingChunk(NamedTuple):
    """One queued request. `length`: bytes to send; `total`: size of the asset. `refusal`: reason why none are sent."""

    request_id: int
    address: str
    offset: int
    length: int
    total: int
    refusal: str = ""


class ChunkReader:
    """One connection to the channel. `number`: the participant's connection epoch that it named last."""

    __slots__ = ("bucket", "descriptor", "number", "pause_ns", "queue", "queued_bytes", "retry_ns", "route")

    def __init__(self, route: bytes, descriptor: int, number: int, now_ns: int) -> None:
        self.route = route
        self.descriptor = descriptor
        self.number = number
        self.queue: deque[PendingChunk] = deque()
        self.queued_bytes = 0
        self.pause_ns = self.retry_ns = 0
        self.bucket = TokenBucket(REQUESTS_PER_S, REQUEST_BURST, now_ns)


class ChunkScheduler:
    """Round robin over the queues of readers, with limits per reader.

    `size_of`: size of an asset that is served [bytes], `None` for any other.
    """

    def __init__(self, size_of: Callable[[str], int | None]) -> None:
        self._size_of = size_of
        self._listeners: Mapping[int, str] = {}
        self._readers: dict[bytes, ChunkReader] = {}
        self._ring: deque[ChunkReader] = deque()  # readers with a queue, each once, in round-robin order

    def set_listeners(self, listeners: Mapping[int, str]) -> list[int]:
        """Set the connection epochs that may request, with the key each must use.

        Returns the descriptors of readers that may not any more; their queues are removed.
        """
        self._listeners = listeners
        gone = [one for one in self._readers.values() if one.number not in listeners]
        for reader in gone:
            self.remove(reader.route)
        return [reader.descriptor for reader in gone]

    def request(self, route: bytes, descriptor: int, user: str, request: AssetRequest, now_ns: int) -> str:
        """Queue a request. Return an empty string, or the `AssetRefusal` for which it is refused."""
        if self._listeners.get(request.connection_epoch) != user:
            return AssetRefusal.NOT_ALLOWED
        reader = self._get_reader(route, descriptor, request.connection_epoch, now_ns)
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
        self._append(reader, PendingChunk(request.request_id, request.address, request.offset, length, total))
        reader.retry_ns = 0  # a reader that requests has read something
        return ""

    def _append(self, reader: ChunkReader, pending: PendingChunk) -> None:
        if not reader.queue:
            self._ring.append(reader)
        reader.queue.append(pending)
        reader.queued_bytes += pending.length

    def has_pending(self, route: bytes) -> bool:
        """Return whether a reader has a queue: further answers must wait behind it."""
        reader = self._readers.get(route)
        return reader is not None and bool(reader.queue)

    def queue_refusal(self, route: bytes, request_id: int, address: str, reason: str) -> bool:
        """Queue a refusal. False when the queue is full, or the reader is unknown."""
        reader = self._readers.get(route)
        if reader is None or len(reader.queue) >= MAX_QUEUED:
            return False
        self._append(reader, PendingChunk(request_id, address, 0, 0, 0, reason))
        return True

    def _get_reader(self, route: bytes, descriptor: int, number: int, now_ns: int) -> ChunkReader | None:
        reader = self._readers.get(route)
        if reader is not None and reader.descriptor != descriptor:
            self.remove(route)
            reader = None
        if reader is not None and reader.number == number:
            return reader
        if sum(one.number == number for one in self._readers.values()) >= MAX_READERS_EACH:
            return None
        if reader is not None:  # a gateway that requests for several participants: its queue stays
            reader.number = number
            return reader
        reader = self._readers[route] = ChunkReader(route, descriptor, number, now_ns)
        return reader

    def next_reader(self, now_ns: int) -> ChunkReader | None:
        """Return the reader to serve: send the first of its `queue`, then call `confirm_sent` or `defer`."""
        for _ in range(len(self._ring)):
            self._ring.rotate(-1)
            reader = self._ring[-1]
            if reader.retry_ns <= now_ns:
                return reader
        return None

    def confirm_sent(self, reader: ChunkReader) -> None:
        """Remove the first request of a reader: its chunk was sent, or is gone."""
        pending = reader.queue.popleft()
        reader.queued_bytes -= pending.length
        reader.pause_ns = 0
        if not reader.queue:
            self._ring.remove(reader)

    def defer(self, reader: ChunkReader, now_ns: int) -> None:
        """Serve a reader again after a pause: its connection is full."""
        reader.pause_ns = min(max(FIRST_PAUSE_NS, 2 * reader.pause_ns), LONGEST_PAUSE_NS)
        reader.retry_ns = now_ns + reader.pause_ns

    def remove(self, route: bytes) -> None:
        """Remove a reader and its queue."""
        reader = self._readers.pop(route, None)
        if reader is not None and reader.queue:
            self._ring.remove(reader)

    def clear(self) -> list[int]:
        """Remove every reader, and return their descriptors."""
        descriptors = [reader.descriptor for reader in self._readers.values()]
        self._readers.clear()
        self._ring.clear()
        return descriptors

    def remove_descriptor(self, descriptor: int) -> None:
        """Remove the readers of a TCP connection that ended, or whose descriptor was reused."""
        for route in [route for route, one in self._readers.items() if one.descriptor == descriptor]:
            self.remove(route)

    @property
    def n_waiting(self) -> int:
        """Number of readers with a queue."""
        return len(self._ring)

    def next_due_ns(self) -> int | None:
        """Return when the next reader is due [ns]; `None` without queues."""
        return min((reader.retry_ns for reader in self._ring), default=None)
