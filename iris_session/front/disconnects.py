"""How connections end: closed by the peer, replaced, silent, slow, or let go by the authority."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import zmq

from iris_session.alignment.service import AlignmentService
from iris_session.front.admission import Admission
from iris_session.front.coalescer import Coalescer
from iris_session.front.connection_guard import ConnectionGuard
from iris_session.front.connections import ConnectionTable, FrontConnection, Outbox
from iris_session.front.status import StatusService
from iris_session.link.config import MILLISECOND
from iris_session.link.sockets import close_tcp, next_tcp_event, peer_of, readable
from iris_session.protocol.entries import Entry, Lost
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import FaultCode
from iris_session.protocol.server_messages import ProtocolFault

#: How long what a closed connection has sent may wait behind the messages of others.
LAST_WORDS_NS = 100 * MILLISECOND
#: Whoever ended like this is still there: an e-stop of theirs counts until their TCP connection is closed, which it is
#: after a minute at the latest.
TCP_STAYS_OPEN = ("silent", "gateway", "heartbeat", "replaced")


class DisconnectHandler:
    """Takes leave of connections: nothing of them stays, and the authority hears of those it did not end itself."""

    def __init__(
        self,
        monitor: zmq.Socket[bytes],
        clients: ConnectionTable,
        outbox: Outbox,
        admission: Admission,
        coalescer: Coalescer,
        drops: Drops,
        status: StatusService,
        alignment: AlignmentService,
        session_ns: Callable[[], int],
        guard: ConnectionGuard,
    ) -> None:
        self._monitor = monitor
        self._guard = guard
        self._clients = clients
        self._outbox = outbox
        self._admission = admission
        self._coalescer = coalescer
        self._drops = drops
        self._status = status
        self._alignment = alignment
        self._session_ns = session_ns
        self._closed: list[tuple[int, int]] = []  # descriptors of closed TCP connections, each with its deadline

    def drain_monitor(self) -> None:
        """Notes the TCP connections that were opened and closed."""
        while readable(self._monitor):
            event, descriptor = next_tcp_event(self._monitor)
            if event == zmq.EVENT_ACCEPTED:
                self._guard.add(descriptor, self._session_ns())
            elif event == zmq.EVENT_DISCONNECTED:
                self._guard.remove(descriptor)
                self._admission.remove_peer(descriptor)
                self._closed.append((descriptor, self._session_ns() + LAST_WORDS_NS))

    def process_disconnects(self, replaced: Iterable[FrontConnection], drained: bool) -> None:
        """Of connections that are closed (after their last words: an e-stop may still wait in the socket; `drained`:
        none does), were replaced by another hello on their route, or did not take what was sent."""
        if self._closed:
            now_ns = self._session_ns()
            self._closed = [one for one in self._closed if self._is_close_pending(*one, drained, now_ns)]
        for connection in replaced:
            self.report_lost(connection, "replaced")
        failed, self._outbox.failed = self._outbox.failed, {}
        for number, reason in failed.items():
            slow = self._clients.by_number.get(number)
            if slow is not None:
                self.report_lost(slow, reason)
                close_tcp(slow.peer.descriptor, slow.address)

    def _is_close_pending(self, descriptor: int, deadline_ns: int, drained: bool, now_ns: int) -> bool:
        """Whether a closed TCP connection is to be looked at again.

        The report names no more than a descriptor, which may be somebody else's by now, or not be closed yet.
        """
        if not drained and now_ns <= deadline_ns:
            return True
        address = peer_of(descriptor)
        self._clients.remove_closed(descriptor, address)
        theirs = [c for c in self._clients.by_number.values() if c.peer.descriptor == descriptor]
        for connection in theirs:
            if connection.address != address or not address[1]:
                self.report_lost(connection, "closed")
        return now_ns <= deadline_ns and any(c.number in self._clients.by_number for c in theirs)

    def disconnect_silent(self, now_ns: int, silence_ns: int) -> None:
        """Gives up those who have said nothing for so long."""
        for one in [c for c in self._clients.by_number.values() if now_ns - c.last_heard_ns > silence_ns]:
            self.report_lost(one, "silent")

    def report_lost(self, connection: FrontConnection, reason: str) -> None:
        """Tells the authority that a connection, and those behind it, are gone."""
        for one in (connection, *self._clients.list_behind(connection)):
            self._remove_state(one, reason)
            self._status.record_disconnect(one, reason)
            self._coalescer.offer(Entry(one.number, one.number, self._session_ns(), Lost(reason)))

    def remove(self, connection: FrontConnection, reason: str) -> None:
        """The authority is done with a connection: it need not hear of it again. Those behind it end with it."""
        for one in self._clients.list_behind(connection):
            text = f"the session let this connection go: its gateway has left ({reason})"
            self._outbox.send(one, ProtocolFault(FaultCode.DROPPED, text, "gateway"))
            self.report_lost(one, "gateway")
        self._remove_state(connection, reason)
        self._coalescer.remove_connection(connection.number)

    def _remove_state(self, connection: FrontConnection, reason: str) -> None:
        self._clients.remove(connection)
        if reason in TCP_STAYS_OPEN:
            self._clients.keep_for_estop(connection)
        self._alignment.remove_connection(connection.number)
        self._drops.remove(connection.number)
