"""`UserLoop`: a session inside a loop that the user owns, by `begin_tick()/end_tick()` or by wrapped steps of its data.

The session touches the user's `MjData` only at a tick, and there only what it drives: `ctrl` of robots that a
participant has engaged (`ctrl_sharing`), and wrenches on objects that a hand holds. It keeps a twin world of its own
whose state is set from the plant's `mjSTATE_INTEGRATION` at every step, with the owner's `ctrl` in place of the
session's; that state is journaled, so authority and control can be re-run exactly although the plant cannot (recordings
of class `open`).

What the session has written stays in the data until the next tick. There, what the owner has written since is the
owner's; where nothing was written the owner's value is the one from before the session took over. It comes back when
the session gives the robot back, and at once after a reset.

The state passed to the core is always finite. While the user's is not, the last finite one replaces it and no tick is
taken: robots hold, participants are notified, and must clutch again afterwards.

While no participant drives, an attached program is only looked at: `look` copies the state after a step, which takes
some microseconds, and a helper thread takes the session's step on the newest copy at the rate of the state. It writes
nothing into the user's data: what it has begun to drive is written by the program's next step, which is a tick.

The helper also takes zero-tick steps, on the twin alone, when the user's loop is silent for 20 ms: leases, heartbeats
and e-stops go on while a script plots, trains or waits at a prompt.

What one step computes is applied until the next `begin_tick`, however many `mj_step` lie between: control counts the
ticks of the rounds before, so that robots keep their speed. At the end robots that are driven are left at rest.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from collections import deque
from collections.abc import Callable
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.physics.world import STATE
from iris_session.protocol.client_messages import Marker
from iris_session.protocol.entries import ExternalReset, StalledGap
from iris_session.session.core import read_plant_state
from iris_session.session.errors import OwnershipError
from iris_session.session.processes import SessionProcesses
from iris_session.session.status import DataFault
from iris_session.session.stepper import NextScene, Stepper

#: Silence of the user's loop after which zero-tick steps begin, and their distance.
IDLE_AFTER_NS: Final = 20_000_000
IDLE_PERIOD_S: Final = 0.01
#: Silence after which robots must be clutched again (the freshness bound of samples). The authority cannot see it,
#: because zero-tick steps go on meanwhile.
GAP_NS: Final = 150_000_000
#: A round that takes longer than that is a gap, too, unless rounds of this loop take so long: so many times the one
#: before.
LONG_ROUND: Final = 4
#: Most ticks that control counts for one round of the user loop, and most time [s]; a larger jump of time is no motion.
MAX_TICKS: Final = 100
MAX_ROUND_S: Final = 0.1
#: Time that an attached script simulates outside of the session's ticks before the owner is warned [s].
UNSEEN_S: Final = 1.0
#: Joints of a driven robot that differ by more than this [rad or m] from where the step has left them were moved by the
#: owner.
MOVED: Final = 1e-6

_CTRL: Final = int(mujoco.mjtState.mjSTATE_CTRL)
_XFRC: Final = int(mujoco.mjtState.mjSTATE_XFRC_APPLIED)
#: Arrays of the data that are part of the state.
_ARRAYS: Final = ("time", "qpos", "qvel", "act", "ctrl", "qfrc_applied", "xfrc_applied", "mocap_pos", "mocap_quat")
_FIELDS: Final = {name: int(getattr(mujoco.mjtState, f"mjSTATE_{name.upper()}")) for name in _ARRAYS}
_FIELDS["qacc_warmstart"] = int(mujoco.mjtState.mjSTATE_WARMSTART)

Floats = NDArray[np.float64]
_log = logging.getLogger(__name__)


class _BorrowedArray:
    """Elements of an array of the user's data that the session writes for now, and the owner's values of them."""

    def __init__(self, array: NDArray[np.float64]) -> None:
        self.indices: NDArray[np.intp] = np.zeros(0, np.intp)
        self._owner = self._written = array[self.indices].copy()

    def read(self, array: Floats) -> None:
        """Take over what the owner has written since `write`."""
        if self.indices.size:
            now = array[self.indices]
            # Arrays of JAX come back rounded (`Session.sync`).
            is_ours = (now == self._written) | (now == self._written.astype(np.float32))
            self._owner = np.where(is_ours, self._owner, now)

    def is_overwritten(self, array: Floats) -> bool:
        """Return whether the array holds other values than those that were written last."""
        return bool(self.indices.size and not np.array_equal(array[self.indices], self._written))

    def put_owner(self, array: Floats) -> None:
        """Put the owner's values into `array`."""
        array[self.indices] = self._owner

    def put_written(self, array: Floats) -> None:
        """Put the session's values into `array` again."""
        array[self.indices] = self._written

    def write(self, array: Floats, indices: NDArray[np.intp], values: Floats) -> None:
        """Give everything back to the owner, then write `values` (of the whole array) at `indices`. After `read`."""
        if not self.indices.size and not indices.size:
            return
        array[self.indices] = self._owner
        self.indices, self._owner = indices, array[indices].copy()
        self._written = array[indices] = values[indices]


