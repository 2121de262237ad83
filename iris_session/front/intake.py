"""From a frame of a client to an entry: decode, limit, dispatch. Nothing that a client sends raises out of here."""

from __future__ import annotations

from typing import Final

from iris_session.alignment.service import AlignmentService
from iris_session.front.admission import Admission
from iris_session.front.connection_guard import BEFORE_HELLO
from iris_session.front.connections import FrontConnection, Peer, Route
from iris_session.front.context import FrontContext
from iris_session.front.key_budgets import ESTOPS_MERGED, describe_excess
from iris_session.front.pairing import PairingService
from iris_session.front.raw_feed import REQUEST_BYTES_PER_S, REQUEST_SHARE, PresenceLimiter, RawFeed
from iris_session.front.status import StatusService
from iris_session.link.sockets import peer_of
from iris_session.protocol.client_messages import (
    ClientEnvelope,
    ClientMessage,
    ClockPing,
    Disconnected,
    EStop,
    Heartbeat,
    Hello,
    Observation,
    Pair,
    Sample,
    Samples,
    TrackingEpoch,
)
from iris_session.protocol.codec import decode_client, get_tag, peek_on_behalf_of
from iris_session.protocol.common import Denial
from iris_session.protocol.entries import Entry
from iris_session.protocol.errors import MalformedError, ProtocolError, ProtocolVersionError, RateError
from iris_session.protocol.limits import LIMITS, TokenBucket, count_events, weigh_request
from iris_session.protocol.names import PROTOCOL_VERSION, AuditKind, DenialReason, FaultCode, RefusalCode, Role
from iris_session.protocol.server_messages import ClockPong, ProtocolFault, Refused, Reply
from iris_session.protocol.status import ClientReport, GetStatus
from iris_session.security import compute_fingerprint, decode_key
from iris_session.security.keyring import parse_pairing_key

#: Faults per second to peers without a connection, on which they could be limited.
_UNKNOWN_PEER_FAULTS: Final = 20
#: A client above a rate limit for longer is reported as flooding.
FLOOD_NS: Final = 2_000_000_000
#: Events of an edge that makes something happen and will be undone: a headset put on, a clutch closed.
_EDGE_EVENTS: Final = 2
#: Why one behind a gateway was disconnected, as the gateway says; any other reason counts as the first.
LOST: Final = "closed"
_LOST_REASONS: Final = {reason: reason for reason in (LOST, "silent", "slow", "flood")}
#: Devices of one connection whose clutch is remembered: as many as a client may name in `hello`.
_MAX_DEVICES: Final = 32


