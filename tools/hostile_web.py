"""Attacks on the web gateway by peers without a key and by observers, while an honest browser drives and stops.

    python tools/hostile_web.py --json --quick
    python tools/hostile_web.py --case pings --case observer_pings

`tools/hostile.py` runs it too.

The session is `iris-session serve handover` on loopback, so that everything an attacker may send reaches the gateway
without TLS, and for the cases `tls_...` the same with `--curve`; attackers have the address of the honest browser,
which holds a robot and moves it before each e-stop. For each case, frames at 0.1 MB/s by one socket and at 5 MB/s by
four, each e-stop must reach the session and come back as an event within 200 ms, or three times what it takes without
the attack; the WebSocket must stay open, the gateway keep running. Afterwards the gateway gives back what it took but
for 50 MiB, and the log has grown by less than 100 lines. Prints progress to standard error, and as its last line one
JSON object with `--json`, else a table; exit status 0 if all is well.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import hashlib
import hmac
import itertools
import json
import math
import os
import re
import secrets
import signal
import socket
import ssl
import struct
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, Final, NamedTuple

import aiohttp
import msgpack
import psutil
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from iris_session.protocol.client_messages import (
    Acquire,
    Bye,
    ClearEStop,
    ClientMessage,
    EStop,
    GetSnapshot,
    Heartbeat,
    Hello,
    Sample,
    wrap_message,
)
from iris_session.protocol.codec import decode_server, decode_state_header, encode_client
from iris_session.protocol.common import Target
from iris_session.protocol.server_messages import EStopChanged, Event, Reply, Welcome
from iris_session.security import KeyHome, encode_key
from iris_session.web import wire

#: What was measured of one case, as the table shows it.
Row = dict[str, Any]
ROOT: Final = Path(__file__).resolve().parents[1]
MIB: Final = 1 << 20
START_S: Final = 90.0
#: Longest time for an e-stop to come back, and its share of that without the attack [ms].
STOP_MS: Final = 200.0
STOP_SHARE: Final = 3.0
LOST_S: Final = 5.0
#: Times that an honest browser comes again within 8 s: then all handshakes of its address are there.
CONNECT_TRIES: Final = 8
#: Samples that move the robot before each e-stop: of those, two a second go on.
MOVING_SAMPLES: Final = 40
MEMORY_MIB: Final = 50.0
LOG_LINES: Final = 100
RATES: Final = (0.1e6, 5e6)
#: Frames of WebSockets by case: first byte (mark of the end, opcode), and bytes of the payload (0, or 126 and more).
FRAMES: Final = {
    "large": (0x82, 48_006),
    "too_large": (0x82, 60_000),
    "pings": (0x89, 0),
    "pongs": (0x8A, 0),
    "fragments": (0x00, 0),
}
#: Cases without a rate: sockets that say nothing, that read nothing, WebSockets opened and closed, unknown assets.
OTHERS: Final = ("half_open", "unread", "observer_unread", "handshakes", "observer_assets")
#: An attack by one that the session has welcomed; one on a session with TLS.
OBSERVER: Final = "observer_"
TLS: Final = "tls_"
#: Handshake messages of TLS 1.2 after the handshake, of which HTTP never hears.
HELLOS: Final = "hellos"
TLS_CASES: Final = (HELLOS, "large", "pings", "observer_pings", "half_open", "handshakes", "observer_assets")
CASES: Final = (*FRAMES, *(OBSERVER + kind for kind in FRAMES), *OTHERS, *(TLS + kind for kind in TLS_CASES))
#: Identities that attackers have where they need one: one key has few connections.
OBSERVERS: Final = 8
#: Sockets that send frames at once, and the rate from which they are so many.
SOCKETS, MANY_FROM = 4, 1e6
SAMPLE_S: Final = 1 / 72
#: Time in which memory is given back: who reads nothing is closed after 6 s, who requests nothing after 15.
SETTLE_S: Final = 25.0


# --- the honest browser -----------------------------------------------------------------------------------------------


class NotWelcomedError(Exception):
    """The session did not welcome the honest browser."""


class HonestBrowser:
    """A browser that joins as a director, moves a robot, and stops."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket = socket
        self._changed = asyncio.Event()
        self._participant = ""
        self._target: tuple[Target, ...] = ()
        self._scene_epoch = self._n = self._applied = self._stop_seq = 0
        self._session_ns = -(1 << 62)  # session time when the monotonic clock is 0, less the shortest delay
        self._clutch = self._is_stopped = False
        self.epoch = self.stops = 0

    @property
    def is_closed(self) -> bool:
        return self._socket.closed

    async def send(self, message: ClientMessage) -> None:
        """Send a message on the control channel."""
        envelope = encode_client(wrap_message(message, self.epoch))
        await self._socket.send_bytes(wire.encode_frames(wire.CONTROL, [envelope]))

    async def read(self) -> None:
        """Read until the WebSocket is closed."""
        async for message in self._socket:
            channel, frames = wire.decode_frames(message.data)
            if channel == wire.CONTROL:
                self._take_message(decode_server(frames[0]).message)
            elif channel == wire.STATE and bytes(frames[0]) == b"rigid":
                header = decode_state_header(frames[1])
                self._session_ns = max(self._session_ns, header.session_time - time.monotonic_ns())
                self._scene_epoch = header.scene_epoch
                for one in header.applied:
                    if one.participant == self._participant:
                        self._applied = one.seq
            self._changed.set()

    def _take_message(self, answer: object) -> None:
        if isinstance(answer, Welcome):
            self.epoch, self._participant = answer.connection_epoch, answer.participant_id
        elif isinstance(answer, Reply) and answer.leases:
            self._target = (Target(answer.leases[0].target, answer.leases[0].lease_version),)
        elif isinstance(answer, Event) and isinstance(answer.body, EStopChanged):
            self._is_stopped, self._stop_seq = answer.body.active, answer.body.stop_seq
            self.stops += answer.body.active

    async def join(self, secret: bytes) -> None:
        """Join and acquire a robot that is free. Raises `NotWelcomedError`."""
        await self.send(Hello("director", "honest", secret=secret, alignment="not_needed", devices=("desktop",)))
        if await self.wait(lambda: self.epoch > 0, 30.0):
            await self.send(Acquire(1))
            if await self.wait(lambda: bool(self._target) and self._scene_epoch > 0, 30.0):
                return
        raise NotWelcomedError(f"epoch {self.epoch}, leases {self._target}")

    async def beat(self) -> None:
        """Send heartbeats."""
        while not self.is_closed:
            await self.send(Heartbeat())
            await asyncio.sleep(0.3)

    async def drive(self) -> None:
        """Move the robot up and down, as fast as a headset sends samples."""
        while not self.is_closed:
            self._n += 1
            twist = (0.0, 0.0, 0.05 * math.sin(self._n / 20), 0.0, 0.0, 0.0)
            now_ns = time.monotonic_ns() + self._session_ns
            head = ("desktop", "twist", self._n, now_ns, self._scene_epoch, 0, 0, self._target)
            await self.send(Sample(*head, clutch=self._clutch, twist=twist))
            await asyncio.sleep(SAMPLE_S)

    async def wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Return whether a condition came true in time."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while not condition():
                    self._changed.clear()
                    await self._changed.wait()
        return condition()

    async def engage(self) -> bool:
        """Clear the e-stop, and return whether the robot follows `MOVING_SAMPLES` samples then."""
        until = time.monotonic() + LOST_S
        while time.monotonic() < until and not self.is_closed:
            if self._is_stopped:
                await self.send(ClearEStop(2, self._stop_seq))
                await self.wait(lambda: not self._is_stopped, LOST_S / 2)
            self._clutch = False
            await asyncio.sleep(4 * SAMPLE_S)
            self._clutch, begin = True, self._n
            if await self.wait(lambda: self._applied >= begin + MOVING_SAMPLES, 3 * MOVING_SAMPLES * SAMPLE_S):  # noqa: B023
                return True
        return False

    async def measure_stop(self) -> float:
        """Return the time from an e-stop to its event [ms], infinity for one that is lost."""
        before, began = self.stops, time.perf_counter()
        with contextlib.suppress(ConnectionError):
            await self.send(EStop())
            await self.wait(lambda: self.stops > before, LOST_S)
        return (time.perf_counter() - began) * 1e3 if self.stops > before else float("inf")


