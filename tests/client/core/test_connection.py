"""The sans-I/O core: every path through joining, losing and resuming a connection, with plain bytes and numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iris_session.client.core.clock import SETTLED
from iris_session.client.core.connection import MAX_INBOX, ClientConnection
from iris_session.client.core.outbox import MAX_OUTGOING, MAX_PENDING
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.errors import IdentityError, NotConnectedError
from iris_session.client.identity import Identity
from iris_session.protocol.client_messages import (
    Acquire,
    Bye,
    ClientMessage,
    ClockPing,
    EStop,
    Heartbeat,
    Hello,
    Marker,
    Sample,
    TrackingEpoch,
)
from iris_session.protocol.codec import decode_client, encode_server
from iris_session.protocol.names import PROTOCOL_VERSION, RefusalCode
from iris_session.protocol.server_messages import (
    BodyInfo,
    ClockPong,
    Endpoints,
    Event,
    Notice,
    ProtocolFault,
    Refused,
    Reply,
    ServerEnvelope,
    ServerMessage,
    Snapshot,
    Welcome,
)
from iris_session.protocol.session_mirror import MissedEvents

MS = 1_000_000
SECOND = 1000 * MS
SAMPLE = Sample("head", "pose", 1, 0, 1, 0, 0)


class Wire:
    """A connection and the messages it sent."""

    def __init__(self) -> None:
        self.connection = ClientConnection(Hello("operator", "ann"), Identity(b"s" * 16))
        self.epoch = 0

    def sent(self) -> list[ClientMessage]:
        """Return everything queued since the last call."""
        messages = []
        while (item := self.connection.peek_outgoing()) is not None:
            self.connection.pop_outgoing(sent=True)
            messages.append(decode_client(item[1]).message)
        return messages

    def receive(self, message: ServerMessage, now_ns: int, *bulk: bytes, epoch: int | None = None) -> None:
        envelope = ServerEnvelope(PROTOCOL_VERSION, self.epoch if epoch is None else epoch, message)
        self.connection.receive([encode_server(envelope), *bulk], now_ns)

    def welcome(self, now_ns: int, token: bytes = b"token", session: str = "s1") -> None:
        self.epoch += 1
        ports = Endpoints(state=1)
        self.receive(
            Welcome(session, "lab", "live", "p1", self.epoch, "operator", token, False, 0, SECOND, MS, MS, ports),
            now_ns,
        )

    def snapshot(self, now_ns: int, event_seq: int = 0, bodies: int = 2, data: bytes | None = None) -> None:
        infos = tuple(BodyInfo(i, f"b{i}", True) for i in range(bodies))
        poses = np.zeros((bodies, 7))
        poses[:, 3] = 1.0
        snapshot = Snapshot(0, event_seq, 1, 0, "hash", 0, 0.0, 0, (), (), bodies=infos)
        self.receive(snapshot, now_ns, poses.tobytes() if data is None else data)

    def clock(self, now_ns: int) -> None:
        for _ in range(SETTLED):
            self.receive(ClockPong(now_ns, now_ns, now_ns), now_ns)

    def join(self, now_ns: int = 0) -> None:
        self.connection.open(now_ns)
        self.welcome(now_ns)
        self.clock(now_ns)
        self.snapshot(now_ns)
        self.sent()
        assert self.connection.phase is ConnectionPhase.READY


@pytest.fixture
def wire() -> Wire:
    return Wire()


def test_timers_keep_an_idle_connection_alive(wire: Wire) -> None:
    wire.join()
    kinds: list[type] = []
    now = 0
    while now < 10 * SECOND:
        now = max(now + MS, wire.connection.next_deadline_ns(now))
        wire.connection.tick(now)
        for message in wire.sent():
            kinds.append(type(message))
            if isinstance(message, ClockPing):
                wire.receive(ClockPong(message.t0_ns, now, now), now)
    assert wire.connection.phase is ConnectionPhase.READY
    assert kinds.count(Heartbeat) >= 19
    assert 15 <= kinds.count(ClockPing) <= 35


def test_silence_ends_the_connection_and_the_token_resumes_it(wire: Wire) -> None:
    wire.join()
    now = 0
    while wire.connection.is_joined:
        now = max(now + MS, wire.connection.next_deadline_ns(now))
        wire.connection.tick(now)
    assert 3 * SECOND <= now <= 5 * SECOND
    assert wire.connection.counters.reconnects == 1
    hello = wire.sent()[-1]
    assert isinstance(hello, Hello)
    assert hello.resume_token == b"token"


@pytest.mark.parametrize(
    ("code", "phase"),
    [
        ("session_ended", ConnectionPhase.WAITING),
        ("dropped", ConnectionPhase.JOINING),
        ("hello", ConnectionPhase.JOINING),
    ],
)
def test_faults_end_the_connection(wire: Wire, code: str, phase: ConnectionPhase) -> None:
    wire.join()
    wire.receive(ProtocolFault(code, "the session let this connection go: heartbeat"), SECOND)
    assert wire.connection.phase is phase
    assert wire.connection.session_ended == (code == "session_ended")
    assert wire.connection.counters.faults == {code: 1}


def test_new_session_resets_everything_but_the_tracking_epoch(wire: Wire) -> None:
    wire.join()
    wire.connection.tracking_epoch = 3
    wire.receive(Event(1, 0, 0, Notice("info", "x")), MS)
    assert wire.connection.mirror.event_seq == 1
    wire.connection.handle_disconnect(SECOND)
    wire.sent()
    wire.welcome(2 * SECOND, session="s2")
    assert not wire.connection.clock.synced
    assert wire.connection.mirror.event_seq == 0
    assert TrackingEpoch(3) in wire.sent()


def test_samples_are_never_queued_offline_and_other_messages_raise(wire: Wire) -> None:
    assert not wire.connection.send(SAMPLE)
    with pytest.raises(NotConnectedError):
        wire.connection.send(EStop())
    with pytest.raises(NotConnectedError):
        wire.connection.request(Acquire(0))
    wire.join()
    wire.connection.send(SAMPLE)
    wire.connection.handle_disconnect(SECOND)
    assert [type(message) for message in wire.sent()] == [Hello]
    assert not wire.connection.send(SAMPLE)
    assert wire.connection.counters.samples_not_sent == 2


def test_urgent_messages_are_sent_first_and_the_queue_is_bounded(wire: Wire) -> None:
    wire.join()
    for _ in range(2 * MAX_OUTGOING):
        wire.connection.send(SAMPLE)
    wire.connection.send(EStop("now"))
    sent = wire.sent()
    assert sent[0] == EStop("now")
    assert len(sent) == MAX_OUTGOING
    assert wire.connection.counters.samples_not_sent == MAX_OUTGOING + 1


def test_snapshot_ahead_of_events_reports_missed_events(wire: Wire) -> None:
    """The link was blocked for a while, and the snapshot is the first message afterwards."""
    wire.join()
    wire.receive(Event(1, 0, 0, Notice("info", "x")), MS)
    wire.snapshot(2 * MS, event_seq=1)
    assert not [m for m in wire.connection.inbox if isinstance(m, MissedEvents)], "none is missed"
    wire.snapshot(3 * MS, event_seq=7)
    wire.receive(Event(8, 0, 0, Notice("info", "y")), 4 * MS)
    assert wire.connection.mirror.gaps == 0
    delivered = [
        e if isinstance(e, MissedEvents) else e.event_seq
        for e in wire.connection.inbox
        if isinstance(e, Event | MissedEvents)
    ]
    assert delivered == [1, MissedEvents(2, 7), 8]


def test_inbox_is_bounded_and_reports_drops(wire: Wire) -> None:
    wire.join()
    for i in range(MAX_INBOX + 10):
        wire.receive(Event(i + 1, 0, 0, Notice("info", "x")), MS)
    assert len(wire.connection.inbox) == MAX_INBOX
    assert wire.connection.counters.inbox_dropped == 11
    first, second = wire.connection.inbox[0], wire.connection.inbox[1]
    assert first == MissedEvents(1, 11), "and the application is notified"
    assert isinstance(second, Event)
    assert second.event_seq == 12


@pytest.mark.parametrize("data", [b"", b"12345678", b"\0" * (3 * 56)])
def test_snapshot_with_wrong_number_of_poses_is_malformed(wire: Wire, data: bytes) -> None:
    wire.connection.open(0)
    wire.welcome(0)
    wire.snapshot(MS, data=data)
    assert wire.connection.counters.malformed == 1
    assert not wire.connection.mirror.synced


def test_close_sends_bye_and_deletes_the_token(wire: Wire) -> None:
    wire.join()
    wire.connection.send(Marker(0, "note"))
    wire.connection.close()
    assert isinstance(wire.sent()[-1], Bye)
    assert wire.connection.identity.resume_token == b""
    with pytest.raises(NotConnectedError, match="closed"):
        wire.connection.send(EStop())


def test_client_with_a_taken_over_identity_keeps_the_token_for_the_other(wire: Wire) -> None:
    wire.join()
    wire.receive(ProtocolFault("dropped", "let go", "replaced"), MS)
    assert wire.connection.phase is ConnectionPhase.REFUSED
    wire.connection.close()
    assert wire.connection.identity.resume_token == b"token"


def test_unread_replies_are_bounded(wire: Wire) -> None:
    wire.join()
    ids = []
    for _ in range(MAX_PENDING + 5):
        ids.append(wire.connection.request(Acquire(0)))
        wire.receive(Reply(ids[-1], True), MS)
    assert wire.connection.counters.inbox_dropped == 5
    assert wire.connection.requests.pop_reply(ids[4]) is None
    assert wire.connection.requests.pop_reply(ids[5]) == Reply(ids[5], True)


@given(st.lists(st.lists(st.binary(max_size=80), max_size=3), max_size=20))
@settings(max_examples=150, deadline=None)
def test_any_server_bytes_are_counted_and_harmless(messages: list[list[bytes]]) -> None:
    wire = Wire()
    wire.join()
    for frames in messages:
        wire.connection.receive(frames, MS)
    assert wire.connection.phase is ConnectionPhase.READY
    assert wire.connection.counters.malformed == len(messages)


def test_request_that_cannot_be_queued_raises(wire: Wire) -> None:
    wire.join()
    for _ in range(MAX_OUTGOING):
        wire.connection.send(Marker(0, "x"))
    with pytest.raises(NotConnectedError, match="queue full"):
        wire.connection.request(Acquire(0))


def test_full_disk_stops_neither_joining_nor_closing(
    wire: Wire, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def raise_full() -> None:
        raise IdentityError("no space left on device")

    wire.connection.identity.path = Path("identity")
    monkeypatch.setattr(wire.connection.identity, "_write", raise_full)
    wire.join()
    assert wire.connection.identity.resume_token == b"token"
    wire.connection.handle_disconnect(2 * SECOND)
    wire.receive(Refused(RefusalCode.RESUME_TOKEN, "used"), 2 * SECOND, epoch=0)
    wire.welcome(3 * SECOND, b"next")
    wire.connection.close()
    assert wire.connection.counters.identity_unwritten == 4
    assert len(caplog.records) == 1
