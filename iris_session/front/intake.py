"""From a frame of a client to an entry: decode, limit, dispatch. Nothing that a client sends raises past here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import msgspec
import zmq

from iris_session.alignment.service import Anchoring
from iris_session.front.admission import Admission
from iris_session.front.audit import AuditTrail
from iris_session.front.coalescer import Coalescer
from iris_session.front.connection_guard import BEFORE_HELLO, Doors
from iris_session.front.connections import ClientTable, Connection, Outbox, Peer, Route
from iris_session.front.pairing import PairingDesk
from iris_session.front.status import StatusDesk
from iris_session.link.config import FrontConfig
from iris_session.link.sockets import peer_of
from iris_session.protocol.client_messages import (
    ClientEnvelope,
    ClientMessage,
    ClockPing,
    EStop,
    Hello,
    Observation,
    Sample,
    Samples,
    TrackingEpoch,
)
from iris_session.protocol.codec import decode_client, tag_of
from iris_session.protocol.common import Denial
from iris_session.protocol.entries import Entry
from iris_session.protocol.errors import MalformedError, ProtocolError, RateError, VersionError
from iris_session.protocol.limits import LIMITS
from iris_session.protocol.names import PROTOCOL_VERSION, AuditKind, DenialReason, FaultCode, RefusalCode
from iris_session.protocol.security import Pair
from iris_session.protocol.server_messages import ClockPong, ProtocolFault, Refused, Reply
from iris_session.protocol.status import ClientReport, GetStatus
from iris_session.protocol.token_bucket import Drops, TokenBucket
from iris_session.security import compute_fingerprint, decode_key
from iris_session.security.keyring import parse_pairing_key

#: Faults to strangers, per second: they have no connection to count on.
_STRANGER_FAULTS: Final = 20
_RECORDER_HWM: Final = 20_000
#: Who is above a rate limit for longer floods.
FLOOD_NS: Final = 2_000_000_000
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
        status: StatusDesk,
        pairing: PairingDesk,
        audit: AuditTrail,
        doors: Doors,
        anchoring: Anchoring,
    ) -> None:
        self._config = config
        self._clients = clients
        self._outbox = outbox
        self._admission = admission
        self._coalescer = coalescer
        self._raw = raw
        self._drops = drops
        self._session_ns = session_ns
        self._status = status
        self._pairing = pairing
        self._audit = audit
        self._doors = doors
        self._anchoring = anchoring
        self._stranger_faults = TokenBucket(_STRANGER_FAULTS, _STRANGER_FAULTS)
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
        if isinstance(message, Pair):
            self._doors.busy(peer.descriptor, now_ns)
            self._not_taken(peer, None, now_ns)
            self._pairing.take(route, peer, message, now_ns)
            return
        if parse_pairing_key(peer.user_id):
            self._stranger(route, peer, message, now_ns)
            return
        connection = self._clients.by_route.get(route)
        if connection is not None and (connection.peer != peer or isinstance(message, Hello)):
            self.replaced.append(connection)
            self._clients.remove(connection)
            connection = None
        if connection is None and isinstance(message, EStop):
            self._late_stop(route, peer, envelope, now_ns)
        if isinstance(message, Hello):
            entry = self._admission.hello(route, peer, message, now_ns)
            if entry is not None:
                self._coalescer.offer(entry)
            else:
                self._not_taken(peer, None, now_ns)
        elif route.on_behalf_of and self._admission.gateway(route.routing_id, peer) is None:
            self._admission.forged(route, peer, now_ns)
            self._not_taken(peer, None, now_ns)
            self._fault(route, None, FaultCode.HELLO, "only a gateway speaks on behalf of others", now_ns)
        elif connection is None:
            self._not_taken(peer, None, now_ns)
            self._fault(route, None, FaultCode.HELLO, "this connection has not said hello: say hello (again)", now_ns)
        else:
            self._from_connection(connection, envelope, now_ns)

    def _late_stop(self, route: Route, peer: Peer, envelope: ClientEnvelope, now_ns: int) -> None:
        """An e-stop of somebody who was given up, and does not know it yet, counts."""
        lost = self._clients.given_up(route, peer)
        if lost is not None:
            self._coalescer.offer(Entry(lost.number, envelope.connection_epoch, now_ns, envelope.message))  # type: ignore[arg-type]

    def _stranger(self, route: Route, peer: Peer, message: ClientMessage, now_ns: int) -> None:
        """A key that is not on the list said something else than `Pair`."""
        self._drops.count("unpaired")
        self._not_taken(peer, None, now_ns)
        mark, name = compute_fingerprint(decode_key(parse_pairing_key(peer.user_id))), getattr(message, "name", "")
        address = peer_of(peer.descriptor)[0]
        self._audit.note(
            AuditKind.KEY_REFUSED, now_ns, subject=mark, name=name, address=address, detail=tag_of(type(message))
        )
        if self._stranger_faults.take(now_ns):
            text, advice = "this key is not on the session's list", "run `iris-session pair` there, join with its code"
            self._outbox.send_to_route(route, Refused(RefusalCode.UNPAIRED, text, advice))

    def _from_connection(self, connection: Connection, envelope: ClientEnvelope, now_ns: int) -> None:
        message = envelope.message
        connection.last_heard_ns = now_ns
        if not connection.admitted and not isinstance(message, (GetStatus, EStop)):  # anyone may stop, however early
            self._drops.count("not_admitted", connection.number)
            self._not_taken(connection.peer, connection, now_ns, tag_of(type(message)))
            return
        if not connection.confirmed and envelope.connection_epoch == connection.number:
            connection.confirmed = True
            self._admission.confirmed(connection)
        kind = type(message)
        late = connection.late_epoch
        if late is not None and kind is not TrackingEpoch and connection.rates.allow(TrackingEpoch, now_ns):
            connection.late_epoch = None
            self._coalescer.offer(late)
        if not connection.rates.allow(kind, now_ns) and kind is not EStop:
            self._flooded(connection, tag_of(kind), now_ns)
            if isinstance(message, TrackingEpoch):  # the newest must get through: samples of the old frame would move
                connection.late_epoch = Entry(connection.number, envelope.connection_epoch, now_ns, message)
                return
            limit = LIMITS[kind]
            error = RateError(tag_of(kind), limit.per_second, limit.burst)
            self._fault(connection.route, connection, error.code, str(error), now_ns)
            self._deny(connection, message, str(error), now_ns)
            return
        if isinstance(message, TrackingEpoch):
            connection.late_epoch = None
        if isinstance(message, GetStatus):
            self._status.asked(connection, message, now_ns)
            return
        if isinstance(message, ClientReport):
            self._status.reported(connection.number, message, now_ns)
            return
        if isinstance(message, Sample):
            self._look_at(connection, message, now_ns)
        elif isinstance(message, Samples):
            self._samples(connection, envelope.connection_epoch, message, now_ns)
            return
        elif isinstance(message, ClockPing):
            self._outbox.send(connection, ClockPong(message.t0_ns, now_ns, self._session_ns()))
            return
        elif isinstance(message, Observation):
            self._raw.put(connection.number, now_ns, message)
            self._anchoring.observed(connection, message, now_ns)
            if not self._config.forward_observations:
                return
        entry = Entry(connection.number, envelope.connection_epoch, now_ns, message)  # type: ignore[arg-type]
        if not self._coalescer.offer(entry) and not isinstance(message, Sample):
            text = f"{tag_of(kind)}: the session does not keep up with what this client sends"
            if not self._deny(connection, message, text, now_ns):
                self._fault(connection.route, connection, FaultCode.RATE, text, now_ns)

    def _deny(self, connection: Connection, message: ClientMessage, text: str, now_ns: int) -> bool:
        """Answers a request that is not taken, at a bounded rate: somebody waits for it. False: it is none."""
        request_id = getattr(message, "request_id", 0)
        if request_id and connection.denials.take(now_ns):
            denial = Denial(DenialReason.QUOTA, text, "send less, or the same again in a moment")
            self._outbox.send(connection, Reply(request_id, False, denial))
        return bool(request_id)

    def _samples(self, connection: Connection, epoch: int, samples: Samples, now_ns: int) -> None:
        """Each within the rate of single samples."""
        for sample in samples.samples:
            if connection.rates.allow(Sample, now_ns):
                self._look_at(connection, sample, now_ns)
                self._coalescer.offer(Entry(connection.number, epoch, now_ns, sample))
            else:
                self._drops.count(FaultCode.RATE, connection.number)
                self._flooded(connection, "sample", now_ns)

    def _look_at(self, connection: Connection, sample: Sample, now_ns: int) -> None:
        """What is done with every sample as it came, before samples are coalesced."""
        self._raw.put(connection.number, now_ns, sample)
        self._status.sampled(connection.number, sample, now_ns)
        self._anchoring.sampled(connection, sample, now_ns)

    def _not_taken(self, peer: Peer, connection: Connection | None, now_ns: int, what: str = BEFORE_HELLO) -> None:
        """Counts towards being cut off."""
        if self._doors.excess(peer, connection, what, now_ns) and connection is not None:
            self._outbox.failed.setdefault(connection.number, "flood")

    def _flooded(self, connection: Connection, tag: str, now_ns: int) -> None:
        """Above its limits for seconds: no slip any more."""
        self._not_taken(connection.peer, connection, now_ns, tag)
        if now_ns - connection.flood_last_ns > FLOOD_NS:
            connection.flood_since_ns = now_ns
        connection.flood_last_ns = now_ns
        if now_ns - connection.flood_since_ns > FLOOD_NS:
            self._doors.flood(connection.address[0], tag, now_ns, connection)

    def _unreadable(self, route: Route, peer: Peer, error: ProtocolError, now_ns: int) -> None:
        """Before `hello` this is the answer to it, so it is a refusal."""
        connection = self._clients.find(route, peer)
        self._not_taken(peer, connection, now_ns, error.code if connection is not None else BEFORE_HELLO)
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
