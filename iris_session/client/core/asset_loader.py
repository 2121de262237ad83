"""Order and window of chunk requests for wanted assets. Pure: no socket, file, clock or thread.

    wanted --next_lookups--> searched in the cache --on_missing(offset)--> requested in chunks --complete--> hashed
       `--remove (found)                                                                     again, remove <--'

Answers come in the order of the requests, so the bytes of one asset come in order too, and a request whose successor is
answered was lost with a TCP connection, and is made again. A chunk that does not continue its asset is ignored. A
window bounds the bytes that were requested and are not stored yet. The chunk size adapts to the speed of the link.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

from iris_session.protocol.assets import (
    MAX_ASSET_BYTES,
    MAX_ASSET_CHUNK_BYTES,
    MAX_ASSET_REQUESTS,
    AssetChunk,
    AssetRefused,
)
from iris_session.protocol.names import AssetRefusal

CHUNK_BYTES: Final = 512 << 10
#: Bounds of the chunk size. A window in less time than `FAST_NS` doubles it: each chunk costs the same work. One that
#: takes longer than `SLOW_NS` halves it, so that what is lost with a connection is little.
MIN_CHUNK_BYTES: Final = 64 << 10
MAX_CHUNK_BYTES: Final = MAX_ASSET_CHUNK_BYTES
FAST_NS: Final = 100_000_000
SLOW_NS: Final = 2_000_000_000
#: Window [bytes], less than a session allows: enough for 400 Mbit/s and 100 ms.
WINDOW_BYTES: Final = 6 << 20
WINDOW_REQUESTS: Final = MAX_ASSET_REQUESTS // 2
#: Maximum number of assets in progress at once: small ones must not wait for each other's round trips.
AT_ONCE: Final = 32
#: Pauses after a temporary refusal and after a disconnect; doubled each time, until a chunk comes.
FIRST_PAUSE_NS: Final = 50_000_000
LONGEST_PAUSE_NS: Final = 2_000_000_000
#: Time without any answer after which the connection is replaced.
PATIENCE_NS: Final = 15_000_000_000


class ChunkRequest(NamedTuple):
    """One request to be sent."""

    request_id: int
    address: str
    offset: int
    length: int


class FailedAsset(NamedTuple):
    """An asset that cannot be fetched."""

    address: str
    reason: str
    text: str


class _Item:
    """One asset. `got`: bytes that came; `asked`: bytes that came or were asked for; `total` -1: not known yet.
    `size_hint`: size as given by `add`, -1 if none: it decides how much is requested first."""

    __slots__ = ("address", "anew", "asked", "got", "size_hint", "total")

    def __init__(self, address: str, got: int, size_hint: int) -> None:
        self.address = address
        self.got = self.asked = got
        self.size_hint = size_hint
        self.total = -1
        self.anew = False

    def next_bytes(self, most: int) -> int:
        """Return the number of bytes to request next."""
        if self.total >= 0:
            return min(most, self.total - self.asked)
        return min(most, self.size_hint - self.asked) if self.size_hint > self.asked else most

    @property
    def open(self) -> bool:
        """True when there is more to request now: of an unknown size only a first chunk."""
        return self.asked == self.got if self.total < 0 else self.asked < self.total


class AssetLoader:
    """Scheduler of chunk requests. All `now_ns` are of one monotonic clock."""

    def __init__(self) -> None:
        #: Reason for which the session postpones requests, in its words; empty while bytes come.
        self.refusal = ""
        self._wanted: dict[str, int] = {}  # not looked up yet; sizes as in `add`
        self._busy: dict[str, int] = {}  # in work by the workers
        self._items: dict[str, _Item] = {}  # missing bytes, in the order of the assets
        self._anew: set[str] = set()  # removed once because the session has fewer bytes
        self._asked: dict[int, tuple[ChunkRequest, int]] = {}  # pending requests with their time
        self._chunk_bytes = CHUNK_BYTES
        self._unstored = 0
        self._next_id = 0
        self._pause_ns = self._paused_until_ns = 0
        self._progress_ns = 0

    @property
    def idle(self) -> bool:
        """True when nothing is wanted."""
        return not (self._wanted or self._busy or self._items)

    @property
    def needs_link(self) -> bool:
        """True while bytes are to come over the network."""
        return bool(self._items)

    def add(self, address: str, size: int = -1) -> bool:
        """Add an asset at the end of the order; `size` [bytes] if it is known. Return false when it is in progress
        already.
        """
        if address in self._wanted or address in self._busy or address in self._items:
            return False
        self._wanted[address] = size
        return True

    def next_lookups(self) -> Iterator[str]:
        """Yield assets to be looked up in the cache now."""
        while self._wanted and len(self._busy) + len(self._items) < AT_ONCE:
            address = next(iter(self._wanted))
            self._busy[address] = self._wanted.pop(address)
            yield address

    def on_missing(self, address: str, offset: int) -> None:
        """Note that an asset is not in the cache, but its first `offset` bytes are."""
        if address in self._busy:
            item = self._items[address] = _Item(address, offset, self._busy.pop(address))
            item.anew = address in self._anew

    def restart_asset(self, address: str) -> bool:
        """Start an asset again whose bytes had another hash. Return false when that was the second time.

        Does nothing for an asset that was removed meanwhile.
        """
        item = self._items.get(address)
        if item is None:
            return True
        if item.anew:
            self.remove(address)
            return False
        fresh = self._items[address] = _Item(address, 0, -1)
        fresh.anew = True
        return True

    def remove(self, address: str) -> None:
        """Remove an asset that is complete or failed."""
        for table in (self._wanted, self._busy, self._items):
            table.pop(address, None)
        self._anew.discard(address)

    def next_requests(self, now_ns: int) -> Iterator[ChunkRequest]:
        """Yield requests to send now, in the order of the assets. A yielded request counts as sent."""
        if self.is_paused(now_ns):
            return
        for item in list(self._items.values()):
            while item.open:
                length = item.next_bytes(self._chunk_bytes)
                if len(self._asked) >= WINDOW_REQUESTS or self._outstanding + length > WINDOW_BYTES:
                    return
                if not self._asked:
                    self._progress_ns = now_ns
                self._next_id += 1
                ask = ChunkRequest(self._next_id, item.address, item.asked, length)
                self._asked[self._next_id] = ask, now_ns
                item.asked += length
                yield ask

    @property
    def _outstanding(self) -> int:
        return self._unstored + sum(ask.length for ask, _ in self._asked.values())

    def process_chunk(self, chunk: AssetChunk, size: int, now_ns: int) -> bool | FailedAsset | None:
        """Process a chunk of `size` bytes.

        Returns true for the next bytes, to be stored (then call `on_stored`); `None` for bytes that are of no use any
        more; false for a chunk that was not requested.
        """
        ask, asked_ns = self._asked.pop(chunk.request_id, (None, 0))
        if ask is None or ask.offset != chunk.offset or ask.address != chunk.address:
            return False
        self._restore_lost_requests(ask.request_id)
        self._progress_ns, self._pause_ns, self.refusal = now_ns, 0, ""
        self._adapt_chunk_size(ask, size, now_ns - asked_ns)
        item = self._items.get(ask.address)
        if item is None or chunk.offset != item.got:
            return None
        expected = min(ask.length, chunk.total - chunk.offset)
        if item.total not in (-1, chunk.total) or size > ask.length or (size == 0 and expected):
            self.remove(ask.address)
            return FailedAsset(ask.address, "protocol", f"the session contradicts itself about asset {ask.address}")
        if chunk.total > MAX_ASSET_BYTES:
            self.remove(ask.address)
            text = f"asset {ask.address} has {chunk.total} bytes: at most {MAX_ASSET_BYTES} are fetched"
            return FailedAsset(ask.address, "protocol", text)
        item.total = chunk.total
        item.got += size
        if size < expected:
            item.asked = item.got
        item.asked = max(item.got, min(item.asked, item.total))
        self._unstored += size
        return True

    def _restore_lost_requests(self, request_id: int) -> None:
        """Request again what was requested before `request_id`: after this answer those will not be answered."""
        for lost in [earlier for earlier in self._asked if earlier < request_id]:
            ask, _ = self._asked.pop(lost)
            item = self._items.get(ask.address)
            if item is not None:
                item.asked = max(item.got, min(item.asked, ask.offset))

    def _adapt_chunk_size(self, ask: ChunkRequest, size: int, took_ns: int) -> None:
        """Use larger chunks on a fast link, smaller ones on a slow one, by the times of whole chunks."""
        if size != self._chunk_bytes or size != ask.length:
            return
        if took_ns < FAST_NS:
            self._chunk_bytes = min(2 * size, MAX_CHUNK_BYTES)
        elif took_ns > SLOW_NS:
            self._chunk_bytes = max(size // 2, MIN_CHUNK_BYTES)

    def is_complete(self, address: str) -> bool:
        """Return whether all bytes of an asset came."""
        item = self._items.get(address)
        return item is not None and item.got == item.total

    def on_stored(self, size: int) -> None:
        """Note that bytes are in the cache, or dropped: they leave the window."""
        self._unstored -= size

    def process_refusal(self, refused: AssetRefused, now_ns: int) -> FailedAsset | str:
        """Process a refusal.

        Returns a `FailedAsset` for a final one; an address when the asset must start again after its bytes were removed
        (then call `on_missing` with 0); else an empty text: it is requested again after a pause.
        """
        ask, _ = self._asked.pop(refused.request_id, (None, 0))
        if ask is None:
            return ""
        self._restore_lost_requests(ask.request_id)
        self._progress_ns = now_ns
        item = self._items.get(ask.address)
        if item is None:
            return ""
        if refused.reason in AssetRefusal.PASSING:
            self.refusal = f"{refused.reason}: {refused.advice}"
            self._pause(now_ns, self._pause_ns)
            item.asked = max(item.got, min(item.asked, ask.offset))
            return ""
        self.remove(ask.address)
        if refused.reason == AssetRefusal.BAD_RANGE and item.got and not item.anew:
            self._busy[ask.address] = -1  # more bytes are stored than the asset has: they belong to another one
            self._anew.add(ask.address)
            return ask.address
        text = f"asset {ask.address} was refused ({refused.reason}): {refused.advice}"
        return FailedAsset(ask.address, refused.reason, text)

    def is_paused(self, now_ns: int) -> bool:
        """Return whether nothing is to be requested now."""
        return now_ns < self._paused_until_ns

    def on_link_lost(self, now_ns: int) -> None:
        """Note that the connection ended, as `on_link_closed`, but not by us: the next one is made after a pause."""
        before_ns = self._pause_ns
        self.on_link_closed()
        self._pause(now_ns, before_ns)

    def _pause(self, now_ns: int, before_ns: int) -> None:
        self._pause_ns = min(max(FIRST_PAUSE_NS, 2 * before_ns), LONGEST_PAUSE_NS)
        self._paused_until_ns = now_ns + self._pause_ns

    def on_link_closed(self) -> None:
        """Note that we closed the connection: pending requests are lost, received bytes stay."""
        self._asked.clear()
        self._pause_ns = self._paused_until_ns = 0
        for item in self._items.values():
            item.asked = item.got

    def is_overdue(self, now_ns: int) -> bool:
        """Return whether answers have not come for too long."""
        return bool(self._asked) and now_ns - self._progress_ns > PATIENCE_NS
