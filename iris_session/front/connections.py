"""Connections as the front knows them, and sending to them without ever waiting.

A connection is one accepted `hello`. It is found by its route (ZeroMQ routing id, and for those behind a gateway the
name that the gateway gave), but it is bound to the TCP connection and key that said `hello`: another peer that comes
to own the same routing id is a stranger.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Final, NamedTuple

import msgspec
import zmq

from iris_session.front.traffic import Traffic
from iris_session.link.config import FrontLimits
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.entries import Entry
from iris_session.protocol.limits import Drops, RateLimiter, TokenBucket
from iris_session.protocol.names import PROTOCOL_VERSION
from iris_session.protocol.server_messages import ServerMessage

_encoder = msgspec.msgpack.Encoder()
#: Connections that were given up and may still stop the session.
MAX_GIVEN_UP: Final = 256


class Route(NamedTuple):
    """Where a message came from. `on_behalf_of` is empty but for participants behind a gateway."""

    routing_id: bytes
    on_behalf_of: str = ""


class Peer(NamedTuple):
    """The TCP connection and the CURVE user id (fingerprint, empty on plain sockets) that a message came by."""

    descriptor: int
    user_id: str


class Connection:
    """One accepted `hello`, until it is lost or dropped."""

    __slots__ = (
        "address",
        "admitted",
        "confirmed",
        "denials",
        "drops_in_a_row",
        "faults",
        "flood_last_ns",
        "flood_since_ns",
        "gateway",
        "hello",
        "key_id",
        "last_heard_ns",
        "late_epoch",
        "number",
        "participant_id",
        "peer",
        "prefix",
        "rates",
        "route",
    )

    def __init__(
        self, number: int, route: Route, peer: Peer, address: tuple[str, int], key_id: str, hello: Hello, gateway: int
    ) -> None:
        self.number = number
        self.route = route
        self.peer = peer
        self.address = address
        self.key_id = key_id
        self.hello = hello
        self.gateway = gateway
        self.admitted = False
        self.participant_id = ""  # from the authority, once admitted
        self.confirmed = False  # a message with its connection epoch has come: it has its `Welcome`
        self.last_heard_ns = 0
        self.drops_in_a_row = 0
        self.flood_last_ns = self.flood_since_ns = 0  # above a rate limit: when last, and without a pause since when
        self.faults = TokenBucket(2.0, 5)
        self.denials = TokenBucket(20.0, 40)  # as many as requests of one kind in an honest hand
        self.late_epoch: Entry | None = None  # the newest tracking epoch that came above its rate
        self.rates = RateLimiter()
        self.prefix = server_prefix(number)


class ClientTable:
    """All connections, by number and by route."""

    def __init__(self) -> None:
        self.by_number: dict[int, Connection] = {}
        self.by_route: dict[Route, Connection] = {}
        self._given_up: dict[tuple[Route, Peer], Connection] = {}

    def __len__(self) -> int:
        return len(self.by_number)

    def add(self, connection: Connection) -> None:
        self.by_number[connection.number] = connection
        self.by_route[connection.route] = connection

    def remove(self, connection: Connection) -> None:
        self.by_number.pop(connection.number, None)
        if self.by_route.get(connection.route) is connection:
            del self.by_route[connection.route]

    def find(self, route: Route, peer: Peer) -> Connection | None:
        """The connection of a route, if it still is the peer that said `hello`."""
        connection = self.by_route.get(route)
        return connection if connection is not None and connection.peer == peer else None

    def give_up(self, connection: Connection) -> None:
        """It counts no more, but who it was may not know that yet."""
        self._given_up.pop((connection.route, connection.peer), None)
        while len(self._given_up) >= MAX_GIVEN_UP:
            del self._given_up[next(iter(self._given_up))]
        self._given_up[connection.route, connection.peer] = connection

    def given_up(self, route: Route, peer: Peer) -> Connection | None:
        """The connection that this peer lost lately."""
        return self._given_up.get((route, peer))

    def forget_given_up(self, heard_before_ns: int) -> None:
        """Who has said nothing since then is nobody any more: its TCP connection may be closed like a stranger's."""
        for key, connection in list(self._given_up.items()):
            if connection.last_heard_ns < heard_before_ns:
                del self._given_up[key]

    @property
    def lost_lately(self) -> Collection[Connection]:
        """Connections that were given up while their TCP connections stood."""
        return self._given_up.values()

    def closed(self, descriptor: int, address: tuple[str, int]) -> None:
        """A TCP connection was closed. `address`: of the peer that has its descriptor now."""
        for key, connection in list(self._given_up.items()):
            if key[1].descriptor == descriptor and (connection.address != address or not address[1]):
                del self._given_up[key]

    def behind(self, gateway: Connection) -> list[Connection]:
        """Connections that a gateway speaks for."""
        return [c for c in self.by_number.values() if c.gateway == gateway.number]


def server_prefix(connection_epoch: int) -> bytes:
    """The bytes of a `ServerEnvelope` before its message: one encoded message serves every connection."""
    return b"\x93" + _encoder.encode(PROTOCOL_VERSION) + _encoder.encode(connection_epoch)


class Outbox:
    """Sends on the control socket. What a socket does not take at once is dropped and counted."""

    def __init__(
        self, control: zmq.Socket[bytes], limits: FrontLimits, drops: Drops, traffic: Traffic | None = None
    ) -> None:
        self._control = control
        self._limits = limits
        self._drops = drops
        self._traffic = traffic or Traffic()
        #: Connections found gone or too slow while sending, with the reason; the loop takes leave of them.
        self.failed: dict[int, str] = {}

    def send(self, connection: Connection, message: ServerMessage, *bulk: bytes) -> bool:
        """Sends one message, and bulk frames after it."""
        return self.send_encoded(connection, _encoder.encode(message), bulk)

    def send_encoded(self, connection: Connection, message: bytes, bulk: Sequence[bytes] = ()) -> bool:
        """Sends an encoded message. A connection that loses `slow_drops` messages in a row is listed as slow."""
        envelope = connection.prefix + message
        if self._send(connection.route, envelope, bulk):
            self._traffic.handed(connection.peer.descriptor, (envelope, *bulk))
            connection.drops_in_a_row = 0
            return True
        connection.drops_in_a_row += 1
        self._drops.count("send_queue_full", connection.number)
        if connection.drops_in_a_row >= self._limits.slow_drops:
            self.failed.setdefault(connection.number, "slow")
        return False

    def send_to_route(self, route: Route, message: ServerMessage) -> None:
        """Sends to somebody who has no connection number: a refusal, or a fault before `hello`."""
        if not self._send(route, server_prefix(0) + _encoder.encode(message), ()):
            self._drops.count("send_queue_full")

    def _send(self, route: Route, envelope: bytes, bulk: Sequence[bytes]) -> bool:
        frames = [route.routing_id, envelope, *bulk]
        if route.on_behalf_of:
            frames.append(route.on_behalf_of.encode())  # last frame: whom of those behind the gateway this is for
        try:
            self._control.send_multipart(frames, zmq.DONTWAIT)
        except zmq.ZMQError as error:
            if error.errno in (zmq.EAGAIN, zmq.EHOSTUNREACH):
                return False
            raise
        return True


def encode_message(message: ServerMessage) -> bytes:
    """Bytes for `Outbox.send_encoded`."""
    return _encoder.encode(message)
