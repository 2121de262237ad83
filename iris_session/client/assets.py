"""Assets of a client: fetched from the session by address, in order, into a cache that outlives sessions."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from iris_session.assets.cache import AssetCache
from iris_session.client.asset_fetch import AssetFetch
from iris_session.client.asset_workers import AssetWorkers, AssetFailed, Decode, AssetFound, AssetMissing, Result, BytesStored
from iris_session.client.core.asset_loader import AssetLoader, FailedAsset
from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.errors import AssetError, InvalidMessageError, NotConnectedError
from iris_session.client.sockets import ClientSockets
from iris_session.protocol.assets import AssetRequest, is_address
from iris_session.protocol.codec import decode_asset_chunk, decode_asset_refused, encode_asset_request
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.names import PROTOCOL_VERSION

_CHUNK_FRAMES: Final = 2


class Assets:
    """Part of `Client`. `asset_cache`: where assets are kept; set another one before the first is fetched."""

    connection: ClientConnection
    _sockets: ClientSockets
    _lock: threading.RLock
    assets_DOT_cache: AssetCache

    def _init_assets(self) -> None:
        self.assets_DOT_cache = AssetCache()
        self._loader = AssetLoader()
        self._workers: AssetWorkers | None = None
        self._fetches: list[AssetFetch] = []
        self._asset_generation = -1
        self._news: list[AssetFetch] = []
        #: Messages on the assets channel that do not fit the protocol, or that nobody here asked for.
        self.assets_DOT_malformed = 0

    def assets_DOT_fetch(
        self,
        addresses: Sequence[str] | Mapping[str, int],
        on_progress: Callable[[AssetFetch], None] | None = None,
        decode: Decode | None = None,
    ) -> AssetFetch:
        """Fetches assets in this order; what the cache has is not asked for. `poll` goes on with it, over any number
        of connections. With sizes (a mapping), `bytes_total` is known from the beginning.

        `on_progress(fetch)`: called from `poll` when something has come. `decode(address, bytes)`: called in another
        thread with every asset when it is there (once for one function, however many fetches have it); what it returns
        is in `AssetFetch.decoded`, what it raises is an `AssetError`. Raises `InvalidMessageError` for what is no
        address, `AssetError` when `asset_cache` was exchanged while something was on its way.

            fetch = client.fetch_assets([scene_hash])
            client.wait_for(lambda c: fetch.done, 30.0)
            data = fetch.read(scene_hash)
        """
        for address in addresses:
            if not is_address(address):
                raise InvalidMessageError(f"{address[:80]!r} is no address of an asset: 64 digits 0-9, a-f")
        sizes = addresses if isinstance(addresses, Mapping) else {}
        with self._lock:
            if self.connection.phase is ConnectionPhase.CLOSED:
                raise NotConnectedError(self.connection.describe())
            if self._workers is None or self._workers.cache is not self.assets_DOT_cache:
                if any(fetch.pending for fetch in self._fetches):
                    raise AssetError(
                        "", "cache", "asset_cache was exchanged while assets were on their way into another"
                    )
                self._end_workers()
                self._workers = AssetWorkers(self.assets_DOT_cache, self._sockets.wake)
                self._sockets.enable_wake_registration()
            fetch = AssetFetch(self.assets_DOT_cache, addresses, sizes, on_progress, decode)
            self._fetches.append(fetch)
            for address in fetch.addresses:
                self._loader.add(address, sizes.get(address, -1))
            self._sockets.wake()
            return fetch

    def assets_DOT_cancel(self, fetch: AssetFetch) -> None:
        """What `fetch` still waits for is not wanted any more: it has `failed`, as `cancelled`. What has come of it
        stays in the cache, to be gone on with. Does nothing when it is done."""
        with self._lock:
            for address in list(fetch.pending):
                error = AssetError(address, "cancelled", f"asset {address} was not waited for")
                fetch.fail(address, error)
                if not any(address in other.pending for other in self._fetches):
                    self._loader.remove(address)
                    if self._workers is not None:
                        self._workers.release(address)
            self._sockets.wake()

    @property
    def _loads_assets(self) -> bool:
        return not self._loader.idle

    # --- inside -------------------------------------------------------------------------------------------------------

    def _tend_assets(self) -> bool:
        """Takes what the workers have done and what has come, and asks for more. True when there was something."""
        workers, loader = self._workers, self._loader
        if workers is None:
            return False
        if self._asset_generation != self.connection.generation:
            self._asset_generation = self.connection.generation
            self._drop_asset_link()
        progressed = False
        for result in workers.poll_results():
            self._take_result(result)
            progressed = True
        for address in loader.next_lookups():
            workers.look_up(address, self._decodes_of(address))
        if loader.needs_link and self.connection.is_joined:
            progressed |= self._exchange(workers)
        elif not loader.needs_link:
            self._sockets.close_assets()
        for fetch in [fetch for fetch in self._fetches if fetch.done]:
            self._fetches.remove(fetch)
        return progressed

    def _exchange(self, workers: AssetWorkers) -> bool:
        """What has come, then what is to be asked for: credit comes back with what was stored."""
        welcome = self.connection.welcome
        assert welcome is not None
        if not welcome.endpoints.assets:
            error = AssetError("", "no_channel", "this session has no channel for assets")
            for address in {address for fetch in self._fetches for address in fetch.pending}:
                self._fail(address, error)
            return True
        now_ns = time.monotonic_ns()
        if self._loader.is_paused(now_ns) and not self._sockets.has_assets:
            return False
        self._sockets.open_assets(welcome.endpoints.assets)
        ended = self._sockets.poll_assets_disconnect()  # before the last that it has brought is taken
        messages = self._sockets.drain_assets()
        for frames in messages:
            try:
                self._take_message(workers, frames, now_ns)
            except ProtocolError:
                self.assets_DOT_malformed += 1
        if ended:
            self._sockets.close_assets()
            self._loader.on_link_lost(now_ns)
            return True
        if self._loader.is_overdue(now_ns):
            self._drop_asset_link()
            return True
        for ask in self._loader.next_requests(now_ns):
            request = AssetRequest(PROTOCOL_VERSION, welcome.connection_epoch, *ask)
            if not self._sockets.send_assets(encode_asset_request(request)):
                self._drop_asset_link()  # it takes nothing, though little was asked for: it is not there
                break
        return bool(messages)

    def _take_message(self, workers: AssetWorkers, frames: list[memoryview], now_ns: int) -> None:
        loader = self._loader
        if len(frames) != _CHUNK_FRAMES:
            outcome = loader.process_refusal(decode_asset_refused(frames[0]), now_ns)
            for fetch in self._fetches:
                fetch.refusal = loader.refusal
            if isinstance(outcome, FailedAsset):
                self._fail(outcome.address, AssetError(*outcome))
            elif outcome:
                workers.restart(outcome)
            return
        head, data = frames
        chunk = decode_asset_chunk(head, len(data))
        taken = loader.process_chunk(chunk, len(data), now_ns)
        if isinstance(taken, FailedAsset):
            self._fail(taken.address, AssetError(*taken))
            return
        if not taken:
            self.assets_DOT_malformed += taken is False
            return
        workers.write(chunk.address, data)
        for fetch in self._fetches:
            fetch.refusal = ""
            fetch.on_bytes(chunk.address, chunk.offset + len(data), chunk.total, len(data))
        self._tell(chunk.address)
        if loader.is_complete(chunk.address):
            workers.finish(chunk.address, self._decodes_of(chunk.address))

    def _take_result(self, result: Result) -> None:
        loader = self._loader
        if isinstance(result, BytesStored):
            loader.on_stored(result.size)
        elif isinstance(result, AssetFound):
            loader.remove(result.address)
            self._tell(result.address)
            for fetch in self._fetches:
                fetch.on_found(result.address, result.size, result.decoded, fetched=result.fetched)
            if any(result.address in fetch.pending for fetch in self._fetches):
                loader.add(result.address, result.size)  # somebody came meanwhile who wants it decoded otherwise
        elif isinstance(result, AssetMissing):
            loader.on_missing(result.address, result.offset)
        elif isinstance(result, AssetFailed):
            self._fail(result.address, result.error)
        elif not loader.restart_asset(result.address):
            text = f"the session sent other bytes than those of asset {result.address}, twice"
            self._fail(result.address, AssetError(result.address, "hash", text))

    def _fail(self, address: str, error: AssetError) -> None:
        self._loader.remove(address)
        if self._workers is not None:
            self._workers.release(address)
        self._tell(address)
        for fetch in self._fetches:
            fetch.fail(address, error)

    def _tell(self, address: str) -> None:
        self._news += [fetch for fetch in self._fetches if address in fetch.pending and fetch not in self._news]

    def _decodes_of(self, address: str) -> list[Decode]:
        """What the fetches that wait for an asset want to be made of it, each once."""
        found: list[Decode] = []
        for fetch in self._fetches:
            if address in fetch.pending and fetch.decode is not None and fetch.decode not in found:
                found.append(fetch.decode)
        return found

    def _drop_asset_link(self) -> None:
        self._sockets.close_assets()
        self._loader.on_link_closed()

    def _call_back_assets(self) -> None:
        """Without the lock."""
        news, self._news = self._news, []
        for fetch in news:
            if fetch.on_progress is not None:
                fetch.on_progress(fetch)

    def _end_workers(self) -> None:
        if self._workers is not None:
            self._workers.close()
            self._workers = None

    def _end_assets(self) -> AssetWorkers | None:
        """The client is closed: what has not come will not. The workers, to be closed without the lock: what they
        decode with may wait for it."""
        workers, self._workers = self._workers, None
        error = AssetError("", "closed", "the client was closed")
        for fetch in self._fetches:
            for address in list(fetch.pending):
                fetch.fail(address, error)
        self._fetches.clear()
        return workers
