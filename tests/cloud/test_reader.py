"""Reading a source step by step: the newest frame, failures, opening again, the end; and its thread."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from iris_session.cloud.frames import SourceEndedError, SourceError
from iris_session.cloud.health import CameraHealth
from iris_session.cloud.reader import HEALTHY_FRAMES, REOPEN_S, SourceReader
from iris_session.protocol.names import StreamFault
from tests.cloud.fake_source import CAMERA, FakeSource, make_frame

DEADLINE_S = 60.0


class Lab:
    """A reader, and the sources that it has opened."""

    def __init__(self, hz: float = 0.0, make_source: Callable[[], FakeSource] = FakeSource) -> None:
        self.sources: list[FakeSource] = []
        self.error: Exception | None = None
        self.now_ns = 10**12
        self.frames = threading.Event()
        self._make_source = make_source
        self.reader = SourceReader("front", self._open, CameraHealth(hz), lambda: self.now_ns, self.frames.set)

    def _open(self) -> FakeSource:
        if self.error is not None:
            raise self.error
        self.sources.append(self._make_source())
        return self.sources[-1]

    def read(self, *items: Exception | int) -> float | None:
        """Let the open source give errors, and frames that were captured so much later [ns]. Return the last delay."""
        if not self.sources:
            self.reader.step()
        delay_s: float | None = 0.0
        for item in items:
            self.sources[-1].put(item if isinstance(item, Exception) else make_frame(self.now_ns + item))
            delay_s = self.reader.step()
        return delay_s

    def fault(self) -> tuple[str, str]:
        found = self.reader.find_fault(self.now_ns)
        return ("", "") if found is None else (found.fault, found.detail)


def test_the_newest_frame_is_kept_and_the_others_are_counted() -> None:
    lab = Lab()
    lab.read()
    assert lab.reader.take_frame() is None
    lab.read(0, 1, 2)
    new = lab.reader.take_frame()
    assert new is not None
    assert (new.frame.capture_ns, new.camera, new.depth_scale_m) == (lab.now_ns + 2, CAMERA, 0.001)
    assert lab.reader.take_frame() is None
    assert (lab.reader.superseded, lab.fault()) == (2, ("", ""))


@pytest.mark.parametrize(
    ("error", "detail"),
    [(SourceError("camera 'front': the cable\nis loose"), "the cable is loose"), (OSError("bus 3"), "OSError: bus 3")],
)
def test_a_source_that_fails_is_closed_and_opened_again(error: Exception, detail: str) -> None:
    lab = Lab()
    assert lab.read(error) == REOPEN_S[0]
    assert lab.sources[0].closed
    assert lab.fault() == (StreamFault.SOURCE, detail)
    lab.error = error
    assert lab.reader.step() == REOPEN_S[1], "it cannot be opened"
    lab.error = None
    assert lab.reader.step() == 0.0
    assert lab.fault()[0] == StreamFault.SOURCE, "until a frame shows that it is over"
    lab.read(*range(HEALTHY_FRAMES))
    assert lab.fault() == ("", "")
    assert (lab.reader.failures, len(lab.sources)) == (2, 2)
    assert lab.read(error) == REOPEN_S[0], "it was healthy"


def test_a_recording_that_is_over_is_not_opened_again() -> None:
    lab = Lab()
    assert lab.read(SourceEndedError("room.mcap is over")) is None
    assert lab.fault() == (StreamFault.SOURCE, "room.mcap is over")
    assert lab.sources[0].closed


def test_frames_that_cannot_be_used_are_counted_and_named() -> None:
    lab = Lab()
    lab.read()
    frame = make_frame(lab.now_ns)
    lab.sources[0].put(frame._replace(depth=frame.depth[:10]))
    lab.reader.step()
    assert (lab.reader.refused, lab.reader.take_frame()) == (1, None)
    assert lab.fault()[0] == StreamFault.SIZE


def test_another_clock_forgets_the_frames_and_opens_the_source_anew() -> None:
    """A recording that is due by the old clock would be silent for as long as the old session ran."""
    lab = Lab()
    lab.read(0)
    lab.reader.restart_clock()
    assert lab.reader.take_frame() is None
    assert lab.reader.step() == 0.0
    assert lab.sources[0].closed
    lab.read(0)
    assert lab.reader.take_frame() is not None
    assert (len(lab.sources), lab.reader.failures) == (2, 0)


def test_a_thread_reads_until_it_is_stopped() -> None:
    def make_source() -> FakeSource:
        source = FakeSource()
        source.put(make_frame(lab.now_ns))
        return source

    lab = Lab(make_source=make_source)
    lab.reader.start()
    assert lab.frames.wait(DEADLINE_S)
    assert lab.reader.take_frame() is not None
    lab.reader.stop()
    assert lab.reader.join(DEADLINE_S)
    assert lab.sources[0].closed
