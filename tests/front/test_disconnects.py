"""How connections end, with real TCP connections and a monitor that says what it is told to."""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Iterator

import pytest
import zmq

from iris_session.alignment.service import AlignmentService
from iris_session.front.audit import AuditTrail
from iris_session.front.coalescer import Coalescer
from iris_session.front.connection_guard import ConnectionGuard
from iris_session.front.connections import ConnectionTable, FrontConnection, Outbox, Peer, Route
from iris_session.front.disconnects import LAST_WORDS_NS, DisconnectHandler
from iris_session.link.config import FrontLimits
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.codec import decode_server
from iris_session.protocol.entries import Lost
from iris_session.protocol.limits import Drops
from iris_session.protocol.server_messages import Message, ProtocolFault


class Door:
    """Departures of connections whose TCP ends are ours."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self.now_ns = 0
        self.drops, self.clients = Drops(), ConnectionTable()
        self.sent: list[Message] = []
        self.coalescer = Coalescer(FrontLimits(), self.drops)
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.monitor, near = context.socket(zmq.PAIR), context.socket(zmq.PAIR)
        self.monitor.bind("inproc://monitor")
        near.connect("inproc://monitor")
        self._near = near
        self.open: list[socket.socket] = [self.listener]
        self.departures = DisconnectHandler(
            near,
            self.clients,
            Outbox(self, FrontLimits(), self.drops),  # type: ignore[arg-type]
            self,  # type: ignore[arg-type]
            self.coalescer,
            self.drops,
            self,  # type: ignore[arg-type]
            AlignmentService(self.coalescer.offer, self.drops),
            lambda: self.now_ns,
            ConnectionGuard(self.clients, self.drops, AuditTrail(self.coalescer.offer), FrontLimits()),
        )

    def send_multipart(self, frames: list[bytes], _flags: int) -> None:
        self.sent.append(decode_server(frames[1]).message)

    def remove_peer(self, _descriptor: int) -> None:
        """As the admission."""

    def record_disconnect(self, _connection: FrontConnection, _reason: str) -> None:
        """As the status desk."""

    def join(self, number: int, behind: FrontConnection | None = None) -> tuple[FrontConnection, socket.socket]:
        """A connection over a new TCP connection, and our end of it in place of libzmq's."""
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
        self.departures.drain_monitor()

    def leave(self) -> list[tuple[int, object]]:
        self.departures.process_disconnects([], drained=True)
        return [(e.connection, e.message) for e in self.coalescer.take_batch()]

    def close(self) -> None:
        self.monitor.close()
        self._near.close()
        for one in self.open:
            one.close()


HELLO = Hello("operator", "Ann")


@pytest.fixture
def door() -> Iterator[Door]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    one = Door(context)
    yield one
    one.close()
    context.destroy(linger=0)


def test_who_has_got_the_descriptor_of_a_closed_connection_stays(door: Door) -> None:
    first, ours = door.join(1)
    descriptor = ours.fileno()
    ours.close()
    assert os.open(os.devnull, os.O_RDONLY) == descriptor  # kept free for the next
    second, theirs = door.join(2)
    os.dup2(theirs.fileno(), descriptor)  # as if accepted right there
    second.peer = Peer(descriptor, "")
    door.report_closed(descriptor)
    assert door.leave() == [(1, Lost("closed"))]
    door.now_ns = 2 * LAST_WORDS_NS
    assert door.leave() == []
    assert list(door.clients.by_number) == [2]
    assert first.number == 1
    os.close(descriptor)


def test_a_report_that_comes_before_the_descriptor_is_closed_is_not_forgotten(door: Door) -> None:
    _, ours = door.join(1)
    door.report_closed(ours.fileno())
    assert door.leave() == []
    ours.close()
    assert door.leave() == [(1, Lost("closed"))]


def test_those_behind_a_gateway_that_is_let_go_leave_with_it_and_are_told(door: Door) -> None:
    gateway, _ = door.join(1)
    door.join(2, behind=gateway)
    door.join(3)
    door.departures.remove(gateway, "heartbeat")
    assert [(e.connection, e.message) for e in door.coalescer.take_batch()] == [(2, Lost("gateway"))]
    assert list(door.clients.by_number) == [3]
    (fault,) = door.sent
    assert isinstance(fault, ProtocolFault)
    assert (fault.code, fault.reason) == ("dropped", "gateway")


@pytest.mark.parametrize(("reason", "stops"), [("heartbeat", True), ("removed", False), ("bye", False)])
def test_only_who_was_given_up_may_stop_after_the_end(door: Door, reason: str, stops: bool) -> None:
    connection, ours = door.join(1)
    door.departures.remove(connection, reason)
    assert (door.clients.find_kept(connection.route, connection.peer) is connection) is stops
    descriptor = ours.fileno()
    ours.close()
    door.report_closed(descriptor)
    door.leave()
    assert door.clients.find_kept(connection.route, connection.peer) is None
