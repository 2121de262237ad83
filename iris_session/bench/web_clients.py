"""Browsers of `bench web`: up to four in one process, which log the states they receive, with their times.

A browser here joins, keeps its connection alive and decodes every state as the page does, over a WebSocket; it draws
nothing. At the times of its job it fetches assets: the largest one, again and again.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import time
from http import HTTPStatus
from typing import Any, Final

import aiohttp
import numpy as np
from numpy.typing import NDArray

from iris_session.bench.clients import JOIN_S, ClientJob, Job, StateLog, make_web_secret
from iris_session.bench.plugins import POLL_S, Plugin
from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.identity import Identity
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.names import AlignmentKind
from iris_session.protocol.scene import decode_scene, list_assets
from iris_session.web import wire

#: Period of what depends on time: heartbeats and clock [s].
TICK_S: Final = 0.05
#: Assets fetched at once; the page fetches as many.
LOADS: Final = 6
#: Bytes that a browser fetches at each of its times.
LOAD_BYTES: Final = 200_000_000


class BenchBrowser:
    """One browser with its log."""

    def __init__(self, job: Job, spec: ClientJob) -> None:
        self.spec = spec
        self._job = job
        hello = Hello(spec.role, spec.name, software="bench", alignment=AlignmentKind.NOT_NEEDED)
        identity = Identity.in_memory()
        if job.keys:
            identity.secret = make_web_secret(job.keys, spec.name)
        self.connection = ClientConnection(hello, identity)
        self._ticket = ""
        self._socket: aiohttp.ClientWebSocketResponse | None = None
        self.begin_ns = self.end_ns = 0
        self.log = StateLog()
        self.loads: list[tuple[int, int, int]] = []

    async def join(self, http: aiohttp.ClientSession) -> None:
        """Open the WebSocket and start to join the session."""
        self._socket = await http.ws_connect(
            f"{self._job.page}v1/session", protocols=[wire.SUBPROTOCOL], max_msg_size=0
        )
        self.connection.open(time.monotonic_ns())
        await self._send_all()

    @property
    def is_ready(self) -> bool:
        """Return whether it has the snapshot, and state after it."""
        return self.connection.phase is ConnectionPhase.READY and bool(self.connection.stream.counters.delivered)

    async def read(self) -> None:
        """Process what the gateway sends, until the WebSocket is closed."""
        assert self._socket is not None
        async for message in self._socket:
            now_ns = time.monotonic_ns()
            channel, frames = wire.decode_frames(message.data)
            if channel == wire.STATE:
                received = [bytes(frame) for frame in frames]
                state = self.connection.stream.drain([received], now_ns - self._job.origin_ns, now_ns)
                handed_ns = self._job.session_time_ns()
                if state is not None and self.begin_ns <= handed_ns < self.end_ns:
                    self.log.add(state.header, handed_ns)
            elif channel == wire.CONTROL:
                self.connection.receive([bytes(frame) for frame in frames], now_ns)
                self.connection.inbox.clear()
                await self._send_all()
            elif isinstance(told := wire.decode_gateway_message(frames[0]), wire.Ticket):
                self._ticket = told.ticket

    async def load_at_times(self, http: aiohttp.ClientSession) -> None:
        """Fetch assets at each of its times in the window, one after the other."""
        for at_s in self.spec.loads_s:
            await asyncio.sleep((self.begin_ns - self._job.session_time_ns()) * 1e-9 + at_s)
            await self._load(http)

    async def _load(self, http: aiohttp.ClientSession) -> None:
        """Fetch the largest asset until `LOAD_BYTES` have come. Notes when, and how much came so far."""
        begin_ns = self._job.session_time_ns()
        row = len(self.loads)
        self.loads.append((begin_ns, begin_ns, 0))
        spec = decode_scene(await self._fetch(http, self.connection.mirror.scene_hash))
        sizes = list_assets(spec)
        largest = max(sizes, key=lambda address: sizes[address])  # a gateway limits requests

        async def fetch_until_enough() -> None:
            while self.loads[row][2] < LOAD_BYTES:
                n = len(await self._fetch(http, largest))
                self.loads[row] = (begin_ns, self._job.session_time_ns(), self.loads[row][2] + n)

        await asyncio.gather(*(fetch_until_enough() for _ in range(LOADS)))

    async def _fetch(self, http: aiohttp.ClientSession, address: str) -> bytes:
        url = f"{self._job.page}v1/asset/{address}"
        while True:  # until it has a ticket of its present connection: it may just have been frozen
            async with http.get(url, headers={"X-Iris-Ticket": self._ticket}) as answer:
                if answer.status == HTTPStatus.OK:
                    return await answer.read()
            await asyncio.sleep(TICK_S)

    async def keep_alive(self) -> None:
        """Send heartbeats and pings until cancelled."""
        while True:
            self.connection.tick(time.monotonic_ns())
            await self._send_all()
            await asyncio.sleep(TICK_S)

    async def close(self) -> None:
        """Leave the session."""
        self.connection.close()
        with contextlib.suppress(ConnectionError):  # the session may have ended first
            await self._send_all()
        if self._socket is not None:
            await self._socket.close()

    async def _send_all(self) -> None:
        assert self._socket is not None
        while (outgoing := self.connection.peek_outgoing()) is not None:
            self.connection.pop_outgoing(sent=True)
            await self._socket.send_bytes(wire.encode_frames(wire.CONTROL, [outgoing[1]]))

    def to_columns(self) -> dict[str, NDArray[Any]]:
        """Return the log."""
        return self.log.to_columns(self.connection.stream) | {"loads": np.array(self.loads, np.int64)}


class Browsers(Plugin):
    """Browsers of one process. Their loop runs while they are polled and while they are measured."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._browsers = [BenchBrowser(job, spec) for spec in job.clients]
        self._loop = asyncio.new_event_loop()
        self._tasks: list[asyncio.Task[None]] = []  # which do not end by themselves
        self._loads: list[asyncio.Task[None]] = []
        self._loop.run_until_complete(self._join())
        gc.collect()
        gc.freeze()
        gc.disable()  # as `bench.clients` does

    def poll(self) -> None:
        """Let the browsers read and send."""
        self._loop.run_until_complete(self._run(POLL_S))

    def measure(self, begin_ns: int, end_ns: int) -> None:
        """Run through a window of session time [ns], and write the log."""
        for browser in self._browsers:
            browser.begin_ns, browser.end_ns = begin_ns, end_ns
            self._loads.append(self._loop.create_task(browser.load_at_times(self._http)))
        self._loop.run_until_complete(self._run((end_ns - self._job.session_time_ns()) * 1e-9))
        self._job.write_log({browser.spec.name: browser.to_columns() for browser in self._browsers})

    def close(self) -> None:
        """Leave the session."""
        self._loop.run_until_complete(self._leave())

    async def _join(self) -> None:
        # The certificate is of this machine's own making.
        connector = aiohttp.TCPConnector(ssl=False, limit=0)
        self._http = aiohttp.ClientSession(connector=connector, auto_decompress=False)
        for browser in self._browsers:
            await browser.join(self._http)
            self._tasks += [self._loop.create_task(one) for one in (browser.read(), browser.keep_alive())]
        async with asyncio.timeout(JOIN_S):
            while not all(browser.is_ready for browser in self._browsers):
                await self._run(TICK_S)

    async def _run(self, seconds: float) -> None:
        """Let all tasks run for some seconds. Raises what a task has raised."""
        tasks = (*self._tasks, *self._loads)
        await asyncio.wait(tasks, timeout=max(0.0, seconds), return_when=asyncio.FIRST_EXCEPTION)
        for task in tasks:
            if task.done():
                task.result()
        if any(task.done() for task in self._tasks):
            raise ConnectionError("the gateway closed the WebSocket of a browser")

    async def _leave(self) -> None:
        for task in (*self._tasks, *self._loads):
            task.cancel()
        for browser in self._browsers:
            await browser.close()
        await self._http.close()
