"""A browser for tests: aiohttp in place of one, and no logic but heartbeats."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import AsyncIterator, Callable
from typing import TypeVar

import aiohttp

from iris_session.protocol.client_messages import ClientMessage, GetSnapshot, Heartbeat, Hello, wrap_message
from iris_session.protocol.codec import decode_server, decode_state_header, encode_client
from iris_session.protocol.common import Message
from iris_session.protocol.server_messages import Snapshot, StateHeader, Welcome
from iris_session.web import wire

T = TypeVar("T", bound=Message)
DEADLINE_S = 60.0
HEARTBEAT_S = 0.2


class WebBrowser:
    """One browser at a gateway. `secret` is its identity; `states` are pairs of header and time of arrival."""

    def __init__(self, http: aiohttp.ClientSession, page: str, name: str = "tab", secret: bytes = b"") -> None:
        self.http = http
        self.page = page
        self.name = name
        self.secret = secret or os.urandom(32)
        self.inbox: list[Message] = []
        self.bulk: list[bytes] = []
        self.states: list[tuple[StateHeader, int]] = []
        self.ticket = ""
        self.welcome: Welcome | None = None
        self._socket: aiohttp.ClientWebSocketResponse | None = None
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def epoch(self) -> int:
        return 0 if self.welcome is None else self.welcome.connection_epoch

    @property
    def socket(self) -> aiohttp.ClientWebSocketResponse:
        assert self._socket is not None
        return self._socket

    @property
    def close_code(self) -> int | None:
        """Code with which the gateway has closed the WebSocket, `None` while it is open."""
        return self.socket.close_code

    async def open(self) -> WebBrowser:
        """Open the WebSocket for control and start to read it."""
        self._socket = await self.http.ws_connect(
            f"{self.page}v1/session", protocols=[wire.SUBPROTOCOL], max_msg_size=0
        )
        self.welcome = None
        self._tasks += [asyncio.create_task(self._read()), asyncio.create_task(self._beat())]
        return self

    async def join(self, role: str = "observer", **hello: object) -> WebBrowser:
        """Open, say hello and wait for the welcome and the ticket."""
        await self.open()
        await self.say_hello(role, **hello)
        await self.wait(lambda: self.ticket, "a ticket")
        return self

    async def say_hello(self, role: str = "observer", **hello: object) -> Welcome:
        before = len(self.got(Welcome))
        fields: dict[str, object] = {"alignment": "not_needed", "devices": ("desktop",), **hello}
        await self.send(Hello(role, self.name, secret=self.secret, **fields), 0)  # type: ignore[arg-type]
        return await self.wait_for(Welcome, before + 1)

    async def come_back(self, role: str = "observer") -> Welcome:
        """Join again with the resume token of the last welcome, as often as it takes."""
        assert self.welcome is not None
        token, until = self.welcome.resume_token, time.monotonic() + DEADLINE_S
        while True:
            await self.close()
            try:
                await self.open()
                return await asyncio.wait_for(self.say_hello(role, resume_token=token), 10.0)
            except (aiohttp.ClientError, TimeoutError, AssertionError, ConnectionError):
                assert time.monotonic() < until, f"{self.name} does not come back"
                await asyncio.sleep(0.1)

    async def send(self, message: ClientMessage, epoch: int | None = None) -> None:
        data = encode_client(wrap_message(message, self.epoch if epoch is None else epoch))
        await self.socket.send_bytes(wire.encode_frames(wire.CONTROL, [data]))

    async def snapshot(self) -> Snapshot:
        before = len(self.got(Snapshot))
        await self.send(GetSnapshot())
        return await self.wait_for(Snapshot, before + 1)

    def got(self, kind: type[T]) -> list[T]:
        return [message for message in self.inbox if isinstance(message, kind)]

    async def wait(self, condition: Callable[[], object], what: str, timeout_s: float = DEADLINE_S) -> None:
        until = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < until, f"{self.name}: not {what}; {self.inbox[-3:]}, closed {self.close_code}"
            await asyncio.sleep(0.005)

    async def wait_for(self, kind: type[T], n: int = 1) -> T:
        await self.wait(lambda: len(self.got(kind)) >= n, f"{n} {kind.__name__}")
        return self.got(kind)[n - 1]

    async def fetch(self, address: str, ticket: str | None = None, **headers: str) -> tuple[int, bytes, dict[str, str]]:
        """Return status, body and headers of a request for an asset."""
        sent = {"X-Iris-Ticket": self.ticket if ticket is None else ticket, **headers}
        async with self.http.get(f"{self.page}v1/asset/{address}", headers=sent) as answer:
            return answer.status, await answer.read(), dict(answer.headers)

    async def _read(self) -> None:
        socket = self.socket
        async for message in socket:
            assert message.type == aiohttp.WSMsgType.BINARY
            now_ns = time.monotonic_ns()
            channel, frames = wire.decode_frames(message.data)
            if channel == wire.CONTROL:
                answer = decode_server(frames[0]).message
                self.inbox.append(answer)
                self.bulk += [bytes(frame) for frame in frames[1:]]
                if isinstance(answer, Welcome):
                    self.welcome = answer
            elif channel == wire.STATE and bytes(frames[0]) == b"rigid":
                self.states.append((decode_state_header(frames[1]), now_ns))
            elif channel == wire.GATEWAY:
                told = wire.decode_gateway_message(frames[0])
                if isinstance(told, wire.Ticket):
                    self.ticket = told.ticket

    async def _beat(self) -> None:
        socket = self.socket
        with contextlib.suppress(ConnectionError):
            while not socket.closed:
                if self.epoch:
                    await self.send(Heartbeat())
                await asyncio.sleep(HEARTBEAT_S)

    async def close(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._tasks.clear()
        if self._socket is not None and not self._socket.closed:
            await self._socket.close()


@contextlib.asynccontextmanager
async def open_http() -> AsyncIterator[aiohttp.ClientSession]:
    """A client that takes the gateway's certificate as it is, with any number of connections."""
    connector = aiohttp.TCPConnector(ssl=False, limit=0)
    async with aiohttp.ClientSession(connector=connector, auto_decompress=False) as http:
        yield http
        await asyncio.sleep(0.05)  # TLS connections close
