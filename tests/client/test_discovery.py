"""Hearing beacons of anybody, and asking for an introduction whatever answers."""

from __future__ import annotations

import contextlib
import fcntl
import resource
import socket
import threading
import time
from collections.abc import Callable, Iterator

import msgspec
import pytest

from iris_session.client import ClientError, FoundSession, find_sessions
from iris_session.client.discovery import request_introduction
from iris_session.link.discovery import MAX_ADDRESSES, MAX_SESSIONS, BeaconListener
from iris_session.protocol.codec import encode_beacon, encode_introduction
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.errors import ProtocolError

BEACON = Beacon(1, "s1", "lab-1", "live", "127.0.0.1", 7721, 7722, 0, 0, 0, "mark")


@pytest.fixture
def air() -> Iterator[tuple[BeaconListener, Callable[[bytes], None]]]:
    """A listener on a port of its own, and how to send to it."""
    with BeaconListener(0) as listener, contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender:
        port = listener._socket.getsockname()[1]
        yield listener, lambda data: sender.sendto(data, ("127.0.0.1", port)) and None


def other(**fields: object) -> bytes:
    return encode_beacon(msgspec.structs.replace(BEACON, **fields))


def test_sessions_are_told_apart_by_id_not_by_name(air: tuple[BeaconListener, Callable[[bytes], None]]) -> None:
    listener, send = air
    send(other())
    send(other())
    send(other(host="10.0.0.5"))
    send(other(session_id="s2", host="10.0.0.6"))
    send(other(session_id="s0", session_name="z"))
    assert listener.poll_sessions() == [
        FoundSession("lab-1", "127.0.0.1:7721", "s1", "live", "mark", ("127.0.0.1:7721", "10.0.0.5:7721")),
        FoundSession("lab-1", "10.0.0.6:7721", "s2", "live", "mark", ("10.0.0.6:7721",)),
        FoundSession("z", "127.0.0.1:7721", "s0", "live", "mark", ("127.0.0.1:7721",)),
    ]


def test_what_anybody_can_send_is_bounded_and_counted(air: tuple[BeaconListener, Callable[[bytes], None]]) -> None:
    listener, send = air
    for odd in ({"session_name": "\x1b[2J"}, {"control": 0}, {"control": 1 << 40}, {"host": "a b"}, {"session_id": ""}):
        send(other(**odd))
    for host in ("a..b", "-", "x" * 65):
        send(other(host=host))
    for data in (b"", b"junk", b"\xff" * 2000, other(protocol=2), msgspec.msgpack.encode({"protocol": 1})):
        send(data)
    for number in range(MAX_SESSIONS + 7):
        send(other(session_id=f"x{number}"))
        listener.poll_sessions()
    for number in range(MAX_ADDRESSES + 3):
        send(other(session_id="x0", host=f"10.0.0.{number}"))
    found = listener.poll_sessions()
    assert len(found) == MAX_SESSIONS
    assert max(len(one.addresses) for one in found) == MAX_ADDRESSES
    assert listener.ignored == {"malformed": 12, "other_version": 1, "too_many": 7}


def test_somebody_else_cannot_send_us_to_a_port_of_our_own() -> None:
    with BeaconListener(0) as listener:
        listener._process_datagram(other(host="127.0.0.1"), "10.0.0.9")
        listener._process_datagram(other(host="::1"), "10.0.0.9")
        assert listener.poll_sessions() == []
        assert listener.ignored == {"foreign_loopback": 2}


def test_sessions_are_found_by_a_process_with_a_thousand_open_files() -> None:
    wanted = 1100
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    assert hard == resource.RLIM_INFINITY or hard > wanted, "this test needs more open files"
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, wanted + 100), hard))
    with BeaconListener(0) as listener, contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender:
        port = listener._socket.getsockname()[1]
        high = fcntl.fcntl(listener._socket.fileno(), fcntl.F_DUPFD, wanted)
        listener._socket.close()
        listener._socket = socket.socket(fileno=high)
        sender.sendto(other(), ("127.0.0.1", port))
        listener.wait(30.0)
        assert [one.name for one in listener.poll_sessions()] == ["lab-1"]
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_port_that_cannot_be_listened_on_is_told() -> None:
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as greedy:
        greedy.bind(("", 0))  # without sharing it
        with pytest.raises(ClientError, match="type the session's address"):
            find_sessions(0.1, port=greedy.getsockname()[1])


class Host:
    """Somebody on a TCP port who says `data`, in pieces, to whoever comes; then closes, or not."""

    def __init__(self, *pieces: bytes, close: bool = True) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.control_port = self._server.getsockname()[1] + 1
        self._pieces, self._close = pieces, close
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        visitor, _ = self._server.accept()
        with visitor:
            for piece in self._pieces:
                visitor.sendall(piece)
                time.sleep(0.02)
            if not self._close:
                self._end.wait(10)

    def __enter__(self) -> Host:
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()
        self._server.close()


def ask(host: str, port: int, timeout_s: float = 5.0) -> Introduction:
    steps = request_introduction(host, port, timeout_s)
    while True:
        try:
            next(steps)
        except StopIteration as done:
            introduction: Introduction = done.value
            return introduction
        time.sleep(0.002)


def test_an_introduction_in_pieces() -> None:
    data = encode_introduction(Introduction(BEACON, "", False, 2))
    with Host(data[:3], data[3:10], data[10:], close=False) as host:
        assert ask("localhost", host.control_port) == Introduction(BEACON, "", False, 2)


@pytest.mark.parametrize(
    ("said", "error"),
    [
        (b"HTTP/1.1 200 OK\r\n\r\n", ProtocolError),  # its first bytes are too large a length
        ((5).to_bytes(4, "big") + b"junk!", ProtocolError),
        (encode_introduction(Introduction(BEACON)) + b"x", ProtocolError),
        (encode_introduction(Introduction(msgspec.structs.replace(BEACON, protocol=9))), ProtocolError),
        (b"\0\0", ConnectionError),
        (b"", ConnectionError),
    ],
)
def test_what_is_no_introduction_is_an_error_at_once(said: bytes, error: type[Exception]) -> None:
    with Host(said) as host, pytest.raises(error):
        ask("127.0.0.1", host.control_port)


def test_nobody_and_silence() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        with pytest.raises(TimeoutError):
            ask("127.0.0.1", silent.getsockname()[1] + 1, 0.2)
        port = silent.getsockname()[1] + 1
    with pytest.raises(ConnectionRefusedError):
        ask("127.0.0.1", port)
    with pytest.raises(OSError, match=r"not known|resolution"):
        ask("no-such-host.invalid", 7721)
