"""Two threads that read, hash and write assets, and decode them for the application.

Each asset belongs to one of them, so the jobs of one asset run in order. `poll_results` returns the results in the
thread that polls. On Linux they have a lower priority than that thread: state comes first.
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
#: The polling thread is woken after this many bytes, and while there is more to do not more often than this: one round
#: of polling costs as much as a chunk.
WAKE_BYTES: Final = 1 << 20
WAKE_NS: Final = 5_000_000
Decode = Callable[[str, memoryview], Any]


class AssetFound(NamedTuple):
    """An asset is in the cache.

    `decoded`: decode functions, each with its result or the `AssetError` that it raised. `fetched`: it was stored just
    now.
    """

    address: str
    size: int
    decoded: tuple[tuple[Decode, Any], ...]
    fetched: bool


class AssetMissing(NamedTuple):
    """An asset is not complete in the cache; its first `offset` bytes are there."""

    address: str
    offset: int


class BytesStored(NamedTuple):
    """This many bytes were written."""

    size: int


class HashMismatch(NamedTuple):
    """The received bytes do not have the hash of the address; they were removed. `size`: number of bytes."""

    address: str
    size: int


class AssetFailed(NamedTuple):
    """The asset cannot be stored or read."""

    error: AssetError
    address: str


Result = AssetFound | AssetMissing | BytesStored | HashMismatch | AssetFailed
_Job = tuple[str, Callable[[], Result], int]


class AssetWorkers:
    """Worker threads for assets. `wake`: called from the threads when there is a result.

    The queues are bounded by the caller: by its window of bytes and its limit of assets at once.
    """

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
        """Search an asset in the cache; the result is `AssetFound` or `AssetMissing`."""

        def work() -> Result:
            view = self.cache.find(address)
            if view is not None:
                return _decode_found(address, view, decodes, fetched=False)
            part = self._parts[address] = self.cache.open_part(address)
            return AssetMissing(address, part.offset)

        self._submit(address, work)

    def write(self, address: str, data: memoryview) -> None:
        """Write the next bytes of a missing asset; the result is `BytesStored`."""

        def work() -> Result:
            part = self._parts.get(address)
            if part is not None:
                part.append(data)
            return BytesStored(len(data))

        self._submit(address, work, len(data))

    def finish(self, address: str, decodes: Iterable[Decode]) -> None:
        """Check an asset whose bytes are all written; the result is `AssetFound` or `HashMismatch`."""

        def work() -> Result:
            part = self._parts[address]
            size = part.offset
            if not part.finish():
                return HashMismatch(address, size)
            del self._parts[address]
            return _decode_found(address, self.cache.view(address), decodes, fetched=True)

        self._submit(address, work)

    def restart(self, address: str) -> None:
        """Remove the stored bytes of an asset; the result is `AssetMissing`."""

        def work() -> Result:
            self._parts[address].restart()
            return AssetMissing(address, 0)

        self._submit(address, work)

    def release(self, address: str) -> None:
        """Stop work on an asset that is not wanted any more; its stored bytes remain for a later fetch."""

        def work() -> Result:
            self._close(address)
            return BytesStored(0)

        self._submit(address, work)

    def close(self) -> None:
        """Finish the present jobs, write all received bytes, and keep partial assets for a later fetch."""
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
                continue  # while closing, only received bytes are still written
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
        except Exception as error:  # an error of our own must not leave a fetch waiting
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
        except Exception as error:  # raised by the application's function: any error fails this asset only
            text = f"asset {address} could not be decoded: {type(error).__name__}: {error}"
            failure = AssetError(address, "decode", text)
            failure.__cause__ = error
            decoded.append((decode, failure))
    return AssetFound(address, len(view), tuple(decoded), fetched)
