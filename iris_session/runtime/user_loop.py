"""A session inside a loop that the user owns: `begin_tick()/end_tick()`, or MuJoCo's control callback.

The session never touches the user's `MjData` but at a tick. It keeps a twin world of its own whose state is set from
the plant's `mjSTATE_INTEGRATION` at every step; that state is journaled, so authority and control can be re-run exactly
although the plant cannot (recordings of class `open`).

The state handed in is always finite. While the user's is not, the last good one stands in for it and no tick is taken:
robots hold, everyone is told, and must clutch again afterwards.

A helper thread takes zero-tick steps, on the twin alone, when the user's loop is silent for 20 ms: leases, heartbeats
and e-stops go on while a script plots, trains or waits at a prompt.
"""

from __future__ import annotations

import threading
from typing import Final

import mujoco
import numpy as np

from iris_session.protocol.client_messages import Marker
from iris_session.protocol.entries import ExternalReset, StalledGap
from iris_session.runtime.core import plant_state
from iris_session.runtime.processes import SessionProcesses
from iris_session.runtime.stepper import Stepper

#: Silence of the user's loop after which zero-tick steps begin, and their distance.
IDLE_AFTER_NS: Final = 20_000_000
IDLE_PERIOD_S: Final = 0.01
#: Silence after which robots must be clutched again (the freshness bound of samples). The authority cannot see it,
#: because zero-tick steps go on meanwhile.
GAP_NS: Final = 150_000_000


class UserLoop:
    """Ties a stepper to the user's `model` and `data`. All methods but `close` belong to the user's thread."""

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
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._diverged = False
        self._diverged_ns = 0
        #: The newest finite state of the user's data.
        self._plant = plant_state(model, data)
        self._last_tick_ns = stepper.clock()
        self._last_time = -1.0
        self._helper_error: BaseException | None = None
        self._helper = threading.Thread(target=self._idle, name="iris-session-idle", daemon=True)
        self._helper.start()

    def begin_tick(self) -> None:
        """One step with one tick: writes `ctrl` (and wrenches on hand-held objects) into the user's data."""
        with self._lock:
            if self._helper_error is not None:
                raise self._helper_error
            self._follow_time()
            now_ns = self._stepper.clock()
            silence_ns = now_ns - self._last_tick_ns
            if silence_ns > GAP_NS:
                self._stepper.post(StalledGap(silence_ns))
            self._last_tick_ns = now_ns
            if not self._take_plant():
                self._stepper.step(0, self._plant)
                return
            self._stepper.step(1, self._plant)
            twin = self._stepper.core.world.data
            self._data.ctrl[self._actuators] = twin.ctrl[self._actuators]
            self._data.xfrc_applied[self._objects] = twin.xfrc_applied[self._objects]

    def end_tick(self) -> None:
        """Publishes what the user's `mj_step` made."""
        with self._lock:
            if self._take_plant():
                self._stepper.core.world.set_state_bytes(self._plant)
            self._stepper.publish(self._stepper.clock())
            self._last_tick_ns = self._stepper.clock()
            self._follow_time()
            self._processes.watch(self._stepper)

    def control_callback(self) -> None:
        """MuJoCo asks for controls at the present state: a tick if time has moved, nothing for `mj_forward`."""
        if self._data.time == self._last_time:
            return
        self.begin_tick()
        self._processes.watch(self._stepper)

    def close(self) -> None:
        """Ends the helper thread."""
        self._closed.set()
        if self._helper is not threading.current_thread():
            self._helper.join(timeout=2.0)

    def _follow_time(self) -> None:
        """Time that goes back is a reset: by the user between two ticks, or by MuJoCo itself within `mj_step`."""
        if self._data.time < self._last_time:
            self._stepper.post(ExternalReset())
        self._last_time = self._data.time

    def _take_plant(self) -> bool:
        """Reads the user's state; False, and said once, while it is not finite."""
        plant = plant_state(self._model, self._data)
        diverged = not np.isfinite(np.frombuffer(plant)).all()
        if diverged and not self._diverged:
            text = "the user's simulation has numbers that are not finite: robots hold until it is reset"
            self._stepper.post(Marker(request_id=0, text=text))
            self._diverged_ns = self._stepper.clock()
        elif self._diverged and not diverged:
            self._stepper.post(StalledGap(self._stepper.clock() - self._diverged_ns))
        self._diverged = diverged
        if not diverged:
            self._plant = plant
        return not diverged

    def _idle(self) -> None:
        try:
            while not self._closed.wait(IDLE_PERIOD_S):
                if self._stepper.clock() - self._last_tick_ns <= IDLE_AFTER_NS:
                    continue
                with self._lock:
                    if self._stepper.clock() - self._last_tick_ns > IDLE_AFTER_NS and not self._closed.is_set():
                        self._stepper.step(0, self._plant)
                        self._processes.watch(self._stepper)
        except BaseException as error:  # shown at the user's next tick, where it can be seen
            self._helper_error = error
