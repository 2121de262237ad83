"""HTTP and WebSockets of the gateway, by aiohttp. Nothing that a browser sends raises out of here.

A WebSocket has two tasks: one reads, one writes what waits for it. State and media are written only while little of
the connection is unacknowledged, so a slow reader gets the newest values and nothing queues; one that acknowledges
nothing for seconds is closed.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import secrets
import time
from collections.abc import Awaitable, Callable
from typing import Final

from aiohttp import WSCloseCode, WSMessage, WSMsgType, web

from iris_session.protocol.assets import is_address
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.limits import Drops, TokenBucket
from iris_session.web.assets import TOO_MANY, UNKNOWN, AssetUnavailableError, ByteRate, GatewayAssets
from iris_session.web.hub import NAME_BYTES, Browser, Closing, Hub
from iris_session.web.listener import Listener
from iris_session.web.origin import HostCheck, make_security_headers
from iris_session.web.page import PageFiles
from iris_session.web.session_link import MediaFeedSocket, SessionLink
from iris_session.web.sockets import count_acknowledged, count_unacknowledged
from iris_session.web.wire import (
    CLOSE_LIMIT,
    CLOSE_NOT_ALLOWED,
    CLOSE_RESTART,
    CLOSE_TOO_SLOW,
    CLOSE_TRY_AGAIN,
    GATEWAY,
    MAX_CLIENT_MESSAGE,
    MEDIA,
    MEDIA_WISHES,
    SUBPROTOCOL,
    Ticket,
    decode_frames,
    decode_gateway_message,
    decode_subscriptions,
    encode_frames,
    make_fragment,
)

log = logging.getLogger(__name__)

#: Unacknowledged bytes up to which the next state is sent: 60 Hz over 100 ms, of a scene of 300 bodies.
STATE_WINDOW: Final = 32_768
#: The same for media, whose frames are larger.
MEDIA_WINDOW: Final = 65_536
#: Bytes of a message of media that are written at a time, in between state is sent: encrypting 8 MiB takes 30 ms.
MEDIA_PIECE: Final = 65_536
#: Longest time without an acknowledged byte while some wait: a client that is frozen for 3 s comes back.
SLOW_S: Final = 6.0
#: Period in which a writer looks again when nothing wakes it.
_LOOK_S: Final = 0.05
#: The first of pauses that double, until the system has taken what was written: 64 KiB in it are 65 MB/s.
_SHORT_S: Final = 0.001
_CHECK_S: Final = 0.5
_CLOSE_S: Final = 1.0
_SMALL_MESSAGE: Final = 32_768
TICKET_S: Final = 5.0
#: Requests for assets at once: of one identity, and of all.
ASSETS_PER_IDENTITY: Final = 16
ASSETS_IN_ALL: Final = 128
#: Bytes of an asset that are written at a time, in between state is sent.
ASSET_PIECE: Final = 65_536
#: Bytes of assets per second, to all together: more than a headset takes over Wi-Fi, and encrypting them leaves most of
#: the loop to the state of others.
ASSET_BYTES_PER_S: Final = 48e6
#: Messages a second on a media socket: subscriptions and tickets, nothing else.
_SUBSCRIPTIONS_PER_S, _SUBSCRIPTIONS_BURST = 5.0, 20
_RANGE: Final = re.compile(r"bytes=(\d{0,15})-(\d{0,15})")
_TICKET_HEADER: Final = "X-Iris-Ticket"
_COME_AGAIN: Final = {"Retry-After": "1"}
_MAX_REASON: Final = 120
_FAULT_LOG_S: Final = 10.0

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Acknowledgements:
    """Tells whether the peer of a transport acknowledges anything of what waits for it."""

    def __init__(self, transport: asyncio.Transport) -> None:
        self._transport = transport
        sock = transport.get_extra_info("socket")
        self._descriptor = -1 if sock is None else sock.fileno()
        self._acknowledged = 0
        self._progress_at = asyncio.get_running_loop().time()
        self._checked_at = 0.0
        self._slow = False

    def count_waiting(self) -> int:
        """Return the bytes that the peer has not acknowledged."""
        return self._transport.get_write_buffer_size() + count_unacknowledged(self._descriptor)

    def is_slow(self) -> bool:
        """Return whether bytes wait, and the peer has acknowledged none for `SLOW_S`."""
        now = asyncio.get_running_loop().time()
        if now - self._checked_at < _CHECK_S / 2:
            return self._slow
        self._checked_at = now
        acknowledged = count_acknowledged(self._descriptor)
        if acknowledged != self._acknowledged or not self.count_waiting():
            self._acknowledged, self._progress_at = acknowledged, now
        self._slow = now - self._progress_at > SLOW_S
        return self._slow

    async def wait_for(self, writing: Awaitable[None]) -> bool:
        """Return whether something is written before the peer is too slow. What writes is cancelled otherwise."""
        task = asyncio.ensure_future(writing)
        try:
            while not task.done():
                if self.is_slow():
                    return False
                await asyncio.wait((task,), timeout=_CHECK_S)
            task.result()
        finally:
            task.cancel()
        return True

    async def hand_over(self, writing: Awaitable[None]) -> bool:
        """Return whether something is written, and taken by the system, before the peer is too slow or has gone.

        asyncio would keep 0.2 MB for a peer that reads nothing, with TLS 0.6 MB, and the heap most of that afterwards.
        Writing on to one that has gone would raise, and keep what is written until a collection of garbage.
        """
        if not await self.wait_for(writing):
            return False
        pause_s = _SHORT_S
        while self._transport.get_write_buffer_size():
            if self._transport.is_closing() or self.is_slow():
                return False
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, _LOOK_S)
        return not self._transport.is_closing()


async def receive_message(socket: web.WebSocketResponse) -> WSMessage:
    """Return the next message of a WebSocket that is no ping or pong, after others had their turn.

    `web.frames` limits how many of those come.
    """
    while True:
        message = await socket.receive()
        await asyncio.sleep(0)  # `receive` does not wait for what has come already
        if message.type == WSMsgType.PING:
            with contextlib.suppress(ConnectionError, RuntimeError):  # closed meanwhile
                await socket.pong(message.data)
        elif message.type != WSMsgType.PONG:
            return message


class SocketWriter:
    """Writes one WebSocket: knows whether there is room, and whether its client reads at all.

    Attributes:
        socket: The WebSocket.
        frame: Frame of media to write next.
    """

    def __init__(self, socket: web.WebSocketResponse, request: web.Request) -> None:
        transport = request.transport
        assert transport is not None
        self.socket = socket
        self.frame: bytes | None = None
        self._transport = transport
        self._acknowledgements = Acknowledgements(transport)
        self.is_slow = self._acknowledgements.is_slow
        self._wake = asyncio.Event()
        transport.set_write_buffer_limits(high=MEDIA_WINDOW)

    def wake(self) -> None:
        """Let `wait` return."""
        self._wake.set()

    def offer(self, frames: list[bytes]) -> None:
        """Set the frame of media to write next."""
        self.frame = encode_frames(MEDIA, frames)
        self.wake()

    async def wait(self) -> None:
        """Wait for `wake`, or a moment."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_CHECK_S):
                await self._wake.wait()
        self._wake.clear()

    def has_room(self, window: int) -> bool:
        """Return whether less than `window` bytes wait for the client."""
        return not self._transport.get_write_buffer_size() and self._acknowledgements.count_waiting() < window

    async def send(self, message: bytes) -> bool:
        """Send a message. False: the client has read nothing for `SLOW_S`, or has closed."""
        try:
            if len(message) < _SMALL_MESSAGE and not self._transport.get_write_buffer_size():
                await self.socket.send_bytes(message)  # does not wait: there is room
                return True
            return await self._acknowledgements.wait_for(self.socket.send_bytes(message))
        except (ConnectionError, RuntimeError):  # closed meanwhile
            return False

    async def send_pieces(self, message: bytes) -> bool:
        """Send a large message, and let others send between its pieces. False: the client reads nothing, or has closed.

        No other message may be sent meanwhile; what aiohttp sends by itself may come between.
        """
        for begin in range(0, len(message), MEDIA_PIECE):
            if self.socket.closed or self._transport.is_closing():
                return False
            self._transport.write(make_fragment(message, begin, min(begin + MEDIA_PIECE, len(message))))
            await asyncio.sleep(0)
            while self._transport.get_write_buffer_size() > MEDIA_WINDOW and not self._transport.is_closing():
                if self.is_slow():
                    return False
                await asyncio.sleep(_LOOK_S / 10)
        return True

    async def close(self, closing: Closing) -> None:
        """Close the WebSocket with a code and a reason; a client that does not answer is cut off."""
        reason = closing.reason.encode()[:_MAX_REASON].decode(errors="ignore").encode()
        with contextlib.suppress(Exception):
            async with asyncio.timeout(_CLOSE_S):
                await self.socket.close(code=closing.code, message=reason)
        if closing.code == CLOSE_TOO_SLOW:
            self._transport.abort()
        else:
            self._transport.close()