def make_trusting_context() -> ssl.SSLContext:
    """Return settings of TLS that take the gateway's certificate as it is."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


async def connect_in_turn(http: aiohttp.ClientSession, url: str) -> aiohttp.ClientWebSocketResponse:
    """Open a WebSocket, again after a refusal as the page does: the attack before has used up the TLS handshakes of
    this address, of which there are 20 a second and a store of 120.
    """
    for _ in range(CONNECT_TRIES):
        with contextlib.suppress(aiohttp.ClientConnectionError):
            return await http.ws_connect(url, protocols=[wire.SUBPROTOCOL], max_msg_size=0)
        await asyncio.sleep(1.0)
    return await http.ws_connect(url, protocols=[wire.SUBPROTOCOL], max_msg_size=0)


@contextlib.asynccontextmanager
async def open_honest(page: str, secret: bytes) -> AsyncIterator[HonestBrowser]:
    """An honest browser that has joined and moves the robot."""
    async with (
        aiohttp.ClientSession(connector=aiohttp.TCPConnector(ssl=False)) as http,
        await connect_in_turn(http, f"{page}v1/session") as socket,
    ):
        browser = HonestBrowser(socket)
        tasks = [asyncio.create_task(browser.read())]
        try:
            await browser.join(secret)
            tasks += [asyncio.create_task(browser.beat()), asyncio.create_task(browser.drive())]
            yield browser
        finally:
            for task in tasks:
                task.cancel()
            with contextlib.suppress(ConnectionError):
                await browser.send(Bye())


# --- attacks ----------------------------------------------------------------------------------------------------------


def make_frame(first: int, length: int) -> bytes:
    """Return a frame of a client (RFC 6455, section 5.2), masked with zeros."""
    if not length:
        return struct.pack(">BB", first, 0x80) + bytes(4)
    head = struct.pack(">BBH", first, 0x80 | 126, length)
    envelope = b"\x94\x01\x00\xa0\x82\xa4type\xa5hello\xa3pad\xc5" + struct.pack(">H", length - 29) + bytes(length)
    body = wire.encode_frames(wire.CONTROL, [envelope[: length - 6]])
    return head + bytes(4) + body[:length].ljust(length, b"\0")


def make_request(host: str, port: int) -> bytes:
    """Return the handshake of a WebSocket."""
    return (
        f"GET /v1/session HTTP/1.1\r\nHost: {host}:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Protocol: {wire.SUBPROTOCOL}\r\n\r\n"
    ).encode()


async def read_all(reader: asyncio.StreamReader) -> None:
    """Read what comes until the end, so that the attacker's own connection holds nothing up."""
    with contextlib.suppress(OSError):
        while await reader.read(1 << 16):
            pass


