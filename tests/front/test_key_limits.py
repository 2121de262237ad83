"""One key against everybody, at a real front process: what it may open, hold and send, over all its connections."""

from __future__ import annotations

import contextlib
import os
import random
import socket
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
import zmq

from iris_session.link import FrontLimits
from iris_session.protocol.client_messages import EStop, Hello, Marker, wrap_message
from iris_session.protocol.codec import encode_client, encode_media_frames
from iris_session.protocol.entries import Lost
from iris_session.protocol.names import AuditKind
from iris_session.protocol.server_messages import Refused, Welcome
from iris_session.protocol.steps import Decision, OutgoingMessage
from iris_session.security import KeyPair
from iris_session.system.priority import LOW_PRIORITY_NICE
from tests.front.harness import FrontSession, RawClient
from tests.front.lab import Lab

pytestmark = pytest.mark.e2e
OpenSession = Callable[..., FrontSession]
MIB = 1 << 20


def join_many(lab: Lab, pair: KeyPair, n: int) -> list[RawClient]:
    """Send `n` hellos with one key, each by a connection of its own, and wait for all answers."""
    clients = [lab.client(pair) for _ in range(n)]
    for client in clients:
        client.send(Hello("observer", "Hog"))
        lab.session.pump(lambda c=client: c.got(Welcome) or c.got(Refused), "an answer")  # type: ignore[misc]
    return clients


def open_push(lab: Lab, pair: KeyPair) -> zmq.Socket[bytes]:
    push = lab.session.context.socket(zmq.PUSH)
    push.linger = 0
    push.curve_serverkey, push.curve_publickey, push.curve_secretkey = lab.curve(pair)
    return push


def ingest_address(session: FrontSession) -> str:
    return f"tcp://{session.host}:{session.ports.media_ingest}"


def null_greeting() -> bytes:
    """ZMTP 3.0 greeting of the NULL mechanism, and its READY command as a PUSH socket."""
    greeting = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
    body = b"\x05READY" + b"\x0bSocket-Type" + struct.pack(">I", 4) + b"PUSH"
    return greeting + b"\x04" + bytes([len(body)]) + body


def curve_greeting() -> bytes:
    """ZMTP 3.0 greeting of the CURVE mechanism, and the beginning of a command of 8 MiB: no key has been shown."""
    greeting = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"CURVE".ljust(20, b"\0") + bytes(32)
    return greeting + b"\x06" + struct.pack(">Q", 8 * MIB)


class Unfinished:
    """A source that sends frame after frame of one message and never the last, by plain TCP."""

    def __init__(self, session: FrontSession, greeting: bytes = b"") -> None:
        self.socket = socket.create_connection((session.host, session.ports.media_ingest))
        self.socket.sendall(greeting or null_greeting())
        self.socket.setblocking(False)
        self._frame = b"\x03" + struct.pack(">Q", MIB) + bytes(MIB)
        self._rest = b""
        self.sent = 0

    def send(self, n_bytes: int) -> bool:
        """Send up to `n_bytes` in all, as far as the front reads. Return false when the connection was closed."""
        try:
            while self.sent < n_bytes:
                self._rest = self._rest or self._frame
                n = self.socket.send(self._rest)
                self._rest, self.sent = self._rest[n:], self.sent + n
        except BlockingIOError:
            pass
        except OSError:
            return False
        try:
            return self.socket.recv(65536) != b""
        except BlockingIOError:
            return True
        except OSError:
            return False


# --- connections ---


def test_one_key_has_a_handful_of_connections(lab: Lab) -> None:
    pair, first = lab.allowed("hog", "observer")
    clients = [first, *join_many(lab, pair, 13)]
    joined = [client for client in clients if client.got(Welcome)]
    assert len(joined) == 8
    refused = clients[-1].got(Refused)[0]
    assert refused.code in ("full", "rate")
    lab.allowed("ann", "operator")


def test_a_gateways_key_has_connections_for_many(lab: Lab) -> None:
    pair, first = lab.allowed("gateway", "gateway", "operator")
    clients = [first, *join_many(lab, pair, 13)]
    assert all(client.got(Welcome) for client in clients)


