"""Limits of TCP connections: silent ones, those of one browser, rates of one network."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from iris_session.link.config import SECOND
from iris_session.link.tcp_guard import TcpConnection, TcpGuard
from iris_session.protocol.limits import Drops, KeyedBuckets
from iris_session.security import KeyHome
from iris_session.web import listener
from iris_session.web.certificate import load_or_make_certificate, make_tls_context
from iris_session.web.hub import Hub
from iris_session.web.listener import (
    BOUNDS,
    MAX_PER_BROWSER,
    REASONS,
    ByteMeter,
    Listener,
    WatchedProtocol,
    open_listening_sockets,
)
from iris_session.web.origin import HostCheck
from iris_session.web.page import PageFiles
from iris_session.web.server import WebServer
from iris_session.web.sockets import READ_BYTES, MeteredSocket
from iris_session.web.wire import CLOSE_LIMIT, SUBPROTOCOL


def test_one_address_has_few_silent_connections_and_no_one_an_idle_one() -> None:
    """Which of them are evicted is tested with the guard itself."""
    guard = TcpGuard(BOUNDS, REASONS, close=lambda *_, **__: True)
    for descriptor in range(100_000, 100_000 + BOUNDS.unauthenticated_per_owner + 3):
        guard.add(descriptor, SECOND, ("10.0.0.1", descriptor % 65_536))
    assert guard.evict_excess() == ["web_connections_per_address"] * 3
    busy, known, *others = guard.table
    guard.table[busy].requests = 1
    guard.establish(known, "web-1")
    assert guard.tick(BOUNDS.silence_ns + SECOND) == []
    assert guard.tick(BOUNDS.silence_ns + 2 * SECOND) == ["web_idle"] * (1 + len(others))
    assert list(guard.table) == [busy]


class FakeTransport:
    """A transport of a connected socket."""

    def __init__(self, sock: socket.socket) -> None:
        self._socket = sock

    def get_extra_info(self, _name: str) -> socket.socket:
        return self._socket


def test_one_browser_has_few_connections_and_networks_have_rates() -> None:
    pairs = [socket.socketpair() for _ in range(MAX_PER_BROWSER + 1)]

    async def use_up() -> None:
        serving = Listener(asyncio.Protocol, None, Drops())
        for ours, _ in pairs:
            transport: Any = FakeTransport(ours)
            serving._guard.add(ours.fileno(), SECOND, ("10.0.0.1", 1))
            serving.establish(transport, "web-1")
        table = serving._guard.table.values()
        assert [one.is_established for one in table] == [True] * MAX_PER_BROWSER + [False]
        handshakes = [serving.allow_handshake(f"2001:db8::{n:x}") for n in range(2 * listener.HANDSHAKE_BURST)]
        assert handshakes.count(False) > listener.HANDSHAKE_BURST // 2
        assert serving.allow_handshake("2001:db8:0:1::1")
        requests = [serving.allow_request("10.0.0.1") for _ in range(2 * listener.REQUEST_BURST)]
        assert requests.count(False) > listener.REQUEST_BURST // 2
        assert serving.allow_request("web-1")

    asyncio.run(use_up())
    for pair in pairs:
        for one in pair:
            one.close()


class MeterRig:
    """Meters of connections that share the buckets of networks and owners."""

    def __init__(self) -> None:
        self.networks = KeyedBuckets(listener.NETWORK_BYTES_PER_S, listener.NETWORK_BYTES_BURST, 16)
        self.overhead = KeyedBuckets(listener.OVERHEAD_PER_S, listener.OVERHEAD_BURST, 16)

    def open(self, address: str, browser: str = "") -> ByteMeter:
        connection = TcpConnection((address, 1), SECOND)
        if browser:
            connection.is_established, connection.owner = True, browser
        return ByteMeter(connection, self.networks, self.overhead, SECOND)


def send(meter: ByteMeter, n_records: int, n_bytes: int, n_data: int, now_ns: int = SECOND) -> int:
    """Return how many of so many records are taken, each with `n_data` of its bytes for HTTP."""
    for n in range(n_records):
        if not meter.take(n_bytes, now_ns):
            return n
        meter.note_data(n_data)
    return n_records


def test_bytes_are_limited_before_anything_reads_them() -> None:
    """Empty fragments of WebSockets, for example, never become a message."""
    rig = MeterRig()
    assert send(rig.open("a"), 300, 1000, 1000) == listener.OTHER_BYTES_BURST // 1000
    assert send(rig.open("a", "web-1"), 20_000, 1000, 1000) == listener.ESTABLISHED_BYTES_BURST // 1000
    n_taken = [send(rig.open("b"), 1, 100_000, 100_000) for _ in range(60)]
    assert 10 < sum(n_taken) < 40, "of one network together"
    assert send(rig.open("b"), 8, 1000, 1000) == 8, "the first ones do not count for the network"


def test_records_that_are_no_data_are_limited() -> None:
    """Those after a ClientHello in TLS 1.2, or KeyUpdate in TLS 1.3, of which HTTP never hears."""
    rig = MeterRig()
    n_hellos = send(rig.open("a"), 10_000, 33, 0)
    assert 33 * n_hellos < 20_000
    browser = rig.open("a", "web-1")
    assert 33 * send(browser, 100_000, 33, 0) < 210_000
    assert send(rig.open("a", "web-1"), 300, 33, 0) < 300, "of one browser together"
    neighbour = rig.open("a", "web-2")
    for second in range(1, 60):
        assert send(neighbour, 1500, 29 + 40, 40, second * SECOND) == 1500, "what a browser may send"
    upload = rig.open("a", "web-3")
    assert all(send(upload, 1, 16_384, 0) and send(upload, 1, 45, 16_384 + 16) for _ in range(500)), "records in parts"


def test_a_socket_reports_what_it_receives_and_ends() -> None:
    async def receive() -> tuple[list[int], Exception | None]:
        ours, theirs = socket.socketpair()
        metered, lost = MeteredSocket(ours), asyncio.get_running_loop().create_future()
        metered.setblocking(False)
        sizes: list[int] = []
        metered.take = lambda n_bytes: sizes.append(n_bytes) is None and sum(sizes) <= 3 * READ_BYTES
        protocol = Mock(spec=asyncio.Protocol)
        protocol.connection_lost.side_effect = lost.set_result
        await asyncio.get_running_loop().connect_accepted_socket(lambda: protocol, metered)
        theirs.sendall(bytes(3 * READ_BYTES + 1))
        reason = await lost
        theirs.close()
        return sizes, reason

    sizes, reason = asyncio.run(receive())
    assert sizes == [READ_BYTES] * 3 + [1]
    assert isinstance(reason, ConnectionAbortedError)


def test_bytes_of_tls_that_are_no_data_cut_a_connection(tmp_path: Path) -> None:
    """Records with one byte each have the most besides that the client of Python can send."""
    made = load_or_make_certificate(KeyHome(tmp_path), [])

    async def flood() -> dict[str, int]:
        protocol = Mock(spec=asyncio.Protocol)
        tls = make_tls_context(made.certificate_path, made.key_path)
        serving = Listener(lambda: protocol, tls, drops := Drops())
        sockets = open_listening_sockets(["127.0.0.1"], 0)
        serving.listen(sockets)
        trusting = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        trusting.check_hostname, trusting.verify_mode = False, ssl.CERT_NONE
        reader, writer = await asyncio.open_connection("127.0.0.1", sockets[0].getsockname()[1], ssl=trusting)
        with contextlib.suppress(ConnectionError):
            while not reader.at_eof():
                writer.write(b"x")
                await writer.drain()
                await asyncio.sleep(0)
        writer.close()
        n_data = sum(len(one.args[0]) for one in protocol.data_received.mock_calls)
        assert 100 < n_data < 2 * listener.OTHER_OVERHEAD // 29
        for one in sockets:
            one.close()
        await serving.close()
        return drops.by_reason

    assert asyncio.run(flood()) == {"web_flood": 1}


def test_a_websocket_with_too_many_frames_is_told_and_cut() -> None:
    async def feed() -> None:
        transport, inner = Mock(spec=asyncio.Transport), Mock(spec=asyncio.Protocol)
        protocol = WatchedProtocol(inner, lambda _: None, lambda: None, lambda _: None)
        protocol.connection_made(transport)
        protocol.count_frames(lambda data: data != b"bad")
        for data in (b"good", b"bad", b"good"):
            protocol.data_received(data)
        inner.data_received.assert_called_once_with(b"good")
        (farewell,) = transport.write.call_args.args
        assert farewell[0] == 0x88
        assert int.from_bytes(farewell[2:4], "big") == CLOSE_LIMIT
        assert transport.close.called

    asyncio.run(feed())


@pytest.mark.parametrize("path", ["/v1/session", "/v1/media"])
@pytest.mark.parametrize("frame", [b"\x89\x80\0\0\0\0", b"\x8a\x80\0\0\0\0", b"\x02\x80\0\0\0\0"])
def test_frames_that_are_no_message_end_their_websocket(path: str, frame: bytes) -> None:
    """Through aiohttp: pings, pongs and empty fragments."""

    async def send(data_at_once: bytes, data: bytes) -> tuple[bytes, dict[str, int]]:
        class Session:
            async def wait_ready(self) -> bool:
                await asyncio.Event().wait()
                return False

        unused: Any = None
        session: Any = Session()
        hub = Hub()
        serving = WebServer(hub, session, unused, HostCheck((), secure=False), PageFiles())
        listening = Listener(await serving.start(), None, hub.drops)
        serving.attach(listening)
        sockets = open_listening_sockets(["127.0.0.1"], 0)
        listening.listen(sockets)
        port = sockets[0].getsockname()[1]
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(
            f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
            f"Sec-WebSocket-Protocol: {SUBPROTOCOL}\r\n\r\n".encode()
            + data_at_once
        )
        answer = await reader.readuntil(b"\r\n\r\n")
        writer.write(data)
        answer += await reader.read()
        writer.close()
        for one in sockets:
            one.close()
        await listening.close()
        await serving.close()
        return answer, hub.drops.by_reason

    answer, drops = asyncio.run(send(b"", frame * 1000))
    assert answer.startswith(b"HTTP/1.1 101")
    assert CLOSE_LIMIT.to_bytes(2, "big") in answer
    assert drops == {"web_flood": 1}
    answer, _ = asyncio.run(send(frame, b""))
    assert answer.startswith(b"HTTP/1.1 400")


def test_a_peer_that_acknowledges_nothing_is_cut() -> None:
    """Whatever it is sent, and also while its connection is being closed."""

    class Writing(asyncio.Protocol):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            assert isinstance(transport, asyncio.Transport)
            transport.write(bytes(8 << 20))
            transport.close()

    async def serve() -> dict[str, int]:
        serving = Listener(Writing, None, drops := Drops())
        sockets = open_listening_sockets(["127.0.0.1"], 0)
        serving.listen(sockets)
        peer = socket.create_connection(sockets[0].getsockname())
        now_ns = 0
        while not len(serving):
            await asyncio.sleep(0)
        while len(serving):  # what the system has room for is acknowledged
            now_ns += round((listener.STALLED_S + 1) * SECOND)
            serving._evict_stalled(now_ns)
            await asyncio.sleep(0)
        peer.close()
        for one in sockets:
            one.close()
        await serving.close()
        return drops.by_reason

    assert asyncio.run(serve()) == {"web_too_slow": 1}


@pytest.mark.parametrize("is_allowed", [True, False])
def test_others_have_their_turn_between_connections_that_wait(
    monkeypatch: pytest.MonkeyPatch, *, is_allowed: bool
) -> None:
    async def count_turns() -> int:
        served, turns = 0, 0

        class Counting(Listener):
            async def _serve(self, sock: socket.socket) -> None:
                nonlocal served
                served += 1
                sock.close()

            def allow_handshake(self, address: str) -> bool:
                nonlocal served
                served += not is_allowed
                return is_allowed

        (listening,) = open_listening_sockets(["127.0.0.1"], 0)
        waiting = [socket.create_connection(listening.getsockname()) for _ in range(50)]
        serving = Counting(asyncio.Protocol, ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), Drops())
        serving.listen([listening])
        while served < len(waiting):
            turns += 1
            await asyncio.sleep(0)
        await serving.close()
        for one in (listening, *waiting):
            one.close()
        return turns

    assert asyncio.run(count_turns()) >= 50


def test_frames_of_a_connection_that_is_not_ours_are_not_counted() -> None:
    async def count() -> bool:
        return Listener(asyncio.Protocol, None, Drops()).count_frames(None)

    assert not asyncio.run(count())
