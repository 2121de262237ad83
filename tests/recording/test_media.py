"""Point clouds and pictures in the file: read back exactly, refused if they do not decode."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
import zmq

from iris_session.journal.rows import SessionHeader
from iris_session.protocol.codec import encode_media_header
from iris_session.protocol.media import MediaHeader, StreamCamera, StreamInfo
from iris_session.recording import RecordedImage, RecordedStream, Recording
from iris_session.recording import process as process_module
from iris_session.recording.writer import RrdWriter
from iris_session.streams.cloud import decode_cloud, encode_cloud
from tests.recording.support import loop_recorder, read

#: Start of image, and a start of frame of 2 x 3 pixels.
JPEG = b"\xff\xd8\xff\xc0\x00\x11\x08\x00\x02\x00\x03 and the rest"


def make_frame(n: int, seed: int = 0, **stated: float) -> bytes:
    random = np.random.default_rng(seed)
    return encode_cloud(random.uniform(-2.0, 2.0, (n, 3)), random.integers(0, 256, (n, 3), np.uint8), **stated)["full"]


def message(
    stream: str,
    frame: bytes | None = None,
    seq: int = 1,
    capture_ns: int = 100,
    encoding: str = "cloud",
    info: StreamInfo | None = None,
) -> list[bytes]:
    """Return a message of the front: a frame, a description, or both; with neither the stream has ended."""
    kind = "none" if frame is None else "full"
    header = MediaHeader(stream, kind, 1, seq, capture_ns, 700, encoding, received_ns=max(500, capture_ns))
    return [encode_media_header(header), frame or b"", b"" if info is None else msgspec.json.encode(info)]


@pytest.fixture
def writer(tmp_path: Path) -> RrdWriter:
    writer = RrdWriter(tmp_path / "session.rrd", "id")
    writer.write_header(SessionHeader("s", "n", "closed", 2_000_000))
    return writer


def test_clouds_are_read_back_exactly(writer: RrdWriter) -> None:
    frames = [make_frame(n, n, voxel_m=0.02, error_m=0.01) for n in (1000, 0, 10)]
    for seq, frame in enumerate(frames):
        writer.add_media(message("room-1.a", frame, seq, 100 + seq))
    writer.add_media(message("other", make_frame(3)))
    writer.close()
    assert writer.drawing.media_refused == 0
    with Recording.open(writer.path) as recording:
        found = list(recording.clouds("room-1.a"))
        assert [(one.seq, one.capture_ns, one.received_ns) for one in found] == [
            (0, 100, 500),
            (1, 101, 500),
            (2, 102, 500),
        ]
        for one, frame in zip(found, frames, strict=True):
            sent = decode_cloud(frame)
            assert one.positions.dtype == np.float32
            assert np.array_equal(one.positions, sent.positions)
            assert np.array_equal(one.colors, sent.colors)
            assert (one.error_m, one.voxel_m) == (sent.error_m, sent.voxel_m)
        (other,) = recording.clouds("other")
        assert (other.error_m, other.voxel_m) == (np.inf, 0.0)
        assert [one.stream for one in recording.clouds()].count("room-1.a") == 3
        assert list(recording.clouds("room")) == []


def test_pictures_are_read_back_exactly(writer: RrdWriter) -> None:
    for seq in (1, 2):
        writer.add_media(message("room-front", JPEG + bytes([seq]), seq, 10 * seq, "jpeg"))
    writer.close()
    with Recording.open(writer.path) as recording:
        assert list(recording.pictures("room-front")) == [
            RecordedImage("room-front", 1, 10, 500, JPEG + b"\x01"),
            RecordedImage("room-front", 2, 20, 500, JPEG + b"\x02"),
        ]


def test_frames_that_do_not_decode_are_counted(writer: RrdWriter) -> None:
    good = make_frame(10)
    refused = [
        message("room", good[:-1]),
        message("room", b""),
        message("room", good, encoding="bytes"),
        message("room", b"GIF89a", encoding="jpeg"),
        message("room", JPEG[:8], encoding="jpeg"),
        message("room", JPEG[:2] + b"\xff" * 70_000 + JPEG[2:], encoding="jpeg"),
        message("room", JPEG.replace(b"\x00\x02", b"\xff\xff"), encoding="jpeg"),
        message("room", JPEG.replace(b"\x00\x02", b"\x00\x00"), encoding="jpeg"),
        message("../room", good),
        [b"\xc1", good, b""],
        [good],
        message("room", good)[:2],
        [*message("room", good)[:2], b'{"hz": "fast"}'],
        message("room", encoding="bytes"),
    ]
    for bad in refused:
        writer.add_media(bad)
    writer.add_media(message("room", good))
    writer.close()
    assert writer.drawing.media_refused == len(refused)
    with Recording.open(writer.path) as recording:
        assert len(list(recording.clouds())) == 1
        assert list(recording.pictures()) == []


def test_streams_say_what_they_are_until_they_end(writer: RrdWriter) -> None:
    camera = StreamCamera(640, 480, 585.0, 585.0, 319.5, 239.5, (0.1, -0.2, 0.0, 0.0), "hand", (0.1, 0.2, 0.3))
    room = StreamInfo("The room", "remote", camera, 30.0)
    blind = msgspec.structs.replace(room, fault="no_depth", detail="no pixel has a depth: is the projector on?")
    writer.add_media(message("room", make_frame(5), 1, 100, info=room))
    writer.add_media(message("room", make_frame(6), 2, 200))
    writer.add_media(message("room-front", JPEG, 1, 150, "jpeg", StreamInfo()))
    writer.add_media(message("room", None, 2, 300, info=blind))
    writer.flush()
    writer.add_media(message("room", None, 2, 400))
    writer.add_media(message("room-front", None, 2, 500, "jpeg"))
    writer.close()
    assert writer.drawing.media_refused == 0
    with Recording.open(writer.path) as recording:
        assert list(recording.streams("room")) == [
            RecordedStream("room", 100, "cloud", room),
            RecordedStream("room", 300, "cloud", blind),
            RecordedStream("room", 400, "cloud", None),
        ]
        assert [(one.stream, one.info) for one in recording.streams()].count(("room-front", StreamInfo())) == 1
        assert [one.seq for one in recording.clouds()] == [1, 2]
        assert [one.seq for one in recording.pictures()] == [1]
        assert recording.damage == []
    for entity, at_ns in (("/clouds/room", 400), ("/pictures/room-front", 500)):
        cleared = [one for one in read(Path(writer.path))[entity] if "Clear:is_recursive" in one.schema.names]
        (batch,) = cleared
        assert [value.value for value in batch.column("session_time")] == [at_ns], "what the viewer shows ends there"


def test_the_recorder_reads_media_only_while_nothing_more_important_waits(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/m"
    with (
        loop_recorder(media_endpoint=endpoint) as one,
        zmq.Context() as context,
        context.socket(zmq.PUSH) as front,
    ):
        loop = one.loop
        assert loop._media is not None
        front.connect(endpoint)
        front.send_multipart(message("room", make_frame(5)))
        assert loop._media.poll(20_000)
        loop._write_s = 2 * process_module.SLOW_WRITE_S
        loop._drain()
        assert loop._writer._media == []
        loop._write_s = 0.0
        loop._drain()
        assert len(loop._writer._media) == 1