def test_one_key_leaves_subscribers_to_others(lab: Lab) -> None:
    pair, _ = lab.allowed("hog", "observer")
    subscribers = [lab.session.subscriber(curve=lab.curve(pair)) for _ in range(40)]
    monitors = [one.get_monitor_socket(zmq.EVENT_DISCONNECTED) for one in subscribers]
    for one in subscribers:
        one.setsockopt(zmq.RECONNECT_IVL, -1)
    excess = len(subscribers) - lab.session.config.limits.key.subscriber_handshake_burst
    assert lab.session.wait_drops("key_connections") > 0
    lab.session.pump(lambda: sum(bool(m.poll(0)) for m in monitors) >= excess - 4, "the excess is closed")
    for one, monitor in zip(subscribers, monitors, strict=True):
        one.disable_monitor()
        monitor.close(linger=0)


# --- those behind a gateway ---


def test_a_flood_of_one_behind_a_gateway_ends_only_its_participant(open_session: OpenSession) -> None:
    session = open_session()
    gateway = session.client()
    gateway.join("gateway", "Gate")
    for name in ("Ann", "Mallory"):
        gateway.send(Hello("observer", name, secret=os.urandom(16)), name)
        gateway.wait_for(Welcome, 2 if name == "Ann" else 3)
    ann, mallory = (w.connection_epoch for w in gateway.got(Welcome)[1:])
    data = encode_client(wrap_message(Marker(1, "x"), mallory, "Mallory"))
    for i in range(12_000):
        gateway.socket.send(data)
        if i % 1000 == 0:
            session.once()
    lost = session.wait_entries(Lost)
    assert [(entry.connection, entry.message) for entry in lost] == [(mallory, Lost("flood"))]
    assert session.wait_drops("flood_cut") == 1
    gateway.send(Marker(7, "still here"), "Ann", ann)
    session.wait_entries(Marker, connection=ann)


def test_refused_hellos_behind_a_gateway_end_no_one(open_session: OpenSession) -> None:
    session = open_session()
    gateway = session.client()
    gateway.join("gateway", "Gate")
    gateway.send(Hello("observer", "Ann", secret=os.urandom(16)), "Ann")
    gateway.wait_for(Welcome, 2)
    ann = gateway.got(Welcome)[-1].connection_epoch
    for i in range(8 * 200):
        gateway.send(Hello("observer", "Mallory", secret=b"short"), f"tab{i % 8}")
        if i % 100 == 0:
            session.once()
    gateway.send(Marker(7, "still here"), "Ann", ann)
    session.wait_entries(Marker, connection=ann)
    assert session.wait_drops("hello_rate", 1001) > 1000
    assert "flood_cut" not in session.process.link.status.drops


# --- e-stops ---


def test_a_flood_of_estops_is_few_entries_and_cut_and_the_first_counts_at_once(session: FrontSession) -> None:
    flooder, ann = session.client(), session.client()
    flooder.join("observer", "Mallory")
    ann.join("observer", "Ann")
    data = encode_client(wrap_message(EStop("flood"), flooder.epoch))
    began = time.monotonic()
    flooder.socket.send(data)
    first = session.wait_entries(EStop)[0]
    assert first.connection == flooder.epoch
    for _ in range(40_000):
        try:
            flooder.socket.send(data, zmq.DONTWAIT)
        except zmq.Again:
            session.once()
    ann.send(EStop("really"))
    session.wait_entries(EStop, connection=ann.epoch)
    assert session.wait_drops("estops_merged", 1001) > 1000
    session.wait_entries(Lost, connection=flooder.epoch)
    assert session.wait_drops("flood_cut") > 0
    stops = [e for e in session.wait_entries(EStop) if e.connection == flooder.epoch]
    assert len(stops) <= 5 + 2 * (time.monotonic() - began)
    assert any(getattr(e.message, "detail", "") == "estop" for e in session.entries)


# --- media ingest ---


