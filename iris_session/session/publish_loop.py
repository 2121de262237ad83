"""Takes the frames of a publisher into the session, at the rate of the state, and steps without one while none comes.

Of frames that come faster the newest wins, and the others are counted. A frame that comes before its time is taken by
the helper thread when it is due; any other by the thread that published it. While the publisher is silent the helper
takes steps without a tick, so leases, heartbeats and requests go on, and repeats the state now and then for those who
have joined meanwhile, with the time that it had, so that it looks as old as it is. Recorded, its time goes on, as
people's heads and hands do.

A row of the journal has a plant's state only where a frame came: in between it stays what it was.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from iris_session.physics.carrier import Carrier
from iris_session.protocol.entries import ExternalReset
from iris_session.protocol.status import NOT_PUBLISHED
from iris_session.scene.composed import ComposedScene
from iris_session.session.cadence import Cadence
from iris_session.session.deformables import Bending
from iris_session.session.draft import Frame
from iris_session.session.errors import OwnershipError
from iris_session.session.processes import SessionProcesses
from iris_session.session.stepper import Stepper, ended_by

#: Silence after which steps without a frame begin, and their distance.
IDLE_AFTER_NS: Final = 20_000_000
IDLE_PERIOD_S: Final = 0.01
#: Silence after which the state is sent again, and again after as long; two periods of the state at least. Longer
#: than the distance of the frames of any source that moves: a repeated pose between two would be seen as a halt.
REPEAT_NS: Final = 250_000_000

_log = logging.getLogger(__name__)


class ShownVertices:
    """Those of the newest frame that was taken, as the streams of deformables read them."""

    def __init__(self, scene: ComposedScene) -> None:
        self.newest: Mapping[str, NDArray[np.float32]] = {name: one.vertices for name, one in scene.deformables.items()}
        self.bending = tuple(
            Bending(one.stream, one.topology, self._of(name)) for name, one in scene.deformables.items()
        )

    def _of(self, name: str) -> Callable[[], NDArray[np.floating]]:
        return lambda: self.newest[name]


class PublishLoop:
    """Drives `stepper` by frames. `offer` from any thread; `superseded`: frames that a newer one took the place of.

    `lock`: held while a step is taken; hold it to read what steps change.
    """

    def __init__(
        self,
        carrier: Carrier,
        vertices: ShownVertices,
        stepper: Stepper,
        processes: SessionProcesses,
        period_ns: int,
    ) -> None:
        self._carrier = carrier
        self._vertices = vertices
        self._stepper = stepper
        self._processes = processes
        self._period_ns = period_ns
        self._repeat_ns = max(REPEAT_NS, 2 * period_ns)
        self.superseded = 0
        self.lock = threading.RLock()
        self._hand = threading.Lock()  # of the frame that waits
        self._waiting: Frame | None = None
        self._due_ns = 0
        self._step_ns = stepper.clock()
        #: Session time of the newest state as it is shown and as it is recorded, and when it was sent.
        self._shown_ns = 0
        self._state_ns = 0
        self._sent_ns = 0
        #: How old the newest frame was when it was taken, -1 before the first.
        self._delay_ns = -1
        self._cadence = Cadence()
        self._closed = threading.Event()
        self._wake = threading.Event()
        self._error: Exception | None = None
        self._traceback: TracebackType | None = None
        with self.lock:
            self._idle()  # who joins before the first frame sees the scene as it was composed
        self._helper = threading.Thread(target=self._work, name="iris-session-publish", daemon=True)
        self._helper.start()

    def offer(self, frame: Frame) -> None:
        """Hands in the newest frame. Raises `OwnershipError` after `close`, and what stopped the helper."""
        with self._hand:
            self.check()  # here, so that no frame is handed in after `close` has taken the last one
            self._cadence.came(self._stepper.clock())
            waited = self._waiting
            if waited is not None:
                self.superseded += 1
            if waited is not None and waited.anew and not frame.anew:  # a reset is told whichever frame brings it
                frame = Frame(frame.capture_ns, frame.time_s, frame.poses, frame.vertices, anew=True)
            self._waiting = frame
        if self._stepper.clock() >= self._due_ns and self.lock.acquire(blocking=False):
            try:
                self._take()
            finally:
                self.lock.release()
        elif waited is None:
            self._wake.set()

    def warnings(self) -> tuple[str, ...]:
        """That the publisher has fallen silent, if it has."""
        silent_ns = self._cadence.silent_ns(self._stepper.clock())
        if not silent_ns:
            return ()
        return (f"{NOT_PUBLISHED} {silent_ns * 1e-9:.1f} s: the program that publishes stands still",)

    def check(self) -> None:
        """Raises what stopped the helper, `OwnershipError` after `close`."""
        if self._error is not None:
            raise self._error.with_traceback(self._traceback)  # which would grow with every time that it is raised
        if self._closed.is_set():
            raise OwnershipError("the session is closed: nothing can be published any more")

    def close(self) -> None:
        """Takes the frame that waits, and ends the helper. After an error no step is taken any more."""
        self._closed.set()
        self._wake.set()
        if self._helper is not threading.current_thread():
            self._helper.join(timeout=2.0)
        with self.lock:
            self._take()

    # --- steps, with the lock held ------------------------------------------------------------------------------------

    def _take(self) -> None:
        """A step with the frame that waits, if one does."""
        with self._hand:
            frame, self._waiting = self._waiting, None
        if frame is None or self._error is not None:
            return
        now_ns = self._stepper.clock()
        self._due_ns += self._period_ns  # a fixed rate, so that a source with jitter loses nothing
        if self._due_ns <= now_ns:
            self._due_ns = now_ns + self._period_ns
        if frame.anew:
            self._stepper.say(ExternalReset())
        self._step(1, self._carrier.encode_state(frame.time_s, frame.poses))
        self._vertices.newest = frame.vertices
        self._delay_ns = max(0, now_ns - frame.capture_ns)
        self._send(frame.capture_ns)

    def _idle(self) -> None:
        self._step(0)
        now_ns = self._stepper.clock()
        if not self._sent_ns or (self._waiting is None and now_ns - self._sent_ns >= self._repeat_ns):
            # Before the first frame nobody has said that the scene is otherwise than it was composed: it is so now.
            self._send(now_ns - max(0, self._delay_ns), again=self._delay_ns >= 0)

    def _step(self, n_ticks: int, plant: bytes = b"") -> None:
        try:
            self._stepper.step(n_ticks, plant, publish=False)
        except BaseException as error:  # whoever took it, the helper ends; Ctrl-C breaks one off, too
            self._fail(error)
            raise
        self._processes.watch(self._stepper)
        self._step_ns = self._stepper.clock()

    def _send(self, capture_ns: int, *, again: bool = False) -> None:
        self._state_ns = max(capture_ns, self._state_ns + 1)
        if not again:  # as it was, though later ones were recorded: what waited somewhere is as old as it is
            self._shown_ns = max(capture_ns, self._shown_ns + 1)
        self._sent_ns = self._stepper.clock()
        self._stepper.publish_now(self._state_ns, self._shown_ns)

    def _fail(self, error: BaseException) -> None:
        self._error, self._traceback = ended_by(error), error.__traceback__

    # --- the helper ---------------------------------------------------------------------------------------------------

    def _work(self) -> None:
        try:
            while not self._closed.is_set() and self._error is None:
                self._wake.wait(self._pause_s())
                self._wake.clear()
                with self.lock:
                    self._turn()
        except BaseException as error:  # raised at the next `publish`, which may not come
            self._fail(error)
            _log.error("no step is taken any more: %s: %s", type(error).__name__, error)

    def _pause_s(self) -> float:
        """Until the frame that waits is due, but never long."""
        if self._waiting is None:
            return IDLE_PERIOD_S
        return min(IDLE_PERIOD_S, max(0.0, (self._due_ns - self._stepper.clock()) * 1e-9))

    def _turn(self) -> None:
        now_ns = self._stepper.clock()
        if self._closed.is_set() or self._error is not None:
            return
        if self._waiting is not None and now_ns >= self._due_ns:
            self._take()
        elif now_ns - self._step_ns > IDLE_AFTER_NS:
            self._idle()
