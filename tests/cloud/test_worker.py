"""The work of a camera process: clouds and pictures are published, faults travel with them, all is reported."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from iris_session.cloud import worker
from iris_session.cloud.camera_file import CameraSettings
from iris_session.cloud.frames import SourceError
from iris_session.cloud.worker import CloudWorker
from iris_session.protocol.names import MediaEncoding, StreamFault
from iris_session.streams.cloud import decode_cloud
from tests.cloud.camera_settings import make_settings
from tests.cloud.fake_source import FakeSink, FakeSource, make_frame


class Lab:
    """A worker whose readers do a step each time that it gives a frame, in the thread of the test."""

    def __init__(self, *names: str, **options: Any) -> None:
        self.sink = FakeSink()
        self.sources: dict[str, FakeSource] = {}
        self.settings = make_settings(*names, **options)
        self.remover: Any = SimpleNamespace(is_ready=lambda at_ns: True, remove=lambda points, at_ns: points)
        self.worker = CloudWorker(self.settings, self.sink, self._open, time.perf_counter_ns, remover=self.remover)
        self.open_sources()

    def _open(self, camera: CameraSettings, now_ns: Callable[[], int]) -> FakeSource:
        self.sources[camera.name] = FakeSource()
        return self.sources[camera.name]

    def open_sources(self) -> None:
        for reader in self.worker._readers.values():
            reader.step()

    def step(self, ms: float, *names: str, late_ms: float = 0.0, **changes: Any) -> None:
        """Let time pass, give a frame of each of these cameras, and poll. `late_ms`: they were captured before."""
        self.sink.time_ns += round(ms * 1e6)
        for name in names:
            frame = make_frame(self.sink.time_ns - round(late_ms * 1e6))
            self.sources[name].put(frame._replace(**changes))
            self.worker._readers[name].step()
        self.worker.poll(0.0)

    def fail(self, name: str, error: Exception) -> None:
        """Let a source fail, and poll."""
        self.sources[name].put(error)
        self.worker._readers[name].step()
        self.worker.poll(0.0)

    def fault(self, stream: str = "room") -> tuple[str, str]:
        info = self.sink.newest_info(stream)
        return ("", "") if info is None else (info.fault, info.detail)

    def count(self, stream: str) -> int:
        """Return how many frames of a stream were published."""
        return len([one for one in self.sink.published if one[0] == stream and one[1]])


def test_cloud_and_picture_of_a_camera() -> None:
    lab = Lab("front", picture_hz=10.0)
    lab.step(40, "front", late_ms=10)
    (name, picture, picture_ns, encoding, info), (cloud_name, frames, cloud_ns, cloud_encoding, cloud_info) = (
        lab.sink.published
    )
    assert (name, encoding, picture_ns) == ("room-front", MediaEncoding.JPEG, lab.sink.time_ns - 10_000_000)
    assert isinstance(picture, bytes)
    decoded = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    assert decoded.shape == (30, 40, 3)
    assert info is not None
    assert info.camera is not None
    assert (info.title, info.hz, info.camera.width, info.camera.fx) == ("Room: front", 10.0, 40, 35.0)
    assert (cloud_name, cloud_encoding, cloud_ns) == ("room", MediaEncoding.CLOUD, lab.sink.time_ns - 10_000_000)
    assert not isinstance(frames, bytes)
    assert set(frames) == {"full", "half", "quarter"}
    assert len(decode_cloud(frames["full"]).positions) > 100
    assert cloud_info is not None
    assert (cloud_info.title, cloud_info.audience, cloud_info.fault) == ("Room", "remote", "")


def test_clouds_and_pictures_have_the_rate_that_is_asked_for() -> None:
    lab = Lab("front", hz=5.0, picture_hz=2.0)
    for _ in range(100):  # 4 s of a camera at 25 Hz
        lab.step(40, "front")
    streams = [one[0] for one in lab.sink.published if one[1]]
    assert 20 <= streams.count("room") <= 22
    assert 8 <= streams.count("room-front") <= 10
    assert lab.worker.count_drops()["superseded"] >= 70


def test_a_fault_is_published_without_a_frame_while_none_comes() -> None:
    lab = Lab("front", picture_hz=10.0)
    lab.fail("front", SourceError("camera 'front': no such device: 0, there are none"))
    assert {one[0] for one in lab.sink.published} == {"room", "room-front"}
    for _, frames, _, _, info in lab.sink.published:
        assert (frames, info is not None) == ({}, True)
        assert info is not None
        assert info.detail.removeprefix("camera front: ") == "no such device: 0, there are none"
        assert (info.fault, info.camera) == (StreamFault.SOURCE, None)
    lab.open_sources()
    lab.step(500, "front")
    assert lab.fault() == ("", "")


def test_frames_that_cannot_be_made_end_nothing(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    lab = Lab("front", picture_hz=30.0)

    def fail(*_: object) -> Any:
        raise RuntimeError("no such\ncell")

    with monkeypatch.context() as patch:
        patch.setattr(worker, "encode_picture", fail)
        patch.setattr(lab.worker.pipeline, "make_cloud", fail)
        for _ in range(5):
            lab.step(40, "front")
    assert {info.fault for *_, info in lab.sink.published if info is not None} == {StreamFault.SOURCE}
    assert lab.fault() == (StreamFault.SOURCE, "frames of 'room' cannot be made: RuntimeError: no such cell")
    report = lab.worker.make_report()
    assert "frames of 'room-front' cannot be made: RuntimeError: no such cell" in report.warning
    assert report.drops["failed"] == 10
    assert caplog.text.count("no such cell") == 2
    lab.sink.published.clear()
    lab.step(40, "front")
    assert {one[0] for one in lab.sink.published if one[1]} == {"room", "room-front"}
    assert (lab.fault(), lab.worker.make_report().warning) == (("", ""), "")


def test_a_camera_that_is_in_no_cloud_is_named() -> None:
    lab = Lab("left", "right")
    for _ in range(50):
        lab.step(10, "right", late_ms=1000)
        lab.step(30, "left")
    assert lab.worker.cloud is not None
    assert lab.worker.cloud.cameras == ("left",)
    fault, detail = lab.fault()
    assert (fault, detail[:35]) == (StreamFault.CLOCK, "camera right: its frames are in no ")
    for _ in range(50):
        lab.step(10, "right")
        lab.step(30, "left")
    assert lab.worker.cloud.cameras == ("left", "right")
    assert lab.fault() == ("", "")


def test_frames_that_no_one_takes_are_counted_once_there_is_a_connection() -> None:
    lab = Lab("front")
    lab.sink.takes = False
    for _ in range(20):
        lab.step(40, "front")
    assert not lab.worker.count_drops(), "the first frames connect"
    lab.sink.takes = True
    lab.step(40, "front")
    assert lab.sink.published[0][4] is not None, "what was dropped has described nothing"
    lab.sink.takes = False
    lab.step(40, "front")
    assert lab.worker.count_drops() == {"send": 1}


def test_what_has_no_pose_is_named() -> None:
    lab = Lab("front", "hand")
    assert not lab.settings.cameras[0].body
    cameras = lab.worker._cameras
    cameras["hand"] = msgspec.structs.replace(cameras["hand"], body="left/hand")
    lab.remover.is_ready = lambda at_ns: False
    for _ in range(10):
        lab.step(40, "front", "hand")
    sources = lab.worker.make_report().cameras
    assert {one.fault for one in sources.values()} == {StreamFault.POSE}
    assert "no state of its robots" in sources["front"].detail
    assert "no body 'left/hand'" in sources["hand"].detail
    lab.remover.is_ready = lambda at_ns: True
    lab.step(40, "front", "hand")
    assert lab.fault() == ("", "")


def test_session_time_that_goes_back_opens_the_sources_anew() -> None:
    """As of a session that is resumed after a reboot: frames would be due for as long as it ran before."""
    lab = Lab("front", picture_hz=30.0)
    for _ in range(3):
        lab.step(40, "front")
    lab.step(-40)
    before = lab.sources["front"]
    assert not lab.worker._readers["front"]._is_outdated, "by so much a clock is slewed"
    lab.step(-60_000)
    lab.open_sources()
    assert before.closed
    lab.sink.published.clear()
    lab.step(40, "front")
    assert {one[0] for one in lab.sink.published if one[1]} == {"room", "room-front"}
    assert lab.fault() == ("", "")
