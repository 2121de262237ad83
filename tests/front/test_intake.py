"""Intake and admission without a network: identity of peers, answers, entries, and samples for the recorder."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
import pytest
import zmq

from iris_session.front.admission import Admission
from iris_session.front.connections import Peer
from iris_session.front.intake import Intake, RawFeed
from iris_session.front.pairing import PairingService
from iris_session.link import FrontLimits
from iris_session.protocol.client_messages import (
    ClientMessage,
    EStop,
    Heartbeat,
    Hello,
    Marker,
    Observation,
    Sample,
    Samples,
    TrackingEpoch,
    wrap_message,
)
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.common import IDENTITY
from iris_session.protocol.entries import Audit, Entry, Join
from iris_session.protocol.limits import LIMITS
from iris_session.protocol.server_messages import Message, ProtocolFault, Refused, Reply, Welcome
from iris_session.protocol.steps import Admitted
from tests.front.fakes import make_alignment, make_context, make_status

ROUTE = b"headset"
ANN = Peer(5, "")
EVE = Peer(6, "")
HELLO = Hello("operator", "Ann", secret=b"s" * 16)


class IntakeRig:
    """Intake and admission with an outbox that keeps sent messages. `recorder`: endpoint of raw samples."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], recorder: str = "") -> None:
        self.now_ns = 1_000_000_000
        self.sent: list[tuple[bytes, Message, list[bytes]]] = []
        front = make_context(self, lambda: self.now_ns)
        self.limits = front.config.limits
        self.drops, self.clients, self.coalescer = front.drops, front.connections, front.coalescer
        self.tokens, self.guard = front.tokens, front.guard
        self.admission = Admission(front, ())
        alignment = make_alignment(front)
        self.intake = Intake(
            front,
            self.admission,
            PairingService(front),
            make_status(front, alignment),
            alignment,
            RawFeed(context, recorder, front.drops),
        )

    def send_multipart(self, frames: list[bytes], _flags: int) -> None:
        self.sent.append((frames[0], decode_server(frames[1]).message, frames[2:]))

    def take(self, message: ClientMessage, peer: Peer = ANN, epoch: int = 0, behalf: str = "", extra: int = 0) -> None:
        data = encode_client(wrap_message(message, epoch, behalf))
        self.intake.handle_message(ROUTE, peer, memoryview(data), extra)

    def join(self, peer: Peer = ANN, **hello: object) -> Welcome:
        self.take(msgspec.structs.replace(Hello("operator", "Ann", secret=b"s" * 16), **hello), peer)
        (entry,) = self.coalescer.take_batch()
        assert isinstance(entry.message, Join)
        self.admission.send_welcome(Admitted(entry.connection, "p1", "operator", False), self.now_ns, 2_000_000)
        welcome = self.sent[-1][1]
        assert isinstance(welcome, Welcome)
        return welcome

    def entries(self) -> list[Entry]:
        return self.coalescer.take_batch()

    def last(self) -> Message:
        return self.sent[-1][1]


@pytest.fixture
def rig() -> Iterator[IntakeRig]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield IntakeRig(context)
    context.destroy(linger=0)


def test_another_tcp_connection_on_the_same_route_is_a_stranger_and_ends_the_first(rig: IntakeRig) -> None:
    epoch = rig.join().connection_epoch
    rig.take(EStop("as Ann"), EVE, epoch)
    assert rig.last() == ProtocolFault("hello", "this connection has not said hello: say hello (again)")
    assert rig.entries() == []
    assert [c.number for c in rig.intake.replaced] == [epoch]


def test_another_key_on_the_same_route_is_a_stranger(rig: IntakeRig) -> None:
    epoch = rig.join(Peer(5, "key-of-ann"), secret=b"").connection_epoch
    rig.take(EStop("as Ann"), Peer(5, "key-of-eve"), epoch)
    assert rig.entries() == []
    assert isinstance(rig.last(), ProtocolFault)


