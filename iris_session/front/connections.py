"""Connections of the front, the table of them, and sending to them without waiting.

A connection is one accepted `hello`. It is found by its route: the ZeroMQ routing id and, behind a gateway, the name
that the gateway gave. It is bound to the TCP connection and key that said `hello`: another peer with the same routing
id does not get it. Limits on TCP connections are in `connection_guard`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import msgspec
import zmq

from iris_session.front.key_budgets import KeyBudget
from iris_session.link.config import SECOND, FrontLimits
from iris_session.link.tcp_guard import TrafficCounter
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.entries import Entry
from iris_session.protocol.limits import Drops, RateLimiter, TokenBucket
from iris_session.protocol.names import PROTOCOL_VERSION
from iris_session.protocol.server_messages import ServerMessage
from iris_session.protocol.status import ClientReport

_encoder = msgspec.msgpack.Encoder()
#: Disconnected connections that may still stop the session.
MAX_KEPT: Final = 256
#: A client's report that is older says nothing about the present.
REPORT_EXPIRY_NS: Final = 3 * SECOND


class Route(NamedTuple):
    """Origin of a message. `on_behalf_of` is empty except for participants behind a gateway."""

    routing_id: bytes
    on_behalf_of: str = ""


class Peer(NamedTuple):
    """TCP connection and CURVE user id (a fingerprint, empty without encryption) by which a message came."""

    descriptor: int
    user_id: str


@dataclass(slots=True, eq=False)
class FrontConnection:
    """One accepted `hello`, until the connection is removed.

    Attributes:
        number: Connection number, which the protocol calls connection epoch.
        budget: What its key may send and cause, shared by all connections of the key.
        gateway: Number of the gateway that speaks for this connection, 0 for none.
        web: Its key is the web identity of a person behind the gateway.
        role: As said in `hello`, or as a director has set it since.
        participant_id: Assigned by the authority, empty before.
        confirmed: A message with this connection epoch has come, so the client has its `Welcome`.
        flood_last_ns, flood_since_ns: When a rate limit was last exceeded, and since when without a pause.
        late_epoch: The newest tracking epoch that came above its rate limit.
        prefix: Encoded start of every `ServerEnvelope` to this connection.
        presence_due_ns: Session time of the next sample that counts, by device of an observer.
        presence_worn: Whether the headset of an observer is worn, as its last sample that counted says.
        report: The client's newest report, and `reported_ns` when it came.
        worn: Whether its headset is worn, as it said last.
        clutches: Whether the clutch is closed, by device, as it said last.
    """

    number: int
    route: Route
    peer: Peer
    address: tuple[str, int]
    key_id: str
    hello: Hello
    gateway: int
    budget: KeyBudget = field(default_factory=lambda: KeyBudget(FrontLimits()))
    web: bool = False
    role: str = ""
    admitted: bool = False
    participant_id: str = ""
    confirmed: bool = False
    last_heard_ns: int = 0
    consecutive_drops: int = 0
    flood_last_ns: int = 0
    flood_since_ns: int = 0
    faults: TokenBucket = field(default_factory=lambda: TokenBucket(2.0, 5))
    #: As many as an honest client makes requests of one kind.
    denials: TokenBucket = field(default_factory=lambda: TokenBucket(20.0, 40))
    late_epoch: Entry | None = None
    rates: RateLimiter = field(default_factory=RateLimiter)
    presence_due_ns: dict[str, int] = field(default_factory=dict)
    presence_worn: bool = True
    report: ClientReport | None = None
    reported_ns: int = 0
    worn: bool = True
    clutches: dict[str, bool] = field(default_factory=dict)
    prefix: bytes = field(init=False)

    def __post_init__(self) -> None:
        self.role = self.role or self.hello.role
        self.prefix = encode_envelope_prefix(self.number)

    def recent_report(self, now_ns: int) -> ClientReport | None:
        """Return the client's newest report, `None` if it is older than `REPORT_EXPIRY_NS`."""
        return self.report if now_ns - self.reported_ns <= REPORT_EXPIRY_NS else None