class WebServer:
    """The web application of one gateway.

    Args:
        hub: Browsers.
        session: Sockets to the session.
        assets: Assets of the session.
        hosts: Check of `Host` and `Origin`.
        page: Files of the page.
    """

    def __init__(
        self, hub: Hub, session: SessionLink, assets: GatewayAssets, hosts: HostCheck, page: PageFiles
    ) -> None:
        self._hub = hub
        self._drops: Drops = hub.drops
        self._session = session
        self._assets = assets
        self._hosts = hosts
        self._page = page
        self._listener: Listener | None = None
        self._media: dict[str, SocketWriter] = {}
        self._loads: dict[bytes, int] = {}  # requests for assets under way, by identity
        self._asset_rate = ByteRate(ASSET_BYTES_PER_S)
        self._fault_logged = 0.0
        application = web.Application(middlewares=[self._guard], client_max_size=4096)
        application.router.add_get("/v1/info", self._info)
        application.router.add_get("/v1/session", self._serve_session, allow_head=False)
        application.router.add_get("/v1/media", self._serve_media, allow_head=False)
        application.router.add_get("/v1/asset/{address}", self._serve_asset, allow_head=False)
        application.router.add_get("/{path:.*}", self._serve_page)
        quiet = logging.getLogger(f"{__name__}.http")
        quiet.setLevel(logging.CRITICAL)  # aiohttp logs every malformed request with a traceback
        self._runner = web.AppRunner(
            application,
            handle_signals=False,
            access_log=None,
            logger=quiet,
            keepalive_timeout=10.0,
            lingering_time=1.0,
            auto_decompress=False,  # of bodies, which are refused, but read for `lingering_time`
            shutdown_timeout=_CLOSE_S,
            max_line_size=2048,
            max_field_size=4096,
        )

    async def start(self) -> Callable[[], asyncio.Protocol]:
        """Return a function that makes the protocol of one connection."""
        await self._runner.setup()
        server = self._runner.server
        assert server is not None
        return server

    def attach(self, listener: Listener) -> None:
        """Set the listener, whose connections are marked as trusted and busy."""
        self._listener = listener

    async def close(self) -> None:
        """End all requests, those that are being answered within `_CLOSE_S`."""
        await self._runner.cleanup()

    # --- every request ------------------------------------------------------------------------------------------------

    def _establish(self, request: web.Request, browser: Browser) -> None:
        if self._listener is not None:
            self._listener.establish(request.transport, browser.name)

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Check where a request comes from, and turn every error into an answer."""
        connection = None if self._listener is None else self._listener.find(request.transport)
        if connection is not None:
            if self._listener is not None and not self._listener.allow_request(connection.owner):
                response = web.Response(status=TOO_MANY, text="too many requests\n", headers=_COME_AGAIN)
                response.headers.update(make_security_headers(""))
                response.force_close()
                return response
            connection.requests += 1
        try:
            return await self._answer(request, handler)
        finally:
            if connection is not None:
                connection.requests -= 1
                connection.quiet_ns = time.monotonic_ns()

    async def _answer(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        hosts = request.headers.getall("Host", [])
        host = self._hosts.find_host(hosts[0]) if len(hosts) == 1 else ""
        try:
            if request.body_exists:
                self._drops.count("web_body")
                response: web.StreamResponse = web.Response(status=400, text="no request here has a body\n")
                response.force_close()
            elif not host:
                self._drops.count("web_host")
                text = "this name is not one of the session's machine: use its address"
                response = web.Response(status=421, text=f"{text}\n")
            elif not self._is_from_own_page(request, host):
                self._drops.count("web_origin")
                response = web.Response(status=403, text="pages of other sites may not use this session\n")
            else:
                response = await handler(request)
        except web.HTTPException as error:
            response = web.Response(status=error.status, text=f"{error.reason}\n", headers=_pick_headers(error))
        except (ConnectionError, asyncio.CancelledError):
            raise
        except Exception as error:  # a fault of ours must not end the connection of anyone else
            self._log_fault(error)
            response = web.Response(status=500, text="the gateway has a fault: see its log\n")
        if not response.prepared:
            response.headers.update(make_security_headers(host))
        if isinstance(response, web.Response) and isinstance(response.body, bytes) and request.method == "GET":
            return await self._write_body(request, response, response.body)
        return response

    async def _write_body(self, request: web.Request, response: web.Response, body: bytes) -> web.StreamResponse:
        """Write a body in pieces, while its request counts as under way. aiohttp would write it afterwards and at once:
        a peer that reads nothing would have all of it in our memory.
        """
        transport = request.transport
        if len(body) <= ASSET_PIECE or transport is None:
            return response
        streamed = web.StreamResponse(status=response.status, headers=response.headers)
        streamed.content_length = len(body)
        await streamed.prepare(request)
        acknowledgements = Acknowledgements(transport)
        for at in range(0, len(body), ASSET_PIECE):
            if not await acknowledgements.hand_over(streamed.write(body[at : at + ASSET_PIECE])):
                if acknowledgements.is_slow():
                    self._drops.count("web_too_slow")
                transport.abort()
                return streamed
        await streamed.write_eof()
        return streamed

    def _is_from_own_page(self, request: web.Request, host: str) -> bool:
        origins = request.headers.getall("Origin", [])
        if len(origins) > 1 or not self._hosts.is_own_origin(next(iter(origins), None), host):
            return False
        # A link to the page from elsewhere is a navigation, and fine; scripts of other sites are not.
        site = request.headers.get("Sec-Fetch-Site", "none")
        return site in ("same-origin", "none") or not request.path.startswith("/v1/")

    def _log_fault(self, error: Exception) -> None:
        self._drops.count("web_fault")
        now = time.monotonic()
        if now - self._fault_logged > _FAULT_LOG_S:
            self._fault_logged = now
            log.error("fault while serving a request, which was answered with 500: %r", error, exc_info=error)

    async def _info(self, _request: web.Request) -> web.StreamResponse:
        return web.json_response(self._session.describe(), headers={"Cache-Control": "no-store"})

    async def _serve_page(self, request: web.Request) -> web.StreamResponse:
        found = self._page.find(request.path)
        if found is None:
            raise web.HTTPNotFound
        headers = {
            "Content-Type": found.content_type,
            "ETag": found.tag,
            "Cache-Control": "public, immutable, max-age=31536000" if found.immutable else "no-cache",
        }
        if request.headers.get("If-None-Match") == found.tag:
            return web.Response(status=304, headers=headers)
        return web.Response(body=found.data, headers=headers)

    # --- assets -------------------------------------------------------------------------------------------------------

    async def _serve_asset(self, request: web.Request) -> web.StreamResponse:
        address = request.match_info["address"]
        browser = self._hub.find_ticket(request.headers.get(_TICKET_HEADER, ""), time.monotonic_ns())
        if browser is None:
            raise web.HTTPUnauthorized(reason="no valid ticket")
        if not is_address(address):
            raise web.HTTPNotFound
        identity = browser.identity
        n = self._loads.get(identity, 0)
        if n >= ASSETS_PER_IDENTITY or sum(self._loads.values()) >= ASSETS_IN_ALL:
            self._drops.count("web_assets_at_once")
            raise web.HTTPTooManyRequests(reason="too many assets at once", headers=_COME_AGAIN)
        self._establish(request, browser)
        self._loads[identity] = n + 1
        try:
            return await self._send_asset(request, address, browser)
        finally:
            left = self._loads.pop(identity, 1) - 1
            if left > 0:
                self._loads[identity] = left

    async def _send_asset(self, request: web.Request, address: str, browser: Browser) -> web.StreamResponse:
        try:
            view = await self._assets.find(address)
        except AssetUnavailableError as error:
            if error.status == UNKNOWN:
                self._hub.note_unknown_asset(browser, time.monotonic_ns())
            headers = _COME_AGAIN if error.status in (TOO_MANY, 503) else {}
            return web.Response(status=error.status, text=f"{error}\n", headers=headers)
        total = len(view)
        part = _parse_range(request.headers.get("Range", ""), total)
        if part is None:
            return web.Response(status=416, headers={"Content-Range": f"bytes */{total}"})
        begin, end, is_part = part
        response = web.StreamResponse(status=206 if is_part else 200)
        response.content_type = "application/octet-stream"
        response.content_length = end - begin
        response.headers["Cache-Control"] = "private, immutable, max-age=31536000"
        response.headers["Accept-Ranges"] = "bytes"
        response.headers["ETag"] = f'"{address}"'
        if is_part:
            response.headers["Content-Range"] = f"bytes {begin}-{end - 1}/{total}"
        response.headers.update(make_security_headers(self._hosts.find_host(request.headers.get("Host"))))
        await response.prepare(request)
        transport = request.transport
        if transport is None:
            raise ConnectionResetError
        acknowledgements = Acknowledgements(transport)
        loop = asyncio.get_running_loop()
        for at in range(begin, end, ASSET_PIECE):
            await asyncio.sleep(self._asset_rate.reserve(min(ASSET_PIECE, end - at), time.monotonic()))
            # Read by a thread: a file that is not in memory must not stop the loop.
            piece = await loop.run_in_executor(None, bytes, view[at : min(at + ASSET_PIECE, end)])
            is_read = await acknowledgements.hand_over(response.write(piece))
            if not is_read and acknowledgements.is_slow():
                self._drops.count("web_asset_slow")
            if not is_read or not browser.is_admitted:  # revoked, or its WebSocket is closed
                transport.abort()
                return response
        await response.write_eof()
        return response

    # --- WebSockets ---------------------------------------------------------------------------------------------------

    async def _open_socket(self, request: web.Request) -> web.WebSocketResponse:
        """Return the WebSocket of a request. Raises `HTTPBadRequest` for a handshake that is not ours."""
        offered = request.headers.get("Sec-WebSocket-Protocol", "")
        if SUBPROTOCOL not in (one.strip() for one in offered.split(",")):
            self._drops.count("web_subprotocol")
            raise web.HTTPBadRequest(reason=f"expected a WebSocket with subprotocol {SUBPROTOCOL}")
        socket = web.WebSocketResponse(
            protocols=(SUBPROTOCOL,),
            max_msg_size=MAX_CLIENT_MESSAGE + 1,  # aiohttp takes less than that
            compress=False,
            timeout=_CLOSE_S,
            heartbeat=30.0,
            autoping=False,  # it would answer what has come without a pause
        )
        if not socket.can_prepare(request).ok:
            raise web.HTTPBadRequest(reason=f"expected a WebSocket with subprotocol {SUBPROTOCOL}")
        if request.protocol._message_tail:  # no frame was counted that came before the answer
            raise web.HTTPBadRequest(reason="a client waits for the answer to its handshake")
        if self._listener is not None and not self._listener.count_frames(request.transport):
            raise web.HTTPInternalServerError
        await socket.prepare(request)
        return socket

    async def _serve_session(self, request: web.Request) -> web.StreamResponse:
        socket = await self._open_socket(request)
        writer = SocketWriter(socket, request)
        if not await self._session.wait_ready():
            await writer.close(Closing(CLOSE_RESTART, "the gateway has no session yet: come again"))
            return socket
        browser = self._hub.open_browser(secrets.token_bytes(NAME_BYTES), request.remote or "", time.monotonic_ns())
        if browser is None:
            await writer.close(Closing(CLOSE_LIMIT, "too many clients at this gateway"))
            return socket
        browser.wake = writer.wake
        self._session.watch_state()
        writing = asyncio.create_task(self._write_session(browser, writer, request))
        try:
            await self._read_session(browser, socket)
        finally:
            await self._end_session(browser, writer, writing)
        return socket

    async def _read_session(self, browser: Browser, socket: web.WebSocketResponse) -> None:
        while browser.closing is None:
            message = await receive_message(socket)
            if message.type == WSMsgType.BINARY:
                envelope = self._hub.receive(browser, message.data, time.monotonic_ns())
                if envelope is not None:
                    self._send_to_session(browser, envelope)
            elif message.type == WSMsgType.TEXT:
                self._drops.count("web_malformed")
                browser.close(CLOSE_NOT_ALLOWED, "messages are binary")
            else:
                self._count_end(message.type, socket)
                return

    def _send_to_session(self, browser: Browser, envelope: bytes) -> None:
        excess = self._session.send(browser, envelope)
        if excess is not None:
            self._drops.count("web_session_full")
            excess.close(CLOSE_LIMIT, "the session does not read: come again")

    def _count_end(self, kind: WSMsgType, socket: web.WebSocketResponse) -> None:
        if socket.close_code == WSCloseCode.MESSAGE_TOO_BIG:
            self._drops.count("web_too_large")
        elif kind == WSMsgType.ERROR or socket.close_code == WSCloseCode.PROTOCOL_ERROR:
            self._drops.count("web_malformed")

    async def _write_session(self, browser: Browser, writer: SocketWriter, request: web.Request) -> None:
        """Write control messages in order, and in between the newest state while there is room."""
        hub = self._hub
        while browser.closing is None:
            await writer.wait()
            if browser.is_admitted:
                self._establish(request, browser)
            while browser.closing is None:
                message = hub.take_message(browser)
                if message is None and browser.latest and writer.has_room(STATE_WINDOW):
                    message = hub.take_latest(browser)
                if message is None:
                    break
                if not await writer.send(message):
                    break
            if writer.is_slow():
                self._drops.count("web_too_slow")
                browser.close(CLOSE_TOO_SLOW, "this client reads nothing")
        if browser.closing is not None:
            await writer.close(browser.closing)

    async def _end_session(self, browser: Browser, writer: SocketWriter, writing: asyncio.Task[None]) -> None:
        notification = self._hub.close_browser(browser)
        if notification is not None:
            self._send_to_session(browser, notification)
        media = self._media.pop(browser.name, None)
        writer.wake()
        with contextlib.suppress(asyncio.CancelledError, Exception):
            async with asyncio.timeout(2 * _CLOSE_S):
                await writing
        if media is not None:
            await media.close(Closing(CLOSE_NOT_ALLOWED, "the session's socket is closed"))

    # --- media --------------------------------------------------------------------------------------------------------

    async def _serve_media(self, request: web.Request) -> web.StreamResponse:
        socket = await self._open_socket(request)
        writer = SocketWriter(socket, request)
        try:
            browser = await self._receive_ticket(socket)
        except TimeoutError:
            self._drops.count("web_ticket")
            await writer.close(Closing(CLOSE_TRY_AGAIN, "no ticket has come in time: come again"))
            return socket
        if browser is None:
            await writer.close(Closing(CLOSE_NOT_ALLOWED, "the first message must be a valid ticket"))
            return socket
        if not self._hub.allow_media(browser, time.monotonic_ns()):
            await writer.close(Closing(CLOSE_LIMIT, "too many media sockets: come again later"))
            return socket
        self._establish(request, browser)
        before, self._media[browser.name] = self._media.get(browser.name), writer
        if before is not None:
            await before.close(Closing(CLOSE_LIMIT, "another media socket of this participant was opened"))
        feed = self._session.open_media(browser, writer.offer)
        writing = asyncio.create_task(self._write_media(browser, writer, feed))
        try:
            await self._read_media(browser, socket, feed, writer)
        finally:
            feed.close()
            writing.cancel()
            if self._media.get(browser.name) is writer:
                del self._media[browser.name]
            await writer.close(Closing(CLOSE_NOT_ALLOWED, "closed"))
        return socket

    async def _receive_ticket(self, socket: web.WebSocketResponse) -> Browser | None:
        """Return the browser whose ticket comes first, `None` for one that is not valid. Raises `TimeoutError`."""
        async with asyncio.timeout(TICKET_S):
            message = await receive_message(socket)
        try:
            if message.type != WSMsgType.BINARY:
                return None
            channel, frames = decode_frames(message.data)
            ticket = decode_gateway_message(frames[0])
        except ProtocolError:
            self._drops.count("web_ticket")
            return None
        if channel != GATEWAY or not isinstance(ticket, Ticket):
            self._drops.count("web_ticket")
            return None
        return self._hub.find_ticket(ticket.ticket, time.monotonic_ns())

    async def _read_media(
        self, browser: Browser, socket: web.WebSocketResponse, feed: MediaFeedSocket, writer: SocketWriter
    ) -> None:
        rate = TokenBucket(_SUBSCRIPTIONS_PER_S, _SUBSCRIPTIONS_BURST, time.monotonic_ns())
        while browser.is_admitted:
            message = await receive_message(socket)
            if message.type != WSMsgType.BINARY:
                self._count_end(message.type, socket)
                return
            if not rate.take(time.monotonic_ns()):
                self._drops.count("web_flood")
                await writer.close(Closing(CLOSE_LIMIT, "more messages than a client may send: send less"))
                return
            try:
                channel, frames = decode_frames(message.data)
                if channel == GATEWAY:  # a fresh ticket: it is the same participant
                    continue
                feed.set_subscriptions(
                    decode_subscriptions(frames[0] if channel == MEDIA_WISHES and len(frames) == 1 else b"")
                )
            except ProtocolError as error:
                self._drops.count("web_malformed")
                await writer.close(Closing(CLOSE_NOT_ALLOWED, str(error)))
                return

    async def _write_media(self, browser: Browser, writer: SocketWriter, feed: MediaFeedSocket) -> None:
        """Write frames one at a time; the next one is read from the session when there is room for it."""
        while browser.is_admitted:
            await writer.wait()
            if writer.frame is not None:
                message, writer.frame = writer.frame, None
                if not await writer.send_pieces(message):
                    break
                while not writer.has_room(MEDIA_WINDOW) and not writer.is_slow():
                    await asyncio.sleep(_LOOK_S / 5)
                feed.resume()
            if writer.is_slow():
                break
        if browser.is_admitted:
            self._drops.count("web_too_slow")
            await writer.close(Closing(CLOSE_TOO_SLOW, "this client reads nothing"))
        else:
            await writer.close(Closing(CLOSE_NOT_ALLOWED, "the session has no connection for this participant now"))


def _pick_headers(error: web.HTTPException) -> dict[str, str]:
    return {name: error.headers[name] for name in ("Allow", "Retry-After") if name in error.headers}


def _parse_range(text: str, total: int) -> tuple[int, int, bool] | None:
    """Return begin and end of a request of an asset, and whether it is a part; `None` for a range outside of it.

    What is not one range of bytes is ignored, as RFC 9110 lets a server do.
    """
    match = _RANGE.fullmatch(text.strip())
    if match is None or not (match[1] or match[2]):
        return 0, total, False
    if not match[1]:
        begin, end = max(0, total - int(match[2])), total
    else:
        begin, end = int(match[1]), min(total, int(match[2]) + 1) if match[2] else total
    return (begin, end, True) if begin < end else None
