"""The end of connections, with a scripted monitor and addresses by descriptor."""

from __future__ import annotations

import pytest
import zmq

from iris_session.front import disconnects as disconnects_module
from iris_session.front.admission import Admission
from iris_session.front.connections import FrontConnection, Peer, Route
from iris_session.front.disconnects import LAST_MESSAGES_NS, DisconnectHandler
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.codec import decode_server
from iris_session.protocol.entries import Lost
from iris_session.protocol.server_messages import Message
from tests.front.fakes import make_alignment, make_context, make_status
from tests.rig.network import Monitor

HELLO = Hello("operator", "Ann")
CLOSED = ("", 0)


class DisconnectRig:
    """A disconnect handler. `addresses`: peers of open TCP connections by descriptor."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns = 0
        self.sent: list[Message] = []
        self.addresses: dict[int, tuple[str, int]] = {}
        front = make_context(self, lambda: self.now_ns)
        self.clients, self.coalescer = front.connections, front.coalescer
        self.monitor = Monitor()
        monkeypatch.setattr(disconnects_module, "peer_of", lambda descriptor: self.addresses.get(descriptor, CLOSED))
        alignment = make_alignment(front)
        admission, status = Admission(front, ()), make_status(front, alignment)
        self.disconnects = DisconnectHandler(front, self.monitor, admission, status, alignment)  # type: ignore[arg-type]

    def send_multipart(self, frames: list[bytes], _flags: int) -> None:
        self.sent.append(decode_server(frames[1]).message)

    def join(self, number: int, descriptor: int, behind: FrontConnection | None = None) -> FrontConnection:
        """Join by a TCP connection, or behind a gateway by that of the gateway."""
        address = self.addresses.setdefault(descriptor, ("10.0.0.1", 1000 + number))
        route = Route(b"%d" % number) if behind is None else Route(behind.route.routing_id, f"tab{number}")
        gateway = 0 if behind is None else behind.number
        connection = FrontConnection(number, route, Peer(descriptor, ""), address, "key", HELLO, gateway)
        self.clients.add(connection)
        return connection

    def report_closed(self, descriptor: int) -> None:
        self.monitor.report(int(zmq.EVENT_DISCONNECTED), descriptor)
        self.disconnects.drain_monitor()

    def leave(self) -> list[tuple[int, object]]:
        self.disconnects.process_disconnects([], drained=True)
        return [(e.connection, e.message) for e in self.coalescer.take_batch()]


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> DisconnectRig:
    return DisconnectRig(monkeypatch)


def test_connection_that_reuses_a_descriptor_stays(rig: DisconnectRig) -> None:
    rig.join(1, 7)
    rig.addresses[7] = ("10.0.0.2", 5)
    rig.join(2, 7)
    rig.report_closed(7)
    assert rig.leave() == [(1, Lost("closed"))]
    rig.now_ns = 2 * LAST_MESSAGES_NS
    assert rig.leave() == []
    assert list(rig.clients.by_number) == [2]


def test_report_before_the_descriptor_is_closed_is_processed_later(rig: DisconnectRig) -> None:
    rig.join(1, 7)
    rig.report_closed(7)
    assert rig.leave() == []
    del rig.addresses[7]
    assert rig.leave() == [(1, Lost("closed"))]


@pytest.mark.parametrize(("reason", "stops"), [("heartbeat", True), ("removed", False), ("bye", False)])
def test_only_silent_clients_may_send_an_estop_after_their_end(rig: DisconnectRig, reason: str, stops: bool) -> None:
    connection = rig.join(1, 7)
    rig.disconnects.remove(connection, reason)
    assert (rig.clients.find_kept(connection.route, connection.peer) is connection) is stops
    del rig.addresses[7]
    rig.report_closed(7)
    rig.leave()
    assert rig.clients.find_kept(connection.route, connection.peer) is None