class Intake:
    """Handle messages of the control socket and offer entries to the coalescer.

    Attributes:
        ended: Connections, by number, replaced by a new hello or another peer on their route, or whose gateway reports
            that they are lost; each with the reason. The loop disconnects them.
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
        self._context = context
        self._admission = admission
        self._pairing = pairing
        self._status = status
        self._alignment = alignment
        self._raw = raw
        self._presence = PresenceLimiter(context.drops)
        self._unknown_peer_faults = TokenBucket(_UNKNOWN_PEER_FAULTS, _UNKNOWN_PEER_FAULTS)
        self.ended: dict[int, tuple[FrontConnection, str]] = {}

    def handle_message(self, routing_id: bytes, peer: Peer, data: memoryview, extra_frames: int) -> None:
        """Handle one message of the socket."""
        now_ns = self._context.now_ns()
        route = Route(routing_id)
        try:
            if extra_frames:
                raise MalformedError(f"a client message is one frame, got {1 + extra_frames}")
            envelope = decode_client(data)
        except ProtocolError as error:
            # Behind a gateway it counts against the client that it names.
            name = peek_on_behalf_of(data)
            if name and self._admission.find_gateway(routing_id, peer) is not None:
                route = Route(routing_id, name)
            self._reject_unreadable(route, peer, error, now_ns)
            return
        if envelope.on_behalf_of:
            gateway = self._context.connections.find(route, peer)
            if gateway is not None:
                gateway.last_heard_ns = now_ns
            route = Route(routing_id, envelope.on_behalf_of)
        self._dispatch(route, peer, envelope, len(data), now_ns)

    def _dispatch(self, route: Route, peer: Peer, envelope: ClientEnvelope, size: int, now_ns: int) -> None:
        message = envelope.message
        if isinstance(message, Pair):
            self._context.guard.touch(peer.descriptor, now_ns)
            self._handle_pair(route, peer, message, now_ns)
            return
        if parse_pairing_key(peer.user_id):
            self._reject_unpaired(route, peer, message, now_ns)
            return
        connection = self._context.connections.by_route.get(route)
        if connection is not None and (connection.peer != peer or isinstance(message, Hello)):
            self._end_connection(connection, "replaced")
            connection = None
        if connection is None and isinstance(message, EStop):
            kept = self._context.connections.find_kept(route, peer)
            if kept is not None:  # a client that was disconnected, and does not know it yet
                self._offer_estop(kept, envelope, now_ns)
        if isinstance(message, Hello):
            entry = self._admission.handle_hello(route, peer, message, now_ns)
            if entry is not None:
                self._context.coalescer.offer(entry)
            else:
                self._count_unauthenticated(route, peer, now_ns)
        elif route.on_behalf_of and self._admission.find_gateway(route.routing_id, peer) is None:
            self._admission.report_forged_gateway(route, peer, now_ns)
            self._count_rejection(peer, None, now_ns)
            self._send_fault(route, None, FaultCode.HELLO, "only a gateway speaks on behalf of others", now_ns)
        elif isinstance(message, Disconnected):
            self._handle_disconnected(route, peer, message, connection, now_ns)
        elif connection is None:
            self._count_unauthenticated(route, peer, now_ns)
            text = "this connection has not said hello: say hello (again)"
            self._send_fault(route, None, FaultCode.HELLO, text, now_ns)
        else:
            self._handle_from_connection(connection, envelope, size, now_ns)

    def _handle_pair(self, route: Route, peer: Peer, pair: Pair, now_ns: int) -> None:
        gateway = self._admission.find_gateway(route.routing_id, peer) if route.on_behalf_of else None
        self._count_rejection(peer, gateway, now_ns)
        if route.on_behalf_of and gateway is None:
            self._admission.report_forged_gateway(route, peer, now_ns)
            self._send_fault(route, None, FaultCode.HELLO, "only a gateway speaks on behalf of others", now_ns)
        else:
            self._pairing.handle_pair(route, peer, pair, now_ns, gateway)

    def _end_connection(self, connection: FrontConnection, reason: str) -> None:
        self.ended[connection.number] = (connection, reason)
        self._context.connections.remove(connection)

    def _handle_disconnected(
        self, route: Route, peer: Peer, message: Disconnected, connection: FrontConnection | None, now_ns: int
    ) -> None:
        """Disconnect one behind a gateway that reports it as lost. A client with a socket of its own closes that."""
        if not route.on_behalf_of:
            text = "only a gateway reports that others are disconnected: close the socket, or send bye"
            self._count_rejection(peer, connection, now_ns)
            self._send_fault(route, connection, FaultCode.HELLO, text, now_ns)
        elif connection is not None:
            self._end_connection(connection, _LOST_REASONS.get(message.reason, LOST))

    def _offer_estop(self, connection: FrontConnection, envelope: ClientEnvelope, now_ns: int) -> bool:
        """Offer an e-stop within the budget of its key. One above it is merged into the next one, half a second later
        at most, and counted. Return whether it was offered."""
        entry = Entry(connection.number, envelope.connection_epoch, now_ns, envelope.message)  # type: ignore[arg-type]
        if not connection.budget.take(now_ns, estops=1):
            self._context.coalescer.offer(entry)
            return True
        self._context.budgets.hold_estop(connection.key_id, connection.budget, entry)
        self._context.drops.count(ESTOPS_MERGED, connection.number)
        return False

    def _reject_unpaired(self, route: Route, peer: Peer, message: ClientMessage, now_ns: int) -> None:
        """Reject a message other than `Pair` of a key that is not on the list."""
        self._context.drops.count("unpaired")
        self._count_rejection(peer, None, now_ns)
        mark, name = compute_fingerprint(decode_key(parse_pairing_key(peer.user_id))), getattr(message, "name", "")
        address = peer_of(peer.descriptor)[0]
        self._context.audit.record(
            AuditKind.KEY_REFUSED, now_ns, subject=mark, name=name, address=address, detail=get_tag(type(message))
        )
        if self._unknown_peer_faults.take(now_ns):
            text, advice = "this key is not on the session's list", "run `iris-session pair` there, join with its code"
            self._context.outbox.send_to_route(route, Refused(RefusalCode.UNPAIRED, text, advice))

    def _handle_from_connection(
        self, connection: FrontConnection, envelope: ClientEnvelope, size: int, now_ns: int
    ) -> None:
        message = envelope.message
        connection.last_heard_ns = now_ns
        if not connection.admitted and not isinstance(message, (GetStatus, EStop)):  # anyone may stop, however early
            self._context.drops.count("not_admitted", connection.number)
            self._count_rejection(connection.peer, connection, now_ns, get_tag(type(message)))
            return
        if not connection.confirmed and envelope.connection_epoch == connection.number:
            connection.confirmed = True
            self._admission.confirm(connection)
        if isinstance(message, EStop):
            if not self._offer_estop(connection, envelope, now_ns):
                self._count_flood(connection, get_tag(EStop), now_ns)
            return
        kind = type(message)
        self._offer_late_epoch(connection, kind, now_ns)
        excess = self._check_rate(connection, message, size, now_ns)
        if excess:
            self._reject_excess(connection, envelope, excess, now_ns)
            return
        if isinstance(message, Heartbeat) and not self._allow_worn_change(connection, message.worn, now_ns):
            message = Heartbeat(connection.worn)  # it is alive, and as worn as before
        if isinstance(message, TrackingEpoch):
            connection.late_epoch = None
        if isinstance(message, GetStatus):
            self._status.send_report(connection, message, now_ns)
            return
        if isinstance(message, ClientReport):
            self._status.record_report(connection, message, now_ns)
            self._raw.send_report(connection, now_ns, message)
            return
        if isinstance(message, Samples):
            self._handle_samples(connection, envelope.connection_epoch, message, now_ns)
            return
        if isinstance(message, ClockPing):
            self._context.outbox.send(connection, ClockPong(message.t0_ns, now_ns, self._context.now_ns()))
            return
        if isinstance(message, Sample):
            self._offer_sample(connection, envelope.connection_epoch, message, now_ns)
            return
        if isinstance(message, Observation):
            self._raw.send(connection, now_ns, message)
            self._alignment.process_observation(connection, message, now_ns)
            if not self._context.config.forward_observations:
                return
        entry = Entry(connection.number, envelope.connection_epoch, now_ns, message)  # type: ignore[arg-type]
        if not self._context.coalescer.offer(entry):
            text = f"{get_tag(kind)}: queue to the session full: send less"
            if not self._send_denial(connection, message, text, now_ns):
                self._send_fault(connection.route, connection, FaultCode.RATE, text, now_ns)

    def _offer_late_epoch(self, connection: FrontConnection, kind: type, now_ns: int) -> None:
        """Offer the tracking epoch that was above a limit, unless `kind`, the message at hand, is a newer one."""
        late = connection.late_epoch
        if (
            late is not None
            and kind is not TrackingEpoch
            and connection.rates.allow(TrackingEpoch, now_ns)
            and not connection.budget.take(now_ns, events=1)
        ):
            connection.late_epoch = None
            self._context.coalescer.offer(late)

    def _check_rate(self, connection: FrontConnection, message: ClientMessage, size: int, now_ns: int) -> str:
        """Return which limit of its type or of its key a message exceeds, or an empty string."""
        kind = type(message)
        if not connection.rates.allow(kind, now_ns):
            limit = LIMITS[kind]
            return str(RateError(get_tag(kind), limit.per_second, limit.burst))
        n_messages = 1 + len(message.samples) if isinstance(message, Samples) else 1
        reason = connection.budget.take(now_ns, bytes=size, messages=n_messages)
        if not reason and not isinstance(message, (Sample, Samples)):
            scene = self._context.publisher.scene
            units, events = weigh_request(message, len(scene.bodies)), count_events(message, len(scene.robots))
            reason = connection.budget.take(now_ns, requests=units, events=events)
            if not reason and connection.role == Role.OBSERVER and not isinstance(message, Observation):
                reason = self._presence.take_request(connection, size, now_ns)
        if not reason:
            return ""
        self._context.drops.count(reason, connection.number)
        if reason == REQUEST_SHARE:
            return f"the requests of the observers of this key are above {REQUEST_BYTES_PER_S} bytes a second"
        return describe_excess(reason, self._context.config.limits.key)

    def _reject_excess(self, connection: FrontConnection, envelope: ClientEnvelope, excess: str, now_ns: int) -> None:
        message = envelope.message
        self._count_flood(connection, get_tag(type(message)), now_ns)
        if isinstance(message, TrackingEpoch):  # the newest must get through: samples of the old frame would move
            connection.late_epoch = Entry(connection.number, envelope.connection_epoch, now_ns, message)
            return
        self._send_fault(connection.route, connection, FaultCode.RATE, excess, now_ns)
        self._send_denial(connection, message, excess, now_ns)

    def _allow_worn_change(self, connection: FrontConnection, worn: bool, now_ns: int) -> bool:
        """Return whether a headset may be worn or not as a message says. Putting it on is an event, as is taking it off
        later, which passes always."""
        if worn and not connection.worn and not self._allow_clutch_edge(connection, now_ns):
            return False
        connection.worn = worn
        return True

    def _allow_clutch_edge(self, connection: FrontConnection, now_ns: int) -> bool:
        """Take an edge that makes something happen and will be undone from the budget of the key."""
        reason = connection.budget.take(now_ns, events=_EDGE_EVENTS)
        if reason:
            self._context.drops.count(reason, connection.number)
            self._count_flood(connection, get_tag(Sample), now_ns)
        return not reason

    def _allow_edges(self, connection: FrontConnection, sample: Sample, now_ns: int) -> bool:
        """Return whether the events that a sample causes are within the budget of its key.

        It causes some when the headset is put on or the clutch closes. The opposite passes always: it stops a robot.
        """
        if not self._allow_worn_change(connection, sample.worn, now_ns):
            return False
        closes = bool(sample.targets) and sample.clutch and not connection.clutches.get(sample.device, False)
        if closes and not self._allow_clutch_edge(connection, now_ns):
            return False
        if sample.device in connection.clutches or len(connection.clutches) < _MAX_DEVICES:
            # Closed without targets it drives nothing: the edge comes with them.
            connection.clutches[sample.device] = sample.clutch and bool(sample.targets)
        return True

    def _send_denial(self, connection: FrontConnection, message: ClientMessage, text: str, now_ns: int) -> bool:
        """Deny a request that was rejected, at a bounded rate, because its client waits for a reply.

        Returns whether the message is a request.
        """
        request_id = getattr(message, "request_id", 0)
        if request_id and connection.denials.take(now_ns):
            denial = Denial(DenialReason.QUOTA, text, "send less, or the same again in a moment")
            self._context.outbox.send(connection, Reply(request_id, False, denial))
        return bool(request_id)

    def _handle_samples(self, connection: FrontConnection, epoch: int, samples: Samples, now_ns: int) -> None:
        """Handle each sample within the rate limit of single samples."""
        for sample in samples.samples:
            if connection.rates.allow(Sample, now_ns):
                self._offer_sample(connection, epoch, sample, now_ns)
            else:
                self._context.drops.count(FaultCode.RATE, connection.number)
                self._count_flood(connection, "sample", now_ns)

    def _offer_sample(self, connection: FrontConnection, epoch: int, sample: Sample, now_ns: int) -> None:
        """Offer a sample to the authority and the recorder; status and alignment get it before it is limited."""
        self._status.record_sample(connection.number, sample, now_ns)
        self._alignment.process_sample(connection, sample, now_ns)
        if not self._allow_edges(connection, sample, now_ns):
            return
        if connection.role == Role.OBSERVER:
            presence = self._presence.limit(connection, sample, now_ns)
            if presence is None:
                return
            sample = presence
        self._raw.send(connection, now_ns, sample)
        self._context.coalescer.offer(Entry(connection.number, epoch, now_ns, sample))

    def _count_rejection(
        self, peer: Peer, connection: FrontConnection | None, now_ns: int, detail: str = BEFORE_HELLO
    ) -> None:
        """Count a rejected message. Too many of them end the connection, and close its TCP connection."""
        if self._context.guard.rate_limit(peer, connection, detail, now_ns) and connection is not None:
            self._context.outbox.failed.setdefault(connection.number, "flood")

    def _count_unauthenticated(self, route: Route, peer: Peer, now_ns: int) -> None:
        """Count a rejected message without a connection: behind a gateway it must not use up what the gateway may send
        before hello."""
        self._count_rejection(peer, self._admission.find_gateway(route.routing_id, peer), now_ns)

    def _count_flood(self, connection: FrontConnection, tag: str, now_ns: int) -> None:
        """Count a message above a rate limit, and report a client that is above it for seconds."""
        self._count_rejection(connection.peer, connection, now_ns, tag)
        if now_ns - connection.flood_last_ns > FLOOD_NS:
            connection.flood_since_ns = now_ns
        connection.flood_last_ns = now_ns
        if now_ns - connection.flood_since_ns > FLOOD_NS:
            self._context.guard.report_flood(connection.address[0], tag, now_ns, connection)

    def _reject_unreadable(self, route: Route, peer: Peer, error: ProtocolError, now_ns: int) -> None:
        """Reject a message that cannot be decoded; before `hello` with a refusal, as the answer to it."""
        connection = self._context.connections.find(route, peer)
        counted = connection or (self._admission.find_gateway(route.routing_id, peer) if route.on_behalf_of else None)
        self._count_rejection(peer, counted, now_ns, error.code if connection is not None else BEFORE_HELLO)
        if connection is not None:
            self._send_fault(route, connection, error.code, str(error), now_ns)
            return
        self._context.drops.count(f"hello_{error.code}")
        if self._unknown_peer_faults.take(now_ns):
            advice = "send the hello of docs/protocol.md"
            if isinstance(error, ProtocolVersionError):
                advice = f"update {'the client' if error.version < PROTOCOL_VERSION else 'the session'}"
            self._context.outbox.send_to_route(route, Refused(error.code, str(error), advice))

    def _send_fault(self, route: Route, connection: FrontConnection | None, code: str, text: str, now_ns: int) -> None:
        """Count a fault, and send it at a bounded rate."""
        fault = ProtocolFault(code, text)
        if connection is None:
            self._context.drops.count(f"stranger_{code}")
            if self._unknown_peer_faults.take(now_ns):
                self._context.outbox.send_to_route(route, fault)
            return
        self._context.drops.count(code, connection.number)
        if connection.faults.take(now_ns):
            self._context.outbox.send(connection, fault)
