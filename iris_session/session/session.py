"""`Session`: one scene, its authority and its processes, driven by our loop or by the user's.

    with Session(model, data) as session:      # our loop, recorded as `closed`
        session.run()

    with Session(model, data) as session:      # the user's loop, recorded as `open`
        while True:
            session.begin_tick()
            mujoco.mj_step(model, data)
            session.end_tick()

    session = Session.attach(model, data)      # one line in an existing script: MuJoCo's control callback

The process that makes the `Session` is the authority. Front and recorder are started by exec, watched, and replaced or
announced when they die (`runtime.processes`).
"""

from __future__ import annotations

import atexit
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Final, Self

import mujoco

from iris_session.physics import Pacer, PacerStats
from iris_session.protocol.client_messages import Assign, Control, EStop, SetScale
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import EntryMessage
from iris_session.protocol.names import ControlAction, LateCause
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.recording.environment import use_one_blas_thread
from iris_session.session.config import SessionConfig
from iris_session.session.config_checks import check_timestep
from iris_session.session.continuation import begin
from iris_session.session.core import SessionCore, core_of
from iris_session.session.errors import OwnershipError
from iris_session.session.owner import Owner
from iris_session.session.processes import SessionProcesses
from iris_session.session.scene_change import SceneChanges, follow_timestep
from iris_session.session.stepper import MAX_HOST_ENTRIES, ROOM_FOR_OURS, Stepper, checked, session_clock
from iris_session.session.tick_times import TickTimes
from iris_session.session.user_loop import UserLoop
from iris_session.system.priority import freeze_garbage_collector, tick_priority

#: Zero-tick steps while paused come at 100 Hz (at least 50 Hz, so that leases and heartbeats go on).
PAUSED_STEP_S: Final = 0.01
#: Most ticks of one step while paused: at 1 ms a tick, steps still come at 50 Hz.
PAUSED_STEP_TICKS: Final = 10


