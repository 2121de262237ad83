"""A depth camera that OpenCV itself can open: OpenNI2 (Kinect, Xtion, Astra), RealSense, Orbbec's UVC devices.

OpenCV must be built with that backend; the wheels of PyPI are built without.
"""

from __future__ import annotations

import glob
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

from iris_session.cloud.camera_file import CameraSettings
from iris_session.cloud.frames import DepthFrame, SourceError
from iris_session.cloud.sources.playback import fit_color, to_depth, to_rgb
from iris_session.system.extras import require_package


class _Backend(NamedTuple):
    """A backend of OpenCV with depth, and the numbers of its pictures (`VideoCapture.retrieve`)."""

    name: str
    depth: int
    color: int


#: By the names of OpenCV's constants: videoio.hpp, `VideoCaptureAPIs`, `CAP_OPENNI_*`, `CAP_INTELPERC_*`,
#: `CAP_OBSENSOR_*`. RealSense devices have the number of the older Intel cameras.
_BACKENDS: Final = (
    _Backend("CAP_OPENNI2", 0, 5),
    _Backend("CAP_OPENNI2_ASTRA", 0, 5),
    _Backend("CAP_INTELPERC", 0, 3),
    _Backend("CAP_OBSENSOR", 0, 1),
)


class OpenCvCamera:
    """A device of a backend of OpenCV that gives depth. `grab` of OpenCV waits as long as the device wants."""

    def __init__(self, settings: CameraSettings, now_ns: Callable[[], int]) -> None:
        require_package("cv2", "a camera by OpenCV")
        import cv2

        if settings.intrinsics is None:
            raise SourceError("intrinsics are missing: OpenCV does not tell them")
        self.camera = settings.intrinsics
        self.depth_scale_m = settings.depth_scale_m or 0.001
        self._now_ns = now_ns
        self._name = f"OpenCV's camera {settings.path or 0}"
        device: int | str = int(settings.path) if settings.path.isdecimal() else settings.path or 0
        built_in = {int(one) for one in cv2.videoio_registry.getBackends()}
        backends = [one for one in _BACKENDS if getattr(cv2, one.name, -1) in built_in]
        if not backends:
            names = ", ".join(sorted({cv2.videoio_registry.getBackendName(one) for one in built_in}))
            raise SourceError(
                f"this OpenCV has no backend for depth cameras (it has {names}): build it with OpenNI2, or use source "
                '"realsense" or "orbbec"'
            )
        self._capture, self._backend = self._open(cv2, device, backends)
        if self._backend.name.startswith("CAP_OPENNI2"):  # colour to depth
            self._capture.set(getattr(cv2, "CAP_PROP_OPENNI_REGISTRATION", 100), 1)

    def read(self, timeout_s: float) -> DepthFrame | None:
        """Return the next frame; see `DepthSource`."""
        if not self._capture.grab():
            raise SourceError(f"{self._name} gives no more frames")
        capture_ns = self._now_ns()
        has_depth, depth = self._capture.retrieve(flag=self._backend.depth)
        has_color, color = self._capture.retrieve(flag=self._backend.color)
        if not has_depth or not has_color:
            return None
        units = to_depth(np.squeeze(depth), self.depth_scale_m, self._name)
        return DepthFrame(units, fit_color(to_rgb(color, self._name), units, self._name), capture_ns)

    def close(self) -> None:
        """Release the device."""
        self._capture.release()

    def _open(self, cv2: Any, device: int | str, backends: list[_Backend]) -> tuple[Any, _Backend]:
        for backend in backends:
            capture = cv2.VideoCapture(device, getattr(cv2, backend.name))
            if capture.isOpened():
                return capture, backend
            capture.release()
        there = ", ".join(sorted(glob.glob("/dev/video*"))) or "none"
        tried = ", ".join(one.name for one in backends)
        raise SourceError(f"{self._name} cannot be opened by {tried}; video devices that are there: {there}")