class Victim(NamedTuple):
    """The gateway, and the secrets of observers that it knows, none where it takes any."""

    host: str
    port: int
    tls: ssl.SSLContext | None
    secrets: list[bytes]

    async def open_websocket(self, *, joins: bool) -> tuple[asyncio.StreamReader, asyncio.StreamWriter, bytes, int]:
        """Open a WebSocket; with `joins` say hello as an observer, and wait for the ticket. Return that and the epoch
        of the connection, too."""
        reader, writer = await asyncio.open_connection(self.host, self.port, limit=8 * MIB, ssl=self.tls)
        writer.write(make_request(self.host, self.port))
        await reader.readuntil(b"\r\n\r\n")
        ticket, epoch = b"", 0
        if joins:
            secret = secrets.choice(self.secrets) if self.secrets else secrets.token_bytes(32)
            hello = Hello("observer", "mallory", secret=secret, alignment="not_needed")
            body = wire.encode_frames(wire.CONTROL, [encode_client(wrap_message(hello, 0))])
            writer.write(struct.pack(">BBH", 0x82, 0x80 | 126, len(body)) + bytes(4) + body)
            async with asyncio.timeout(10.0):
                before = await reader.readuntil(b"\xa6ticket\xa6ticket\xd9")  # the type, then the field: a text
                length = (await reader.readexactly(1))[0]
                ticket = await reader.readexactly(length)
            unpacker = msgpack.Unpacker()
            unpacker.feed(before.split(b"\xb0connection_epoch")[1])
            epoch = int(unpacker.unpack())
        print("connected", flush=True)
        return reader, writer, ticket, epoch