def test_a_key_without_the_role_is_refused_before_it_sends_anything(lab: Lab) -> None:
    pair, _ = lab.allowed("eve", "observer")
    camera, _ = lab.allowed("camera", "camera", "observer")
    heard = {}
    for name, key in (("eve", pair), ("camera", camera)):
        push = open_push(lab, key)
        wanted = zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_HANDSHAKE_FAILED_AUTH
        monitor = push.get_monitor_socket(wanted)
        push.connect(ingest_address(lab.session))
        lab.session.pump(lambda m=monitor: bool(m.poll(0)), "the end of the handshake")  # type: ignore[misc]
        heard[name] = int.from_bytes(monitor.recv_multipart()[0][:2], "little")
        push.disable_monitor()
        monitor.close(linger=0)
        push.close()
    assert heard == {"eve": zmq.EVENT_HANDSHAKE_FAILED_AUTH, "camera": zmq.EVENT_HANDSHAKE_SUCCEEDED}
    assert lab.session.wait_drops("media_source_refused") > 0
    audits = lambda: [e.message for e in lab.session.entries if getattr(e.message, "detail", "") == "media ingest"]  # noqa: E731
    lab.session.pump(lambda: bool(audits()), "its name")
    assert audits()[0].kind == AuditKind.KEY_REFUSED  # type: ignore[union-attr]


def test_the_sum_of_unfinished_messages_is_bounded(open_session: OpenSession) -> None:
    session = open_session()
    front = psutil.Process(session.process.pid)
    base = front.memory_info().rss
    sources = [Unfinished(session) for _ in range(6)]
    peak = 0

    def some_closed() -> bool:
        nonlocal peak
        alive = [one.send(50 * MIB) for one in sources]
        peak = max(peak, front.memory_info().rss - base)
        return not all(alive)

    session.pump(some_closed, "the end of a source")
    assert session.wait_drops("media_flood") > 0
    assert peak < 192 * MIB
    for one in sources:
        one.socket.close()


@pytest.mark.long
def test_a_source_that_floods_waits_before_it_may_connect_again_and_others_do_not(lab: Lab) -> None:
    """Behind one address, as of a gateway or NAT: the honest camera hands in all the time."""
    keys = {name: lab.allowed(name, "camera", "observer")[0] for name in ("honest", "mallory")}
    honest = open_push(lab, keys["honest"])
    honest.setsockopt(zmq.IMMEDIATE, 1)  # a send fails while it is not connected
    monitor = honest.get_monitor_socket(zmq.EVENT_DISCONNECTED)
    honest.connect(ingest_address(lab.session))

    def hand_in() -> bool:
        try:
            honest.send_multipart(encode_media_frames("depth", b"x", 0, 1, "bytes"), zmq.DONTWAIT)
        except zmq.Again:
            return False
        return True

    lab.session.pump(hand_in, "the camera is connected")
    began = time.monotonic()
    lab.session.pump(lambda: hand_in() and time.monotonic() > began + 1.5, "connected long before the flood")
    push = open_push(lab, keys["mallory"])
    push.setsockopt(zmq.RECONNECT_IVL, 20)
    push.setsockopt(zmq.SNDTIMEO, 20_000)
    push.connect(ingest_address(lab.session))
    push.send_multipart([bytes(MIB)] * 200, copy=False)  # never whole: it is cut after 64 MiB
    lab.session.pump(
        lambda: bool(hand_in() and "media_backoff" in lab.session.process.link.status.drops), "a refused handshake"
    )
    (flood,) = lab.audits(AuditKind.FLOOD)
    assert flood.detail == "media ingest, mallory"
    assert not monitor.poll(0), "the honest camera was disconnected"
    assert lab.session.wait_drops("media_flood") == 1
    push.send_multipart([bytes(MIB)] * 200, copy=False)
    lab.session.pump(
        lambda: bool(hand_in() and lab.session.process.link.status.drops["media_flood"] > 1), "mallory is let in again"
    )
    honest.disable_monitor()
    monitor.close(linger=0)
    honest.close()
    push.close()


