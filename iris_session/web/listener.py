"""TCP connections of the gateway: accepted within limits, with TLS, and closed when they do nothing.

aiohttp has no limit of connections, and none of the time in which a request must come. So connections are accepted
here, limited by `TcpGuard`, and given to aiohttp behind a protocol of our own (`WatchedProtocol`), which notes their
end. A connection counts for its network until a request of it has a ticket, or the session has welcomed its browser;
then it counts for that.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import socket
import ssl
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from iris_session.link.config import SECOND
from iris_session.link.sockets import open_listeners
from iris_session.link.tcp_guard import TcpBounds, TcpConnection, TcpGuard, TcpReasons
from iris_session.protocol.limits import Drops, KeyedBuckets, TokenBucket, find_network
from iris_session.web.frames import NETWORK_EXTRA_BURST, NETWORK_EXTRA_PER_S, FrameMeter
from iris_session.web.sockets import MeteredSocket, count_acknowledged, count_unacknowledged, limit_unsent
from iris_session.web.wire import CLOSE_LIMIT, make_close_frame

#: Connections of one browser that are established. It has two WebSockets, and 16 assets at once.
MAX_PER_BROWSER: Final = 24
#: Of one address: handshakes of TLS, which cost a millisecond each, and requests, those of a browser counted for
#: itself. The page has some ten files.
HANDSHAKES_PER_S, HANDSHAKE_BURST = 20.0, 120
REQUESTS_PER_S, REQUEST_BURST = 200.0, 1000
MAX_ADDRESSES: Final = 1024
#: Bytes from one connection: of an established one what its browser may send in messages (`HubLimits`) with their
#: frames, of another a request, a hello and pairing. All that a peer can send counts, whatever TLS and aiohttp do with
#: it: handshake messages and empty fragments of WebSockets for example never become a message.
ESTABLISHED_BYTES_PER_S, ESTABLISHED_BYTES_BURST = 5e6, 10_000_000
OTHER_BYTES_PER_S, OTHER_BYTES_BURST = 20e3, 200_000
#: The same of all connections of a network that are not established.
NETWORK_BYTES_PER_S, NETWORK_BYTES_BURST = 200e3, 2_000_000
#: Bytes of one owner that are none of its data: 29 of each record of TLS, of which a browser sends 1,500 a second, and
#: those of handshakes. A ClientHello after the handshake has 33, costs 8 us, and leaves 31 of an answer in memory; so
#: a connection that is not established has few of them in all.
OVERHEAD_PER_S, OVERHEAD_BURST, OTHER_OVERHEAD = 60e3, 200_000, 16_384
#: Of these bytes of one connection none count for its network: a request and a hello come through whatever others of
#: the network send.
FREE_BYTES, FREE_OVERHEAD = 16_384, 4096
#: Time for the first byte, for the handshake of TLS, and for a request.
FIRST_BYTE_S: Final = 5.0
HANDSHAKE_S: Final = 8.0
IDLE_S: Final = 15.0
#: A connection is established when a request of it has a ticket, or the session has welcomed its browser.
BOUNDS: Final = TcpBounds(
    unauthenticated=256,
    unauthenticated_per_owner=128,
    established=256,
    silence_ns=round(IDLE_S * SECOND),
    idle_ns=round(IDLE_S * SECOND),
    unread_bytes=0,
)
REASONS: Final = TcpReasons("web", "web_connections", "web_connections", "web_idle", "", "web_connections_per_address")
#: Longest time in which a peer acknowledges nothing of what waits for it, also after its request has ended: a
#: WebSocket that is being closed, small answers.
STALLED_S: Final = 10.0
_SWEEP_S: Final = 1.0
_BACKLOG: Final = 256
#: Pause when the system gives no connection, for lack of descriptors for example.
_ACCEPT_PAUSE_S: Final = 0.1
_TLS_HANDSHAKE: Final = 0x16
_FLOOD: Final = make_close_frame(CLOSE_LIMIT, "more frames than a client may send: send less")
#: Time for a peer that is cut to read why.
_FAREWELL_S: Final = 1.0
_MAX_PLAIN_REQUEST: Final = 2048
_HOST_LINE: Final = re.compile(rb"\r\nhost:[ \t]*([A-Za-z0-9._:\[\]-]{1,260})[ \t]*\r\n", re.IGNORECASE)
_PATH: Final = re.compile(rb"[A-Z]{3,7} (/[A-Za-z0-9._~!$&'()*+,;=:@%/?-]{0,500}) HTTP/1\.")


class WatchedProtocol(asyncio.Protocol):
    """Protocol of one connection that passes everything on to that of aiohttp, notes how much and the end, and cuts a
    WebSocket with too many frames."""

    def __init__(
        self,
        inner: asyncio.Protocol,
        on_made: Callable[[asyncio.Transport], None],
        on_lost: Callable[[], None],
        note_data: Callable[[int], None],
    ) -> None:
        self._inner = inner
        self._on_made = on_made
        self._on_lost = on_lost
        self._note_data = note_data
        self._transport: asyncio.Transport | None = None
        self._take_frames: Callable[[bytes], bool] | None = None
        self._is_cut = False

    def count_frames(self, take_frames: Callable[[bytes], bool]) -> None:
        """Let `take_frames` tell of what comes from now on, a WebSocket, whether it is within the limits of frames."""
        self._take_frames = take_frames

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._on_made(transport)
        self._inner.connection_made(transport)

    def data_received(self, data: bytes) -> None:
        if self._is_cut:
            return
        self._note_data(len(data))
        if self._take_frames is None or self._take_frames(data):
            self._inner.data_received(data)
            return
        self._is_cut = True
        if self._transport is not None:  # a peer that reads learns why
            self._transport.write(_FLOOD)
            self._transport.close()
            asyncio.get_running_loop().call_later(_FAREWELL_S, self._transport.abort)

    def eof_received(self) -> bool | None:
        return self._inner.eof_received()

    def pause_writing(self) -> None:
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        self._inner.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        try:
            self._inner.connection_lost(exc)
        finally:
            self._on_lost()


class ByteMeter:
    """Counts and limits the bytes of one connection. `network_bytes`, `overhead`: buckets by network and by owner."""

    def __init__(
        self, connection: TcpConnection, network_bytes: KeyedBuckets, overhead: KeyedBuckets, now_ns: int
    ) -> None:
        self._connection = connection
        self._network = find_network(connection.address[0])
        self._network_bytes = network_bytes
        self._overhead = overhead
        self._other = TokenBucket(OTHER_BYTES_PER_S, OTHER_BYTES_BURST, now_ns)
        self._established = TokenBucket(ESTABLISHED_BYTES_PER_S, ESTABLISHED_BYTES_BURST, now_ns)
        self._received = self._data = 0
        self._most_overhead = FREE_OVERHEAD  # bytes that were no data, when they were most

    def note_data(self, n_bytes: int) -> None:
        """Count bytes that have come out of TLS."""
        self._data += n_bytes

    def take(self, n_bytes: int, now_ns: int) -> bool:
        """Return whether bytes that have come in are within the limits. It is known of those before what was data."""
        overhead = self._received - self._data  # of a record that has not come whole, for a moment
        more = max(0, overhead - self._most_overhead)
        self._most_overhead += more
        free = max(0, FREE_BYTES - self._received)
        self._received += n_bytes
        if more and not self._overhead.take(self._connection.owner, now_ns, more):
            return False
        if self._connection.is_established:
            return self._established.take(now_ns, n_bytes)
        return (
            overhead <= OTHER_OVERHEAD
            and self._other.take(now_ns, n_bytes)
            and self._network_bytes.take(self._network, now_ns, max(0, n_bytes - free))
        )


class Listener:
    """Accepts connections on listening sockets and gives them to `make_protocol`.

    Args:
        make_protocol: Returns the protocol of HTTP for one connection.
        tls: Settings of TLS, `None` for plain HTTP.
        drops: Counters.
    """

    def __init__(self, make_protocol: Callable[[], asyncio.Protocol], tls: ssl.SSLContext | None, drops: Drops) -> None:
        self._make_protocol = make_protocol
        self._tls = tls
        self._drops = drops
        self._guard = TcpGuard(BOUNDS, REASONS, close=self._close_connection)
        self._closers: dict[TcpConnection, Callable[[], object]] = {}
        self._handshakes = KeyedBuckets(HANDSHAKES_PER_S, HANDSHAKE_BURST, MAX_ADDRESSES)
        self._requests = KeyedBuckets(REQUESTS_PER_S, REQUEST_BURST, MAX_ADDRESSES)
        self._bytes = KeyedBuckets(NETWORK_BYTES_PER_S, NETWORK_BYTES_BURST, MAX_ADDRESSES)
        self._overhead = KeyedBuckets(OVERHEAD_PER_S, OVERHEAD_BURST, MAX_ADDRESSES)
        self._extra_frames = KeyedBuckets(NETWORK_EXTRA_PER_S, NETWORK_EXTRA_BURST, MAX_ADDRESSES)
        self._progress: dict[TcpConnection, tuple[int, int]] = {}  # bytes acknowledged, and since when not more
        self._loop = asyncio.get_running_loop()
        self._tasks: set[asyncio.Task[None]] = set()

    def __len__(self) -> int:
        return len(self._guard)

    def listen(self, sockets: Sequence[socket.socket]) -> None:
        """Start to accept connections on listening sockets."""
        for one in sockets:
            one.setblocking(False)
            self._start(self._accept(one))
        self._start(self._sweep())

    def find(self, transport: asyncio.BaseTransport | None) -> TcpConnection | None:
        """Return the connection of a transport, `None` when it is closed."""
        sock = None if transport is None else transport.get_extra_info("socket")
        return None if sock is None else self._guard.find(sock.fileno())

    def establish(self, transport: asyncio.BaseTransport | None, browser: str) -> None:
        """Note that a connection belongs to a browser, by the name of that, unless it has many others."""
        connection = self.find(transport)
        if connection is None or connection.is_established:
            return
        if sum(one.owner == browser for one in self._guard.table.values()) < MAX_PER_BROWSER:
            connection.is_established, connection.owner = True, browser

    def count_frames(self, transport: asyncio.BaseTransport | None) -> bool:
        """Count and limit the frames of a connection that becomes a WebSocket. False: it is none of ours."""
        connection, protocol = self.find(transport), transport.get_protocol() if transport is not None else None
        if connection is None or not isinstance(protocol, WatchedProtocol):
            return False
        network = find_network(connection.address[0])

        def take_extra(now_ns: int) -> bool:
            return connection.is_established or self._extra_frames.take(network, now_ns)

        meter = FrameMeter(take_extra, time.monotonic_ns())

        def take_frames(data: bytes) -> bool:
            if meter.feed(data, time.monotonic_ns()):
                return True
            self._drops.count("web_flood")
            return False

        protocol.count_frames(take_frames)
        return True

    def allow_handshake(self, address: str) -> bool:
        """Return whether an address may make one more handshake of TLS now."""
        if self._handshakes.take(find_network(address), time.monotonic_ns()):
            return True
        self._drops.count("web_handshake_rate")
        return False

    def allow_request(self, owner: str) -> bool:
        """Return whether the owner of a connection, a network or a browser, may make one more request now."""
        if self._requests.take(owner, time.monotonic_ns()):
            return True
        self._drops.count("web_request_rate")
        return False

    async def close(self) -> None:
        """Stop accepting, and close all connections."""
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for close in list(self._closers.values()):
            close()

    def _start(self, work: object) -> None:
        task: asyncio.Task[None] = self._loop.create_task(work)  # type: ignore[arg-type]
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _accept(self, listening: socket.socket) -> None:
        while True:
            try:
                sock, peer = await self._loop.sock_accept(listening)
            except OSError:
                self._drops.count("web_accept")
                await asyncio.sleep(_ACCEPT_PAUSE_S)
                continue
            await asyncio.sleep(0)  # `sock_accept` does not wait while connections do
            if self._tls is not None and not self.allow_handshake(str(peer[0])):
                sock.close()
                continue
            self._start(self._serve(MeteredSocket(sock)))

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(_SWEEP_S)
            self._count(self._guard.tick(time.monotonic_ns()))
            self._evict_stalled(time.monotonic_ns())

    def _evict_stalled(self, now_ns: int) -> None:
        """Close connections whose peers have acknowledged nothing for `STALLED_S` although something waits."""
        before, self._progress = self._progress, {}
        for descriptor, connection in list(self._guard.table.items()):
            if count_unacknowledged(descriptor):
                acknowledged = count_acknowledged(descriptor)
                last, since_ns = before.get(connection, (-1, now_ns))
                self._progress[connection] = acknowledged, since_ns if acknowledged == last else now_ns
                if now_ns - self._progress[connection][1] > STALLED_S * SECOND:
                    self._count([self._guard.evict(descriptor, "web_too_slow")])

    def _count(self, reasons: Iterable[str]) -> None:
        for reason in reasons:
            self._drops.count(reason)

    def _close_connection(self, descriptor: int, peer: tuple[str, int], *, discard: bool = False) -> bool:
        connection = self._guard.find(descriptor)
        if connection is not None:
            self._closers.pop(connection)()
        return True

    async def _serve(self, sock: MeteredSocket) -> None:
        """Make a connection of an accepted socket: count it, sniff TLS, shake hands."""
        task = asyncio.current_task()
        assert task is not None
        descriptor = sock.fileno()
        connection = self._guard.add(descriptor, time.monotonic_ns())
        meter = ByteMeter(connection, self._bytes, self._overhead, time.monotonic_ns())

        def take(n_bytes: int) -> bool:
            if meter.take(n_bytes, time.monotonic_ns()):
                return True
            self._drops.count("web_flood")
            return False

        sock.take = take
        self._closers[connection] = task.cancel
        is_passed_on = False
        try:
            self._count(self._guard.evict_excess())
            sock.setblocking(False)
            limit_unsent(sock)
            if self._tls is not None and not await self._begins_with_tls(sock):
                await self._redirect(sock)
                return

            def on_made(transport: asyncio.Transport) -> None:
                self._closers[connection] = transport.abort
                connection.quiet_ns = time.monotonic_ns()

            protocol = WatchedProtocol(
                self._make_protocol(),
                on_made,
                lambda: self._remove(descriptor, connection),
                meter.note_data,
            )
            is_passed_on = True
            try:
                await self._loop.connect_accepted_socket(
                    lambda: protocol, sock, ssl=self._tls, ssl_handshake_timeout=HANDSHAKE_S if self._tls else None
                )
            except BaseException:
                is_passed_on = False
                raise
        except (OSError, TimeoutError):  # of TLS too: not TLS, or none that we speak
            self._drops.count("web_handshake")
        finally:
            if not is_passed_on:
                self._remove(descriptor, connection)
                with contextlib.suppress(OSError):
                    sock.close()

    def _remove(self, descriptor: int, connection: TcpConnection) -> None:
        self._closers.pop(connection, None)
        if self._guard.find(descriptor) is connection:  # else it was evicted
            self._guard.remove(descriptor)

    async def _begins_with_tls(self, sock: socket.socket) -> bool:
        """Return whether the first byte begins a handshake of TLS. Raises `TimeoutError` when none comes."""
        async with asyncio.timeout(FIRST_BYTE_S):
            while True:
                try:
                    first = sock.recv(1, socket.MSG_PEEK)
                except BlockingIOError:
                    await self._wait_readable(sock)
                    continue
                if not first:
                    raise ConnectionResetError
                return first[0] == _TLS_HANDSHAKE

    async def _wait_readable(self, sock: socket.socket) -> None:
        ready = asyncio.Event()
        descriptor = sock.fileno()
        self._loop.add_reader(descriptor, ready.set)
        try:
            await ready.wait()
        finally:
            self._loop.remove_reader(descriptor)

    async def _redirect(self, sock: socket.socket) -> None:
        """Answer plain HTTP with the address of HTTPS: people type addresses without it."""
        self._drops.count("web_plain")
        async with asyncio.timeout(FIRST_BYTE_S):
            request = b""
            while b"\r\n\r\n" not in request and len(request) < _MAX_PLAIN_REQUEST:
                more = await self._loop.sock_recv(sock, _MAX_PLAIN_REQUEST)
                if not more:
                    return
                request += more
            host, path = _HOST_LINE.search(request), _PATH.match(request)
            if host is not None and path is not None:
                place = b"https://" + host[1] + path[1]
                answer = b"HTTP/1.1 307 Temporary Redirect\r\nLocation: " + place + b"\r\n"
            else:
                answer = b"HTTP/1.1 400 Bad Request\r\n"
            await self._loop.sock_sendall(sock, answer + b"Content-Length: 0\r\nConnection: close\r\n\r\n")


def open_listening_sockets(hosts: Sequence[str], port: int) -> list[socket.socket]:
    """Return listening sockets on one port of each address; port 0 takes any free one. Raises `OSError`."""
    addresses = dict.fromkeys("127.0.0.1" if host == "localhost" else host for host in hosts)
    return open_listeners(tuple(addresses), port, _BACKLOG, only_v6=True)
