"""`UserLoop`: a session inside a loop that the user owns, by `begin_tick()/end_tick()` or MuJoCo's control callback.

The session never touches the user's `MjData` but at a tick. It keeps a twin world of its own whose state is set from
the plant's `mjSTATE_INTEGRATION` at every step; that state is journaled, so authority and control can be re-run exactly
although the plant cannot (recordings of class `open`).

The state passed to the core is always finite. While the user's is not, the last finite one replaces it and no tick is
taken: robots hold, participants are notified, and must clutch again afterwards.

A helper thread takes zero-tick steps, on the twin alone, when the user's loop is silent for 20 ms: leases, heartbeats
and e-stops go on while a script plots, trains or waits at a prompt.

What one step computes is applied until the next `begin_tick`, however many `mj_step` lie between: control counts the
ticks of the round before, so that robots keep their speed. At the end robots are left at rest.
"""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Final

import mujoco
import numpy as np

from iris_session.protocol.client_messages import Marker
from iris_session.protocol.entries import ExternalReset, StalledGap
from iris_session.session.core import read_plant_state
from iris_session.session.errors import OwnershipError
from iris_session.session.processes import SessionProcesses
from iris_session.session.stepper import Stepper

#: Silence of the user's loop after which zero-tick steps begin, and their distance.
IDLE_AFTER_NS: Final = 20_000_000
IDLE_PERIOD_S: Final = 0.01
#: Silence after which robots must be clutched again (the freshness bound of samples). The authority cannot see it,
#: because zero-tick steps go on meanwhile.
GAP_NS: Final = 150_000_000
#: Most ticks that control counts for one round of the user loop; a larger jump of time is no motion.
MAX_TICKS: Final = 100


