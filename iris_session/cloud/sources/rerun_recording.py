"""A depth camera in a Rerun file: `DepthImage` or `EncodedDepthImage`, with `Image` or `EncodedImage` of colour.

Intrinsics are those of a `Pinhole` on the entity of the depth or above it, unless the camera file has them.
"""

from __future__ import annotations

import heapq
import warnings
from collections.abc import Callable, Iterator
from typing import Any, Final

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

#: Archetypes of each kind of picture.
_KINDS: Final = {"depth": ("DepthImage", "EncodedDepthImage"), "color": ("Image", "EncodedImage")}
#: Rerun's `ChannelDatatype`.
_TYPES: Final = {6: np.uint8, 8: np.uint16, 33: np.float16, 34: np.float32, 35: np.float64}
#: Rerun's `ColorModel`: its channels as OpenCV orders them.
_CHANNELS: Final = {1: [0], 2: [2, 1, 0], 3: [2, 1, 0], 4: [0, 1, 2], 5: [0, 1, 2]}
#: Number of channels of those.
_N_CHANNELS: Final = {1: 1, 2: 3, 3: 4, 4: 3, 5: 4}


class RerunSource(RecordingSource[tuple[Any, Any]]):
    """Plays a Rerun file, chunk by chunk, twice: once for depth, once for colour.

    Times are those of the first timeline that is not `log_time`, else of `log_time`.
    """

    def __init__(self, settings: CameraSettings, now_ns: Callable[[], int]) -> None:
        require_package("rerun", "a Rerun recording")
        require_package("cv2", "a Rerun recording of pictures")
        self._path, self._hz = settings.path, settings.hz
        kinds: dict[str, set[str]] = {"depth": set(), "color": set()}
        pinholes: dict[str, Any] = {}
        self._meter = 0.0  # units of depth in a metre
        for chunk in self._read_chunks():
            batch = chunk.to_record_batch()
            for kind, archetypes in _KINDS.items():
                if any(f"{one}:{part}" in batch.schema.names for one in archetypes for part in ("buffer", "blob")):
                    kinds[kind].add(chunk.entity_path)
            if "Pinhole:image_from_camera" in batch.schema.names:
                pinholes.setdefault(chunk.entity_path, batch)
            names = ("DepthImage:meter", "EncodedDepthImage:meter")
            self._meter = self._meter or _read_value(batch, names, 0) or 0.0
        self._depth = choose_channel("depth", settings.depth, kinds["depth"], self._path)
        self._color = choose_channel("color", settings.color, kinds["color"], self._path)
        # Depth in whole metres is depth in numbers with a point.
        self.depth_scale_m = settings.depth_scale_m or (1.0 / self._meter if self._meter > 1.0 else 0.001)
        self.camera = settings.intrinsics or self._find_camera(pinholes)
        super().__init__(settings, now_ns)

    def _decode_frame(self, content: tuple[Any, Any], capture_ns: int) -> DepthFrame:
        depth, color = content
        pixels = _decode(depth, "depth", self._path)
        if pixels.dtype.kind == "f":
            pixels = pixels / (self._meter or 1.0)
        units = to_depth(pixels, self.depth_scale_m, f"{self._path}: {self._depth}")
        rgb = to_rgb(_decode(color, "color", self._path), f"{self._path}: {self._color}")
        return DepthFrame(units, fit_color(rgb, units, self._path), capture_ns)

    def _read_chunks(self, entity: str = "") -> Iterator[Any]:
        """Yield the chunks of one entity, or of all."""
        from rerun.chunk import RrdReader

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a file without a footer: its recorder was killed
                stream = RrdReader(self._path).stream()
            yield from stream.filter(content=entity) if entity else stream
        except (OSError, RuntimeError, ValueError) as error:
            raise SourceError(f"{self._path} cannot be read: {' '.join(str(error).split())}") from error

    def _list_frames(self) -> Iterator[tuple[int, tuple[Any, Any]]]:
        both = (self._list_pictures("depth", self._depth), self._list_pictures("color", self._color))
        return resample(pair_pictures(heapq.merge(*both, key=lambda one: one.t_ns)), self._hz)

    def _list_pictures(self, kind: Any, entity: str) -> Iterator[RecordedPicture[Any]]:
        """Yield the pictures of an entity, as a batch and its row."""
        names = [f"{one}:{part}" for one in _KINDS[kind] for part in ("buffer", "blob")]
        for chunk in self._read_chunks(entity):
            batch = chunk.to_record_batch()
            found = next((name for name in names if name in batch.schema.names), None)
            timelines = sorted(chunk.timeline_names, key=lambda name: (name == "log_time", name))
            if found is None or not timelines:
                continue
            times = batch.column(timelines[0]).cast("int64").to_numpy(zero_copy_only=False)
            for row in range(batch.num_rows):
                yield RecordedPicture(int(times[row]), kind, (batch, found, row))

    def _find_camera(self, pinholes: dict[str, Any]) -> CameraModel:
        entity = self._depth
        while entity and entity not in pinholes:
            entity = entity.rpartition("/")[0]
        if not entity:
            raise SourceError(f"{self._path} has no Pinhole at {self._depth}: give intrinsics")
        matrix = _read_value(pinholes[entity], ("Pinhole:image_from_camera",), 0)
        size = _read_value(pinholes[entity], ("Pinhole:resolution",), 0)
        if size is None:
            raise SourceError(f"{self._path}: the Pinhole at {entity} has no resolution: give intrinsics")
        try:  # a matrix by columns
            return CameraModel(int(size[0]), int(size[1]), matrix[0], matrix[4], matrix[6], matrix[7])
        except CameraError as error:
            raise SourceError(f"{self._path}: the Pinhole at {entity}: {error}") from error


def _read_value(batch: Any, names: tuple[str, ...], row: int) -> Any:
    """Return the first value of the first of these columns that is there, None if there is none."""
    for name in names:
        if name in batch.schema.names:
            values = batch.column(name)[row].as_py()
            if values:
                return values[0]
    return None


def _decode(content: tuple[Any, str, int], kind: str, name: str) -> npt.NDArray[Any]:
    """Return the pixels of a picture as OpenCV orders them."""
    batch, column, row = content
    archetype, _, part = column.partition(":")
    values = batch.column(column)[row].values
    data = values[0].values.to_numpy() if values is not None and len(values) else np.empty(0, np.uint8)
    if part == "blob":
        return decode_picture(data, f"{name}: {archetype}")
    layout = _read_value(batch, (f"{archetype}:format",), row)
    if layout is None or layout["pixel_format"] is not None or layout["channel_datatype"] not in _TYPES:
        raise SourceError(f"{name}: {archetype} has format {layout}: raw pixels of 8, 16 or 32 bits are read")
    model = 1 if kind == "depth" else layout["color_model"] or 1
    shape = (layout["height"], layout["width"], _N_CHANNELS[model])
    pixels = np.frombuffer(data, _TYPES[layout["channel_datatype"]])
    if pixels.size != np.prod(shape):
        raise SourceError(f"{name}: {archetype} has {data.size} bytes: its format is {shape} of {pixels.dtype}")
    return pixels.reshape(shape)[..., _CHANNELS[model]] if shape[2] > 1 else pixels.reshape(shape[:2])
