"""An Orbbec camera, by `pyorbbecsdk` (package pyorbbecsdk2): colour aligned to depth by the vendor's filter.

Written from the package's type stubs and documentation; never run with a device.
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


class OrbbecCamera:
    """One device, by its serial number. Frames are dated by their arrival."""

    recorded_hz = 0.0

    def __init__(self, settings: CameraSettings, now_ns: Callable[[], int]) -> None:
        require_package("pyorbbecsdk", 'source "orbbec"')
        import pyorbbecsdk as ob

        self._now_ns = now_ns
        devices = ob.Context().query_devices()
        there = {devices.get_device_serial_number_by_index(k): "Orbbec" for k in range(devices.get_count())}
        serial = choose_device("Orbbec", settings.path, there)
        self._name = f"Orbbec {serial}"
        self._fixed_scale_m = settings.depth_scale_m
        self.depth_scale_m = settings.depth_scale_m or 0.001  # the device's comes with its first frame
        hz = round(settings.hz or DEFAULT_HZ)
        size = settings.width, settings.height
        try:
            self._pipeline: Any = ob.Pipeline(devices.get_device_by_serial_number(serial))
            profiles = self._pipeline.get_stream_profile_list(ob.OBSensorType.DEPTH_SENSOR)
            profile = profiles.get_video_stream_profile(*size, ob.OBFormat.Y16, hz)
            self.camera = settings.intrinsics or _to_camera(profile)
            config = ob.Config()
            config.enable_stream(profile)
            colors = self._pipeline.get_stream_profile_list(ob.OBSensorType.COLOR_SENSOR)
            config.enable_stream(colors.get_video_stream_profile(*size, ob.OBFormat.RGB, hz))
            self._pipeline.enable_frame_sync()
            self._pipeline.start(config)
            try:
                self._align = ob.AlignFilter(align_to_stream=ob.OBStreamType.DEPTH_STREAM)
            except BaseException:
                self._pipeline.stop()
                raise
        except Exception as error:  # the package has its own errors, of no common base
            text = f"{settings.width} x {settings.height} at {hz} Hz"
            raise SourceError(
                f"{self._name} does not start with {text}: {error}; try another width, height, hz"
            ) from error

    def read(self, timeout_s: float) -> DepthFrame | None:
        """Return the next frame; see `DepthSource`."""
        try:
            frames = self._pipeline.wait_for_frames(max(1, round(1e3 * timeout_s)))
            capture_ns = self._now_ns()
            if not frames or not frames.get_depth_frame() or not frames.get_color_frame():
                return None
            aligned = self._align.process(frames)
            if not aligned:
                return None
            frames = aligned.as_frame_set()
            depth, color = frames.get_depth_frame(), frames.get_color_frame()
            if not depth or not color:
                return None
            # The scale is in millimetres.
            self.depth_scale_m = self._fixed_scale_m or 1e-3 * depth.get_depth_scale()
            # Copies: the device has few buffers.
            units = np.frombuffer(depth.get_data(), np.uint16).reshape(depth.get_height(), depth.get_width()).copy()
            rgb = np.frombuffer(color.get_data(), np.uint8).reshape(color.get_height(), color.get_width(), 3).copy()
        except Exception as error:
            raise SourceError(f"{self._name}: {error}") from error
        return DepthFrame(units, rgb, capture_ns)

    def close(self) -> None:
        """Release the device."""
        self._pipeline.stop()


def _to_camera(profile: Any) -> CameraModel:
    """Return the intrinsics of the device's depth. Its distortion is OpenCV's model with eight coefficients."""
    found, lens = profile.get_intrinsic(), profile.get_distortion()
    distortion = (lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6)
    return CameraModel(
        found.width, found.height, found.fx, found.fy, found.cx, found.cy, distortion if any(distortion) else ()
    )
