"""A depth camera in an MCAP file: raw or compressed pictures of ROS 2 (`sensor_msgs`) or Foxglove.

Foxglove's messages are read as Protobuf or JSON. Intrinsics are those of the `CameraInfo` or `CameraCalibration` of
the size of the depth, unless the camera file has them. Times are those at which messages were logged.
"""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from anchors.camera import CameraError, CameraModel
from iris_session.cloud.camera_file import CameraSettings
from iris_session.cloud.frames import DepthFrame, SourceError
from iris_session.cloud.sources.playback import (
    RecordedPicture,
    RecordingSource,
    choose_channel,
    decode_picture,
    fit_color,
    pair_pictures,
    resample,
    to_depth,
    to_rgb,
)
from iris_session.system.extras import require_package

_RAW: Final = ("sensor_msgs/msg/Image", "foxglove.RawImage")
_COMPRESSED: Final = ("sensor_msgs/msg/CompressedImage", "foxglove.CompressedImage")
_CAMERA: Final = ("sensor_msgs/msg/CameraInfo", "foxglove.CameraCalibration")
#: Raw encodings: type, channels in OpenCV's order.
_DEPTHS: Final = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
_COLORS: Final = {
    "rgb8": [2, 1, 0],
    "bgr8": [0, 1, 2],
    "rgba8": [2, 1, 0, 3],
    "bgra8": [0, 1, 2, 3],
    "8UC3": [0, 1, 2],
    "mono8": [0],
}
#: Models of the lens that are OpenCV's, as `sensor_msgs/distortion_models.hpp` names them; empty: not said.
_LENSES: Final = ("", "plumb_bob", "rational_polynomial")
#: Of image_transport's `compressedDepth`: the bytes before the PNG.
_CONFIG_HEADER: Final = 12
#: Messages that are looked at to tell depth from colour, and for intrinsics.
_FIRST: Final = 500


class _RecordedCamera(NamedTuple):
    """Intrinsics of a topic. `lens`: distortion model; `model` has no distortion where that is none of OpenCV's."""

    topic: str
    model: CameraModel
    lens: str


class McapSource(RecordingSource[tuple[Any, Any]]):
    """Plays an MCAP file, message by message."""

    def __init__(self, settings: CameraSettings, now_ns: Callable[[], int]) -> None:
        for package in ("mcap", "mcap_ros2", "mcap_protobuf", "cv2"):
            require_package(package, "an MCAP recording")
        self._path, self._hz = settings.path, settings.hz
        self.depth_scale_m = settings.depth_scale_m or 0.001
        kinds: dict[str, set[str]] = {"depth": set(), "color": set()}
        cameras: list[_RecordedCamera] = []
        for number, (schema, topic, _, message) in enumerate(self._read_messages()):
            if schema in _CAMERA:
                cameras += _to_camera(topic, message)
            else:
                kinds["depth" if _is_depth(message) else "color"].add(topic)
            if number >= _FIRST:
                break
        self._depth = choose_channel("depth", settings.depth, kinds["depth"], self._path)
        self._color = choose_channel("color", settings.color, kinds["color"], self._path)
        super().__init__(settings, now_ns)
        self.camera = settings.intrinsics or self._choose_camera(cameras)

    def _decode_frame(self, content: tuple[Any, Any], capture_ns: int) -> DepthFrame:
        depth, color = content
        units = self._decode_depth(depth)
        rgb = to_rgb(_decode(color, f"{self._path}: {self._color}"), f"{self._path}: {self._color}")
        return DepthFrame(units, fit_color(rgb, units, self._path), capture_ns)

    def _decode_depth(self, message: Any) -> npt.NDArray[np.uint16]:
        name = f"{self._path}: {self._depth}"
        return to_depth(_decode(message, name), self.depth_scale_m, name)

    def _list_frames(self) -> Iterator[tuple[int, tuple[Any, Any]]]:
        return resample(pair_pictures(self._list_pictures()), self._hz)

    def _list_pictures(self) -> Iterator[RecordedPicture[Any]]:
        for _, topic, t_ns, message in self._read_messages([self._depth, self._color]):
            yield RecordedPicture(t_ns, "depth" if topic == self._depth else "color", message)

    def _read_messages(self, topics: list[str] | None = None) -> Iterator[tuple[str, str, int, Any]]:
        """Yield schema, topic, time and message of pictures and intrinsics, in order of their times."""
        from mcap.reader import make_reader
        from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
        from mcap_ros2.decoder import DecoderFactory as Ros2Decoders

        wanted = {*_RAW, *_COMPRESSED, *_CAMERA}
        decoders: dict[int, Callable[[bytes], Any]] = {}
        factories = (Ros2Decoders(), ProtobufDecoders())
        try:
            with open(self._path, "rb") as file:
                for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages(topics):
                    if schema is None or schema.name not in wanted:
                        continue
                    if channel.id not in decoders:
                        if channel.message_encoding == "json":
                            decoders[channel.id] = _decode_json
                        else:
                            found = (one.decoder_for(channel.message_encoding, schema) for one in factories)
                            decoders[channel.id] = next((one for one in found if one is not None), _refuse)
                    yield schema.name, channel.topic, message.log_time, decoders[channel.id](message.data)
        except OSError as error:
            raise SourceError(f"{self._path} cannot be read: {error.strerror}") from error
        except Exception as error:  # of four packages, each with errors of its own
            said = " ".join(str(error).split()) or type(error).__name__
            raise SourceError(f"{self._path} cannot be read ({said}): `mcap recover` repairs a damaged file") from error

    def _choose_camera(self, cameras: list[_RecordedCamera]) -> CameraModel:
        """Return the intrinsics of the depth's size, of the topic that begins most like the depth's."""
        cameras.sort(key=lambda one: -len(os.path.commonpath([one.topic.strip("/"), self._depth.strip("/")])))
        for _, (depth, _) in self._list_frames():
            height, width = self._decode_depth(depth).shape
            found = next((one for one in cameras if (one.model.width, one.model.height) == (width, height)), None)
            if found is None:
                break
            if found.lens not in _LENSES:
                raise SourceError(
                    f"{self._path}: {found.topic} has the distortion model {found.lens!r}, and "
                    f"{' and '.join(_LENSES[1:])} are read: rectify the pictures and give intrinsics"
                )
            return found.model
        raise SourceError(f"{self._path} has no CameraInfo or CameraCalibration of the depth's size: give intrinsics")


