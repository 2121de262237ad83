"""What of the media goes to the recorder: the newest frames at a rate, within bounds, and again to a new recorder."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
import zmq

from iris_session.front.media import recorder as recorder_module
from iris_session.front.media.recorder import BURST_BYTES, BYTES_PER_S, MediaRecorder
from iris_session.front.media.scheduler import MediaScheduler
from iris_session.link.sockets import IO_THREADS
from iris_session.protocol.codec import decode_media_header
from iris_session.protocol.limits import MAX_MEDIA_FRAME_BYTES
from iris_session.protocol.media import MediaHeader, MediaPush, StreamInfo

SECOND = 1_000_000_000
PERIOD_NS = SECOND // 2


class Rig:
    """A scheduler, what sends from it at 2 Hz, and a socket in place of the recorder."""

    def __init__(self, folder: Path) -> None:
        self.endpoint = f"ipc://{folder}/media"
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context(IO_THREADS)
        self.scheduler = MediaScheduler()
        self.now_ns = 10 * SECOND
        self.got: list[tuple[MediaHeader, bytes]] = []
        self.infos: list[tuple[MediaHeader, StreamInfo | None]] = []  # of messages without a frame, or with an info
        self.socket = self.listen()
        self.media = MediaRecorder(self.context, self.endpoint, 2.0)
        self.wait(lambda: self.media._connected)

    def listen(self) -> zmq.Socket[bytes]:
        socket = self.context.socket(zmq.PULL)
        socket.setsockopt(zmq.RCVHWM, 1)
        socket.bind(self.endpoint)
        return socket

    def wait(self, condition: Callable[[], bool]) -> None:
        until = time.monotonic() + 20.0
        while not condition():
            assert time.monotonic() < until
            self.media.tick(self.scheduler, self.now_ns)
            time.sleep(0.002)

    def push(self, stream: str, frame: bytes = b"x", encoding: str = "cloud") -> None:
        push = MediaPush(stream, 3, self.now_ns - 7, ("full", "half"), encoding, sent_ns=self.now_ns - 5)
        assert self.scheduler.push(push, [frame, frame[:1]], "", self.now_ns)

    def tick(self, *, take: bool = True) -> None:
        """Pass a tick, and take what was sent."""
        before = self.list_sent()
        self.wait(lambda: bool(self.media._socket.getsockopt(zmq.EVENTS) & zmq.POLLOUT)) if take else None
        self.media.tick(self.scheduler, self.now_ns)
        sent = len(dict(self.list_sent().items() ^ before.items()))  # streams
        while take and self.socket.poll(20_000 if sent > 0 else 0):
            head, frame, info = self.socket.recv_multipart()
            header = decode_media_header(head)
            if header.budget_class == "full":
                self.got.append((header, frame))
            if info or header.budget_class == "none":
                self.infos.append((header, msgspec.json.decode(info, type=StreamInfo) if info else None))
            sent -= 1

    def list_sent(self) -> dict[str, tuple[int, StreamInfo | None]]:
        return {name: (stream.seq, stream.info) for name, stream in self.media._streams.items() if stream.seq >= 0}

    def drops(self) -> dict[str, int]:
        return self.scheduler.pop_drops()[0]

    def close(self) -> None:
        self.media.close()
        self.context.destroy(linger=0)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    yield rig
    rig.close()


def test_newest_frame_goes_at_the_rate(rig: Rig) -> None:
    for i in range(41):  # two seconds at 20 Hz
        rig.push("room", b"%d" % i)
        rig.tick()
        rig.now_ns += SECOND // 20
    assert [int(frame) for _, frame in rig.got] == [0, 10, 20, 30, 40]
    header = rig.got[1][0]
    assert (header.stream, header.budget_class, header.scene_epoch, header.encoding) == ("room", "full", 3, "cloud")
    pushed_ns = 10 * SECOND + SECOND // 2
    assert (header.capture_ns, header.sent_ns, header.received_ns) == (pushed_ns - 7, pushed_ns - 5, pushed_ns)
    assert header.published_ns == pushed_ns
    assert [one.seq - rig.got[0][0].seq for one, _ in rig.got] == [0, 10, 20, 30, 40]
    assert rig.drops() == {}


def test_descriptions_go_when_they_change_and_the_end_of_a_stream(rig: Rig) -> None:
    def describe(info: StreamInfo) -> None:
        push = MediaPush("room", 3, 0, (), "cloud", info)
        assert rig.scheduler.push(push, [], "", rig.now_ns)

    room = StreamInfo("Room", hz=30.0)
    slow = msgspec.structs.replace(room, fault="slow", detail="3 frames per second come")
    describe(room)
    rig.push("room")
    rig.tick()
    assert [one for _, one in rig.infos] == [room]
    for info in (room, slow, msgspec.structs.replace(slow, detail="4 frames per second come"), room):
        describe(msgspec.structs.replace(info))
        rig.push("room") if info is room else None
        rig.now_ns += PERIOD_NS
        rig.tick()
    assert [one for _, one in rig.infos] == [room, slow, room]
    changed = rig.infos[1][0]
    assert (changed.budget_class, changed.capture_ns) == ("none", 10 * SECOND + 2 * PERIOD_NS)
    assert len(rig.got) == 3
    rig.scheduler.release_frames(rig.now_ns)  # for want of memory: the stream is still there
    rig.tick()
    rig.scheduler.stop_sources([""])
    for _ in range(3):
        rig.now_ns += PERIOD_NS
        rig.tick()
    assert [(header.stream, header.encoding, one) for header, one in rig.infos[3:]] == [("room", "cloud", None)]
    rig.push("room", b"again")
    rig.tick()
    assert rig.infos[4:] == [(rig.got[-1][0], StreamInfo())]
    assert rig.drops() == {}


def test_bytes_are_bounded_and_every_stream_has_its_turn(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    """A large stream does not starve for small ones, nor they for it; what is missing is counted, and logged once."""
    seconds, sizes = 60, {"large": MAX_MEDIA_FRAME_BYTES, "small": 1000, "middle": 1_000_000}
    with caplog.at_level(logging.WARNING, recorder_module.__name__):
        for _ in range(10 * seconds):
            for stream, size in sizes.items():
                rig.push(stream, bytes(size))
            for _ in sizes:
                rig.tick()
            rig.now_ns += SECOND // 10
    in_file = 2 * sum(len(frame) for _, frame in rig.got)
    assert 0.8 * seconds * BYTES_PER_S <= in_file <= seconds * BYTES_PER_S + BURST_BYTES
    counts = {stream: sum(header.stream == stream for header, _ in rig.got) for stream in sizes}
    assert min(counts.values()) >= 10, counts
    drops = rig.drops()
    assert list(drops) == [recorder_module.BYTES_SHARE]
    assert sum(counts.values()) + drops[recorder_module.BYTES_SHARE] == pytest.approx(3 * 2 * seconds, rel=0.1)
    assert len([record for record in caplog.records if "missing in the recording" in record.message]) == 1


def test_recorder_that_does_not_read_costs_frames_and_no_time(rig: Rig) -> None:
    for _ in range(20):
        rig.push("room", bytes(1_000_000))
        rig.tick(take=False)
        rig.now_ns += PERIOD_NS
    drops = rig.drops()
    assert list(drops) == [recorder_module.NOT_READ]
    assert 10 <= drops[recorder_module.NOT_READ] < 20
    newest = b"newest"
    rig.push("room", newest)
    rig.wait(lambda: newest in take_all(rig.socket))


def take_all(socket: zmq.Socket[bytes]) -> list[bytes]:
    found = []
    while socket.poll(0):
        found.append(socket.recv_multipart()[1])
    return found


def test_new_recorder_gets_the_newest_frames_again(rig: Rig) -> None:
    """Also those of streams at rest, and each once."""
    rig.push("room", b"at rest")
    rig.tick()
    assert len(rig.got) == 1
    rig.socket.close(linger=0)
    rig.wait(lambda: not rig.media._connected)
    rig.push("other", b"while there was none")
    rig.now_ns += 10 * PERIOD_NS
    rig.media.tick(rig.scheduler, rig.now_ns)
    rig.socket = rig.listen()
    found: list[bytes] = []

    def has_both() -> bool:
        found.extend(take_all(rig.socket))
        return len(found) >= 2

    rig.wait(has_both)
    for _ in range(5):
        rig.now_ns += PERIOD_NS
        rig.media.tick(rig.scheduler, rig.now_ns)
    rig.socket.poll(50)
    found += take_all(rig.socket)
    assert sorted(found) == [b"at rest", b"while there was none"]
