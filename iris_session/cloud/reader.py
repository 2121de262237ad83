"""Reading one source in a thread of its own: the newest frame is kept, and a source that fails is opened again.

A source may hang in its driver for as long as it likes: nothing but its own thread waits for it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from iris_session.cloud.frames import DepthSource, SourceEndedError, SourceError, SourceFrame
from iris_session.cloud.health import CameraHealth, Fault
from iris_session.protocol.names import StreamFault
from iris_session.system.backoff import Backoff
from iris_session.system.extras import MissingExtraError
from iris_session.system.log import describe_error

MILLISECOND: Final = 1_000_000
#: Delays before a source that failed is opened again [s].
REOPEN_S: Final = (0.5, 1.0, 2.0, 5.0)
#: Frames after which a source counts as healthy again.
HEALTHY_FRAMES: Final = 30
#: Longest wait for a frame, after which the thread looks whether it is to end [s].
READ_S: Final = 0.2
#: Weight of the newest frame in the mean time of reading.
_SHARE: Final = 0.1


class SourceReader:
    """Thread that reads one source. All methods may be called from one other thread.

    Args:
        name: Name of the camera, for the name of the thread.
        open_source: Opens the source.
        health: Looks for faults in the frames.
        now_ns: Session time [ns].
        on_frame: Called in the thread with every frame.

    Attributes:
        superseded: Frames that were replaced by newer ones before they were taken.
        refused: Frames that could not be used.
        incomplete: Frames of a recording that lack a part.
        failures: How often the source could not be opened or read.
        read_ms: Mean age of a frame when its source returned it: of capture, transport and decoding [ms].
    """

    def __init__(
        self,
        name: str,
        open_source: Callable[[], DepthSource],
        health: CameraHealth,
        now_ns: Callable[[], int],
        on_frame: Callable[[], None],
    ) -> None:
        self._name = name
        self._open_source = open_source
        self._health = health
        self._now_ns = now_ns
        self._on_frame = on_frame
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._is_outdated = False  # the source was opened by the clock of another session
        self._newest: SourceFrame | None = None
        self._failure = ""
        self._source: DepthSource | None = None
        self._n_frames = 0  # of this source
        self._backoff = Backoff(REOPEN_S)
        self.superseded = self.refused = self.incomplete = self.failures = 0
        self.read_ms = 0.0
        self._thread = threading.Thread(target=self._run, name=f"iris-camera-{name}"[:15], daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._health.restart(self._now_ns())
        self._thread.start()

    def take_frame(self) -> SourceFrame | None:
        """Return the newest frame once: `None` until there is another."""
        with self._lock:
            newest, self._newest = self._newest, None
            return newest

    def find_fault(self, now_ns: int) -> Fault | None:
        """Return the fault of the source now, `None` while all is well."""
        with self._lock:
            if self._failure:
                return Fault(StreamFault.SOURCE, self._failure)
            return self._health.find_fault(now_ns)

    def measure_hz(self, now_ns: int) -> float:
        """Return the rate of the frames."""
        with self._lock:
            return self._health.measure_hz(now_ns)

    def restart_clock(self) -> None:
        """Forget what was captured by another session's clock, and open the source anew: it has times of that clock."""
        with self._lock:
            self._newest = None
            self._is_outdated = True
            self._health.restart(self._now_ns())

    def stop(self) -> None:
        """Ask the thread to end."""
        self._stopping.set()

    def join(self, timeout_s: float) -> bool:
        """Wait for the thread. Return false when it still runs, in its source, after `timeout_s`."""
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def step(self) -> float | None:
        """Open the source, or read its next frame. The thread does nothing else.

        Returns:
            Seconds to wait before the next step; `None`: the recording is over.
        """
        with self._lock:
            is_outdated, self._is_outdated = self._is_outdated, False
        if is_outdated:
            self._close()
        try:
            if self._source is None:
                self._source, self._n_frames = self._open_source(), 0
                self.incomplete = getattr(self._source, "left_out", 0)  # of a folder
                with self._lock:
                    self._health.restart(self._now_ns())
            else:
                self._read(self._source)
        except SourceEndedError as error:
            self._fail(str(error))
            return None
        except (SourceError, MissingExtraError) as error:
            self._fail(str(error))
        except Exception as error:  # of a driver: the other cameras go on
            self._fail(describe_error(error))
        else:
            return 0.0
        return self._backoff.next_delay()

    def _run(self) -> None:
        while not self._stopping.is_set() and (delay_s := self.step()) is not None:
            self._stopping.wait(delay_s)
        self._close()

    def _close(self) -> None:
        source, self._source = self._source, None
        if source is not None:
            with suppress(Exception):  # of a device that is gone
                source.close()

    def _fail(self, text: str) -> None:
        self._close()
        with self._lock:
            said = " ".join(text.split()).removeprefix(f"camera {self._name!r}: ")
            self._failure = said or "the source failed"
            self.failures += 1
        self._on_frame()

    def _read(self, source: DepthSource) -> None:
        """Read a frame. Raises what the source raises."""
        frame = source.read(READ_S)
        if frame is None:
            return
        read_ms = max(0, self._now_ns() - frame.capture_ns) / MILLISECOND
        self.read_ms += (_SHARE if self.read_ms else 1.0) * (read_ms - self.read_ms)
        self._n_frames += 1
        if self._n_frames == HEALTHY_FRAMES:
            self._backoff.reset()
        self._take_over(SourceFrame(frame, source.camera, source.depth_scale_m), source.recorded_hz)
        self._on_frame()

    def _take_over(self, new: SourceFrame, recorded_hz: float) -> None:
        with self._lock:
            if self._is_outdated:
                return
            self._failure = ""
            self._health.limit_rate(recorded_hz)
            if not self._health.check_frame(new.frame, new.camera, self._now_ns()):
                self.refused += 1
                return
            self.superseded += self._newest is not None
            self._newest = new
