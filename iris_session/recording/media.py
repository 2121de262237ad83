"""Point clouds and pictures of cameras in the file, as the viewer draws them.

A point is kept as float32 and whole bytes, which `decode_cloud` makes without rounding, so the frame itself is not kept
beside it. An image is kept as it came. Rows are at the time of capture on `session_time` alone: a camera sees the room,
which has no simulated time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]
import rerun as rr

from iris_session.protocol.codec import decode_media_header
from iris_session.protocol.media import MAX_IMAGE_SIZE, MAX_STREAMS, MediaHeader, is_stream_name
from iris_session.protocol.names import AssetEncoding, MediaEncoding
from iris_session.recording import paths
from iris_session.recording.scene_geometry import WORLD
from iris_session.scene import AssetDecodeError
from iris_session.scene.images import read_stated_size
from iris_session.streams.cloud import CloudFrame, decode_cloud
from iris_session.streams.errors import StreamError

#: Size of a point that stands for itself, in the viewer [px].
_POINT_PX: Final = 1.5


class MediaDrawer:
    """Log clouds and pictures to a recording. `pictures`: streams of pictures so far, at most `MAX_STREAMS`."""

    def __init__(self, recording: Any) -> None:
        self._rec = recording
        self.pictures: list[str] = []

    def draw(self, message: Sequence[bytes]) -> None:
        """Log one frame: an encoded `MediaHeader`, and the frame. Raises `StreamError` or `ProtocolError`."""
        if len(message) != 2:
            raise StreamError(f"{len(message)} parts of a frame: a header and a frame are expected")
        header, frame = decode_media_header(message[0]), message[1]
        if not is_stream_name(header.stream):  # it is a part of the name of an entity
            raise StreamError(f"{header.stream!r} is no name of a stream")
        if header.encoding == MediaEncoding.CLOUD:
            self._draw_cloud(header, decode_cloud(frame))
        elif header.encoding == MediaEncoding.JPEG:
            self._draw_picture(header, frame)
        else:
            raise StreamError(f"a frame of encoding {header.encoding!r} is not recorded: cloud and jpeg are")

    def _draw_cloud(self, header: MediaHeader, cloud: CloudFrame) -> None:
        radius = 0.5 * cloud.voxel_m if cloud.voxel_m else rr.components.Radius.ui_points(_POINT_PX)
        self._log(
            paths.CLOUDS,
            header,
            rr.CoordinateFrame(WORLD),
            rr.Points3D(cloud.positions, colors=cloud.colors, radii=[radius]),
            rr.AnyValues(
                error_m=pa.array([cloud.error_m], pa.float64()), voxel_m=pa.array([cloud.voxel_m], pa.float64())
            ),
        )

    def _draw_picture(self, header: MediaHeader, frame: bytes) -> None:
        _check_size(frame)
        if header.stream not in self.pictures and len(self.pictures) < MAX_STREAMS:
            self.pictures.append(header.stream)
        self._log(paths.PICTURES, header, rr.EncodedImage(contents=frame, media_type="image/jpeg"))

    def _log(self, folder: str, header: MediaHeader, *components: Any) -> None:
        times = {name: pa.array([getattr(header, name)], pa.int64()) for name in ("seq", "capture_ns", "received_ns")}
        # Times that cannot be, before the session or after the receipt, would stretch the time line.
        at_ns = max(0, min(header.capture_ns, header.received_ns))
        self._rec.set_time(paths.SESSION_TIME, duration=np.timedelta64(at_ns, "ns"))
        self._rec.log(f"{folder}/{header.stream}", *components, rr.AnyValues(**times), strict=True)
        self._rec.reset_time()


#: Beginning of a JPEG file in which its size has to be: a longer one could be filled with what is searched in vain.
HEAD_BYTES: Final = 65_536


def _check_size(frame: bytes) -> None:
    """Check that a JPEG file states a size that a viewer can allocate. Raises `StreamError`."""
    try:
        size = read_stated_size(frame[:HEAD_BYTES], AssetEncoding.JPEG)
    except AssetDecodeError as error:
        raise StreamError(str(error)) from None
    if not 1 <= min(size) <= max(size) <= MAX_IMAGE_SIZE:
        raise StreamError(f"an image of {size[0]} x {size[1]}: 1 to {MAX_IMAGE_SIZE} pixels are expected")
