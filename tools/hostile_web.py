"""Attacks on the web gateway by peers without a key and by observers, while an honest browser drives and stops.

    python tools/hostile_web.py --json --quick
    python tools/hostile_web.py --case pings --case observer_pings

`tools/hostile.py` runs it too.

The session is `iris-session serve handover` on loopback, so that everything an attacker may send reaches the gateway
without TLS; attackers have the address of the honest browser. For each case, frames at 0.1 and at 5 MB/s, each e-stop
of the honest browser must reach the session and come back as an event within 200 ms, or three times what it takes
without the attack; its WebSocket must stay open, the gateway keep running. Afterwards the gateway gives back what it
took but for 50 MiB, and the log has grown by less than 100 lines. Prints progress to standard error, and as its last
line one JSON object with `--json`, else a table; exit status 0 if all is well.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import re
import secrets
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, Final

import aiohttp
import msgpack
import psutil

from iris_session.protocol.client_messages import (
    ClientMessage,
    EStop,
    GetSnapshot,
    Heartbeat,
    Hello,
    Sample,
    wrap_message,
)
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.common import IDENTITY
from iris_session.protocol.server_messages import EStopChanged, Event, Welcome
from iris_session.web import wire

MIB: Final = 1 << 20
START_S: Final = 90.0
#: Longest time for an e-stop to come back, and its share of that without the attack [ms].
STOP_MS: Final = 200.0
STOP_SHARE: Final = 3.0
LOST_S: Final = 5.0
STOP_PERIOD_S: Final = 0.3
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
#: An attack by one that the session has welcomed.
OBSERVER: Final = "observer_"
CASES: Final = (*FRAMES, *(OBSERVER + kind for kind in FRAMES), *OTHERS)
SAMPLE_S: Final = 1 / 72
#: Time in which memory is given back: who reads nothing is closed after 6 s, who requests nothing after 15.
SETTLE_S: Final = 25.0


# --- the honest browser -----------------------------------------------------------------------------------------------


class NotWelcomedError(Exception):
    """The session did not welcome the honest browser."""


class HonestBrowser:
    """A browser that joins, beats, drives, and stops."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket = socket
        self.epoch = 0
        self.stops = 0
        self._changed = asyncio.Event()

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
            if channel != wire.CONTROL:
                continue
            answer = decode_server(frames[0]).message
            if isinstance(answer, Welcome):
                self.epoch = answer.connection_epoch
            elif isinstance(answer, Event) and isinstance(answer.body, EStopChanged):
                self.stops += 1
            self._changed.set()

    async def beat(self) -> None:
        """Send heartbeats."""
        while not self.is_closed:
            await self.send(Heartbeat())
            await asyncio.sleep(0.3)

    async def drive(self) -> None:
        """Send the head and a hand as a headset does."""
        n = 0
        while not self.is_closed:
            n += 1
            for device in ("head", "controller/right"):
                await self.send(Sample(device, "pose", n, time.monotonic_ns(), 1, 0, 0, pose=IDENTITY))
            await asyncio.sleep(SAMPLE_S)

    async def wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Return whether a condition came true in time."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while not condition():
                    self._changed.clear()
                    await self._changed.wait()
        return condition()

    async def measure_stop(self) -> float:
        """Return the time from an e-stop to its event [ms], infinity for one that is lost."""
        before, began = self.stops, time.perf_counter()
        with contextlib.suppress(ConnectionError):
            await self.send(EStop())
            await self.wait(lambda: self.stops > before, LOST_S)
        return (time.perf_counter() - began) * 1e3 if self.stops > before else float("inf")


@contextlib.asynccontextmanager
async def open_honest(page: str) -> AsyncIterator[HonestBrowser]:
    """An honest browser that has joined as an operator."""
    async with (
        aiohttp.ClientSession() as http,
        http.ws_connect(f"{page}v1/session", protocols=[wire.SUBPROTOCOL], max_msg_size=0) as socket,
    ):
        browser = HonestBrowser(socket)
        reading = asyncio.create_task(browser.read())
        hello = Hello(
            "operator", "honest", secret=secrets.token_bytes(32), alignment="not_needed", devices=("desktop",)
        )
        await browser.send(hello)
        if not await browser.wait(lambda: browser.epoch > 0, 30.0):
            raise NotWelcomedError
        beating, driving = asyncio.create_task(browser.beat()), asyncio.create_task(browser.drive())
        try:
            yield browser
        finally:
            for task in (reading, beating, driving):
                task.cancel()


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


