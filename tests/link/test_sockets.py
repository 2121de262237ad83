"""Sockets of the front with real connections, and peers that do not read."""

from __future__ import annotations

import socket
import sys
import time
from contextlib import ExitStack

import pytest
import zmq

from iris_session.link import sockets
from iris_session.link.config import FrontConfig, FrontLimits
from iris_session.link.sockets import FILE_DESCRIPTORS, RESERVED_DESCRIPTORS, fit_limits, pace_tcp
from iris_session.protocol.server_messages import TOPIC_PRESENCE, TOPIC_RIGID, TOPIC_ROBOTS


def test_stalled_subscriber_is_cut_off_and_others_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Like a headset that has moved to another network, or sleeps while its kernel answers."""
    monkeypatch.setattr(sockets, "STUCK_MS", 1000)
    with ExitStack() as stack:
        context = stack.enter_context(zmq.Context())
        config = FrontConfig(control_port=0, state_port=0, origin_ns=0)
        state = stack.enter_context(sockets.open_state(context, config, None))
        monitor = stack.enter_context(sockets.watch_tcp(state, "test", zmq.EVENT_DISCONNECTED))
        reader = stack.enter_context(context.socket(zmq.SUB))
        stuck = stack.enter_context(context.socket(zmq.SUB))  # nobody reads it: libzmq stops reading, too
        stuck.rcvhwm, stuck.rcvbuf = 1, 4096
        for one in (reader, stuck):
            one.subscribe(b"")
            one.connect(f"tcp://127.0.0.1:{sockets.bound_port(state)}")
        state.linger = reader.linger = stuck.linger = 0
        deadline = time.monotonic() + 60.0
        got = 0
        while not sockets.readable(monitor):
            assert time.monotonic() < deadline, f"nobody was cut off; the other got {got} frames"
            state.send(b"r" + bytes(5000))
            got += len(_drain(reader))
            time.sleep(0.005)
        assert got > 0
        while b"last" not in _drain(reader):
            assert time.monotonic() < deadline, "the other one was cut off, too"
            state.send(b"last")
            time.sleep(0.005)


def _drain(reader: zmq.Socket[bytes]) -> list[bytes]:
    got = []
    while reader.poll(0):
        got.append(reader.recv())
    return got


def test_a_state_its_robots_and_presence_that_come_at_once_all_arrive() -> None:
    topics = [TOPIC_RIGID, TOPIC_ROBOTS, TOPIC_PRESENCE]
    with ExitStack() as stack:
        context = stack.enter_context(zmq.Context())
        state = stack.enter_context(sockets.open_state(context, FrontConfig(state_port=0), None))
        reader = stack.enter_context(context.socket(zmq.SUB))
        state.linger = reader.linger = 0
        reader.rcvhwm = 2
        reader.subscribe(b"")
        reader.connect(f"tcp://127.0.0.1:{sockets.bound_port(state)}")
        assert state.recv() == b"\x01", "it has subscribed"
        for _ in range(200):
            state.get(zmq.EVENTS)  # the time between two states: libzmq looks what was sent on
            for topic in topics:
                state.send(topic)
            for topic in topics:
                assert reader.poll(5000), f"{topic!r} was dropped"
                assert reader.recv() == topic


@pytest.mark.parametrize("descriptors", [64, 256, 1024, 4096, 8192, 1 << 20])
def test_limits_fit_into_the_descriptors_of_the_system(descriptors: int) -> None:
    limits = FrontLimits()
    fitted = fit_limits(limits, descriptors)
    assert fitted.connections == limits.connections
    assert (fitted is limits) == (descriptors >= FILE_DESCRIPTORS), "the limit that the front asks for is enough"
    if descriptors >= 1024:
        used = 5 * fitted.unauthenticated + 3 * fitted.subscribers + fitted.sources + fitted.connections
        assert used + RESERVED_DESCRIPTORS <= descriptors
    assert min(fitted.unauthenticated, fitted.subscribers, fitted.sources) > 0


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has SO_MAX_PACING_RATE")
def test_pace_is_set_for_the_peer_that_is_meant_and_lifted() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener, socket.create_connection(listener.getsockname()) as near:
        found = []
        for peer, pace in ((("127.0.0.1", 1), 1.0), (near.getpeername(), 1_000_000), (near.getpeername(), 0.0)):
            pace_tcp(near.fileno(), peer, pace)
            found.append(near.getsockopt(socket.SOL_SOCKET, 47))
    assert found == [-1, 1_000_000, -1], "SO_MAX_PACING_RATE"
