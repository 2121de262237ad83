"""Sockets of the front with real connections, and peers that do not read."""

from __future__ import annotations

import socket
import sys
import threading
import time
from contextlib import ExitStack

import pytest
import zmq

from iris_session.link import sockets
from iris_session.link.config import FrontConfig, FrontLimits
from iris_session.link.sockets import FILE_DESCRIPTORS, RESERVED_DESCRIPTORS, close_tcp, fit_limits, pace_tcp


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


@pytest.mark.parametrize("discard", [True, False])
def test_what_is_unread_of_a_connection_that_is_closed_is_discarded_on_request(discard: bool) -> None:
    with ExitStack() as stack:
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        theirs = stack.enter_context(socket.create_connection(listener.getsockname()))
        ours, peer = listener.accept()
        stack.enter_context(ours)
        theirs.sendall(bytes(1000))
        assert len(ours.recv(1000, socket.MSG_PEEK | socket.MSG_WAITALL)) == 1000
        assert close_tcp(ours.fileno(), peer, discard=discard)
        assert len(ours.recv(1000)) == (0 if discard else 1000)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has SO_MAX_PACING_RATE")
def test_paced_connection_sends_no_faster_until_the_limit_is_lifted() -> None:
    n_bytes = 1_000_000
    with ExitStack() as stack:
        listening = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        near = stack.enter_context(socket.create_connection(listening.getsockname()))
        far = stack.enter_context(listening.accept()[0])
        pace_tcp(near.fileno(), ("127.0.0.1", 1), 1.0)  # of a descriptor that is another's now
        for pace, shortest_s in ((1_000_000, 0.25), (0, 0.0)):  # the system sends ten segments of 64 KiB at once
            pace_tcp(near.fileno(), near.getpeername(), pace)
            sender = threading.Thread(target=near.sendall, args=(bytes(n_bytes),))
            began = time.monotonic()
            sender.start()
            left = n_bytes
            while left:
                left -= len(far.recv(left))
            assert time.monotonic() - began >= shortest_s
            sender.join()
        assert near.getsockopt(socket.SOL_SOCKET, 47) == -1, "SO_MAX_PACING_RATE, as it was"