async def attack_with_frames(victim: Victim, kind: str, bytes_per_s: float, *, joins: bool) -> None:
    """Send frames of one kind on one WebSocket after the other, each opened as soon as the last is cut."""
    frame = make_frame(*FRAMES[kind])
    begin = make_frame(0x02, 0) if kind == "fragments" else b""  # the message whose empty rest follows
    piece = frame * max(1, round(min(bytes_per_s * 0.02, 256e3) / len(frame)))
    while True:
        with contextlib.suppress(OSError, TimeoutError, asyncio.IncompleteReadError):
            reader, writer, _, _ = await victim.open_websocket(joins=joins)
            try:
                writer.write(begin)
                reading = asyncio.create_task(read_all(reader))
                while not reading.done():
                    writer.write(piece)
                    await writer.drain()
                    await asyncio.sleep(len(piece) / bytes_per_s)
            finally:
                writer.close()
        await asyncio.sleep(0.02)


async def attack_with_handshakes(victim: Victim) -> None:
    """Open a WebSocket and leave, a hundred times a second."""
    while True:
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            _, writer, _, _ = await victim.open_websocket(joins=False)
            writer.close()
        await asyncio.sleep(0.01)


async def attack_with_assets(victim: Victim) -> None:
    """Request assets that nobody serves, as fast as answers come, by one observer after the other."""
    while True:
        with contextlib.suppress(OSError, TimeoutError, asyncio.IncompleteReadError):
            _, writer, ticket, _ = await victim.open_websocket(joins=True)
            reader, http = await asyncio.open_connection(victim.host, victim.port, ssl=victim.tls)
            for _ in range(5000):
                name = secrets.token_hex(32)
                address = f"{victim.host}:{victim.port}"
                head = f"GET /v1/asset/{name} HTTP/1.1\r\nHost: {address}\r\nX-Iris-Ticket: ".encode()
                http.write(head + ticket + b"\r\n\r\n")
                answer = await reader.readuntil(b"\r\n\r\n")
                if b" 401 " in answer:
                    break
                length = int(answer.lower().split(b"content-length: ")[1].split(b"\r")[0])
                await reader.readexactly(length)
            http.close()
            writer.close()
        await asyncio.sleep(0.02)


async def attack_by_reading_nothing(victim: Victim) -> None:
    """Join, ask for snapshots, and read none of them nor any state."""
    held: list[asyncio.StreamWriter] = []
    while True:
        with contextlib.suppress(OSError, TimeoutError, asyncio.IncompleteReadError):
            reader, writer, _, epoch = await victim.open_websocket(joins=True)
            reader._transport.pause_reading()  # type: ignore[attr-defined]
            frame = wire.encode_frames(wire.CONTROL, [encode_client(wrap_message(GetSnapshot(), epoch))])
            writer.write(8 * (struct.pack(">BB", 0x82, 0x80 | len(frame)) + bytes(4) + frame))
            held.append(writer)
        while len(held) > 30:
            held.pop(0).close()
        await asyncio.sleep(0.1)


