"""Clients of `bench web`: up to four browsers in one process, which log the states they receive, with their times.

    python -m iris_session.bench.web_clients < job.json

Same protocol as `bench.clients`: prints `ready`, reads `begin end`, writes its log as one .npz file. A browser here
joins, keeps its connection alive and decodes every state as the page does, over a WebSocket; it draws nothing. Within
the window each line `load BYTES` lets the first browser fetch that much: the largest asset, again and again.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import sys
import time
from collections.abc import Sequence
from http import HTTPStatus
from typing import Final

import aiohttp
import msgspec
import numpy as np

from iris_session.bench.clients import JOIN_S, MAX_FRAMES, ClientJob, Job, make_web_secret
from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.state_stream import SceneState
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


class BenchBrowser:
    """One browser with its log."""

    def __init__(self, job: Job, spec: ClientJob) -> None:
        self.spec = spec
        self._job = job
        hello = Hello(spec.role, spec.name, software="bench", alignment=AlignmentKind.NOT_NEEDED)
        identity = Identity.in_memory()
        if job.secret:
            identity.secret = make_web_secret(job.secret, spec.name)
        self.connection = ClientConnection(hello, identity)
        self._ticket = ""
        self._socket: aiohttp.ClientWebSocketResponse | None = None
        self.begin_ns = self.end_ns = 0
        self.ticks: list[int] = []
        self.handed_ns: list[int] = []
        self.state_ns: list[int] = []
        self.published_ns: list[int] = []
        self.loads: list[tuple[int, int, int]] = []
        self.overflow = 0

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
                if state is not None:
                    self._log(state)
            elif channel == wire.CONTROL:
                self.connection.receive([bytes(frame) for frame in frames], now_ns)
                self.connection.inbox.clear()
                await self._send_all()
            elif isinstance(told := wire.decode_gateway_message(frames[0]), wire.Ticket):
                self._ticket = told.ticket

    async def load(self, http: aiohttp.ClientSession, size: int) -> None:
        """Fetch the largest asset of the scene until `size` bytes have come. Notes when, and how much came so far."""
        begin_ns = time.monotonic_ns() - self._job.origin_ns
        row = len(self.loads)
        self.loads.append((begin_ns, begin_ns, 0))
        spec = decode_scene(await self._fetch(http, self.connection.mirror.scene_hash))
        sizes = list_assets(spec)
        largest = max(sizes, key=lambda address: sizes[address])  # a gateway limits requests

        async def fetch_until_enough() -> None:
            while self.loads[row][2] < size:
                n = len(await self._fetch(http, largest))
                self.loads[row] = (begin_ns, time.monotonic_ns() - self._job.origin_ns, self.loads[row][2] + n)

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

    def _log(self, state: SceneState) -> None:
        now_ns = time.monotonic_ns() - self._job.origin_ns
        if not self.begin_ns <= now_ns < self.end_ns:
            return
        if len(self.ticks) >= MAX_FRAMES:
            self.overflow += 1
            return
        self.handed_ns.append(now_ns)
        self.ticks.append(state.header.tick)
        self.state_ns.append(state.header.session_time)
        self.published_ns.append(state.header.published_ns)

    def to_columns(self) -> dict[str, np.ndarray[tuple[int, ...], np.dtype[np.int64]]]:
        """Return the log, with the columns of `bench.clients`."""
        counters = self.connection.stream.counters
        counts = [0, self.overflow, counters.superseded, counters.rigid_messages, counters.rigid_bytes]
        columns: dict[str, Sequence[int | tuple[int, ...]]] = {
            "ticks": self.ticks,
            "handed_ns": self.handed_ns,
            "state_ns": self.state_ns,
            "published_ns": self.published_ns,
            "counts": counts,
            "loads": self.loads,
        }
        return {key: np.array(column, np.int64) for key, column in columns.items()}


async def run(job: Job) -> None:
    """Join, wait for the window, measure, and write the log."""
    browsers = [BenchBrowser(job, spec) for spec in job.clients]
    # The certificate is of this machine's own making.
    connector = aiohttp.TCPConnector(ssl=False, limit=0)
    commands = await _open_stdin()
    async with (
        aiohttp.ClientSession(connector=connector, auto_decompress=False) as http,
        asyncio.TaskGroup() as group,
    ):
        for browser in browsers:
            await browser.join(http)
        readers = [group.create_task(browser.read()) for browser in browsers]
        timers = [group.create_task(browser.keep_alive()) for browser in browsers]
        async with asyncio.timeout(JOIN_S):
            while not all(browser.is_ready for browser in browsers):
                await asyncio.sleep(TICK_S)
        gc.collect()
        gc.freeze()
        gc.disable()  # as `bench.clients` does
        print("ready", flush=True)
        begin_ns, end_ns = map(int, (await commands.readline()).split())
        for browser in browsers:
            browser.begin_ns, browser.end_ns = begin_ns, end_ns
        loading = group.create_task(_load_on_command(commands, browsers[0], http))
        await asyncio.sleep((end_ns + job.origin_ns - time.monotonic_ns()) * 1e-9)
        lost = [browser.spec.name for browser, reader in zip(browsers, readers, strict=True) if reader.done()]
        log = {f"{b.spec.name}.{key}": column for b in browsers for key, column in b.to_columns().items()}
        np.savez(job.log, allow_pickle=False, **log)
        for task in (*readers, *timers, loading):
            task.cancel()
        for browser in browsers:
            await browser.close()
    if lost:
        sys.exit(f"bench web: the gateway closed the WebSocket of {', '.join(lost)}")


async def _open_stdin() -> asyncio.StreamReader:
    """Return standard input as a stream, which does not keep the process from ending."""
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    return reader


async def _load_on_command(commands: asyncio.StreamReader, browser: BenchBrowser, http: aiohttp.ClientSession) -> None:
    while line := await commands.readline():
        await browser.load(http, int(line.split()[1]))


if __name__ == "__main__":
    asyncio.run(run(msgspec.json.decode(sys.stdin.readline(), type=Job)))
