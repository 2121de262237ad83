"""From a frame of a client to an entry: decode, limit, dispatch. Nothing that a client sends raises out of here."""

from __future__ import annotations

from typing import Final

import msgspec
import zmq

from iris_session.alignment.service import AlignmentService
from iris_session.front.admission import Admission
from iris_session.front.connection_guard import BEFORE_HELLO
from iris_session.front.connections import FrontConnection, Peer, Route
from iris_session.front.context import FrontContext
from iris_session.front.pairing import PairingService
from iris_session.front.status import StatusService
from iris_session.link.sockets import peer_of
from iris_session.protocol.client_messages import (
    ClientEnvelope,
    ClientMessage,
    ClockPing,
    EStop,
    Hello,
    Observation,
    Pair,
    Sample,
    Samples,
    TrackingEpoch,
)
from iris_session.protocol.codec import decode_client, get_tag
from iris_session.protocol.common import Denial
from iris_session.protocol.entries import Entry
from iris_session.protocol.errors import MalformedError, ProtocolError, ProtocolVersionError, RateError
from iris_session.protocol.limits import LIMITS, Drops, TokenBucket
from iris_session.protocol.names import PROTOCOL_VERSION, AuditKind, DenialReason, FaultCode, RefusalCode
from iris_session.protocol.server_messages import ClockPong, ProtocolFault, Refused, Reply
from iris_session.protocol.status import ClientReport, GetStatus
from iris_session.security import compute_fingerprint, decode_key
from iris_session.security.keyring import parse_pairing_key

#: Faults per second to peers without a connection, on which they could be limited.
_UNKNOWN_PEER_FAULTS: Final = 20
_RECORDER_HWM: Final = 20_000
#: A client above a rate limit for longer is reported as flooding.
FLOOD_NS: Final = 2_000_000_000
_encode = msgspec.msgpack.Encoder().encode


