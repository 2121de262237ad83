"""`PublishLoop`: steps with the frames of a publisher at the rate of the state, and steps without one while none comes.

Of frames that come faster the newest wins, and the others are counted. A frame that comes before it is due is published
by the helper thread, any other by the thread that offered it. While the publisher is silent the helper takes steps
without a tick, so leases, heartbeats and requests continue, and repeats the state now and then for clients that joined
meanwhile, with its original time, so that its age is right. In the recording its time advances, as heads and hands do.

A row of the journal has a plant state only where a frame came; in between it does not change.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from iris_session.physics.kinematic_model import TICK_S, KinematicModel
from iris_session.protocol.entries import ExternalReset
from iris_session.protocol.status import NOT_PUBLISHED
from iris_session.scene.result import ComposedScene
from iris_session.session.deformables import DeformableSourceMesh
from iris_session.session.errors import OwnershipError
from iris_session.session.pending_state import Frame
from iris_session.session.processes import SessionProcesses
from iris_session.session.stepper import Stepper

#: Silence after which steps without a frame begin, and their distance.
IDLE_AFTER_NS: Final = 20_000_000
IDLE_PERIOD_S: Final = 0.01
#: Silence after which the state is sent again, and again after as long; two periods of the state at least. Longer
#: than the distance of the frames of any source that moves: a repeated pose between two would be seen as a halt.
REPEAT_NS: Final = 250_000_000
#: Most milliseconds of the world for which targets of robots move with one frame: a larger jump of time is no motion.
MAX_TICKS: Final = 100

_log = logging.getLogger(__name__)


class PublishedVertices:
    """Vertices of the newest published frame, as the streams of deformables read them."""

    def __init__(self, scene: ComposedScene) -> None:
        self.newest: Mapping[str, NDArray[np.float32]] = {name: one.vertices for name, one in scene.deformables.items()}
        self.meshes = tuple(
            DeformableSourceMesh(one.stream, one.topology, lambda name=name: self.newest[name])  # type: ignore[misc]
            for name, one in scene.deformables.items()
        )


class PublishLoop:
    """Drives a stepper by frames. `offer` may be called from any thread; `start` starts the helper thread.

    Attributes:
        superseded: Frames that a newer one replaced before they were published.
        core: That of the stepper.
        lock: Held while a step is taken; hold it to read what steps change.
        grippers: How far the participants who drive have closed grippers, 0 to 1, by robot.
    """

    def __init__(
        self,
        kinematic_model: KinematicModel,
        vertices: PublishedVertices,
        stepper: Stepper,
        processes: SessionProcesses,
        period_ns: int,
    ) -> None:
        self._kinematic_model = kinematic_model
        self._vertices = vertices
        self._stepper, self.core = stepper, stepper.core
        self._processes = processes
        self._period_ns = period_ns
        self._repeat_ns = max(REPEAT_NS, 2 * period_ns)
        self.superseded = 0
        self.grippers: dict[str, float] = {}
        self.lock = threading.RLock()
        self._pending_lock = threading.Lock()
        self._pending: Frame | None = None
        self._due_ns = 0
        self._step_ns = stepper.clock()
        # Session time of the newest state as clients see it and as it is recorded, and when it was sent.
        self._shown_ns = 0
        self._state_ns = 0
        self._sent_ns = 0
        # Age of the newest frame when it was published, -1 before the first.
        self._delay_ns = -1
        self._time_s = 0.0  # of the newest frame
        self._arrivals = ArrivalMonitor()
        self._closed = threading.Event()
        self._wake = threading.Event()
        with self.lock:
            self._take_idle_step()  # clients that join before the first frame see the scene as it was composed
        self._helper = threading.Thread(target=self._run_helper, name="iris-session-publish", daemon=True)

    def start(self) -> None:
        """Start the helper thread, which polls until `close`."""
        self._helper.start()

    def poll(self) -> None:
        """Publish the pending frame if it is due; without one, take a step without a tick if the last is long ago."""
        with self.lock:
            now_ns = self._stepper.clock()
            if self._closed.is_set() or self._stepper.has_ended:
                return
            if self._pending is not None and now_ns >= self._due_ns:
                self._publish_pending()
            elif now_ns - self._step_ns > IDLE_AFTER_NS:
                self._take_idle_step()

    def offer(self, frame: Frame) -> None:
        """Publish a frame now or when it is due. Raises `OwnershipError` after `close`, and what stopped the helper."""
        with self._pending_lock:
            self.raise_if_ended()  # under the lock: no frame is offered after `close` has published the last one
            self._arrivals.note_arrival(self._stepper.clock())
            before = self._pending
            if before is not None:
                self.superseded += 1
            if before is not None and before.anew and not frame.anew:  # keep the reset of the replaced frame
                frame = Frame(frame.capture_ns, frame.time_s, frame.poses, frame.vertices, anew=True)
            self._pending = frame
        if self._stepper.clock() >= self._due_ns and self.lock.acquire(blocking=False):
            try:
                self._publish_pending()
            finally:
                self.lock.release()
        elif before is None:
            self._wake.set()

    def warnings(self) -> tuple[str, ...]:
        """Return a warning if the publisher has fallen silent."""
        silent_ns = self._arrivals.measure_silence_ns(self._stepper.clock())
        if not silent_ns:
            return ()
        return (f"{NOT_PUBLISHED} {silent_ns * 1e-9:.1f} s: the program that publishes stands still",)

    @property
    def has_ended(self) -> bool:
        """True after an error in a step, and after `close`."""
        return self._closed.is_set() or self._stepper.has_ended

    def raise_if_ended(self) -> None:
        """Raise what stopped the helper, or `OwnershipError` after `close`."""
        self._stepper.raise_if_ended()
        if self._closed.is_set():
            raise OwnershipError("the session is closed: nothing can be published any more")

    def close(self) -> None:
        """Publish the pending frame and end the helper. After an error no further step is taken."""
        self._closed.set()
        self._wake.set()
        if self._helper.is_alive() and self._helper is not threading.current_thread():
            self._helper.join(timeout=2.0)
        with self.lock:
            self._publish_pending()

    # --- steps, with the lock held ------------------------------------------------------------------------------------

    def _publish_pending(self) -> None:
        """Take a step with the pending frame, if there is one."""
        with self._pending_lock:
            frame, self._pending = self._pending, None
        if frame is None or self._stepper.has_ended:
            return
        now_ns = self._stepper.clock()
        self._due_ns += self._period_ns  # a fixed rate, so that a source with jitter loses nothing
        if self._due_ns <= now_ns:
            self._due_ns = now_ns + self._period_ns
        if frame.anew:
            self._stepper.inputs.post_own(ExternalReset())
        ticks = self._count_ticks(frame)
        self._step(ticks, self._kinematic_model.encode_state(frame.time_s, frame.poses))
        self._vertices.newest = frame.vertices
        self._delay_ns = max(0, now_ns - frame.capture_ns)
        self._publish_state(frame.capture_ns)

    def _take_idle_step(self) -> None:
        self._step(0)
        now_ns = self._stepper.clock()
        if not self._sent_ns or (self._pending is None and now_ns - self._sent_ns >= self._repeat_ns):
            # Before the first frame the scene is as it was composed, and is so now.
            self._publish_state(now_ns - max(0, self._delay_ns), is_repeat=self._delay_ns >= 0)

    def _count_ticks(self, frame: Frame) -> int:
        """Return the ticks since the frame before, in which targets of robots move; without robots one will do."""
        before, self._time_s = self._time_s, frame.time_s
        if not self.core.scene.robots or frame.anew:
            return 1
        return min(MAX_TICKS, max(1, round((frame.time_s - before) / TICK_S)))

    def _step(self, n_ticks: int, plant: bytes = b"") -> None:
        outcome = self._stepper.step(n_ticks, plant, publish=False)
        for command in outcome.decision.commands:
            if command.gripper is not None:
                self.grippers[command.robot] = command.gripper
        driven = self.core.driven  # the next participant begins without the gripper of the one before
        self.grippers = {name: closed for name, closed in self.grippers.items() if name in driven}
        self._processes.supervise(self._stepper)
        self._step_ns = self._stepper.clock()

    def _publish_state(self, capture_ns: int, *, is_repeat: bool = False) -> None:
        self._state_ns = max(capture_ns, self._state_ns + 1)
        if not is_repeat:  # a repeated state keeps its time
            self._shown_ns = max(capture_ns, self._shown_ns + 1)
        self._sent_ns = self._stepper.clock()
        self._stepper.publish_now(self._state_ns, self._shown_ns)

    # --- the helper ---------------------------------------------------------------------------------------------------

    def _run_helper(self) -> None:
        try:
            while not self._closed.is_set() and not self._stepper.has_ended:
                self._wake.wait(self._compute_pause_s())
                self._wake.clear()
                self.poll()
        except BaseException as error:
            self._stepper.end(error)  # raised at the next `publish`, which may not come
            _log.error("the session stands still after an error: %s: %s", type(error).__name__, error)

    def _compute_pause_s(self) -> float:
        """Return the time until the pending frame is due [s], at most `IDLE_PERIOD_S`."""
        if self._pending is None:
            return IDLE_PERIOD_S
        return min(IDLE_PERIOD_S, max(0.0, (self._due_ns - self._stepper.clock()) * 1e-9))


#: Shortest silence that is reported, and how many usual periods it must last.
SILENT_NS: Final = 1_000_000_000
SILENT_PERIODS: Final = 10
#: Periods over which the usual one is averaged.
_WEIGHT: Final = 8


class ArrivalMonitor:
    """Detects silence of something periodic. Pure; something that came once has no period yet and is never silent."""

    def __init__(self) -> None:
        self._arrived_ns = -1
        self._period_ns = 0

    def note_arrival(self, now_ns: int) -> None:
        if self._arrived_ns >= 0:
            period_ns = now_ns - self._arrived_ns
            self._period_ns += (period_ns - self._period_ns) // (_WEIGHT if self._period_ns else 1)
            self._period_ns = max(1, self._period_ns)
        self._arrived_ns = now_ns

    def measure_silence_ns(self, now_ns: int) -> int:
        """Return the time since the last arrival if it is much longer than usual, else 0."""
        silence_ns = now_ns - self._arrived_ns
        return silence_ns if self._period_ns and silence_ns > max(SILENT_NS, SILENT_PERIODS * self._period_ns) else 0