def test_strangers_that_flood_media_ingest_have_no_key_refused(lab: Lab) -> None:
    """A camera that connects meanwhile, from the same address, is not taken for the flooder."""
    camera = lab.allowed("camera", "camera", "observer")[0]
    strangers = [Unfinished(lab.session, curve_greeting()) for _ in range(12)]
    push = open_push(lab, camera)
    push.connect(ingest_address(lab.session))
    push.send_multipart(encode_media_frames("depth", b"x", 0, 1, "bytes"))
    lab.session.pump(
        lambda: [one.send(6 * MIB) for one in strangers].count(False) > 0, "one is cut: 64 MiB for one address"
    )
    lab.session.pump(lambda: lab.audits(AuditKind.FLOOD), "it is reported")
    assert [flood.detail for flood in lab.audits(AuditKind.FLOOD)] == ["media ingest"]
    push.close()
    again = open_push(lab, camera)
    again.setsockopt(zmq.IMMEDIATE, 1)
    again.setsockopt(zmq.SNDTIMEO, 20_000)
    again.connect(ingest_address(lab.session))
    again.send_multipart(encode_media_frames("depth", b"x", 0, 1, "bytes"))
    again.close()
    for stranger in strangers:
        stranger.socket.close()
    assert "media_backoff" not in lab.session.process.link.status.drops


def test_decrypting_media_runs_after_other_work(session: FrontSession) -> None:
    tasks = Path(f"/proc/{session.process.pid}/task").iterdir()
    names = {(task / "comm").read_text().strip(): int(task.name) for task in tasks}
    loop, media = (os.getpriority(os.PRIO_PROCESS, one) for one in (session.process.pid, names["ZMQbg/IO/1"]))
    assert media == min(19, loop + LOW_PRIORITY_NICE)


def test_memory_is_taken_from_the_largest_connection_of_any_socket(open_session: OpenSession) -> None:
    """An honest client on a slow link has some messages pending; a source holds most of the memory."""
    limits = FrontLimits(send_queue=100_000, slow_drops=10**9, memory_bytes=24 * MIB)
    session = open_session(limits=limits, bodies=2000)
    slow = session.client()
    slow.join(name="Slow")
    session.clients.remove(slow)  # it reads no more
    slow.socket.rcvhwm = 1
    for _ in range(25):
        session.once(Decision((), outgoing=(OutgoingMessage(1, session.snapshot(1)),)))
    source = Unfinished(session)
    session.pump(lambda: not source.send(50 * MIB), "the end of the source")
    source.socket.close()
    assert session.wait_drops("memory") == 1
    assert not [e for e in session.entries if isinstance(e.message, Lost)]
    slow.close()


# --- subscriptions ---


@pytest.fixture
def xsubs(session: FrontSession) -> Iterator[list[zmq.Socket[bytes]]]:
    sockets: list[zmq.Socket[bytes]] = []
    for _ in range(40):
        sub = session.context.socket(zmq.XSUB)
        sub.linger = 0
        sub.sndhwm = 1000
        sub.connect(f"tcp://{session.host}:{session.ports.state}")
        sockets.append(sub)
    yield sockets
    for sub in sockets:
        sub.close()


def test_a_message_larger_than_a_subscription_ends_its_connection_before_the_front_sees_it(
    session: FrontSession, xsubs: list[zmq.Socket[bytes]]
) -> None:
    xsubs[0].send(b"\x01" + bytes(200))
    assert session.wait_drops("state_closed_early") > 0
    assert "state_topic_unknown" not in session.process.link.status.drops  # type: ignore[union-attr]


def test_topics_that_do_not_exist_do_not_grow_the_front(session: FrontSession, xsubs: list[zmq.Socket[bytes]]) -> None:
    front = psutil.Process(session.process.pid)
    session.pump(lambda: session.process.link.status is not None, "a start")
    base, rng = front.memory_info().rss, random.Random(1)
    for _ in range(500):
        for sub in xsubs:
            with contextlib.suppress(zmq.Again):
                sub.send(b"\x01" + rng.randbytes(80), zmq.DONTWAIT)
        session.once()
    session.pump(lambda: session.process.link.status.drops.get("flood_cut", 0) > 0, "the end of one")
    assert session.wait_drops("state_topic_unknown") > 0
    for sub in xsubs:
        sub.close()
    session.pump(lambda: front.memory_info().rss - base < 24 * MIB, "the memory is given back")


def test_a_key_that_was_cut_off_for_its_topics_is_refused_for_a_moment(lab: Lab) -> None:
    pair, _ = lab.allowed("hog", "observer")
    sub = lab.session.subscriber(curve=lab.curve(pair))
    for i in range(40):
        sub.subscribe(b"topic %d" % i)
    assert lab.session.wait_drops("flood_cut") > 0
    assert lab.session.wait_drops("key_banned") > 0, "the socket connects again by itself"
