"""`client.assets`: assets fetched from the session by address, in order, into a cache that outlives sessions.

`ClientAssets` exchanges messages, in the thread that polls; `AssetWorkers` are two threads that read, hash, write and
decode. What to request next is decided by `core.asset_loader`.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, Final

from iris_session.assets.errors import AssetStoreError
from iris_session.assets.store import AssetPart, AssetStore, default_root
from iris_session.client.core.asset_loader import AssetLoader, FailedAsset
from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.errors import AssetError, InvalidMessageError, NotConnectedError
from iris_session.client.sockets import ClientSockets
from iris_session.protocol.assets import AssetRequest, is_address
from iris_session.protocol.codec import decode_asset_chunk, decode_asset_refused, encode_asset_request
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.names import PROTOCOL_VERSION
from iris_session.system.priority import lower_thread_priority

_CHUNK_FRAMES: Final = 2
THREADS: Final = 2
#: The polling thread is woken after this many bytes, and while there is more to do not more often than this: one round
#: of polling costs as much as a chunk.
WAKE_BYTES: Final = 1 << 20
WAKE_NS: Final = 5_000_000
Decode = Callable[[str, memoryview], Any]


class AssetFetch:
    """Assets in the order in which they are wanted, and their progress; made by `client.assets.fetch`.

    Attributes:
        addresses: Content hashes of the assets, each once.
        pending: Addresses that are still to come.
        failed: Errors of those that will not come, by address.
        decoded: Results of `decode`, by address.
        bytes_received: Bytes of these assets that came over the network.
        cached: Number of assets that were in the cache.
        refusal: Why the session does not answer requests yet, in its words; empty while it does.
    """

    def __init__(
        self,
        cache: AssetStore,
        addresses: Iterable[str],
        sizes: Mapping[str, int],
        on_progress: Callable[[AssetFetch], None] | None,
        decode: Decode | None,
    ) -> None:
        self.addresses = tuple(dict.fromkeys(addresses))
        self.on_progress = on_progress
        self.decode = decode
        self.pending = dict.fromkeys(self.addresses)
        self.failed: dict[str, AssetError] = {}
        self.decoded: dict[str, Any] = {}
        self.refusal = ""
        self.bytes_received = 0
        self.cached = 0
        self._cache = cache
        self._sizes = {address: sizes[address] for address in self.addresses if address in sizes}
        self._done: dict[str, int] = {}

    @property
    def done(self) -> bool:
        """True when no asset is pending; `failed` has those that could not be fetched."""
        return not self.pending

    @property
    def bytes_done(self) -> int:
        """Bytes of these assets that are available."""
        return sum(self._done.values())

    @property
    def bytes_total(self) -> int:
        """Bytes of all these assets, as far as their sizes are known."""
        return sum(self._sizes.values())

    def read(self, address: str) -> bytes:
        """Read an asset that is here.

        Args:
            address: Content hash, one of `addresses`.

        Returns:
            Its bytes.

        Raises:
            AssetError: It has not come yet, or will not.
        """
        return bytes(self.view(address))

    def view(self, address: str) -> memoryview:
        """Map an asset that is here, without a copy: only the parts that are used are read.

        Args:
            address: Content hash, one of `addresses`.

        Returns:
            Its bytes, read-only.

        Raises:
            AssetError: It has not come yet, or will not.
        """
        if address in self.failed:
            raise self.failed[address]
        if address in self.pending:
            raise AssetError(address, "gone", f"asset {address} has not come yet")
        try:
            return self._cache.view(address)
        except AssetStoreError as error:
            raise AssetError.from_store(error) from error

    def check(self) -> None:
        """Raise the first error of `failed`, if there is one.

        Raises:
            AssetError: An asset will not come.
        """
        for error in self.failed.values():
            raise error

    # --- for the client ----------------------------------------------------------------------------------------------

    def _on_bytes(self, address: str, size: int, total: int, received: int = 0) -> None:
        """Note that `size` of `total` bytes of an asset are here."""
        if address in self.pending:
            self._done[address], self._sizes[address] = size, total
            self.bytes_received += received

    def _on_found(self, address: str, size: int, decoded: Sequence[tuple[Decode, Any]], *, fetched: bool) -> None:
        """Note that an asset is here, with the results of decode functions. It stays pending without that of ours."""
        if address not in self.pending:
            return
        value: Any = None
        if self.decode is not None:
            results = [result for decode, result in decoded if decode == self.decode]
            if not results:
                return
            value = results[0]
        if isinstance(value, AssetError):
            self._fail(address, value)
            return
        self._done[address] = self._sizes[address] = size
        self.cached += not fetched
        if self.decode is not None:
            self.decoded[address] = value
        del self.pending[address]

    def _fail(self, address: str, error: AssetError) -> None:
        """Note that an asset will not come."""
        if address in self.pending:
            del self.pending[address]
            self.failed[address] = error


class ClientAssets:
    """Fetches assets for a client; `Client.poll` continues it, over any number of connections.

    Attributes:
        cache: Where assets are kept; set another one before the first fetch.
        malformed: Messages on the assets channel that do not fit the protocol, or answer no request of ours.
    """

    def __init__(self, connection: ClientConnection, sockets: ClientSockets, lock: threading.RLock) -> None:
        self.cache = AssetStore(default_root("client-assets"))
        self.malformed = 0
        self._connection = connection
        self._sockets = sockets
        self._lock = lock
        self._loader = AssetLoader()
        self._workers: AssetWorkers | None = None
        self._fetches: list[AssetFetch] = []
        self._generation = -1
        self._progressed: list[AssetFetch] = []

    def fetch(
        self,
        addresses: Sequence[str] | Mapping[str, int],
        on_progress: Callable[[AssetFetch], None] | None = None,
        decode: Decode | None = None,
    ) -> AssetFetch:
        """Start to fetch assets in this order, without waiting; those in the cache are not requested.

            fetch = client.assets.fetch([scene_hash])
            client.wait_for(lambda c: fetch.done, 30.0)
            data = fetch.read(scene_hash)

        Args:
            addresses: Content hashes (64 digits 0-9, a-f). As a mapping to sizes [bytes], `bytes_total` is known from
                the beginning.
            on_progress: Called from `poll` with the fetch when bytes have come.
            decode: `decode(address, bytes)` is called in another thread with every asset when it is here, once for one
                function, however many fetches have it. Its result is in `AssetFetch.decoded`; an exception becomes an
                `AssetError`.

        Returns:
            The fetch; it is complete when its `done` is true.

        Raises:
            InvalidMessageError: One of `addresses` is not an address.
            AssetError: `cache` was exchanged while assets were on their way into another.
            NotConnectedError: The client was closed.
        """
        for address in addresses:
            if not is_address(address):
                raise InvalidMessageError(f"{address[:80]!r} is no address of an asset: 64 digits 0-9, a-f")
        sizes = addresses if isinstance(addresses, Mapping) else {}
        with self._lock:
            if self._connection.phase is ConnectionPhase.CLOSED:
                raise NotConnectedError(self._connection.describe())
            if self._workers is None or self._workers.cache is not self.cache:
                if any(fetch.pending for fetch in self._fetches):
                    raise AssetError(
                        "", "cache", "assets.cache was exchanged while assets were on their way into another"
                    )
                if self._workers is not None:
                    self._workers.close()
                self._workers = AssetWorkers(self, self._sockets.wake)
                self._sockets.enable_wake_registration()
            fetch = AssetFetch(self.cache, addresses, sizes, on_progress, decode)
            self._fetches.append(fetch)
            for address in fetch.addresses:
                self._loader.add(address, sizes.get(address, -1))
            self._sockets.wake()
            return fetch

    def cancel(self, fetch: AssetFetch) -> None:
        """Cancel what a fetch still waits for: it has `failed` with reason `cancelled`.

        Bytes that have come stay in the cache, for a later fetch.

        Args:
            fetch: The fetch; one that is done is left as it is.
        """
        with self._lock:
            for address in list(fetch.pending):
                fetch._fail(address, AssetError(address, "cancelled", f"the fetch of asset {address} was cancelled"))
                if not any(address in other.pending for other in self._fetches):
                    self._loader.remove(address)
                    if self._workers is not None:
                        self._workers.release(address)
            self._sockets.wake()

    # --- for the client, which holds the lock ----------------------------------------------------------------------

    @property
    def is_loading(self) -> bool:
        """True while assets are wanted."""
        return not self._loader.idle

    @property
    def has_workers(self) -> bool:
        """True since the first fetch."""
        return self._workers is not None

    def poll(self) -> bool:
        """Process results of the workers and received chunks, and request more.

        Returns:
            True when there was something.
        """
        workers, loader = self._workers, self._loader
        if workers is None:
            return False
        if self._generation != self._connection.generation:
            self._generation = self._connection.generation
            self._close_link()
        progressed = False
        for apply_result in workers.poll_results():
            apply_result()
            progressed = True
        for address in loader.next_lookups():
            workers.look_up(address, self._pending_decodes(address))
        if loader.needs_link and self._connection.is_joined:
            progressed |= self._exchange(workers)
        elif not loader.needs_link:
            self._sockets.close_assets()
        for fetch in [fetch for fetch in self._fetches if fetch.done]:
            self._fetches.remove(fetch)
        return progressed

    def call_back(self) -> None:
        """Call `on_progress` of the fetches that progressed. Without the lock."""
        progressed, self._progressed = self._progressed, []
        for fetch in progressed:
            if fetch.on_progress is not None:
                fetch.on_progress(fetch)

    def close(self) -> AssetWorkers | None:
        """Fail all pending assets, because the client is closed.

        Returns:
            The workers, to be closed without the lock: their decode functions may wait for it.
        """
        workers, self._workers = self._workers, None
        error = AssetError("", "closed", "the client was closed")
        for fetch in self._fetches:
            for address in list(fetch.pending):
                fetch._fail(address, error)
        self._fetches.clear()
        return workers

    def _exchange(self, workers: AssetWorkers) -> bool:
        """Process what has come, then send requests: credit comes back with what was stored."""
        welcome = self._connection.welcome
        assert welcome is not None
        if not welcome.endpoints.assets:
            error = AssetError("", "no_channel", "this session has no channel for assets")
            for address in {address for fetch in self._fetches for address in fetch.pending}:
                self._on_failed(address, error)
            return True
        now_ns = time.monotonic_ns()
        if self._loader.is_paused(now_ns) and not self._sockets.has_assets:
            return False
        self._sockets.open_assets(welcome.endpoints.assets)
        ended = self._sockets.poll_assets_disconnect()  # before the last messages of that connection are read
        messages = self._sockets.drain_assets()
        for frames in messages:
            try:
                self._process_message(workers, frames, now_ns)
            except ProtocolError:
                self.malformed += 1
        if ended:
            self._sockets.close_assets()
            self._loader.on_link_lost(now_ns)
            return True
        if self._loader.is_overdue(now_ns):
            self._close_link()
            return True
        for chunk in self._loader.next_requests(now_ns):
            request = AssetRequest(PROTOCOL_VERSION, welcome.connection_epoch, *chunk)
            if not self._sockets.send_assets(encode_asset_request(request)):
                self._close_link()  # the socket is full although little was requested: there is no peer
                break
        return bool(messages)

    def _process_message(self, workers: AssetWorkers, frames: list[memoryview], now_ns: int) -> None:
        loader = self._loader
        if len(frames) != _CHUNK_FRAMES:
            outcome = loader.process_refusal(decode_asset_refused(frames[0]), now_ns)
            for fetch in self._fetches:
                fetch.refusal = loader.refusal
            if isinstance(outcome, FailedAsset):
                self._on_failed(outcome.address, AssetError(*outcome))
            elif outcome:
                workers.restart(outcome)
            return
        head, data = frames
        chunk = decode_asset_chunk(head, len(data))
        accepted = loader.process_chunk(chunk, len(data), now_ns)
        if isinstance(accepted, FailedAsset):
            self._on_failed(accepted.address, AssetError(*accepted))
            return
        if not accepted:
            self.malformed += accepted is False
            return
        workers.write(chunk.address, data)
        for fetch in self._fetches:
            fetch.refusal = ""
            fetch._on_bytes(chunk.address, chunk.offset + len(data), chunk.total, len(data))
        self._note_progress(chunk.address)
        if loader.is_complete(chunk.address):
            workers.finish(chunk.address, self._pending_decodes(chunk.address))

    # --- results of the workers ---------------------------------------------------------------------------------------

    def _on_stored(self, size: int) -> None:
        """Note that received bytes are written, or dropped."""
        self._loader.on_stored(size)

    def _on_missing(self, address: str, offset: int) -> None:
        """Note that an asset is not complete in the cache; its first `offset` bytes are there."""
        self._loader.on_missing(address, offset)

    def _on_found(self, address: str, size: int, decoded: Sequence[tuple[Decode, Any]], *, fetched: bool) -> None:
        """Note that an asset is in the cache, with the results of decode functions. `fetched`: stored just now."""
        self._loader.remove(address)
        self._note_progress(address)
        for fetch in self._fetches:
            fetch._on_found(address, size, decoded, fetched=fetched)
        if any(address in fetch.pending for fetch in self._fetches):
            self._loader.add(address, size)  # a new fetch decodes it by another function

    def _on_mismatch(self, address: str) -> None:
        """Note that the received bytes do not have the hash of the address; they were removed."""
        if not self._loader.restart_asset(address):
            text = f"the session sent other bytes than those of asset {address}, twice"
            self._on_failed(address, AssetError(address, "hash", text))

    def _on_failed(self, address: str, error: AssetError) -> None:
        """Note that an asset will not come."""
        self._loader.remove(address)
        if self._workers is not None:
            self._workers.release(address)
        self._note_progress(address)
        for fetch in self._fetches:
            fetch._fail(address, error)

    def _note_progress(self, address: str) -> None:
        new = [fetch for fetch in self._fetches if address in fetch.pending and fetch not in self._progressed]
        self._progressed += new

    def _pending_decodes(self, address: str) -> list[Decode]:
        """Return the decode functions of the fetches that wait for an asset, each once."""
        return list(dict.fromkeys(f.decode for f in self._fetches if address in f.pending and f.decode is not None))

    def _close_link(self) -> None:
        self._sockets.close_assets()
        self._loader.on_link_closed()


# --- the threads ------------------------------------------------------------------------------------------------------


#: What a job leaves to be done in the thread that polls.
Result = Callable[[], None]
_Job = tuple[str, Callable[[], Result], int]


class AssetWorkers:
    """Two threads that read, hash and write assets, and decode them for the application.

    Each asset belongs to one of them, so the jobs of one asset run in order. On Linux they have a lower priority than
    the thread that polls: state comes first. The queues are bounded by the caller: by its window of bytes and its limit
    of assets at once.

    Args:
        owner: Gets the results, when it calls what `poll_results` yields.
        wake: Called from the threads when there is a result.
        threads: Number of threads.

    Attributes:
        cache: Where assets are kept.
    """

    def __init__(self, owner: ClientAssets, wake: Callable[[], None], threads: int = THREADS) -> None:
        self.cache = owner.cache
        self._owner = owner
        self._wake = wake
        self._parts: dict[str, AssetPart] = {}
        self._closing = False
        self._results: queue.SimpleQueue[Result] = queue.SimpleQueue()
        self._jobs: list[queue.SimpleQueue[_Job | None]] = [queue.SimpleQueue() for _ in range(threads)]
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
        """Search an asset in the cache; the result is `on_found` or `on_missing`."""

        def work() -> Result:
            view = self.cache.find(address)
            if view is not None:
                return partial(self._owner._on_found, address, *_decode(address, view, decodes), fetched=False)
            part = self._parts[address] = self.cache.open_part(address)
            return partial(self._owner._on_missing, address, part.offset)

        self._submit(address, work)

    def write(self, address: str, data: memoryview) -> None:
        """Write the next bytes of a missing asset; the result is `on_stored`."""

        def work() -> Result:
            part = self._parts.get(address)
            if part is not None:
                part.append(data)
            return partial(self._owner._on_stored, len(data))

        self._submit(address, work, len(data))

    def finish(self, address: str, decodes: Iterable[Decode]) -> None:
        """Check an asset whose bytes are all written; the result is `on_found` or `on_mismatch`."""

        def work() -> Result:
            if not self._parts[address].finish():
                return partial(self._owner._on_mismatch, address)
            del self._parts[address]
            view = self.cache.view(address)
            return partial(self._owner._on_found, address, *_decode(address, view, decodes), fetched=True)

        self._submit(address, work)

    def restart(self, address: str) -> None:
        """Remove the stored bytes of an asset; the result is `on_missing`."""

        def work() -> Result:
            self._parts[address].restart()
            return partial(self._owner._on_missing, address, 0)

        self._submit(address, work)

    def release(self, address: str) -> None:
        """Stop work on an asset that is not wanted any more; its stored bytes remain for a later fetch."""

        def work() -> Result:
            self._close(address)
            return partial(self._owner._on_stored, 0)

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

    def _run(self, jobs: queue.SimpleQueue[_Job | None]) -> None:
        lower_thread_priority()
        untold, woken_ns = 0, 0
        while (job := jobs.get()) is not None:
            address, work, size = job
            if self._closing and not size:
                continue  # while closing, only received bytes are still written
            self._results.put(self._run_job(address, work, size))
            untold += size
            now_ns = time.monotonic_ns()
            if untold >= WAKE_BYTES or (not size and now_ns - woken_ns >= WAKE_NS) or jobs.empty():
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
            self._results.put(partial(self._owner._on_stored, size))
        return partial(self._owner._on_failed, address, failure)

    def _close(self, address: str) -> None:
        part = self._parts.pop(address, None)
        if part is not None:
            part.close()

    def _submit(self, address: str, work: Callable[[], Result], size: int = 0) -> None:
        self._jobs[int(address[:8], 16) % len(self._jobs)].put((address, work, size))


def _decode(address: str, view: memoryview, decodes: Iterable[Decode]) -> tuple[int, list[tuple[Decode, Any]]]:
    """Return the size of an asset, and every function with its result, or with the `AssetError` that it raised."""
    decoded: list[tuple[Decode, Any]] = []
    for decode in decodes:
        try:
            decoded.append((decode, decode(address, view)))
        except Exception as error:  # raised by the application's function: any error fails this asset only
            text = f"asset {address} could not be decoded: {type(error).__name__}: {error}"
            failure = AssetError(address, "decode", text)
            failure.__cause__ = error
            decoded.append((decode, failure))
    return len(view), decoded
