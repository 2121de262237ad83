"""Connection of one participant: bytes and times in, bytes and messages out, over any number of sockets.

    IDLE --open()--> JOINING --Welcome--> SYNCING --snapshot and clock--> READY
    JOINING, SYNCING, READY --silence, disconnect, session_ended--> WAITING (back-off, none at first) --> JOINING
    JOINING --Refused--> REFUSED (`failure` holds the reason)          any --close()--> CLOSED
    JOINING --retryable Refused (too many at once)--> WAITING (`retryable_refusal` holds the reason)

The shell opens a fresh control socket whenever `generation` changes, passes received frames to `receive`, calls `tick`
at the latest at `next_deadline_ns`, and sends what `peek_outgoing` shows. All `now_ns` are one monotonic clock.
Nothing that a server sends raises here: what does not fit the protocol is counted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import msgspec

from iris_session.client.core.clock import ClockSync
from iris_session.client.core.outbox import MAX_OUTGOING, Outbox, PendingEStop, PendingRequests, encode_checked
from iris_session.client.core.state_stream import StateStream, poses_from_bytes
from iris_session.client.core.status import ConnectionCounters, ConnectionPhase
from iris_session.client.errors import ClientError, NotConnectedError, RefusedError, VersionError
from iris_session.protocol.client_messages import (
    Bye,
    ClearEStop,
    ClientMessage,
    ClockPing,
    EStop,
    GetSnapshot,
    Heartbeat,
    Hello,
    Sample,
    Samples,
    TrackingEpoch,
    wrap_message,
)
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.names import DenialReason, FaultCode, RefusalCode
from iris_session.protocol.server_messages import (
    ClockPong,
    EStopChanged,
    Event,
    Feedback,
    Paired,
    ParticipantLeft,
    ProtocolFault,
    Refused,
    Reply,
    Snapshot,
    Welcome,
)
from iris_session.protocol.session_mirror import MissedEvents, SessionMirror
from iris_session.protocol.status import DeliveryBudget, GetStatus, StatusReport

if TYPE_CHECKING:  # this room has no files
    from iris_session.client.identity import Identity

#: Time to wait for the reply to hello, at first and at most: a handshake takes five round trips, so over a slow link
#: the first attempts are too short.
HELLO_TIMEOUT_NS: Final = 1_000_000_000
HELLO_TIMEOUT_MAX_NS: Final = 4_000_000_000
BACKOFF_MIN_NS: Final = 100_000_000
BACKOFF_MAX_NS: Final = 2_000_000_000
STEADY_NS: Final = 1_000_000_000
SNAPSHOT_RETRY_NS: Final = 500_000_000
#: Heartbeat periods that a session may ask for: with others a client would never rest, or never notice its end.
HEARTBEAT_MIN_NS: Final = 20_000_000
HEARTBEAT_MAX_NS: Final = 10_000_000_000
SILENT_HEARTBEATS: Final = 4  # heartbeat periods without a message from the front: the connection is lost
MAX_INBOX: Final = 1024

#: Refusals that pass: a client that was joined before keeps trying (after `rate` every client does).
RETRYABLE_REFUSALS: Final = frozenset({RefusalCode.RATE, RefusalCode.FULL, DenialReason.SESSION_FULL})
#: Faults about a message of ours that the session could not read: its request gets no reply.
UNREAD_MESSAGE_FAULTS: Final = frozenset({FaultCode.MALFORMED, FaultCode.TOO_LARGE})
#: Reason of a drop after another connection resumed this one. Joining again would only take it back in turn.
REPLACED: Final = "replaced"

#: Messages to the application, in order. Replies: denials of messages that expect no reply.
InboxMessage = Event | MissedEvents | Feedback | ProtocolFault | Reply


class ClientConnection:
    """One participant's connection, over any number of sockets."""

    def __init__(self, hello: Hello, identity: Identity) -> None:
        self.hello = hello
        self.identity = identity
        self.phase = ConnectionPhase.IDLE
        self.generation = 0
        self.welcome: Welcome | None = None
        self.failure: ClientError | None = None
        #: The newest refusal that passes, until a session welcomes us.
        self.retryable_refusal: Refused | None = None
        self.session_ended = False  # the newest session that welcomed us said that it ends
        self.wake_ns = 0  # deadline of the shell's own work; 0: none
        self.last_protocol_fault: ProtocolFault | None = None  # the newest of `UNREAD_MESSAGE_FAULTS`
        self.stalled = False
        self.worn = True
        self.tracking_epoch = 0
        self.mirror = SessionMirror()
        self.clock = ClockSync()
        self.stream = StateStream()
        self.counters = ConnectionCounters()
        self.inbox: deque[InboxMessage] = deque()
        #: Newest message of the kinds of which only the newest matters, by type.
        self.latest: dict[type, StatusReport | DeliveryBudget | Paired] = {}
        self.requests = PendingRequests(self.counters)
        self.pending_estop = PendingEStop()
        self._outbox = Outbox(self.counters)
        self._backoff_ns = BACKOFF_MIN_NS
        self._hello_at = 0
        self._hello_wait_ns = HELLO_TIMEOUT_NS
        self._retry_at = 0
        self._heard_at = 0
        self._heartbeat_at = 0
        self._heartbeat_ns = 0  # as the session asks for, bounded
        self._snapshot_at = 0
        self._joined_at = 0
        self._ticked_at = 0

    # --- life ---------------------------------------------------------------------------------------------------------

    def open(self, now_ns: int) -> None:
        """Start to join, also after a refusal. Attempts stay as long as they have become: the link is that slow."""
        self.failure = self.retryable_refusal = None
        self._backoff_ns = BACKOFF_MIN_NS
        self._send_hello(now_ns)

    def close(self) -> None:
        """Queue a bye, which releases leases at once. Send what `peek_outgoing` still shows."""
        if self.welcome is not None:
            self._queue(Bye())
            if self.phase is not ConnectionPhase.REFUSED:  # then the token in a shared file may be of the successor
                self.counters.identity_unwritten += not self.identity.remember(b"")
        self.phase = ConnectionPhase.CLOSED

    def handle_disconnect(self, now_ns: int) -> None:
        """Join again, at once if this connection was steady: the socket lost its peer, or the front forgot us."""
        if not self.is_joined:
            return
        self.counters.reconnects += 1
        self._hello_wait_ns = HELLO_TIMEOUT_NS
        if now_ns - self._joined_at < STEADY_NS:
            self._start_backoff(now_ns)
        else:
            self._backoff_ns = BACKOFF_MIN_NS
            self._send_hello(now_ns)

    @property
    def is_joined(self) -> bool:
        """True while the session has accepted us and the connection stands as far as we know."""
        return self.phase in (ConnectionPhase.SYNCING, ConnectionPhase.READY)

    @property
    def participant_id(self) -> str:
        """Our id in the session, empty before the first welcome."""
        return "" if self.welcome is None else self.welcome.participant_id

    @property
    def connection_epoch(self) -> int:
        """Number of this connection in the session, 0 before the first welcome."""
        return 0 if self.welcome is None else self.welcome.connection_epoch

    def tick(self, now_ns: int) -> None:
        """Do everything that depends on time: hello, back-off, clock, heartbeat, snapshot, silence."""
        if now_ns - self._ticked_at > STEADY_NS:
            self._heard_at = now_ns  # we stood still: messages of that time are still to be read
        self._ticked_at = now_ns
        if self.phase is ConnectionPhase.WAITING and now_ns >= self._retry_at:
            self._send_hello(now_ns)
        elif self.phase is ConnectionPhase.JOINING and now_ns >= self._hello_at + self._hello_wait_ns:
            self._hello_wait_ns = min(2 * self._hello_wait_ns, HELLO_TIMEOUT_MAX_NS)
            self._start_backoff(now_ns)
        elif self.is_joined:
            self._send_periodic(now_ns)

    def next_deadline_ns(self, now_ns: int) -> int:
        """Return the latest time at which `tick` must be called."""
        if self.phase is ConnectionPhase.WAITING:
            return self._retry_at
        if self.phase is ConnectionPhase.JOINING:
            return self._hello_at + self._hello_wait_ns
        if not self.is_joined:
            return self.wake_ns or now_ns + STEADY_NS
        due = min(self.clock.next_ping_ns, self._heartbeat_at, self._heard_at + self._silence_ns)
        return min(due, self._snapshot_at) if self._needs_snapshot else due

    def describe(self) -> str:
        """Return one line for people: why there is no connection now."""
        if self.phase in (ConnectionPhase.WAITING, ConnectionPhase.JOINING):
            if self.retryable_refusal is not None:
                return f"not let in yet, trying again: {RefusedError(self.retryable_refusal)}"
            if self.session_ended:
                return "the session has ended; joining as soon as there is one again"
            return "the connection was lost; joining again" if self.welcome else "no session has answered yet"
        texts = {
            ConnectionPhase.IDLE: "not connected: call connect() first",
            ConnectionPhase.CLOSED: "this client was closed",
        }
        return texts.get(self.phase, str(self.failure) if self.failure else "connected")

    # --- sending ------------------------------------------------------------------------------------------------------

    def send(self, message: ClientMessage) -> bool:
        """Queue a message.

        Samples are never kept: without a connection they are dropped and counted. An e-stop is kept until the session
        has it, over any number of connections.

        Args:
            message: A message that expects no reply.

        Returns:
            False: the message was dropped and counted (the send queue is full, or a sample has no connection), or it is
            an e-stop that has no connection yet.

        Raises:
            InvalidMessageError: A value does not fit the protocol, connected or not.
            NotConnectedError: There is no connection, and the message is neither sample nor e-stop.
        """
        data = encode_checked(message, self.connection_epoch)
        joining = self.phase in (ConnectionPhase.JOINING, ConnectionPhase.WAITING)
        if isinstance(message, EStop) and (self.is_joined or joining):
            self.pending_estop.begin(message)
            return self.phase is not ConnectionPhase.WAITING and self._outbox.push(message, data)
        if not self.is_joined:
            if isinstance(message, Sample | Samples):
                self.counters.samples_not_sent += 1
                return False
            raise NotConnectedError(self.describe())
        return self._outbox.push(message, data)

    def request(self, message: Any) -> int:
        """Queue a request under a fresh `request_id`.

        Args:
            message: A message with a field `request_id`, which is filled in.

        Returns:
            The `request_id`; `requests.pop_reply` has the reply.

        Raises:
            InvalidMessageError: A value does not fit the protocol.
            NotConnectedError: There is no connection, or the send queue is full.
        """
        if not self.is_joined:
            raise NotConnectedError(self.describe())
        request_id = self.requests.next_request
        message = msgspec.structs.replace(message, request_id=request_id)
        data = encode_checked(message, self.connection_epoch)
        if not self._outbox.push(message, data):
            raise NotConnectedError(f"send queue full ({MAX_OUTGOING} messages): the session is not reading")
        if isinstance(message, ClearEStop):
            self.pending_estop.withdraw()
        self.requests.add_pending()
        return request_id

    def request_status(self) -> bool:
        """Queue `GetStatus`; the report appears in `latest`. Works while joining too, before the welcome.

        Returns:
            False: there is no socket to ask by now, or the send queue is full.
        """
        asks = self.is_joined or self.phase is ConnectionPhase.JOINING
        return asks and self._queue(GetStatus())

    def peek_outgoing(self) -> tuple[bool, bytes] | None:
        """Return the next message to send as (may be dropped when the socket is full, bytes)."""
        return self._outbox.peek()

    def pop_outgoing(self, *, sent: bool) -> None:
        """Remove the message of `peek_outgoing`, which was sent or is dropped."""
        self._outbox.pop(sent=sent)

    def lease_version(self, target: str) -> int | None:
        """Return our fencing token for `target`, by events or by a reply that came before its event."""
        granted, known = self.requests.granted_lease(target), self.mirror.leases.get(target)
        if granted is not None and (known is None or granted.lease_version > known.lease_version):
            ours = granted.holder == self.participant_id or self.participant_id in granted.sub_holders
            return granted.lease_version if ours else None
        return self.mirror.find_lease_version(target, self.participant_id)

    # --- receiving ----------------------------------------------------------------------------------------------------

    def receive(self, frames: Sequence[bytes], now_ns: int) -> None:
        """Process one message of the control channel, `[envelope, *bulk]`."""
        try:
            wrapped = decode_server(frames[0])
        except (ProtocolError, IndexError):
            self.counters.malformed += 1
            return
        message = wrapped.message
        self.counters.received += 1
        self._heard_at = now_ns
        if isinstance(message, Welcome):
            self._process_welcome(message, now_ns)
        elif isinstance(message, Refused):
            self._process_refusal(message, now_ns)
        elif isinstance(message, ProtocolFault):
            self._process_fault(message, now_ns)
        elif isinstance(message, StatusReport):
            self.latest[StatusReport] = message  # also while a session that stands still welcomes no client
        elif not self.is_joined or wrapped.connection_epoch != self.connection_epoch:
            self.counters.other_connection += 1
        elif isinstance(message, ClockPong):
            self.clock.process_pong(message.t0_ns, message.t1_ns, message.t2_ns, now_ns)
            self.pending_estop.on_pong(message.t0_ns, stopped=self.mirror.synced and self.mirror.estop)
            self._update_ready()
        elif isinstance(message, Reply):
            if not self.requests.process_reply(message):
                self.counters.unasked_denials += 1
                self._deliver(message)
        elif isinstance(message, Event):
            self._process_event(message, now_ns)
        elif isinstance(message, Snapshot):
            self._process_snapshot(message, frames[1:])
        elif isinstance(message, Feedback):
            self._deliver(message)
        else:
            self.latest[type(message)] = message

    def _process_welcome(self, welcome: Welcome, now_ns: int) -> None:
        if self.phase is not ConnectionPhase.JOINING:
            self.counters.other_connection += 1
            return
        if self.welcome is None or welcome.session_id != self.welcome.session_id:
            self.mirror.reset()
            self.clock.reset()
            self.stream.reset()  # else state continues: a restarted front numbers its frames above the old one's
        self.clock.restart()  # this machine may have slept
        self.stream.restart()
        self.mirror.synced = False
        self.welcome = welcome
        self.retryable_refusal, self.session_ended = None, False
        self.counters.identity_unwritten += not self.identity.remember(welcome.resume_token)
        self.phase = ConnectionPhase.SYNCING
        self._joined_at = now_ns
        self._heartbeat_ns = min(max(welcome.heartbeat_ns, HEARTBEAT_MIN_NS), HEARTBEAT_MAX_NS)
        self._heartbeat_at = now_ns + self._heartbeat_ns // 2
        self._snapshot_at = now_ns
        if self.pending_estop.message is not None:
            self.pending_estop.begin(self.pending_estop.message)
            self._queue(self.pending_estop.message)
        if self.tracking_epoch:
            self._queue(TrackingEpoch(self.tracking_epoch))
        self._send_periodic(now_ns)

    def _process_refusal(self, refused: Refused, now_ns: int) -> None:
        if self.phase is not ConnectionPhase.JOINING:
            return
        if refused.code == RefusalCode.RESUME_TOKEN and self.identity.resume_token:
            # Used up or removed: join as a new participant.
            self.counters.identity_unwritten += not self.identity.remember(b"")
            self._send_hello(now_ns)
        elif refused.code == RefusalCode.RATE or (refused.code in RETRYABLE_REFUSALS and self.welcome is not None):
            self.retryable_refusal = refused
            self._start_backoff(now_ns)
        else:
            self.phase = ConnectionPhase.REFUSED
            self.failure = (VersionError if refused.code == RefusalCode.VERSION else RefusedError)(refused)

    def _process_fault(self, fault: ProtocolFault, now_ns: int) -> None:
        self.counters.count_fault(fault.code)
        self._deliver(fault)
        if fault.code in UNREAD_MESSAGE_FAULTS:
            self.last_protocol_fault = fault
        elif fault.code in ("stalled", "recovered"):
            self.stalled = fault.code == "stalled"
        elif (refused := final_refusal(fault)) is not None:
            self.failure = RefusedError(refused)
            self.phase = ConnectionPhase.REFUSED
        elif fault.code == "session_ended" and self.is_joined:
            self.counters.reconnects += 1
            self.session_ended = True
            self._start_backoff(now_ns)
        elif fault.code in ("dropped", "hello"):
            self.handle_disconnect(now_ns)

    def _process_event(self, event: Event, now_ns: int) -> None:
        if not self.mirror.apply_event(event):
            return
        self.stream.scene_epoch = self.mirror.bodies_until
        if not self.mirror.synced:
            # Another scene: its bodies are requested at once, however lately others were.
            self._snapshot_at = min(self._snapshot_at, now_ns)
        stop = event.body
        if isinstance(stop, EStopChanged) and stop.active and stop.participant == self.participant_id:
            self.pending_estop.withdraw()
        self._deliver(event)

    def _process_snapshot(self, snapshot: Snapshot, bulk: Sequence[bytes]) -> None:
        poses = poses_from_bytes(bulk[0] if bulk else b"", len(snapshot.bodies))
        if poses is None:
            self.counters.malformed += 1
            return
        self.counters.snapshots += 1
        for message in self.mirror.apply_snapshot(snapshot):
            self._deliver(message)
        self.stream.scene_epoch = self.mirror.bodies_until
        self.stream.retain_presence(self.mirror.connected)
        self.stream.load_keyframe(snapshot.state_seq, poses)
        self._update_ready()

    def _update_ready(self) -> None:
        if self.phase is ConnectionPhase.SYNCING and self.mirror.synced and self.clock.settled:
            self.phase = ConnectionPhase.READY

    def _deliver(self, message: InboxMessage) -> None:
        if isinstance(message, Event) and isinstance(message.body, ParticipantLeft):
            self.stream.remove_presence(message.body.participant)
        if len(self.inbox) >= MAX_INBOX:
            self._make_inbox_room()
        self.inbox.append(message)

    def _make_inbox_room(self) -> None:
        """Drop the oldest messages of a full inbox; one `MissedEvents` at its front names the events among them."""
        missed: MissedEvents | None = None
        while len(self.inbox) >= MAX_INBOX - (missed is not None):
            dropped = self.inbox.popleft()
            self.counters.inbox_dropped += not isinstance(dropped, MissedEvents)
            if isinstance(dropped, Event | MissedEvents):
                first, last = (dropped.event_seq,) * 2 if isinstance(dropped, Event) else dropped
                missed = MissedEvents(first if missed is None else missed.first, last)
        if missed is not None:
            self.inbox.appendleft(missed)

    # --- timers -------------------------------------------------------------------------------------------------------

    @property
    def _silence_ns(self) -> int:
        return SILENT_HEARTBEATS * max(self._heartbeat_ns, 500_000_000)

    @property
    def _needs_snapshot(self) -> bool:
        return not self.mirror.synced or self.stream.wants_snapshot

    def _send_periodic(self, now_ns: int) -> None:
        assert self.welcome is not None
        if now_ns - self._heard_at >= self._silence_ns:
            self.handle_disconnect(now_ns)
            return
        if self.clock.poll_ping(now_ns):
            self._queue(ClockPing(now_ns))
            self.pending_estop.on_ping(now_ns)
        if now_ns >= self._heartbeat_at:
            self._heartbeat_at = now_ns + self._heartbeat_ns // 2
            self._queue(Heartbeat(self.worn))
        if self._needs_snapshot and now_ns >= self._snapshot_at:
            self._snapshot_at = now_ns + SNAPSHOT_RETRY_NS
            self._queue(GetSnapshot())

    def _send_hello(self, now_ns: int) -> None:
        """Begin a fresh socket with a hello: no message of an earlier connection can reach the session."""
        self.generation += 1
        self.phase = ConnectionPhase.JOINING
        self.stalled = False
        self._hello_at = now_ns
        self._heard_at = now_ns
        self._outbox.clear()
        self.requests.clear()
        hello = msgspec.structs.replace(
            self.hello, secret=self.identity.secret, resume_token=self.identity.resume_token
        )
        self._outbox.push(hello, encode_client(wrap_message(hello)))
        if self.pending_estop.message is not None:  # every client may stop, however early
            self._outbox.push(self.pending_estop.message, encode_client(wrap_message(self.pending_estop.message)))

    def _start_backoff(self, now_ns: int) -> None:
        self.phase = ConnectionPhase.WAITING
        self._outbox.clear()
        self._retry_at = now_ns + self._backoff_ns
        self._backoff_ns = min(2 * self._backoff_ns, BACKOFF_MAX_NS)

    def _queue(self, message: ClientMessage) -> bool:
        return self._outbox.push(message, encode_client(wrap_message(message, self.connection_epoch)))


def final_refusal(fault: ProtocolFault) -> Refused | None:
    """Return the refusal that a fault amounts to when the client must not join again by itself, else `None`."""
    if fault.code == FaultCode.DROPPED and fault.reason == REPLACED:
        advice = "give every client that runs at the same time an identity of its own"
        return Refused(REPLACED, "another client took over with this identity", advice)
    if fault.code == FaultCode.REVOKED:
        return Refused(fault.code, fault.message, "ask the owner of the session")
    return None
