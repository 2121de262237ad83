"""Settings of a camera file by the test."""

from __future__ import annotations

from typing import Any

from iris_session.cloud.camera_file import CameraPose, CameraSettings, CloudSettings

POSE = CameraPose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


def make_settings(*names: str, **options: Any) -> CloudSettings:
    """Return the settings of cameras at the origin, without pictures by default."""
    cameras = tuple(CameraSettings(name=name, source="folder", pose=POSE, error_mm=10.0) for name in names)
    return CloudSettings(
        **{
            "stream": "room",
            "title": "Room",
            "hz": 30.0,
            "picture_hz": 0.0,
            "voxel_m": 0.08,
            **options,
        },
        cameras=cameras,
    )
