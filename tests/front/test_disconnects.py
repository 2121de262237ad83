"""The end of connections, with real TCP connections and a scripted monitor."""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Iterator

import pytest
import zmq

from iris_session.front.admission import Admission
from iris_session.front.connections import FrontConnection, Peer, Route
from iris_session.front.disconnects import LAST_MESSAGES_NS, DisconnectHandler
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.codec import decode_server
from iris_session.protocol.entries import Lost
from iris_session.protocol.server_messages import Message, ProtocolFault
from tests.front.fakes import make_alignment, make_context, make_status


class DisconnectRig:
    """A disconnect handler for connections whose TCP ends are ours."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self.now_ns = 0
        self.sent: list[Message] = []
        front = make_context(self, lambda: self.now_ns)
        self.drops, self.clients, self.coalescer = front.drops, front.connections, front.coalescer
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.monitor, near = context.socket(zmq.PAIR), context.socket(zmq.PAIR)
        self.monitor.bind("inproc://monitor")
        near.connect("inproc://monitor")
        self._near = near
        self.open: list[socket.socket] = [self.listener]
        alignment = make_alignment(front)
        self.disconnects = DisconnectHandler(
            front, near, Admission(front, ()), make_status(front, alignment), alignment
        )

    def send_multipart(self, frames: list[bytes], _flags: int) -> None:
        self.sent.append(decode_server(frames[1]).message)

    def join(self, number: int, behind: FrontConnection | None = None) -> tuple[FrontConnection, socket.socket]:
        """Join over a new TCP connection, whose end at the front is ours in place of libzmq's."""
        if behind is not None:
            connection = FrontConnection(
                number, Route(b"1", f"tab{number}"), behind.peer, behind.address, "key", HELLO, behind.number
            )
            self.clients.add(connection)
            return connection, self.open[-1]
        peer = socket.create_connection(self.listener.getsockname())
        ours, address = self.listener.accept()
        self.open += [peer, ours]
        connection = FrontConnection(number, Route(b"%d" % number), Peer(ours.fileno(), ""), address, "key", HELLO, 0)
        self.clients.add(connection)
        return connection, ours

    def report_closed(self, descriptor: int) -> None:
        self.monitor.send_multipart([struct.pack("=HI", zmq.EVENT_DISCONNECTED, descriptor), b"tcp://127.0.0.1:1"])
        self.disconnects.drain_monitor()

    def leave(self) -> list[tuple[int, object]]:
        self.disconnects.process_disconnects([], drained=True)
        return [(e.connection, e.message) for e in self.coalescer.take_batch()]

    def close(self) -> None:
        self.monitor.close()
        self._near.close()
        for one in self.open:
            one.close()


HELLO = Hello("operator", "Ann")


@pytest.fixture
def rig() -> Iterator[DisconnectRig]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    one = DisconnectRig(context)
    yield one
    one.close()
    context.destroy(linger=0)


def test_connection_that_reuses_a_descriptor_stays(rig: DisconnectRig) -> None:
    first, ours = rig.join(1)
    descriptor = ours.fileno()
    ours.close()
    assert os.open(os.devnull, os.O_RDONLY) == descriptor  # kept free for the next
    second, theirs = rig.join(2)
    os.dup2(theirs.fileno(), descriptor)  # as if accepted right there
    second.peer = Peer(descriptor, "")
    rig.report_closed(descriptor)
    assert rig.leave() == [(1, Lost("closed"))]
    rig.now_ns = 2 * LAST_MESSAGES_NS
    assert rig.leave() == []
    assert list(rig.clients.by_number) == [2]
    assert first.number == 1
    os.close(descriptor)


def test_report_before_the_descriptor_is_closed_is_processed_later(rig: DisconnectRig) -> None:
    _, ours = rig.join(1)
    rig.report_closed(ours.fileno())
    assert rig.leave() == []
    ours.close()
    assert rig.leave() == [(1, Lost("closed"))]


def test_participants_of_a_closed_gateway_are_disconnected_and_notified(rig: DisconnectRig) -> None:
    gateway, _ = rig.join(1)
    rig.join(2, behind=gateway)
    rig.join(3)
    rig.disconnects.remove(gateway, "heartbeat")
    assert [(e.connection, e.message) for e in rig.coalescer.take_batch()] == [(2, Lost("gateway"))]
    assert list(rig.clients.by_number) == [3]
    (fault,) = rig.sent
    assert isinstance(fault, ProtocolFault)
    assert (fault.code, fault.reason) == ("dropped", "gateway")


@pytest.mark.parametrize(("reason", "stops"), [("heartbeat", True), ("removed", False), ("bye", False)])
def test_only_silent_clients_may_send_an_estop_after_their_end(rig: DisconnectRig, reason: str, stops: bool) -> None:
    connection, ours = rig.join(1)
    rig.disconnects.remove(connection, reason)
    assert (rig.clients.find_kept(connection.route, connection.peer) is connection) is stops
    descriptor = ours.fileno()
    ours.close()
    rig.report_closed(descriptor)
    rig.leave()
    assert rig.clients.find_kept(connection.route, connection.peer) is None
