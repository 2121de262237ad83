"""The front against clients that are broken, hostile, slow or many. With real sockets: `test_processes`."""

from __future__ import annotations

import random
from collections.abc import Callable

import msgspec

from iris_session.link import FrontLimits
from iris_session.protocol.client_messages import EStop, Marker, Sample, wrap_message
from iris_session.protocol.codec import encode_client
from iris_session.protocol.common import IDENTITY
from iris_session.protocol.entries import Lost
from iris_session.protocol.server_messages import Event, ProtocolFault, Refused
from iris_session.protocol.steps import Decision
from tests.front.harness import FrontSession

OpenSession = Callable[..., FrontSession]


def test_garbage_is_answered_with_bounded_faults(session: FrontSession) -> None:
    joined, unknown = session.client(), session.client()
    joined.join()
    rng = random.Random(1)
    good = encode_client(wrap_message(Marker(1, "x" * 50), 1))
    for _ in range(300):
        noise = rng.randbytes(rng.randrange(200))
        cut = bytearray(good)
        cut[rng.randrange(len(cut))] ^= 1 << rng.randrange(8)
        for data in (noise, bytes(cut[: rng.randrange(len(cut))]), b"", b"\xc1", b"\x94\x01"):
            joined.socket.send(data)
            unknown.socket.send(data)
        joined.socket.send_multipart([b"", good, b"extra"])
    joined.send(EStop("still heard"))
    session.wait_entries(EStop)
    fault = joined.wait_for(ProtocolFault)
    assert fault.code == "malformed"
    assert len(joined.got(ProtocolFault)) < 10
    assert session.wait_drops("malformed", 301) > 300
    assert session.wait_drops("hello_malformed", 301) > 300
    assert unknown.wait_for(Refused).code == "malformed"
    assert len(unknown.got(Refused)) < 40


def test_invalid_values_are_named_in_the_fault(session: FrontSession) -> None:
    client = session.client()
    client.join()
    client.socket.send(msgspec.msgpack.encode([1, 1, "", {"type": "dance"}]))
    assert "dance" in client.wait_for(ProtocolFault).message
    client.socket.send(msgspec.msgpack.encode([1, 1, "", {"type": "marker", "request_id": 1, "text": "x" * 5000}]))
    assert client.wait_for(ProtocolFault, 2).code in ("malformed", "too_large")


def test_stalled_authority_gets_a_bounded_batch_with_the_estop_first(session: FrontSession) -> None:
    client, other = session.client(), session.client()
    client.join()
    other.join(name="Bob")
    for seq in range(500):
        client.send(Sample("head", "pose", seq, 0, 1, 0, 1, pose=IDENTITY))
        client.send(Marker(seq, "x"))
        session.run_front()  # the authority takes nothing, and the credit of the front is used up
    other.send(EStop())
    session.run_front()
    waiting = session.link.poll()
    assert len(waiting) < 300
    assert any(isinstance(entry.message, EStop) for entry in waiting), "urgent entries have credit of their own"
    assert session.wait_drops("rate") > 0


def test_client_that_reads_nothing_is_disconnected_as_slow(open_session: OpenSession) -> None:
    session = open_session(limits=FrontLimits(slow_drops=16))
    honest, slow = session.client(), session.client()
    honest.join(name="Ann")
    slow.join(name="Slow")
    slow.reads = False
    for _ in range(20):
        session.once(Decision((), events=(session.notice("x" * 500),)))
    (loss,) = session.wait_entries(Lost)
    assert (loss.connection, loss.message) == (2, Lost("slow"))
    assert session.wait_drops("send_queue_full", 16) >= 16
    assert not slow.is_connected, "what waits for it takes no memory any more"
    assert [event.event_seq for event in honest.got(Event)] == list(range(1, 21))