async def attack_with_sockets(victim: Victim, kind: str, n: int = 200) -> None:
    """Keep connections that say nothing (`half_open`), or that request the page's program and read nothing
    (`unread`)."""
    host, port = victim.host, victim.port
    request = b""
    if kind == "unread":
        with urllib.request.urlopen(f"http://{host}:{port}/", timeout=5.0) as page:
            program = re.findall(rb"assets/[\w.-]+\.js", page.read())[0].decode()
        request = f"GET /{program} HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode()
    writers: list[asyncio.StreamWriter] = []
    while True:
        with contextlib.suppress(OSError):
            sock = socket.socket()
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            sock.setblocking(False)
            await asyncio.get_running_loop().sock_connect(sock, (host, port))
            reader, writer = await asyncio.open_connection(sock=sock, limit=1)
            reader._transport.pause_reading()  # type: ignore[attr-defined]
            print("connected", flush=True)
            writer.write(request * 8)
            writers.append(writer)
        if len(writers) > n:
            writers.pop(0).close()
        await asyncio.sleep(0.01)


def shake_hands(sock: socket.socket) -> tuple[AESGCM, bytes]:
    """Make a handshake of TLS 1.2. Return the cipher and the fixed part of the nonce of what the client writes (RFC
    5246, sections 5 and 6.3; RFC 5288), so that records can be made which no library sends."""
    context = make_trusting_context()
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    context.set_ciphers("ECDHE-ECDSA-AES128-GCM-SHA256")
    with tempfile.NamedTemporaryFile("r") as log:
        context.keylog_filename = log.name
        incoming, outgoing, server_random = ssl.MemoryBIO(), ssl.MemoryBIO(), b""
        tls = context.wrap_bio(incoming, outgoing)
        while True:
            try:
                tls.do_handshake()
                break
            except ssl.SSLWantReadError:
                sock.sendall(outgoing.read())
                data = sock.recv(1 << 16)
                if not data:
                    raise ConnectionResetError from None
                server_random = server_random or data[11:43]
                incoming.write(data)
        if outgoing.pending:
            sock.sendall(outgoing.read())
        _, client_random, master = next(line.split() for line in log if line.startswith("CLIENT_RANDOM"))
    secret, seed = bytes.fromhex(master), b"key expansion" + server_random + bytes.fromhex(client_random)
    block, chain = b"", seed
    while len(block) < 40:
        chain = hmac.digest(secret, chain, hashlib.sha256)
        block += hmac.digest(secret, chain + seed, hashlib.sha256)
    return AESGCM(block[:16]), block[32:36]


def attack_with_hellos(victim: Victim, bytes_per_s: float) -> None:
    """Send one empty ClientHello after the other behind a handshake, and read none of the answers."""
    while True:
        with contextlib.suppress(OSError), socket.socket() as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            sock.connect((victim.host, victim.port))
            cipher, fixed = shake_hands(sock)
            print("connected", flush=True)
            numbers = itertools.count(1)
            while True:
                piece = b""
                for n in itertools.islice(numbers, max(1, round(bytes_per_s * 0.02 / 33))):
                    nonce = struct.pack(">Q", n)
                    sealed = cipher.encrypt(fixed + nonce, b"\x01\0\0\0", struct.pack(">QBHH", n, 22, 0x303, 4))
                    piece += struct.pack(">BHH", 22, 0x303, len(nonce + sealed)) + nonce + sealed
                sock.sendall(piece)
                time.sleep(len(piece) / bytes_per_s)
        time.sleep(0.02)


async def attack(kind: str, victim: Victim, bytes_per_s: float) -> None:
    """Attack until the process is ended."""
    name = kind.removeprefix(TLS)
    base = name.removeprefix(OBSERVER)
    n = SOCKETS if bytes_per_s >= MANY_FROM else 1
    if base in FRAMES:
        each = (attack_with_frames(victim, base, bytes_per_s / n, joins=name != base) for _ in range(n))
        await asyncio.gather(*each)
    elif name == HELLOS:
        for _ in range(n):
            threading.Thread(target=attack_with_hellos, args=(victim, bytes_per_s / n), daemon=True).start()
        await asyncio.Event().wait()
    elif name == "handshakes":
        await attack_with_handshakes(victim)
    elif name == "observer_assets":
        await asyncio.gather(*(attack_with_assets(victim) for _ in range(SOCKETS)))
    elif name == "observer_unread":
        await attack_by_reading_nothing(victim)
    else:
        await attack_with_sockets(victim, name)


# --- the lab ----------------------------------------------------------------------------------------------------------


