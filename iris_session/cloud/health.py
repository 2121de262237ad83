"""Faults of the frames of one camera, as they can be seen in the frames. Pure: times are arguments.

A fault that makes a frame unusable (`size`, `pose`) is reported with the frame; one that a single bad frame may have is
reported when it has lasted, and within a second; a low rate by those of two seconds or three periods. All clear when
frames are good again, `clock` two seconds later.
"""

from __future__ import annotations

import zlib
from collections import deque
from typing import Final, NamedTuple

import numpy as np

from anchors.camera import CameraModel
from iris_session.cloud.frames import DepthFrame
from iris_session.protocol.names import StreamFault

MILLISECOND: Final = 1_000_000
SECOND: Final = 1_000_000_000
#: The same picture for this long: no sensor sees the same twice, because of its noise.
FROZEN_NS: Final = SECOND
#: A picture without depth for this long: a single one may be a hand before the lens.
LASTING_NS: Final = 300 * MILLISECOND
#: A jump of the clock is shown for this long: it is over with the next frame.
CLOCK_SHOWN_NS: Final = 2 * SECOND
#: Capture times lie in the future by the error of the clocks at most.
FUTURE_NS: Final = 50 * MILLISECOND
#: Time over which the rate is measured, at least; and the least share of the rate that is asked for.
RATE_NS: Final = 2 * SECOND
LEAST_RATE: Final = 0.4
#: Without a frame for this long, and for three periods, a source has stopped.
STOPPED_NS: Final = SECOND
#: Share of the pixels.
LEAST_MEASURED: Final = 0.001
MOST_SATURATED: Final = 0.9
_SATURATED: Final = 0xFFFF
MAX_FRAMES: Final = 512


class Fault(NamedTuple):
    """A fault of a stream: a `StreamFault`, and one line for people."""

    fault: str
    detail: str


