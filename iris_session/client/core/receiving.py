"""What a client's connection makes of what comes in. Part of `Connection`: no socket, clock or thread here either.

Nothing that a server sends raises here: what does not fit is counted.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Sequence

from iris_session.client.core.clock import ClockSync
from iris_session.client.core.inbox import PendingRequests
from iris_session.client.core.limits import MAX_INBOX, UNREAD_MESSAGE_FAULTS, RETRYABLE_REFUSALS, final_refusal, bounded_heartbeat_ns
from iris_session.client.core.outbox import PendingEStop
from iris_session.client.core.state_stream import StateStream, poses_from_bytes
from iris_session.client.core.status import ConnectionCounters, ConnectionPhase
from iris_session.client.errors import ClientError, RefusedError, VersionError
from iris_session.client.identity import Identity
from iris_session.protocol.client_messages import ClientMessage, TrackingEpoch
from iris_session.protocol.codec import decode_server
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.names import RefusalCode
from iris_session.protocol.security import Paired
from iris_session.protocol.server_messages import (
    ClockPong,
    EStopChanged,
    Event,
    Feedback,
    ParticipantLeft,
    ProtocolFault,
    Refused,
    Reply,
    Snapshot,
    Welcome,
)
from iris_session.protocol.session_mirror import Missed, SessionMirror
from iris_session.protocol.status import DeliveryBudget, StatusReport

#: What is handed to the application, in this order. Replies: denials that nobody waits for.
InboxMessage = Event | Missed | Feedback | ProtocolFault | Reply


class Receiving:
    """Part of `Connection`."""

    identity: Identity
    phase: ConnectionPhase
    welcome: Welcome | None
    failure: ClientError | None
    put_off: Refused | None
    not_taken: ProtocolFault | None
    stalled: bool
    tracking_epoch: int
    mirror: SessionMirror
    clock: ClockSync
    stream: StateStream
    counters: ConnectionCounters
    inbox: deque[InboxMessage]
    latest: dict[type, StatusReport | DeliveryBudget | Paired]
    requests: PendingRequests
    pending_estop: PendingEStop
    _heard_at: int
    _heartbeat_at: int
    _heartbeat_ns: int
    _snapshot_at: int
    _joined_at: int

    @property
    @abstractmethod
    def joined(self) -> bool: ...

    @property
    @abstractmethod
    def connection_epoch(self) -> int: ...

    @abstractmethod
    def lost(self, now_ns: int) -> None: ...

    @abstractmethod
    def _say_hello(self, now_ns: int) -> None: ...

    @abstractmethod
    def _wait(self, now_ns: int) -> None: ...

    @abstractmethod
    def _keep_up(self, now_ns: int) -> None: ...

    @abstractmethod
    def _queue(self, message: ClientMessage) -> bool: ...

    def receive(self, frames: Sequence[bytes], now_ns: int) -> None:
        """One message of the control channel: `[envelope, *bulk]`. Anything that does not fit is counted."""
        try:
            wrapped = decode_server(frames[0])
        except (ProtocolError, IndexError):
            self.counters.malformed += 1
            return
        message = wrapped.message
        self.counters.received += 1
        self._heard_at = now_ns
        if isinstance(message, Welcome):
            self._welcomed(message, now_ns)
        elif isinstance(message, Refused):
            self._refused(message, now_ns)
        elif isinstance(message, ProtocolFault):
            self._fault(message, now_ns)
        elif isinstance(message, StatusReport):
            self.latest[StatusReport] = message  # also while a session that stands still lets nobody in
        elif not self.joined or wrapped.connection_epoch != self.connection_epoch:
            self.counters.other_connection += 1
        elif isinstance(message, ClockPong):
            self.clock.process_pong(message.t0_ns, message.t1_ns, message.t2_ns, now_ns)
            self.pending_estop.on_pong(message.t0_ns, stopped=self.mirror.synced and self.mirror.estop)
            self._maybe_ready()
        elif isinstance(message, Reply):
            if not self.requests.process_reply(message):
                self.counters.unasked_denials += 1
                self._deliver(message)
        elif isinstance(message, Event):
            if self.mirror.apply_event(message):
                self.stream.scene_epoch = self.mirror.bodies_until
                if not self.mirror.synced:
                    # Another scene: its bodies are asked for at once, however lately others were.
                    self._snapshot_at = min(self._snapshot_at, now_ns)
                if isinstance(message.body, EStopChanged) and message.body.active:
                    self.pending_estop.withdraw()
                self._deliver(message)
        elif isinstance(message, Snapshot):
            self._snapshot(message, frames[1:])
        elif isinstance(message, Feedback):
            self._deliver(message)
        else:
            self.latest[type(message)] = message

    def _welcomed(self, welcome: Welcome, now_ns: int) -> None:
        if self.phase is not ConnectionPhase.JOINING:
            self.counters.other_connection += 1
            return
        if self.welcome is None or welcome.session_id != self.welcome.session_id:
            self.mirror.reset()
            self.clock.reset()
            self.stream.reset()  # else state goes on: a restarted front numbers its frames above the old one's
        self.clock.restart()  # this machine may have slept
        self.stream.restart()
        self.mirror.synced = False
        self.welcome = welcome
        self.put_off = None
        self.counters.identity_unwritten += not self.identity.remember(welcome.resume_token)
        self.phase = ConnectionPhase.SYNCING
        self._joined_at = now_ns
        self._heartbeat_ns = bounded_heartbeat_ns(welcome)
        self._heartbeat_at = now_ns + self._heartbeat_ns // 2
        self._snapshot_at = now_ns
        if self.pending_estop.message is not None:
            self.pending_estop.begin(self.pending_estop.message)
            self._queue(self.pending_estop.message)
        if self.tracking_epoch:
            self._queue(TrackingEpoch(self.tracking_epoch))
        self._keep_up(now_ns)

    def _refused(self, refused: Refused, now_ns: int) -> None:
        if self.phase is not ConnectionPhase.JOINING:
            return
        if refused.code == RefusalCode.RESUME_TOKEN and self.identity.resume_token:
            # Used up or forgotten: join as somebody new.
            self.counters.identity_unwritten += not self.identity.remember(b"")
            self._say_hello(now_ns)
        elif refused.code == RefusalCode.RATE or (refused.code in RETRYABLE_REFUSALS and self.welcome is not None):
            self.put_off = refused
            self._wait(now_ns)
        else:
            self.phase = ConnectionPhase.REFUSED
            self.failure = (VersionError if refused.code == RefusalCode.VERSION else RefusedError)(refused)

    def _fault(self, fault: ProtocolFault, now_ns: int) -> None:
        self.counters.count_fault(fault.code)
        self._deliver(fault)
        if fault.code in UNREAD_MESSAGE_FAULTS:
            self.not_taken = fault
        elif fault.code in ("stalled", "recovered"):
            self.stalled = fault.code == "stalled"
        elif (end := final_refusal(fault)) is not None:
            self.failure = RefusedError(end)
            self.phase = ConnectionPhase.REFUSED
        elif fault.code == "session_ended" and self.joined:
            self.counters.reconnects += 1
            self._wait(now_ns)
        elif fault.code in ("dropped", "hello"):
            self.lost(now_ns)

    def _snapshot(self, snapshot: Snapshot, bulk: Sequence[bytes]) -> None:
        poses = poses_from_bytes(bulk[0] if bulk else b"", len(snapshot.bodies))
        if poses is None:
            self.counters.malformed += 1
            return
        self.counters.snapshots += 1
        for told in self.mirror.apply_snapshot(snapshot):
            self._deliver(told)
        if self.mirror.estop:
            self.pending_estop.withdraw()
        self.stream.scene_epoch = self.mirror.bodies_until
        self.stream.retain_presence(self.mirror.connected)
        self.stream.load_keyframe(snapshot.state_seq, poses)
        self._maybe_ready()

    def _maybe_ready(self) -> None:
        if self.phase is ConnectionPhase.SYNCING and self.mirror.synced and self.clock.settled:
            self.phase = ConnectionPhase.READY

    def _deliver(self, message: InboxMessage) -> None:
        if isinstance(message, Event) and isinstance(message.body, ParticipantLeft):
            self.stream.remove_presence(message.body.participant)
        if len(self.inbox) >= MAX_INBOX:
            self._make_room()
        self.inbox.append(message)

    def _make_room(self) -> None:
        """Nobody takes what waits: the oldest goes, and one note at the front says which events went with it."""
        lost: Missed | None = None
        while len(self.inbox) >= MAX_INBOX - (lost is not None):
            gone = self.inbox.popleft()
            self.counters.inbox_dropped += not isinstance(gone, Missed)
            if isinstance(gone, Event | Missed):
                first, last = gone if isinstance(gone, Missed) else (gone.event_seq, gone.event_seq)
                lost = Missed(first if lost is None else lost.first, last)
        if lost is not None:
            self.inbox.appendleft(lost)
