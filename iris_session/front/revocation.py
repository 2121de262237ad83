"""Revocation of keys: closes their connections and those behind them at once, and removes their participants.

libzmq cannot drop one subscriber. So, if the key may have one, the state socket is closed and opened again on the same
port: all other clients connect again within a fraction of a second, and the revoked key is refused.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import Final

import zmq

from iris_session.front.connections import FrontConnection
from iris_session.front.context import FrontContext
from iris_session.front.disconnects import DisconnectHandler
from iris_session.link.config import MILLISECOND, SECOND, FrontError
from iris_session.link.sockets import close_tcp
from iris_session.protocol.client_messages import RemoveParticipant
from iris_session.protocol.entries import HOST, Entry
from iris_session.protocol.names import AuditKind, FaultCode
from iris_session.protocol.server_messages import ProtocolFault
from iris_session.security import WEB, AllowedKey, AllowList, KeysBusyError, KeysError
from iris_session.security.keyring import select_gateway_roles
from iris_session.system.file_worker import LOCK_TIMEOUT_S

log = logging.getLogger(__name__)

CHECK_PERIOD_NS: Final = 100 * MILLISECOND
#: Between the fault and the end of the TCP connection, so that the fault arrives.
FAREWELL_NS: Final = 100 * MILLISECOND
#: libzmq frees a port some milliseconds after its socket was closed; later than this another process has it.
PORT_FREE_NS: Final = 5 * SECOND
SEEN_NS: Final = 60 * SECOND
REVOKED: Final = "this key was taken off the session's list"
GATEWAY_REVOKED: Final = "the gateway's key was taken off the session's list"
ROLE_TAKEN: Final = "its key lost the role"


class RevocationService:
    """Apply changes of the allow-list, and write those of a director. A `Service`.

    `open_state` opens the state socket, and raises `FrontError` while its port is not free yet.
    """

    def __init__(
        self, context: FrontContext, disconnects: DisconnectHandler, open_state: Callable[[], zmq.Socket[bytes]]
    ) -> None:
        self._context = context
        self._disconnects = disconnects
        self._open_state = open_state
        self._closing: list[tuple[int, FrontConnection]] = []
        self._writing = False
        self._reported_error = ""  # of the allow-list, logged last
        self._state_due_ns = 0  # while the state socket is closed: when its port should have been free
        self._next_check_ns = self._next_seen_ns = 0
        for mark in self._context.tokens.revoked_keys:  # the front before ended before it wrote that into the list
            if self._context.keyring.find_entry(mark) is not None:
                self._context.keyring.pending_revocations[mark] = None
        self._find_removed_keys()

    def _find_removed_keys(self) -> None:
        """Count keys of participants as removed that left the list while no front was running."""
        tokens, keyring = self._context.tokens, self._context.keyring
        if keyring.key is None:
            return
        removed = [AllowedKey("", mark) for mark in tokens.curve_keys if keyring.find_key(mark) is None]
        for mark in tokens.web_keys:
            entry = keyring.find_entry(mark)
            if entry is None or entry.kind != WEB:
                removed.append(AllowedKey("", mark, kind=WEB))
        keyring.removed.update((one.key, one) for one in removed)

    def revoke(self, key_id: str, now_ns: int) -> None:
        """Revoke a key on request of a director: disconnect it, and take it off the list."""
        self._context.keyring.pending_revocations[key_id] = None
        self._disconnect_key(key_id, now_ns, "a director revoked this key")

    def disconnect(self, connection: FrontConnection, text: str, now_ns: int, reason: str = "revoked") -> None:
        """Send a fault to a participant that was removed, and close its TCP connection a moment later."""
        self._context.outbox.send(connection, ProtocolFault(FaultCode.REVOKED, text, reason))
        if not connection.gateway:  # else it is one of many on the TCP connection of its gateway
            self._closing.append((now_ns + FAREWELL_NS, connection))

    def tick(self, now_ns: int) -> None:
        """Read the allow-list, disconnect revoked keys, reopen the state socket."""
        while self._closing and now_ns >= self._closing[0][0]:
            _, gone = self._closing.pop(0)
            close_tcp(gone.peer.descriptor, gone.address)
        if now_ns >= self._next_check_ns:
            self._next_check_ns = now_ns + CHECK_PERIOD_NS
            self._write_allow_list(now_ns)
            self._context.keyring.reload_if_changed()
        if self._context.keyring.removed:
            gone_keys, self._context.keyring.removed = self._context.keyring.removed, {}
            for mark, old in gone_keys.items():
                now = self._context.keyring.find_entry(mark)
                if now is not None and now.kind != old.kind:
                    now = None  # as that kind of key it is not listed any more
                if now is None and self._context.tokens.is_revoked(mark):
                    continue  # a director revoked it: all is done
                if now is None:
                    self._context.audit.record(AuditKind.KEY_REVOKED, now_ns, subject=mark, name=old.name)
                    self._disconnect_key(mark, now_ns, REVOKED)
                else:
                    self._apply_roles(mark, now.roles, now_ns)
        while self._context.keyring.added:
            self._context.tokens.reinstate_key(self._context.keyring.added.popitem()[0])
        if self._state_due_ns:
            self._reopen_state(now_ns)

    def close(self) -> None:
        """Close the connections that got their fault."""
        for _, gone in self._closing:
            close_tcp(gone.peer.descriptor, gone.address)

    def _disconnect_key(self, key_id: str, now_ns: int, text: str) -> None:
        for connection in self._context.connections.list_of_key(key_id):
            for one in self._context.connections.list_behind(connection):
                self.disconnect(one, GATEWAY_REVOKED, now_ns)
            self.disconnect(connection, text, now_ns)
            self._disconnects.report_lost(connection, "revoked")  # and those behind it
        for participant in self._context.tokens.revoke_key(key_id):
            self._remove_participant(participant, "key revoked", now_ns)
        if key_id in self._context.keyring.state_subscribers and not self._state_due_ns:
            self._context.publisher.replace_socket(None)
            self._context.keyring.state_subscribers.clear()
            self._state_due_ns = now_ns + PORT_FREE_NS

    def _apply_roles(self, key_id: str, roles: tuple[str, ...], now_ns: int) -> None:
        """Apply the present roles of a key: connections in a role that it lost, its own or behind it, are removed, and
        refused when they join again."""
        for connection in self._context.connections.list_of_key(key_id):
            behind = self._context.connections.list_behind(connection)
            if roles and connection.role not in roles:
                lost = [*behind, connection]
            else:
                left = select_gateway_roles(roles)
                lost = [one for one in behind if left and one.role not in left]
            for one in lost:
                self._disconnect_role(one, now_ns)

    def check_role(self, connection: FrontConnection, now_ns: int) -> None:
        """Remove a connection if its key may not have its role (any more): the authority knows the roles of a key as
        they were when it joined."""
        gateway = self._context.connections.by_number.get(connection.gateway)
        behind = gateway.key_id if gateway is not None else ""
        roles = self._context.keyring.find_roles(connection.key_id, behind, web=connection.web)
        if roles is not None and (roles or connection.web) and connection.role not in roles:
            self._disconnect_role(connection, now_ns)

    def _disconnect_role(self, connection: FrontConnection, now_ns: int) -> None:
        participant, role = connection.participant_id, connection.role
        if connection.gateway:
            whose = "its key" if connection.web else "its gateway"
            text = f"the session closed this connection: {whose} may not be {role} any more"
            self._context.outbox.send(connection, ProtocolFault(FaultCode.DROPPED, text, "role"))
        self._disconnects.report_lost(connection, "role")
        if not connection.gateway:
            close_tcp(connection.peer.descriptor, connection.address)
        if participant:
            self._context.tokens.remove_participant(participant)
            self._remove_participant(participant, ROLE_TAKEN, now_ns)

    def _remove_participant(self, participant: str, reason: str, now_ns: int) -> None:
        self._context.coalescer.offer(Entry(HOST, HOST, now_ns, RemoveParticipant(0, participant, reason=reason)))

    def _reopen_state(self, now_ns: int) -> None:
        try:
            self._context.publisher.replace_socket(self._open_state())
        except FrontError as error:
            if now_ns >= self._state_due_ns:
                self._state_due_ns = now_ns + PORT_FREE_NS
                log.warning("cannot reopen the state socket after a revocation, so no client gets state: %s", error)
            return
        self._state_due_ns = 0

    def _write_allow_list(self, now_ns: int) -> None:
        """Write changes to the list. They are in force already, so nothing waits for the file."""
        keyring = self._context.keyring
        if keyring.home is None:
            keyring.pending_revocations.clear()
            return
        due = bool(keyring.last_seen) and now_ns >= self._next_seen_ns
        if self._writing or not (keyring.pending_revocations or due) or keyring.is_missing:
            return
        marks, seen = tuple(keyring.pending_revocations), keyring.last_seen if due else {}
        job = partial(_change_allow_list, keyring.home.clients, marks, seen)
        self._writing = keyring.files.submit(job, partial(self._on_written, marks, seen))
        if self._writing and due:
            self._next_seen_ns = now_ns + SEEN_NS
            keyring.last_seen = {}

    def _on_written(self, marks: tuple[str, ...], seen: dict[str, str], outcome: KeysError | None, now_ns: int) -> None:
        self._writing = False
        keyring = self._context.keyring
        if outcome is None:
            for mark in marks:
                keyring.pending_revocations.pop(mark, None)
            return
        keyring.last_seen = {**seen, **keyring.last_seen}
        if not isinstance(outcome, KeysBusyError) and str(outcome) != self._reported_error:
            self._reported_error = str(outcome)  # the key stays out of this session; its file is tried again
            log.warning("cannot change the allow-list: %s", outcome)


def _change_allow_list(clients: AllowList, marks: tuple[str, ...], seen: dict[str, str]) -> None:
    for mark in marks:
        clients.revoke_key(mark, LOCK_TIMEOUT_S)
    if seen:
        clients.record_last_seen(seen, LOCK_TIMEOUT_S)
