"""The media proxy of a real front process: delivery of frames, and permission to hand them in."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zmq

from iris_session.front.media import proxy as media_module
from iris_session.front.media.proxy import MediaProxy
from iris_session.front.media.scheduler import MediaSubscriber
from iris_session.link.media_source import MediaSource
from iris_session.link.sockets import IO_THREADS, watch_tcp
from iris_session.link.tcp_guard import TcpBounds, TcpGuard, make_reasons
from iris_session.protocol.client_messages import Heartbeat
from iris_session.protocol.codec import decode_media_header, encode_media_frames
from iris_session.protocol.limits import MAX_MEDIA_FRAME_BYTES
from iris_session.protocol.media import MediaHeader, make_topic
from iris_session.protocol.status import DeliveryBudget
from iris_session.security import KeyPair
from tests.front.lab import Lab
from tests.front.process_harness import ProcessClient, ProcessSession

Curve = tuple[bytes, bytes, bytes]
SECOND = 1_000_000_000


class Viewer:
    """A SUB socket on the media port, and the frames it received."""

    def __init__(
        self, session: ProcessSession, topics: list[bytes], curve: Curve | None = None, hwm: int = 1000
    ) -> None:
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

    def __init__(self, session: ProcessSession) -> None:
        self.session = session
        self.viewers: list[Viewer] = []
        self.size = 500
        self.publishing = True
        self.period_s = 0.0  # at least, between two frames
        self._published_s = 0.0
        self._here: list[ProcessClient] = []
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

    def joined(self, client: ProcessClient, name: str = "ann") -> ProcessClient:
        if client.welcome is None:
            client.join("observer", name)
        self._here.append(client)
        client.wait_for(DeliveryBudget)
        return client

    def viewer(
        self, client: ProcessClient, curve: Curve | None = None, stream: str = "cloud", epoch: int = 0, hwm: int = 1000
    ) -> Viewer:
        self.viewers.append(Viewer(self.session, [make_topic(epoch or client.epoch, stream)], curve, hwm))
        return self.viewers[-1]

    def drops(self, reason: str, n: int = 1) -> None:
        self.session.pump(lambda: self.session.process.link.status.drops.get(reason, 0) >= n, reason)

    def close(self) -> None:
        for viewer in self.viewers:
            viewer.socket.close()


@pytest.fixture
def media(process_session: ProcessSession) -> Iterator[Stage]:
    stage = Stage(process_session)
    yield stage
    stage.close()


@pytest.fixture
def locked(process_lab: Lab) -> Iterator[tuple[Lab, Stage]]:
    stage = Stage(process_lab.session)
    yield process_lab, stage
    stage.close()


def budgets(client: ProcessClient) -> dict[str, str]:
    return {one.stream: one.budget_class for one in client.got(DeliveryBudget)[-1].streams}


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


@pytest.mark.parametrize(("stream", "frames"), [("a b", b"x"), ("a", {"half": b"x"}), ("a", bytes(8_388_609))])
def test_invalid_media_are_an_error_of_the_publisher(tmp_path: Path, stream: str, frames: object) -> None:
    source = MediaSource(f"ipc://{tmp_path}/front")
    with pytest.raises(ValueError, match=r"name|'full'|8388608"):
        source.publish(stream, frames, 0, 0, "bytes")  # type: ignore[arg-type]
    source.close()


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
