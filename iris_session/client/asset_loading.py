"""What is to be asked for next, of assets that are wanted in an order. Pure: no socket, file, clock or thread.

    wanted --to_look--> looked up in the cache --missing(offset)--> asked for in chunks --whole--> hashed --again, drop
                                               `--drop

Answers come in the order of the requests, so of one asset the bytes come in order too; whatever does not continue what
is there is passed over, and asked for again. A window bounds what was asked for and is not stored yet.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

from iris_session.protocol.assets import MAX_ASSET_REQUESTS, AssetChunk, AssetRefused
from iris_session.protocol.names import AssetRefusal

CHUNK_BYTES: Final = 512 << 10
#: Half of what a session allows: enough for 250 Mbit/s and 100 ms.
WINDOW_BYTES: Final = 4 << 20
WINDOW_REQUESTS: Final = MAX_ASSET_REQUESTS // 2
#: Assets that are looked up, received or hashed at once: small ones must not wait for each other's round trips.
AT_ONCE: Final = 32
#: After a refusal that passes; doubled each time, until a chunk comes.
FIRST_PAUSE_NS: Final = 50_000_000
LONGEST_PAUSE_NS: Final = 2_000_000_000
#: A request without an answer for so long, while nothing else comes either: the connection is made anew.
PATIENCE_NS: Final = 15_000_000_000


class Ask(NamedTuple):
    """One request to be sent."""

    request_id: int
    address: str
    offset: int
    length: int


class Failed(NamedTuple):
    """An asset that will not come."""

    address: str
    reason: str
    text: str


class _Item:
    """One asset. `got`: bytes that came; `asked`: bytes that came or were asked for; `total` -1: not known yet."""

    __slots__ = ("address", "anew", "asked", "got", "total")

    def __init__(self, address: str, got: int) -> None:
        self.address = address
        self.got = self.asked = got
        self.total = -1
        self.anew = False

    @property
    def open(self) -> bool:
        """Whether there is more to ask for now: of an unknown size only a first chunk."""
        return self.asked == self.got if self.total < 0 else self.asked < self.total


class AssetLoader:
    """`now_ns` are of one monotonic clock."""

    def __init__(self) -> None:
        self._wanted: dict[str, None] = {}  # not looked up yet
        self._busy: dict[str, None] = {}  # in the hands of the workers
        self._items: dict[str, _Item] = {}  # of which bytes are to come, in their order
        self._asked: dict[int, Ask] = {}
        self._unstored = 0
        self._next_id = 0
        self._pause_ns = self._paused_until_ns = 0
        self._progress_ns = 0

    @property
    def idle(self) -> bool:
        """Nothing is wanted."""
        return not (self._wanted or self._busy or self._items)

    @property
    def needs_link(self) -> bool:
        """Whether bytes are to come over the network."""
        return bool(self._items)

    def want(self, address: str) -> bool:
        """Adds an asset at the end of the order. False: it is on its way already."""
        if address in self._wanted or address in self._busy or address in self._items:
            return False
        self._wanted[address] = None
        return True

    def to_look(self) -> Iterator[str]:
        """Assets to be looked up in the cache now."""
        while self._wanted and len(self._busy) + len(self._items) < AT_ONCE:
            address = next(iter(self._wanted))
            del self._wanted[address]
            self._busy[address] = None
            yield address

    def missing(self, address: str, offset: int) -> None:
        """It is not in the cache, but its first `offset` bytes are."""
        if address in self._busy:
            del self._busy[address]
            self._items[address] = _Item(address, offset)

    def again(self, address: str) -> bool:
        """The bytes that came were not those of the asset: from the beginning. False: that was the second time."""
        item = self._items.get(address)
        self._busy.pop(address, None)
        if item is not None and item.anew:
            self.drop(address)
            return False
        fresh = self._items[address] = _Item(address, 0)
        fresh.anew = True
        return True

    def drop(self, address: str) -> None:
        """It is there, or will not come."""
        for table in (self._wanted, self._busy, self._items):
            table.pop(address, None)

    def requests(self, now_ns: int) -> Iterator[Ask]:
        """What is to be asked now, in the order of the assets. What was yielded counts as asked."""
        if now_ns < self._paused_until_ns:
            return
        for item in list(self._items.values()):
            while item.open:
                length = CHUNK_BYTES if item.total < 0 else min(CHUNK_BYTES, item.total - item.asked)
                if len(self._asked) >= WINDOW_REQUESTS or self._outstanding + length > WINDOW_BYTES:
                    return
                if not self._asked:
                    self._progress_ns = now_ns
                self._next_id += 1
                ask = self._asked[self._next_id] = Ask(self._next_id, item.address, item.asked, length)
                item.asked += length
                yield ask

    @property
    def _outstanding(self) -> int:
        return self._unstored + sum(ask.length for ask in self._asked.values())

    def chunk(self, chunk: AssetChunk, size: int, now_ns: int) -> bool | Failed:
        """`size` bytes came. True: they are the next ones, to be stored (then call `stored`)."""
        ask = self._asked.pop(chunk.request_id, None)
        if ask is None:
            return False
        self._progress_ns, self._pause_ns = now_ns, 0
        item = self._items.get(ask.address)
        if item is None or chunk.offset != item.got or ask.offset != chunk.offset or chunk.address != ask.address:
            return False
        expected = min(ask.length, chunk.total - chunk.offset)
        if item.total not in (-1, chunk.total) or size > ask.length or (size == 0 and expected):
            self.drop(ask.address)
            return Failed(ask.address, "protocol", f"the session contradicts itself about asset {ask.address}")
        item.total = chunk.total
        item.got += size
        if size < expected:
            item.asked = item.got
        item.asked = max(item.got, min(item.asked, item.total))
        self._unstored += size
        return True

    def whole(self, address: str) -> bool:
        """Whether all its bytes came."""
        item = self._items.get(address)
        return item is not None and item.got == item.total

    def stored(self, size: int) -> None:
        """These bytes are in the cache, or thrown away: they fill the window no more."""
        self._unstored -= size

    def refused(self, refused: AssetRefused, now_ns: int) -> Failed | str:
        """A request was refused. A `Failed` when the asset will not come; an address when it is to begin anew, after
        its part was thrown away (then call `missing` with 0); else empty: it is asked for again after a pause."""
        ask = self._asked.pop(refused.request_id, None)
        if ask is None:
            return ""
        self._progress_ns = now_ns
        item = self._items.get(ask.address)
        if item is None:
            return ""
        if refused.reason in AssetRefusal.PASSING:
            self._pause_ns = min(max(FIRST_PAUSE_NS, 2 * self._pause_ns), LONGEST_PAUSE_NS)
            self._paused_until_ns = now_ns + self._pause_ns
            item.asked = max(item.got, min(item.asked, ask.offset))
            return ""
        self.drop(ask.address)
        if refused.reason == AssetRefusal.BAD_RANGE and item.got and not item.anew:
            self._busy[ask.address] = None  # our part is longer than the asset: it was of something else
            return ask.address
        text = f"asset {ask.address} was refused ({refused.reason}): {refused.advice}"
        return Failed(ask.address, refused.reason, text)

    def cut_off(self) -> None:
        """The connection ended: what was asked by it will not come, what came stays."""
        self._asked.clear()
        self._pause_ns = self._paused_until_ns = 0
        for item in self._items.values():
            item.asked = item.got

    def overdue(self, now_ns: int) -> bool:
        """Whether answers have not come for too long."""
        return bool(self._asked) and now_ns - self._progress_ns > PATIENCE_NS
