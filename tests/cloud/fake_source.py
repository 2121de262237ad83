"""A source and a sink that the test moves, without threads and clocks."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from anchors.camera import CameraModel
from iris_session.cloud.frames import DepthFrame
from iris_session.protocol.media import StreamInfo

CAMERA = CameraModel(40, 30, 35.0, 35.0, 19.5, 14.5)


class FakeSource:
    """Returns what the test puts in; an error is raised.

    Attributes:
        closed: It was closed.
    """

    def __init__(self) -> None:
        self.camera = CAMERA
        self.depth_scale_m = 0.001
        self.recorded_hz = 0.0
        self.closed = False
        self._items: deque[DepthFrame | Exception] = deque()

    def put(self, *items: DepthFrame | Exception) -> None:
        self._items.extend(items)

    def read(self, timeout_s: float) -> DepthFrame | None:
        item = self._items.popleft() if self._items else None
        if isinstance(item, Exception):
            raise item
        return item

    def close(self) -> None:
        self.closed = True


def make_frame(capture_ns: int, depth_mm: int = 1500) -> DepthFrame:
    """Return a wall with noise."""
    random = np.random.default_rng(capture_ns % 2**32)
    depth = (depth_mm + random.integers(0, 3, (30, 40))).astype(np.uint16)
    return DepthFrame(depth, np.full((30, 40, 3), 90, np.uint8), capture_ns, None)


class FakeSink:
    """Keeps what was published. Its clock stands still until the test moves it.

    Attributes:
        takes: Whether it takes anything.
    """

    def __init__(self) -> None:
        self.published: list[tuple[str, bytes | Mapping[str, bytes], int, str, StreamInfo | None]] = []
        self.takes = True
        self.time_ns = 10**12

    def now_ns(self) -> int:
        return self.time_ns

    def publish(
        self, stream: str, frames: bytes | Mapping[str, bytes], capture_ns: int, encoding: str, info: StreamInfo | None
    ) -> bool:
        if self.takes:
            self.published.append((stream, frames, capture_ns, encoding, info))
        return self.takes

    def newest_info(self, stream: str) -> StreamInfo | None:
        """Return the last description of a stream."""
        return next((one[4] for one in reversed(self.published) if one[0] == stream and one[4] is not None), None)
