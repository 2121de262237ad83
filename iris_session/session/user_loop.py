"""A session inside a loop that the user owns: `begin_tick()/end_tick()`, or MuJoCo's control callback.

The session never touches the user's `MjData` but at a tick. It keeps a twin world of its own whose state is set from
the plant's `mjSTATE_INTEGRATION` at every step; that state is journaled, so authority and control can be re-run exactly
although the plant cannot (recordings of class `open`).

The state handed in is always finite. While the user's is not, the last good one stands in for it and no tick is taken:
robots hold, everyone is told, and must clutch again afterwards.

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
from iris_session.session.core import plant_state
from iris_session.session.errors import OwnershipError
from iris_session.session.processes import SessionProcesses
from iris_session.session.stepper import Stepper

#: Silence of the user's loop after which zero-tick steps begin, and their distance.
IDLE_AFTER_NS: Final = 20_000_000
IDLE_PERIOD_S: Final = 0.01
#: Silence after which robots must be clutched again (the freshness bound of samples). The authority cannot see it,
#: because zero-tick steps go on meanwhile.
GAP_NS: Final = 150_000_000
#: Most ticks that control takes for one round of the user's loop; a time that jumps further is no motion.
MAX_TICKS: Final = 100


class UserLoop:
    """Ties a stepper to the user's `model` and `data`. All methods but `close` and `reset` belong to the user's thread.

    `lock`: held while a step is taken; hold it to read what steps change.
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
        self._plant = plant_state(model, data)
        self._last_tick_ns = stepper.clock()
        self._last_time = -1.0
        self._began_time: float | None = None  # of the newest round, None after a reset
        self._calls = -1  # of MuJoCo's functions on the data, at the last callback
        self._in_tick = False
        self._was_reset = False
        self._wrote = False
        self._helper_error: BaseException | None = None
        self._helper_traceback: TracebackType | None = None
        self._helper = threading.Thread(target=self._idle, name="iris-session-idle", daemon=True)
        self._helper.start()

    def begin_tick(self) -> None:
        """One step: writes `ctrl` (and wrenches on hand-held objects) into the user's data. Ends a tick that began."""
        with self.lock:
            self._check_open()
            if self._in_tick:
                self._end()
            self._in_tick = True
            self._follow_time()
            now_ns = self._stepper.clock()
            silence_ns = now_ns - self._last_tick_ns
            if silence_ns > GAP_NS:
                self._stepper.say(StalledGap(silence_ns))
            self._last_tick_ns = now_ns
            if not self._take_plant():
                self._stepper.step(0, self._plant)
                return
            self._tell_reset()
            self._stepper.step(self._ticks(), self._plant, publish=False)
            self._apply()
            self._wrote = True

    def end_tick(self) -> None:
        """Publishes what the user's `mj_step` made. Raises `OwnershipError` when no tick began."""
        with self.lock:
            self._check_open()
            if not self._in_tick:
                raise OwnershipError("end_tick() ends a tick: call begin_tick() before it, then mj_step")
            if self._end():
                self._tell_reset()  # the next step, be it the helper's, is on the state after it
            self._last_tick_ns = self._stepper.clock()

    def control_callback(self) -> None:
        """MuJoCo asks for controls at the present state: a tick if time has moved, nothing for `mj_forward`."""
        # A reset after exactly one step leaves the time of the last callback. MuJoCo counts its calls on the data and a
        # reset begins anew, but so does the passive viewer at every sync; only a reset forgets the warm start too.
        calls = int(self._data.timer.number.sum())
        counted_anew, self._calls = calls <= self._calls, calls
        if counted_anew and self._data.time == self._last_time and not self._data.qacc_warmstart.any():
            self.reset()
        if self._was_reset or self._data.time != self._last_time:
            self.begin_tick()

    def reset(self) -> None:
        """The user has put the data into another state, or is about to: robots hold where the next tick finds them."""
        self._was_reset = True

    def close(self) -> None:
        """Ends the helper thread and leaves the robots of the user's data at rest, without our forces on objects."""
        self._closed.set()
        if self._helper is not threading.current_thread():
            self._helper.join(timeout=2.0)
        with self.lock:
            if self._wrote and self._take_plant():
                self._wrote = False
                self._stepper.core.rest(self._plant)
                self._apply()

    def _check_open(self) -> None:
        if self._closed.is_set():
            raise OwnershipError("the session is closed: no tick can be taken any more")
        if self._helper_error is not None:
            raise self._helper_error.with_traceback(self._helper_traceback)  # as of `Stepper.step`

    def _end(self) -> bool:
        """True when the state that was taken is one after time went back."""
        self._in_tick = False
        went_back = self._follow_time()
        good = self._take_plant()
        if good and not self._was_reset:  # the epoch of a state after a reset is that of the next step
            self._stepper.core.world.restore_state(self._plant)
            self._stepper.publish(self._stepper.clock())
        self._processes.watch(self._stepper)
        return good and went_back

    def _apply(self) -> None:
        """`ctrl` of the robots and wrenches on the objects, from the twin into the user's data."""
        twin = self._stepper.core.world.data
        self._data.ctrl[self._actuators] = twin.ctrl[self._actuators]
        self._data.xfrc_applied[self._objects] = twin.xfrc_applied[self._objects]

    def _ticks(self) -> int:
        """Ticks that this round stands for: as many as the one before took, if any time passed in it."""
        began, self._began_time = self._began_time, float(self._data.time)
        if began is None:
            return 1
        return min(MAX_TICKS, max(1, round((self._began_time - began) / float(self._model.opt.timestep))))

    def _follow_time(self) -> bool:
        """Time that goes back is a reset: by the user between two ticks, or by MuJoCo itself within `mj_step`."""
        went_back = bool(self._data.time < self._last_time)
        if went_back:
            self.reset()
        self._last_time = self._data.time
        return went_back

    def _take_plant(self) -> bool:
        """Reads the user's state; False, and said once, while it is not finite."""
        plant = plant_state(self._model, self._data)
        diverged = not np.isfinite(np.frombuffer(plant)).all()
        if diverged and not self._diverged:
            text = "the user's simulation has numbers that are not finite: robots hold until it is reset"
            self._stepper.say(Marker(request_id=0, text=text))
            self._diverged_ns = self._stepper.clock()
        elif self._diverged and not diverged:
            self._stepper.say(StalledGap(self._stepper.clock() - self._diverged_ns))
        self._diverged = diverged
        if diverged:
            return False
        self._plant = plant
        return True

    def _tell_reset(self) -> None:
        """The step that reads a reset must be one on the state after it."""
        if self._was_reset:
            self._was_reset = False
            self._began_time = None
            self._stepper.say(ExternalReset())

    def _idle(self) -> None:
        try:
            while not self._closed.wait(IDLE_PERIOD_S):
                if self._stepper.clock() - self._last_tick_ns <= IDLE_AFTER_NS:
                    continue
                with self.lock:
                    if self._stepper.clock() - self._last_tick_ns > IDLE_AFTER_NS and not self._closed.is_set():
                        self._stepper.step(0, self._plant)
                        self._processes.watch(self._stepper)
        except BaseException as error:  # shown at the user's next tick, where it can be seen
            self._helper_error, self._helper_traceback = error, error.__traceback__
