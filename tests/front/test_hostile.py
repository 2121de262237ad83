"""The real front process against clients that are broken, hostile, slow or many."""

from __future__ import annotations

import random
import socket as sockets
import time
from collections import deque
from collections.abc import Callable

import msgspec
import numpy as np
import psutil
import pytest
import zmq

from iris_session.link import FrontLimits
from iris_session.protocol.client_messages import EStop, GetSnapshot, Heartbeat, Hello, Marker, Sample, wrap_message
from iris_session.protocol.codec import encode_client
from iris_session.protocol.common import IDENTITY
from iris_session.protocol.entries import Entry, Lost
from iris_session.protocol.limits import MAX_CLIENT_BYTES
from iris_session.protocol.server_messages import Event, ProtocolFault, Refused
from iris_session.protocol.steps import Decision, OutgoingMessage
from tests.front.harness import FrontSession

pytestmark = pytest.mark.e2e
OpenSession = Callable[..., FrontSession]
BODIES = 2000


def test_garbage_is_answered_with_bounded_faults(session: FrontSession) -> None:
    joined, stranger = session.client(), session.client()
    joined.join()
    rng, began = random.Random(1), time.monotonic()
    good = encode_client(wrap_message(Marker(1, "x" * 50), 1))
    for _ in range(300):
        noise = rng.randbytes(rng.randrange(200))
        cut = bytearray(good)
        cut[rng.randrange(len(cut))] ^= 1 << rng.randrange(8)
        for data in (noise, bytes(cut[: rng.randrange(len(cut))]), b"", b"\xc1", b"\x94\x01"):
            joined.socket.send(data)
            stranger.socket.send(data)
        joined.socket.send_multipart([b"", good, b"extra"])
    joined.send(EStop("still heard"))
    session.wait_entries(EStop)
    assert session.process.alive
    fault = joined.wait_for(ProtocolFault)
    assert fault.code == "malformed"
    seconds = time.monotonic() - began
    assert len(joined.got(ProtocolFault)) < 10 + 3 * seconds
    assert session.wait_drops("malformed", 301) > 300
    assert session.wait_drops("hello_malformed", 301) > 300
    assert stranger.wait_for(Refused).code == "malformed"
    assert len(stranger.got(Refused)) < 40 + 25 * (time.monotonic() - began)


def test_invalid_values_are_named_in_the_fault(session: FrontSession) -> None:
    client = session.client()
    client.join()
    client.socket.send(msgspec.msgpack.encode([1, 1, "", {"type": "dance"}]))
    assert "dance" in client.wait_for(ProtocolFault).message
    client.socket.send(msgspec.msgpack.encode([1, 1, "", {"type": "marker", "request_id": 1, "text": "x" * 5000}]))
    assert client.wait_for(ProtocolFault, 2).code in ("malformed", "too_large")


def test_huge_frame_disconnects_only_its_sender(session: FrontSession) -> None:
    honest, huge = session.client(), session.client()
    honest.join(name="Ann")
    huge.join(name="Bob")
    huge.socket.send(b"x" * (MAX_CLIENT_BYTES + 1))
    (lost,) = session.wait_entries(Lost)
    assert lost.connection == 2
    honest.send(EStop())
    session.wait_entries(EStop, connection=1)


def test_three_hundred_connections_without_hello_leave_room(session: FrontSession) -> None:
    crowd = [sockets.create_connection((session.host, session.ports.control)) for _ in range(150)]
    peers = [session.client() for _ in range(150)]
    client = session.client()
    client.join()
    client.send(EStop())
    session.wait_entries(EStop)
    for tcp in crowd:
        tcp.close()
    for peer in peers:
        peer.close()
    client.send(Marker(1, "after"))
    session.wait_entries(Marker)
    assert not session.wait_entries(EStop)[0].connection > 1


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
    knocking = session.client()
    for _ in range(200):
        knocking.send(Hello("operator", "Knock"))
    session.pump(lambda: any(r.code == "rate" for r in knocking.got(Refused)), "refusal by rate")
    knocking.wait_for(Refused, 200)
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


def test_connections_without_subscription_do_not_block_subscribers(open_session: OpenSession) -> None:
    session = open_session(limits=FrontLimits(subscribers=5))
    crowd = [sockets.create_connection((session.host, session.ports.state)) for _ in range(20)]
    sub = session.subscriber()

    def state_comes() -> bool:
        session.send_state(np.zeros((3, 7)))
        return bool(sub.poll(0))

    session.pump(state_comes, "state")
    for tcp in crowd:
        tcp.close()


def test_flood_does_not_delay_the_estop_of_another_client(session: FrontSession) -> None:
    flooder, other = session.client(), session.client()
    flooder.join("operator", "Flood")
    other.join("observer", "Eve")
    sample = Sample("head", "pose", 1, 0, 1, 0, 1, pose=IDENTITY)
    flood = [
        encode_client(wrap_message(msgspec.structs.replace(sample, seq=seq, clutch=seq % 2 == 1), 1))
        for seq in range(30_000)
    ]
    for data in flood:
        try:
            flooder.socket.send(data, zmq.DONTWAIT)
        except zmq.Again:
            break
    other.send(EStop("now"))
    (stop,) = session.wait_entries(EStop)
    before = [e for e in session.entries if isinstance(e.message, Sample)]
    assert len(before) < 3000, "the e-stop waited behind the flood"
    assert session.wait_drops("rate") > 0
    assert stop.connection == 2