async def open_websocket(
    host: str, port: int, *, joins: bool
) -> tuple[asyncio.StreamReader, asyncio.StreamWriter, bytes, int]:
    """Open a WebSocket; with `joins` say hello as an observer, and wait for the ticket. Return that and the epoch of
    the connection, too."""
    reader, writer = await asyncio.open_connection(host, port, limit=8 * MIB)
    writer.write(make_request(host, port))
    await reader.readuntil(b"\r\n\r\n")
    ticket, epoch = b"", 0
    if joins:
        hello = Hello("observer", "mallory", secret=secrets.token_bytes(32), alignment="not_needed")
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


async def attack_with_frames(host: str, port: int, kind: str, bytes_per_s: float, *, joins: bool) -> None:
    """Send frames of one kind on one WebSocket after the other, each opened as soon as the last is cut."""
    frame = make_frame(*FRAMES[kind])
    begin = make_frame(0x02, 0) if kind == "fragments" else b""  # the message whose empty rest follows
    piece = frame * max(1, round(min(bytes_per_s * 0.02, 256e3) / len(frame)))
    while True:
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            reader, writer, _, _ = await open_websocket(host, port, joins=joins)
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


async def attack_with_handshakes(host: str, port: int) -> None:
    """Open a WebSocket and leave, a hundred times a second."""
    while True:
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            _, writer, _, _ = await open_websocket(host, port, joins=False)
            writer.close()
        await asyncio.sleep(0.01)


async def attack_with_assets(host: str, port: int) -> None:
    """Request assets that nobody serves, as fast as answers come, by one observer after the other."""
    while True:
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            _, writer, ticket, _ = await open_websocket(host, port, joins=True)
            reader, http = await asyncio.open_connection(host, port)
            for _ in range(5000):
                name = secrets.token_hex(32)
                head = f"GET /v1/asset/{name} HTTP/1.1\r\nHost: {host}:{port}\r\nX-Iris-Ticket: ".encode()
                http.write(head + ticket + b"\r\n\r\n")
                answer = await reader.readuntil(b"\r\n\r\n")
                if b" 401 " in answer:
                    break
                length = int(answer.lower().split(b"content-length: ")[1].split(b"\r")[0])
                await reader.readexactly(length)
            http.close()
            writer.close()
        await asyncio.sleep(0.02)


async def attack_by_reading_nothing(host: str, port: int) -> None:
    """Join, ask for snapshots, and read none of them nor any state."""
    held: list[asyncio.StreamWriter] = []
    while True:
        with contextlib.suppress(OSError, TimeoutError, asyncio.IncompleteReadError):
            reader, writer, _, epoch = await open_websocket(host, port, joins=True)
            reader._transport.pause_reading()  # type: ignore[attr-defined]
            frame = wire.encode_frames(wire.CONTROL, [encode_client(wrap_message(GetSnapshot(), epoch))])
            writer.write(8 * (struct.pack(">BB", 0x82, 0x80 | len(frame)) + bytes(4) + frame))
            held.append(writer)
        while len(held) > 30:
            held.pop(0).close()
        await asyncio.sleep(0.1)


async def attack_with_sockets(host: str, port: int, kind: str, n: int = 200) -> None:
    """Keep connections that say nothing (`half_open`), or that request the page's program and read nothing
    (`unread`)."""
    with urllib.request.urlopen(f"http://{host}:{port}/", timeout=5.0) as page:
        program = re.findall(rb"assets/[\w.-]+\.js", page.read())[0].decode()
    request = b"" if kind == "half_open" else f"GET /{program} HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode()
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


def attack(kind: str, host: str, port: int, bytes_per_s: float) -> None:
    """Attack until the process is ended."""
    base = kind.removeprefix(OBSERVER)
    if base in FRAMES:
        asyncio.run(attack_with_frames(host, port, base, bytes_per_s, joins=kind != base))
    elif kind == "handshakes":
        asyncio.run(attack_with_handshakes(host, port))
    elif kind == "observer_assets":
        asyncio.run(attack_with_assets(host, port))
    elif kind == "observer_unread":
        asyncio.run(attack_by_reading_nothing(host, port))
    else:
        asyncio.run(attack_with_sockets(host, port, kind))


# --- the lab ----------------------------------------------------------------------------------------------------------


async def measure(browser: HonestBrowser, seconds: float) -> list[float]:
    """Return the times of e-stops [ms]."""
    until, times_ms = time.monotonic() + seconds, []
    while time.monotonic() < until and not browser.is_closed:
        times_ms.append(await browser.measure_stop())
        await asyncio.sleep(STOP_PERIOD_S)
    return times_ms


