"""From a frame of a client to an entry: decode, limit, dispatch. Nothing that a client sends raises past here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import msgspec
import zmq

from iris_session.protocol.client_messages import (
    ClientEnvelope,
    ClientMessage,
    ClockPing,
    EStop,
    Hello,
    Observation,
    Sample,
)
from iris_session.protocol.codec import decode_client, tag_of
from iris_session.protocol.entries import Entry
from iris_session.protocol.errors import MalformedError, ProtocolError, RateError, VersionError
from iris_session.protocol.limits import LIMITS
from iris_session.protocol.names import PROTOCOL_VERSION, FaultCode
from iris_session.protocol.server_messages import ClockPong, ProtocolFault, Refused
from iris_session.transport.admission import Admission
from iris_session.transport.alignment_desk import AlignmentDesk
from iris_session.transport.clients import ClientTable, Connection, Outbox, Peer, Route
from iris_session.transport.coalescer import Coalescer
from iris_session.transport.config import FrontConfig
from iris_session.transport.limiter import Drops, TokenBucket

#: Faults to strangers, per second: they have no connection to count on.
_STRANGER_FAULTS: Final = 20
_RECORDER_HWM: Final = 20_000
_encode = msgspec.msgpack.Encoder().encode


class RawFeed:
    """Raw samples and observations to the recorder, `[connection, receive_ns, message bytes]`. Never blocks."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, drops: Drops) -> None:
        self._drops = drops
        self._socket = context.socket(zmq.PUSH) if endpoint else None
        if self._socket is not None:
            self._socket.setsockopt(zmq.SNDHWM, _RECORDER_HWM)
            self._socket.setsockopt(zmq.LINGER, 200)
            self._socket.connect(endpoint)

    def put(self, connection: int, receive_ns: int, message: ClientMessage) -> None:
        if self._socket is None:
            return
        try:
            self._socket.send(_encode((connection, receive_ns, _encode(message))), zmq.DONTWAIT)
        except zmq.Again:
            self._drops.count("recorder_queue_full", connection)


class Intake:
    """Takes what arrives on the control socket. `entries` go to `coalescer`."""

    def __init__(
        self,
        config: FrontConfig,
        clients: ClientTable,
        outbox: Outbox,
        admission: Admission,
        coalescer: Coalescer,
        raw: RawFeed,
        drops: Drops,
        session_ns: Callable[[], int],
    ) -> None:
        self._config = config
        self._clients = clients
        self._outbox = outbox
        self._admission = admission
        self._coalescer = coalescer
        self._raw = raw
        self._drops = drops
        self._session_ns = session_ns
        self._stranger_faults = TokenBucket(_STRANGER_FAULTS, _STRANGER_FAULTS)
        self._anchors = {name: (pose.p, pose.q) for name, pose in config.anchors.items()}
        #: Connections that have observations to estimate from.
        self.desks: dict[int, AlignmentDesk] = {}
        #: Connections replaced by a new hello or peer on the same route; the loop takes leave of them.
        self.replaced: list[Connection] = []

    def take(self, routing_id: bytes, peer: Peer, data: memoryview, extra_frames: int) -> None:
        """One message from the socket."""
        now_ns = self._session_ns()
        route = Route(routing_id)
        try:
            if extra_frames:
                raise MalformedError(f"a client message is one frame, got {1 + extra_frames}")
            envelope = decode_client(data)
        except ProtocolError as error:
            self._unreadable(route, peer, error, now_ns)
            return
        if envelope.on_behalf_of:
            route = Route(routing_id, envelope.on_behalf_of)
            self._heard_gateway(Route(routing_id), peer, now_ns)
        self._dispatch(route, peer, envelope, now_ns)

    def _heard_gateway(self, route: Route, peer: Peer, now_ns: int) -> None:
        gateway = self._clients.find(route, peer)
        if gateway is not None:
            gateway.last_heard_ns = now_ns

    def _dispatch(self, route: Route, peer: Peer, envelope: ClientEnvelope, now_ns: int) -> None:
        message = envelope.message
        connection = self._clients.by_route.get(route)
        if connection is not None and (connection.peer != peer or isinstance(message, Hello)):
            self.replaced.append(connection)
            self._clients.remove(connection)
            connection = None
        if isinstance(message, Hello):
            entry = self._admission.hello(route, peer, message, now_ns)
            if entry is not None:
                self._coalescer.offer(entry)
        elif connection is None:
            self._fault(route, None, FaultCode.HELLO, "this connection has not said hello: say hello (again)", now_ns)
        else:
            self._from_connection(connection, envelope, now_ns)

    def _from_connection(self, connection: Connection, envelope: ClientEnvelope, now_ns: int) -> None:
        message = envelope.message
        connection.last_heard_ns = now_ns
        if not connection.admitted:
            self._drops.count("not_admitted", connection.number)
            return
        if not connection.confirmed and envelope.connection_epoch == connection.number:
            connection.confirmed = True
            self._admission.confirmed(connection)
        kind = type(message)
        if not connection.rates.allow(kind, now_ns) and kind is not EStop:
            limit = LIMITS[kind]
            error = RateError(tag_of(kind), limit.per_second, limit.burst)
            self._fault(connection.route, connection, error.code, str(error), now_ns)
            return
        if isinstance(message, Sample):
            self._raw.put(connection.number, now_ns, message)
        elif isinstance(message, ClockPing):
            self._outbox.send(connection, ClockPong(message.t0_ns, now_ns, self._session_ns()))
            return
        elif isinstance(message, Observation):
            self._raw.put(connection.number, now_ns, message)
            self._observe(connection, message)
            if not self._config.forward_observations:
                return
        self._coalescer.offer(Entry(connection.number, envelope.connection_epoch, now_ns, message))  # type: ignore[arg-type]

    def _observe(self, connection: Connection, observation: Observation) -> None:
        desk = self.desks.get(connection.number)
        if desk is None:
            desk = self.desks[connection.number] = AlignmentDesk(self._anchors, self._config.proposal_period_ns)
        if not desk.observe(observation):
            self._drops.count("observation_unusable", connection.number)

    def _unreadable(self, route: Route, peer: Peer, error: ProtocolError, now_ns: int) -> None:
        """Before `hello` this is the answer to it, so it is a refusal."""
        connection = self._clients.find(route, peer)
        if connection is not None:
            self._fault(route, connection, error.code, str(error), now_ns)
            return
        self._drops.count(f"hello_{error.code}")
        if self._stranger_faults.take(now_ns):
            advice = "send the hello of docs/protocol.md"
            if isinstance(error, VersionError):
                advice = f"update {'the client' if error.version < PROTOCOL_VERSION else 'the session'}"
            self._outbox.send_to_route(route, Refused(error.code, str(error), advice))

    def _fault(self, route: Route, connection: Connection | None, code: str, text: str, now_ns: int) -> None:
        """Counts, and says so at a bounded rate."""
        fault = ProtocolFault(code, text)
        if connection is None:
            self._drops.count(f"stranger_{code}")
            if self._stranger_faults.take(now_ns):
                self._outbox.send_to_route(route, fault)
            return
        self._drops.count(code, connection.number)
        if connection.faults.take(now_ns):
            self._outbox.send(connection, fault)