class ConnectionTable:
    """All connections, by number and by route."""

    def __init__(self) -> None:
        self.by_number: dict[int, FrontConnection] = {}
        self.by_route: dict[Route, FrontConnection] = {}
        self._kept: dict[tuple[Route, Peer], FrontConnection] = {}

    def __len__(self) -> int:
        return len(self.by_number)

    def add(self, connection: FrontConnection) -> None:
        connection.budget.connections += 1
        self.by_number[connection.number] = connection
        self.by_route[connection.route] = connection

    def remove(self, connection: FrontConnection) -> None:
        if self.by_number.pop(connection.number, None) is not None:
            connection.budget.connections -= 1
        if self.by_route.get(connection.route) is connection:
            del self.by_route[connection.route]

    def find(self, route: Route, peer: Peer) -> FrontConnection | None:
        """Return the connection of a route, if its peer is the one that said `hello`."""
        connection = self.by_route.get(route)
        return connection if connection is not None and connection.peer == peer else None

    def list_behind(self, gateway: FrontConnection) -> list[FrontConnection]:
        """Return the connections that a gateway speaks for."""
        return [c for c in self.by_number.values() if c.gateway == gateway.number]

    def list_of_key(self, key_id: str) -> list[FrontConnection]:
        """Return the connections of a key."""
        return [c for c in self.by_number.values() if c.key_id == key_id]

    # Connections that were disconnected while their TCP connections stay open. Their clients may not know yet, and an
    # e-stop of theirs still counts.

    @property
    def kept(self) -> Collection[FrontConnection]:
        """Disconnected connections whose TCP connections are open."""
        return self._kept.values()

    def keep_for_estop(self, connection: FrontConnection) -> None:
        """Keep a disconnected connection, because its client may still send an e-stop."""
        self._kept.pop((connection.route, connection.peer), None)
        while len(self._kept) >= MAX_KEPT:
            del self._kept[next(iter(self._kept))]
        self._kept[connection.route, connection.peer] = connection

    def find_kept(self, route: Route, peer: Peer) -> FrontConnection | None:
        """Return the disconnected connection of a peer."""
        return self._kept.get((route, peer))

    def expire_kept(self, heard_before_ns: int) -> None:
        """Remove kept connections that have sent nothing since then."""
        for key, connection in list(self._kept.items()):
            if connection.last_heard_ns < heard_before_ns:
                del self._kept[key]

    def remove_closed(self, descriptor: int, address: tuple[str, int]) -> None:
        """Remove kept connections of a closed TCP connection. `address`: of the peer that has its descriptor now."""
        for key, connection in list(self._kept.items()):
            if key[1].descriptor == descriptor and (connection.address != address or not address[1]):
                del self._kept[key]


def encode_envelope_prefix(connection_epoch: int) -> bytes:
    """Encode a `ServerEnvelope` up to its message, so that one encoded message serves every connection."""
    return b"\x93" + _encoder.encode(PROTOCOL_VERSION) + _encoder.encode(connection_epoch)


class ControlSender:
    """Send on the control socket. A message for which a send queue has no room is dropped and counted.

    Attributes:
        failed: Reason by number of connections found slow while sending. The loop disconnects them.
    """

    def __init__(
        self, control: zmq.Socket[bytes], limits: FrontLimits, drops: Drops, traffic: TrafficCounter | None = None
    ) -> None:
        self._control = control
        self._limits = limits
        self._drops = drops
        self._traffic = traffic or TrafficCounter()
        self.failed: dict[int, str] = {}

    def send(self, connection: FrontConnection, message: ServerMessage, *bulk: bytes) -> bool:
        """Send one message, and bulk frames after it. Return whether there was room."""
        return self.send_encoded(connection, _encoder.encode(message), bulk)

    def send_encoded(self, connection: FrontConnection, message: bytes, bulk: Sequence[bytes] = ()) -> bool:
        """Send an encoded message. A connection that loses `slow_drops` messages in a row is listed as slow."""
        envelope = connection.prefix + message
        if self._send(connection.route, envelope, bulk):
            self._traffic.count_sent(connection.peer.descriptor, (envelope, *bulk))
            connection.consecutive_drops = 0
            return True
        connection.consecutive_drops += 1
        self._drops.count("send_queue_full", connection.number)
        if connection.consecutive_drops >= self._limits.slow_drops:
            self.failed.setdefault(connection.number, "slow")
        return False

    def send_to_route(self, route: Route, message: ServerMessage) -> None:
        """Send to a peer without a connection number: a refusal, or a fault before `hello`."""
        if not self._send(route, encode_envelope_prefix(0) + _encoder.encode(message), ()):
            self._drops.count("send_queue_full")

    def _send(self, route: Route, envelope: bytes, bulk: Sequence[bytes]) -> bool:
        frames = [route.routing_id, envelope, *bulk]
        if route.on_behalf_of:
            frames.append(route.on_behalf_of.encode())  # last frame: the recipient behind the gateway
        try:
            self._control.send_multipart(frames, zmq.DONTWAIT)
        except zmq.ZMQError as error:
            if error.errno in (zmq.EAGAIN, zmq.EHOSTUNREACH):
                return False
            raise
        return True
