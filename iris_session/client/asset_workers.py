"""Two threads that read, hash and write assets, and decode them for the application.

An asset belongs to one of them, so what is asked for one asset happens in that order. What became of it is taken by
`results` in the thread that polls. On Linux they have a lower priority than the thread that polls: state comes first.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final, NamedTuple

from iris_session.assets.errors import AssetStoreError
from iris_session.assets.store import AssetPart, AssetStore
from iris_session.client.errors import AssetError
from iris_session.system.priority import lower_thread_priority

THREADS: Final = 2
#: Who polls is woken after so many bytes, and not more often than this while there is more to do: to look at everything
#: that may have come costs it as much as a chunk does.
WAKE_BYTES: Final = 1 << 20
WAKE_NS: Final = 5_000_000
Decode = Callable[[str, memoryview], Any]


class AssetFound(NamedTuple):
    """An asset is in the cache. `decoded`: functions, with what each made of it, or the `AssetError` that it ended
    with. `fetched`: it was stored just now."""

    address: str
    size: int
    decoded: tuple[tuple[Decode, Any], ...]
    fetched: bool


class AssetMissing(NamedTuple):
    """Its first `offset` bytes are there."""

    address: str
    offset: int


class BytesStored(NamedTuple):
    """So many bytes were taken over."""

    size: int


class HashMismatch(NamedTuple):
    """The bytes that came are not those of the address; they are thrown away. `size`: how many they were."""

    address: str
    size: int


class AssetFailed(NamedTuple):
    """The asset will not come."""

    error: AssetError
    address: str


Result = AssetFound | AssetMissing | BytesStored | HashMismatch | AssetFailed
_Job = tuple[str, Callable[[], Result], int]


class AssetWorkers:
    """`wake`: called from the threads when there is a result. How much waits is bounded by who asks: a window of bytes,
    and a few assets at once."""

    def __init__(self, cache: AssetStore, wake: Callable[[], None]) -> None:
        self.cache = cache
        self._wake = wake
        self._parts: dict[str, AssetPart] = {}
        self._closing = False
        self._results: queue.SimpleQueue[Result] = queue.SimpleQueue()
        self._jobs: list[queue.SimpleQueue[_Job | None]] = [queue.SimpleQueue() for _ in range(THREADS)]
        self._threads = [
            threading.Thread(target=self._run, args=(jobs,), name=f"iris-assets-{n}", daemon=True)
            for n, jobs in enumerate(self._jobs)
        ]
        for thread in self._threads:
            thread.start()

    def poll_results(self) -> Iterator[Result]:
        """Yield the results since the last call."""
        while not self._results.empty():
            yield self._results.get_nowait()

    def look_up(self, address: str, decodes: Iterable[Decode]) -> None:
        """`Found` or `Missing`."""

        def work() -> Result:
            view = self.cache.find(address)
            if view is not None:
                return _decode_found(address, view, decodes, fetched=False)
            part = self._parts[address] = self.cache.open_part(address)
            return AssetMissing(address, part.offset)

        self._submit(address, work)

    def write(self, address: str, data: memoryview) -> None:
        """The next bytes of an asset that was `Missing`: `Stored`."""

        def work() -> Result:
            part = self._parts.get(address)
            if part is not None:
                part.append(data)
            return BytesStored(len(data))

        self._submit(address, work, len(data))

    def finish(self, address: str, decodes: Iterable[Decode]) -> None:
        """All bytes were written: `Found` or `Wrong`."""

        def work() -> Result:
            part = self._parts[address]
            size = part.offset
            if not part.finish():
                return HashMismatch(address, size)
            del self._parts[address]
            return _decode_found(address, self.cache.view(address), decodes, fetched=True)

        self._submit(address, work)

    def restart(self, address: str) -> None:
        """Throws away what is there: `Missing`."""

        def work() -> Result:
            self._parts[address].restart()
            return AssetMissing(address, 0)

        self._submit(address, work)

    def release(self, address: str) -> None:
        """It is not wanted any more; what is there stays for another time."""

        def work() -> Result:
            self._close(address)
            return BytesStored(0)

        self._submit(address, work)

    def close(self) -> None:
        """Waits for what is being done, writes what has come, and leaves parts for another time."""
        self._closing = True
        for jobs in self._jobs:
            jobs.put(None)
        for thread in self._threads:
            thread.join()
        for address in list(self._parts):
            self._close(address)

    # --- the threads --------------------------------------------------------------------------------------------------

    def _run(self, jobs: queue.SimpleQueue[_Job | None]) -> None:
        lower_thread_priority()
        untold, woken_ns = 0, 0
        while (job := jobs.get()) is not None:
            address, work, size = job
            if self._closing and not size:
                continue  # only bytes are worth it
            result = self._run_job(address, work, size)
            self._results.put(result)
            untold += size
            now_ns = time.monotonic_ns()
            news = untold >= WAKE_BYTES or (not isinstance(result, BytesStored) and now_ns - woken_ns >= WAKE_NS)
            if news or jobs.empty():
                untold, woken_ns = 0, now_ns
                self._wake()

    def _run_job(self, address: str, work: Callable[[], Result], size: int) -> Result:
        try:
            return work()
        except AssetError as error:
            failure = error
        except AssetStoreError as error:
            failure = AssetError.from_store(error)
            failure.__cause__ = error
        except Exception as error:  # a fault of ours: it must not leave a fetch waiting
            failure = AssetError(address, "cache", f"asset {address}: {type(error).__name__}: {error}")
            failure.__cause__ = error
        self._close(address)
        if size:
            self._results.put(BytesStored(size))
        return AssetFailed(failure, address)

    def _close(self, address: str) -> None:
        part = self._parts.pop(address, None)
        if part is not None:
            part.close()

    def _submit(self, address: str, work: Callable[[], Result], size: int = 0) -> None:
        self._jobs[int(address[:8], 16) % THREADS].put((address, work, size))


def _decode_found(address: str, view: memoryview, decodes: Iterable[Decode], *, fetched: bool) -> Result:
    decoded: list[tuple[Decode, Any]] = []
    for decode in decodes:
        try:
            decoded.append((decode, decode(address, view)))
        except Exception as error:  # of the application: whatever it is belongs to this asset
            text = f"asset {address} could not be decoded: {type(error).__name__}: {error}"
            failure = AssetError(address, "decode", text)
            failure.__cause__ = error
            decoded.append((decode, failure))
    return AssetFound(address, len(view), tuple(decoded), fetched)