def test_the_curve_key_is_the_identity_whatever_the_secret(rig: IntakeRig) -> None:
    rig.take(Hello("operator", "Ann", secret=b"x" * 16), Peer(5, "fingerprint"))
    (entry,) = rig.entries()
    assert isinstance(entry.message, Join)
    assert entry.message.key_id == "fingerprint"


def test_more_than_one_frame_is_malformed(rig: IntakeRig) -> None:
    epoch = rig.join().connection_epoch
    rig.take(Marker(1, "x"), epoch=epoch, extra=1)
    fault = rig.last()
    assert isinstance(fault, ProtocolFault)
    assert (fault.code, rig.entries()) == ("malformed", [])


def test_what_is_said_before_admission_is_dropped_and_counted(rig: IntakeRig) -> None:
    rig.take(Hello("operator", "Ann", secret=b"s" * 16))
    rig.take(Marker(1, "early"), epoch=1)
    assert [type(e.message) for e in rig.entries()] == [Join]
    assert rig.drops.by_reason == {"not_admitted": 1}


def test_too_many_messages_of_a_type_are_dropped_with_a_fault_now_and_then(rig: IntakeRig) -> None:
    epoch = rig.join().connection_epoch
    for i in range(100):
        rig.take(Marker(i, "x"), epoch=epoch)
    faults = [m for _, m, _ in rig.sent if isinstance(m, ProtocolFault)]
    assert rig.drops.by_reason["rate"] == 60
    assert 1 <= len(faults) <= 6
    assert "marker" in faults[0].message
    rig.take(EStop(), epoch=epoch)
    assert isinstance(rig.entries()[0].message, EStop)


def test_an_estop_is_never_over_its_rate(rig: IntakeRig) -> None:
    epoch = rig.join().connection_epoch
    for _ in range(1000):
        rig.take(EStop(), epoch=epoch)
        (entry,) = rig.entries()
        assert isinstance(entry.message, EStop)


def test_a_stop_does_not_wait_for_the_welcome(rig: IntakeRig) -> None:
    rig.take(Hello("observer", "Ann", secret=b"s" * 16))
    rig.take(Marker(1, "too early"))
    rig.take(EStop("now"))
    assert [type(e.message) for e in rig.entries()] == [EStop, Join]


def test_the_hellos_of_one_peer_are_bounded_until_it_is_gone(rig: IntakeRig) -> None:
    for _ in range(12):
        rig.take(Hello("operator", "Ann"))
    assert [m.code for _, m, _ in rig.sent if isinstance(m, Refused)] == ["identity"] * 10 + ["rate"] * 2
    rig.take(Hello("operator", "Eve"), EVE)
    assert rig.last() == rig.sent[0][1]
    rig.admission.remove_peer(ANN.descriptor)
    rig.take(Hello("operator", "Ann"))
    assert rig.last() == rig.sent[0][1]


def test_answers_to_those_behind_a_gateway_name_them(rig: IntakeRig) -> None:
    rig.join(role="gateway")
    rig.take(Hello("operator", "Tab"), behalf="tab1")
    route, refused, bulk = rig.sent[-1]
    assert (route, bulk) == (ROUTE, [b"tab1"])
    assert isinstance(refused, Refused)


def test_two_behind_one_gateway_with_one_secret_are_one_key_but_not_that_of_a_client(rig: IntakeRig) -> None:
    rig.join(role="gateway")
    for tab in ("tab1", "tab2"):
        rig.take(Hello("operator", tab, secret=b"s" * 16), behalf=tab)
    first, second = (e.message.key_id for e in rig.entries() if isinstance(e.message, Join))
    assert first == second != rig.clients.by_number[1].key_id


def test_nobody_speaks_for_a_gateway_of_another_tcp_connection(rig: IntakeRig) -> None:
    rig.join(role="gateway")
    rig.take(Hello("operator", "Tab", secret=b"s" * 16), EVE, behalf="tab1")
    refused = rig.last()
    assert isinstance(refused, Refused)
    assert refused.code == "gateway_only"
    (audit,) = rig.entries()
    assert audit.message == Audit("gateway_refused", "", "", "", "on behalf of tab1")


