"""Point clouds of a client: decoded once, with counters, age and the times of their way."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from iris_session.client import Client, InvalidMessageError
from iris_session.client.media import CloudFeed, MediaFeed, MediaFrame
from iris_session.client.stream_meter import STAGES, StreamMeter
from iris_session.protocol.codec import decode_media_push
from iris_session.protocol.media import MediaHeader, StreamBudget, StreamInfo
from iris_session.protocol.status import DeliveryBudget
from iris_session.streams.cloud import encode_cloud
from tests.client.session import ClientSession

POINTS = np.arange(30, dtype=np.float32).reshape(10, 3) / 10
FRAME = encode_cloud(POINTS, np.full((10, 3), 255, np.uint8), voxel_m=0.02, error_m=0.01)["full"]


class Rig:
    """A feed whose frames come from the test."""

    def __init__(self) -> None:
        self.now_ns = 1_000
        self.feed = MediaFeed("room")
        self.cloud = CloudFeed(self.feed, lambda: self.now_ns)

    def receive(self, data: bytes = FRAME, encoding: str = "cloud") -> None:
        self.feed.received += 1
        header = MediaHeader("room", "full", 1, self.feed.received, 100, 400, encoding, 0, 200, 300)
        self.feed.newest = MediaFrame(header, data, 400)


def test_cloud_is_decoded_once_and_polled_once() -> None:
    rig = Rig()
    assert rig.cloud.poll() is None
    assert rig.cloud.newest is None
    assert rig.cloud.age_ns is None
    rig.receive()
    cloud = rig.cloud.newest
    assert cloud is not None
    assert rig.cloud.poll() is cloud
    assert rig.cloud.poll() is None
    assert rig.cloud.newest is cloud
    assert (rig.cloud.decoded, rig.cloud.undecodable, rig.cloud.skipped) == (1, 0, 0)
    assert np.allclose(np.sort(cloud.positions, axis=0), POINTS, atol=1e-3)
    assert (cloud.error_m, cloud.voxel_m) == pytest.approx((0.01, 0.02))
    assert cloud.colors.tolist() == [[255] * 4] * 10


@pytest.mark.parametrize(
    ("data", "encoding", "fault"),
    [(FRAME[:-1], "cloud", ""), (b"", "cloud", ""), (FRAME, "jpeg", "jpeg")],
)
def test_frame_that_is_no_cloud_is_counted_and_leaves_the_one_before(data: bytes, encoding: str, fault: str) -> None:
    rig = Rig()
    rig.receive()
    before = rig.cloud.poll()
    rig.receive(data, encoding)
    assert rig.cloud.newest is before
    assert rig.cloud.poll() is None
    assert (rig.cloud.decoded, rig.cloud.undecodable, rig.cloud.skipped) == (1, 1, 0)
    assert rig.cloud.fault
    assert fault in rig.cloud.fault
    rig.receive()
    assert rig.cloud.poll() is not None
    assert rig.cloud.fault == ""


def measure(rig: Rig, encoding: str, n: int, *, told: bool = True) -> Any:
    """Return the measurement of `n` frames in two seconds."""
    budget = StreamBudget("room", encoding=encoding, title="Room", fault="slow", detail="3 of 10")
    delivery = DeliveryBudget("full", streams=(budget,) if told else ())
    media = SimpleNamespace(subscribe=lambda _: rig.feed, cloud=lambda _: rig.cloud, delivery=delivery)
    client: Any = SimpleNamespace(media=media)
    meter = StreamMeter(client, "room", 1_000_000_000)
    for _ in range(n):
        rig.receive(FRAME if encoding == "cloud" else b"picture", encoding)
        meter.poll(2_500_000_000)
        meter.poll(2_700_000_000)
    return meter.measure(3_000_000_000)


def test_what_comes_of_a_cloud_is_measured() -> None:
    found = measure(Rig(), "cloud", 3)
    assert (found.frames, found.seconds, found.hz, found.silent_s) == (3, 2.0, 1.5, 0.5)
    assert found.mbit_per_s == pytest.approx(1.5 * len(FRAME) * 8e-6)
    assert (found.points, found.bytes_per_point) == (10, len(FRAME) / 10)
    assert (found.voxel_m, found.error_mm) == pytest.approx((0.02, 10.0))
    assert (found.age_ms, found.age_ms_p99) == pytest.approx((900e-6, 900e-6))
    assert found.ages_ms == pytest.approx(dict(zip(STAGES, (1e-4, 1e-4, 1e-4, 1e-4, 5e-4), strict=True)))
    assert (found.title, found.stale, found.fault, found.detail) == ("Room", False, "slow", "3 of 10")


def test_a_stream_that_the_session_has_no_more_is_stale() -> None:
    found = measure(Rig(), "cloud", 0, told=False)
    assert (found.stale, found.age_ms, found.hz) == (True, None, 0.0)


def test_cloud_of_a_session(session: ClientSession, join: Callable[..., Client]) -> None:
    ann = join("ann")
    room = ann.media.cloud("room")
    assert ann.media.cloud("room") is room
    ann.sleep(0.1)
    session.publish_media("room", FRAME, encoding="cloud")
    ann.poll()
    cloud = room.poll()
    assert cloud is not None
    assert len(cloud.positions) == 10
    slack_ns = ann.clock_error_ns()
    assert cloud.times.capture_ns == cloud.times.published_ns == session.now_ns
    assert abs(cloud.times.arrived_ns - session.now_ns) < slack_ns
    assert cloud.times.decoded_ns >= cloud.times.arrived_ns
    ann.media.unsubscribe("room")
    assert ann.media.cloud("room") is not room
    with pytest.raises(InvalidMessageError):
        ann.media.cloud("a/b")


def test_info_alone_tells_why_no_frame_comes(session: ClientSession, join: Callable[..., Client]) -> None:
    camera = join("cam", role="camera")
    info = StreamInfo("Room", hz=30.0, fault="source", detail="no such device")
    camera.media.publish("room", {}, encoding="cloud", info=info)
    ((_, (head,)),) = session.sockets_of(camera).published
    push = decode_media_push(head)
    assert (push.classes, push.info) == ((), info)
    with pytest.raises(InvalidMessageError, match="full"):
        camera.media.publish("room", {})
