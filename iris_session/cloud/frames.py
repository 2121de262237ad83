"""Frames of a depth camera, and the interface of the sources that give them.

The sources themselves are in `iris_session.cloud.sources`.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from anchors.camera import CameraModel
from iris_session.protocol.errors import IrisError


class SourceError(IrisError):
    """A source cannot be opened, or gives no more frames. The message is one line for people."""


class SourceEndedError(SourceError):
    """The recording is over and does not begin anew."""


class DepthFrame(NamedTuple):
    """One frame of a depth camera.

    Attributes:
        depth: (height, width), along the camera's optical axis; 0 and 65,535 are no measurement.
        color: (height, width, 3), RGB, of the same pixels.
        capture_ns: Session time of the capture.
        T_world_camera: (4, 4), from the camera's optical frame (x right, y down, z forward) to the world, where the
            source knows it; None: as configured.
    """

    depth: npt.NDArray[np.uint16]
    color: npt.NDArray[np.uint8]
    capture_ns: int
    T_world_camera: npt.NDArray[np.float64] | None = None


class SourceFrame(NamedTuple):
    """A frame with what its source says of all of them: intrinsics, and the length of one unit of depth [m]."""

    frame: DepthFrame
    camera: CameraModel
    depth_scale_m: float


class DepthSource(Protocol):
    """A camera or a recording.

    Attributes:
        camera: Intrinsics of its frames.
        depth_scale_m: Length of one unit of `DepthFrame.depth` [m].
        recorded_hz: Frames per second of a recording by their times, 0 while it is not known, and of cameras.
    """

    camera: CameraModel
    depth_scale_m: float

    @property
    def recorded_hz(self) -> float: ...

    def read(self, timeout_s: float) -> DepthFrame | None:
        """Return the next frame, or None if none came in time.

        Args:
            timeout_s: Longest wait [s].

        Raises:
            SourceEndedError: The recording is over.
            SourceError: The source failed; close it, open it anew.
        """
        ...

    def close(self) -> None:
        """Release the device or file."""
        ...