class UserLoop:
    """Ties a stepper to the user's `model` and `data`. All methods but `close` and `reset` belong to the user's thread.

    `lock` is held while a step is taken; hold it to read what steps change.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, stepper: Stepper, processes: SessionProcesses
    ) -> None:
        self._model = model
        self._data = data
        self._stepper = stepper
        self._processes = processes
        config = stepper.core.config
        names = [a for r in config.robots for a in (*r.actuators, r.gripper_actuator) if a]
        self._actuators = [model.actuator(name).id for name in names]
        self._objects = [model.body(spec.body).id for spec in config.objects]
        self.lock = threading.RLock()
        self._closed = threading.Event()
        self._diverged = False
        self._diverged_ns = 0
        #: The newest finite state of the user's data.
        self._plant = read_plant_state(model, data)
        self._last_tick_ns = stepper.clock()
        self._last_time = -1.0
        self._began_time: float | None = None  # of the newest round, None after a reset
        self._calls = -1  # of MuJoCo's functions on the data, at the last callback
        self._in_tick = False
        self._was_reset = False
        self._wrote = False
        self._helper_error: BaseException | None = None
        self._helper_traceback: TracebackType | None = None
        self._helper = threading.Thread(target=self._run_helper, name="iris-session-idle", daemon=True)
        self._helper.start()

    def begin_tick(self) -> None:
        """One step: writes `ctrl` (and wrenches on hand-held objects) into the user's data. Ends a tick that began."""
        with self.lock:
            self._require_open()
            if self._in_tick:
                self._finish_tick()
            self._in_tick = True
            self._detect_reset()
            now_ns = self._stepper.clock()
            silence_ns = now_ns - self._last_tick_ns
            if silence_ns > GAP_NS:
                self._stepper.post_own(StalledGap(silence_ns))
            self._last_tick_ns = now_ns
            if not self._read_plant():
                self._stepper.step(0, self._plant)
                return
            self._post_reset()
            self._stepper.step(self._count_ticks(), self._plant, publish=False)
            self._write_controls()
            self._wrote = True

    def end_tick(self) -> None:
        """Publish the state after the user's `mj_step`. Raises `OwnershipError` when no tick has begun."""
        with self.lock:
            self._require_open()
            if not self._in_tick:
                raise OwnershipError("end_tick() ends a tick: call begin_tick() before it, then mj_step")
            if self._finish_tick():
                self._post_reset()  # the next step, be it the helper's, is on the state after it
            self._last_tick_ns = self._stepper.clock()

    def control_callback(self) -> None:
        """Begin a tick if time has moved since the last callback; MuJoCo calls it for `mj_forward` too."""
        # A reset after exactly one step leaves the time of the last callback. MuJoCo counts its calls on the data and a
        # reset begins anew, but so does the passive viewer at every sync; only a reset forgets the warm start too.
        calls = int(self._data.timer.number.sum())
        counted_anew, self._calls = calls <= self._calls, calls
        if counted_anew and self._data.time == self._last_time and not self._data.qacc_warmstart.any():
            self.reset()
        if self._was_reset or self._data.time != self._last_time:
            self.begin_tick()

    def reset(self) -> None:
        """Note that the user resets the data before the next tick: robots hold where that tick finds them."""
        self._was_reset = True

    def close(self) -> None:
        """End the helper thread and leave the robots of the user's data at rest, without our forces on objects."""
        self._closed.set()
        if self._helper is not threading.current_thread():
            self._helper.join(timeout=2.0)
        with self.lock:
            if self._wrote and self._read_plant():
                self._wrote = False
                self._stepper.core.write_rest_controls(self._plant)
                self._write_controls()

    def _require_open(self) -> None:
        if self._closed.is_set():
            raise OwnershipError("the session is closed: no tick can be taken any more")
        if self._helper_error is not None:
            raise self._helper_error.with_traceback(self._helper_traceback)  # as in `Stepper.step`

    def _finish_tick(self) -> bool:
        """Publish the state after a tick; return whether it is one after time went back."""
        self._in_tick = False
        went_back = self._detect_reset()
        good = self._read_plant()
        if good and not self._was_reset:  # the epoch of a state after a reset is that of the next step
            self._stepper.core.world.restore_state(self._plant)
            self._stepper.publish(self._stepper.clock())
        self._processes.supervise(self._stepper)
        return good and went_back

    def _write_controls(self) -> None:
        """Copy `ctrl` of the robots and wrenches on the objects from the twin into the user's data."""
        twin = self._stepper.core.world.data
        self._data.ctrl[self._actuators] = twin.ctrl[self._actuators]
        self._data.xfrc_applied[self._objects] = twin.xfrc_applied[self._objects]

    def _count_ticks(self) -> int:
        """Return the ticks that this round stands for: as many as the one before took, if any time passed in it."""
        began, self._began_time = self._began_time, float(self._data.time)
        if began is None:
            return 1
        return min(MAX_TICKS, max(1, round((self._began_time - began) / float(self._model.opt.timestep))))

    def _detect_reset(self) -> bool:
        """Return whether time went back, which is a reset: by the user between ticks, or by MuJoCo within `mj_step`."""
        went_back = bool(self._data.time < self._last_time)
        if went_back:
            self.reset()
        self._last_time = self._data.time
        return went_back

    def _read_plant(self) -> bool:
        """Read the user's state; return False, and announce it once, while it is not finite."""
        plant = read_plant_state(self._model, self._data)
        diverged = not np.isfinite(np.frombuffer(plant)).all()
        if diverged and not self._diverged:
            text = "the user's simulation has numbers that are not finite: robots hold until it is reset"
            self._stepper.post_own(Marker(request_id=0, text=text))
            self._diverged_ns = self._stepper.clock()
        elif self._diverged and not diverged:
            self._stepper.post_own(StalledGap(self._stepper.clock() - self._diverged_ns))
        self._diverged = diverged
        if diverged:
            return False
        self._plant = plant
        return True

    def _post_reset(self) -> None:
        """Queue a pending reset for the next step, which must be on the state after it."""
        if self._was_reset:
            self._was_reset = False
            self._began_time = None
            self._stepper.post_own(ExternalReset())

    def _run_helper(self) -> None:
        try:
            while not self._closed.wait(IDLE_PERIOD_S):
                if self._stepper.clock() - self._last_tick_ns <= IDLE_AFTER_NS:
                    continue
                with self.lock:
                    if self._stepper.clock() - self._last_tick_ns > IDLE_AFTER_NS and not self._closed.is_set():
                        self._stepper.step(0, self._plant)
                        self._processes.supervise(self._stepper)
        except BaseException as error:  # raised at the user's next tick, where it is seen
            self._helper_error, self._helper_traceback = error, error.__traceback__
