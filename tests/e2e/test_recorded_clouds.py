"""Clouds and pictures of a source in the recording of a session, also after its recorder was killed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from iris_session import Client, decode_cloud, encode_cloud
from iris_session.recording import NotARecordingError, Recording
from tests.e2e.session_process import DEADLINE_S, SessionProcess, wait_until

pytestmark = pytest.mark.e2e


@pytest.mark.long
def test_clouds_and_pictures_of_a_source_are_recorded(serve: Callable[..., SessionProcess]) -> None:
    """At rest, so each once in a part: a new recorder gets them again."""
    server = serve("handover", "--record-clouds", "10Hz")
    positions = np.random.default_rng(0).uniform(-1.0, 1.0, (5000, 3))
    frames = encode_cloud(positions, np.full((5000, 3), 200, np.uint8), voxel_m=0.02, error_m=0.01)
    picture = b"\xff\xd8\xff\xc0\x00\x11\x08\x00\x02\x00\x03 of 3 x 2 pixels"
    with Client(server.address, role="source", name="camera").connect(DEADLINE_S) as source:
        source.start()  # else it would be silent while the file is waited for
        publish(source, "room", frames, 1_000_000_007, "cloud")
        publish(source, "room-front", picture, 1_000_000_009, "jpeg")
        wait_until(lambda: holds_both(server.recording), "both are in the file")
        recorder = server.children()["recording.process"]
        recorder.kill()
        part2 = server.recording.with_name("session.part2.rrd")
        wait_until(lambda: holds_both(part2), "both are in the next part")
        assert source.status(DEADLINE_S).drops.get("recorded_media", 0) == 0
    report = server.finish()
    assert (report["parts"], report["ok"]) == (2, True)
    with Recording.open(server.recording) as recording:
        (cloud,) = recording.clouds("room")
        (image,) = recording.pictures("room-front")
    sent = decode_cloud(frames["full"])
    assert np.array_equal(cloud.positions, sent.positions)
    assert np.array_equal(cloud.colors, sent.colors)
    assert (cloud.capture_ns, image.capture_ns, image.jpeg) == (1_000_000_007, 1_000_000_009, picture)
    assert cloud.received_ns > 0


@pytest.mark.long
def test_no_clouds_are_recorded_with_off(serve: Callable[..., SessionProcess]) -> None:
    server = serve("handover", "--record-clouds", "off")
    frame = encode_cloud(np.zeros((10, 3)), np.zeros((10, 3), np.uint8))["full"]
    with Client(server.address, role="source", name="camera").connect(DEADLINE_S) as source:
        publish(source, "room", frame, 5, "cloud")
        wait_until(
            lambda: [one.stream for one in source.status(DEADLINE_S).media] == ["room"], "the session has the cloud"
        )
    server.finish()
    with Recording.open(server.recording) as recording:
        assert list(recording.clouds()) == []


def publish(source: Client, stream: str, frames: bytes | dict[str, bytes], capture_ns: int, encoding: str) -> None:
    """Publish one frame, once."""
    wait_until(
        lambda: source.media.publish(stream, frames, capture_ns=capture_ns, encoding=encoding), f"{stream} is published"
    )


def holds_both(path: Path) -> bool:
    try:
        with Recording.open(path, warn=False) as recording:
            return any(recording.clouds()) and any(recording.pictures())
    except NotARecordingError:
        return False
