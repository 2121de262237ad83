"""A connection guard and TCP connections that it guards, for tests of the guards."""

from __future__ import annotations

import socket

from iris_session.front.audit import AuditTrail
from iris_session.front.connection_guard import ConnectionGuard
from iris_session.front.connections import ConnectionTable, FrontConnection, Peer, Route
from iris_session.link.config import SECOND, FrontLimits
from iris_session.link.tcp_guard import TcpBounds, TrafficCounter
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.entries import Audit, Entry
from iris_session.protocol.limits import Drops

CHECK_PERIOD_NS = TcpBounds().check_period_ns
LIMITS = FrontLimits(unauthenticated=3, hello_timeout_ns=10 * SECOND)


class ControlSocketRig:
    """A connection guard, and TCP connections that it guards."""

    def __init__(self) -> None:
        self.now_ns = SECOND
        self.clients, self.drops = ConnectionTable(), Drops()
        self.reported: list[Entry] = []
        self.traffic = TrafficCounter()
        self.guard = ConnectionGuard(self.clients, self.drops, AuditTrail(self._record), LIMITS, self.traffic)
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.held: list[socket.socket] = [self.listener]

    def _record(self, entry: Entry) -> bool:
        self.reported.append(entry)
        return True

    @property
    def audits(self) -> list[Audit]:
        return [entry.message for entry in self.reported if isinstance(entry.message, Audit)]

    def open(self) -> tuple[Peer, socket.socket]:
        """A new TCP connection: as the front sees it, and its other end."""
        theirs = socket.create_connection(self.listener.getsockname())
        ours, _ = self.listener.accept()
        self.held += [theirs, ours]
        self.guard.add(ours.fileno(), self.now_ns)
        return Peer(ours.fileno(), ""), theirs

    def hello(self, peer: Peer, number: int = 1) -> FrontConnection:
        route = Route(b"%d" % number)
        address = next(one.getpeername() for one in self.held[1:] if one.fileno() == peer.descriptor)
        connection = FrontConnection(number, route, peer, address, f"key{number}", Hello("operator", "Ann"), 0)
        self.clients.add(connection)
        return connection

    def look(self, after_ns: int = CHECK_PERIOD_NS) -> None:
        self.now_ns += after_ns
        self.guard.tick(self.now_ns)


def is_closed(theirs: socket.socket) -> bool:
    theirs.settimeout(0.05)
    try:
        return theirs.recv(1) == b""
    except TimeoutError:
        return False
