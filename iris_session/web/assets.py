"""Assets for browsers: fetched from the session once for all who want them, kept in a content store.

An asset is given out only if the session serves it now: before the store is asked, the session is asked for its size.
`ClientAssets` fetches it, as for any other client.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from typing import Final

import zmq

from iris_session.assets.errors import AssetStoreError
from iris_session.assets.store import AssetStore
from iris_session.client.assets import AssetFetch, ClientAssets
from iris_session.client.core.connection import ClientConnection
from iris_session.client.errors import AssetError, NotConnectedError
from iris_session.client.sockets import ClientSockets
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
#: Period in which assets are fetched while some are wanted.
_POLL_S: Final = 0.002
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
        connection: The gateway's connection.
        sockets: Sockets to fetch assets with; closed by `close`.
        open_socket: Returns a new socket connected to the assets channel, `None` while there is none.
        drops: Counters.
    """

    def __init__(
        self,
        store: AssetStore,
        connection: ClientConnection,
        sockets: ClientSockets,
        open_socket: Callable[[], zmq.Socket[bytes] | None],
        drops: Drops,
    ) -> None:
        self._store = store
        self._connection = connection
        self._sockets = sockets
        self._open_socket = open_socket
        self._drops = drops
        self._loop = asyncio.get_running_loop()
        self._client = ClientAssets(connection, sockets, threading.RLock())
        self._client.cache = store
        self._malformed = 0
        self._reader: SocketReader | None = None
        self._tasks: dict[str, asyncio.Task[memoryview]] = {}
        self._fetches: dict[AssetFetch, asyncio.Future[None]] = {}
        self._poller: asyncio.Task[None] | None = None
        self._sizes: dict[int, asyncio.Future[str]] = {}
        self._requests = 0
        self._allowed: dict[str, int] = {}  # until when
        self._views: dict[str, memoryview] = {}  # the most recently used comes last
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
        task = self._tasks.get(address)
        if task is None:
            if len(self._tasks) >= MAX_PENDING:
                raise AssetUnavailableError(TOO_MANY, f"{MAX_PENDING} assets are being fetched already")
            task = self._tasks[address] = self._loop.create_task(self._fetch(address))
            task.add_done_callback(lambda done: self._forget(address, done))
        try:
            return await asyncio.wait_for(asyncio.shield(task), PATIENCE_S)
        except TimeoutError:
            raise AssetUnavailableError(TEMPORARY, "the asset is not here yet") from None

    def close_link(self) -> None:
        """Forget what the session serves: the gateway was disconnected. What was pending is requested again."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None
        for waiting in self._sizes.values():
            if not waiting.done():
                waiting.set_result(AssetRefusal.BUSY)
        self._allowed.clear()

    async def close(self) -> None:
        """End all work. Bytes that have come are kept for later."""
        for task in (*self._tasks.values(), *([] if self._poller is None else [self._poller])):
            task.cancel()
        self.close_link()
        self._views.clear()
        workers = self._client.close()
        if workers is not None:
            await self._loop.run_in_executor(None, workers.close)
        self._sockets.close()

    # --- one asset ----------------------------------------------------------------------------------------------------

    def _forget(self, address: str, done: asyncio.Task[memoryview]) -> None:
        self._tasks.pop(address, None)
        if not done.cancelled():
            done.exception()  # those who waited have it

    async def _fetch(self, address: str) -> memoryview:
        await self._check_served(address)
        try:
            fetch = self._client.fetch([address])
            waiting = self._fetches[fetch] = self._loop.create_future()
            if self._poller is None or self._poller.done():
                self._poller = self._loop.create_task(self._poll())
            await waiting
            view = fetch.view(address)
        except AssetError as error:
            if error.reason == "hash":
                self._drops.count("web_asset_hash")
            status = UNKNOWN if error.reason == AssetRefusal.UNKNOWN else TEMPORARY
            raise AssetUnavailableError(status, str(error)) from None
        except (AssetStoreError, NotConnectedError) as error:
            raise AssetUnavailableError(TEMPORARY, str(error)) from None
        if not fetch.cached:
            self.fetched += 1
            self.fetched_bytes += len(view)
        while len(self._views) >= MAX_VIEWS:
            del self._views[next(iter(self._views))]
        self._views[address] = view
        return view

    async def _poll(self) -> None:
        """Fetch assets until none is wanted."""
        while self._fetches:
            self._sockets.clear_wake()
            self._client.poll()
            for fetch in [fetch for fetch in self._fetches if fetch.done]:
                waiting = self._fetches.pop(fetch)
                if not waiting.done():
                    waiting.set_result(None)
            if self._client.malformed != self._malformed:
                self._drops.count("web_asset_malformed", n=self._client.malformed - self._malformed)
                self._malformed = self._client.malformed
            await asyncio.sleep(_POLL_S)

    # --- whether the session serves it --------------------------------------------------------------------------------

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
        self._requests += 1
        request_id = self._requests
        request = AssetRequest(PROTOCOL_VERSION, self._connection.connection_epoch, request_id, address, 0, 1)
        waiting = self._sizes[request_id] = self._loop.create_future()
        try:
            if not reader.send([encode_asset_request(request)]):
                return AssetRefusal.BUSY
            return await asyncio.wait_for(waiting, PATIENCE_S / 4)
        except TimeoutError:
            return AssetRefusal.BUSY
        finally:
            self._sizes.pop(request_id, None)

    def _find_reader(self) -> SocketReader | None:
        """Return the connection for sizes, opened where needed; `None` without admission."""
        if self._reader is None:
            sock = self._open_socket()
            if sock is not None:
                sock.setsockopt(zmq.MAXMSGSIZE, MAX_ASSET_CHUNK_BYTES)
                self._reader = SocketReader(sock, self._receive, batch=8)
        return self._reader

    def _receive(self, frames: list[zmq.Frame]) -> None:
        try:
            if len(frames) == _CHUNK_FRAMES:
                request_id, reason = decode_asset_chunk(frames[0].buffer, len(frames[1])).request_id, ""
            else:
                refused = decode_asset_refused(frames[0].buffer)
                request_id, reason = refused.request_id, refused.reason
        except ProtocolError:
            self._drops.count("web_asset_malformed")
            return
        waiting = self._sizes.get(request_id)
        if waiting is not None and not waiting.done():
            waiting.set_result(reason)
