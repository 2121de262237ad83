"""Two threads that read, hash and write assets, and decode them for the application.

An asset belongs to one of them, so what is asked for one asset happens in that order. What became of it is taken by
`results` in the thread that polls.
"""

from __future__ import annotations

import queue
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, NamedTuple

from iris_session.client.asset_cache import AssetCache, Part
from iris_session.client.errors import AssetError

THREADS: Final = 2
Decode = Callable[[str, memoryview], Any]


class Found(NamedTuple):
    """An asset is in the cache, decoded where that was asked for. `fetched`: it was stored just now."""

    address: str
    size: int
    decoded: Any
    fetched: bool


class Missing(NamedTuple):
    """Its first `offset` bytes are there."""

    address: str
    offset: int


class Stored(NamedTuple):
    """So many bytes were taken over."""

    size: int


class Wrong(NamedTuple):
    """The bytes that came are not those of the address; they are thrown away. `size`: how many they were."""

    address: str
    size: int


class Broken(NamedTuple):
    """The asset will not come."""

    error: AssetError
    address: str


Result = Found | Missing | Stored | Wrong | Broken


class AssetWorkers:
    """`wake`: called from the threads when there is a result. How much waits is bounded by who asks: a window of bytes,
    and a few assets at once."""

    def __init__(self, cache: AssetCache, wake: Callable[[], None]) -> None:
        self.cache = cache
        self._wake = wake
        self._pools = [ThreadPoolExecutor(1, f"iris-assets-{n}") for n in range(THREADS)]
        self._parts: dict[str, Part] = {}
        self._closing = False
        self._results: queue.SimpleQueue[Result] = queue.SimpleQueue()

    def results(self) -> Iterator[Result]:
        """What was done since the last time."""
        while not self._results.empty():
            yield self._results.get_nowait()

    def look(self, address: str, decode: Decode | None) -> None:
        """`Found` or `Missing`."""

        def work() -> Result:
            size = self.cache.find(address)
            if size is not None:
                return self._found(address, size, decode, fetched=False)
            part = self._parts[address] = self.cache.begin(address)
            return Missing(address, part.offset)

        self._submit(address, work)

    def write(self, address: str, data: memoryview) -> None:
        """The next bytes of an asset that was `Missing`: `Stored`."""

        def work() -> Result:
            part = self._parts.get(address)
            if part is not None:
                part.append(data)
            return Stored(len(data))

        self._submit(address, work, len(data))

    def finish(self, address: str, decode: Decode | None) -> None:
        """All bytes were written: `Found` or `Wrong`."""

        def work() -> Result:
            part = self._parts[address]
            size = part.offset
            if not part.finish():
                return Wrong(address, size)
            del self._parts[address]
            return self._found(address, size, decode, fetched=True)

        self._submit(address, work)

    def restart(self, address: str) -> None:
        """Throws away what is there: `Missing`."""

        def work() -> Result:
            self._parts[address].restart()
            return Missing(address, 0)

        self._submit(address, work)

    def leave(self, address: str) -> None:
        """It is not wanted any more; what is there stays for another time."""

        def work() -> Result:
            self._close(address)
            return Stored(0)

        self._submit(address, work)

    def close(self) -> None:
        """Waits for what is being done, writes what has come, and leaves parts for another time."""
        self._closing = True
        for pool in self._pools:
            pool.shutdown()
        for address in list(self._parts):
            self._close(address)

    def _close(self, address: str) -> None:
        part = self._parts.pop(address, None)
        if part is not None:
            part.close()

    def _found(self, address: str, size: int, decode: Decode | None, *, fetched: bool) -> Result:
        decoded: Any = None
        if decode is not None:
            try:
                decoded = decode(address, self.cache.view(address))
            except Exception as error:  # of the application: whatever it is belongs to this asset
                text = f"asset {address} could not be decoded: {type(error).__name__}: {error}"
                failure = AssetError(address, "decode", text)
                failure.__cause__ = error
                return Broken(failure, address)
        return Found(address, size, decoded, fetched)

    def _submit(self, address: str, work: Callable[[], Result], size: int = 0) -> None:
        def job() -> None:
            if self._closing and not size:
                return  # only bytes are worth it
            try:
                result = work()
            except AssetError as error:
                self._close(address)
                self._results.put(Broken(error, address))
                result = Stored(size)
            except Exception as error:  # a fault of ours: it must not leave somebody waiting
                self._close(address)
                failure = AssetError(address, "cache", f"asset {address}: {type(error).__name__}: {error}")
                failure.__cause__ = error
                self._results.put(Broken(failure, address))
                result = Stored(size)
            self._results.put(result)
            self._wake()

        self._pools[int(address[:8], 16) % THREADS].submit(job)