async def count_lines(stream: asyncio.StreamReader) -> int:
    """Return the number of lines until the end: of an attacker, its connections."""
    n = 0
    while await stream.readline():
        n += 1
    return n


async def run_case(kind: str, port: int, bytes_per_s: float, seconds: float) -> dict[str, Any]:
    """Return what an honest browser has measured during an attack."""
    async with open_honest(f"http://127.0.0.1:{port}/") as browser:
        usual = await measure(browser, seconds)
        command = [sys.executable, __file__, "--attack", kind, str(port), str(bytes_per_s)]
        attacker = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE)
        try:
            assert attacker.stdout is not None
            async with asyncio.timeout(LOST_S):
                await attacker.stdout.readline()  # it is connected
            counting = asyncio.create_task(count_lines(attacker.stdout))
            times_ms = await measure(browser, seconds)
            is_open, is_attacking = not browser.is_closed, attacker.returncode is None
        finally:
            attacker.kill()
            await attacker.wait()
        n_connections = 1 + await counting
    slowest, n_lost = max(times_ms, default=float("inf")), times_ms.count(float("inf"))
    ok = is_open and is_attacking and slowest <= max(STOP_MS, STOP_SHARE * max(usual, default=0.0))
    row = {"case": kind, "mb_per_s": bytes_per_s / 1e6, "connections": n_connections}
    row |= {"stops": len(times_ms), "lost": n_lost}
    row |= {"usual_ms": round(max(usual, default=0.0), 1), "slowest_ms": None if n_lost else round(slowest, 1)}
    return {**row, "is_open": is_open, "ok": ok}


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


def wait_for_page(server: subprocess.Popen[bytes], port: int) -> None:
    """Wait until the gateway answers. Raises `SystemExit`."""
    until = time.monotonic() + START_S
    while time.monotonic() < until and server.poll() is None:
        with contextlib.suppress(OSError), urllib.request.urlopen(f"http://127.0.0.1:{port}/v1/info", timeout=5.0):
            return
        time.sleep(0.2)
    raise SystemExit("hostile_web: the session did not start")


def run(cases: list[str], seconds: float) -> dict[str, Any]:
    """Run cases against one session. Return the figures."""
    with tempfile.TemporaryDirectory() as folder, (Path(folder) / "log").open("wb") as log:
        port = 20_000 + os.getpid() % 20_000
        server = subprocess.Popen(
            [
                *(sys.executable, "-m", "iris_session.cli.main", "serve", "handover", "--no-record", "--no-beacon"),
                *("--control-port", "0", "--state-port", "0", "--web-port", str(port)),
            ],
            stdout=subprocess.DEVNULL,
            stderr=log,
            env={**os.environ, "IRIS_HOME": str(Path(folder) / "home")},
        )
        try:
            wait_for_page(server, port)
            gateway, rows = find_gateway(server), []
            base_mib = gateway.memory_info().rss / MIB
            for kind in cases:
                for bytes_per_s in RATES if kind.removeprefix(OBSERVER) in FRAMES else RATES[:1]:
                    try:
                        rows.append(asyncio.run(run_case(kind, port, bytes_per_s, seconds)))
                    except (NotWelcomedError, TimeoutError):
                        rows.append({"case": kind, "is_open": False, "ok": False})
                    rows[-1]["grown_mib"] = round(read_memory_mib(gateway) - base_mib, 1)
                    print(f"hostile_web: {rows[-1]}", file=sys.stderr, flush=True)
            until = time.monotonic() + SETTLE_S
            while (kept_mib := read_memory_mib(gateway) - base_mib) > MEMORY_MIB and time.monotonic() < until:
                time.sleep(0.5)
            n_lines = (Path(folder) / "log").read_bytes().count(b"\n")
        finally:
            server.send_signal(signal.SIGINT)
            server.wait(60.0)
    ok = all(row["ok"] for row in rows) and kept_mib <= MEMORY_MIB and n_lines < LOG_LINES
    return {"cases": rows, "kept_mib": round(kept_mib, 1), "log_lines": n_lines, "ok": ok}


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
    parser.add_argument("--attack", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.attack:
        kind, port, bytes_per_s = options.attack
        attack(kind, "127.0.0.1", int(port), float(bytes_per_s))
        return 0
    figures = run(options.case or list(CASES), 3.0 if options.quick else 10.0)
    if options.json:
        print(json.dumps(figures))
    else:
        print(format_table(figures))
    return 0 if figures["ok"] else 1


if __name__ == "__main__":
    sys.exit(main())
