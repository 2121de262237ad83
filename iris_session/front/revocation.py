"""Revoked keys: their connections end at once, and those behind them; their participants are removed.

libzmq cannot drop one subscriber. So, if the key may have one, the state socket is closed and opened again on the same
port: everyone else connects again within a fraction of a second, the revoked key is not let in.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import Final

import zmq

from iris_session.front.audit import AuditTrail
from iris_session.front.connections import ClientTable, Connection, Outbox
from iris_session.front.state_publisher import StatePublisher
from iris_session.link.config import MILLISECOND, SECOND, FrontError
from iris_session.link.sockets import close_tcp
from iris_session.protocol.entries import HOST, Entry
from iris_session.protocol.names import AuditKind, FaultCode
from iris_session.protocol.security import RemoveParticipant
from iris_session.protocol.server_messages import ProtocolFault
from iris_session.security import AllowList, KeysBusyError, KeysError
from iris_session.security.keyring import Keyring, select_gateway_roles
from iris_session.security.resume_tokens import ResumeTokens
from iris_session.system.file_worker import LOCK_TIMEOUT_S

LOOK_NS: Final = 100 * MILLISECOND
#: Between the fault and the end of the TCP connection, so that the fault arrives.
FAREWELL_NS: Final = 100 * MILLISECOND
#: libzmq frees a port some milliseconds after its socket was closed; later than this somebody else has it.
PORT_FREE_NS: Final = 5 * SECOND
SEEN_NS: Final = 60 * SECOND
REVOKED: Final = "this key was taken off the session's list"
GATEWAY_REVOKED: Final = "the gateway's key was taken off the session's list"
ROLE_TAKEN: Final = "its key lost the role"


class Revocation:
    """A `Service`. `lose` tells the authority that a connection is gone; `open_state` opens the state socket, and
    raises `FrontError` while its port is not free yet."""

    def __init__(
        self,
        keyring: Keyring,
        clients: ClientTable,
        outbox: Outbox,
        tokens: ResumeTokens,
        audit: AuditTrail,
        publisher: StatePublisher,
        offer: Callable[[Entry], bool],
        lose: Callable[[Connection, str], None],
        open_state: Callable[[], zmq.Socket[bytes]],
    ) -> None:
        self._keyring = keyring
        self._clients = clients
        self._outbox = outbox
        self._tokens = tokens
        self._audit = audit
        self._publisher = publisher
        self._offer = offer
        self._lose = lose
        self._open_state = open_state
        self._leaving: list[tuple[int, Connection]] = []
        self._writing = False
        self._said = ""  # what went wrong with the list last
        self._state_due_ns = 0  # while the state socket is closed: when its port should have been free
        self._next_look_ns = self._next_seen_ns = 0

    def revoke(self, key_id: str, now_ns: int) -> None:
        """A director's word: ends the key here, and takes it off the list."""
        self._keyring.pending_revocations[key_id] = None
        self._end(key_id, now_ns, "a director revoked this key")

    def remove(self, connection: Connection, text: str, now_ns: int, reason: str = "revoked") -> None:
        """The authority has removed a participant: told, then disconnected."""
        self._outbox.send(connection, ProtocolFault(FaultCode.REVOKED, text, reason))
        if not connection.gateway:  # one of many on the TCP connection of a gateway
            self._leaving.append((now_ns + FAREWELL_NS, connection))

    def turn(self, now_ns: int) -> None:
        """Looks at the list, ends what has to end, opens what is closed."""
        while self._leaving and now_ns >= self._leaving[0][0]:
            _, gone = self._leaving.pop(0)
            close_tcp(gone.peer.descriptor, gone.address)
        if now_ns >= self._next_look_ns:
            self._next_look_ns = now_ns + LOOK_NS
            self._write(now_ns)
            self._keyring.reload_if_changed()
        if self._keyring.removed:
            gone_keys, self._keyring.removed = self._keyring.removed, {}
            for mark, old in gone_keys.items():
                now = self._keyring.find_key(mark)
                if now is None and self._tokens.is_revoked(mark):
                    continue  # a director did it: all is done
                if now is None:
                    self._audit.note(AuditKind.KEY_REVOKED, now_ns, subject=mark, name=old.name)
                    self._end(mark, now_ns, REVOKED)
                else:
                    self._narrow(mark, now.roles, now_ns)
        while self._keyring.added:
            self._tokens.reinstate_key(self._keyring.added.popitem()[0])
        if self._state_due_ns:
            self._reopen(now_ns)

    def close(self) -> None:
        """Closes the connections that were told to go."""
        for _, gone in self._leaving:
            close_tcp(gone.peer.descriptor, gone.address)

    def _end(self, key_id: str, now_ns: int, text: str) -> None:
        for connection in self._of(key_id):
            for one in self._clients.behind(connection):
                self.remove(one, GATEWAY_REVOKED, now_ns)
            self.remove(connection, text, now_ns)
            self._lose(connection, "revoked")  # and those behind it
        for participant in self._tokens.revoke_key(key_id):
            self._expel(participant, "key revoked", now_ns)
        if key_id in self._keyring.state_subscribers and not self._state_due_ns:
            self._publisher.use_socket(None)
            self._keyring.state_subscribers.clear()
            self._state_due_ns = now_ns + PORT_FREE_NS

    def _narrow(self, key_id: str, roles: tuple[str, ...], now_ns: int) -> None:
        """A key has other roles now: whoever is here in a role that it lost, itself or behind it, is removed, and
        refused when it comes back."""
        for connection in self._of(key_id):
            behind = self._clients.behind(connection)
            if roles and connection.hello.role not in roles:
                lost = [*behind, connection]
            else:
                left = select_gateway_roles(roles)
                lost = [one for one in behind if left and one.hello.role not in left]
            for one in lost:
                self._end_role(one, now_ns)

    def _end_role(self, connection: Connection, now_ns: int) -> None:
        participant, role = connection.participant_id, connection.hello.role
        if connection.gateway:
            text = f"the session let this connection go: its gateway may speak for no {role} any more"
            self._outbox.send(connection, ProtocolFault(FaultCode.DROPPED, text, "role"))
        self._lose(connection, "role")
        if not connection.gateway:
            close_tcp(connection.peer.descriptor, connection.address)
        if participant:
            self._tokens.remove_participant(participant)
            self._expel(participant, ROLE_TAKEN, now_ns)

    def _of(self, key_id: str) -> list[Connection]:
        return [c for c in self._clients.by_number.values() if c.key_id == key_id]

    def _expel(self, participant: str, reason: str, now_ns: int) -> None:
        self._offer(Entry(HOST, HOST, now_ns, RemoveParticipant(0, participant, reason=reason)))

    def _reopen(self, now_ns: int) -> None:
        try:
            self._publisher.use_socket(self._open_state())
        except FrontError as error:
            if now_ns >= self._state_due_ns:
                self._state_due_ns = now_ns + PORT_FREE_NS
                print(f"iris-session: nobody gets state after a key was revoked: {error}", file=sys.stderr, flush=True)
            return
        self._state_due_ns = 0

    def _write(self, now_ns: int) -> None:
        """Has the list changed. What it says is decided already: nobody waits for the file."""
        keyring = self._keyring
        if keyring.home is None:
            keyring.pending_revocations.clear()
            return
        due = bool(keyring.last_seen) and now_ns >= self._next_seen_ns
        if self._writing or not (keyring.pending_revocations or due):
            return
        marks, seen = tuple(keyring.pending_revocations), keyring.last_seen if due else {}
        job = partial(_change, keyring.home.clients, marks, seen)
        self._writing = keyring.files.submit(job, partial(self._written, marks, seen))
        if self._writing and due:
            self._next_seen_ns = now_ns + SEEN_NS
            keyring.last_seen = {}

    def _written(self, marks: tuple[str, ...], seen: dict[str, str], outcome: KeysError | None, now_ns: int) -> None:
        self._writing = False
        keyring = self._keyring
        if outcome is None:
            for mark in marks:
                keyring.pending_revocations.pop(mark, None)
            return
        keyring.last_seen = {**seen, **keyring.last_seen}
        if not isinstance(outcome, KeysBusyError) and str(outcome) != self._said:
            self._said = str(outcome)  # the key stays out of this session; its file is tried again
            print(f"iris-session: the allow-list cannot be changed: {outcome}", file=sys.stderr, flush=True)


def _change(clients: AllowList, marks: tuple[str, ...], seen: dict[str, str]) -> None:
    for mark in marks:
        clients.revoke_key(mark, LOCK_TIMEOUT_S)
    if seen:
        clients.record_last_seen(seen, LOCK_TIMEOUT_S)
