"""Recordings are played at their rate, depth is paired with colour, pictures become arrays of one kind."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from anchors.camera import CameraModel
from iris_session.cloud.camera_file import CameraSettings
from iris_session.cloud.frames import DepthFrame, DepthSource, SourceEndedError, SourceError
from iris_session.cloud.sources import open_source
from iris_session.cloud.sources.playback import (
    RecordedPicture,
    RecordingSource,
    decode_picture,
    fit_color,
    pair_pictures,
    resample,
    to_depth,
)

MS = 1_000_000


class Clock:
    """Time that passes when it is slept."""

    def __init__(self) -> None:
        self.t_ns = 5_000 * MS

    def now_ns(self) -> int:
        return self.t_ns

    def sleep(self, seconds: float) -> None:
        self.t_ns += round(1e9 * seconds)


class Recording(RecordingSource[int]):
    """A recording whose frames have their numbers as depth."""

    camera, depth_scale_m = CameraModel(1, 1, 1.0, 1.0, 0.0, 0.0), 0.001

    def __init__(self, clock: Clock, times_ms: list[int], *, loop: bool = False) -> None:
        self._times_ms = times_ms
        super().__init__(CameraSettings(name="a", source="mcap", loop=loop), clock.now_ns, clock.sleep)

    def _list_frames(self) -> Iterator[tuple[int, int]]:
        return iter([(100 * MS + t * MS, k) for k, t in enumerate(self._times_ms)])

    def _decode_frame(self, content: int, capture_ns: int) -> DepthFrame:
        return DepthFrame(np.full((1, 1), content, np.uint16), np.zeros((1, 1, 3), np.uint8), capture_ns)

    def play(self, n: int = 1) -> list[tuple[int, int]]:
        """Return numbers and times of the next frames."""
        frames = [self.read(10.0) for _ in range(n)]
        return [(int(one.depth[0, 0]), one.capture_ns) for one in frames if one is not None]


def test_frames_come_at_their_times_and_again_after_the_end() -> None:
    clock = Clock()
    seen = Recording(clock, [0, 30, 60], loop=True).play(5)
    assert seen == [(0, 5_000 * MS), (1, 5_030 * MS), (2, 5_060 * MS), (0, 5_090 * MS), (1, 5_120 * MS)]
    assert clock.t_ns == 5_120 * MS


def test_a_late_reader_is_waited_for() -> None:
    clock = Clock()
    recording = Recording(clock, [0, 30, 60, 90, 120])
    recording.play()
    clock.sleep(0.05)  # late by 20 ms: the rate holds
    assert recording.play(2) == [(1, 5_030 * MS), (2, 5_060 * MS)]
    clock.sleep(5.0)
    assert recording.play(2) == [(3, 10_060 * MS), (4, 10_090 * MS)]


def test_empty_and_closed_recordings_have_no_frames() -> None:
    with pytest.raises(SourceError):
        Recording(Clock(), [])
    ended, closed = Recording(Clock(), [0, 30]), Recording(Clock(), [0, 30], loop=True)
    ended.play(2)
    closed.close()
    for recording in (ended, closed):
        with pytest.raises(SourceEndedError):
            recording.read(1.0)


def test_depth_is_paired_with_colour_of_its_time() -> None:
    messages = [
        RecordedPicture(0, "color", "c0"),
        RecordedPicture(10 * MS, "depth", "d0"),
        RecordedPicture(33 * MS, "color", "c1"),
        RecordedPicture(40 * MS, "color", "c2"),
        RecordedPicture(43 * MS, "depth", "d1"),
        RecordedPicture(100 * MS, "depth", "d2"),
        RecordedPicture(160 * MS, "color", "c3"),
        RecordedPicture(170 * MS, "depth", "d3"),
    ]
    pairs = list(pair_pictures(messages))
    assert pairs == [(10 * MS, ("d0", "c0")), (43 * MS, ("d1", "c2")), (170 * MS, ("d3", "c3"))]
    assert [t for t, _ in resample(iter(pairs), 10.0)] == [0, 100 * MS, 200 * MS]


def test_depth_in_metres_becomes_units() -> None:
    metres = np.array([[1.0, 0.2501, np.nan], [np.inf, -1.0, 70.0]], np.float32)
    assert to_depth(metres, 0.001, "x").tolist() == [[1000, 250, 0], [0, 0, 0]]
    units = np.array([[1, 65_535]], np.uint16)
    assert to_depth(units, 0.001, "x") is units
    for wrong in (np.zeros((2, 2), np.uint8), np.zeros((2, 2, 3), np.uint16)):
        with pytest.raises(SourceError):
            to_depth(wrong, 0.001, "x")


@pytest.mark.parametrize("scale", [3, 0.5])
def test_colour_of_another_resolution_is_put_on_the_grid_of_the_depth(scale: float) -> None:
    depth = np.zeros((12, 16), np.uint16)
    height, width = round(12 * scale), round(16 * scale)
    color = np.zeros((height, width, 3), np.uint8)
    color[..., 0] = np.arange(width)  # its column
    color[..., 1] = np.arange(height)[:, None]
    fitted = fit_color(color, depth, "x")
    assert fitted.shape == (12, 16, 3)
    # Pixel centres of both grids: within half a pixel of the colour.
    assert np.abs(fitted[0, :, 0] + 0.5 - (np.arange(16) + 0.5) * scale).max() <= 0.5
    assert np.abs(fitted[:, 0, 1] + 0.5 - (np.arange(12) + 0.5) * scale).max() <= 0.5


def test_colour_of_another_view_is_refused_with_both_sizes() -> None:
    with pytest.raises(SourceError, match=r"16 x 9.*16 x 12"):
        fit_color(np.zeros((9, 16, 3), np.uint8), np.zeros((12, 16), np.uint16), "x")


def claim(data: bytes, size: int) -> bytes:
    """Return a PNG or JPEG whose header claims a width and height of `size`."""
    if data[:4] == b"\x89PNG":
        header = b"IHDR" + struct.pack(">II", size, size) + data[24:29]
        return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]
    at = data.index(b"\xff\xc0") + 5
    return data[:at] + struct.pack(">HH", size, size) + data[at + 4 :]


@pytest.mark.parametrize("end", [".png", ".jpg"])
def test_a_picture_that_claims_to_be_huge_is_refused_by_its_header(end: str) -> None:
    data = cv2.imencode(end, np.zeros((4, 4, 3), np.uint8))[1].tobytes()
    for other in (b"", b"not a picture", data[:20]):
        with pytest.raises(SourceError):
            decode_picture(other, "x")
    assert decode_picture(claim(data, 4), "x").shape == (4, 4, 3)
    for size in (65_535, 4_097):
        with pytest.raises(SourceError, match=f"{size} x {size}"):
            decode_picture(claim(data, size), "x")


def test_errors_of_packages_are_one_line_with_the_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken:
        camera, depth_scale_m, closed = CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5), 0.001, 0

        def close(self) -> None:
            self.closed += 1
            raise RuntimeError("no device")

    def fail(*_: object) -> DepthSource:
        raise KeyError("data")

    broken = Broken()
    settings = CameraSettings(name="front", source="mcap", path="/a.mcap")
    monkeypatch.setattr("iris_session.cloud.sources._open", lambda *_: broken)
    broken.depth_scale_m = 0.0
    with pytest.raises(SourceError, match=r"camera 'front': .*depth_scale_m"):
        open_source(settings, lambda: 0)
    broken.camera = CameraModel(100_000, 100_000, 1.0, 1.0, 1.0, 1.0)
    with pytest.raises(SourceError, match=r"camera 'front': .*100000 x 100000"):
        open_source(settings, lambda: 0)
    assert broken.closed == 2
    monkeypatch.setattr("iris_session.cloud.sources._open", fail)
    with pytest.raises(SourceError, match=r"camera 'front': .*KeyError: 'data'"):
        open_source(settings, lambda: 0)


@pytest.mark.parametrize(
    ("source", "package", "extra"), [("realsense", "pyrealsense2", "realsense"), ("mcap", "mcap", "mcap")]
)
def test_a_missing_package_is_named_with_its_extra(
    source: str, package: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == package else object())
    with pytest.raises(SourceError) as caught:
        open_source(CameraSettings(name="front", source=source, path="x"), lambda: 0)  # type: ignore[arg-type]
    assert "'front'" in str(caught.value)
    assert f"iris-session[{extra}]" in str(caught.value)
