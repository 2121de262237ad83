"""WebSockets and HTTP of the gateway: messages in pieces, tickets, pings, slow readers, foreign pages."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import random
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from aiohttp import ClientError, ClientSession, TCPConnector, WSMessage, WSMsgType, WSServerHandshakeError, web

from iris_session.web import server, wire
from iris_session.web.assets import ByteRate
from iris_session.web.hub import Hub
from iris_session.web.origin import HostCheck
from iris_session.web.page import PageFiles
from iris_session.web.server import ASSET_PIECE, MEDIA_PIECE, SocketWriter, WebServer, receive_message


@pytest.mark.parametrize("length", [1, 125, 126, MEDIA_PIECE - 1, MEDIA_PIECE, MEDIA_PIECE + 1, 40 * MEDIA_PIECE + 200])
def test_message_in_pieces_comes_whole(length: int) -> None:
    message = random.Random(length).randbytes(length)
    assert asyncio.run(send_beside_another(message))[0] == message


def test_others_send_between_the_pieces_of_a_message() -> None:
    message, turns = asyncio.run(send_beside_another(bytes(64 * MEDIA_PIECE)))
    assert len(message) == 64 * MEDIA_PIECE
    assert turns >= 64


@pytest.mark.parametrize(("first", "code"), [(None, 1013), (wire.encode_gateway_message(wire.Ticket("x")), 4003)])
def test_late_ticket_is_no_wrong_one(monkeypatch: pytest.MonkeyPatch, first: bytes | None, code: int) -> None:
    monkeypatch.setattr(server, "TICKET_S", 0.05 if first is None else 60.0)
    hub = Hub()

    async def open_media() -> object:
        async with serve(hub) as (page, _), ClientSession() as session, open_socket(session, page) as media:
            if first is not None:
                await media.send_bytes(first)
            message = await media.receive()
            assert message.type == WSMsgType.CLOSE
            return message.data

    assert asyncio.run(open_media()) == code
    assert hub.drops.by_reason == {"web_ticket": 1}


def test_pings_are_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "TICKET_S", 600.0)

    async def ping() -> list[bytes]:
        async with serve(Hub()) as (page, _), ClientSession() as session:
            media = await session.ws_connect(f"{page}v1/media", protocols=[wire.SUBPROTOCOL], autoping=False)
            for n in range(10):
                await media.ping(bytes([n]))
            pongs = [await media.receive() for _ in range(10)]
            await media.close()
        assert {pong.type for pong in pongs} == {WSMsgType.PONG}
        return [pong.data for pong in pongs]

    assert asyncio.run(ping()) == [bytes([n]) for n in range(10)]


def test_others_have_their_turn_between_messages_that_have_come() -> None:
    class Ready:
        async def receive(self) -> WSMessage:
            return WSMessage(WSMsgType.BINARY, b"", None)

    async def count_turns() -> int:
        turns = 0

        async def take_turns() -> None:
            nonlocal turns
            while True:
                turns += 1
                await asyncio.sleep(0)

        other = asyncio.create_task(take_turns())
        ready: Any = Ready()
        for _ in range(100):
            await receive_message(ready)
        other.cancel()
        return turns

    assert asyncio.run(count_turns()) >= 99


def test_a_page_that_is_not_read_is_not_kept_in_memory(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_bytes(bytes(64 << 20))

    async def read_nothing() -> tuple[int, int]:
        async with serve(Hub(), folder=tmp_path) as (page, serving):
            host, port = page.removeprefix("http://").rstrip("/").split(":")
            sock = socket.create_connection((host, int(port)))
            sock.sendall(f"GET / HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode())
            assert serving._runner.server is not None
            waiting, turns = 0, 1000
            while turns:
                for one in serving._runner.server.connections:
                    waiting = max(waiting, one.transport.get_write_buffer_size())
                turns -= waiting > 0
                await asyncio.sleep(0)
            sock.close()
            while len(asyncio.all_tasks()) > 1:  # those of the request
                await asyncio.sleep(0)
            return waiting, sum(type(one) is web.StreamResponse for one in gc.get_objects())

    gc.collect()
    gc.disable()  # what is sent to many that leave must not wait for a collection
    try:
        waiting, n_kept = asyncio.run(read_nothing())
    finally:
        gc.enable()
    assert 0 < waiting <= ASSET_PIECE
    assert n_kept == 0


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ("Origin: {page}\r\n", 200),
        ("Origin: {page}\r\nOrigin: https://evil.example\r\n", 403),
        ("Origin: https://evil.example\r\nOrigin: {page}\r\n", 403),
    ],
)
def test_one_origin_is_named(headers: str, status: int) -> None:
    async def request() -> bytes:
        async with serve(Hub()) as (page, _):
            host, port = page.removeprefix("http://").rstrip("/").split(":")
            reader, writer = await asyncio.open_connection(host, int(port))
            origins = headers.format(page=page.rstrip("/"))
            writer.write(f"GET / HTTP/1.1\r\nHost: {host}:{port}\r\n{origins}Connection: close\r\n\r\n".encode())
            answer = await reader.readline()
            writer.close()
            return answer

    assert asyncio.run(request()).split()[1] == str(status).encode()


def test_a_download_ends_with_the_admission(monkeypatch: pytest.MonkeyPatch) -> None:
    hub, address, total = Hub(), "ab" * 32, 256 << 20

    class Assets:
        async def find(self, _address: str) -> memoryview:
            return memoryview(bytes(total))

    async def download() -> int:
        headers = open_with_ticket(hub, 0, b"ann")
        (browser,) = hub
        assets: Any = Assets()
        async with (
            serve(hub, assets) as (page, _),
            ClientSession() as session,
            session.get(f"{page}v1/asset/{address}", headers=headers) as response,
        ):
            n = len(await response.content.readany())
            browser.epoch = 0  # revoked: the WebSocket may still be open
            with contextlib.suppress(ClientError):
                while more := await response.content.readany():
                    n += len(more)
        return n

    assert 0 < asyncio.run(download()) < total


def open_with_ticket(hub: Hub, n: int, identity: bytes) -> dict[str, str]:
    """Open a browser that the session has welcomed. Return the header of its requests for assets."""
    browser = hub.open_browser(n.to_bytes(6, "big"), "127.0.0.1", time.monotonic_ns())
    assert browser is not None
    browser.epoch, browser.identity = 5, identity
    hub.issue_ticket(browser, bytes((n,)) * 32, time.monotonic_ns())
    return {"X-Iris-Ticket": browser.ticket.decode()}


def test_one_identity_cannot_have_all_assets_at_once() -> None:
    hub = Hub()

    class Assets:
        def __init__(self) -> None:
            self.waiting = 0
            self.may_answer = asyncio.Event()

        async def find(self, _address: str) -> memoryview:
            self.waiting += 1
            await self.may_answer.wait()
            return memoryview(b"")

    async def request() -> list[tuple[int, str]]:
        first, second, other = (open_with_ticket(hub, n, b"ann" if n < 2 else b"bob") for n in range(3))
        assets = Assets()
        connector = TCPConnector(limit=0)
        async with serve(hub, assets) as (page, _), ClientSession(connector=connector) as session:

            async def get(headers: dict[str, str]) -> tuple[int, str]:
                async with session.get(f"{page}v1/asset/{'ab' * 32}", headers=headers) as response:
                    return response.status, response.headers.get("Retry-After", "")

            tasks = [asyncio.create_task(get((first, second)[n % 2])) for n in range(server.ASSETS_PER_IDENTITY)]
            while assets.waiting < len(tasks):
                await asyncio.sleep(0)
            tasks += [asyncio.create_task(get(headers)) for headers in (second, other)]
            while assets.waiting + tasks[-2].done() < len(tasks):
                await asyncio.sleep(0)
            assets.may_answer.set()
            return [await task for task in (*tasks[-2:], asyncio.create_task(get(second)))]

    assert asyncio.run(request()) == [(429, "1"), (200, ""), (200, "")]


def test_too_many_requests_are_answered() -> None:
    class Listening:
        def find(self, _transport: object) -> Mock:
            return Mock(owner="10.0.0.1", requests=0)

        def allow_request(self, owner: str) -> bool:
            return owner != "10.0.0.1"

    async def request() -> tuple[int, str, str]:
        async with serve(Hub()) as (page, serving), ClientSession() as session:
            listening: Any = Listening()
            serving.attach(listening)
            async with session.get(page) as response:
                return response.status, response.headers["Retry-After"], response.headers["Connection"]

    assert asyncio.run(request()) == (429, "1", "close")


@pytest.mark.parametrize(
    ("request_line", "more", "status"),
    [
        ("GET /", "Content-Encoding: deflate\r\nContent-Length: 9\r\n\r\nx", 400),
        ("GET /", "Transfer-Encoding: chunked\r\n\r\n", 400),
        ("GET /", "Content-Length: 0\r\n\r\n", 200),
        (f"HEAD /v1/asset/{'ab' * 32}", "\r\n", 404),
        ("HEAD /v1/session", "\r\n", 404),
        ("HEAD /", "\r\n", 200),
        ("POST /v1/info", "Content-Length: 0\r\n\r\n", 405),
        ("GET /v1/nothing", "\r\n", 404),
    ],
)
def test_requests_with_a_body_and_heads_of_no_page(request_line: str, more: str, status: int) -> None:
    async def request() -> tuple[bytes, bytes]:
        async with serve(Hub()) as (page, serving):
            host, port = page.removeprefix("http://").rstrip("/").split(":")
            reader, writer = await asyncio.open_connection(host, int(port))
            writer.write(f"{request_line} HTTP/1.1\r\nHost: {host}:{port}\r\n{more}".encode())
            head = await reader.readuntil(b"\r\n\r\n")
            assert serving._runner._kwargs["auto_decompress"] is False
            writer.close()
            return head.split()[1], head.lower()

    got, head = asyncio.run(request())
    assert got == str(status).encode()
    assert (b"connection: close" in head) == (status == 400)


def test_a_websocket_whose_frames_are_not_counted_is_refused() -> None:
    class Listening:
        def find(self, _transport: object) -> None:
            return None

        def count_frames(self, _transport: object) -> bool:
            return False

    async def connect() -> int:
        async with serve(Hub()) as (page, serving), ClientSession() as session:
            listening: Any = Listening()
            serving.attach(listening)
            with pytest.raises(WSServerHandshakeError) as error:
                await open_socket(session, page)
            return error.value.status

    assert asyncio.run(connect()) == 500


def test_media_waits_for_a_reader() -> None:
    transport = Mock(spec=asyncio.Transport)
    transport.get_extra_info.return_value = None
    transport.is_closing.return_value = False
    transport.get_write_buffer_size.side_effect = lambda: sum(len(one.args[0]) for one in transport.write.mock_calls)

    async def write() -> None:
        request, media = Mock(transport=transport), Mock(closed=False)
        writing = asyncio.create_task(SocketWriter(media, request).send_pieces(bytes(64 * MEDIA_PIECE)))
        for _ in range(100):
            await asyncio.sleep(0)
        writing.cancel()

    asyncio.run(write())
    assert transport.write.call_count <= 2


@contextlib.asynccontextmanager
async def serve(hub: Hub, assets: Any = None, *, folder: Path | None = None) -> AsyncIterator[tuple[str, WebServer]]:
    """Serve without a session. Yields the address of the page."""
    unused: Any = None
    page = PageFiles() if folder is None else PageFiles(folder)
    serving = WebServer(hub, unused, assets, HostCheck((), secure=False), page)
    listening = await asyncio.get_running_loop().create_server(await serving.start(), "127.0.0.1", 0)
    try:
        yield f"http://127.0.0.1:{listening.sockets[0].getsockname()[1]}/", serving
    finally:
        listening.close()
        await serving.close()


def open_socket(session: ClientSession, page: str) -> Any:
    return session.ws_connect(f"{page}v1/media", protocols=[wire.SUBPROTOCOL])


def test_senders_of_assets_share_a_rate_and_do_not_pay_for_silence() -> None:
    rate = ByteRate(1024.0)
    assert [rate.reserve(128, 5.0) for _ in range(3)] == [0.0, 0.125, 0.25]
    assert rate.reserve(128, 60.0) == 0.0


async def send_beside_another(message: bytes) -> tuple[bytes, int]:
    """Return what the browser gets, and how often another task had its turn meanwhile. Pings come in between."""

    async def act(writer: SocketWriter) -> int:
        turns = 0

        async def take_turns() -> None:
            nonlocal turns
            while True:
                turns += 1
                if turns % 8 == 0:
                    await writer.socket.ping()
                await asyncio.sleep(0)

        other = asyncio.create_task(take_turns())
        await asyncio.sleep(0)
        assert await writer.send_pieces(message)
        other.cancel()
        return turns

    got, turns = await serve_one(act)
    assert got is not None
    return got, turns


async def serve_one(act: Callable[[SocketWriter], Awaitable[int]]) -> tuple[bytes | None, int]:
    """Let `act` use the writer of a WebSocket. Return what its browser gets first, and what `act` returns."""
    acted: asyncio.Future[int] = asyncio.get_running_loop().create_future()

    async def handle(request: web.Request) -> web.StreamResponse:
        socket = web.WebSocketResponse(compress=False)
        await socket.prepare(request)
        acted.set_result(await act(SocketWriter(socket, request)))
        await socket.receive()
        return socket

    application = web.Application()
    application.router.add_get("/", handle)
    runner = web.AppRunner(application)
    await runner.setup()
    site = web.TCPSite(runner, "127.0.0.1", 0)
    await site.start()
    address = f"http://127.0.0.1:{runner.addresses[0][1]}/"
    try:
        async with ClientSession() as session, session.ws_connect(address, max_msg_size=0) as browser:
            message = await browser.receive()
            got = message.data if isinstance(message.data, bytes) else None
        return got, await acted
    finally:
        await runner.cleanup()
