"""Faults of frames: each is found within a second, and is over when frames are good again."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from anchors.camera import CameraModel
from iris_session.cloud.frames import DepthFrame
from iris_session.cloud.health import CameraHealth
from iris_session.protocol.names import StreamFault

MS = 1_000_000
CAMERA = CameraModel(40, 30, 35.0, 35.0, 19.5, 14.5)


def make_frame(at_ms: int) -> DepthFrame:
    """Return a frame as of a sensor: no two are the same."""
    random = np.random.default_rng(at_ms)
    depth = (1500 + random.integers(0, 5, (30, 40))).astype(np.uint16)
    return DepthFrame(depth, np.full((30, 40, 3), 90, np.uint8), at_ms * MS, None)


class Watch:
    """A camera at 20 Hz."""

    def __init__(self, **options: bool) -> None:
        self.health = CameraHealth(20.0, **options)
        self.health.restart(0)
        self.now_ms = 0

    def run(self, ms: int, change: Callable[[DepthFrame], DepthFrame] = lambda frame: frame, hz: int = 20) -> str:
        """Give frames for a while. Return the fault after it."""
        until = self.now_ms + ms
        while self.now_ms < until:
            self.now_ms += 1000 // hz
            self.health.check_frame(change(make_frame(self.now_ms)), CAMERA, self.now_ms * MS)
        return self.fault()

    def fault(self) -> str:
        found = self.health.find_fault(self.now_ms * MS)
        if found is None:
            return ""
        assert found.detail
        assert "\n" not in found.detail
        return found.fault


def without_depth(frame: DepthFrame) -> DepthFrame:
    return frame._replace(depth=np.zeros_like(frame.depth))


def saturated(frame: DepthFrame) -> DepthFrame:
    return frame._replace(depth=np.full_like(frame.depth, 0xFFFF))


def frozen(frame: DepthFrame) -> DepthFrame:
    return make_frame(7)._replace(capture_ns=frame.capture_ns)


def of_other_size(frame: DepthFrame) -> DepthFrame:
    return frame._replace(color=np.zeros((60, 80, 3), np.uint8))


def of_other_intrinsics(frame: DepthFrame) -> DepthFrame:
    return frame._replace(depth=np.ones((60, 80), np.uint16), color=np.zeros((60, 80, 3), np.uint8))


def without_pose(frame: DepthFrame) -> DepthFrame:
    return frame._replace(T_world_camera=np.full((4, 4), np.nan))


def in_future(frame: DepthFrame) -> DepthFrame:
    return frame._replace(capture_ns=frame.capture_ns + 400 * MS)


def going_back(frame: DepthFrame) -> DepthFrame:
    return frame._replace(capture_ns=-frame.capture_ns)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (without_depth, StreamFault.NO_DEPTH),
        (saturated, StreamFault.SATURATED),
        (frozen, StreamFault.FROZEN),
        (of_other_size, StreamFault.SIZE),
        (of_other_intrinsics, StreamFault.SIZE),
        (without_pose, StreamFault.POSE),
        (in_future, StreamFault.CLOCK),
        (going_back, StreamFault.CLOCK),
    ],
)
def test_a_fault_is_found_within_a_second_and_clears(change: Callable[[DepthFrame], DepthFrame], fault: str) -> None:
    watch = Watch()
    assert watch.run(3000) == ""
    assert watch.run(1050, change) == fault
    assert watch.run(2050) == ""


def test_single_bad_frames_are_no_fault() -> None:
    watch = Watch()
    for _ in range(5):
        assert watch.run(500) == ""
        assert watch.run(100, without_depth) == ""


def test_pictures_of_a_rendered_world_may_be_the_same() -> None:
    assert Watch(has_noise=False).run(3000, frozen) == ""


def test_frames_that_cannot_be_used_are_refused() -> None:
    health = CameraHealth(20.0)
    assert health.check_frame(make_frame(1), CAMERA, MS)
    assert not health.check_frame(of_other_size(make_frame(2)), CAMERA, 2 * MS)
    assert not health.check_frame(without_pose(make_frame(3)), CAMERA, 3 * MS)
    assert health.check_frame(without_depth(make_frame(4)), CAMERA, 4 * MS)


def test_a_rate_far_below_what_is_asked_for() -> None:
    watch = Watch()
    assert watch.run(4000, hz=10) == "", "half of it is a camera that has no more"
    assert watch.run(4000, hz=5) == StreamFault.SLOW
    assert watch.run(3000) == ""


def test_the_rate_of_a_recording_is_enough_and_half_of_it_is_not() -> None:
    watch = Watch()
    watch.health.limit_rate(5.0)
    assert watch.run(5000, hz=5) == ""
    assert watch.run(5000, hz=1) == StreamFault.SLOW
    watch.health.limit_rate(0.0)
    assert watch.run(4000, hz=5) == StreamFault.SLOW, "20 frames per second are asked for"


def test_a_source_that_stops() -> None:
    watch = Watch()
    watch.run(1000)
    watch.now_ms += 900
    assert watch.fault() != StreamFault.SOURCE
    watch.now_ms += 200
    assert watch.fault() == StreamFault.SOURCE
    watch.run(50)
    assert watch.fault() != StreamFault.SOURCE