def test_a_stop_of_who_was_given_up_lately_counts_until_the_tcp_connection_is_closed(rig: IntakeRig) -> None:
    number = rig.join().connection_epoch
    lost = rig.clients.by_number[number]
    rig.clients.remove(lost)
    rig.take(EStop("unknown"), epoch=number)
    assert not rig.coalescer
    rig.clients.keep_for_estop(lost)
    rig.take(EStop("by another"), EVE, epoch=number)
    assert not rig.coalescer
    rig.take(EStop("now"), epoch=number)
    assert rig.coalescer.take_batch() == [Entry(number, number, rig.now_ns, EStop("now"))]
    fault = rig.sent[-1][1]
    assert isinstance(fault, ProtocolFault)
    assert fault.code == "hello", "it is told to come back all the same"
    rig.clients.remove_closed(ANN.descriptor, ("10.0.0.1", 5))
    rig.take(EStop("somebody else"), epoch=number)
    assert not rig.coalescer


def test_requests_above_their_rate_or_without_room_are_answered_by_a_denial(rig: IntakeRig) -> None:
    number = rig.join().connection_epoch
    for i in range(200):
        rig.take(Marker(i + 1, "x"), epoch=number)
    denied = {m.request_id: m.denial for _, m, _ in rig.sent if isinstance(m, Reply)}
    taken = {e.message.request_id for e in rig.coalescer.take_batch() if isinstance(e.message, Marker)}
    assert taken == set(range(1, 41))
    assert set(denied) == set(range(41, 81)), "at a bounded rate"
    assert all(d is not None and d.reason == "quota" and "marker" in d.message for d in denied.values())
    rig.sent.clear()
    for second in range(1, 20):  # within the rate, while the authority takes nothing
        rig.now_ns += 1_000_000_000
        for i in range(10):
            rig.take(Marker(1000 * second + i, "x"), epoch=number)
    replies = [m for _, m, _ in rig.sent if isinstance(m, Reply)]
    assert len(replies) == 190 - FrontLimits().pending_messages
    assert all(r.denial is not None and r.denial.reason == "quota" for r in replies)


def test_the_newest_tracking_epoch_gets_through_whatever_its_rate(rig: IntakeRig) -> None:
    number = rig.join().connection_epoch
    for epoch in range(1, 101):
        rig.take(TrackingEpoch(epoch), epoch=number)
    assert [e.message for e in rig.coalescer.take_batch()] == [TrackingEpoch(10)]
    rig.now_ns += 1_000_000_000
    rig.take(Heartbeat(), epoch=number)
    assert {type(e.message): e.message for e in rig.coalescer.take_batch()}[TrackingEpoch] == TrackingEpoch(100)
    rig.take(Heartbeat(), epoch=number)
    assert [e.message for e in rig.coalescer.take_batch()] == [Heartbeat()]


def test_a_full_house_lets_back_in_who_has_a_token(rig: IntakeRig) -> None:
    welcome = rig.join()
    for i in range(rig.limits.connections - 1):
        rig.now_ns += 1_000_000_000
        hello = msgspec.structs.replace(HELLO, secret=b"%016d" % i)
        rig.intake.handle_message(bytes([i]), Peer(100 + i, ""), memoryview(encode_client(wrap_message(hello))), 0)
    assert len(rig.clients) == rig.limits.connections
    rig.now_ns += 1_000_000_000
    rig.coalescer.take_batch()
    late, back = Peer(7, ""), Peer(8, "")
    data = encode_client(wrap_message(HELLO))
    rig.intake.handle_message(b"late", late, memoryview(data), 0)
    assert isinstance(rig.sent[-1][1], Refused)
    data = encode_client(wrap_message(msgspec.structs.replace(HELLO, resume_token=welcome.resume_token)))
    rig.intake.handle_message(b"back", back, memoryview(data), 0)
    (entry,) = rig.coalescer.take_batch()
    assert isinstance(entry.message, Join)
    assert entry.message.resume_of == "p1"


