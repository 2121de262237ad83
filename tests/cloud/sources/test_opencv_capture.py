"""OpenCV's depth cameras: without a backend one line says so; with one, its pictures become frames.

The backend is a stand-in: no device, and no OpenCV with such a backend, is here.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from anchors.camera import CameraModel
from iris_session.cloud.camera_file import CameraSettings
from iris_session.cloud.frames import SourceError
from iris_session.cloud.sources import open_source

SETTINGS = CameraSettings(name="a", source="opencv", intrinsics=CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5))


class StandIn:
    """A device that OpenNI2 opens."""

    opens = True

    def __init__(self, device: int | str, backend: int) -> None:
        self.device, self.backend, self.grabs, self.released = device, backend, 2, False
        self.properties: dict[int, float] = {}

    def isOpened(self) -> bool:
        return self.opens

    def set(self, name: int, value: float) -> None:
        self.properties[name] = value

    def grab(self) -> bool:
        self.grabs -= 1
        return self.grabs >= 0

    def retrieve(self, flag: int) -> tuple[bool, Any]:
        if flag == 0:
            return True, np.full((48, 64), 1234, np.uint16)
        assert flag == cv2.CAP_OPENNI_BGR_IMAGE
        return True, np.full((96, 128, 3), (30, 20, 10), np.uint8)

    def release(self) -> None:
        self.released = True


@pytest.fixture
def openni(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2.videoio_registry, "getBackends", lambda: [cv2.CAP_OPENNI2])
    monkeypatch.setattr(cv2, "VideoCapture", StandIn)


@pytest.mark.usefixtures("openni")
def test_pictures_become_frames_until_the_device_gives_none() -> None:
    source: Any = open_source(SETTINGS, lambda: 7)
    assert (source._capture.device, source._capture.backend) == (0, cv2.CAP_OPENNI2)
    assert source._capture.properties == {cv2.CAP_PROP_OPENNI_REGISTRATION: 1}
    for _ in range(2):
        frame = source.read(1.0)
        assert frame.capture_ns == 7
        assert (frame.depth == 1234).all()
        assert frame.color.shape == (48, 64, 3)
        assert (frame.color == (10, 20, 30)).all()
    with pytest.raises(SourceError):
        source.read(1.0)
    source.close()
    assert source._capture.released


@pytest.mark.usefixtures("openni")
def test_a_device_that_does_not_open_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StandIn, "opens", False)
    monkeypatch.setattr("glob.glob", lambda pattern: ["/dev/video7"])
    with pytest.raises(SourceError) as caught:
        open_source(SETTINGS, lambda: 0)
    assert "/dev/video7" in str(caught.value)


def test_an_opencv_without_depth_cameras_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2.videoio_registry, "getBackends", lambda: [cv2.CAP_V4L2])
    with pytest.raises(SourceError) as caught:
        open_source(SETTINGS, lambda: 0)
    assert "V4L2" in str(caught.value)