class RawFeed:
    """Forward samples and observations to the recorder: `[connection, receive_ns, message bytes]`.

    Never blocks. Without an endpoint nothing is forwarded. Messages are encoded again, not forwarded as received: so
    the recording holds nothing that the schema does not have, however large or deep a client made it.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, drops: Drops) -> None:
        self._drops = drops
        self._socket = context.socket(zmq.PUSH) if endpoint else None
        if self._socket is not None:
            self._socket.setsockopt(zmq.SNDHWM, _RECORDER_HWM)
            self._socket.setsockopt(zmq.LINGER, 200)
            self._socket.connect(endpoint)

    def send(self, connection: int, receive_ns: int, message: Sample | Observation) -> None:
        """Forward one message."""
        if self._socket is None:
            return
        try:
            self._socket.send(_encode((connection, receive_ns, _encode(message))), zmq.DONTWAIT)
        except zmq.Again:
            self._drops.count("recorder_queue_full", connection)


class Intake:
    """Handle messages of the control socket and offer entries to the coalescer.

    Attributes:
        replaced: Connections replaced by a new hello or another peer on their route. The loop disconnects them.
    """

    def __init__(
        self,
        context: FrontContext,
        admission: Admission,
        pairing: PairingService,
        status: StatusService,
        alignment: AlignmentService,
        raw: RawFeed,
    ) -> None:
        self._config = context.config
        self._connections = context.connections
        self._outbox = context.outbox
        self._coalescer = context.coalescer
        self._drops = context.drops
        self._audit = context.audit
        self._guard = context.guard
        self._now_ns = context.now_ns
        self._admission = admission
        self._pairing = pairing
        self._status = status
        self._alignment = alignment
        self._raw = raw
        self._unknown_peer_faults = TokenBucket(_UNKNOWN_PEER_FAULTS, _UNKNOWN_PEER_FAULTS)
        self.replaced: list[FrontConnection] = []

    def handle_message(self, routing_id: bytes, peer: Peer, data: memoryview, extra_frames: int) -> None:
        """Handle one message of the socket."""
        now_ns = self._now_ns()
        route = Route(routing_id)
        try:
            if extra_frames:
                raise MalformedError(f"a client message is one frame, got {1 + extra_frames}")
            envelope = decode_client(data)
        except ProtocolError as error:
            self._reject_unreadable(route, peer, error, now_ns)
            return
        if envelope.on_behalf_of:
            route = Route(routing_id, envelope.on_behalf_of)
            self._touch_gateway(Route(routing_id), peer, now_ns)
        self._dispatch(route, peer, envelope, now_ns)

    def _touch_gateway(self, route: Route, peer: Peer, now_ns: int) -> None:
        gateway = self._connections.find(route, peer)
        if gateway is not None:
            gateway.last_heard_ns = now_ns

    def _dispatch(self, route: Route, peer: Peer, envelope: ClientEnvelope, now_ns: int) -> None:
        message = envelope.message
        if isinstance(message, Pair):
            self._guard.touch(peer.descriptor, now_ns)
            self._count_rejection(peer, None, now_ns)
            self._pairing.handle_pair(route, peer, message, now_ns)
            return
        if parse_pairing_key(peer.user_id):
            self._reject_unpaired(route, peer, message, now_ns)
            return
        connection = self._connections.by_route.get(route)
        if connection is not None and (connection.peer != peer or isinstance(message, Hello)):
            self.replaced.append(connection)
            self._connections.remove(connection)
            connection = None
        if connection is None and isinstance(message, EStop):
            self._forward_late_estop(route, peer, envelope, now_ns)
        if isinstance(message, Hello):
            entry = self._admission.handle_hello(route, peer, message, now_ns)
            if entry is not None:
                self._coalescer.offer(entry)
            else:
                self._count_rejection(peer, None, now_ns)
        elif route.on_behalf_of and self._admission.find_gateway(route.routing_id, peer) is None:
            self._admission.report_forged_gateway(route, peer, now_ns)
            self._count_rejection(peer, None, now_ns)
            self._send_fault(route, None, FaultCode.HELLO, "only a gateway speaks on behalf of others", now_ns)
        elif connection is None:
            self._count_rejection(peer, None, now_ns)
            text = "this connection has not said hello: say hello (again)"
            self._send_fault(route, None, FaultCode.HELLO, text, now_ns)
        else:
            self._handle_from_connection(connection, envelope, now_ns)

    def _forward_late_estop(self, route: Route, peer: Peer, envelope: ClientEnvelope, now_ns: int) -> None:
        """Forward the e-stop of a client that was disconnected and does not know it yet."""
        kept = self._connections.find_kept(route, peer)
        if kept is not None:
            self._coalescer.offer(Entry(kept.number, envelope.connection_epoch, now_ns, envelope.message))  # type: ignore[arg-type]

    def _reject_unpaired(self, route: Route, peer: Peer, message: ClientMessage, now_ns: int) -> None:
        """Reject a message other than `Pair` of a key that is not on the list."""
        self._drops.count("unpaired")
        self._count_rejection(peer, None, now_ns)
        mark, name = compute_fingerprint(decode_key(parse_pairing_key(peer.user_id))), getattr(message, "name", "")
        address = peer_of(peer.descriptor)[0]
        self._audit.record(
            AuditKind.KEY_REFUSED, now_ns, subject=mark, name=name, address=address, detail=get_tag(type(message))
        )
        if self._unknown_peer_faults.take(now_ns):
            text, advice = "this key is not on the session's list", "run `iris-session pair` there, join with its code"
            self._outbox.send_to_route(route, Refused(RefusalCode.UNPAIRED, text, advice))

    def _handle_from_connection(self, connection: FrontConnection, envelope: ClientEnvelope, now_ns: int) -> None:
        message = envelope.message
        connection.last_heard_ns = now_ns
        if not connection.admitted and not isinstance(message, (GetStatus, EStop)):  # anyone may stop, however early
            self._drops.count("not_admitted", connection.number)
            self._count_rejection(connection.peer, connection, now_ns, get_tag(type(message)))
            return
        if not connection.confirmed and envelope.connection_epoch == connection.number:
            connection.confirmed = True
            self._admission.confirm(connection)
        kind = type(message)
        late = connection.late_epoch
        if late is not None and kind is not TrackingEpoch and connection.rates.allow(TrackingEpoch, now_ns):
            connection.late_epoch = None
            self._coalescer.offer(late)
        if not connection.rates.allow(kind, now_ns) and kind is not EStop:
            self._count_flood(connection, get_tag(kind), now_ns)
            if isinstance(message, TrackingEpoch):  # the newest must get through: samples of the old frame would move
                connection.late_epoch = Entry(connection.number, envelope.connection_epoch, now_ns, message)
                return
            limit = LIMITS[kind]
            error = RateError(get_tag(kind), limit.per_second, limit.burst)
            self._send_fault(connection.route, connection, error.code, str(error), now_ns)
            self._send_denial(connection, message, str(error), now_ns)
            return
        if isinstance(message, TrackingEpoch):
            connection.late_epoch = None
        if isinstance(message, GetStatus):
            self._status.send_report(connection, message, now_ns)
            return
        if isinstance(message, ClientReport):
            self._status.record_report(connection, message, now_ns)
            return
        if isinstance(message, Samples):
            self._handle_samples(connection, envelope.connection_epoch, message, now_ns)
            return
        if isinstance(message, ClockPing):
            self._outbox.send(connection, ClockPong(message.t0_ns, now_ns, self._now_ns()))
            return
        if isinstance(message, Sample):
            self._raw.send(connection.number, now_ns, message)
            self._observe_sample(connection, message, now_ns)
        elif isinstance(message, Observation):
            self._raw.send(connection.number, now_ns, message)
            self._alignment.process_observation(connection, message, now_ns)
            if not self._config.forward_observations:
                return
        entry = Entry(connection.number, envelope.connection_epoch, now_ns, message)  # type: ignore[arg-type]
        if not self._coalescer.offer(entry) and not isinstance(message, Sample):
            text = f"{get_tag(kind)}: queue to the session full: send less"
            if not self._send_denial(connection, message, text, now_ns):
                self._send_fault(connection.route, connection, FaultCode.RATE, text, now_ns)

    def _send_denial(self, connection: FrontConnection, message: ClientMessage, text: str, now_ns: int) -> bool:
        """Deny a request that was rejected, at a bounded rate, because its client waits for a reply.

        Returns whether the message is a request.
        """
        request_id = getattr(message, "request_id", 0)
        if request_id and connection.denials.take(now_ns):
            denial = Denial(DenialReason.QUOTA, text, "send less, or the same again in a moment")
            self._outbox.send(connection, Reply(request_id, False, denial))
        return bool(request_id)

    def _handle_samples(self, connection: FrontConnection, epoch: int, samples: Samples, now_ns: int) -> None:
        """Handle each sample within the rate limit of single samples."""
        for sample in samples.samples:
            if connection.rates.allow(Sample, now_ns):
                self._raw.send(connection.number, now_ns, sample)
                self._observe_sample(connection, sample, now_ns)
                self._coalescer.offer(Entry(connection.number, epoch, now_ns, sample))
            else:
                self._drops.count(FaultCode.RATE, connection.number)
                self._count_flood(connection, "sample", now_ns)

    def _observe_sample(self, connection: FrontConnection, sample: Sample, now_ns: int) -> None:
        """Pass every sample on to status and alignment, before samples are coalesced."""
        self._status.record_sample(connection.number, sample, now_ns)
        self._alignment.process_sample(connection, sample, now_ns)

    def _count_rejection(
        self, peer: Peer, connection: FrontConnection | None, now_ns: int, detail: str = BEFORE_HELLO
    ) -> None:
        """Count a rejected message. Too many of them close the TCP connection."""
        if self._guard.rate_limit(peer, connection, detail, now_ns) and connection is not None:
            self._outbox.failed.setdefault(connection.number, "flood")

    def _count_flood(self, connection: FrontConnection, tag: str, now_ns: int) -> None:
        """Count a message above a rate limit, and report a client that is above it for seconds."""
        self._count_rejection(connection.peer, connection, now_ns, tag)
        if now_ns - connection.flood_last_ns > FLOOD_NS:
            connection.flood_since_ns = now_ns
        connection.flood_last_ns = now_ns
        if now_ns - connection.flood_since_ns > FLOOD_NS:
            self._guard.report_flood(connection.address[0], tag, now_ns, connection)

    def _reject_unreadable(self, route: Route, peer: Peer, error: ProtocolError, now_ns: int) -> None:
        """Reject a message that cannot be decoded; before `hello` with a refusal, as the answer to it."""
        connection = self._connections.find(route, peer)
        self._count_rejection(peer, connection, now_ns, error.code if connection is not None else BEFORE_HELLO)
        if connection is not None:
            self._send_fault(route, connection, error.code, str(error), now_ns)
            return
        self._drops.count(f"hello_{error.code}")
        if self._unknown_peer_faults.take(now_ns):
            advice = "send the hello of docs/protocol.md"
            if isinstance(error, ProtocolVersionError):
                advice = f"update {'the client' if error.version < PROTOCOL_VERSION else 'the session'}"
            self._outbox.send_to_route(route, Refused(error.code, str(error), advice))

    def _send_fault(self, route: Route, connection: FrontConnection | None, code: str, text: str, now_ns: int) -> None:
        """Count a fault, and send it at a bounded rate."""
        fault = ProtocolFault(code, text)
        if connection is None:
            self._drops.count(f"stranger_{code}")
            if self._unknown_peer_faults.take(now_ns):
                self._outbox.send_to_route(route, fault)
            return
        self._drops.count(code, connection.number)
        if connection.faults.take(now_ns):
            self._outbox.send(connection, fault)