async def measure(browser: HonestBrowser, seconds: float) -> tuple[list[float], int]:
    """Return the times of e-stops [ms], and how many of them came while the robot did not follow."""
    until, times_ms, n_idle = time.monotonic() + seconds, [], 0
    while time.monotonic() < until and not browser.is_closed:
        with contextlib.suppress(ConnectionError):
            n_idle += not await browser.engage()
        times_ms.append(await browser.measure_stop())
    return times_ms, n_idle


async def count_lines(stream: asyncio.StreamReader) -> int:
    """Return the number of lines until the end: of an attacker, its connections."""
    n = 0
    while await stream.readline():
        n += 1
    return n


async def run_case(kind: str, page: str, known: list[bytes], bytes_per_s: float, seconds: float) -> Row:
    """Return what an honest browser has measured during an attack. `known`: its secret, then those of attackers."""
    async with open_honest(page, known[0]) as browser:
        usual, _ = await measure(browser, seconds)
        port = page.rstrip("/").rpartition(":")[2]
        command = [sys.executable, __file__, "--attack", kind, port, str(bytes_per_s), b"".join(known[1:]).hex()]
        attacker = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE)
        try:
            assert attacker.stdout is not None
            async with asyncio.timeout(START_S / 2):
                await attacker.stdout.readline()  # it is connected
            counting = asyncio.create_task(count_lines(attacker.stdout))
            times_ms, n_idle = await measure(browser, seconds)
            is_open, is_attacking = not browser.is_closed, attacker.returncode is None
        finally:
            attacker.kill()
            await attacker.wait()
        n_connections = 1 + await counting
    slowest, n_lost = max(times_ms, default=float("inf")), times_ms.count(float("inf"))
    is_fast = slowest <= max(STOP_MS, STOP_SHARE * max(usual, default=0.0))
    row = {"case": kind, "mb_per_s": bytes_per_s / 1e6, "connections": n_connections}
    row |= {"stops": len(times_ms), "idle": n_idle, "lost": n_lost}
    row |= {"usual_ms": round(max(usual, default=0.0), 1), "slowest_ms": None if n_lost else round(slowest, 1)}
    return {**row, "is_open": is_open, "ok": is_open and is_attacking and is_fast and not n_idle}


def find_gateway(server: subprocess.Popen[bytes]) -> psutil.Process:
    """Return the gateway process of a session."""
    for child in psutil.Process(server.pid).children():
        if "iris_session.web.gateway" in child.cmdline():
            return child
    raise SystemExit("hostile_web: the session has no gateway")


def read_memory_mib(process: psutil.Process) -> float:
    """Return the memory of a process, infinity for one that has ended."""
    try:
        return float(process.memory_info().rss) / MIB
    except psutil.NoSuchProcess:
        return float("inf")


def wait_for_page(server: subprocess.Popen[bytes], page: str) -> None:
    """Wait until the gateway answers. Raises `SystemExit`."""
    until = time.monotonic() + START_S
    tls = make_trusting_context() if page.startswith("https") else None
    while time.monotonic() < until and server.poll() is None:
        with contextlib.suppress(OSError), urllib.request.urlopen(f"{page}v1/info", timeout=5.0, context=tls):
            return
        time.sleep(0.2)
    raise SystemExit("hostile_web: the session did not start")


def run(cases: list[str], seconds: float) -> dict[str, Any]:
    """Run cases, each against a session without or with TLS. Return the figures."""
    figures: dict[str, Any] = {"cases": [], "kept_mib": 0.0, "log_lines": 0}
    for tls in (False, True):
        chosen = [kind for kind in cases if kind.startswith(TLS) is tls]
        if chosen:
            rows, kept_mib, n_lines = run_session(chosen, seconds, tls=tls)
            figures["cases"] += rows
            figures["kept_mib"] = max(figures["kept_mib"], round(kept_mib, 1))
            figures["log_lines"] = max(figures["log_lines"], n_lines)
    is_well = all(row["ok"] for row in figures["cases"]) and figures["kept_mib"] <= MEMORY_MIB
    return {**figures, "ok": is_well and figures["log_lines"] < LOG_LINES}