def test_stalled_authority_gets_a_bounded_batch_with_the_estop_first(session: FrontSession) -> None:
    client, other = session.client(), session.client()
    client.join()
    other.join(name="Bob")
    for seq in range(500):
        client.send(Sample("head", "pose", seq, 0, 1, 0, 1, pose=IDENTITY))
        client.send(Marker(seq, "x"))
        time.sleep(0.0002)  # spread over many passes of the front, so that its credit is used up
    other.send(EStop())
    waiting: list[Entry] = []
    batches = 0
    deadline = time.monotonic() + 30
    while not any(isinstance(e.message, EStop) for e in waiting):
        assert time.monotonic() < deadline
        got = session.process.link.poll()
        batches += bool(got)
        waiting += got
    assert len(waiting) < 300
    assert session.wait_drops("rate") > 0


def test_client_that_reads_nothing_is_disconnected_as_slow(open_session: OpenSession) -> None:
    session = open_session(limits=FrontLimits(send_queue=64, slow_drops=16), silence_ns=60_000_000_000)
    honest = session.client()
    honest.join(name="Ann")
    slow = session.context.socket(zmq.DEALER)
    slow.linger = 0
    slow.rcvhwm = 1
    slow.setsockopt(zmq.RCVBUF, 4096)
    disconnects = slow.get_monitor_socket(zmq.EVENT_DISCONNECTED)
    slow.connect(f"tcp://{session.host}:{session.ports.control}")
    slow.send(encode_client(wrap_message(Hello("observer", "Slow", secret=b"s" * 16))))
    session.pump(lambda: slow.poll(0) != 0, "welcome of the slow client")
    text = "x" * 500

    def lost() -> bool:
        session.once(Decision((), events=tuple(session.notice(text) for _ in range(4))))
        honest.wait_for(Event, session.event_seq)  # on a busy machine its thread could be slow, too
        return any(isinstance(e.message, Lost) for e in session.entries)

    session.pump(lost, "loss of the slow client")
    (loss,) = [e for e in session.entries if isinstance(e.message, Lost)]
    assert (loss.connection, loss.message) == (2, Lost("slow"))
    assert session.wait_drops("send_queue_full", 16) >= 16
    honest.wait_for(Event, 10)
    seqs = [event.event_seq for event in honest.got(Event)]
    assert seqs == list(range(1, len(seqs) + 1))
    # Its TCP connection is closed: what waits for it takes no memory any more.
    deadline = time.monotonic() + 30.0
    while not disconnects.poll(10):  # it is told after it has read what came before
        assert time.monotonic() < deadline
        while slow.poll(0):
            slow.recv()
    slow.disable_monitor()
    disconnects.close(linger=0)
    slow.close()


def test_pending_bytes_of_a_stalled_client_are_bounded(open_session: OpenSession) -> None:
    limits = FrontLimits(send_queue=100_000, slow_drops=10**9, memory_bytes=24 << 20)
    session = open_session(limits=limits, silence_ns=60_000_000_000, bodies=BODIES)
    slow, honest, waiting = session.client(), session.client(), session.client()
    slow.join(name="Bob")
    honest.join(name="Ann")
    waiting.join(name="Eve")  # neither is the newest at fault, nor a stranger
    session.clients.remove(slow)  # it reads no more
    slow.socket.rcvhwm = 1
    front = psutil.Process(session.process.pid)
    base = front.memory_info().rss

    def lost() -> bool:
        session.once(Decision((), outgoing=(OutgoingMessage(1, session.snapshot(1)),) * 2))
        assert front.memory_info().rss - base < 3 * limits.memory_bytes
        return any(isinstance(e.message, Lost) for e in session.entries)

    session.pump(lost, "the end of who reads nothing", timeout_s=60.0)
    (loss,) = [e for e in session.entries if isinstance(e.message, Lost)]
    assert loss.connection == 1
    assert session.wait_drops("memory") == 1
    session.pump(lambda: any("memory" in getattr(e.message, "detail", "") for e in session.entries), "its name")
    honest.send(EStop())
    session.wait_entries(EStop, connection=2)
    slow.close()


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


def test_state_continues_while_one_subscriber_reads_nothing(open_session: OpenSession) -> None:
    """Sends more than all queues and socket buffers to the stalled one hold."""
    session = open_session(bodies=BODIES)
    stuck = session.subscriber(rcvhwm=1, rcvbuf=4096)
    sub = session.subscriber()
    rng = np.random.default_rng(1)
    received = 0
    drops: deque[int] = deque(maxlen=300)  # after each of the last states: a front that the machine stops drops some

    def enough() -> bool:
        nonlocal received
        session.send_state(rng.normal(size=(BODIES, 7)))
        drops.append(session.process.link.state_drops)
        while sub.poll(0):
            received += sum(map(len, sub.recv_multipart()))
        return received > 25_000_000 and drops[-1] - drops[0] < len(drops) / 2

    session.pump(enough, "25 MB of state, the last of which did not wait for the stuck one", timeout_s=120.0)
    for_stuck = 0
    while stuck.poll(200):
        for_stuck += sum(map(len, stuck.recv_multipart()))
    assert 0 < for_stuck < received / 4, "it got what fits on the way, and the rest was dropped for it alone"
