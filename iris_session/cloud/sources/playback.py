"""Parts that sources share: playing a recording by the session's clock, pairing depth with colour, pictures,
choosing among devices.

A recording waits for a reader that is late: it is played more slowly, and no frame is skipped.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from statistics import median
from typing import Any, Final, Generic, Literal, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from anchors.camera import CameraModel
from iris_session.cloud.camera_file import CameraSettings
from iris_session.cloud.frames import DepthFrame, SourceEndedError, SourceError
from iris_session.protocol.media import MAX_IMAGE_SIZE
from iris_session.protocol.names import AssetEncoding
from iris_session.scene import AssetDecodeError
from iris_session.scene.images import read_stated_size

T = TypeVar("T")
_PNG: Final = b"\x89PNG"
SECOND: Final = 10**9
#: Rate of what has no times of its own [Hz].
DEFAULT_HZ: Final = 30.0
#: Depth and colour of one frame are captured within this time.
PAIR_NS: Final = 50_000_000
#: Frames by which the rate of a recording is known.
RATE_FRAMES: Final = 30
#: Jitter of a reader: one that is late by more is waited for.
LATE_NS: Final = 50_000_000


class RecordedPicture(NamedTuple, Generic[T]):
    """A picture of a recording, not decoded: its time in the recording, and of which kind it is."""

    t_ns: int
    kind: Literal["depth", "color"]
    content: T


class RecordingSource(ABC, Generic[T]):
    """A source that plays a recording at the rate of its times. Subclasses set `camera` and `depth_scale_m`.

    Args:
        settings: The camera.
        now_ns: Session time.
        sleep: Waits [s].

    Raises:
        SourceError: There are no frames.
    """

    camera: CameraModel
    depth_scale_m: float

    def __init__(
        self, settings: CameraSettings, now_ns: Callable[[], int], sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._now_ns, self._sleep, self._name, self._loop = now_ns, sleep, settings.path, settings.loop
        self._offset_ns: int | None = None  # session time minus time in the recording
        self._interval_ns = round(SECOND / DEFAULT_HZ)
        self._intervals: deque[int] = deque(maxlen=RATE_FRAMES)
        self._frames = self._list_frames()
        self._next = next(self._frames, None)
        if self._next is None:
            raise SourceError(f"{self._name} has no frames")

    @abstractmethod
    def _list_frames(self) -> Iterator[tuple[int, T]]:
        """Begin anew: yield frames with their times in the recording [ns], in order of these."""

    @abstractmethod
    def _decode_frame(self, content: T, capture_ns: int) -> DepthFrame:
        """Return a frame. Raises `SourceError`."""

    def read(self, timeout_s: float) -> DepthFrame | None:
        """Return the next frame, captured at the session time at which it was due; see `DepthSource`."""
        if self._next is None:
            raise SourceEndedError(f"{self._name} is over: loop = true plays it again")
        now_ns = self._now_ns()
        if self._offset_ns is None or now_ns - (self._next[0] + self._offset_ns) > LATE_NS:
            self._offset_ns = now_ns - self._next[0]
        wait_s = (self._next[0] + self._offset_ns - now_ns) / SECOND
        if wait_s > 0.0:
            self._sleep(min(wait_s, timeout_s))
        return None if wait_s > timeout_s else self._decode_frame(*self._take(self._next, self._offset_ns))

    @property
    def recorded_hz(self) -> float:
        """Frames per second by their times, 0 before the first. Pauses between them do not count."""
        return SECOND / median(self._intervals) if self._intervals else 0.0

    def close(self) -> None:
        """Close the file that is read. Nothing is due afterwards."""
        self._frames, self._next, self._loop = iter(()), None, False

    def _take(self, present: tuple[int, T], offset_ns: int) -> tuple[T, int]:
        """Return the present frame and when it is due, and look at the one after it."""
        t_ns, content = present
        due_ns = t_ns + offset_ns
        self._next = next(self._frames, None)
        if self._next is not None:
            self._interval_ns = max(self._next[0] - t_ns, 0) or self._interval_ns
            self._intervals.append(self._interval_ns)
        elif self._loop:
            self._frames = self._list_frames()
            self._next = next(self._frames, None)
            if self._next is not None:
                self._offset_ns = due_ns + self._interval_ns - self._next[0]
        return content, due_ns


def resample(frames: Iterator[tuple[int, T]], hz: float) -> Iterator[tuple[int, T]]:
    """Yield frames with the times of a given rate [Hz] in place of theirs; 0: with theirs."""
    for number, (t_ns, frame) in enumerate(frames):
        yield (round(number * SECOND / hz) if hz else t_ns), frame


def pair_pictures(messages: Iterable[RecordedPicture[T]]) -> Iterator[tuple[int, tuple[T, T]]]:
    """Yield depth with colour of the same time, and the time of the depth.

    Args:
        messages: In order of their times.
    """
    found: dict[str, RecordedPicture[T]] = {}
    for message in messages:
        found[message.kind] = message
        if len(found) < 2:
            continue
        depth, color = found["depth"], found["color"]
        if abs(depth.t_ns - color.t_ns) <= PAIR_NS:
            found.clear()
            yield depth.t_ns, (depth.content, color.content)
        else:
            del found["color" if message.kind == "depth" else "depth"]


def choose_channel(kind: str, wanted: str, there: Iterable[str], name: str) -> str:
    """Return the topic or entity of the depth or colour pictures.

    Args:
        kind: Key in the camera file, `depth` or `color`.
        wanted: Its value, empty: the only one that is there.
        there: Those of the recording.
        name: Of the recording, for errors.

    Raises:
        SourceError: It is not there, or there are several to choose from.
    """
    names = sorted(set(there))
    if not names:
        raise SourceError(f"{name} has no {kind} pictures")
    if wanted in names or (not wanted and len(names) == 1):
        return wanted or names[0]
    wrong = f"{kind} {wanted!r} is not in {name}" if wanted else f"{name} has several {kind} pictures"
    raise SourceError(f"{wrong}: give {kind} as one of {', '.join(names)}")


def decode_picture(data: Any, name: str) -> npt.NDArray[Any]:
    """Return the pixels of a PNG or JPEG as OpenCV reads them: one channel, or blue, green, red.

    Raises:
        SourceError: It is neither, is damaged, or states a size above `MAX_IMAGE_SIZE`: some bytes can claim any size.
    """
    import cv2

    head = bytes(data)
    try:
        size = read_stated_size(head, AssetEncoding.PNG if head[:4] == _PNG else AssetEncoding.JPEG)
    except AssetDecodeError as error:
        raise SourceError(f"{name} is not a readable PNG or JPEG ({len(head)} bytes)") from error
    if max(size) > MAX_IMAGE_SIZE:
        raise SourceError(
            f"{name} is a picture of {size[0]} x {size[1]}: at most {MAX_IMAGE_SIZE} x {MAX_IMAGE_SIZE} are read"
        )
    try:
        picture: Any = cv2.imdecode(np.frombuffer(head, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise SourceError(f"{name} is a damaged picture: {' '.join(str(error).split())}") from error
    if picture is None:
        raise SourceError(f"{name} is not a readable picture ({len(head)} bytes)")
    return np.asarray(picture)


def to_rgb(picture: npt.NDArray[Any], name: str) -> npt.NDArray[np.uint8]:
    """Return a picture with one, three or four channels, as OpenCV reads it, as red, green, blue.

    Raises:
        SourceError: Its values are not 8 bits.
    """
    if picture.dtype != np.uint8:
        raise SourceError(f"{name} is {picture.shape} of {picture.dtype}: a colour picture has 8 bits a channel")
    if picture.ndim == 2:
        return np.repeat(picture[..., None], 3, axis=2)
    return np.ascontiguousarray(picture[..., 2::-1])


def to_depth(picture: npt.NDArray[Any], depth_scale_m: float, name: str) -> npt.NDArray[np.uint16]:
    """Return depth in units of `depth_scale_m`, from such units or from floating-point metres.

    Raises:
        SourceError: It is neither.
    """
    if picture.ndim == 2 and picture.dtype == np.uint16:
        return picture
    if picture.ndim == 2 and picture.dtype.kind == "f":
        units = np.rint(np.nan_to_num(picture, nan=0.0, posinf=0.0, neginf=0.0) / depth_scale_m)
        return np.where((units > 0.0) & (units < 65_535.0), units, 0.0).astype(np.uint16)
    raise SourceError(
        f"{name} is {picture.shape} of {picture.dtype}: depth has one channel of uint16, or of float32 in metres"
    )


def fit_color(color: npt.NDArray[np.uint8], depth: npt.NDArray[np.uint16], name: str) -> npt.NDArray[np.uint8]:
    """Return colour on the grid of the depth: it is registered, and may have another resolution of the same view.

    Raises:
        SourceError: The pictures have another ratio of width to height, so that they do not show the same view.
    """
    (h, w), (height, width) = color.shape[:2], depth.shape
    if (h, w) == (height, width):
        return color
    if h * width != w * height:
        raise SourceError(
            f"{name}: colour is {w} x {h}, depth {width} x {height}: they do not show the same view, register colour "
            "to depth"
        )
    rows = ((np.arange(height) + 0.5) * (h / height)).astype(np.intp)
    columns = ((np.arange(width) + 0.5) * (w / width)).astype(np.intp)
    return np.ascontiguousarray(color[rows[:, None], columns[None, :]])


def choose_device(kind: str, wanted: str, there: Mapping[str, str]) -> str:
    """Return the serial number of a device.

    Args:
        kind: Kind of the device, for errors.
        wanted: Its serial number, empty: the only one.
        there: Names of the devices that are there, by serial number.

    Raises:
        SourceError: It is not there, or there are several to choose from.
    """
    if wanted in there or (not wanted and len(there) == 1):
        return wanted or next(iter(there))
    devices = ", ".join(f"{serial} ({name})" for serial, name in sorted(there.items()))
    if not there:
        raise SourceError(f"no {kind} camera is connected: check cable, power, and the vendor's udev rules")
    wrong = f"no {kind} camera has the serial number {wanted!r}" if wanted else f"{len(there)} {kind} cameras"
    raise SourceError(f"{wrong}: give path as one of {devices}")
