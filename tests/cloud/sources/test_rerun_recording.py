"""Rerun files, written by its SDK and read back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rerun as rr

from iris_session.cloud.camera_file import CameraSettings
from iris_session.cloud.frames import DepthFrame, SourceEndedError, SourceError
from iris_session.cloud.sources import open_source

N = 4
SHAPE = (48, 64)


def make_depth(k: int) -> np.ndarray[Any, np.dtype[np.uint16]]:
    return np.arange(SHAPE[0] * SHAPE[1], dtype=np.uint16).reshape(SHAPE) + k


def make_color(k: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return red, green, blue that differ."""
    return np.full((*SHAPE, 3), (200, 100 + k, 20), np.uint8)


def encode(end: str, rgb: np.ndarray[Any, Any]) -> bytes:
    """Return a compressed picture."""
    return cv2.imencode(end, rgb[..., ::-1] if rgb.ndim == 3 else rgb)[1].tobytes()


def write(
    path: Path, *, depth: str = "raw", color: str = "raw", pinhole: bool = True, every_ns: int = 10_000_000
) -> None:
    rec = rr.RecordingStream("test")
    rec.save(path)
    if pinhole:
        rec.log(
            "cam", rr.Pinhole(focal_length=(50.0, 51.0), principal_point=(31.0, 23.0), resolution=(64, 48)), static=True
        )
    for k in range(N):
        rec.set_time("captured", timestamp=np.datetime64(10**18 + k * every_ns, "ns"))
        if depth == "raw":
            rec.log("cam/depth", rr.DepthImage(make_depth(k), meter=2000.0))
        elif depth == "metres":
            rec.log("cam/depth", rr.DepthImage(make_depth(k).astype(np.float32) / 1000.0, meter=1.0))
        elif depth == "png":
            rec.log(
                "cam/depth",
                rr.EncodedDepthImage(encode(".png", make_depth(k)), media_type="image/png", meter=2000.0),
            )
        if color == "raw":
            rec.log("cam/color", rr.Image(make_color(k)))
        elif color == "bgr":
            rec.log("cam/color", rr.Image(make_color(k)[..., ::-1], color_model="BGR"))
        elif color == "png":
            rec.log("cam/color", rr.EncodedImage(contents=encode(".png", make_color(k)), media_type="image/png"))
        elif color == "nv12":
            rec.log(
                "cam/color",
                rr.Image(
                    bytes=bytes(SHAPE[0] * SHAPE[1] * 3 // 2), width=64, height=48, pixel_format=rr.PixelFormat.NV12
                ),
            )
    rec.disconnect()


def read_source(settings: CameraSettings) -> tuple[Any, list[DepthFrame]]:
    """Return the source, closed, and its frames, on a clock that is a frame later at each look."""
    ticks = iter(range(0, 10**12, 10_000_000))
    source = open_source(settings, lambda: next(ticks))
    frames = []
    try:
        while (frame := source.read(1.0)) is not None:
            frames.append(frame)
    except SourceEndedError:
        pass
    source.close()
    return source, frames


def read_all(path: Path, **values: Any) -> tuple[Any, list[DepthFrame]]:
    return read_source(CameraSettings(name="a", source="rerun", path=str(path), loop=False, **values))


@pytest.mark.parametrize(("depth", "color"), [("raw", "raw"), ("png", "png"), ("raw", "bgr")])
def test_pictures_are_read_back(tmp_path: Path, depth: str, color: str) -> None:
    write(tmp_path / "a.rrd", depth=depth, color=color)
    source, frames = read_all(tmp_path / "a.rrd")
    assert len(frames) == N
    for k, frame in enumerate(frames):
        assert np.array_equal(frame.depth, make_depth(k))
        assert np.array_equal(frame.color, make_color(k))
        assert (frame.capture_ns, frame.T_world_camera) == (k * 10_000_000, None)
    assert source.depth_scale_m == 0.0005
    assert source.recorded_hz == pytest.approx(100.0)
    camera = source.camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (64, 48, 50.0, 51.0, 31.0, 23.0)


def test_depth_in_metres_is_given_in_the_scale_that_is_asked_for(tmp_path: Path) -> None:
    write(tmp_path / "a.rrd", depth="metres")
    source, frames = read_all(tmp_path / "a.rrd", depth_scale_m=0.001)
    assert source.depth_scale_m == 0.001
    assert np.array_equal(frames[1].depth, make_depth(1))


def test_a_rate_takes_the_place_of_the_times(tmp_path: Path) -> None:
    write(tmp_path / "a.rrd", every_ns=3_000_000_000)
    _, frames = read_all(tmp_path / "a.rrd", hz=100.0)
    assert [frame.capture_ns for frame in frames] == [k * 10_000_000 for k in range(N)]


@pytest.mark.parametrize(
    ("written", "values"),
    [({"pinhole": False}, {}), ({"depth": ""}, {}), ({"color": "nv12"}, {}), ({}, {"depth": "/cam/other"})],
)
def test_what_is_missing_is_named(tmp_path: Path, written: dict[str, Any], values: dict[str, Any]) -> None:
    write(tmp_path / "a.rrd", **written)
    with pytest.raises(SourceError) as caught:
        read_all(tmp_path / "a.rrd", **values)
    assert not isinstance(caught.value, SourceEndedError)
    assert "a.rrd" in str(caught.value)


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.rrd").write_bytes(b"RRF2" + bytes(100))
    with pytest.raises(SourceError):
        read_all(tmp_path / "a.rrd")
