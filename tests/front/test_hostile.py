"""The front against clients that are broken, hostile, slow or many. With real sockets: `test_processes`."""

from __future__ import annotations

import random
from collections.abc import Callable

import msgspec

from iris_session.link import FrontLimits
from iris_session.protocol.client_messages import EStop, GetSnapshot, Heartbeat, Hello, Marker, Sample, wrap_message
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


def test_hellos_above_capacity_or_rate_are_refused_with_advice(open_session: OpenSession) -> None:
    limits = FrontLimits(
        connections=2, hellos_per_second=0.001, hello_burst=3, hellos_per_source=0.001, hello_source_burst=1
    )
    session = open_session(limits=limits)
    for name in ("Ann", "Bob"):
        session.client().join(name=name)
    third = session.client()
    third.send(Hello("operator", "Cid", secret=third.secret))
    assert third.wait_for(Refused).code == "full"
    for _ in range(2):
        third.send(Hello("operator", "Cid", secret=third.secret))
    assert third.wait_for(Refused, 3).code == "rate"


def test_hellos_of_one_peer_do_not_limit_others(session: FrontSession) -> None:
    flooder = session.client()
    for _ in range(200):
        flooder.send(Hello("operator", "Knock"))
    session.pump(lambda: any(r.code == "rate" for r in flooder.got(Refused)), "refusal by rate")
    flooder.wait_for(Refused, 200)
    session.client().join()


def test_one_key_leaves_connections_to_others(open_session: OpenSession) -> None:
    session = open_session(limits=FrontLimits(connections=4))
    hog, ann = session.client(), session.client()
    clients = [hog]
    for _ in range(3):
        clients[-1].secret = hog.secret
        clients[-1].join(name="Hog")
        clients.append(session.client())
    clients[-1].send(Hello("operator", "Hog", secret=hog.secret))
    refused = clients[-1].wait_for(Refused)
    assert (refused.code, refused.message) == ("full", "this key has 3 connections already")
    ann.join()


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


def test_second_peer_with_the_same_routing_id_is_unknown(session: FrontSession) -> None:
    first = session.client(routing_id=b"headset")
    first.join()
    first.close()
    session.wait_entries(Lost)
    impostor = session.client(routing_id=b"headset")
    impostor.send(EStop("as Ann"), epoch=1)
    assert impostor.wait_for(ProtocolFault).code == "hello"
    assert not [e for e in session.entries if isinstance(e.message, EStop)]


def test_two_peers_with_one_routing_id_do_not_mix(session: FrontSession) -> None:
    first = session.client(routing_id=b"headset")
    first.join()
    impostor = session.client(routing_id=b"headset")
    impostor.send(EStop("as Ann"), epoch=1)
    first.send(Marker(1, "mine"))
    session.wait_entries(Marker)
    assert not [e for e in session.entries if isinstance(e.message, EStop)]


def test_rate_limits_are_per_message_type(session: FrontSession) -> None:
    client = session.client()
    client.join()
    for _ in range(60):
        client.send(GetSnapshot(1))
    client.send(Heartbeat())
    session.wait_entries(Heartbeat)
    fault = client.wait_for(ProtocolFault)
    assert fault.code == "rate"
    assert "get_snapshot" in fault.message
