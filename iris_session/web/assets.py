"""Assets for browsers: fetched from the session once for all who want them, kept in a content store.

An asset is given out only if the session serves it now: before the store is asked, the session is asked for its size.
Order, window and repetition of requests are those of `client.core.asset_loader`; files are read, written and hashed by
the threads of `client.asset_workers`.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from typing import Final

import zmq

from iris_session.assets.errors import AssetStoreError
from iris_session.assets.store import AssetStore
from iris_session.client.asset_workers import AssetFailed, AssetFound, AssetMissing, AssetWorkers, BytesStored
from iris_session.client.core.asset_loader import AssetLoader, FailedAsset
from iris_session.protocol.assets import MAX_ASSET_CHUNK_BYTES, AssetRequest
from iris_session.protocol.codec import decode_asset_chunk, decode_asset_refused, encode_asset_request
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import PROTOCOL_VERSION, AssetRefusal
from iris_session.system.backoff import Backoff
from iris_session.web.sockets import SocketReader

#: Assets in work at once; more are refused with 429.
MAX_PENDING: Final = 512
#: Mapped assets that are kept open.
MAX_VIEWS: Final = 128
#: The session is asked again after so long whether it still serves an asset: scenes change.
ALLOWED_NS: Final = 30_000_000_000
#: Longest time to answer one request.
PATIENCE_S: Final = 60.0
#: Ids of the requests for sizes, above those that a loader counts up from 1.
_FIRST_SIZE_REQUEST: Final = 1 << 40
_TICK_S: Final = 0.05
_RETRY_S: Final = (0.1, 0.2, 0.4, 0.8, 1.6)
_CHUNK_FRAMES: Final = 2
UNKNOWN, TOO_MANY, TEMPORARY = 404, 429, 503


class ByteRate:
    """Rate of bytes that all senders share: each waits until what was reserved before is sent.

    `bytes_per_s`: of all together.
    """

    def __init__(self, bytes_per_s: float) -> None:
        self._bytes_per_s = bytes_per_s
        self._due_s = 0.0

    def reserve(self, n_bytes: int, now_s: float) -> float:
        """Reserve `n_bytes` and return how long to wait before they are sent [s]."""
        begin_s = max(self._due_s, now_s)
        self._due_s = begin_s + n_bytes / self._bytes_per_s
        return begin_s - now_s


class AssetUnavailableError(Exception):
    """An asset cannot be given out. `status`: of HTTP."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


