"""Pictures of cameras: the newest one of a media stream of encoding `jpeg`, decoded when you ask for it.

wrist = client.camera("wrist")
image = wrist.wait()  # or read(), which does not wait; uint8 (h, w, 3), RGB
"""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iris_session.client.errors import ClientError
from iris_session.client.media import ClientMedia, MediaFeed, MediaFrame
from iris_session.protocol.media import MAX_IMAGE_SIZE, StreamBudget, is_stream_name
from iris_session.protocol.names import MediaEncoding
from iris_session.system.extras import require_package

Picture = NDArray[np.uint8]
#: `Client.wait_for`.
Wait = Callable[[Callable[[Any], bool], float], bool]


class _Decoded(NamedTuple):
    frame: MediaFrame
    picture: Picture


class CameraFeed:
    """The newest picture of a camera. Use it from one thread.

    Pictures come at most at `hz`, and are left out where drawing, link or program are slower: always look at
    `capture_ns`.

    Attributes:
        name: Name of the camera.
        feed: The subscription: frames that came, and that our link did not take (`dropped`).
        decoded: Number of pictures that were decoded.
        undecodable: Number of frames that are no picture.
        fault: Why the newest frame is no picture; empty if it is one.
    """

    def __init__(
        self, name: str, feed: MediaFeed, media: ClientMedia, wait: Wait, session_now_ns: Callable[[], int]
    ) -> None:
        self.name = name
        self.feed = feed
        self.decoded = 0
        self.undecodable = 0
        self.fault = ""
        self._media = media
        self._wait_for = wait
        self._session_now_ns = session_now_ns
        self._seen: MediaFrame | None = None
        self._newest: _Decoded | None = None

    def read(self) -> Picture | None:
        """Return the newest picture, without waiting.

        Returns:
            uint8, shape (height, width, 3), RGB, read-only; `None` before the first. The same array until there is
            another.
        """
        frame = self.feed.newest
        if frame is not None and frame is not self._seen:
            self._seen = frame
            try:
                self._newest = _Decoded(frame, decode_jpeg(frame))
            except ValueError as error:
                self.undecodable += 1
                self.fault = str(error)
            else:
                self.decoded += 1
                self.fault = ""
        return None if self._newest is None else self._newest.picture

    def wait(self, timeout_s: float = 5.0) -> Picture:
        """Wait for a picture that is newer than the last one that was read.

        Args:
            timeout_s: Seconds to wait at most.

        Returns:
            As of `read`.

        Raises:
            ClientError: None came.
        """
        before = self._newest

        def is_there(_: object) -> bool:
            self.read()
            return self._newest is not before

        if not self._wait_for(is_there, timeout_s) or self._newest is None:
            why = self.fault or (self._budget.detail if self._budget is not None else "") or "the session sends none"
            raise ClientError(f"no picture of camera {self.name!r} within {timeout_s:g} s: {why}")
        return self._newest.picture

    @property
    def capture_ns(self) -> int | None:
        """Session time of the state that the newest picture shows [ns], `None` before the first."""
        self.read()
        return None if self._newest is None else self._newest.frame.header.capture_ns

    @property
    def age_ns(self) -> int | None:
        """Time since then [ns], `None` before the first picture."""
        capture_ns = self.capture_ns
        return None if capture_ns is None else self._session_now_ns() - capture_ns

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height [px], as stated by the source or as of the newest picture; `None` while not known."""
        budget = self._budget
        if budget is not None and budget.camera is not None:
            return budget.camera.width, budget.camera.height
        picture = self.read()
        return None if picture is None else (picture.shape[1], picture.shape[0])

    @property
    def hz(self) -> float:
        """Pictures a second that the source means to hold [Hz], 0 while not known."""
        return 0.0 if self._budget is None else self._budget.hz

    @property
    def skipped(self) -> int:
        """Number of pictures that came and were replaced by newer ones before they were decoded."""
        pending = self.feed.newest is not self._seen
        return max(0, self.feed.received - self.decoded - self.undecodable - pending)

    @property
    def _budget(self) -> StreamBudget | None:
        return _list_pictures(self._media).get(self.feed.stream)


def open_camera(
    media: ClientMedia, wait: Wait, session_now_ns: Callable[[], int], name: str, timeout_s: float
) -> CameraFeed:
    """Subscribe to the pictures of a camera, as `Client.camera` does.

    Raises:
        ClientError: The session offers no such camera within `timeout_s`; the text lists those that it does.
        MissingExtraError: Pillow is not installed.
    """
    require_package("PIL", "client.camera()")
    stream = name.replace("/", "_")
    if not is_stream_name(stream) or not wait(lambda _: stream in _list_pictures(media), timeout_s):
        known = ", ".join(map(_describe, _list_pictures(media).values()))
        raise ClientError(
            f"the session offers no pictures of a camera {name!r:.80}: it offers "
            f"{known or 'none; its owner chooses them, as with `iris-session serve SCENE --picture CAMERA`'}"
        )
    return CameraFeed(name, media.subscribe(stream), media, wait, session_now_ns)


def _list_pictures(media: ClientMedia) -> dict[str, StreamBudget]:
    delivery = media.delivery
    streams = () if delivery is None else delivery.streams
    return {one.stream: one for one in streams if one.encoding == MediaEncoding.JPEG}


def _describe(one: StreamBudget) -> str:
    size = "" if one.camera is None else f" ({one.camera.width}x{one.camera.height} at {one.hz:g} Hz)"
    return f"{one.stream}{size}"


def decode_jpeg(frame: MediaFrame) -> Picture:
    """Return the picture of a frame, read-only. Raises `ValueError` for one that is none, or too large."""
    from PIL import Image

    if frame.header.encoding != MediaEncoding.JPEG:
        raise ValueError(f"stream {frame.header.stream!r} has encoding {frame.header.encoding!r}: 'jpeg' is expected")
    try:
        with Image.open(io.BytesIO(frame.data), formats=("JPEG",)) as image:
            if max(image.size) > MAX_IMAGE_SIZE:
                raise ValueError(f"a picture of {image.size[0]} x {image.size[1]} pixels: at most {MAX_IMAGE_SIZE}")
            picture = np.array(image.convert("RGB"))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"{len(frame.data)} bytes that are no picture: {' '.join(str(error).split())}") from error
    picture.setflags(write=False)
    return picture
