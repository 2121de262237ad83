"""TCP connections of the gateway: accepted within limits, with TLS, and closed when they do nothing.

aiohttp has no limit of connections, and none of the time in which a request must come. So connections are accepted
here, counted per address (of IPv6, per network), and given to aiohttp behind a protocol of our own (`WatchedProtocol`),
which notes their end. A connection is a stranger until a request of it has a ticket, or the session has welcomed its
browser. Only few of a browser are none.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import socket
import ssl
import time
from collections.abc import Callable, Sequence
from typing import Final

from iris_session.protocol.limits import Drops, KeyedBuckets, find_network
from iris_session.web.sockets import limit_unsent

#: Connections in all, and strangers among them in all and of one address; above it the oldest are evicted.
MAX_CONNECTIONS: Final = 512
MAX_STRANGERS: Final = 256
MAX_STRANGERS_PER_ADDRESS: Final = 128
#: Connections of one browser that are no strangers. It has two WebSockets, and 16 assets at once.
MAX_TRUSTED_PER_BROWSER: Final = 24
#: Of one address: handshakes of TLS, which cost a millisecond each, and requests. The page has some ten files.
HANDSHAKES_PER_S, HANDSHAKE_BURST = 20.0, 120
REQUESTS_PER_S, REQUEST_BURST = 200.0, 1000
MAX_ADDRESSES: Final = 1024
#: Time for the first byte, for the handshake of TLS, and for a request.
FIRST_BYTE_S: Final = 5.0
HANDSHAKE_S: Final = 8.0
IDLE_S: Final = 15.0
_SWEEP_S: Final = 1.0
_BACKLOG: Final = 256
#: Pause when the system gives no connection, for lack of descriptors for example.
_ACCEPT_PAUSE_S: Final = 0.1
_TLS_HANDSHAKE: Final = 0x16
_MAX_PLAIN_REQUEST: Final = 2048
_HOST_LINE: Final = re.compile(rb"\r\nhost:[ \t]*([A-Za-z0-9._:\[\]-]{1,260})[ \t]*\r\n", re.IGNORECASE)
_PATH: Final = re.compile(rb"[A-Z]{3,7} (/[A-Za-z0-9._~!$&'()*+,;=:@%/?-]{0,500}) HTTP/1\.")


class Connection:
    """One TCP connection.

    Attributes:
        address: Of its peer; of IPv6 its network.
        requests: Under way now.
        browser: Name of the browser that it belongs to, empty for a stranger.
    """

    __slots__ = ("address", "browser", "close", "idle_since", "requests")

    def __init__(self, address: str, now: float, close: Callable[[], None]) -> None:
        self.address = find_network(address)
        self.close = close
        self.idle_since = now
        self.requests = 0
        self.browser = ""


class ConnectionLimiter:
    """Table of connections, and which of them are evicted for others. Pure: times [s] are arguments."""

    def __init__(self, drops: Drops) -> None:
        self._drops = drops
        self._connections: dict[Connection, None] = {}  # the oldest first

    def __len__(self) -> int:
        return len(self._connections)

    def add(self, connection: Connection) -> list[Connection]:
        """Add a connection. Return those to close so that the limits hold, perhaps this one itself."""
        self._connections[connection] = None
        strangers: dict[str, list[Connection]] = {}  # by address
        idle: dict[str, list[Connection]] = {}  # those of browsers without a request, by browser
        for one in self._connections:
            if not one.browser:
                strangers.setdefault(one.address, []).append(one)
            elif not one.requests:
                idle.setdefault(one.browser, []).append(one)
        evicted: list[Connection] = []
        theirs = strangers[connection.address]
        if len(theirs) > MAX_STRANGERS_PER_ADDRESS:
            evicted.append(theirs[0])
            self._drops.count("web_connections_per_address")
        elif sum(map(len, strangers.values())) > MAX_STRANGERS:
            evicted.append(max(strangers.values(), key=len)[0])
            self._drops.count("web_connections")
        elif len(self._connections) > MAX_CONNECTIONS:
            evicted.append(max((*idle.values(), *strangers.values()), key=len)[0])
            self._drops.count("web_connections")
        return evicted

    def trust(self, connection: Connection, browser: str) -> None:
        """Note that a connection belongs to a browser. It stays a stranger when that has many others."""
        if connection.browser:
            return
        if sum(one.browser == browser for one in self._connections) < MAX_TRUSTED_PER_BROWSER:
            connection.browser = browser

    def remove(self, connection: Connection) -> None:
        """Remove a connection that is closed."""
        self._connections.pop(connection, None)

    def select_idle(self, now: float) -> list[Connection]:
        """Return the connections without a request for too long: they sent none, or only part of one."""
        idle = [one for one in self._connections if not one.requests and now - one.idle_since > IDLE_S]
        if idle:
            self._drops.count("web_idle", n=len(idle))
        return idle

    def list_all(self) -> list[Connection]:
        """Return all connections."""
        return list(self._connections)


class WatchedProtocol(asyncio.Protocol):
    """Protocol of one connection that passes everything on to that of aiohttp, and notes the end."""

    def __init__(
        self, inner: asyncio.Protocol, on_made: Callable[[asyncio.Transport], None], on_lost: Callable[[], None]
    ) -> None:
        self._inner = inner
        self._on_made = on_made
        self._on_lost = on_lost

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._on_made(transport)
        self._inner.connection_made(transport)

    def data_received(self, data: bytes) -> None:
        self._inner.data_received(data)

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
        self._limiter = ConnectionLimiter(drops)
        self._handshakes = KeyedBuckets(HANDSHAKES_PER_S, HANDSHAKE_BURST, MAX_ADDRESSES)
        self._requests = KeyedBuckets(REQUESTS_PER_S, REQUEST_BURST, MAX_ADDRESSES)
        self._by_peer: dict[tuple[str, int], Connection] = {}
        self._loop = asyncio.get_running_loop()
        self._tasks: set[asyncio.Task[None]] = set()

    def __len__(self) -> int:
        return len(self._limiter)

    def listen(self, sockets: Sequence[socket.socket]) -> None:
        """Start to accept connections on listening sockets."""
        for one in sockets:
            one.setblocking(False)
            self._start(self._accept(one))
        self._start(self._sweep())

    def find(self, peer: object) -> Connection | None:
        """Return the connection of a peer, as `peername` of its transport is."""
        return self._by_peer.get(peer[:2]) if isinstance(peer, tuple) else None

    def trust(self, connection: Connection, browser: str) -> None:
        """Note that a connection belongs to a browser, by the name of that."""
        self._limiter.trust(connection, browser)

    def allow_handshake(self, address: str) -> bool:
        """Return whether an address may make one more handshake of TLS now."""
        if self._handshakes.take(find_network(address), time.monotonic_ns()):
            return True
        self._drops.count("web_handshake_rate")
        return False

    def allow_request(self, connection: Connection) -> bool:
        """Return whether the address of a connection may make one more request now."""
        if self._requests.take(connection.address, time.monotonic_ns()):
            return True
        self._drops.count("web_request_rate")
        return False

    async def close(self) -> None:
        """Stop accepting, and close all connections."""
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for connection in self._limiter.list_all():
            connection.close()

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
            if self._tls is not None and not self.allow_handshake(str(peer[0])):
                sock.close()
                continue
            self._start(self._serve(sock, (str(peer[0]), int(peer[1]))))

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(_SWEEP_S)
            for connection in self._limiter.select_idle(self._loop.time()):
                connection.close()

    async def _serve(self, sock: socket.socket, peer: tuple[str, int]) -> None:
        """Make a connection of an accepted socket: count it, sniff TLS, shake hands."""
        task = asyncio.current_task()
        assert task is not None
        connection = Connection(peer[0], self._loop.time(), lambda: _cancel(task))
        self._by_peer[peer] = connection
        is_passed_on = False
        try:
            for evicted in self._limiter.add(connection):
                evicted.close()
            sock.setblocking(False)
            limit_unsent(sock)
            if self._tls is not None and not await self._begins_with_tls(sock):
                await self._redirect(sock)
                return

            def on_made(transport: asyncio.Transport) -> None:
                connection.close = transport.abort
                connection.idle_since = self._loop.time()

            protocol = WatchedProtocol(self._make_protocol(), on_made, lambda: self._remove(connection, peer))
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
                self._remove(connection, peer)
                with contextlib.suppress(OSError):
                    sock.close()

    def _remove(self, connection: Connection, peer: tuple[str, int]) -> None:
        self._limiter.remove(connection)
        if self._by_peer.get(peer) is connection:
            del self._by_peer[peer]

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


def _cancel(task: asyncio.Task[None]) -> None:
    task.cancel()


def open_listening_sockets(hosts: Sequence[str], port: int) -> list[socket.socket]:
    """Return listening sockets on one port of each address; port 0 takes any free one. Raises `OSError`."""
    sockets: list[socket.socket] = []
    try:
        for name in dict.fromkeys("127.0.0.1" if host == "localhost" else host for host in hosts):
            family = socket.AF_INET6 if ":" in name else socket.AF_INET
            sock = socket.socket(family, socket.SOCK_STREAM)
            sockets.append(sock)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            sock.bind((name, port))
            sock.listen(_BACKLOG)
            port = sock.getsockname()[1]
    except BaseException:
        for sock in sockets:
            sock.close()
        raise
    return sockets
