"""Point clouds and pictures of cameras in the file, as the viewer draws them.

A point is kept as float32 and whole bytes, which `decode_cloud` makes without rounding, so the frame itself is not kept
beside it. An image is kept as it came. What a stream is, its `StreamInfo`, is in an entity of its own. Rows are at the
time of capture on `session_time` and `wall_time` alone: a camera sees the room, which has no simulated time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import msgspec
import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]
import rerun as rr

from iris_session.protocol.codec import decode_media_header
from iris_session.protocol.media import MAX_IMAGE_SIZE, MAX_STREAMS, MediaHeader, StreamInfo, is_stream_name
from iris_session.protocol.names import AssetEncoding, BudgetClass, MediaEncoding
from iris_session.rrd import paths
from iris_session.scene import AssetDecodeError
from iris_session.scene.images import read_stated_size
from iris_session.streams.cloud import CloudFrame, decode_cloud
from iris_session.streams.errors import StreamError

#: Size of a point that stands for itself, in the viewer [px].
_POINT_PX: Final = 1.5
#: Folders of entities by the encodings that are recorded.
_FOLDERS: Final = {MediaEncoding.CLOUD: paths.CLOUDS, MediaEncoding.JPEG: paths.PICTURES}


class MediaDrawer:
    """Log clouds and pictures to a recording.

    `pictures`: streams of pictures so far, at most `MAX_STREAMS`. `origin_utc_ns`: see `SessionHeader`.
    """

    def __init__(self, recording: Any) -> None:
        self._rec = recording
        self.pictures: list[str] = []
        self.origin_utc_ns = 0

    def draw(self, message: Sequence[bytes]) -> None:
        """Log a message of `front.media.recorder`: a frame, a description, or both, or the end of a stream.

        Raises:
            StreamError: It is none of these, or the frame does not decode.
            ProtocolError: The header does not decode.
        """
        if len(message) != 3:
            raise StreamError(f"{len(message)} parts of a message: a header, a frame and an info are expected")
        header, (frame, info) = decode_media_header(message[0]), message[1:]
        if not is_stream_name(header.stream):  # it is a part of the name of an entity
            raise StreamError(f"{header.stream!r} is no name of a stream")
        if header.encoding not in _FOLDERS:
            raise StreamError(f"a frame of encoding {header.encoding!r} is not recorded: cloud and jpeg are")
        if info:
            self._describe(header, info)
        if header.budget_class != BudgetClass.NONE:
            if header.encoding == MediaEncoding.CLOUD:
                self._draw_cloud(header, decode_cloud(frame))
            else:
                self._draw_picture(header, frame)
        elif not info:
            self._describe(header, b"")
            self._log(_FOLDERS[header.encoding], header, rr.Clear(recursive=False))

    def _describe(self, header: MediaHeader, info: bytes) -> None:
        """Log the description of a stream; empty: it has ended."""
        try:
            msgspec.json.decode(info or b"{}", type=StreamInfo)  # it will be read back
        except msgspec.DecodeError as error:
            raise StreamError(f"the description of a stream: {error}") from None
        self._log(paths.STREAMS, header, rr.AnyValues(encoding=header.encoding, info=info.decode()))

    def _draw_cloud(self, header: MediaHeader, cloud: CloudFrame) -> None:
        radius = 0.5 * cloud.voxel_m if cloud.voxel_m else rr.components.Radius.ui_points(_POINT_PX)
        self._log(
            paths.CLOUDS,
            header,
            _make_times(header),
            rr.Points3D(cloud.positions, colors=cloud.colors, radii=[radius]),
            rr.AnyValues(
                error_m=pa.array([cloud.error_m], pa.float64()), voxel_m=pa.array([cloud.voxel_m], pa.float64())
            ),
        )

    def _draw_picture(self, header: MediaHeader, frame: bytes) -> None:
        _check_size(frame)
        if header.stream not in self.pictures and len(self.pictures) < MAX_STREAMS:
            self.pictures.append(header.stream)
        image = rr.EncodedImage(contents=frame, media_type="image/jpeg")
        self._log(paths.PICTURES, header, _make_times(header), image)

    def _log(self, folder: str, header: MediaHeader, *components: Any) -> None:
        # Times that cannot be, before the session or after the receipt, would stretch the time line.
        at_ns = max(0, min(header.capture_ns, header.received_ns))
        self._rec.set_time(paths.SESSION_TIME, duration=np.timedelta64(at_ns, "ns"))
        self._rec.set_time(paths.WALL_TIME, timestamp=np.datetime64(at_ns + self.origin_utc_ns, "ns"))
        self._rec.log(f"{folder}/{header.stream}", *components, strict=True)
        self._rec.reset_time()


def _make_times(header: MediaHeader) -> Any:
    names = ("seq", "capture_ns", "received_ns")
    return rr.AnyValues(**{name: pa.array([getattr(header, name)], pa.int64()) for name in names})


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