class UserLoop:
    """Ties a stepper to the user's `model` and `data`. All methods but `close` and `reset` belong to the user's thread.

    `lock` is held while a step is taken; hold it to read what steps change.

    Attributes:
        model, data: That the user advances now.
        fault: What is not finite in the user's data now, `None` while all is well.
        overwritten: Rounds in which the owner has changed what the session had written, between the two ends of it.
        is_attached: The loop is driven by the wrapped step of its data, so no time should pass outside of rounds.
        unseen_s: Time of the simulation [s] that did.
        reset_count: Resets so far.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, stepper: Stepper, processes: SessionProcesses
    ) -> None:
        self._stepper = stepper
        self._processes = processes
        self.lock = threading.RLock()
        self._closed = threading.Event()
        self.fault: DataFault | None = None
        self._fault_ns = 0
        self.overwritten = 0
        self.is_attached = False
        self.unseen_s = 0.0
        self.reset_count = 0
        #: Wakes the helper thread. Unlike `Event` it is in C: Ctrl-C in the program leaves no lock held.
        self._wake: queue.SimpleQueue[None] = queue.SimpleQueue()
        #: State of the newest look, until a step is taken on it or on a newer one.
        self._noted: deque[Floats] = deque(maxlen=1)
        self._has_idled = False  # since the newest look
        self._drives = False
        self._use(model, data)
        #: The newest finite state of the user's data.
        self._plant = read_plant_state(model, data)
        self._last_tick_ns = stepper.clock()
        self._began_ns = self._round_ns = self._usual_ns = 0  # newest round: begin, length; length of the one before
        self._last_time = -1.0
        self._began_time: float | None = None  # of the newest round, None after a reset
        self._ticks_before = 0  # of the round before the newest, 0 when there is none
        self._in_tick = False
        self._was_reset = False
        self._helper = threading.Thread(target=self._run_helper, name="iris-session-idle", daemon=True)
        self._helper.start()

    def _use(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self.model, self.data = model, data
        scene = self._stepper.core.scene
        self._objects = {spec.name: int(model.body(spec.body).id) for spec in scene.objects}
        self._joints = {
            spec.name: np.array([model.jnt_qposadr[model.joint(name).id] for name in spec.joints], np.intp)
            for spec in scene.robots
        }
        self._ctrl, self._forces = _BorrowedArray(data.ctrl), _BorrowedArray(data.xfrc_applied)
        self._state_size = mujoco.mj_stateSize(model, STATE)
        self._ctrl_at = mujoco.mj_stateSize(model, STATE & (_CTRL - 1))
        self._forces_at = mujoco.mj_stateSize(model, STATE & (_XFRC - 1))
        self._noted.clear()
        self._left: dict[str, Floats] = {}  # joints of driven robots after the newest round in which time passed

    @property
    def is_driving(self) -> bool:
        """True while the session writes something, so that every step of the program must be a tick."""
        return bool(self._drives or self._ctrl.indices.size or self._forces.indices.size)

    @property
    def is_closed(self) -> bool:
        """True from `close` on."""
        return self._closed.is_set()

    @property
    def has_ended(self) -> bool:
        """True once a step of the session was broken off."""
        return self._stepper.has_ended

    def note_time(self) -> None:
        """Note the time of the data after the program has done something else than a step: back is a reset."""
        self._detect_reset()
        if not self.is_driving:  # else it is a gap
            self._last_tick_ns = self._stepper.clock()

    def read_clock(self) -> int:
        """Return session time [ns]."""
        return self._stepper.clock()

    def note_step(self, began_ns: int, began_time: float) -> None:
        """Note a step of the program during which the session drove nothing: its begin in session and data time [s]."""
        time = float(self.data.time)
        if began_time < self._last_time or time < began_time:
            self.reset()
        elif self._last_time >= 0.0:
            self.unseen_s += began_time - self._last_time
        self._last_time = time
        self._last_tick_ns = now_ns = self._stepper.clock()
        self._usual_ns, self._round_ns = max(self._round_ns, 1), now_ns - began_ns

    def look(self) -> None:
        """Show the data as it is, if the state is due. While nothing is driven.

        The helper thread takes the step, and shows a state that is not due should the program fall silent. A reset is
        shown at once.
        """
        self._require_open()
        self._began_time = None
        self._left = {}
        if self._was_reset or self._stepper.last is None:
            with self.lock:
                self._show_reset()
            return
        state = np.empty(self._state_size)
        mujoco.mj_getState(self.model, self.data, state, STATE)
        self._noted.append(state)
        # A step of the idle helper has shown the state before this one once more: this one does not wait for its turn.
        if self._has_idled or self._stepper.is_state_due(self._last_tick_ns):
            self._wake_helper()

    def _show_reset(self) -> None:
        """Take a step on the data after a reset. Not while it is not finite, but for one step that says so."""
        is_known = self.fault is not None
        if self._read_plant():
            self._post_reset()
        elif is_known:
            return
        self._step(0, self._plant)
        self._processes.supervise(self._stepper)
        self._last_tick_ns = self._stepper.clock()

    def begin_tick(self, n_ticks: int = 0) -> None:
        """One step: writes `ctrl` (and wrenches on hand-held objects) into the user's data. Ends a tick that began.

        Args:
            n_ticks: Ticks of physics that follow; 0 for as many as in the rounds before.
        """
        with self.lock:
            self._require_open()
            if self._in_tick:
                self._finish_tick()
            self._in_tick = True
            passed = float(self.data.time) - self._last_time if self._last_time >= 0.0 else 0.0
            self.unseen_s += max(0.0, passed)
            self._detect_reset()
            if passed == 0.0:
                self._detect_move()
            self._post_gap()
            self._ctrl.read(self.data.ctrl)
            self._forces.read(self.data.xfrc_applied)
            if not self._read_plant():
                self._step(0, self._plant)
                self._ctrl.put_written(self.data.ctrl)
                return
            self._post_reset()
            counted = self._count_ticks()
            self._step(n_ticks or counted, self._plant, publish=False)
            self._write_controls()

    def end_tick(self) -> None:
        """Publish the state after the user's `mj_step`. Raises `OwnershipError` when no tick has begun."""
        with self.lock:
            self._require_open()
            if not self._in_tick:
                raise OwnershipError("end_tick() ends a tick: call begin_tick() before it, then mj_step")
            if self._finish_tick():
                self._post_reset()  # the next step, be it the helper's, is on the state after it
            self._last_tick_ns = self._stepper.clock()
            self._round_ns = self._last_tick_ns - self._began_ns

    def reset(self) -> None:
        """Note that the user resets the data before the next tick: robots are then where that tick finds them."""
        self._was_reset = True
        self.reset_count += 1

    @property
    def driven(self) -> tuple[str, ...]:
        """Robots that the session drives: a participant holds them and has engaged, or they are being given back."""
        return () if self.is_closed or self.has_ended else self._stepper.core.driven

    def change_model(
        self, model: mujoco.MjModel, data: mujoco.MjData, prepare: Callable[[bytes], NextScene | None]
    ) -> None:
        """Go on with another model and data, which is a reset: the owner's program has built its world anew.

        `prepare` makes the new scene from the state of `data`, and `None` when it is the present one. It takes long,
        and steps without ticks go on meanwhile.
        """
        plant = read_plant_state(model, data)
        scene = prepare(plant)
        with self.lock:
            self._in_tick = False
            self._ctrl.read(self.data.ctrl)
            self._ctrl.put_owner(self.data.ctrl)
            self._forces.read(self.data.xfrc_applied)
            self._forces.put_owner(self.data.xfrc_applied)
            if scene is None:
                self.reset()
                self._use(model, data)
            else:
                scenes = self._processes.scenes
                with scenes.lock:  # no patch comes between
                    while self._stepper.inputs.scenes:  # patches of the present scene
                        self._step(0, self._plant)
                    scenes.show(scene.shown)
                    self._stepper.inputs.queue_scene(scene)
                self._plant = plant
                self._step(0, plant, publish=False)
                self._use(model, data)
                self._began_time = None
            self._last_time = float(data.time)

    def close(self) -> None:
        """End the helper thread and leave driven robots of the user's data at rest, without our forces on objects."""
        self._closed.set()
        self._wake_helper()
        if self._helper is not threading.current_thread():
            self._helper.join(timeout=2.0)
        with self.lock:
            self._ctrl.read(self.data.ctrl)
            self._forces.read(self.data.xfrc_applied)
            if (self._ctrl.indices.size or self._forces.indices.size) and self._read_plant():
                self._stepper.core.write_rest_controls(self._plant)
                self._write_controls()
            self._ctrl, self._forces = _BorrowedArray(self.data.ctrl), _BorrowedArray(self.data.xfrc_applied)
            self._drives = False

    def end(self, error: Exception) -> None:
        """End the session by an error beside its steps: nothing is driven any more."""
        self._stepper.end(error)
        self.close()

    def list_warnings(self) -> tuple[str, ...]:
        """Return what the owner should know, one line each."""
        found = [self.fault.text] if self.fault is not None else []
        if self.overwritten:
            found.append(
                f"ctrl of driven robots was changed between begin and end of {self.overwritten} ticks: set ctrl before "
                "begin_tick(), and not in a control callback"
            )
        # A loop of which nothing is seen has begun no round.
        unseen_s = self.unseen_s + (float(self.data.time) if self._last_time < 0.0 else 0.0)
        if self.is_attached and unseen_s > UNSEEN_S:
            found.append(
                f"{unseen_s:.1f} s were simulated outside of the session's ticks: share the environment, as share(env)"
            )
        return tuple(found)

    def _require_open(self) -> None:
        if self._closed.is_set():
            raise OwnershipError("the session is closed: no tick can be taken any more")
        self._stepper.raise_if_ended()

    def _finish_tick(self) -> bool:
        """Publish the state after a tick; return whether it is one after time went back."""
        self._in_tick = False
        if self._ctrl.is_overwritten(self.data.ctrl):
            self.overwritten += 1
        passed = self._last_time < self.data.time
        went_back = self._detect_reset()
        self._left = {name: self.data.qpos[self._joints[name]] for name in self.driven} if passed else {}
        good = self._read_plant()
        # The epoch of a state after a reset is that of the next step.
        if good and not self._was_reset and self._stepper.is_state_due(self._stepper.clock()):
            self._stepper.core.world.restore_state(self._plant)
            self._stepper.publish(self._stepper.clock())
        self._processes.supervise(self._stepper)
        return good and went_back

    def _step(self, n_ticks: int, plant: bytes, *, publish: bool = True) -> None:
        self._stepper.step(n_ticks, plant, publish=publish)
        core = self._stepper.core
        assert core.sharing is not None
        self._drives = bool(core.sharing.driven or core.controller.holds_objects)

    def _write_controls(self) -> None:
        """Write `ctrl` of driven robots and wrenches on held objects; give back what is neither any more."""
        core = self._stepper.core
        assert core.sharing is not None
        self._ctrl.write(self.data.ctrl, core.sharing.actuators, core.world.ctrl)
        held = np.array([self._objects[name] for name in core.controller.list_held_objects()], np.intp)
        self._forces.write(self.data.xfrc_applied, held, core.world.data.xfrc_applied)

    def _count_ticks(self) -> int:
        """Return for how many ticks of the model this round counts: as many as the last round took, at most as many as
        the round before it, so that a single long round makes no leap."""
        began, self._began_time = self._began_time, float(self.data.time)
        if began is None:
            self._ticks_before = 0
            return 1
        ticks = max(1, round((self._began_time - began) / float(self.model.opt.timestep)))
        before, self._ticks_before = self._ticks_before, ticks
        most = min(MAX_TICKS, max(1, int(MAX_ROUND_S / float(self.model.opt.timestep))))
        return min(most, ticks, before or ticks)

    def _post_gap(self) -> None:
        """Announce a time without ticks: robots hold until clutched again."""
        now_ns = self._stepper.clock()
        silence_ns = now_ns - self._last_tick_ns
        usual_ns, round_ns = self._usual_ns, self._round_ns
        self._usual_ns, self._round_ns = max(round_ns, 1), 0
        if round_ns > max(GAP_NS, LONG_ROUND * usual_ns):
            silence_ns += round_ns
        if silence_ns > GAP_NS:
            self._stepper.inputs.post_own(StalledGap(silence_ns))
        self._last_tick_ns = self._began_ns = now_ns

    def _detect_reset(self) -> bool:
        """Return whether time went back, which is a reset: by the user between ticks, or by MuJoCo within `mj_step`."""
        went_back = bool(self.data.time < self._last_time)
        if went_back:
            self.reset()
        self._last_time = float(self.data.time)
        return went_back

    def _detect_move(self) -> None:
        """Take it for a reset, too, when the owner has put a driven robot elsewhere while time stood still.

        Not where no time passes in rounds: there the owner advances the joints, as for a real robot.
        """
        if self._left and not self._was_reset:
            for name, left in self._left.items():
                if not np.allclose(self.data.qpos[self._joints[name]], left, rtol=0.0, atol=MOVED):
                    self.reset()

    def _read_plant(self) -> bool:
        """Read the user's state with the owner's inputs; return False, and announce it once, while it is not finite."""
        state = np.empty(self._state_size)
        mujoco.mj_getState(self.model, self.data, state, STATE)
        self._noted.clear()
        self._ctrl.put_owner(state[self._ctrl_at :][: self.model.nu])
        self._forces.put_owner(state[self._forces_at :][: 6 * self.model.nbody].reshape(-1, 6))
        return self._accept(state)

    def _accept(self, state: Floats) -> bool:
        """Make a state that of the plant; return False, and announce it once, while it is not finite."""
        if not np.isfinite(state).all():
            if self.fault is None:
                self._fault_ns = self._stepper.clock()
                self.fault = DataFault(self._find_bad_arrays(state), self._fault_ns * 1e-9)
                text = f"the user's simulation has numbers that are not finite: {self.fault.text}"
                self._stepper.inputs.post_own(Marker(request_id=0, text=text))
            return False
        if self.fault is not None:
            self.fault = None
            self._stepper.inputs.post_own(StalledGap(self._stepper.clock() - self._fault_ns))
        self._plant = state.tobytes()
        return True

    def _find_bad_arrays(self, state: Floats) -> tuple[str, ...]:
        """Return the arrays of a state that are not finite."""
        found = []
        for name, part in _FIELDS.items():
            begin = mujoco.mj_stateSize(self.model, STATE & (part - 1))
            if not np.isfinite(state[begin:][: mujoco.mj_stateSize(self.model, part)]).all():
                found.append(name)
        return tuple(found) or ("plugin_state",)

    def _post_reset(self) -> None:
        """Queue a pending reset for the next step, which must be on the state after it."""
        if self._was_reset:
            self._began_time = None
            self._left = {}
            self._stepper.inputs.post_own(ExternalReset())
            self._was_reset = False  # at last: Ctrl-C must not lose it

    def _wake_helper(self) -> None:
        if self._wake.empty():
            self._wake.put(None)

    def _is_silent(self) -> bool:
        return self._stepper.clock() - self._last_tick_ns > IDLE_AFTER_NS

    def _take_helper_step(self) -> None:
        """Take a step on the newest look when it is due, or on any look, or without one, when the loop is silent.

        It has no ticks: ticks are for the `ctrl` that the program's next step applies.
        """
        is_due = bool(self._noted) and (self._has_idled or self._stepper.is_state_due(self._stepper.clock()))
        if not (is_due or self._is_silent()):
            return
        with self.lock:
            if self._closed.is_set():
                return
            if self._noted:
                self._accept(self._noted.popleft())
                self._stepper.make_state_due()
                self._has_idled = False
                self._step(0, self._plant)
            elif self._is_silent():
                self._has_idled = True
                self._step(0, self._plant)
            self._processes.supervise(self._stepper)

    def _run_helper(self) -> None:
        try:
            while not self._closed.is_set():
                with contextlib.suppress(queue.Empty):
                    self._wake.get(timeout=IDLE_PERIOD_S)
                self._take_helper_step()
        except BaseException as error:
            self._stepper.end(error)  # raised at the user's next tick, where it is seen
            _log.error("the session stands still after an error: %s", error)
