"""Peers that hold connections, talk nonsense, or replay: a real session goes on, and lets honest people in."""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path

import msgspec
import pytest
import zmq

from iris_session.client import Client
from iris_session.protocol.client_messages import ClockPing, Hello, wrap_message
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.server_messages import ClockPong, Message, ProtocolFault, Refused, Welcome
from tests.e2e.conftest import DEADLINE_S, Server, Stage
from tests.front.harness import FrontSession

pytestmark = pytest.mark.e2e
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)


def where(server: Server) -> tuple[str, int]:
    host, port = server.address.rsplit(":", 1)
    return host, int(port)


def hung_up(one: socket.socket) -> bool:
    one.setblocking(False)
    try:
        while one.recv(65536):
            pass
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


class Raw:
    """A DEALER that says what it is told to."""

    def __init__(self, server: Server) -> None:
        self.socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
        self.socket.linger = 0
        host, port = where(server)
        self.socket.connect(f"tcp://{host}:{port}")

    def said(self, kind: type[Message]) -> Message:
        """Waits for a message of a kind."""
        deadline = time.monotonic() + DEADLINE_S
        while time.monotonic() < deadline:
            if self.socket.poll(100):
                message = decode_server(self.socket.recv_multipart()[0]).message
                if isinstance(message, kind):
                    return message
        pytest.fail(f"no {kind.__name__}")

    def close(self) -> None:
        self.socket.close(linger=0)


def test_a_thousand_connections_without_hello(house: Server) -> None:
    with Client(house.address, role="observer", name="Eve").connect(DEADLINE_S) as eve:
        crowd = [socket.create_connection(where(house)) for _ in range(1000)]
        Client(house.address, role="observer", name="Ann").connect(DEADLINE_S).close()
        deadline = time.monotonic() + DEADLINE_S
        while not all(hung_up(one) for one in crowd):
            assert time.monotonic() < deadline, "the silent ones stay"
            eve.sleep(0.2)
        for one in crowd:
            one.close()
        assert eve.ready


def test_slow_talkers_and_half_greetings_are_closed(house: Server) -> None:
    with Client(house.address, role="observer").connect(DEADLINE_S) as eve:
        assert eve.connection.welcome is not None
        host, control = where(house)
        ports = (control, eve.connection.welcome.endpoints.state, control - 1)
        slow = [socket.create_connection((host, port)) for port in ports]
        half = [socket.create_connection((host, port)) for port in ports]
        for one in half:
            one.sendall(GREETING[:32])
        ends = set()
        deadline = time.monotonic() + DEADLINE_S
        at = 0
        while len(ends) < len(slow) + len(half):
            assert time.monotonic() < deadline
            for i, one in enumerate((*slow, *half)):
                if i not in ends and hung_up(one):
                    ends.add(i)
            for i, one in enumerate(slow):
                if i not in ends:
                    try:
                        one.send(GREETING[at % 64 : at % 64 + 1])
                    except OSError:
                        ends.add(i)
            at += 1
            eve.sleep(1.0)  # one byte a second
        for one in (*slow, *half):
            one.close()
        assert eve.ready


def test_nonsense_of_every_depth_is_answered(house: Server) -> None:
    raw = Raw(house)
    raw.socket.send(encode_client(wrap_message(Hello("observer", "Mallory", secret=os.urandom(16)))))
    raw.said(Welcome)
    deep = b"\x94\x01\x00\xa0" + b"\x91" * 30_000
    huge_map = b"\x94\x01\x00\xa0\x81\xa4type\xdf\xff\xff\xff\xff"
    many_keys = msgspec.msgpack.encode([1, 0, "", {"type": "heartbeat", **{f"key{i}": i for i in range(3000)}}])
    for data in (deep, huge_map, b"\x94\x01\x00\xa0" + b"\x81\xa1x" * 9000, b"\xdd\xff\xff\xff\xff", many_keys):
        raw.socket.send(data)
        fault = raw.said(ProtocolFault)
        assert isinstance(fault, ProtocolFault)
        assert fault.code in ("malformed", "too_large", "version")
    raw.close()
    Client(house.address, role="observer").connect(DEADLINE_S).close()


def test_a_replayed_hello_does_not_take_over(house: Server) -> None:
    secret = os.urandom(16)
    first = Raw(house)
    first.socket.send(encode_client(wrap_message(Hello("operator", "Ann", alignment="not_needed", secret=secret))))
    welcome = first.said(Welcome)
    assert isinstance(welcome, Welcome)
    first.close()
    back = encode_client(
        wrap_message(Hello("operator", "Ann", alignment="not_needed", secret=secret, resume_token=welcome.resume_token))
    )
    second = Raw(house)
    second.socket.send(back)
    again = second.said(Welcome)
    assert isinstance(again, Welcome)
    assert again.participant_id == welcome.participant_id
    second.socket.send(encode_client(wrap_message(ClockPing(1), again.connection_epoch)))  # its welcome has arrived
    second.said(ClockPong)
    replayed = Raw(house)
    replayed.socket.send(back)
    answer = replayed.said(Message)
    assert isinstance(answer, Refused)
    assert answer.code == "resume_token"
    for one in (second, replayed):
        one.close()


def test_a_hundred_subscribers_that_read_nothing(visit: Stage) -> None:
    stage = visit
    ann = stage.join("Ann", "observer")
    stage.run(lambda: ann.ready, "ready")
    welcome = ann.connection.welcome
    assert welcome is not None
    host, _ = where(stage.server)
    stuck = []
    for _ in range(100):
        one = socket.socket()
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        one.connect((host, welcome.endpoints.state))
        ready = b"\x05READY\x0bSocket-Type\x00\x00\x00\x03SUB"
        one.sendall(GREETING + b"\x04" + bytes((len(ready),)) + ready + b"\x00\x01\x01")
        stuck.append(one)
    before = ann.connection.stream.counters.delivered
    stage.run(lambda: ann.connection.stream.counters.delivered > before + 180, "three seconds of state")
    for one in stuck:
        one.close()


def test_garbage_in_an_encrypted_handshake(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir(mode=0o700)
    front = FrontSession(curve=True, key_home=str(home))
    try:
        curve = GREETING[:12] + b"CURVE".ljust(20, b"\0") + bytes(32)
        for size in (0, 1, 199, 200, 5000):
            for port in (front.ports.control, front.ports.state):
                with socket.create_connection(("127.0.0.1", port)) as one:
                    command = b"\x05HELLO\x01\x00" + os.urandom(size)
                    one.sendall(curve + b"\x06" + len(command).to_bytes(8, "big") + command)
                    front.pump(lambda one=one: hung_up(one), "the end of it")  # type: ignore[misc]
        assert front.process.alive
        with socket.create_connection(("127.0.0.1", front.ports.control)) as one:
            one.settimeout(10)
            assert one.recv(1) == b"\xff"
    finally:
        front.close()
