"""Beacons from any sender, introductions from any host, and names of hosts."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Generator, Iterator
from typing import Any

import msgspec
import pytest

from iris_session.client import ClientError, FoundSession, discovery, find_sessions
from iris_session.client.discovery import request_introduction, resolve_host
from iris_session.link.discovery import MAX_ADDRESSES, MAX_SESSIONS, BeaconListener
from iris_session.protocol.codec import encode_beacon, encode_introduction
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.errors import ProtocolError

BEACON = Beacon(1, "s1", "lab-1", "live", "127.0.0.1", 7721, 7722, 0, 0, 0, "mark")


@pytest.fixture
def listener() -> Iterator[tuple[BeaconListener, Callable[[bytes], None]]]:
    """A listener on its own port, and a function to send to it."""
    with BeaconListener(0) as listener, contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender:
        port = listener._socket.getsockname()[1]
        yield listener, lambda data: sender.sendto(data, ("127.0.0.1", port)) and None


def other_session(**fields: object) -> bytes:
    return encode_beacon(msgspec.structs.replace(BEACON, **fields))


def test_sessions_are_identified_by_id_not_by_name(listener: tuple[BeaconListener, Callable[[bytes], None]]) -> None:
    listener, send = listener
    send(other_session())
    send(other_session())
    send(other_session(host="10.0.0.5"))
    send(other_session(session_id="s2", host="10.0.0.6"))
    send(other_session(session_id="s0", session_name="z"))
    assert listener.poll_sessions() == [
        FoundSession("lab-1", "127.0.0.1:7721", "s1", "live", "mark", ("127.0.0.1:7721", "10.0.0.5:7721")),
        FoundSession("lab-1", "10.0.0.6:7721", "s2", "live", "mark", ("10.0.0.6:7721",)),
        FoundSession("z", "127.0.0.1:7721", "s0", "live", "mark", ("127.0.0.1:7721",)),
    ]


def test_hostile_beacons_are_bounded_and_counted(listener: tuple[BeaconListener, Callable[[bytes], None]]) -> None:
    listener, send = listener
    for odd in ({"session_name": "\x1b[2J"}, {"control": 0}, {"control": 1 << 40}, {"host": "a b"}, {"session_id": ""}):
        send(other_session(**odd))
    for host in ("a..b", "-", "x" * 65):
        send(other_session(host=host))
    for data in (b"", b"junk", b"\xff" * 2000, other_session(protocol=2), msgspec.msgpack.encode({"protocol": 1})):
        send(data)
    for number in range(MAX_SESSIONS + 7):
        send(other_session(session_id=f"x{number}"))
        listener.poll_sessions()
    for number in range(MAX_ADDRESSES + 3):
        send(other_session(session_id="x0", host=f"10.0.0.{number}"))
    found = listener.poll_sessions()
    assert len(found) == MAX_SESSIONS
    assert max(len(one.addresses) for one in found) == MAX_ADDRESSES
    assert listener.ignored == {"malformed": 12, "other_version": 1, "too_many": 7}


def test_foreign_beacon_cannot_redirect_to_a_local_port() -> None:
    with BeaconListener(0) as listener:
        listener._process_datagram(other_session(host="127.0.0.1"), "10.0.0.9")
        listener._process_datagram(other_session(host="::1"), "10.0.0.9")
        assert listener.poll_sessions() == []
        assert listener.ignored == {"foreign_loopback": 2}


def test_unavailable_port_is_an_error() -> None:
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as greedy:
        greedy.bind(("", 0))  # without sharing it
        with pytest.raises(ClientError):
            find_sessions(0.1, port=greedy.getsockname()[1])


class Host:
    """A TCP server that sends `data` in pieces to every connection, then closes it or not."""

    def __init__(self, *pieces: bytes, close: bool = True) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.control_port = self._server.getsockname()[1] + 1
        self._pieces, self._close = pieces, close
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        connection, _ = self._server.accept()
        with connection:
            for piece in self._pieces:
                connection.sendall(piece)
                time.sleep(0.002)
            if not self._close:
                self._end.wait(60.0)

    def __enter__(self) -> Host:
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()
        self._server.close()


def ask(host: str, port: int, timeout_s: float = 30.0) -> Introduction:
    return end(request_introduction(host, port, timeout_s))


def end(steps: Generator[None, None, Any]) -> Any:
    """Take steps until there is a result."""
    while True:
        try:
            next(steps)
        except StopIteration as done:
            return done.value
        time.sleep(0.001)


def test_introduction_in_pieces_is_read() -> None:
    data = encode_introduction(Introduction(BEACON, "", False, 2))
    with Host(data[:3], data[3:10], data[10:], close=False) as host:
        assert ask("127.0.0.1", host.control_port) == Introduction(BEACON, "", False, 2)


@pytest.mark.parametrize(
    ("data", "error"),
    [
        (b"HTTP/1.1 200 OK\r\n\r\n", ProtocolError),  # its first bytes are too large a length
        ((5).to_bytes(4, "big") + b"junk!", ProtocolError),
        (encode_introduction(Introduction(BEACON)) + b"x", ProtocolError),
        (encode_introduction(Introduction(msgspec.structs.replace(BEACON, protocol=9))), ProtocolError),
        (b"\0\0", ConnectionError),
        (b"", ConnectionError),
    ],
)
def test_invalid_introductions_are_errors_at_once(data: bytes, error: type[Exception]) -> None:
    with Host(data) as host, pytest.raises(error):
        ask("127.0.0.1", host.control_port)


def test_closed_port_and_silence_time_out() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent, pytest.raises(TimeoutError):
        ask("127.0.0.1", silent.getsockname()[1] + 1, 0.01)
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # without listening: no other process gets the port
        with pytest.raises(ConnectionRefusedError):
            ask("127.0.0.1", closed.getsockname()[1] + 1)


def test_names_are_looked_up_without_blocking(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a name server that hangs all ask once, and a late answer serves the next attempt."""
    may_answer, asked = threading.Event(), []

    def getaddrinfo(host: str, *_: object) -> list[Any]:
        asked.append(host)
        assert may_answer.wait(30.0)
        if host == "unknown":
            raise socket.gaierror(socket.EAI_NONAME, "not known")
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("192.0.2.1", 0))]

    monkeypatch.setattr(discovery.socket, "getaddrinfo", getaddrinfo)
    until_s = time.monotonic() + 30.0
    assert [end(resolve_host(host, until_s)) for host in ("10.0.0.5", "::1")] == ["10.0.0.5", "::1"]
    assert asked == []
    first, second = resolve_host("lab", until_s), resolve_host("lab", until_s)
    for _ in range(5):
        next(first)  # would not return if it waited
        next(second)
    with pytest.raises(TimeoutError, match="name lab"):
        end(resolve_host("lab", 0.0))
    may_answer.set()
    assert end(first) == end(second) == "192.0.2.1"
    assert asked == ["lab"]
    for n in (1, 2):
        with pytest.raises(OSError, match="not known"):
            end(resolve_host("unknown", until_s))
        assert asked == ["lab", *["unknown"] * n], "and it is asked for again"
