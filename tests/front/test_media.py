"""The media proxy of a real front process: delivery of frames, and permission to hand them in."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zmq

from iris_session.front.media import proxy as media_module
from iris_session.front.media.proxy import MediaProxy
from iris_session.front.media.scheduler import MediaSubscriber
from iris_session.link import FrontLimits
from iris_session.link.media_source import MediaSource
from iris_session.link.sockets import IO_THREADS, watch_tcp
from iris_session.link.tcp_guard import TcpBounds, TcpGuard, make_reasons
from iris_session.protocol.client_messages import Heartbeat
from iris_session.protocol.codec import decode_media_header, encode_media_frames
from iris_session.protocol.limits import MAX_MEDIA_FRAME_BYTES
from iris_session.protocol.media import MediaHeader, make_topic
from iris_session.protocol.names import BudgetClass
from iris_session.protocol.status import ClientReport, DeliveryBudget, GetStatus, ParticipantReport, StatusReport
from iris_session.security import KeyPair
from tests.front.harness import N_BODIES, FrontSession, RawClient
from tests.front.lab import Lab, Open

Curve = tuple[bytes, bytes, bytes]
SECOND = 1_000_000_000


class Viewer:
    """A SUB socket on the media port, and the frames it received."""

    def __init__(self, session: FrontSession, topics: list[bytes], curve: Curve | None = None, hwm: int = 1000) -> None:
        self.socket = session.context.socket(zmq.SUB)
        self.socket.linger = 0
        self.socket.rcvhwm = hwm
        if curve:
            self.socket.curve_serverkey, self.socket.curve_publickey, self.socket.curve_secretkey = curve
        self.socket.connect(f"tcp://{session.host}:{session.ports.media}")
        for topic in topics:
            self.socket.subscribe(topic)
        self.got: list[tuple[bytes, MediaHeader, bytes]] = []

    def take(self) -> int:
        while self.socket.poll(0):
            topic, head, data = self.socket.recv_multipart()
            self.got.append((topic, decode_media_header(head), data))
        return len(self.got)


class Stage:
    """A publisher of `cloud` at every step, and viewers, which are kept alive on slow machines, too."""

    def __init__(self, session: FrontSession) -> None:
        self.session = session
        self.viewers: list[Viewer] = []
        self.size = 500
        self.publishing = True
        self.period_s = 0.0  # at least, between two frames
        self._published_s = 0.0
        self._here: list[RawClient] = []
        self._beat_s = 0.0
        self._once, session.once = session.once, self._step  # type: ignore[method-assign,assignment]

    def _step(self, *arguments: object) -> None:
        self._once(*arguments)  # type: ignore[arg-type]
        if time.monotonic() > self._beat_s + 0.3:
            self._beat_s = time.monotonic()
            for client in self._here:
                client.send(Heartbeat(True))
        if self.publishing and time.monotonic() >= self._published_s + self.period_s:
            self._published_s = time.monotonic()
            now_ns = self.session.process.link.now_ns
            self.session.process.publish_media("cloud", b"c" * self.size, now_ns, 1, "bytes")

    def until(self, condition: Callable[[], object], what: str) -> None:
        self.session.pump(lambda: bool(condition()), what)

    def joined(self, client: RawClient, name: str = "ann") -> RawClient:
        if client.welcome is None:
            client.join("observer", name)
        self._here.append(client)
        client.wait_for(DeliveryBudget)
        return client

    def viewer(
        self, client: RawClient, curve: Curve | None = None, stream: str = "cloud", epoch: int = 0, hwm: int = 1000
    ) -> Viewer:
        self.viewers.append(Viewer(self.session, [make_topic(epoch or client.epoch, stream)], curve, hwm))
        return self.viewers[-1]

    def drops(self, reason: str, n: int = 1) -> None:
        self.session.pump(lambda: self.session.process.link.status.drops.get(reason, 0) >= n, reason)

    def close(self) -> None:
        for viewer in self.viewers:
            viewer.socket.close()


@pytest.fixture
def media(session: FrontSession) -> Iterator[Stage]:
    stage = Stage(session)
    yield stage
    stage.close()


@pytest.fixture
def locked(lab: Lab) -> Iterator[tuple[Lab, Stage]]:
    stage = Stage(lab.session)
    yield lab, stage
    stage.close()


def budgets(client: RawClient) -> dict[str, str]:
    return {one.stream: one.budget_class for one in client.got(DeliveryBudget)[-1].streams}


def test_subscriber_gets_the_newest_frames(media: Stage) -> None:
    session = media.session
    ann = media.joined(session.client())
    viewer = media.viewer(ann)
    media.until(lambda: viewer.take() >= 5, "media")
    topic, header, data = viewer.got[-1]
    assert topic == make_topic(ann.epoch, "cloud") + b"full"
    assert (header.stream, header.budget_class, header.scene_epoch, header.encoding) == ("cloud", "full", 1, "bytes")
    assert header.capture_ns <= header.published_ns <= session.process.link.now_ns
    assert data == b"c" * 500
    assert [b[1].seq for b in viewer.got] == sorted({b[1].seq for b in viewer.got})
    media.until(lambda: budgets(ann) == {"cloud": "full"}, "ann is told of the stream")


def test_status_lists_streams_of_each_client(media: Stage) -> None:
    session, media.period_s = media.session, 0.02  # frames that come faster than they are read lower the class
    ann = media.joined(session.client())
    viewer = media.viewer(ann)
    media.until(lambda: viewer.take() >= 5, "media")
    assert ann.welcome is not None
    row = ParticipantReport(ann.welcome.participant_id, "ann", "observer", True)
    session.process.link.send_report(StatusReport(0, "", "", 0, participants=(row,)))

    asked_s = 0.0

    def told() -> bool:
        nonlocal asked_s
        viewer.take()  # who does not read is sent less
        if time.monotonic() > asked_s + 0.3:
            asked_s = time.monotonic()
            ann.send(GetStatus())
        reports = ann.got(StatusReport)
        if not reports or not reports[-1].participants:  # the authority's half is on its way
            return False
        report, mine = reports[-1], reports[-1].participants[0]
        return bool(report.media and mine.media and mine.media_bytes_per_s) and (
            (report.media[0].stream, report.media[0].subscribers) == ("cloud", 1)
            and (mine.budget_class, mine.media[0].stream, mine.media[0].budget_class) == ("full", "cloud", "full")
            and report.media[0].hz > 0.0
        )

    media.until(told, "the stream and its subscriber")


def test_unknown_topics_are_counted(media: Stage) -> None:
    session = media.session
    ann = media.joined(session.client())
    bad = Viewer(session, [b"", b"media/", b"cloud", make_topic(ann.epoch + 7, "cloud")])
    media.viewers.append(bad)
    other = media.viewer(ann, stream="other")
    media.drops("media_topic_unknown", 3)
    media.drops("media_refused", 1)
    good = media.viewer(ann)
    media.until(lambda: good.take() >= 20, "media")
    assert (bad.take(), other.take()) == (0, 0)


def test_a_message_that_is_no_subscription_takes_no_ones_frames(media: Stage) -> None:
    """libzmq would give the subscriptions that wait behind it to the connections of the next ones."""
    session = media.session
    ann = media.joined(session.client())
    viewer = media.viewer(ann)
    bad, other = (session.context.socket(zmq.XSUB) for _ in range(2))
    for one in (bad, other):
        one.linger = 0
        one.connect(f"tcp://{session.host}:{session.ports.media}")
        one.send(b"\1" + make_topic(ann.epoch, "cloud"))
    media.until(lambda: viewer.take() >= 1 and bad.poll(0) and other.poll(0), "all are subscribed")
    os.kill(session.process.pid, signal.SIGSTOP)  # so that all three wait together
    try:
        bad.send(b"no subscription")
        viewer.socket.subscribe(make_topic(ann.epoch, "second"))
        other.send(b"\1" + make_topic(ann.epoch, "third"))
    finally:
        os.kill(session.process.pid, signal.SIGCONT)
    media.drops("media_flood")

    def has_second() -> bool:
        session.process.publish_media("second", b"second", session.process.link.now_ns, 1, "bytes")
        viewer.take()
        return any(header.stream == "second" for _, header, _ in viewer.got)

    media.until(has_second, "the viewer gets what it subscribed to")
    topics = set()
    while other.poll(0):
        topics.add(other.recv_multipart()[0])
    assert make_topic(ann.epoch, "second") + b"full" not in topics
    bad.close()
    other.close()


@pytest.mark.parametrize("port", ["media", "media_ingest"])
def test_only_silent_media_connections_are_closed(open_session: Open, port: str) -> None:
    session = open_session(limits=FrontLimits(hello_timeout_ns=1_500_000_000))
    media = Stage(session)
    ann = media.joined(session.client())
    viewer = media.viewer(ann)
    with socket.create_connection((session.host, getattr(session.ports, port))) as silent:
        media.drops("media_silent")
        silent.settimeout(30.0)
        while silent.recv(4096):
            pass
    seen = viewer.take()
    media.until(lambda: viewer.take() > seen + 100, "ann goes on")
    assert session.process.link.status.drops["media_silent"] == 1
    media.close()


def test_endless_message_is_cut_off(open_session: Open) -> None:
    """libzmq would collect it in memory; its own sockets cannot send one."""
    session = open_session(limits=FrontLimits(source_bytes=1 << 20))
    media = Stage(session)
    ann = media.joined(session.client())
    greeting = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
    ready = b"\x05READY\x0bSocket-Type\x00\x00\x00\x04PUSH"
    frame = b"\x03" + (100_000).to_bytes(8, "big") + bytes(100_000)  # and more of the same message
    with socket.create_connection((session.host, session.ports.media_ingest)) as source:
        source.settimeout(30.0)
        source.sendall(greeting + b"\x04" + bytes([len(ready)]) + ready)
        answer = b""
        while b"PULL" not in answer:
            answer += source.recv(4096)
        source.sendall(20 * frame)
        media.drops("media_flood")
    viewer = media.viewer(ann)
    media.until(lambda: viewer.take() > 20, "ann gets media")
    media.close()


def test_excess_media_subscribers_are_closed_and_the_first_stay(open_session: Open) -> None:
    session = open_session(limits=FrontLimits(subscribers=2))
    media = Stage(session)
    ann = media.joined(session.client())
    viewer = media.viewer(ann)
    media.until(lambda: viewer.take() >= 1, "media")
    for _ in range(4):
        media.viewer(ann)
    media.drops("media_too_many", 2)
    seen = viewer.take()
    media.until(lambda: viewer.take() > seen + 20, "ann goes on")
    media.close()


def test_stalled_viewer_delays_no_other_and_gets_less(media: Stage) -> None:
    session = media.session
    media.size = 100_000
    ann, bob = (media.joined(session.client(), name) for name in ("ann", "bob"))
    viewer, stuck = media.viewer(ann), media.viewer(bob, hwm=1)
    media.until(lambda: viewer.take() > 0, "media")
    media.until(lambda: viewer.take() >= 0 and budgets(bob).get("cloud") == BudgetClass.NONE, "bob gets none")
    told = bob.got(DeliveryBudget)[-1]
    assert (told.budget_class, told.reason) == (BudgetClass.NONE, "the link does not take all media")
    media.until(lambda: viewer.take() and budgets(ann) == {"cloud": BudgetClass.FULL}, "ann has all of it")
    media.drops("media_superseded")
    before = len(viewer.got)
    media.until(lambda: viewer.take() >= before + 20, "ann goes on")
    assert stuck.take() >= 1


def test_client_may_request_less_media(media: Stage) -> None:
    session = media.session
    media.size = 20_000
    ann = media.joined(session.client())
    viewer = media.viewer(ann)
    media.until(lambda: viewer.take() > 100, "media")

    def asks() -> bool:
        viewer.take()
        ann.send(ClientReport(1.0, 1.0, 60, media_limit_mbit_per_s=0.001))
        session.process.link.poll()
        return budgets(ann) == {"cloud": BudgetClass.NONE}

    media.until(asks, "none")
    assert ann.got(DeliveryBudget)[-1].reason


def test_client_without_state_gets_less_media(media: Stage) -> None:
    """A client that received nothing cannot report missed state; the front knows what it sent."""
    session = media.session
    ann = media.joined(session.client())
    viewer = media.viewer(ann)
    media.until(lambda: viewer.take() > 100, "media")
    poses = np.zeros((N_BODIES, 7))
    poses[:, 3] = 1.0

    rounds = 0

    def starves() -> bool:
        nonlocal rounds
        viewer.take()
        for _ in range(30):
            session.send_state(poses)
        rounds += 1
        ann.send(ClientReport(1.0, 1.0, 60) if rounds < 100 else ClientReport(0.0, 0.0, 0))
        time.sleep(0.01)
        return any("of state was missed" in told.reason for told in ann.got(DeliveryBudget))

    media.until(starves, "less, for want of state")


def test_restarted_front_accepts_media(media: Stage) -> None:
    session = media.session
    ann = media.joined(session.client())
    viewer = media.viewer(ann)
    media.until(lambda: viewer.take() >= 1, "media")
    old_seq = viewer.got[-1][1].seq
    session.process.restart()
    media.until(lambda: session.process.link.ports is not None, "a new front")
    assert session.process.link.ports is not None
    session.ports = session.process.link.ports
    bob = media.joined(session.client(), "bob")
    again = media.viewer(bob)
    media.until(lambda: again.take() >= 1, "media of the new front")
    assert again.got[0][1].seq > old_seq


def test_invalid_media_are_an_error_of_the_publisher(media: Stage) -> None:
    with pytest.raises(ValueError, match="name"):
        media.session.process.publish_media("a b", b"x", 0, 0, "bytes")
    with pytest.raises(ValueError, match="'full'"):
        media.session.process.publish_media("a", {"half": b"x"}, 0, 0, "bytes")
    with pytest.raises(ValueError, match="8388608"):
        media.session.process.publish_media("a", bytes(8_388_609), 0, 0, "bytes")


def test_publishing_media_after_the_end_raises(tmp_path: Path) -> None:
    source = MediaSource(f"ipc://{tmp_path}/front")
    assert source.publish("a", b"x", 0, 0, "bytes")
    source.close()
    source.close()
    assert not source.publish("a", b"x", 0, 0, "bytes")
    assert source.dropped == 1


# --- keys ------------------------------------------------------------------------------------------------------------


def test_only_the_key_of_a_connection_opens_its_media(locked: tuple[Lab, Stage]) -> None:
    lab, stage = locked
    ann, client = lab.allowed("ann")
    bob, other = lab.allowed("bob")
    stage.joined(client)
    stage.joined(other, "bob")
    eves = stage.viewer(client, lab.curve(KeyPair.generate()))
    bobs = stage.viewer(client, lab.curve(bob))
    stage.drops("unknown_key")
    stage.drops("media_refused")
    anns = stage.viewer(client, lab.curve(ann))
    stage.until(lambda: anns.take() >= 10, "media")
    bobs.socket.unsubscribe(make_topic(client.epoch, "cloud"))
    bobs.socket.subscribe(b"that was it")
    stage.drops("media_topic_unknown")
    bobs.socket.close()
    seen = anns.take()
    stage.until(lambda: anns.take() >= seen + 20, "what bob takes back is not ann's")
    assert eves.take() == 0
    assert bobs.got == []


def test_revoked_key_gets_no_media_and_others_do(locked: tuple[Lab, Stage]) -> None:
    lab, stage = locked
    ann, client = lab.allowed("ann")
    bob, other = lab.allowed("bob")
    stage.joined(client)
    stage.joined(other, "bob")
    anns, bobs = stage.viewer(client, lab.curve(ann)), stage.viewer(other, lab.curve(bob))
    stage.until(lambda: min(anns.take(), bobs.take()) >= 1, "media")
    lab.home.clients.revoke_key(ann.fingerprint)
    lab.audits("key_revoked")
    stage.until(lambda: bobs.take() >= 0 and _quiet(anns), "nothing more for ann")
    last, seen = len(anns.got), bobs.take()
    stage.until(lambda: bobs.take() >= seen + 20, "bob goes on")
    assert anns.take() == last
    again = stage.viewer(client, lab.curve(ann))
    stage.until(lambda: bobs.take() >= seen + 40, "bob goes on")
    assert again.take() == 0


def _quiet(viewer: Viewer) -> bool:
    """Return whether nothing is received for a while."""
    before = viewer.take()
    return not viewer.socket.poll(100) and viewer.take() == before


def test_only_sources_may_push_media(locked: tuple[Lab, Stage]) -> None:
    lab, stage = locked
    stage.publishing = False
    bob, viewing = lab.allowed("bob", "operator", "observer")
    stage.joined(viewing, "bob")
    viewer = stage.viewer(viewing, lab.curve(bob), "depth")
    camera = KeyPair.generate()
    lab.home.clients.allow_key("cam-1", camera.public, ("camera",))
    pushes = {pair.public: _pusher(lab, pair) for pair in (camera, bob)}

    def sends(pair: KeyPair, data: bytes, condition: Callable[[], bool], what: str) -> None:
        def once() -> bool:
            _send(pushes[pair.public], data)
            viewer.take()
            return condition()

        stage.until(once, what)

    def refused() -> int:
        return lab.session.process.link.status.drops.get("media_source_refused", 0)

    sends(camera, b"camera", lambda: len(viewer.got) > 0, "frames of the camera")
    before = refused()
    sends(bob, b"bob", lambda: refused() > before, "bob is refused")
    lab.home.clients.revoke_key(camera.fingerprint)
    before = refused()
    sends(camera, b"revoked", lambda: refused() > before + 20, "the camera is refused")
    seen = len(viewer.got)
    sends(camera, b"late", lambda: refused() > before + 60, "and stays so")
    assert len(viewer.got) == seen
    assert b"bob" not in {data for _, _, data in viewer.got}
    for pusher in pushes.values():
        pusher.close()


def _pusher(lab: Lab, pair: KeyPair) -> zmq.Socket[bytes]:
    pusher = lab.session.context.socket(zmq.PUSH)
    pusher.linger = 0
    pusher.curve_serverkey, pusher.curve_publickey, pusher.curve_secretkey = lab.curve(pair)
    pusher.connect(f"tcp://{lab.session.host}:{lab.session.ports.media_ingest}")
    return pusher


def _send(pusher: zmq.Socket[bytes], data: bytes) -> None:
    try:
        pusher.send_multipart(encode_media_frames("depth", data, 0, 1, "bytes"), zmq.DONTWAIT)
    except zmq.Again:
        return


def test_first_frame_of_an_undecided_source_is_not_refused(locked: tuple[Lab, Stage]) -> None:
    lab, stage = locked
    stage.publishing = False
    camera = KeyPair.generate()
    lab.home.clients.allow_key("cam-1", camera.public, ("camera",))
    pusher = _pusher(lab, camera)
    drops = lab.session.process.link.status.drops

    def known() -> bool:
        _send(pusher, b"camera")
        nonlocal drops
        drops = lab.session.process.link.status.drops
        return "media_source_undecided" in drops

    stage.until(known, "the first frames come before anybody has looked")
    viewing = lab.allowed("bob", "observer")[1]
    stage.joined(viewing, "bob")
    stage.until(lambda: _send(pusher, b"camera") or "depth" in budgets(viewing), "the camera is let in")
    assert "media_source_refused" not in lab.session.process.link.status.drops
    pusher.close()


def test_pending_media_are_bounded_in_bytes(tmp_path: Path) -> None:
    """No front reads. Large frames are not copied, and count until they were sent."""
    endpoint = f"ipc://{tmp_path}/media"
    source, frame = MediaSource(endpoint), bytes(MAX_MEDIA_FRAME_BYTES)
    largest = {"full": frame, "half": frame, "quarter": frame}
    taken = [source.publish(f"s{n}", largest, 0, 1, "bytes") for n in range(4)]
    assert taken == [True, False, False, False]
    assert source.publish("small", b"x", 0, 1, "bytes")
    assert source.dropped == 3
    with zmq.Context() as context, context.socket(zmq.PULL) as front:
        front.bind(endpoint)
        assert front.poll(30_000)
        assert [len(part) for part in front.recv_multipart()[1:]] == [MAX_MEDIA_FRAME_BYTES] * 3
        deadline = time.monotonic() + 30.0
        while source.waiting:
            assert time.monotonic() < deadline, "libzmq is done with it"
            time.sleep(0.001)
        assert source.publish("again", largest, 0, 1, "bytes")
        source.close()
    assert not source.publish("late", b"x", 0, 1, "bytes")


def test_published_frame_is_sent_as_it_was_when_published(tmp_path: Path) -> None:
    endpoint, picture = f"ipc://{tmp_path}/media", bytearray(b"a" * 200_000)
    source = MediaSource(endpoint)
    assert source.publish("cloud", picture, 0, 1, "bytes")  # type: ignore[arg-type]
    picture[:] = b"b" * len(picture)
    with zmq.Context() as context, context.socket(zmq.PULL) as front:
        front.bind(endpoint)
        assert front.poll(30_000)
        assert set(front.recv_multipart()[1]) == {ord("a")}
    source.close()


class InProcess:
    """A proxy in this process, on plain loopback, whose time stands still: nothing ends by silence."""

    def __init__(self, folder: Path) -> None:
        self.endpoint = f"ipc://{folder}/media"
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context(IO_THREADS)
        out, local, remote = (self.context.socket(kind) for kind in (zmq.XPUB, zmq.PULL, zmq.PULL))
        out.setsockopt(zmq.XPUB_MANUAL, 1)
        out.bind_to_random_port("tcp://127.0.0.1")
        local.bind(self.endpoint)
        self.port = remote.bind_to_random_port("tcp://127.0.0.1")
        guards = [
            TcpGuard(TcpBounds(unread_bytes=1 << 20), make_reasons("media"), watch_tcp(one, name))
            for one, name in ((out, "out"), (remote, "in"))
        ]
        self.proxy = MediaProxy(out, *guards, local, remote, lambda: SECOND, encrypted=False)
        self.proxy.start()

    def source(self) -> zmq.Socket[bytes]:
        source = self.context.socket(zmq.PUSH)
        source.linger = 0
        source.connect(f"tcp://127.0.0.1:{self.port}")
        return source

    def until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + 30.0
        while not condition():
            assert time.monotonic() < deadline, what
            time.sleep(0.002)

    def sends(self, source: zmq.Socket[bytes], data: bytes) -> bool:
        """Send a frame. Return whether it became the newest one of the stream."""
        drops = self.count_drops()
        source.send_multipart(encode_media_frames("depth", data, 0, 1, "bytes"))
        self.until(lambda: self.newest() == data or self.count_drops() > drops, "taken or refused")
        return self.newest() == data

    def newest(self) -> bytes:
        with self.proxy.lock:
            return b"".join(bytes(one.frame) for one in self.proxy.scheduler.list_newest(("bytes",)))

    def count_drops(self) -> int:
        with self.proxy.lock:
            return self.proxy.scheduler.drops.get("media_stream_taken", 0)

    def close(self) -> None:
        self.proxy.close()
        self.context.destroy(linger=0)


def test_stream_has_one_source_and_the_next_one_at_once_when_that_has_ended(tmp_path: Path) -> None:
    rig = InProcess(tmp_path)
    first, second, local = rig.source(), rig.source(), MediaSource(rig.endpoint)
    assert rig.sends(first, b"1")
    assert not rig.sends(second, b"2")
    assert rig.sends(first, b"3")
    local.publish("depth", b"4", 0, 1, "bytes")
    rig.until(lambda: rig.count_drops() == 2, "the session itself is another source")
    first.close()
    rig.until(lambda: rig.sends(second, b"5"), "the second source has it")
    assert rig.sends(second, b"6")
    third = rig.source()
    assert not rig.sends(third, b"7")
    for one in (second, third, local):
        one.close()
    rig.close()


def test_fault_of_the_thread_loses_pending_work_and_is_logged_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(media_module, "FAULT_S", 0.001)
    endpoint = f"ipc://{tmp_path}/media"
    with zmq.Context() as context:
        out, local, remote = (context.socket(kind) for kind in (zmq.XPUB, zmq.PULL, zmq.PULL))
        out.setsockopt(zmq.XPUB_MANUAL, 1)
        port = out.bind_to_random_port("tcp://127.0.0.1")
        local.bind(endpoint)
        remote.bind_to_random_port("tcp://127.0.0.1")
        guard = [
            TcpGuard(TcpBounds(unread_bytes=1 << 20), make_reasons("media"), watch_tcp(one, name))
            for one, name in ((out, "fault-out"), (remote, "fault-in"))
        ]
        proxy = MediaProxy(out, *guard, local, remote, time.monotonic_ns, encrypted=False)
        faults = iter([True] * 3)
        send = proxy._send
        monkeypatch.setattr(proxy, "_send", lambda *frame: 1 // 0 if next(faults, False) else send(*frame))
        with proxy.lock:
            proxy.scheduler.set_subscribers({1: MediaSubscriber("", {})}, 0)
        proxy.start()
        source = MediaSource(endpoint)
        with context.socket(zmq.SUB) as viewer:
            viewer.connect(f"tcp://127.0.0.1:{port}")
            viewer.subscribe(make_topic(1, "cloud"))
            deadline = time.monotonic() + 30.0
            while not viewer.poll(5):
                assert time.monotonic() < deadline, "media go on"
                source.publish("cloud", b"points", time.monotonic_ns(), 1, "bytes")
        with proxy.lock:
            counted = proxy.scheduler.pop_drops()[0]["media_fault"]
        source.close()
        proxy.close()
    assert caplog.text.count("thread of media, which continues: ZeroDivisionError") == 1
    assert "Traceback" in caplog.text
    assert counted == 3
