"""The impairment proxy: no loss on TCP, back-pressure, rate, datagrams, in simulated time; and as a process."""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from iris_session.netsim import proxy
from iris_session.netsim.process import ImpairmentError, ImpairmentProcess
from iris_session.netsim.profiles import UP, Direction, Profile, ProfilePhase
from iris_session.netsim.proxy import CHUNK, DatagramPort, ImpairedLink, _Pipe
from tests.loopback import make_loopback_address
from tests.rig.simulation import Simulation

MS = 1_000_000
DEADLINE_S = 60.0
#: Addresses of links that no other test uses, and of a roaming client.
LINK, OTHER_LINK, ROAMED = (make_loopback_address() for _ in range(3))


class Loop:
    """The proxy's event loop, in simulated time."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.readers: dict[int, Callable[[], None]] = {}
        self.writers: dict[int, Callable[[], None]] = {}

    def call_at(self, at_s: float, event: Callable[[], None]) -> Any:
        timer = SimpleNamespace(is_due=True)
        timer.cancel = lambda: setattr(timer, "is_due", False)
        at_ns = -(-round(at_s * 1e10) // 10)
        self.simulation.call_at(at_ns, lambda: event() if timer.is_due else None)
        return timer

    def call_later(self, delay_s: float, event: Callable[[], None]) -> Any:
        return self.call_at(self.simulation.now_ns * 1e-9 + delay_s, event)

    def add_reader(self, descriptor: int, on_readable: Callable[..., None], *arguments: Any) -> None:
        self.readers[descriptor] = lambda: on_readable(*arguments)

    def remove_reader(self, descriptor: int) -> None:
        self.readers.pop(descriptor, None)

    def add_writer(self, descriptor: int, on_writable: Callable[[], None]) -> None:
        self.writers[descriptor] = on_writable

    def remove_writer(self, descriptor: int) -> None:
        self.writers.pop(descriptor, None)


class End:
    """A socket of the proxy: what comes in is read, what goes out is kept with its time."""

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self.incoming: deque[Any] = deque()
        self.sent: list[tuple[int, bytes]] = []
        self.room = 1 << 30

    def feed(self, data: Any) -> None:
        """Let data come in; the proxy reads as much as it wants."""
        self.incoming.append(data)
        self.read()

    def read(self) -> None:
        while self.incoming and id(self) in self._loop.readers:
            self._loop.readers[id(self)]()

    def fileno(self) -> int:
        return id(self)

    def recv(self, size: int) -> bytes:
        data: bytes = self.incoming.popleft()
        if data[size:]:
            self.incoming.appendleft(data[size:])
        return data[:size]

    def recvfrom(self, size: int) -> tuple[bytes, tuple[str, int]]:
        return self.incoming.popleft(), ("127.0.0.9", 5000)

    def send(self, data: bytes) -> int:
        taken = min(len(data), self.room)
        if not taken:
            raise BlockingIOError
        self.room -= taken
        self.sent.append((self._loop.simulation.now_ns, data[:taken]))
        return taken

    def shutdown(self, _: int) -> None:
        self.sent.append((self._loop.simulation.now_ns, b""))

    def bind(self, *_: Any) -> None: ...

    connect = bind

    @property
    def bytes_sent(self) -> bytes:
        return b"".join(data for _, data in self.sent)


@pytest.fixture
def loop(monkeypatch: pytest.MonkeyPatch) -> Loop:
    simulation = Simulation(1)
    loop = Loop(simulation)
    monkeypatch.setattr(asyncio, "get_running_loop", lambda: loop)
    monkeypatch.setattr(proxy, "time", SimpleNamespace(monotonic_ns=lambda: simulation.now_ns))
    return loop


class Lane:
    """One direction of a TCP connection over a link."""

    def __init__(self, loop: Loop, link: ImpairedLink) -> None:
        self.source, self.sink = End(loop), End(loop)
        self.simulation = loop.simulation
        connection: Any = SimpleNamespace(link=link, on_pipe_ended=lambda: None)
        self.pipe = _Pipe(connection, UP, self.source, self.sink)  # type: ignore[arg-type]

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 1000)):
            self.simulation.run(self.simulation.now_ns + MS)
            self.source.read()


def make_link(loop: Loop, **phase: Any) -> ImpairedLink:
    profile = Profile(phases=(ProfilePhase(**phase),), window_kib=64)
    return ImpairedLink(LINK, "127.0.0.1", profile, 1)


def test_bytes_arrive_complete_in_order_and_not_early(loop: Loop) -> None:
    even = Lane(loop, make_link(loop, delay_ms=30.0))
    begin_ns = loop.simulation.now_ns
    even.source.feed(b"ping")
    even.run(0.1)
    assert even.sink.sent == [(begin_ns + 30 * MS, b"ping")]
    wild = Lane(loop, make_link(loop, delay_ms=15.0, jitter_ms=10.0, stall_every_s=0.2, stall_s=0.03))
    payload = random.Random(1).randbytes(400_000)
    begin_ns = loop.simulation.now_ns
    for at in range(0, len(payload), 10_000):
        wild.source.feed(payload[at : at + 10_000])
        wild.run(0.005)
    wild.source.feed(b"")
    wild.run(2.0)
    assert wild.sink.bytes_sent == payload
    assert wild.sink.sent[0][0] - begin_ns >= 5 * MS
    assert wild.sink.sent[-1][1] == b"", "the end arrives last"
    assert wild.pipe.ended


def test_stall_holds_the_sender_back_and_loses_nothing(loop: Loop) -> None:
    link = make_link(loop)
    path = Lane(loop, link)
    link.stalled_by_command = True
    link.update_stalls()
    payload = random.Random(2).randbytes(1_000_000)
    path.source.feed(payload)
    path.run(1.0)
    assert path.sink.sent == []
    assert path.pipe.size == 64 * 1024
    assert len(path.source.incoming[0]) == len(payload) - 64 * 1024, "the rest stays with the sender"
    path.sink.room = 300_000  # of the receiver, who reads slowly
    link.stalled_by_command = False
    link.update_stalls()
    path.run(1.0)
    assert len(path.sink.bytes_sent) == 300_000
    path.sink.room = 1 << 30
    loop.writers[path.sink.fileno()]()
    path.run(1.0)
    assert path.sink.bytes_sent == payload
    assert link.bytes[UP] == len(payload)


def test_rate_is_shared_by_all_connections_of_a_link(loop: Loop) -> None:
    """2 Mbit/s: 125 kB take half a second over any number of connections."""
    link = make_link(loop, up=Direction(rate_mbit=2.0))
    paths = [Lane(loop, link), Lane(loop, link)]
    begin_ns = loop.simulation.now_ns
    for path in paths:
        path.source.feed(bytes(62_500))
    for _ in range(100):
        for path in paths:
            path.run(0.01)
    assert [len(path.sink.bytes_sent) for path in paths] == [62_500, 62_500]
    last_ns = max(path.sink.sent[-1][0] for path in paths) - begin_ns
    assert 500 * MS <= last_ns <= 500 * MS + CHUNK * 8 / 2e6 * 1e9


def test_datagrams_are_lost_duplicated_and_reordered(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    def pass_through(seed: int, n: int = 1000) -> list[int]:
        opened: list[End] = []

        def open_socket(_: str) -> End:
            opened.append(End(loop))
            return opened[-1]

        monkeypatch.setattr(proxy, "_open_socket", open_socket)
        phase = ProfilePhase(loss=0.2, duplicate=0.2, reorder=0.1, reorder_ms=30.0)
        port = DatagramPort(ImpairedLink(LINK, "127.0.0.1", Profile(phases=(phase,)), seed), 7720)
        for number in range(n):
            opened[0].feed(struct.pack("<I", number))
            loop.simulation.run(loop.simulation.now_ns + MS // 2)
        loop.simulation.run(loop.simulation.now_ns + 100 * MS)
        got = [struct.unpack("<I", data)[0] for _, data in opened[1].sent]
        assert len(set(got)) + port.lost == n
        assert len(got) == n - port.lost + port.duplicated
        return got

    got = pass_through(3)
    assert len(set(got)) == pytest.approx(800, abs=40)
    assert len(got) / len(set(got)) == pytest.approx(1.2, abs=0.04)
    assert got != sorted(got)
    assert got == pass_through(3), "the fate of each datagram is its seed's and number's"
    assert got != pass_through(4)


# --- the process, with sockets of the system --------------------------------------------------------------------------


class Echo:
    """A server that returns all bytes and records how connections ended."""

    def __init__(self) -> None:
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listening.getsockname()[1]
        self.ends: list[str] = []
        self.peers: list[str] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            try:
                connection, peer = self._listening.accept()
            except OSError:
                return
            self.peers.append(peer[0])
            threading.Thread(target=self._echo, args=(connection,), daemon=True).start()

    def _echo(self, connection: socket.socket) -> None:
        with connection:
            while True:
                try:
                    data = connection.recv(65536)
                    if not data:
                        self.ends.append("closed")
                        return
                    connection.sendall(data)
                except OSError:
                    self.ends.append("reset")
                    return

    def close(self) -> None:
        self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()


@pytest.fixture
def echo() -> Iterator[Echo]:
    echo = Echo()
    yield echo
    echo.close()


def _connect(host: str, port: int) -> socket.socket:
    connection = socket.create_connection((host, port), timeout=DEADLINE_S)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def _receive(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        part = connection.recv(65536)
        assert part, f"the connection ended after {len(data)} of {size} bytes"
        data += part
    return data


def _wait_until(condition: Any, what: str) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, f"not within {DEADLINE_S:g} s: {what}"
        time.sleep(0.005)


def _echo(connection: socket.socket, data: bytes = b"x") -> None:
    connection.sendall(data)
    assert _receive(connection, len(data)) == data


@pytest.mark.e2e
def test_connections_over_a_proxy_are_stalled_cut_reset_and_roam(echo: Echo) -> None:
    with pytest.raises(ImpairmentError, match=r"127\.0\.0\.1"):
        ImpairmentProcess({"127.0.0.1": "none"}, [echo.port])
    with ImpairmentProcess({LINK: "none", OTHER_LINK: "30ms"}, [echo.port]) as proxy:
        with _connect(LINK, echo.port) as hit, _connect(OTHER_LINK, echo.port) as spared:
            _echo(hit, random.Random(1).randbytes(400_000))
            begin = time.monotonic()
            _echo(spared)
            assert time.monotonic() - begin >= 0.030
            proxy.execute(f"stall @{LINK}")
            hit.sendall(b"later")
            hit.setblocking(False)
            _echo(spared)
            with pytest.raises(BlockingIOError):
                hit.recv(1)
            proxy.execute(f"resume @{LINK}")
            hit.settimeout(DEADLINE_S)
            assert _receive(hit, 5) == b"later"
            stats = {link["link"]: link for link in proxy.execute("stats")["links"]}
            assert (stats[LINK]["bytes_up"], stats[OTHER_LINK]["bytes_up"]) == (400_005, 2)
            proxy.execute(f"cut @{LINK}")
            assert hit.recv(1) == b""
            _wait_until(lambda: echo.ends == ["closed"], "the server sees an orderly end")
            _echo(spared)
        _wait_until(lambda: len(echo.ends) == 2, "the other one has ended")
        with _connect(LINK, echo.port) as hit:  # the link accepts the next connection
            _echo(hit)
            proxy.execute(f"reset @{LINK}")
            with pytest.raises(ConnectionResetError):
                hit.recv(1)
            _wait_until(lambda: echo.ends[2:] == ["reset"], "the server sees it, too")
        with _connect(LINK, echo.port) as left:
            _echo(left)
            proxy.execute(f"roam {ROAMED}")
            with pytest.raises(ConnectionResetError):
                left.recv(1)
        with _connect(LINK, echo.port) as again:
            _echo(again)
            assert echo.peers[-1] == ROAMED
            assert len(echo.ends) == 3, "for the server the old connection is open"


@pytest.mark.e2e
def test_proxy_forwards_datagrams_refuses_what_it_cannot_do_and_ends_with_its_parent(tmp_path: Path) -> None:
    with contextlib.ExitStack() as stack:
        closed = stack.enter_context(socket.socket())
        closed.bind(("127.0.0.1", 0))  # without listening: no other process gets the port
        port = closed.getsockname()[1]
        server = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        server.bind(("127.0.0.1", port))
        proxy = stack.enter_context(ImpairmentProcess({LINK: "none"}, [port], udp=[port]))
        client = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        client.connect((LINK, port))
        for one in (server, client):
            one.settimeout(DEADLINE_S)
        client.send(b"up")
        data, peer = server.recvfrom(100)
        server.sendto(b"down", peer)
        assert (data, client.recv(100)) == (b"up", b"down")
        with pytest.raises(ConnectionResetError), _connect(LINK, port) as connection:  # at once, or at first use
            connection.recv(1)
        for command, value in (("explode", "stall"), (f"stall @{ROAMED}", LINK), ("profile nice-wifi", "nice-wifi")):
            with pytest.raises(ImpairmentError, match=value):
                proxy.execute(command)
        proxy.execute("profile 20ms")
    with pytest.raises(ImpairmentError, match="nice-wifi"):
        ImpairmentProcess({LINK: "nice-wifi"}, [port])
    command_line = [sys.executable, "-m", "iris_session.netsim.process", "--ports", str(port), "--link", LINK]
    with subprocess.Popen([*command_line, "--until-eof"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        assert json.loads(process.stdout.readline())["ready"] == [LINK]
        process.stdin.close()
        assert process.wait(DEADLINE_S) == 0
