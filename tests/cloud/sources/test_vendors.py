"""RealSense and Orbbec, with stand-ins of the vendors' packages: no such device is here.

The stand-ins have the calls of the packages' bindings (librealsense 2, `wrappers/python`; pyorbbecsdk, `stubs`).
"""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from iris_session.cloud.camera_file import CameraSettings
from iris_session.cloud.frames import SourceError
from iris_session.cloud.sources import open_source

WIDTH, HEIGHT = 64, 48
DEPTH = np.full((HEIGHT, WIDTH), 1500, np.uint16)
COLOR = np.full((HEIGHT, WIDTH, 3), (10, 20, 30), np.uint8)


def make_settings(source: Any, **values: Any) -> CameraSettings:
    return CameraSettings(name="a", source=source, width=WIDTH, height=HEIGHT, **values)


class RealSenseStandIn(ModuleType):
    """`pyrealsense2` with devices 11 and 22. Its frames are aligned only by its filter."""

    stream = SimpleNamespace(depth="depth", color="color")
    format = SimpleNamespace(z16="z16", rgb8="rgb8")
    camera_info = SimpleNamespace(serial_number="serial", name="name")
    distortion = SimpleNamespace(brown_conrady="brown", inverse_brown_conrady="inverse")

    def __init__(self) -> None:
        super().__init__("pyrealsense2")
        self.serials = ["11", "22"]
        self.enabled: list[Any] = []
        self.fails = self.stopped = False
        self.arrives = True

    def context(self) -> Any:
        devices = [
            SimpleNamespace(get_info=lambda key, s=one: f"D435 {s}" if key == "name" else s) for one in self.serials
        ]
        return SimpleNamespace(query_devices=lambda: devices)

    def config(self) -> Any:
        return SimpleNamespace(
            enable_device=self.enabled.append,
            enable_stream=lambda *args: self.enabled.append(args),
        )

    def align(self, to: str) -> Any:
        assert to == "depth"

        def frame(data: Any) -> Any:
            return SimpleNamespace(get_data=lambda: data)

        aligned = SimpleNamespace(get_depth_frame=lambda: frame(DEPTH), get_color_frame=lambda: frame(COLOR))
        return SimpleNamespace(process=lambda frames: aligned)

    def pipeline(self) -> Any:
        lens = {"coeffs": [0.0] * 5, "model": "brown"}
        found = SimpleNamespace(width=64, height=48, fx=50.0, fy=51.0, ppx=31.0, ppy=23.0, **lens)
        stream = SimpleNamespace(as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: found))
        sensor = SimpleNamespace(get_depth_scale=lambda: 0.00025)
        profile = SimpleNamespace(
            get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor), get_stream=lambda which: stream
        )

        def start(config: Any) -> Any:
            if self.fails:
                raise RuntimeError("Couldn't resolve requests")
            return profile

        def stop() -> None:
            self.stopped = True

        return SimpleNamespace(start=start, stop=stop, try_wait_for_frames=lambda timeout_ms: (self.arrives, "frames"))


