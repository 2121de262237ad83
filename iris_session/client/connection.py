"""Sans-I/O core of the client: bytes and times in, bytes out. It owns no socket, clock or thread.

    IDLE --open()--> JOINING --Welcome--> SYNCING --snapshot and clock--> READY
    JOINING, SYNCING, READY --silence, lost(), session_ended--> WAITING (back-off, none at first) --> JOINING
    JOINING --Refused--> REFUSED (`failure` says why)          any --close()--> CLOSED
    JOINING --Refused that passes (too many at once)--> WAITING (`put_off` says why)

The shell opens a fresh control socket whenever `generation` changes, passes received frames to `receive`, calls `tick`
at the latest at `next_deadline_ns`, and sends what `peek_outgoing` shows. All `now_ns` are one monotonic clock.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import msgspec

from iris_session.client.answers import Answers
from iris_session.client.clock import ClockSync
from iris_session.client.errors import ClientError, NotConnectedError, RefusedError
from iris_session.client.identity import Identity
from iris_session.client.limits import (
    BACKOFF_MAX_NS,
    BACKOFF_MIN_NS,
    HELLO_TIMEOUT_MAX_NS,
    HELLO_TIMEOUT_NS,
    SILENT_HEARTBEATS,
    SNAPSHOT_RETRY_NS,
    STEADY_NS,
)
from iris_session.client.outgoing import Outgoing, PendingStop
from iris_session.client.receiving import Receiving, Told
from iris_session.client.state_stream import StateStream
from iris_session.client.status import ConnectionCounters, Phase
from iris_session.client.values import checked_bytes
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
    wrap_message,
)
from iris_session.protocol.codec import encode_client
from iris_session.protocol.server_messages import (
    Paired,
    ProtocolFault,
    Refused,
    Welcome,
)
from iris_session.protocol.session_mirror import SessionMirror
from iris_session.protocol.status import DeliveryBudget, StatusReport


class Connection(Receiving):
    """One participant's connection, over any number of sockets."""

    def __init__(self, hello: Hello, identity: Identity) -> None:
        self.hello = hello
        self.identity = identity
        self.phase = Phase.IDLE
        self.generation = 0
        self.welcome: Welcome | None = None
        self.failure: ClientError | None = None
        self.put_off: Refused | None = None  # the newest refusal that passes, until a session lets us in
        self.wake_ns = 0  # when the shell has something to do that is not ours; 0: never
        self.not_taken: ProtocolFault | None = None  # the newest fault of `NOT_TAKEN`
        self.stalled = False
        self.worn = True
        self.tracking_epoch = 0
        self.mirror = SessionMirror()
        self.clock = ClockSync()
        self.stream = StateStream()
        self.counters = ConnectionCounters()
        self.inbox: deque[Told] = deque()
        #: Newest message of the kinds of which only the newest matters, by type.
        self.latest: dict[type, StatusReport | DeliveryBudget | Paired] = {}
        self.answers = Answers(self.counters)
        self.stop = PendingStop()
        self._outgoing = Outgoing(self.counters)
        self._backoff_ns = BACKOFF_MIN_NS
        self._hello_at = 0
        self._hello_wait_ns = HELLO_TIMEOUT_NS
        self._retry_at = 0
        self._heard_at = 0
        self._heartbeat_at = 0
        self._heartbeat_ns = 0  # as the session asks for, within reason
        self._snapshot_at = 0
        self._joined_at = 0
        self._ticked_at = 0

    # --- life ---------------------------------------------------------------------------------------------------------

    def open(self, now_ns: int) -> None:
        """Starts joining, also after a refusal."""
        self.failure = self.put_off = None
        self._backoff_ns, self._hello_wait_ns = BACKOFF_MIN_NS, HELLO_TIMEOUT_NS
        self._say_hello(now_ns)

    def close(self) -> None:
        """Says bye; leases are released at once. What `peek_outgoing` still shows should be sent."""
        if self.welcome is not None:
            self._queue(Bye())
            if self.phase is not Phase.REFUSED:  # then the token in a shared file may be that of who took over
                self.counters.identity_unwritten += not self.identity.remember(b"")
        self.phase = Phase.CLOSED

    def lost(self, now_ns: int) -> None:
        """The socket lost its peer, or the front its memory of us: join again, at once if this one stood for long."""
        if not self.joined:
            return
        self.counters.reconnects += 1
        self._hello_wait_ns = HELLO_TIMEOUT_NS
        if now_ns - self._joined_at < STEADY_NS:
            self._wait(now_ns)
        else:
            self._backoff_ns = BACKOFF_MIN_NS
            self._say_hello(now_ns)

    @property
    def joined(self) -> bool:
        """The session accepted us, and the connection stands as far as we know."""
        return self.phase in (Phase.SYNCING, Phase.READY)

    @property
    def participant_id(self) -> str:
        return "" if self.welcome is None else self.welcome.participant_id

    @property
    def connection_epoch(self) -> int:
        return 0 if self.welcome is None else self.welcome.connection_epoch

    def tick(self, now_ns: int) -> None:
        """Everything that depends on time: hello, back-off, clock, heartbeat, snapshot, silence."""
        if now_ns - self._ticked_at > STEADY_NS:
            self._heard_at = now_ns  # it was us who stood still: what was said meanwhile is still to be read
        self._ticked_at = now_ns
        if self.phase is Phase.WAITING and now_ns >= self._retry_at:
            self._say_hello(now_ns)
        elif self.phase is Phase.JOINING and now_ns >= self._hello_at + self._hello_wait_ns:
            self._hello_wait_ns = min(2 * self._hello_wait_ns, HELLO_TIMEOUT_MAX_NS)
            self._wait(now_ns)
        elif self.joined:
            self._keep_up(now_ns)

    def next_deadline_ns(self, now_ns: int) -> int:
        """When `tick` must be called at the latest."""
        if self.phase is Phase.WAITING:
            return self._retry_at
        if self.phase is Phase.JOINING:
            return self._hello_at + self._hello_wait_ns
        if not self.joined:
            return self.wake_ns or now_ns + STEADY_NS
        due = min(self.clock.next_ping_ns, self._heartbeat_at, self._heard_at + self._silence_ns)
        return min(due, self._snapshot_at) if self._snapshot_wanted else due

    # --- sending ------------------------------------------------------------------------------------------------------

    def send(self, message: ClientMessage) -> bool:
        """Queues a message. Samples are never kept: false (and counted) when there is no connection.

        An e-stop is kept until the session has it, over any number of connections: false says that there is none now.
        Raises `InvalidMessageError` when the protocol does not take it, connected or not.
        """
        data = checked_bytes(message, self.connection_epoch)
        if isinstance(message, EStop) and (self.joined or self.phase in (Phase.JOINING, Phase.WAITING)):
            self.stop.ask(message)
            return self.phase is not Phase.WAITING and self._outgoing.push(message, data)
        if not self.joined:
            if isinstance(message, Sample | Samples):
                self.counters.samples_not_sent += 1
                return False
            raise NotConnectedError(self.describe())
        return self._outgoing.push(message, data)

    def request(self, message: Any) -> int:
        """Queues a request under a fresh `request_id`, which is returned."""
        if not self.joined:
            raise NotConnectedError(self.describe())
        request_id = self.answers.next_request
        message = msgspec.structs.replace(message, request_id=request_id)
        data = checked_bytes(message, self.connection_epoch)
        if not self._outgoing.push(message, data):
            raise NotConnectedError("the session takes nothing: too many messages wait to be sent")
        if isinstance(message, ClearEStop):
            self.stop.withdraw()
        self.answers.expect()
        return request_id

    def peek_outgoing(self) -> tuple[bool, bytes] | None:
        """The next message to send: (may be dropped when the socket is full, bytes)."""
        return self._outgoing.peek()

    def pop_outgoing(self, *, sent: bool) -> None:
        """The message of `peek_outgoing` is done with: sent, or dropped."""
        self._outgoing.pop(sent=sent)

    def lease_version(self, target: str) -> int | None:
        """Our fencing token for `target`, by events or by a reply that came before its event."""
        granted, known = self.answers.granted(target), self.mirror.leases.get(target)
        if granted is not None and (known is None or granted.lease_version > known.lease_version):
            ours = granted.holder == self.participant_id or self.participant_id in granted.sub_holders
            return granted.lease_version if ours else None
        return self.mirror.find_lease_version(target, self.participant_id)

    def describe(self) -> str:
        """One line for people: why there is no connection now."""
        if self.phase in (Phase.WAITING, Phase.JOINING) and self.put_off is not None:
            return f"not let in yet, trying again: {RefusedError(self.put_off)}"
        if self.phase in (Phase.WAITING, Phase.JOINING):
            return "the connection was lost; joining again" if self.welcome else "no session has answered yet"
        texts = {Phase.IDLE: "not connected: call connect() first", Phase.CLOSED: "this client was closed"}
        return texts.get(self.phase, str(self.failure) if self.failure else "connected")

    # --- timers -------------------------------------------------------------------------------------------------------

    @property
    def _silence_ns(self) -> int:
        return SILENT_HEARTBEATS * max(self._heartbeat_ns, 500_000_000)

    @property
    def _snapshot_wanted(self) -> bool:
        return not self.mirror.synced or self.stream.wants_snapshot

    def _keep_up(self, now_ns: int) -> None:
        assert self.welcome is not None
        if now_ns - self._heard_at >= self._silence_ns:
            self.lost(now_ns)
            return
        if self.clock.ping_due(now_ns):
            self._queue(ClockPing(now_ns))
            self.stop.pinged(now_ns)
        if now_ns >= self._heartbeat_at:
            self._heartbeat_at = now_ns + self._heartbeat_ns // 2
            self._queue(Heartbeat(self.worn))
        if self._snapshot_wanted and now_ns >= self._snapshot_at:
            self._snapshot_at = now_ns + SNAPSHOT_RETRY_NS
            self._queue(GetSnapshot())

    def _say_hello(self, now_ns: int) -> None:
        """A fresh socket and a new hello: nothing meant for an earlier connection can reach the session."""
        self.generation += 1
        self.phase = Phase.JOINING
        self.stalled = False
        self._hello_at = now_ns
        self._heard_at = now_ns
        self._outgoing.clear()
        self.answers.clear()
        hello = msgspec.structs.replace(
            self.hello, secret=self.identity.secret, resume_token=self.identity.resume_token
        )
        self._outgoing.push(hello, encode_client(wrap_message(hello)))
        if self.stop.message is not None:  # anyone may stop, however early
            self._outgoing.push(self.stop.message, encode_client(wrap_message(self.stop.message)))

    def _wait(self, now_ns: int) -> None:
        self.phase = Phase.WAITING
        self._outgoing.clear()
        self._retry_at = now_ns + self._backoff_ns
        self._backoff_ns = min(2 * self._backoff_ns, BACKOFF_MAX_NS)

    def _queue(self, message: ClientMessage) -> bool:
        return self._outgoing.push(message, encode_client(wrap_message(message, self.connection_epoch)))
