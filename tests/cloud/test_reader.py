"""Reading a source in a thread: the newest frame, failures, opening again, the end."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest

from iris_session.cloud.frames import SourceEndedError, SourceError
from iris_session.cloud.health import CameraHealth
from iris_session.cloud.reader import SourceReader
from iris_session.protocol.names import StreamFault
from tests.cloud.fake_source import CAMERA, FakeSource, make_frame, wait_until


class Lab:
    """A reader, and the sources that it has opened."""

    def __init__(self) -> None:
        self.sources: list[FakeSource] = []
        self.error: Exception | None = None
        self.reader = SourceReader("front", self._open, CameraHealth(0.0), time.monotonic_ns, threading.Event().set)

    def _open(self) -> FakeSource:
        if self.error is not None:
            raise self.error
        self.sources.append(FakeSource())
        return self.sources[-1]

    def fault(self) -> tuple[str, str]:
        found = self.reader.find_fault(time.monotonic_ns())
        return ("", "") if found is None else (found.fault, found.detail)


@pytest.fixture
def lab() -> Iterator[Lab]:
    lab = Lab()
    yield lab
    lab.reader.stop()
    assert lab.reader.join(60.0)
    assert all(source.closed for source in lab.sources)


def test_the_newest_frame_is_kept_and_the_others_are_counted(lab: Lab) -> None:
    lab.reader.start()
    wait_until(lambda: lab.sources)
    assert lab.reader.take_frame() is None
    times = [time.monotonic_ns() + i for i in range(3)]
    for at in times:
        lab.sources[0].put(make_frame(at))
    wait_until(lambda: lab.reader.superseded == 2)
    new = lab.reader.take_frame()
    assert new is not None
    assert (new.frame.capture_ns, new.camera, new.depth_scale_m) == (times[2], CAMERA, 0.001)
    assert lab.reader.take_frame() is None
    assert lab.fault() == ("", "")


def test_a_source_that_fails_is_closed_and_opened_again(lab: Lab) -> None:
    lab.reader.start()
    wait_until(lambda: lab.sources)
    lab.sources[0].put(SourceError("the cable\nis loose"))
    wait_until(lambda: lab.sources[0].closed)
    wait_until(lambda: lab.fault() == (StreamFault.SOURCE, "the cable is loose"))
    wait_until(lambda: len(lab.sources) == 2)
    assert lab.fault()[0] == StreamFault.SOURCE, "until a frame shows that it is over"
    lab.sources[1].put(make_frame(time.monotonic_ns()))
    wait_until(lambda: lab.fault() == ("", ""))
    assert lab.reader.failures == 1
    new = lab.reader.take_frame()
    assert new is not None


def test_any_error_of_a_driver_is_a_fault_of_its_source(lab: Lab) -> None:
    lab.error = RuntimeError("bus 3: 0x8007")
    lab.reader.start()
    wait_until(lambda: lab.fault() == (StreamFault.SOURCE, "RuntimeError: bus 3: 0x8007"))
    lab.error = None
    wait_until(lambda: lab.sources)


def test_a_recording_that_is_over_is_not_opened_again(lab: Lab) -> None:
    lab.reader.start()
    wait_until(lambda: lab.sources)
    lab.sources[0].put(SourceEndedError("room.mcap is over"))
    assert lab.reader.join(60.0)
    assert lab.fault() == (StreamFault.SOURCE, "room.mcap is over")
    assert len(lab.sources) == 1


def test_frames_that_cannot_be_used_are_counted_and_named(lab: Lab) -> None:
    lab.reader.start()
    wait_until(lambda: lab.sources)
    frame = make_frame(time.monotonic_ns())
    lab.sources[0].put(frame._replace(depth=frame.depth[:10]))
    wait_until(lambda: lab.reader.refused == 1)
    assert lab.reader.take_frame() is None
    assert lab.fault()[0] == StreamFault.SIZE


def test_another_clock_forgets_the_frames(lab: Lab) -> None:
    lab.reader.start()
    wait_until(lambda: lab.sources)
    lab.sources[0].put(make_frame(time.monotonic_ns()))
    wait_until(lambda: lab.reader.measure_hz(time.monotonic_ns()) > 0.0)
    lab.reader.restart_clock()
    assert lab.reader.take_frame() is None


def test_another_clock_opens_the_source_anew(lab: Lab) -> None:
    """A recording that is due by the old clock would be silent for as long as the old session ran."""
    lab.reader.start()
    wait_until(lambda: lab.sources)
    lab.reader.restart_clock()
    lab.sources[0].put(make_frame(1))  # of the old clock
    wait_until(lambda: len(lab.sources) == 2)
    assert lab.sources[0].closed
    assert lab.reader.take_frame() is None
    lab.sources[1].put(make_frame(time.monotonic_ns()))
    wait_until(lambda: lab.reader.measure_hz(time.monotonic_ns()) > 0.0)
    new = lab.reader.take_frame()
    assert new is not None
    assert lab.reader.failures == 0


def test_a_recording_is_expected_to_come_at_its_own_rate() -> None:
    now = [0]
    source = FakeSource(recorded_hz=5.0)
    health = CameraHealth(30.0)
    reader = SourceReader("front", lambda: source, health, lambda: now[0], threading.Event().set)
    reader.start()
    for number in range(1, 26):
        now[0] = number * 200_000_000
        source.put(make_frame(now[0]))
        wait_until(lambda: health.arrived_ns == now[0])
    assert reader.find_fault(now[0]) is None
    assert reader.measure_hz(now[0]) == 5.0
    reader.stop()
    assert reader.join(60.0)
