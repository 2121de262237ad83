"""The end of connections: closed by the peer, replaced, silent, slow, or disconnected by the authority."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import zmq

from iris_session.alignment.service import AlignmentService
from iris_session.front.admission import Admission
from iris_session.front.connections import FrontConnection
from iris_session.front.context import FrontContext
from iris_session.front.status import StatusService
from iris_session.link.config import MILLISECOND
from iris_session.link.sockets import close_tcp, next_tcp_event, peer_of, readable
from iris_session.protocol.entries import Entry, Lost
from iris_session.protocol.names import FaultCode
from iris_session.protocol.server_messages import ProtocolFault

#: How long messages of a closed connection may wait behind those of others.
LAST_MESSAGES_NS: Final = 100 * MILLISECOND
#: Reasons after which the TCP connection stays open: an e-stop by it counts until it is closed, after a minute at the
#: latest.
TCP_STAYS_OPEN: Final = ("silent", "gateway", "heartbeat", "replaced", "refused")


class DisconnectHandler:
    """Remove connections that have ended, and notify the authority of those that it did not end itself."""

    def __init__(
        self,
        context: FrontContext,
        monitor: zmq.Socket[bytes],
        admission: Admission,
        status: StatusService,
        alignment: AlignmentService,
    ) -> None:
        self._context = context
        self._monitor = monitor
        self._admission = admission
        self._status = status
        self._alignment = alignment
        self._closed: list[tuple[int, int]] = []  # descriptors of closed TCP connections, each with its deadline

    def drain_monitor(self) -> None:
        """Read which TCP connections were accepted and closed."""
        while readable(self._monitor):
            event, descriptor = next_tcp_event(self._monitor)
            if event == zmq.EVENT_ACCEPTED:
                self._context.guard.add(descriptor, self._context.now_ns())
            elif event == zmq.EVENT_DISCONNECTED:
                self._context.guard.remove(descriptor)
                self._admission.remove_peer(descriptor)
                self._closed.append((descriptor, self._context.now_ns() + LAST_MESSAGES_NS))

    def process_disconnects(self, ended: Iterable[tuple[FrontConnection, str]], drained: bool) -> None:
        """Disconnect connections whose TCP connection was closed, that `ended` on their route for the reason beside
        them, or that do not read what is sent to them.

        A closed connection is handled after its last messages, because an e-stop may be pending in the socket.
        `drained`: no message is.
        """
        if self._closed:
            now_ns = self._context.now_ns()
            self._closed = [one for one in self._closed if self._is_close_pending(*one, drained, now_ns)]
        for connection, reason in ended:
            self.report_lost(connection, reason)
        failed, self._context.outbox.failed = self._context.outbox.failed, {}
        for number, reason in failed.items():
            slow = self._context.connections.by_number.get(number)
            if slow is not None:
                self.report_lost(slow, reason)
                if not (slow.gateway and reason == "flood"):  # the others behind the gateway go on
                    close_tcp(slow.peer.descriptor, slow.address)

    def _is_close_pending(self, descriptor: int, deadline_ns: int, drained: bool, now_ns: int) -> bool:
        """Return whether a closed TCP connection has to be examined again.

        The monitor reports no more than a descriptor, which another connection may own by now, or which may not be
        closed yet.
        """
        if not drained and now_ns <= deadline_ns:
            return True
        address = peer_of(descriptor)
        self._context.connections.remove_closed(descriptor, address)
        theirs = [c for c in self._context.connections.by_number.values() if c.peer.descriptor == descriptor]
        for connection in theirs:
            if connection.address != address or not address[1]:
                self.report_lost(connection, "closed")
        return now_ns <= deadline_ns and any(c.number in self._context.connections.by_number for c in theirs)

    def disconnect_silent(self, now_ns: int, silence_ns: int) -> None:
        """Disconnect connections that have sent nothing for so long."""
        for one in [c for c in self._context.connections.by_number.values() if now_ns - c.last_heard_ns > silence_ns]:
            self.report_lost(one, "silent")

    def report_lost(self, connection: FrontConnection, reason: str) -> None:
        """Remove a connection and those behind it, and report them to the authority as lost."""
        for one in (connection, *self._context.connections.list_behind(connection)):
            self._remove_state(one, reason)
            self._status.record_disconnect(one, reason)
            self._context.coalescer.offer(Entry(one.number, one.number, self._context.now_ns(), Lost(reason)))

    def remove(self, connection: FrontConnection, reason: str) -> None:
        """Remove a connection that the authority has ended. Those behind it are disconnected with it."""
        for one in self._context.connections.list_behind(connection):
            text = f"the session closed this connection: its gateway has left ({reason})"
            self._context.outbox.send(one, ProtocolFault(FaultCode.DROPPED, text, "gateway"))
            self.report_lost(one, "gateway")
        self._remove_state(connection, reason)
        self._context.coalescer.remove_connection(connection.number)

    def _remove_state(self, connection: FrontConnection, reason: str) -> None:
        self._context.connections.remove(connection)
        if reason in TCP_STAYS_OPEN:
            self._context.connections.keep_for_estop(connection)
        self._alignment.remove_connection(connection.number)
        self._context.drops.remove(connection.number)