class GatewayAssets:
    """Assets of one session. All methods belong to the asyncio loop.

    Args:
        store: Where assets are kept; that of the session, when the gateway runs beside it.
        open_socket: Returns a new socket connected to the assets channel, `None` while there is none.
        find_epoch: Returns the gateway's connection epoch, 0 while it is not admitted.
        drops: Counters.
    """

    def __init__(
        self,
        store: AssetStore,
        open_socket: Callable[[], zmq.Socket[bytes] | None],
        find_epoch: Callable[[], int],
        drops: Drops,
    ) -> None:
        self._store = store
        self._open_socket = open_socket
        self._find_epoch = find_epoch
        self._drops = drops
        self._loop = asyncio.get_running_loop()
        self._loader = AssetLoader()
        self._workers: AssetWorkers | None = None
        self._reader: SocketReader | None = None
        self._epoch = 0
        self._pending: dict[str, asyncio.Task[memoryview]] = {}
        self._loading: dict[str, asyncio.Future[None]] = {}
        self._sizes: dict[int, asyncio.Future[str]] = {}
        self._next_size_request = _FIRST_SIZE_REQUEST
        self._allowed: dict[str, int] = {}  # until when
        self._views: dict[str, memoryview] = {}  # the most recently used comes last
        self._ticker: asyncio.TimerHandle | None = None
        #: Assets that were fetched from the session, and bytes of them.
        self.fetched = self.fetched_bytes = 0

    async def find(self, address: str) -> memoryview:
        """Return the verified bytes of an asset that the session serves.

        Raises:
            AssetUnavailableError: It does not, or it cannot be fetched now.
        """
        view = self._views.get(address)
        if view is not None and self._allowed.get(address, 0) > time.monotonic_ns():
            self._views[address] = self._views.pop(address)
            return view
        task = self._pending.get(address)
        if task is None:
            if len(self._pending) >= MAX_PENDING:
                raise AssetUnavailableError(TOO_MANY, f"{MAX_PENDING} assets are being fetched already")
            task = self._pending[address] = self._loop.create_task(self._fetch(address))
            task.add_done_callback(lambda done: self._forget(address, done))
        try:
            return await asyncio.wait_for(asyncio.shield(task), PATIENCE_S)
        except TimeoutError:
            raise AssetUnavailableError(TEMPORARY, "the asset is not here yet") from None

    def close_link(self) -> None:
        """Close the connection to the session: the gateway was disconnected. What was pending is requested again."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None
        self._loader.on_link_closed()
        for waiting in self._sizes.values():
            if not waiting.done():
                waiting.set_result(AssetRefusal.BUSY)
        self._sizes.clear()
        self._allowed.clear()

    async def close(self) -> None:
        """End all work. Bytes that have come are kept for later."""
        for task in list(self._pending.values()):
            task.cancel()
        self.close_link()
        if self._ticker is not None:
            self._ticker.cancel()
        self._views.clear()
        workers, self._workers = self._workers, None
        if workers is not None:
            await self._loop.run_in_executor(None, workers.close)

    # --- one asset ----------------------------------------------------------------------------------------------------

    def _forget(self, address: str, done: asyncio.Task[memoryview]) -> None:
        self._pending.pop(address, None)
        if not done.cancelled():
            done.exception()  # those who waited have it

    async def _fetch(self, address: str) -> memoryview:
        await self._check_served(address)
        waiting = self._loading[address] = self._loop.create_future()
        try:
            self._loader.add(address)
            self._tick()
            await waiting
        finally:
            self._loading.pop(address, None)
            self._loader.remove(address)
        try:
            view = self._store.view(address)
        except AssetStoreError as error:
            raise AssetUnavailableError(TEMPORARY, str(error)) from None
        while len(self._views) >= MAX_VIEWS:
            del self._views[next(iter(self._views))]
        self._views[address] = view
        return view

    async def _check_served(self, address: str) -> None:
        """Ask the session whether it serves an asset now. Raises `AssetUnavailableError`."""
        if self._allowed.get(address, 0) > time.monotonic_ns():
            return
        pauses = Backoff(_RETRY_S)
        while True:
            refusal = await self._request_size(address)
            if not refusal:
                break
            if refusal not in AssetRefusal.PASSING:
                self._drops.count("web_asset_unknown")
                raise AssetUnavailableError(UNKNOWN, "the session does not serve this asset")
            if pauses.failures >= len(_RETRY_S):
                raise AssetUnavailableError(TEMPORARY, f"the session is not ready: {refusal}")
            await asyncio.sleep(pauses.next_delay())
        now_ns = time.monotonic_ns()
        if len(self._allowed) > 4 * MAX_PENDING:
            self._allowed = {one: until for one, until in self._allowed.items() if until > now_ns}
        self._allowed[address] = now_ns + ALLOWED_NS

    async def _request_size(self, address: str) -> str:
        """Request one byte of an asset, which names its size. Return the reason of a refusal, empty for an answer."""
        reader = self._find_reader()
        if reader is None:
            return AssetRefusal.NOT_ALLOWED
        self._next_size_request += 1
        request_id = self._next_size_request
        request = AssetRequest(PROTOCOL_VERSION, self._epoch, request_id, address, 0, 1)
        waiting = self._sizes[request_id] = self._loop.create_future()
        try:
            if not reader.send([encode_asset_request(request)]):
                return AssetRefusal.BUSY
            return await asyncio.wait_for(waiting, PATIENCE_S / 4)
        except TimeoutError:
            return AssetRefusal.BUSY
        finally:
            self._sizes.pop(request_id, None)

    # --- the channel --------------------------------------------------------------------------------------------------

    def _find_reader(self) -> SocketReader | None:
        """Return the connection to the assets channel, opened where needed; `None` without admission."""
        epoch = self._find_epoch()
        if epoch != self._epoch:
            self.close_link()
            self._epoch = epoch
        if self._reader is None and epoch:
            sock = self._open_socket()
            if sock is None:
                return None
            sock.setsockopt(zmq.MAXMSGSIZE, MAX_ASSET_CHUNK_BYTES)
            self._reader = SocketReader(sock, self._receive, self._tick, batch=8)
        return self._reader

    def _tick(self) -> None:
        """Process results of the threads and request what is missing; again after a while, while there is work."""
        if self._ticker is not None:
            self._ticker.cancel()
            self._ticker = None
        if not self._loading and self._loader.idle:
            return
        workers, loader = self._workers, self._loader
        if workers is None:
            workers = self._workers = AssetWorkers(self._store, self._wake)
        for result in workers.poll_results():
            if isinstance(result, BytesStored):
                loader.on_stored(result.size)
            elif isinstance(result, AssetFound):
                self.fetched += result.fetched
                self.fetched_bytes += result.size if result.fetched else 0
                self._finish(result.address)
            elif isinstance(result, AssetMissing):
                loader.on_missing(result.address, result.offset)
            elif isinstance(result, AssetFailed):
                self._finish(result.address, AssetUnavailableError(TEMPORARY, str(result.error)))
            elif not loader.restart_asset(result.address):
                self._drops.count("web_asset_hash")
                text = "the session sent other bytes than those of the asset, twice"
                self._finish(result.address, AssetUnavailableError(TEMPORARY, text))
        for address in loader.next_lookups():
            workers.look_up(address, ())
        self._request_chunks()
        self._ticker = self._loop.call_later(_TICK_S, self._tick)

    def _request_chunks(self) -> None:
        loader, now_ns = self._loader, time.monotonic_ns()
        if not loader.needs_link:
            return
        if loader.is_overdue(now_ns) and self._reader is not None:
            self._reader.close()
            self._reader = None
            loader.on_link_lost(now_ns)
        reader = self._find_reader()
        if reader is None:
            return
        for chunk in loader.next_requests(now_ns):
            if not reader.send([encode_asset_request(AssetRequest(PROTOCOL_VERSION, self._epoch, *chunk))]):
                reader.close()
                self._reader = None
                loader.on_link_lost(now_ns)
                return

    def _wake(self) -> None:
        """Process results soon. Called by the threads."""
        self._loop.call_soon_threadsafe(self._tick)

    def _receive(self, frames: list[zmq.Frame]) -> None:
        try:
            self._process([frame.buffer for frame in frames])
        except ProtocolError:
            self._drops.count("web_asset_malformed")

    def _process(self, frames: Sequence[memoryview]) -> None:
        loader, now_ns = self._loader, time.monotonic_ns()
        if len(frames) != _CHUNK_FRAMES:
            refused = decode_asset_refused(frames[0])
            waiting = self._sizes.get(refused.request_id)
            if waiting is not None:
                if not waiting.done():
                    waiting.set_result(refused.reason)
                return
            outcome = loader.process_refusal(refused, now_ns)
            if isinstance(outcome, FailedAsset):
                self._finish(outcome.address, AssetUnavailableError(UNKNOWN, outcome.text))
            elif outcome and self._workers is not None:
                self._workers.restart(outcome)
            return
        head, data = frames
        chunk = decode_asset_chunk(head, len(data))
        waiting = self._sizes.get(chunk.request_id)
        if waiting is not None or chunk.request_id >= _FIRST_SIZE_REQUEST:
            if waiting is not None and not waiting.done():
                waiting.set_result("")
            return
        accepted = loader.process_chunk(chunk, len(data), now_ns)
        if isinstance(accepted, FailedAsset):
            self._finish(accepted.address, AssetUnavailableError(TEMPORARY, accepted.text))
        elif accepted and self._workers is not None:
            self._workers.write(chunk.address, data)
            if loader.is_complete(chunk.address):
                self._workers.finish(chunk.address, ())
        elif accepted is False:
            self._drops.count("web_asset_malformed")

    def _finish(self, address: str, error: AssetUnavailableError | None = None) -> None:
        self._loader.remove(address)
        if error is not None and self._workers is not None:
            self._workers.release(address)
        waiting = self._loading.get(address)
        if waiting is not None and not waiting.done():
            if error is None:
                waiting.set_result(None)
            else:
                waiting.set_exception(error)
