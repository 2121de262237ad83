"""A RealSense camera, by `pyrealsense2`: colour aligned to depth by the vendor's filter.

Written from the package's documentation and bindings (librealsense 2, `wrappers/python`); never run with a device.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from anchors.camera import CameraModel
from iris_session.cloud.camera_file import CameraSettings
from iris_session.cloud.frames import DepthFrame, SourceError
from iris_session.cloud.sources.playback import DEFAULT_HZ, choose_device
from iris_session.system.extras import require_package


class RealSenseCamera:
    """One device, by its serial number. Frames are dated by their arrival."""

    recorded_hz = 0.0

    def __init__(self, settings: CameraSettings, now_ns: Callable[[], int]) -> None:
        require_package("pyrealsense2", 'source "realsense"')
        import pyrealsense2 as rs

        self._now_ns = now_ns
        there = {
            device.get_info(rs.camera_info.serial_number): device.get_info(rs.camera_info.name)
            for device in rs.context().query_devices()
        }
        serial = choose_device("RealSense", settings.path, there)
        self._name = f"RealSense {serial}"
        hz = round(settings.hz or DEFAULT_HZ)
        config = rs.config()
        config.enable_device(serial)
        config.enable_stream(rs.stream.depth, settings.width, settings.height, rs.format.z16, hz)
        config.enable_stream(rs.stream.color, settings.width, settings.height, rs.format.rgb8, hz)
        self._pipeline: Any = rs.pipeline()
        try:
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            size = f"{settings.width} x {settings.height} at {hz} Hz"
            raise SourceError(
                f"{self._name} does not start with {size}: {error}; try another width, height, hz"
            ) from error
        try:
            self.depth_scale_m = settings.depth_scale_m or profile.get_device().first_depth_sensor().get_depth_scale()
            stream = profile.get_stream(rs.stream.depth).as_video_stream_profile()
            self.camera = settings.intrinsics or _to_camera(rs, stream.get_intrinsics(), self._name)
            self._align = rs.align(rs.stream.depth)
        except BaseException:
            self._pipeline.stop()
            raise

    def read(self, timeout_s: float) -> DepthFrame | None:
        """Return the next frame; see `DepthSource`."""
        try:
            arrived, frames = self._pipeline.try_wait_for_frames(round(1e3 * timeout_s))
            capture_ns = self._now_ns()
            if not arrived:
                return None
            frames = self._align.process(frames)
            depth, color = frames.get_depth_frame(), frames.get_color_frame()
        except RuntimeError as error:
            raise SourceError(f"{self._name}: {error}") from error
        if not depth or not color:
            return None
        # Copies: the device has few buffers.
        return DepthFrame(np.array(depth.get_data(), np.uint16), np.array(color.get_data(), np.uint8), capture_ns)

    def close(self) -> None:
        """Release the device."""
        self._pipeline.stop()


def _to_camera(rs: Any, found: Any, name: str) -> CameraModel:
    """Return the intrinsics of a device's depth. Depth of stereo devices is rectified: it has no distortion."""
    distortion = tuple(float(k) for k in found.coeffs) if any(found.coeffs) else ()
    if distortion and found.model != rs.distortion.brown_conrady:
        raise SourceError(f"{name}: its depth has lens distortion of {found.model}: give intrinsics of OpenCV's model")
    return CameraModel(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy, distortion)