def test_a_key_that_uses_up_all_hellos_keeps_nobody_else_out(rig: IntakeRig) -> None:
    for i in range(1000):
        data = encode_client(wrap_message(Hello("operator", "Eve")))
        rig.intake.handle_message(b"%d" % i, Peer(1000 + i, "key-of-eve"), memoryview(data), 0)
    refused = rig.last()
    assert isinstance(refused, Refused)
    assert refused.code == "rate"
    rig.coalescer.take_batch()
    assert rig.join(Peer(5, "key-of-ann")).participant_id == "p1"


def test_who_is_above_the_limits_for_seconds_is_named_as_a_flood(rig: IntakeRig) -> None:
    epoch = rig.join().connection_epoch

    def floods() -> list[Audit]:
        return [e.message for e in rig.entries() if isinstance(e.message, Audit)]

    for _ in range(60):  # a burst is none
        rig.take(Marker(1, "x"), epoch=epoch)
    assert floods() == []
    for _ in range(300):
        rig.now_ns += 10_000_000
        for _ in range(5):
            rig.take(Marker(1, "x"), epoch=epoch)
    (flood,) = floods()
    assert (flood.kind, flood.subject, flood.name, flood.detail) == ("flood", "p1", "Ann", "marker")


DEVICES = ("head", "controller/left", "controller/right")


def together(seq: int) -> Samples:
    return Samples(tuple(Sample(device, "pose", seq, 0, 1, 0, 0, pose=IDENTITY) for device in DEVICES))


def test_each_sample_becomes_an_entry_of_its_own() -> None:
    with zmq.Context() as context:
        rig = IntakeRig(context)
        epoch = rig.join().connection_epoch
        rig.take(together(7), epoch=epoch)
        entries = rig.entries()
    assert [e.message for e in entries] == list(together(7).samples)
    assert {(e.connection, e.connection_epoch) for e in entries} == {(epoch, epoch)}


def test_a_flood_is_cut_at_the_rate_of_single_samples_and_counted() -> None:
    with zmq.Context() as context:
        rig = IntakeRig(context)
        epoch = rig.join().connection_epoch
        for seq in range(LIMITS[Samples].burst):
            rig.take(together(seq), epoch=epoch)
    assert rig.drops.by_reason["rate"] == 3 * LIMITS[Samples].burst - LIMITS[Sample].burst


def test_only_known_fields_of_samples_and_observations_are_recorded() -> None:
    """A client cannot put other bytes into the recording, nor bring the front down by a deep unknown field."""
    sample = Sample("head", "pose", 7, 0, 1, 0, 0, pose=IDENTITY, gripper=0.5)
    observation = Observation("table", "qr", IDENTITY, 1000, 1, 0)
    canonical = msgspec.msgpack.encode(sample)
    with zmq.Context() as context, context.socket(zmq.PULL) as recorder:
        recorder.bind("inproc://recorder")
        rig = IntakeRig(context, "inproc://recorder")
        epoch = rig.join().connection_epoch
        rig.take(sample, epoch=epoch)
        rig.take(together(8), epoch=epoch)
        rig.take(observation, epoch=epoch)
        fields = msgspec.msgpack.decode(canonical)
        body = canonical[1:] if len(fields) < 16 else canonical[3:]
        head = b"\xde" + (len(fields) + 1).to_bytes(2, "big")
        for depth in (1, 900, 950, 980, 990, 995, 999):  # the first of them is accepted, too deep ones are refused
            deep = head + body + b"\xa1x" + b"\x91" * depth + b"\xc0"
            frame = encode_client(wrap_message(sample, epoch))
            rig.intake.handle_message(ROUTE, ANN, memoryview(frame.replace(canonical, deep)), 0)
        recorded = []
        while recorder.poll(0):
            connection, receive_ns, data = msgspec.msgpack.decode(recorder.recv())
            assert (connection, receive_ns) == (epoch, rig.now_ns)
            recorded.append(data)
        rig.intake._raw._socket.close(linger=0)  # type: ignore[union-attr]
    several = [msgspec.msgpack.encode(one) for one in together(8).samples]
    expected = [canonical, *several, msgspec.msgpack.encode(observation)]
    assert recorded[: len(expected)] == expected
    assert len(recorded) > len(expected)
    assert set(recorded[len(expected) :]) == {canonical}