class Session(Owner, SceneChanges):
    """A shared session over one MuJoCo model.

    `model`: an `MjModel`, or the path of an MJCF or MJB file. `data`: the state to begin with (None: keyframe `home`,
    else the model's default). With our loop a copy of it is advanced (`session.data` from then on). `robots`,
    `objects`: None finds them in the model. With `config.resume` all of them come from the recording. Raises
    `AmbiguousModelError`, `ConfigError`, `StartError`, `ResumeError`.
    """

    def __init__(
        self,
        model: mujoco.MjModel | str | Path | None = None,
        data: mujoco.MjData | None = None,
        config: SessionConfig | None = None,
        *,
        robots: Sequence[RobotSpec] | None = None,
        objects: Sequence[ObjectSpec] | None = None,
    ) -> None:
        self._past, self.config, scene = begin(config, model, data, robots, objects)
        self.model, self.robots, self.objects = scene
        self.data = data
        self.origin_ns = time.monotonic_ns() if self._past is None else self._past.origin_ns
        self.clock = session_clock(self.origin_ns)
        self._processes: SessionProcesses | None = None
        self._core: SessionCore | None = None
        self._stepper: Stepper | None = None
        self._user_loop: UserLoop | None = None
        self._early: list[EntryMessage] = []  # posted before anybody drove the session
        self._handing_over = threading.RLock()  # of those; a signal handler may post, too
        self._early_patches = []
        self._pacer: Pacer | None = None
        self._stop = threading.Event()
        self._attached = False
        self._callback: Callable[[mujoco.MjModel, mujoco.MjData], None] | None = None
        self._asked_ticks = 0  # by a director, while paused
        self._scheduling = "normal"
        #: Why the recording is incomplete, known after `close()`; empty when it is not.
        self.recording_fault = ""

    # --- life --------------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Opens the sockets and the recording. Called by `with`. Participants can connect from here on.

        Raises before it opens anything when the robots cannot be driven: `ControlError`, `PhysicsError`, `ConfigError`;
        afterwards `StartError`: a port in use, a folder that cannot be written, a key that is missing.
        """
        if self._processes is None:
            self._check_open()
            core = self._make_core(user_owned=False)
            processes = SessionProcesses(self.config, core, self.origin_ns, self._past)
            processes.start()
            self._processes = processes

    def close(self) -> bool:
        """Tells everyone that the session ends, finishes the recording, ends every process. Can be called twice.

        False: the recording is incomplete, `recording_fault` says why. In a user's loop the robots of `data` are left
        at rest where they are commanded (torque actuators: with the torques that hold them now).
        """
        self._stop.set()
        self._ended = True
        if self._attached:
            if mujoco.get_mjcb_control() is self._callback:  # it may be somebody else's by now
                mujoco.set_mjcb_control(None)
            atexit.unregister(self.close)
            self._attached = False
        if self._user_loop is not None:
            self._user_loop.close()
        if self._processes is not None:
            self.recording_fault = self._processes.close()
            self._recorded, self._processes = self._processes.recording, None
        if self._past is not None:
            self._past.close()
        return not self.recording_fault

    # --- our loop ----------------------------------------------------------------------------------------------------

    def run(self, seconds: float | None = None, until: Callable[[], object] | None = None) -> None:
        """Advances physics in real time until `stop()`, Ctrl-C or SIGTERM, `seconds` of session time, or `until()`.

        One step per tick. A tick that cannot be met in time is taken late and counted (`status().lateness`).
        """
        check_timestep(self.model)
        use_one_blas_thread()  # for the same bits in every run
        stepper = self._make_stepper(user_owned=False)
        with self.signals(), freeze_garbage_collector(), tick_priority(self.config.realtime) as self._scheduling:
            # Counted from here: collecting garbage in a large process takes longer than a short run.
            end_ns = None if seconds is None else self.clock() + int(seconds * 1e9)
            pacer = self._pacer = Pacer(stepper.core.world.tick_period_ns, self.clock())
            times = self._follow(stepper, pacer)
            while not self._stop.is_set():
                now_ns = self.clock()
                if (end_ns is not None and now_ns >= end_ns) or (until is not None and until()):
                    break
                times.lap(LateCause.OWNER)
                if stepper.paused:
                    self._paused_step(stepper, pacer, times)
                    times.idle()
                else:
                    self._tick(stepper, pacer, times)
                self._live().watch(stepper)
                times.lap(LateCause.SUPERVISION)
        pacer.pause(self.clock())  # what nobody asked to run is not late

    def _follow(self, stepper: Stepper, pacer: Pacer) -> TickTimes:
        """Measures the parts of every tick from here on, for status reports."""
        times = TickTimes(pacer.period_ns, self.clock)
        stepper.lap = times.lap
        reporter = self._live().reporter
        reporter.pacer, reporter.times, reporter.scheduling = pacer, times, self._scheduling
        return times

    def _tick(self, stepper: Stepper, pacer: Pacer, times: TickTimes) -> None:
        self._asked_ticks = 0
        now_ns = self.clock()
        pacer.resume(now_ns)
        wait_ns = pacer.next_deadline_ns - now_ns
        if wait_ns > 0:
            time.sleep(wait_ns * 1e-9)
            times.woke(pacer.next_deadline_ns)
        else:
            times.gave_up(pacer.skip_backlog(now_ns))
        began_ns = max(now_ns, pacer.next_deadline_ns)
        stepper.step(1)
        if not follow_timestep(stepper, pacer, times, began_ns):
            lateness_ns = pacer.finished(self.clock())
            times.finished(lateness_ns)
            stepper.lateness_ns = max(stepper.lateness_ns, lateness_ns)

    def _paused_step(self, stepper: Stepper, pacer: Pacer, times: TickTimes) -> None:
        """Zero ticks, or some of those that a director asked for: few, so that an e-stop never waits for many."""
        assert stepper.last is not None
        pacer.pause(self.clock())
        time.sleep(PAUSED_STEP_S)
        decision = stepper.last.decision
        left = 0 if decision.reset else self._asked_ticks
        self._asked_ticks = min(left + decision.step_ticks, self.config.authority.max_step_ticks)
        n_ticks = min(self._asked_ticks, PAUSED_STEP_TICKS)
        self._asked_ticks -= n_ticks
        stepper.step(n_ticks)
        follow_timestep(stepper, pacer, times, self.clock())

    # --- the user's loop ---------------------------------------------------------------------------------------------

    def begin_tick(self) -> None:
        """Reads what participants want and writes `data.ctrl` of the robots; call right before `mj_step`."""
        self._loop().begin_tick()

    def end_tick(self) -> None:
        """Publishes the state after the user's `mj_step`."""
        self._loop().end_tick()

    def targets(self) -> dict[str, Pose]:
        """End-effector targets `T_world_tip` per robot, for an environment's own controller."""
        self._live()
        with self._unchanging():
            return {} if self._core is None else dict(self._core.controller.targets())

    @classmethod
    def attach(cls, model: mujoco.MjModel, data: mujoco.MjData, config: SessionConfig | None = None) -> Self:
        """Shares a script's own simulation: every `mj_step(model, data)` after this line is one tick of the session.

        Uses MuJoCo's control callback, which is global to the process: it acts on `data` only, once per new time, and
        takes time going back as a reset. RK4 calls it four times a step and is refused (`OwnershipError`), as is a
        callback that is already set. The session ends with `close()`, or with the script.
        """
        if int(model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_RK4):
            raise OwnershipError("attach() cannot be used with the RK4 integrator: set integrator='implicitfast'")
        if mujoco.get_mjcb_control() is not None:
            raise OwnershipError("MuJoCo's control callback is in use: call begin_tick() and end_tick() instead")
        session = cls(model, data, config)
        try:
            session.start()
            loop = session._loop()
        except BaseException:
            session.close()
            raise

        def on_control(_: mujoco.MjModel, callback_data: mujoco.MjData) -> None:
            if callback_data is data:
                loop.control_callback()

        mujoco.set_mjcb_control(on_control)
        session._attached, session._callback = True, on_control
        atexit.register(session.close)  # a script may simply end
        return session

    def _unchanging(self) -> AbstractContextManager[object]:
        """Inside, no step is taken by the helper thread of a user's loop."""
        return nullcontext() if self._user_loop is None else self._user_loop.lock

    def _loop(self) -> UserLoop:
        if self._user_loop is None:
            if self.data is None:
                raise OwnershipError("begin_tick() needs the data that your loop advances: Session(model, data)")
            stepper = self._make_stepper(user_owned=True)
            self._user_loop = UserLoop(self.model, self.data, stepper, self._live())
        return self._user_loop

    # --- what the owner may do ---------------------------------------------------------------------------------------

    def post(self, message: EntryMessage) -> None:
        """Puts an input of the owner (connection 0, rights of a director) into the next step. From any thread."""
        self._check_open()
        with self._handing_over:
            if self._stepper is not None:
                self._stepper.post(message)
            elif len(self._early) < MAX_HOST_ENTRIES + (ROOM_FOR_OURS if isinstance(message, EStop) else 0):
                self._early.append(checked(message))
            else:
                raise OwnershipError(f"more than {MAX_HOST_ENTRIES} inputs wait for the first step: call run() first")

    def pause(self) -> None:
        """Stops physics; leases, heartbeats and requests go on."""
        self.post(Control(request_id=0, action="pause"))

    def resume(self) -> None:
        """Continues physics; robots hold until clutched again."""
        self.post(Control(request_id=0, action="resume"))

    def reset(self) -> None:
        """Back to the initial state, in a new `scene_epoch`. In a user's loop: tells that the user does so before the
        next tick."""
        if self._user_loop is not None:
            self._user_loop.reset()
        else:
            self.post(Control(request_id=0, action="reset"))

    def assign(self, robots: Sequence[str], participant: str = "") -> None:
        """Gives robots to a participant, or frees them, whoever holds them."""
        self.post(Assign(request_id=0, robots=tuple(robots), participant=participant))

    def set_scale(self, robot: str, scale: float) -> None:
        """How far `robot` moves as its holder's hand moves: 1 as far, 0.1 a tenth. Ends with that holder."""
        self.post(SetScale(request_id=0, robots=(robot,), scale=scale))

    @property
    def stepper(self) -> Stepper:
        """The machinery behind this session, for benchmarks and tests; not part of the public API."""
        return self._make_stepper(user_owned=self._user_loop is not None)

    def lateness(self, *, anew: bool = False) -> PacerStats | None:
        """Accounting of ticks of the newest `run()`, None before it. `anew`: its percentiles begin again from here."""
        return None if self._pacer is None else self._pacer.stats(self.clock(), anew=anew)

    # --- inside ------------------------------------------------------------------------------------------------------

    def _make_stepper(self, *, user_owned: bool) -> Stepper:
        if self._stepper is not None:
            if user_owned != self._stepper.core.config.authority.user_owned_loop:
                raise OwnershipError("one session is driven in one way: by run(), or by begin_tick() and end_tick()")
        else:
            live, core = self._live(), self._make_core(user_owned=user_owned)
            stepper = live.make_stepper(core, self.clock, user_owned=user_owned)
            if not user_owned:
                self.data = core.world.data
                stepper.on_scene.append(self._take_scene)
            with live.scenes.lock, self._handing_over:  # nothing of another thread comes between
                self._stepper = stepper  # first: what a signal handler posts meanwhile goes there, and is not lost
                for patch in self._early_patches:
                    stepper.change_scene(patch)
                for message in self._early:
                    # The data of a user's loop is taken as it is now: there is nothing to go back from.
                    if not (user_owned and isinstance(message, Control) and message.action == ControlAction.RESET):
                        stepper.say(message)
                self._early_patches.clear()
                self._early.clear()
        return self._stepper

    def _make_core(self, *, user_owned: bool) -> SessionCore:
        """The core for the data as it is now; the one made at the start when nothing has changed since."""
        if self._past is not None:
            if user_owned:
                raise OwnershipError("a resumed session is driven by run(): its physics are in the recording")
            return self._past.core
        self._core = core_of(self.config, self.model, self.data, self.robots, self.objects, user_owned, self._core)
        return self._core
