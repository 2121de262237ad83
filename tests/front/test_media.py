"""The media proxy with real sockets: subscriptions, permission to hand in frames, faults; and sources of frames."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from iris_session.front.media import proxy as media_module
from iris_session.front.media.proxy import MediaProxy
from iris_session.front.media.scheduler import MediaSubscriber
from iris_session.link.media_source import MediaSource
from iris_session.link.sockets import IO_THREADS, readable, watch_tcp
from iris_session.link.tcp_guard import TcpBounds, TcpGuard, make_reasons
from iris_session.protocol.codec import encode_media_frames
from iris_session.protocol.limits import MAX_MEDIA_FRAME_BYTES
from iris_session.protocol.media import make_topic
from tests.front.harness import _UserFrame

SECOND = 1_000_000_000


class Rig:
    """A proxy in this process, on plain loopback, whose time stands still: nothing ends by silence."""

    def __init__(self, folder: Path) -> None:
        self.endpoint = f"ipc://{folder}/media"
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context(IO_THREADS)
        self.out, local, remote = (self.context.socket(kind) for kind in (zmq.XPUB, zmq.PULL, zmq.PULL))
        self.out.setsockopt(zmq.XPUB_MANUAL, 1)
        self.out_port = self.out.bind_to_random_port("tcp://127.0.0.1")
        local.bind(self.endpoint)
        self.port = remote.bind_to_random_port("tcp://127.0.0.1")
        guards = [
            TcpGuard(TcpBounds(unread_bytes=1 << 20), make_reasons("media"), watch_tcp(one, name))
            for one, name in ((self.out, "out"), (remote, "in"))
        ]
        self.proxy = MediaProxy(self.out, *guards, local, remote, lambda: SECOND, encrypted=False)
        self.proxy.scheduler.set_subscribers({1: MediaSubscriber("", {})}, 0)
        self.opened: list[Any] = []

    def open(self, kind: int, port: int) -> zmq.Socket[bytes]:
        socket = self.context.socket(kind)
        socket.linger = 0
        socket.connect(f"tcp://127.0.0.1:{port}")
        self.opened.append(socket)
        return socket

    def source(self) -> zmq.Socket[bytes]:
        return self.open(zmq.PUSH, self.port)

    def local_source(self) -> MediaSource:
        self.opened.append(MediaSource(self.endpoint))
        return self.opened[-1]  # type: ignore[no-any-return]

    def until(self, condition: Callable[[], object], what: str) -> None:
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

    def count_drops(self, reason: str = "media_stream_taken") -> int:
        with self.proxy.lock:
            return self.proxy.scheduler.drops.get(reason, 0)

    def close(self) -> None:
        for one in self.opened:
            one.close()
        self.proxy.close()
        self.context.destroy(linger=0)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    yield rig
    rig.close()


def test_a_message_that_is_no_subscription_takes_no_ones_frames(rig: Rig) -> None:
    """libzmq would give the subscriptions that wait behind it to the connections of the next ones."""
    viewer, bad, other = (rig.open(zmq.XSUB, rig.out_port) for _ in range(3))

    def receive(*messages: tuple[zmq.Socket[bytes], bytes]) -> None:
        """Send messages one after the other, and have the proxy read them together."""
        for socket, message in messages:
            socket.send(message)
            time.sleep(0.02)
        rig.until(lambda: readable(rig.out), "the messages")
        rig.proxy._receive_subscriptions()

    for one in (viewer, bad, other):
        receive((one, b"\1" + make_topic(1, "cloud")))
    second, third = make_topic(1, "second"), make_topic(1, "third")
    receive((bad, b"no subscription"), (viewer, b"\1" + second), (other, b"\1" + third))
    assert rig.count_drops("media_flood") == 1
    assert rig.count_drops("media_order_lost") == 2, "they subscribe again when they have connected again"
    assert rig.proxy.scheduler.list_subscriptions(1) == ["cloud"], "what came behind it is not applied"


def test_frames_of_a_key_count_while_it_is_a_source(rig: Rig) -> None:
    rig.proxy._encrypted = True
    rig.proxy.is_source = lambda key: key == "camera"

    def push(key: str) -> None:
        head, *parts = encode_media_frames("depth", key.encode(), 0, 1, "bytes")
        frames: list[Any] = [_UserFrame(head, -1, more=True), *parts]
        frames[0].user = key
        rig.proxy._handle_remote_frames(frames, [10, 10])

    push("camera")
    push("bob")
    assert rig.newest() == b"camera"
    rig.proxy.is_source = lambda _key: False  # it was revoked
    push("camera")
    assert rig.count_drops("media_source_refused") == 2


def test_stream_has_one_source_and_the_next_one_at_once_when_that_has_ended(rig: Rig) -> None:
    rig.proxy.start()
    first, second, local = rig.source(), rig.source(), rig.local_source()
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


def test_fault_of_the_thread_loses_pending_work_and_is_logged_once(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(media_module, "FAULT_S", 0.001)
    faults, send = iter([True] * 3), rig.proxy._send
    monkeypatch.setattr(rig.proxy, "_send", lambda *frame: 1 // 0 if next(faults, False) else send(*frame))
    rig.proxy.start()
    source, viewer = rig.local_source(), rig.open(zmq.SUB, rig.out_port)
    viewer.subscribe(make_topic(1, "cloud"))

    def is_sent() -> bool:
        source.publish("cloud", b"points", 0, 1, "bytes")
        return bool(viewer.poll(5))

    rig.until(is_sent, "media go on")
    assert rig.count_drops("media_fault") == 3
    assert caplog.text.count("thread of media, which continues: ZeroDivisionError") == 1


# --- sources of this machine -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("stream", "frames"), [("a b", b"x"), ("a", {"half": b"x"}), ("a", bytes(8_388_609))])
def test_invalid_media_are_an_error_of_the_publisher(tmp_path: Path, stream: str, frames: object) -> None:
    source = MediaSource(f"ipc://{tmp_path}/front")
    with pytest.raises(ValueError, match=r"name|'full'|8388608"):
        source.publish(stream, frames, 0, 0, "bytes")  # type: ignore[arg-type]
    source.close()


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