def run_session(cases: list[str], seconds: float, *, tls: bool) -> tuple[list[Row], float, int]:
    """Run cases against one session. Return their rows, the memory that the gateway keeps [MiB], and lines of log."""
    with tempfile.TemporaryDirectory() as folder, (Path(folder) / "log").open("wb") as log:
        port, home = 20_000 + os.getpid() % 20_000, Path(folder) / "home"
        page = f"http{'s' if tls else ''}://127.0.0.1:{port}/"
        known = [secrets.token_bytes(32) for _ in range(1 + OBSERVERS * tls)]
        for n, secret in enumerate(known if tls else ()):
            KeyHome(home).clients.allow_key(f"browser-{n}", encode_key(hashlib.sha256(secret).digest()), kind="web")
        server = subprocess.Popen(
            [
                *(sys.executable, "-m", "iris_session.cli.main", "serve", "handover", "--no-record", "--no-beacon"),
                *("--control-port", "0", "--state-port", "0", "--web-port", str(port), *["--curve"][: int(tls)]),
            ],
            stdout=subprocess.DEVNULL,
            stderr=log,
            env={**os.environ, "IRIS_HOME": str(home)},
        )
        try:
            wait_for_page(server, page)
            gateway, rows = find_gateway(server), []
            base_mib = gateway.memory_info().rss / MIB
            for kind in cases:
                has_rates = kind == TLS + HELLOS or kind.removeprefix(TLS).removeprefix(OBSERVER) in FRAMES
                for bytes_per_s in RATES if has_rates else RATES[:1]:
                    try:
                        rows.append(asyncio.run(run_case(kind, page, known, bytes_per_s, seconds)))
                    except (NotWelcomedError, TimeoutError, OSError, aiohttp.ClientError) as error:
                        rows.append({"case": kind, "is_open": False, "ok": False, "fault": repr(error)})
                    rows[-1]["grown_mib"] = round(read_memory_mib(gateway) - base_mib, 1)
                    print(f"hostile_web: {rows[-1]}", file=sys.stderr, flush=True)
            until = time.monotonic() + SETTLE_S
            while (kept_mib := read_memory_mib(gateway) - base_mib) > MEMORY_MIB and time.monotonic() < until:
                time.sleep(0.5)
            return rows, kept_mib, (Path(folder) / "log").read_bytes().count(b"\n")
        finally:
            server.send_signal(signal.SIGINT)
            server.wait(60.0)


def format_table(figures: dict[str, Any]) -> str:
    """Return the figures of `run` as the Markdown table of docs/evidence/hostile.md."""
    columns = list(figures["cases"][0])
    rows = ["| " + " | ".join(str(row.get(column, "")) for column in columns) + " |" for row in figures["cases"]]
    head = [f"| {' | '.join(columns)} |", f"{'|---' * len(columns)}|"]
    return "\n".join(
        [*head, *rows, f"the gateway keeps {figures['kept_mib']} MiB, the log has {figures['log_lines']} lines"]
    )


def main() -> int:
    """Run the tool. Return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.add_argument("--quick", action="store_true", help="3 s a measurement instead of 10")
    parser.add_argument("--case", action="append", choices=CASES, help="run this case only; may be repeated")
    parser.add_argument("--attack", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.attack:
        kind, port, bytes_per_s, known = options.attack
        tls = make_trusting_context() if kind.startswith(TLS) else None
        observers = [bytes.fromhex(known[at : at + 64]) for at in range(0, len(known), 64)]
        victim = Victim("127.0.0.1", int(port), tls, observers)
        asyncio.run(attack(kind, victim, float(bytes_per_s)))
        return 0
    if not (ROOT / "iris_session/web/page/index.html").is_file():
        parser.error("there is no page, which attackers request: make web")
    figures = run(options.case or list(CASES), 3.0 if options.quick else 10.0)
    if options.json:
        print(json.dumps(figures))
    else:
        print(format_table(figures))
    return 0 if figures["ok"] else 1


if __name__ == "__main__":
    sys.exit(main())