class CameraHealth:
    """Look for faults in the frames of one camera.

    Args:
        hz: Frames per second that the camera is asked for, 0 for any.
        has_noise: No two pictures are the same, as with every sensor. Rendered pictures of a world at rest are.
    """

    def __init__(self, hz: float, *, has_noise: bool = True) -> None:
        self._asked_hz = self._hz = hz
        self._has_noise = has_noise
        self.restart(0)

    def restart(self, now_ns: int) -> None:
        """Forget the frames so far: the source was opened anew, or the clock is another one."""
        self._began_ns = now_ns
        self._arrivals: deque[int] = deque(maxlen=MAX_FRAMES)
        self._captured_ns: int | None = None
        self._picture = 0
        self._same_since_ns: int | None = None
        self._bad: Fault | None = None
        self._bad_since_ns = 0
        self._unusable: Fault | None = None
        self._clock: Fault | None = None
        self._clock_ns = 0

    def limit_rate(self, recorded_hz: float) -> None:
        """Expect no more frames per second than a recording has; 0: that is not known."""
        self._hz = min(self._asked_hz, recorded_hz or self._asked_hz)

    def check_frame(self, frame: DepthFrame, camera: CameraModel, now_ns: int) -> bool:
        """Look at a frame.

        Args:
            frame: The frame.
            camera: Intrinsics of its source.
            now_ns: Session time [ns].

        Returns:
            False: the frame cannot be used.
        """
        self._arrivals.append(now_ns)
        self._check_clock(frame.capture_ns, now_ns)
        self._unusable = find_size_fault(frame, camera) or find_pose_fault(frame)
        if self._unusable is not None:
            return False
        bad = find_depth_fault(frame)
        if bad is None or self._bad is None or bad.fault != self._bad.fault:
            self._bad_since_ns = now_ns
        self._bad = bad
        picture = zlib.crc32(np.ascontiguousarray(frame.color).data, zlib.crc32(np.ascontiguousarray(frame.depth).data))
        if self._same_since_ns is None or picture != self._picture:
            self._picture, self._same_since_ns = picture, now_ns
        return True

    def find_fault(self, now_ns: int) -> Fault | None:
        """Return the fault now, the one that explains most; `None` while all is well."""
        if self._unusable is not None:
            return self._unusable
        stopped = self._find_stop(now_ns)
        if stopped is not None:
            return stopped
        if self._bad is not None and now_ns - self._bad_since_ns >= LASTING_NS:
            return self._bad
        if self._has_noise and self.arrived_ns is not None and self._same_since_ns is not None:
            same_ns = self.arrived_ns - self._same_since_ns  # one picture of a slow camera is not frozen
            if same_ns >= FROZEN_NS:
                return Fault(StreamFault.FROZEN, f"the same picture for {same_ns / SECOND:.0f} s")
        if self._clock is not None and now_ns - self._clock_ns < CLOCK_SHOWN_NS:
            return self._clock
        return self._find_slowness(now_ns)

    @property
    def arrived_ns(self) -> int | None:
        """Session time of the newest frame [ns]."""
        return self._arrivals[-1] if self._arrivals else None

    def measure_hz(self, now_ns: int) -> float:
        """Return the rate of the frames over the last `RATE_NS`, or three periods."""
        recent = [at for at in self._arrivals if now_ns - at < self._window_ns]
        return len(recent) / (self._window_ns / SECOND)

    @property
    def _window_ns(self) -> float:
        return max(RATE_NS, 3.0 * SECOND / self._hz if self._hz else 0.0)

    def _check_clock(self, capture_ns: int, now_ns: int) -> None:
        before_ns, self._captured_ns = self._captured_ns, capture_ns
        detail = ""
        if capture_ns - now_ns > FUTURE_NS:
            detail = f"a frame was captured {(capture_ns - now_ns) / MILLISECOND:.0f} ms in the future"
        elif before_ns is not None and capture_ns < before_ns:
            detail = f"capture times went back by {(before_ns - capture_ns) / MILLISECOND:.0f} ms"
        if detail:
            self._clock, self._clock_ns = Fault(StreamFault.CLOCK, detail), now_ns

    def _find_stop(self, now_ns: int) -> Fault | None:
        """Return a fault when no frames come any more."""
        newest_ns = self._began_ns if self.arrived_ns is None else self.arrived_ns
        silence_ns = now_ns - newest_ns
        if silence_ns <= max(STOPPED_NS, 3.0 * SECOND / self._hz if self._hz else 0.0):
            return None
        return Fault(StreamFault.SOURCE, f"no frame for {silence_ns / SECOND:.0f} s")

    def _find_slowness(self, now_ns: int) -> Fault | None:
        if now_ns - self._began_ns < self._window_ns or not self._hz:
            return None
        hz = self.measure_hz(now_ns)
        if hz >= LEAST_RATE * self._hz:
            return None
        return Fault(StreamFault.SLOW, f"{hz:.1f} frames per second come, {self._hz:g} are asked for")


def find_size_fault(frame: DepthFrame, camera: CameraModel) -> Fault | None:
    """Return a fault when depth, colour and intrinsics are not of one size."""
    depth, color, model = frame.depth.shape, frame.color.shape, (camera.height, camera.width)
    if depth == model and color == (*model, 3):
        return None
    sizes = [" x ".join(map(str, shape[1::-1])) for shape in (depth, color, model)]
    return Fault(StreamFault.SIZE, f"depth is {sizes[0]}, colour {sizes[1]}, intrinsics {sizes[2]}: all must be equal")


def find_pose_fault(frame: DepthFrame) -> Fault | None:
    """Return a fault when the pose that a frame brings is not one."""
    pose = frame.T_world_camera
    if pose is None or np.isfinite(pose).all():
        return None
    return Fault(StreamFault.POSE, "the pose of the camera has numbers that are not finite")


def find_depth_fault(frame: DepthFrame) -> Fault | None:
    """Return a fault when a depth picture measures nothing."""
    saturated = np.count_nonzero(frame.depth == _SATURATED) / frame.depth.size
    if saturated >= MOST_SATURATED:
        detail = f"{100.0 * saturated:.0f} % of the depth is saturated: is the lens covered, or the room too bright?"
        return Fault(StreamFault.SATURATED, detail)
    measured = np.count_nonzero(frame.depth) / frame.depth.size - saturated
    if measured < LEAST_MEASURED:
        return Fault(StreamFault.NO_DEPTH, "no pixel has a depth: is the projector on, and the scene within range?")
    return None
