"""Source of `bench cloud-stream`: points in motion, encoded and published by a process of its own."""

from __future__ import annotations

import time
from typing import Any, ClassVar, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.bench.plugins import POLL_S, Plugin
from iris_session.client import Client, CurveKeys
from iris_session.client.errors import NotConnectedError
from iris_session.cloud.pipeline import CLASSES
from iris_session.streams.cloud import encode_cloud, order_points
from iris_session.system.priority import lower_thread_priority

STREAM: Final = "room"
VOXEL_M: Final = 0.01
ERROR_M: Final = 0.01
#: Amplitude of the motion [m], its frequency [Hz], and its wave number [rad/m].
_SWING: Final = 0.15
_HZ: Final = 0.4
_WAVE: Final = 2.0
#: Red, green, blue of the walls and the floor.
_PAINT: Final = np.array(((215, 210, 200), (190, 200, 215), (130, 110, 90)))
_LOW, _HIGH = np.array(((-2.0, -2.0, 0.0), (2.0, 2.0, 2.4)), np.float32)


class SourceJob(msgspec.Struct, frozen=True):
    """Job of the source. `seed`: of the points."""

    points: int
    hz: int
    seed: int


class MovingCloud:
    """Points on the walls and the floor of a room, which swing: where they are depends on seed and frame only."""

    def __init__(self, points: int, seed: int) -> None:
        random = np.random.default_rng(seed)
        self._base = random.uniform(_LOW, _HIGH, (points, 3)).astype(np.float32)
        axis = random.integers(0, 3, points)
        self._base[np.arange(points), axis] = _LOW[axis]
        self._phase = _WAVE * self._base.sum(axis=1)
        self.colors = (_PAINT[axis] + random.integers(-12, 13, (points, 3))).astype(np.uint8)

    def compute_positions(self, t: float) -> NDArray[np.float32]:
        """Return the positions (n, 3) at a time [s]."""
        swing = np.sin(np.float32(2.0 * np.pi * _HZ * t) + self._phase) * np.float32(_SWING)
        return np.asarray(self._base + swing[:, None], np.float32)

    def sort(self, t: float) -> NDArray[np.float64]:
        """Return the positions at a time in the order of the points of a frame."""
        positions = self.compute_positions(t)
        return positions[order_points(positions.T, VOXEL_M)].astype(np.float64)

    def encode(self, t: float) -> dict[str, bytes]:
        """Return the frames at a time [s]."""
        return encode_cloud(self.compute_positions(t), self.colors, voxel_m=VOXEL_M, error_m=ERROR_M, classes=CLASSES)


class MediaPublisher(Plugin):
    """Plug-in that publishes clouds. `role`: in which it joins."""

    role: ClassVar[str]

    def __init__(self, job: Any) -> None:
        super().__init__(job)
        lower_thread_priority()  # of this thread and those that it starts, as in a camera process
        self._client: Client | None = None

    def connect(self, address: str, *keys: str) -> None:
        """Join a session, with the keys of an encrypted one."""
        curve = CurveKeys(*(key.encode() for key in keys)) if keys else None
        self._client = Client(address, role=self.role, name=self.role, alignment="not_needed", curve=curve)
        self._client.connect(30.0)
        nothing = encode_cloud(np.empty((0, 3)), np.empty((0, 3), np.uint8))
        until_s = time.monotonic() + 30.0
        while not self._client.media.publish(STREAM, nothing, encoding="cloud"):  # the first call connects
            if time.monotonic() > until_s:
                raise TimeoutError("the session takes no media")
            self._client.poll(POLL_S)

    def poll(self) -> None:
        """Keep the connection alive."""
        if self._client is None:
            super().poll()
        else:
            self._client.poll(POLL_S)

    def close(self) -> None:
        """Leave the session."""
        if self._client is not None:
            self._client.close()

    def publish(self, frames: dict[str, bytes], capture_ns: int) -> bool:
        """Publish a cloud. Return false if the link takes nothing, or the client is reconnecting."""
        assert self._client is not None
        try:
            return self._client.media.publish(STREAM, frames, capture_ns=capture_ns, encoding="cloud")
        except NotConnectedError:
            return False


class Source(MediaPublisher):
    """Publisher of a moving cloud."""

    job_type = SourceJob
    role = "source"

    def __init__(self, job: SourceJob) -> None:
        super().__init__(job)
        self._cloud = MovingCloud(job.points, job.seed)

    def run(self, seconds: float) -> dict[str, Any]:
        """Publish for some seconds. Return captures [ns] of the frames by number, and what their encoding took [ms]."""
        assert self._client is not None
        hz: int = self.job.hz
        captures: dict[int, int] = {}
        encode_ms, refused = [], 0
        begin = time.perf_counter()
        number = 0
        while (now := time.perf_counter()) < begin + seconds:
            if now < begin + number / hz:
                self._client.poll(begin + number / hz - now)
                continue
            capture_ns = self._client.session_now_ns()
            positions = self._cloud.compute_positions(number / hz)
            began_ns = time.perf_counter_ns()
            frames = encode_cloud(positions, self._cloud.colors, voxel_m=VOXEL_M, error_m=ERROR_M, classes=CLASSES)
            encode_ms.append((time.perf_counter_ns() - began_ns) * 1e-6)
            refused += not self.publish(frames, capture_ns)
            captures[number] = capture_ns
            # Frames without time for them are left out.
            number = max(number + 1, int((time.perf_counter() - begin) * hz))
        return {"captures": captures, "encode_ms": encode_ms, "refused": refused}