class OrbbecStandIn(ModuleType):
    """`pyorbbecsdk` with device AB."""

    OBSensorType = SimpleNamespace(DEPTH_SENSOR="depth", COLOR_SENSOR="color")
    OBStreamType = SimpleNamespace(DEPTH_STREAM="to depth")
    OBFormat = SimpleNamespace(Y16="Y16", RGB="RGB")

    def __init__(self) -> None:
        super().__init__("pyorbbecsdk")
        self.enabled: list[Any] = []
        self.stopped = False
        self.frames: Any = self

    def Context(self) -> Any:
        devices = SimpleNamespace(
            get_count=lambda: 1,
            get_device_serial_number_by_index=lambda k: "AB",
            get_device_by_serial_number=lambda serial: serial,
        )
        return SimpleNamespace(query_devices=lambda: devices)

    def Config(self) -> Any:
        return SimpleNamespace(enable_stream=self.enabled.append)

    def AlignFilter(self, align_to_stream: str) -> Any:
        assert align_to_stream == "to depth"
        return SimpleNamespace(process=lambda frames: SimpleNamespace(as_frame_set=lambda: frames))

    def get_depth_frame(self) -> Any:
        return self._make_frame(DEPTH, get_depth_scale=lambda: 0.5)

    def get_color_frame(self) -> Any:
        return self._make_frame(COLOR)

    def _make_frame(self, pixels: Any, **more: Any) -> Any:
        data = pixels.reshape(-1).view(np.uint8)
        return SimpleNamespace(get_data=lambda: data, get_width=lambda: WIDTH, get_height=lambda: HEIGHT, **more)

    def Pipeline(self, device: str) -> Any:
        assert device == "AB"
        lens = SimpleNamespace(k1=0.1, k2=0.2, p1=0.3, p2=0.4, k3=0.5, k4=0.6, k5=0.7, k6=0.8)
        found = SimpleNamespace(width=64, height=48, fx=50.0, fy=51.0, cx=31.0, cy=23.0)

        def choose(width: int, height: int, form: str, hz: int) -> Any:
            return SimpleNamespace(
                key=(width, height, form, hz), get_intrinsic=lambda: found, get_distortion=lambda: lens
            )

        def stop() -> None:
            self.stopped = True

        return SimpleNamespace(
            get_stream_profile_list=lambda sensor: SimpleNamespace(get_video_stream_profile=choose),
            enable_frame_sync=lambda: None,
            start=lambda config: None,
            stop=stop,
            wait_for_frames=lambda timeout_ms: self.frames,
        )


@pytest.fixture
def realsense(monkeypatch: pytest.MonkeyPatch) -> RealSenseStandIn:
    module = RealSenseStandIn()
    monkeypatch.setitem(sys.modules, "pyrealsense2", module)
    monkeypatch.setattr("iris_session.cloud.sources.realsense.require_package", lambda package, purpose: None)
    return module


@pytest.fixture
def orbbec(monkeypatch: pytest.MonkeyPatch) -> OrbbecStandIn:
    module = OrbbecStandIn()
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", module)
    monkeypatch.setattr("iris_session.cloud.sources.orbbec.require_package", lambda package, purpose: None)
    return module


def test_realsense_gives_colour_aligned_to_depth(realsense: RealSenseStandIn) -> None:
    source = open_source(make_settings("realsense", path="22", hz=15.0), lambda: 7)
    assert realsense.enabled == ["22", ("depth", 64, 48, "z16", 15), ("color", 64, 48, "rgb8", 15)]
    camera = source.camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (64, 48, 50.0, 51.0, 31.0, 23.0)
    assert (camera.distortion, source.depth_scale_m) == ((), 0.00025)
    frame = source.read(0.1)
    assert frame is not None
    assert frame.capture_ns == 7
    assert np.array_equal(frame.depth, DEPTH)
    assert np.array_equal(frame.color, COLOR)
    assert frame.depth is not DEPTH
    realsense.arrives = False
    assert source.read(0.1) is None
    source.close()
    assert realsense.stopped


def test_realsense_that_is_not_there_or_does_not_start_is_named(realsense: RealSenseStandIn) -> None:
    for path in ("", "33"):
        with pytest.raises(SourceError) as caught:
            open_source(make_settings("realsense", path=path), lambda: 0)
        assert "11 (D435 11)" in str(caught.value)
        assert "22 (D435 22)" in str(caught.value)
    realsense.fails = True
    with pytest.raises(SourceError) as caught:
        open_source(make_settings("realsense", path="11"), lambda: 0)
    assert "64 x 48 at 30 Hz" in str(caught.value)


def test_orbbec_gives_colour_aligned_to_depth(orbbec: OrbbecStandIn) -> None:
    source = open_source(make_settings("orbbec"), lambda: 7)
    assert [one.key for one in orbbec.enabled] == [(64, 48, "Y16", 30), (64, 48, "RGB", 30)]
    assert source.camera.distortion == (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
    assert (source.camera.fx, source.camera.cx) == (50.0, 31.0)
    frame = source.read(0.1)
    assert frame is not None
    assert (frame.capture_ns, source.depth_scale_m) == (7, 0.0005)
    assert np.array_equal(frame.depth, DEPTH)
    assert np.array_equal(frame.color, COLOR)
    orbbec.frames = None
    assert source.read(0.1) is None
    source.close()
    assert orbbec.stopped