def _decode_json(data: bytes) -> Any:
    """Return a message of Foxglove's JSON schemas; bytes are Base64 there."""
    found = json.loads(data)
    if "data" in found:
        found["data"] = base64.b64decode(found["data"])
    return SimpleNamespace(**found)


def _refuse(data: bytes) -> Any:
    raise ValueError(f"a message of {len(data)} bytes in an encoding that is not read: CDR, Protobuf and JSON are")


def _is_depth(message: Any) -> bool:
    if hasattr(message, "encoding"):
        return message.encoding in _DEPTHS
    form = message.format.lower()
    return "compresseddepth" in form or any(one.lower() in form for one in _DEPTHS) or _is_png16(bytes(message.data))


def _is_png16(data: bytes) -> bool:
    """Return true for a PNG of one channel of 16 bits (PNG specification, IHDR)."""
    return data[:8] == b"\x89PNG\r\n\x1a\n" and data[24:26] == b"\x10\x00"


def _decode(message: Any, name: str) -> npt.NDArray[Any]:
    """Return the pixels of a picture in OpenCV's order of channels."""
    if not hasattr(message, "encoding"):
        start = _CONFIG_HEADER if "compressedDepth" in message.format else 0
        return decode_picture(bytes(message.data)[start:], name)
    kind: Any = _DEPTHS.get(message.encoding, np.uint8)
    channels = [0] if message.encoding in _DEPTHS else _COLORS.get(message.encoding)
    if channels is None:
        raise SourceError(f"{name} has encoding {message.encoding!r}: {', '.join((*_DEPTHS, *_COLORS))} are read")
    data = np.frombuffer(message.data, np.uint8)
    used = message.width * len(channels) * np.dtype(kind).itemsize
    if message.step < used or data.size != message.step * message.height:
        raise SourceError(f"{name} has {data.size} bytes: its size is {message.width} x {message.height}")
    rows = np.ascontiguousarray(data.reshape(message.height, message.step)[:, :used])
    order = ">" if getattr(message, "is_bigendian", 0) else "<"
    pixels: npt.NDArray[Any] = rows.view(np.dtype(kind).newbyteorder(order)).astype(kind, copy=False)
    return pixels.reshape(message.height, message.width, -1)[..., channels] if len(channels) > 1 else pixels


def _to_camera(topic: str, message: Any) -> list[_RecordedCamera]:
    """Return the intrinsics of a message, none if they are those of no camera."""
    matrix, coefficients = (getattr(message, name, None) or getattr(message, name.lower(), None) for name in ("K", "D"))
    if matrix is None:
        return []
    lens = str(getattr(message, "distortion_model", ""))
    used = coefficients if lens in _LENSES and coefficients is not None and any(coefficients) else ()
    try:
        distortion = tuple(float(k) for k in used)
        size = message.width, message.height
        return [
            _RecordedCamera(topic, CameraModel(*size, matrix[0], matrix[4], matrix[2], matrix[5], distortion), lens)
        ]
    except CameraError:
        return []
