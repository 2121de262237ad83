"""The asset server: a thread of the front that sends chunks of assets, with a ZeroMQ context of its own.

The context's I/O thread, which copies and encrypts, has a lower priority than all other threads of the front. The
server's own thread has not: it holds Python's lock for moments, and a thread that does not get the processor while it
holds the lock would stop the front. It pauses instead, whenever the front's loop is late. Which client may fetch what
is decided in `asset_service`; which request is next in `assets.chunk_scheduler`.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Final, NamedTuple

import zmq

from iris_session.assets.chunk_scheduler import ADVICE, ChunkReader, ChunkScheduler
from iris_session.assets.store import ServedAssets
from iris_session.link.config import MILLISECOND, FrontConfig
from iris_session.link.sockets import open_assets, read_peer, readable, watch_tcp
from iris_session.link.tcp_guard import PendingConnection, TcpGuard
from iris_session.protocol.assets import AssetChunk, AssetRefused
from iris_session.protocol.codec import decode_asset_request, encode_asset_header
from iris_session.protocol.errors import ProtocolError, ProtocolVersionError
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import PROTOCOL_VERSION, AssetRefusal
from iris_session.security import KeyPair, compute_fingerprint
from iris_session.security.zap import ZAP_ENDPOINT, answer_zap_requests, is_curve_request
from iris_session.system.priority import run_at_low_priority

log = logging.getLogger(__name__)

IDLE_MS: Final = 50
#: Requests handled, and chunks sent, per pass.
ROUND: Final = 64
CHUNKS: Final = 2
#: While the front's loop is late, one chunk is sent per so long: the slowest headset still gets its scene.
YIELD_MS: Final = 5
#: Refusals that do not count against a gateway, which requests for many: it limits each of them by itself.
_OF_OTHERS: Final = frozenset({AssetRefusal.UNKNOWN, AssetRefusal.TOO_MANY, AssetRefusal.RATE, AssetRefusal.BUSY})
#: Pause after a fault of the server: a repeated fault must not use a whole processor.
FAULT_S: Final = 0.25
#: As plain integers: operations on the enumerations take longer than the calls that use them.
_DONTWAIT: Final = int(zmq.DONTWAIT)
_MORE: Final = int(zmq.DONTWAIT | zmq.SNDMORE)


#: A folder, with the addresses of the assets served from it.
AssetFolder = tuple[str, tuple[str, ...]]


class AssetAccess(NamedTuple):
    """Access to assets: which client may fetch which. Replaced as a whole, from the front's loop.

    Attributes:
        clients: Connections that may request, with the key of their TCP connection (empty without encryption).
        allowed_keys: Fingerprints of the keys that may connect.
        folders: Assets that are served.
        gateways: Connections that request for others.
    """

    clients: Mapping[int, str] = {}
    allowed_keys: frozenset[str] = frozenset()
    folders: tuple[AssetFolder, ...] = ()
    gateways: frozenset[int] = frozenset()


class AssetSockets:
    """Sockets of the assets channel, in a context of their own. Raises `FrontError`."""

    def __init__(self, config: FrontConfig, key: KeyPair | None) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context(1)
        self.zap: zmq.Socket[bytes] | None = None
        if key is not None:  # before a client can connect: without a ZAP handler libzmq admits every key
            self.zap = self.context.socket(zmq.ROUTER)
            self.zap.bind(ZAP_ENDPOINT)
        try:
            self.socket = open_assets(self.context, config, key)
        except BaseException:
            self.close()
            raise
        self.monitor = watch_tcp(self.socket, "assets")

    def close(self) -> None:
        self.context.destroy(linger=0)


def open_asset_sockets(config: FrontConfig, key: KeyPair | None) -> AssetSockets:
    """Open `AssetSockets` whose I/O thread has a low priority. Raises `FrontError`."""
    return run_at_low_priority(lambda: AssetSockets(config, key))


class AssetServer:
    """Serve assets in a thread. `set_access`, `pending_readers` and the attributes are for other threads.

    Attributes:
        late_until_ns: Session time until which the server yields to the front's loop.
        sent_bytes, requests: Counters since the start.
        drops: Refusals and drops since the start.
    """

    def __init__(self, sockets: AssetSockets, guard: TcpGuard, now_ns: Callable[[], int]) -> None:
        self._sockets = sockets
        self._socket = sockets.socket
        self._guard = guard
        self._now_ns = now_ns
        self._encrypted = sockets.zap is not None
        self._files = ServedAssets()
        self._scheduler = ChunkScheduler(self._files.size)
        self._access = self._applied = AssetAccess()
        self.sent_bytes = self.requests = 0
        self.drops = Drops()
        self._stopping = False
        self._reported_fault = ""
        self._thread = threading.Thread(target=self._run, name="iris-assets", daemon=True)
        self.late_until_ns = 0

    def start(self) -> None:
        self._thread.start()

    def set_access(self, access: AssetAccess) -> None:
        """Set who may fetch what. A request made after this call returns is answered by it."""
        self._access = access

    @property
    def pending_readers(self) -> int:
        """Number of readers with pending requests."""
        return self._scheduler.n_waiting

    def list_pending(self) -> list[PendingConnection]:
        """Return the connections of readers and what is unread of them."""
        return self._guard.list_pending()

    def close(self) -> None:
        """Wait for the end of the thread, then close the sockets."""
        self._stopping = True
        if self._thread.ident is not None:
            self._thread.join()
        self._guard.close()
        self._sockets.close()

    # --- the thread --------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopping:
            try:
                self._serve()
            except Exception as error:  # a fault of the server costs requests under way, and affects assets alone
                self._recover(error)

    def _recover(self, error: Exception) -> None:
        """Count a fault, log it unless it repeats the last one, and close all connections: clients request again by new
        ones."""
        for descriptor in self._scheduler.clear():
            self._guard.evict(descriptor, "")
        self.drops.count("assets_fault")
        if repr(error) != self._reported_fault:
            self._reported_fault = repr(error)
            log.error("fault in the thread of assets, which continues: %s", self._reported_fault, exc_info=error)
        time.sleep(FAULT_S)

    def _serve(self) -> None:
        poller = zmq.Poller()
        for one in (self._socket, self._sockets.zap):
            if one is not None:
                poller.register(one, zmq.POLLIN)
        while not self._stopping:
            poller.poll(self._poll_timeout_ms())
            self._apply_access()
            if self._sockets.zap is not None:
                answer_zap_requests(self._sockets.zap, self._authenticate)
            self._read_connection_events()
            self._count_reasons(self._guard.tick(self._now_ns()))
            self._receive_requests()
            self._send_chunks()

    def _poll_timeout_ms(self) -> int:
        due_ns = self._scheduler.next_due_ns()
        if due_ns is None:
            return IDLE_MS
        now_ns = self._now_ns()
        if now_ns < self.late_until_ns:
            return YIELD_MS
        return min(IDLE_MS, max(0, -(-(due_ns - now_ns) // MILLISECOND)))

    def _apply_access(self) -> None:
        table = self._access
        if table is self._applied:
            return
        if table.folders != self._applied.folders:
            self._files.serve(table.folders)
        self._applied = table
        for descriptor in self._scheduler.set_listeners(table.clients):
            self._guard.evict(descriptor, "")

    def _authenticate(self, request: list[bytes]) -> str:
        mark = compute_fingerprint(request[6]) if is_curve_request(request) else ""
        if mark in self._applied.allowed_keys:
            return mark
        self.drops.count("assets_unknown_key")
        return ""

    def _read_connection_events(self) -> None:
        for event in self._guard.read_events(self._now_ns()):
            self._scheduler.remove_descriptor(event.descriptor)

    def _count_reasons(self, reasons: Iterable[str]) -> None:
        for reason in filter(None, reasons):
            self.drops.count(reason)

    # --- requests ---------------------------------------------------------------------------------------------------

    def _receive_requests(self) -> None:
        for _ in range(ROUND):
            if not readable(self._socket):
                return
            route = self._socket.recv(_DONTWAIT)
            self._apply_access()  # the request may be for a scene that was announced since
            frame = self._socket.recv(_DONTWAIT, copy=False)
            lengths = [len(frame)]
            more = frame.more
            while more:
                extra = self._socket.recv(_DONTWAIT, copy=False)
                lengths.append(len(extra))
                more = extra.more
            descriptor, user = read_peer(frame, encrypted=self._encrypted)
            if descriptor < 0:
                self.drops.count("assets_unversioned_peer")
                continue
            self._read_connection_events()
            refused = self._handle_request(route, descriptor, user, frame, single=len(lengths) == 1)
            self._guard.establish(descriptor, user)
            self._count_reasons([self._guard.record_message(descriptor, lengths, int(refused))])

    def _handle_request(self, route: bytes, descriptor: int, user: str, frame: zmq.Frame, *, single: bool) -> bool:
        """Handle one message. Return whether it was refused in a way that counts against its connection."""
        now_ns = self._now_ns()
        request_id, address, is_gateway = 0, "", False
        self.requests += 1
        try:
            request = decode_asset_request(frame.buffer if single else b"")
        except ProtocolVersionError:
            reason: str = AssetRefusal.VERSION
        except ProtocolError:
            reason = AssetRefusal.MALFORMED
        else:
            request_id, address = request.request_id, request.address
            is_gateway = request.connection_epoch in self._applied.gateways
            reason = self._scheduler.request(route, descriptor, user, request, now_ns)
        if reason:
            self._queue_refusal(route, request_id, address, reason)
        return bool(reason) and not (is_gateway and reason in _OF_OTHERS)

    def _queue_refusal(self, route: bytes, request_id: int, address: str, reason: str) -> None:
        """Refuse a request, at once or after the reader's pending chunks."""
        self.drops.count(f"assets_{reason}")
        if not self._scheduler.has_pending(route):
            with contextlib.suppress(zmq.ZMQError):  # no room
                self._socket.send_multipart((route, _refusal(request_id, address, reason)), _DONTWAIT)
                return
        if not self._scheduler.queue_refusal(route, request_id, address, reason):
            self.drops.count("assets_refusal_unsent")

    # --- chunks ------------------------------------------------------------------------------------------------------

    def _send_chunks(self) -> None:
        late = self._now_ns() < self.late_until_ns
        for _ in range(1 if late else CHUNKS):
            reader = self._scheduler.next_reader(self._now_ns())
            if reader is None:
                return
            self._send_chunk(reader)

    def _send_chunk(self, reader: ChunkReader) -> None:
        pending = reader.queue[0]
        chunk = None if pending.refusal else self._files.chunk(pending.address, pending.offset, pending.length)
        try:
            if chunk is None:  # or the scene changed twice since the request
                reason = pending.refusal or AssetRefusal.UNKNOWN
                refusal = _refusal(pending.request_id, pending.address, reason)
                self._socket.send_multipart((reader.route, refusal), _DONTWAIT)
            else:
                head = AssetChunk(PROTOCOL_VERSION, pending.request_id, pending.address, pending.offset, pending.total)
                self._socket.send(reader.route, _MORE)
                self._socket.send(encode_asset_header(head), _MORE)
                self._socket.send(chunk, _DONTWAIT, copy=False)
        except zmq.Again:
            self._scheduler.defer(reader, self._now_ns())
            return
        except zmq.ZMQError:  # the connection has ended; its monitor will report that
            self._scheduler.remove(reader.route)
            return
        self._scheduler.confirm_sent(reader)
        if chunk is not None:
            self.sent_bytes += pending.length


def _refusal(request_id: int, address: str, reason: str) -> bytes:
    return encode_asset_header(AssetRefused(PROTOCOL_VERSION, request_id, address, reason, ADVICE[reason]))
