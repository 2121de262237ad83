"""Revoked keys: their connections end at once, their participants are removed, the state socket is opened anew.

libzmq cannot drop one subscriber. So the state socket is closed and opened again on the same port: everyone else
connects again within a fraction of a second, the revoked key is not let in.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Final

import zmq

from iris_session.keys import KeysBusyError, KeysError
from iris_session.protocol.entries import HOST, Entry
from iris_session.protocol.names import AuditKind, FaultCode
from iris_session.protocol.security import RemoveParticipant
from iris_session.protocol.server_messages import ProtocolFault
from iris_session.transport.audit import AuditTrail
from iris_session.transport.clients import ClientTable, Connection, Outbox
from iris_session.transport.config import MILLISECOND, SECOND, FrontError
from iris_session.transport.keyring import Keyring
from iris_session.transport.resume_tokens import ResumeTokens
from iris_session.transport.sockets import close_tcp
from iris_session.transport.state_publisher import StatePublisher

LOOK_NS: Final = 100 * MILLISECOND
#: Between the fault and the end of the TCP connection, so that the fault arrives.
FAREWELL_NS: Final = 100 * MILLISECOND
#: libzmq frees a port some milliseconds after its socket was closed; later than this somebody else has it.
PORT_FREE_NS: Final = 5 * SECOND
SEEN_NS: Final = 60 * SECOND
REVOKED: Final = "this key was taken off the session's list"


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
        self._to_revoke: dict[str, None] = {}
        self._said = ""  # what went wrong with the list last
        self._state_due_ns = 0  # while the state socket is closed: when its port should have been free
        self._next_look_ns = self._next_seen_ns = 0

    def revoke(self, key_id: str, now_ns: int) -> None:
        """A director's word: ends the key here, and takes it off the list."""
        self._to_revoke[key_id] = None
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
            self._keyring.look()
        if self._keyring.gone:
            gone_keys, self._keyring.gone = self._keyring.gone, {}
            for mark, old in gone_keys.items():
                now = self._keyring.find(mark)
                if now is None and self._tokens.revoked(mark):
                    continue  # a director did it: all is done
                if now is None:
                    self._audit.note(AuditKind.KEY_REVOKED, now_ns, subject=mark, name=old.name)
                    self._end(mark, now_ns, REVOKED)
                else:
                    self._narrow(mark, now.roles)
        while self._keyring.come:
            self._tokens.forgive(self._keyring.come.popitem()[0])
        if self._state_due_ns:
            self._reopen(now_ns)

    def close(self) -> None:
        """Closes the connections that were told to go."""
        for _, gone in self._leaving:
            close_tcp(gone.peer.descriptor, gone.address)

    def _end(self, key_id: str, now_ns: int, text: str) -> None:
        for connection in [c for c in self._clients.by_number.values() if c.key_id == key_id]:
            self.remove(connection, text, now_ns)
            self._lose(connection, "revoked")
        for participant in self._tokens.revoke(key_id):
            self._offer(Entry(HOST, HOST, now_ns, RemoveParticipant(0, participant, reason="key revoked")))
        if self._keyring.key is not None and not self._state_due_ns:
            self._publisher.use_socket(None)
            self._state_due_ns = now_ns + PORT_FREE_NS

    def _narrow(self, key_id: str, roles: tuple[str, ...]) -> None:
        """A key has other roles now: connections in a role that it lost are closed, and refused when they come back."""
        for connection in [c for c in self._clients.by_number.values() if c.key_id == key_id]:
            if roles and connection.hello.role not in roles:
                self._lose(connection, "role")
                close_tcp(connection.peer.descriptor, connection.address)

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
        """Changes the list, without waiting for others who change it."""
        home = self._keyring.home
        if home is None:
            self._to_revoke.clear()
            return
        try:
            for key_id in tuple(self._to_revoke):
                home.clients.revoke(key_id, patience_s=0.0)
                del self._to_revoke[key_id]
            if self._keyring.seen and now_ns >= self._next_seen_ns:
                self._next_seen_ns = now_ns + SEEN_NS
                home.clients.seen(self._keyring.seen, patience_s=0.0)
                self._keyring.seen = {}
        except KeysBusyError:
            return
        except KeysError as error:
            if str(error) != self._said:  # the key stays out of this session; its file is tried again
                self._said = str(error)
                print(f"iris-session: the allow-list cannot be changed: {error}", file=sys.stderr, flush=True)
