"""Intake and admission without a network: identity of peers, answers, entries, and samples for the recorder."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
import pytest
import zmq

from iris_session.front.connections import Peer
from iris_session.link import FrontLimits
from iris_session.protocol.client_messages import (
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
from iris_session.protocol.codec import encode_client
from iris_session.protocol.common import IDENTITY
from iris_session.protocol.entries import Audit, Entry, Join
from iris_session.protocol.server_messages import ProtocolFault, Refused, Reply
from tests.front.intake_rig import ANN, EVE, HELLO, ROUTE, IntakeRig


@pytest.fixture
def rig() -> Iterator[IntakeRig]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield IntakeRig(context)
    context.destroy(linger=0)


def test_other_tcp_connection_on_the_same_route_is_unknown_and_ends_the_first(rig: IntakeRig) -> None:
    epoch = rig.join().connection_epoch
    rig.take(EStop("as Ann"), EVE, epoch)
    assert rig.last() == ProtocolFault("hello", "this connection has not said hello: say hello (again)")
    assert rig.entries() == []
    assert list(rig.intake.ended) == [epoch]


def test_more_than_one_frame_is_malformed(rig: IntakeRig) -> None:
    epoch = rig.join().connection_epoch
    rig.take(Marker(1, "x"), epoch=epoch, extra=1)
    fault = rig.last()
    assert isinstance(fault, ProtocolFault)
    assert (fault.code, rig.entries()) == ("malformed", [])


def test_before_the_welcome_an_estop_is_forwarded_and_nothing_else(rig: IntakeRig) -> None:
    rig.take(Hello("observer", "Ann", secret=b"s" * 16))
    rig.take(Marker(1, "too early"))
    rig.take(Marker(1, "early"), epoch=1)
    rig.take(EStop("now"))
    assert [type(e.message) for e in rig.entries()] == [EStop, Join]
    assert rig.drops.by_reason == {"not_admitted": 2}


def test_hellos_of_one_peer_are_bounded_until_it_disconnects(rig: IntakeRig) -> None:
    for _ in range(12):
        rig.take(Hello("operator", "Ann"))
    assert [m.code for _, m, _ in rig.sent if isinstance(m, Refused)] == ["identity"] * 10 + ["rate"] * 2
    rig.take(Hello("operator", "Eve"), EVE)
    assert rig.last() == rig.sent[0][1]
    rig.admission.remove_peer(ANN.descriptor)
    rig.take(Hello("operator", "Ann"))
    assert rig.last() == rig.sent[0][1]


def test_gateway_is_bound_to_its_tcp_connection(rig: IntakeRig) -> None:
    rig.join(role="gateway")
    rig.take(Hello("operator", "Tab", secret=b"s" * 16), EVE, behalf="tab1")
    refused = rig.last()
    assert isinstance(refused, Refused)
    assert refused.code == "gateway_only"
    (audit,) = rig.entries()
    assert audit.message == Audit("gateway_refused", "", "", "", "on behalf of tab1")


def test_estop_of_a_silent_client_counts_until_its_tcp_connection_is_closed(rig: IntakeRig) -> None:
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


def test_requests_above_rate_or_capacity_are_denied(rig: IntakeRig) -> None:
    number = rig.join().connection_epoch
    for i in range(200):
        rig.take(Marker(i + 1, "x"), epoch=number)
    faults = [m for _, m, _ in rig.sent if isinstance(m, ProtocolFault)]
    assert rig.drops.by_reason["rate"] == 160
    assert 1 <= len(faults) <= 11
    rig.take(EStop(), epoch=number)
    assert isinstance(rig.coalescer.take_batch(urgent_only=True)[0].message, EStop)
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


def test_newest_tracking_epoch_has_no_rate_limit(rig: IntakeRig) -> None:
    number = rig.join().connection_epoch
    for epoch in range(1, 101):
        rig.take(TrackingEpoch(epoch), epoch=number)
    assert [e.message for e in rig.coalescer.take_batch()] == [TrackingEpoch(10)]
    rig.now_ns += 1_000_000_000
    rig.take(Heartbeat(), epoch=number)
    assert {type(e.message): e.message for e in rig.coalescer.take_batch()}[TrackingEpoch] == TrackingEpoch(100)
    rig.take(Heartbeat(), epoch=number)
    assert [e.message for e in rig.coalescer.take_batch()] == [Heartbeat()]


def test_full_session_admits_clients_with_a_resume_token(rig: IntakeRig) -> None:
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


def test_strangers_behind_a_gateway_use_up_no_hellos_of_others(rig: IntakeRig) -> None:
    rig.join(Peer(5, "key-of-gateway"), role="gateway")
    for i in range(500):
        rig.take(Hello("operator", "Eve", secret=b"short"), Peer(5, "key-of-gateway"), behalf=f"tab{i % 8}")
    refused = rig.last()
    assert isinstance(refused, Refused)
    assert refused.code == "rate"
    rig.take(HELLO, Peer(5, "key-of-gateway"), behalf="ann")
    assert [e.message.name for e in rig.entries() if isinstance(e.message, Join)] == ["Ann"]


DEVICES = ("head", "controller/left", "controller/right")


def together(seq: int) -> Samples:
    return Samples(tuple(Sample(device, "pose", seq, 0, 1, 0, 0, pose=IDENTITY) for device in DEVICES))


def test_only_known_fields_of_samples_and_observations_are_recorded() -> None:
    """A client can neither put other bytes into the recording nor crash the front by a deep unknown field."""
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
        rig.intake._raw.tick(rig.now_ns)
        while recorder.poll(0):
            rows = msgspec.msgpack.decode(recorder.recv())
            assert {tuple(row[:2]) for row in rows} == {(epoch, rig.now_ns)}
            recorded += [data for _, _, data in rows]
        rig.intake._raw._socket.close(linger=0)  # type: ignore[union-attr]
    several = [msgspec.msgpack.encode(one) for one in together(8).samples]
    expected = [canonical, *several, msgspec.msgpack.encode(observation)]
    assert recorded[: len(expected)] == expected
    assert len(recorded) > len(expected)
    assert set(recorded[len(expected) :]) == {canonical}
