"""The impairment proxy: conditions by seed, no loss on TCP, back-pressure, cut and reset, datagrams; one process."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from iris_session.netsim.process import ImpairmentError, ImpairmentProcess
from iris_session.netsim.profiles import (
    DOWN,
    PROFILES,
    UP,
    Direction,
    LinkConditions,
    Profile,
    ProfileError,
    ProfilePhase,
    load_profile,
    make_latency_profile,
)
from tests.loopback import make_loopback_address

SECOND = 1_000_000_000
MS = 1_000_000
DEADLINE_S = 20.0
#: Addresses of links that no other test uses, and of a roaming client.
LINK, OTHER_LINK, ROAMED = (make_loopback_address() for _ in range(3))


# --- conditions ---


def _series(seed: int, profile: str = "busy-wifi", direction: str = DOWN) -> list[tuple[int, bool]]:
    conditions = LinkConditions(load_profile(profile), seed)
    out = []
    for t in range(0, 60 * SECOND, 10 * MS):
        conditions.advance(t)
        out.append((conditions.compute_delay_ns(direction, t), conditions.is_stalled(direction, t)))
    return out


def test_conditions_are_a_function_of_seed_and_time() -> None:
    assert _series(1) == _series(1)
    assert _series(1) != _series(2)
    assert _series(1) != _series(1, direction=UP)
    conditions, sparse = (LinkConditions(PROFILES["busy-wifi"], 1) for _ in range(2))
    dense = {
        t: (conditions.compute_delay_ns(UP, t), conditions.is_stalled(UP, t)) for t in range(0, 20 * SECOND, 5 * MS)
    }
    for t in range(0, 20 * SECOND, 500 * MS):  # queried less often, the conditions are the same
        assert dense[t] == (sparse.compute_delay_ns(UP, t), sparse.is_stalled(UP, t))


def test_profiles_match_their_names() -> None:
    good, busy = _series(0, "good-wifi"), _series(0)
    assert 1.8 < sum(d for d, _ in good) / len(good) / MS < 2.2
    assert max(d for d, _ in good) < 8 * MS
    assert not any(stalled for _, stalled in good)
    assert sum(d > 40 * MS for d, _ in busy) > 10
    assert any(stalled for _, stalled in busy)
    assert all(d >= 0 for d, _ in busy)
    assert all(d == 0 for d, _ in _series(0, "none"))
    blackout = [stalled for _, stalled in _series(0, "blackout")]
    assert blackout == [1000 <= i < 1500 for i in range(6000)]


def test_phases_are_sequential_and_repeat() -> None:
    profile = Profile(
        phases=(
            ProfilePhase(seconds=1.0, delay_ms=1.0),
            ProfilePhase(seconds=2.0, delay_ms=5.0, at_start="cut", up=Direction(delay_ms=9.0, stalled=True)),
        ),
        repeat=True,
    )
    conditions = LinkConditions(profile)
    seen: list[tuple[int, str]] = []
    for t in range(0, 7 * SECOND, SECOND // 2):
        conditions.advance(t, lambda how, t=t: seen.append((t, how)))  # type: ignore[misc]
        late = t % (3 * SECOND) >= SECOND
        assert conditions.compute_delay_ns(DOWN, t) == (5 if late else 1) * MS
        assert conditions.compute_delay_ns(UP, t) == (9 if late else 1) * MS
        assert conditions.is_stalled(UP, t) is late
        assert not conditions.is_stalled(DOWN, t)
        assert conditions.find_next_change_ns(t) == t - t % (3 * SECOND) + (3 * SECOND if late else SECOND)
    assert seen == [(SECOND, "cut"), (4 * SECOND, "cut")]


def test_profiles_are_read_from_files(tmp_path: Path) -> None:
    toml = tmp_path / "lab.toml"
    toml.write_text(
        'repeat = true\n[[phases]]\nseconds = 30\ndelay_ms = 5\njitter_ms = 2\nup = {delay_ms = 9}\n'
        "[[phases]]\nseconds = 2\nstalled = true\n"
    )  # fmt: skip
    profile = load_profile(str(toml))
    assert profile.phases[0].get_direction(UP) == Direction(delay_ms=9.0)
    assert profile.phases[0].get_direction(DOWN).jitter_ms == 2.0
    file = tmp_path / "lab.json"
    file.write_text(json.dumps({"phases": [{"delay_ms": 30}], "window_kib": 1024}))
    assert load_profile(str(file)) == make_latency_profile(30.0) == load_profile("30ms")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("phases = []", "needs a phase"),
        ("[[phases]]\ndelay = 3", "unknown field `delay`"),
        ("[[phases]]\ndelay_ms = -1", "delay_ms -1.0"),
        ("[[phases]]\nloss = 2.0", "loss 2.0"),
        ('[[phases]]\nat_start = "burn"', "'cut' or 'reset'"),
        ("repeat = true\n[[phases]]\ndelay_ms = 3", "last phase"),
        ("window_kib = 1\n[[phases]]", "4 to 16384"),
        ("[[phases", "lab.toml"),
    ],
)
def test_invalid_profiles_are_rejected_with_reason(tmp_path: Path, text: str, expected: str) -> None:
    file = tmp_path / "lab.toml"
    file.write_text(text)
    with pytest.raises(ProfileError) as error:
        load_profile(str(file))
    assert expected in str(error.value)


def test_unknown_profile_lists_the_known() -> None:
    with pytest.raises(ProfileError, match=r"none, lan, .*40ms"):
        load_profile("nice-wifi")


# --- the process ---


class Echo:
    """A server that returns all bytes and records how connections ended."""

    def __init__(self) -> None:
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listening.getsockname()[1]
        self.ends: list[str] = []
        self.peers: list[str] = []
        self.reading = threading.Event()
        self.reading.set()
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
                self.reading.wait()
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


def _write_profile(tmp_path: Path, **phase: Any) -> str:
    path = tmp_path / f"profile{len(list(tmp_path.iterdir()))}.json"
    path.write_text(json.dumps({"phases": [phase], "window_kib": 64}))
    return str(path)


def test_bytes_arrive_complete_in_order_and_not_early(echo: Echo, tmp_path: Path) -> None:
    profile = _write_profile(tmp_path, delay_ms=15.0, jitter_ms=10.0, stall_every_s=0.2, stall_s=0.03)
    constant = _write_profile(tmp_path, delay_ms=30.0)
    with (
        ImpairmentProcess({LINK: profile, OTHER_LINK: constant}, [echo.port]) as proxy,
        _connect(LINK, echo.port) as wild,
        _connect(OTHER_LINK, echo.port) as even,
    ):
        payload = b"".join(struct.pack("<I", i) for i in range(100_000))
        sender = threading.Thread(target=wild.sendall, args=(payload,))
        sender.start()
        assert _receive(wild, len(payload)) == payload
        sender.join()
        for _ in range(5):
            begin = time.monotonic()
            even.sendall(b"ping")
            assert _receive(even, 4) == b"ping"
            assert time.monotonic() - begin >= 0.060  # both ways
        stats = {link["link"]: link for link in proxy.execute("stats")["links"]}
        assert stats[LINK]["bytes_up"] == stats[LINK]["bytes_down"] == len(payload)
        assert stats[OTHER_LINK]["bytes_up"] == 20
        wild.shutdown(socket.SHUT_WR)
        assert wild.recv(1) == b""  # the end arrives last, in both directions
        _wait_until(lambda: echo.ends == ["closed"], "the server sees an orderly end")


def test_stall_holds_the_sender_back_and_loses_nothing(echo: Echo) -> None:
    with (
        ImpairmentProcess({LINK: "none"}, [echo.port]) as proxy,
        _connect(LINK, echo.port) as connection,
    ):
        connection.sendall(b"before")
        assert _receive(connection, 6) == b"before"
        proxy.execute("stall")
        connection.setblocking(False)
        sent = 0
        with contextlib.suppress(BlockingIOError):
            while True:
                sent += connection.send(b"z" * 65536)
        held = proxy.execute(f"stats @{LINK}")["links"][0]["held_bytes"]
        assert 0 < held <= PROFILES["none"].window_kib * 1024
        assert sent < 32 * 2**20, "a stalled link must not swallow everything"
        with pytest.raises(BlockingIOError):
            connection.recv(1)
        proxy.execute("resume")
        connection.settimeout(DEADLINE_S)
        assert _receive(connection, sent) == b"z" * sent


def test_rate_is_limited(echo: Echo, tmp_path: Path) -> None:
    """2 Mbit/s up: 125 kB take half a second over any number of connections."""
    profile = _write_profile(tmp_path, up={"rate_mbit": 2.0})
    with (
        ImpairmentProcess({LINK: profile}, [echo.port]),
        _connect(LINK, echo.port) as one,
        _connect(LINK, echo.port) as two,
    ):
        begin = time.monotonic()
        senders = [threading.Thread(target=c.sendall, args=(b"r" * 62_500,)) for c in (one, two)]
        for sender in senders:
            sender.start()
        _receive(one, 62_500)
        _receive(two, 62_500)
        assert time.monotonic() - begin >= 0.49
        for sender in senders:
            sender.join()


@pytest.mark.parametrize(("command", "end"), [("cut", "closed"), ("reset", "reset")])
def test_cut_and_reset_end_connections(echo: Echo, command: str, end: str) -> None:
    with ImpairmentProcess({LINK: "none", OTHER_LINK: "none"}, [echo.port]) as proxy:
        hit, spared = _connect(LINK, echo.port), _connect(OTHER_LINK, echo.port)
        with hit, spared:
            for connection in (hit, spared):
                connection.sendall(b"x")
                _receive(connection, 1)
            proxy.execute(f"{command} @{LINK}")
            if command == "reset":
                with pytest.raises(ConnectionResetError):
                    hit.recv(1)
            else:
                assert hit.recv(1) == b""
            _wait_until(lambda: echo.ends == [end], f"the server's end is {end}")
            spared.sendall(b"y")
            assert _receive(spared, 1) == b"y"
            with _connect(LINK, echo.port) as again:  # the link accepts the next connection
                again.sendall(b"z")
                assert _receive(again, 1) == b"z"


def test_roaming_leaves_the_old_connection_open_at_the_server(echo: Echo) -> None:
    with (
        ImpairmentProcess({LINK: "none"}, [echo.port]) as proxy,
        _connect(LINK, echo.port) as connection,
    ):
        connection.sendall(b"x")
        _receive(connection, 1)
        proxy.execute(f"roam {ROAMED}")
        with pytest.raises(ConnectionResetError):
            connection.recv(1)
        with _connect(LINK, echo.port) as again:
            again.sendall(b"z")
            assert _receive(again, 1) == b"z"
            assert echo.peers == ["127.0.0.1", ROAMED]
            assert echo.ends == []


def test_connection_without_a_server_is_closed() -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # without listening: no other process gets the port
        port = closed.getsockname()[1]
        with (
            ImpairmentProcess({LINK: "none"}, [port]),
            pytest.raises(ConnectionResetError),  # at once, or at first use
            _connect(LINK, port) as connection,
        ):
            connection.recv(1)


DATAGRAMS = 150  # they fit into the server's socket, which is read at the end


def test_datagrams_are_lost_duplicated_and_reordered(tmp_path: Path) -> None:
    profile = _write_profile(tmp_path, loss=0.2, duplicate=0.2, reorder=0.1, reorder_ms=30.0)

    def pass_through(seed: int) -> list[int]:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
            server.bind(("127.0.0.1", 0))
            port = server.getsockname()[1]
            with (
                ImpairmentProcess({LINK: profile}, [], udp=[port], seed=seed) as proxy,
                socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client,
            ):
                client.connect((LINK, port))
                for i in range(DATAGRAMS):
                    client.send(struct.pack("<I", i))
                    time.sleep(0.0005)  # one by one, as from a sender with a rate
                server.settimeout(0.5)
                got: list[int] = []
                peer: Any = None

                def takes_no_more() -> bool:
                    nonlocal peer
                    with contextlib.suppress(TimeoutError):
                        while True:
                            data, peer = server.recvfrom(100)
                            got.append(struct.unpack("<I", data)[0])
                    lost: int = proxy.execute("stats")["links"][0]["datagrams_lost"]
                    return len(set(got)) + lost == DATAGRAMS

                _wait_until(takes_no_more, "each datagram has come or is lost")
                server.sendto(b"down", peer)  # the opposite direction finds its client
                client.settimeout(0.2)
                with contextlib.suppress(TimeoutError):  # it may be lost
                    assert client.recv(100) == b"down"
                return got

    got = pass_through(3)
    assert 0.1 < 1.0 - len(set(got)) / DATAGRAMS < 0.3
    assert 0.1 < (len(got) - len(set(got))) / len(set(got)) < 0.3
    assert got != sorted(got)
    assert sorted(got) == sorted(pass_through(3)), "the fate of each datagram is its seed's and number's"
    assert set(got) != set(pass_through(4))


def test_commands_and_errors(echo: Echo, tmp_path: Path) -> None:
    with ImpairmentProcess({LINK: "none"}, [echo.port]) as proxy:
        with pytest.raises(ImpairmentError, match="command: stall, resume"):
            proxy.execute("explode")
        with pytest.raises(ImpairmentError, match=f"{ROAMED}: .*{LINK}"):
            proxy.execute(f"stall @{ROAMED}")
        with pytest.raises(ImpairmentError, match="no profile"):
            proxy.execute("profile nice-wifi")
        proxy.execute(f"profile {_write_profile(tmp_path, delay_ms=20.0)}")
        with _connect(LINK, echo.port) as connection:
            begin = time.monotonic()
            connection.sendall(b"x")
            _receive(connection, 1)
            assert time.monotonic() - begin >= 0.040
    with pytest.raises(ImpairmentError, match="no profile 'nice-wifi'"):
        ImpairmentProcess({LINK: "nice-wifi"}, [echo.port])
    with pytest.raises(ImpairmentError, match=r"on 127\.0\.0\.1: .*127\.0\.0\.1 only"):
        ImpairmentProcess({"127.0.0.1": "none"}, [echo.port])


def test_proxy_ends_with_its_parent(echo: Echo) -> None:
    command = [sys.executable, "-m", "iris_session.netsim.process", "--ports", str(echo.port), "--link", LINK]
    with subprocess.Popen([*command, "--until-eof"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        assert json.loads(process.stdout.readline())["ready"] == [LINK]
        process.stdin.close()
        assert process.wait(DEADLINE_S) == 0
