"""The live gateway of `fuzz.py`: WebSocket messages, bytes of WebSockets and HTTP requests at a real process.

A session with two robots runs as `iris-session serve`; its gateway is a process of its own. Hostile browsers are
observers at most, so whatever they say, no robot may move.
"""

from __future__ import annotations

import asyncio
import re
import sys
import tempfile
import time
from collections.abc import Callable, Coroutine
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

import aiohttp
import msgspec
import psutil
from fuzz_decoders import Corpus, client_messages, make_web_message

from iris_session.client import Client
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.codec import decode_client, encode_client
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.names import Role
from iris_session.web import wire

sys.path.insert(0, str(Path(__file__).parents[1]))

if TYPE_CHECKING:
    from tests.web.browser import WebBrowser

DEADLINE_S: Final = 60.0
#: Distance that the tip of a robot may be from where it stood [m].
MAX_MOTION_M: Final = 0.002
ROBOTS: Final = ("left", "right")
_MESSAGE, _ENVELOPE, _MEDIA, _FRAMES, _HTTP = range(5)
_KINDS: Final = (*(_ENVELOPE,) * 6, *(_MESSAGE,) * 2, _MEDIA, _MEDIA, _FRAMES, _FRAMES, _HTTP, _HTTP)
_PATHS: Final = ("/", "/v1/info", "/v1/session", "/v1/media", f"/v1/asset/{'0' * 64}", "/../x", "/assets/x.js", "*")
_HEADERS: Final = (
    ("Host", ("127.0.0.1", "localhost", "evil.example", "")),
    ("Origin", ("http://127.0.0.1", "https://evil.example", "null")),
    ("Upgrade", ("websocket", "h2c")),
    ("Connection", ("Upgrade", "close", "keep-alive")),
    ("Sec-WebSocket-Key", ("AAAAAAAAAAAAAAAAAAAAAA==", "x")),
    ("Sec-WebSocket-Version", ("13", "99")),
    ("Sec-WebSocket-Protocol", (wire.SUBPROTOCOL, "iris-session.2")),
    ("Content-Length", ("0", "5", "-1", "99999999999")),
    ("Transfer-Encoding", ("chunked", "gzip")),
    ("Range", ("bytes=0-1", "bytes=-1", "bytes=9-1")),
    ("X-Iris-Ticket", ("x", "")),
)


def make_request(rng: Random) -> bytes:
    """Return a request, mostly of the kind that the gateway serves."""
    lines = [
        f"{rng.choice(('GET', 'GET', 'POST', 'HEAD', 'X'))} {rng.choice(_PATHS)} HTTP/{rng.choice(('1.1', '1.0'))}"
    ]
    lines += [f"{name}: {rng.choice(values)}" for name, values in _HEADERS if rng.random() < 0.5]
    return "\r\n".join([*lines, "", ""]).encode() + rng.choice((b"", b"body", b"5\r\nhello\r\n0\r\n\r\n"))


def make_frame(rng: Random) -> bytes:
    """Return a WebSocket frame of a client: mostly masked, any opcode, any flags, a length that may be wrong."""
    payload = make_web_message(rng)[:60_000]
    first = rng.choice((0x82, 0x82, 0x02, 0x80, 0x88, 0x89, 0x8A, 0x81, 0xC2, rng.randrange(256)))
    masked = 0x80 if rng.random() < 0.9 else 0
    length = rng.choice((len(payload), len(payload), len(payload) + 1, 0, 2**40))
    if length < 126 and rng.random() < 0.9:
        head = bytes((first, masked | length))
    elif length < 65_536 and rng.random() < 0.9:
        head = bytes((first, masked | 126)) + length.to_bytes(2, "big")
    else:
        head = bytes((first, masked | 127)) + length.to_bytes(8, "big")
    mask = rng.randbytes(4) if masked else b""
    return head + mask + (bytes(b ^ mask[i % 4] for i, b in enumerate(payload)) if mask else payload)


