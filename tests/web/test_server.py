"""WebSockets of the gateway: large messages, whole for the browser and in pieces for the loop; late tickets."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from aiohttp import ClientSession, WSMsgType, web

from iris_session.web import server, wire
from iris_session.web.assets import ByteRate
from iris_session.web.hub import Hub
from iris_session.web.origin import HostCheck
from iris_session.web.page import PageFiles
from iris_session.web.server import MEDIA_PIECE, SocketWriter, WebServer


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
    unused: Any = None
    hub = Hub()

    async def open_media() -> object:
        serving = WebServer(hub, unused, unused, HostCheck((), secure=False), PageFiles())
        listening = await asyncio.get_running_loop().create_server(await serving.start(), "127.0.0.1", 0)
        page = f"http://127.0.0.1:{listening.sockets[0].getsockname()[1]}/"
        try:
            async with (
                ClientSession() as session,
                session.ws_connect(f"{page}v1/media", protocols=[wire.SUBPROTOCOL]) as media,
            ):
                if first is not None:
                    await media.send_bytes(first)
                message = await media.receive(30.0)
                assert message.type == WSMsgType.CLOSE
                return message.data
        finally:
            listening.close()
            await serving.close()

    assert asyncio.run(open_media()) == code
    assert hub.drops.by_reason == {"web_ticket": 1}


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
