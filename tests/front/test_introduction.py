"""The introduction: said to whoever connects, whatever they do, and on the port below the control port."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator

import pytest

from iris_session.front.introduction import ANSWERS_PER_TICK, IntroductionServer, open_listeners, open_with_introduction
from iris_session.link.config import FrontError, PortInUseError
from iris_session.protocol.codec import decode_introduction
from iris_session.protocol.discovery import Beacon, Introduction
from tests.front.harness import FrontSession

BEACON = Beacon(1, "s1", "lab-1", "live", "10.1.2.3", 7721, 7722, 0, 0, 0, "mark")


@pytest.fixture
def introducer() -> Iterator[tuple[IntroductionServer, int]]:
    listeners = open_listeners(["127.0.0.1"], 0)
    made = IntroductionServer(listeners, lambda: Introduction(BEACON, "k" * 40, True, 3))
    yield made, listeners[0].getsockname()[1]
    made.close()


def read(visitor: socket.socket) -> bytes:
    visitor.settimeout(5.0)
    data = b""
    while more := visitor.recv(4096):
        data += more
    return data


def test_everything_is_said_at_once_and_the_connection_closed(introducer: tuple[IntroductionServer, int]) -> None:
    service, port = introducer
    with socket.create_connection(("127.0.0.1", port)) as visitor:
        service.tick(0)
        data = read(visitor)
    introduction = decode_introduction(data)
    assert introduction == Introduction(BEACON, "k" * 40, True, 3)
    for length in range(len(data)):
        assert decode_introduction(data[:length]) is None


def test_a_turn_is_bounded_and_those_who_say_nothing_or_much_or_hang_up_hold_nothing(
    introducer: tuple[IntroductionServer, int],
) -> None:
    service, port = introducer
    visitors = [socket.create_connection(("127.0.0.1", port)) for _ in range(3 * ANSWERS_PER_TICK)]
    visitors[0].close()
    visitors[1].sendall(b"GET / HTTP/1.1\r\n" * 100)
    before = threading.active_count()
    service.tick(0)
    answered = [v for v in visitors[2:] if _has_data(v)]
    assert len(answered) == ANSWERS_PER_TICK - 2
    service.tick(1)
    service.tick(2)
    assert all(decode_introduction(read(v)) is not None for v in visitors[2:])
    assert threading.active_count() == before
    for visitor in visitors:
        visitor.close()


def test_two_neighbouring_free_ports_are_found() -> None:
    taken: list[int] = []

    def open_control(port: int) -> int:
        taken.append(port)
        if len(taken) < 4:
            raise PortInUseError(port, "control")
        return port

    control, listeners = open_with_introduction(["127.0.0.1"], 0, open_control)
    assert control == taken[3] == listeners[0].getsockname()[1] + 1
    for listener in listeners:
        listener.close()


def test_a_port_in_use_is_an_error_with_advice_and_frees_what_was_opened() -> None:
    with socket.create_server(("127.0.0.1", 0)) as occupied:
        port = occupied.getsockname()[1]
        with pytest.raises(PortInUseError, match=rf"port {port} \(introduction\) is in use .*another block of ports"):
            open_with_introduction(["127.0.0.1"], port + 1, lambda _: 0)
    with pytest.raises(PortInUseError):
        open_with_introduction(["127.0.0.1"], port + 1, _in_use)
    for listener in open_listeners(["127.0.0.1"], port):  # it was closed again
        listener.close()
    with pytest.raises(FrontError, match=r"cannot listen on 203\.0\.113\.9"):
        open_listeners(["203.0.113.9"], 0)


def test_a_front_introduces_itself_on_every_address_it_listens_on() -> None:
    session = FrontSession(listen=("127.0.0.1", "::1"), session_id="abc")
    try:
        assert session.ports.reachable == ("127.0.0.1", "::1")
        for host in ("127.0.0.1", "::1"):
            with socket.create_connection((host, session.ports.control - 1)) as visitor:
                introduction = decode_introduction(read(visitor))
            assert introduction is not None
            assert introduction.beacon.session_id == "abc"
            assert introduction.beacon.session_name == "test"
            assert (introduction.beacon.control, introduction.beacon.state) == (
                session.ports.control,
                session.ports.state,
            )
            assert (introduction.server_key, introduction.pairing, introduction.participants) == ("", False, 0)
    finally:
        session.close()


def _in_use(port: int) -> int:
    raise PortInUseError(port, "control")


def _has_data(visitor: socket.socket) -> bool:
    visitor.settimeout(0.05)
    try:
        return bool(visitor.recv(1, socket.MSG_PEEK))
    except TimeoutError:
        return False