class WebGateway:
    """Port of a real gateway. Every `BARRIER` inputs, honest browsers and a ZeroMQ client must get answers."""

    BARRIER: Final = 250
    PEERS: Final = 6
    #: Inputs of one hostile browser before another one replaces it.
    LIFE: Final = 100

    def __init__(self, rng: Random) -> None:
        from tests.e2e.session_process import SessionProcess, make_serve_command
        from tests.web.browser import WebBrowser, open_http

        self._rng = rng
        self._corpora: dict[int, Corpus] = {
            _MESSAGE: Corpus(rng, [make_web_message]),
            _ENVELOPE: Corpus(rng, client_messages()),
            _MEDIA: Corpus(rng, [make_web_message]),
            _FRAMES: Corpus(rng, [make_frame]),
            _HTTP: Corpus(rng, [make_request]),
        }
        self._loop = asyncio.new_event_loop()
        self._stack = AsyncExitStack()
        self._folder = tempfile.TemporaryDirectory(prefix="iris-fuzz-")
        folder = Path(self._folder.name)
        recording = folder / "session.rrd"
        self.server = SessionProcess(folder, recording, make_serve_command("handover", recording))
        found = re.search(r"in a browser: (\S+)", self._wait_for_output("in a browser: "))
        assert found
        self.page = found[1]
        self._address = urlsplit(self.page)
        self._make_browser: Callable[..., WebBrowser] = WebBrowser
        self._http: aiohttp.ClientSession = self._run(self._stack.enter_async_context(open_http()))
        self._peers: list[tuple[WebBrowser, int]] = []
        self._raw: list[asyncio.StreamWriter] = []
        self._sent = 0
        self.honest = self._run(self._make_browser(self._http, self.page, "honest").join())
        self.process = self.server.children()["web.gateway"]
        self.client = Client(self.server.address, role="observer", name="watch", alignment="not_needed")
        self.client.connect(DEADLINE_S)
        assert self.client.wait_for(lambda c: all(c.scene.tip_pose(robot) for robot in ROBOTS), DEADLINE_S)
        self._begin = {robot: self.client.scene.tip_pose(robot) for robot in ROBOTS}

    def make(self) -> bytes:
        """Return an input; its first byte is the kind."""
        kind = self._rng.choice(_KINDS)
        return bytes((kind,)) + self._corpora[kind].damaged()

    def feed(self, data: bytes) -> bool:
        """Send an input. Return whether it was sent as a whole."""
        self._sent += 1
        self.client.poll()
        accepted = False
        with suppress(ConnectionError, aiohttp.ClientError, TimeoutError):
            accepted = self._run(self._send(data[0], data[1:]))
        if self._sent % self.BARRIER == 0:
            self.check()
        return accepted

    async def _send(self, kind: int, data: bytes) -> bool:
        if kind in (_FRAMES, _HTTP):
            return await self._send_bytes(data, upgrade=kind == _FRAMES)
        if kind == _MEDIA:
            return await self._send_media(data)
        peer = await self._find_peer()
        if kind == _ENVELOPE:
            data = wire.encode_frames(wire.CONTROL, [self._make_harmless(data, peer.epoch)])
        await peer.socket.send_bytes(data)
        return True

    def _make_harmless(self, data: bytes, epoch: int) -> bytes:
        """Return a message of one who is an observer at most, mostly with the right connection epoch."""
        try:
            envelope = decode_client(data)
        except ProtocolError:
            return data
        if isinstance(envelope.message, Hello):
            hello = msgspec.structs.replace(envelope.message, role=Role.OBSERVER, secret=self._rng.randbytes(32))
            envelope = msgspec.structs.replace(envelope, message=hello)
        if self._rng.random() < 0.7:
            envelope = msgspec.structs.replace(envelope, connection_epoch=epoch, on_behalf_of="")
        return encode_client(envelope)

    async def _find_peer(self) -> WebBrowser:
        """Return a hostile browser whose WebSocket is open."""
        i = self._rng.randrange(self.PEERS)
        if i < len(self._peers):
            peer, left = self._peers[i]
            if left and peer.close_code is None and not peer.socket.closed:
                self._peers[i] = peer, left - 1
                return peer
            await peer.close()
            del self._peers[i]
        peer = self._make_browser(self._http, self.page, "peer")
        await asyncio.wait_for(peer.open(), 10.0)
        self._peers.append((peer, self.LIFE))
        if self._rng.random() < 0.8:
            await peer.send(Hello(Role.OBSERVER, "peer", secret=peer.secret, alignment="not_needed"), 0)
            with suppress(AssertionError):  # the session bounds how often one may join
                await peer.wait(lambda: peer.ticket, "a ticket", 1.0)
        return peer

    async def _send_media(self, data: bytes) -> bool:
        ticket = self._rng.choice((self.honest.ticket, "wrong", ""))
        async with self._http.ws_connect(f"{self.page}v1/media", protocols=[wire.SUBPROTOCOL]) as media:
            if ticket:
                await media.send_bytes(wire.encode_gateway_message(wire.Ticket(ticket)))
            await media.send_bytes(data)
            return True

    async def _send_bytes(self, data: bytes, *, upgrade: bool) -> bool:
        host, port = self._address.hostname, self._address.port
        reader, writer = await asyncio.wait_for(asyncio.open_connection(host, port), 10.0)
        if upgrade:
            writer.write(
                f"GET /v1/session HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
                f"Sec-WebSocket-Protocol: {wire.SUBPROTOCOL}\r\n\r\n".encode()
            )
            await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), 10.0)
        writer.write(data)
        await writer.drain()
        self._raw.append(writer)
        while len(self._raw) > 40:  # some stay open, in the middle of what they say
            self._raw.pop(self._rng.randrange(len(self._raw))).close()
        return True

    def check(self) -> None:
        """Check that everyone else is served, that no process was replaced, and that no robot has moved."""
        self._run(self._check_honest())
        assert self.server.process.poll() is None, "the session has ended"
        assert self.process.is_running(), "the gateway has ended"
        assert self.server.children()["web.gateway"].pid == self.process.pid, "the gateway was replaced"
        assert "Traceback" not in self.server.output, self.server.output[-2000:]
        report = self.client.status(DEADLINE_S)
        assert not any(report.restarts.values()), report.restarts
        assert not report.drops.get("web_fault"), self.server.output[-2000:]
        for robot, begin in self._begin.items():
            tip = self.client.scene.tip_pose(robot)
            assert tip is not None
            assert begin is not None
            moved = sum((a - b) ** 2 for a, b in zip(tip[0], begin[0], strict=True)) ** 0.5
            assert moved < MAX_MOTION_M, f"{robot} has moved by {moved:.4f} m"

    async def _check_honest(self) -> None:
        n = len(self.honest.states)
        await self.honest.snapshot()
        await self.honest.wait(lambda: len(self.honest.states) > n, "state goes on")
        async with self._http.get(f"{self.page}v1/info") as answer:
            assert answer.status == 200
        late = await self._make_browser(self._http, self.page, "late").join()
        await late.snapshot()
        await late.close()
        self.honest.inbox.clear()
        self.honest.bulk.clear()
        del self.honest.states[:-1]

    def close(self) -> None:
        """End the session."""
        for writer in self._raw:
            writer.close()
        for peer, _ in self._peers:
            self._run(peer.close())
        self._run(self.honest.close())
        self._run(self._stack.aclose())
        self._loop.close()
        self.client.close()
        self._end_session()
        self._folder.cleanup()

    def _end_session(self) -> None:
        children = psutil.Process(self.server.process.pid).children(recursive=True)
        try:
            self.server.stop()
        finally:
            self.server.process.kill()
            psutil.wait_procs(children, timeout=DEADLINE_S)

    def _run(self, work: Coroutine[Any, Any, Any]) -> Any:
        return self._loop.run_until_complete(work)

    def _wait_for_output(self, text: str) -> str:
        deadline = time.monotonic() + DEADLINE_S
        while text not in self.server.output:
            assert time.monotonic() < deadline, self.server.output
            time.sleep(0.01)
        return self.server.output
