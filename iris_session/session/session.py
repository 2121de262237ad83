"""`Session`: one scene, its authority and its processes, driven by our loop or by the user's.

    with Session(model, data) as session:      # our loop, recorded as `closed`
        session.run()

    with Session(model, data) as session:      # the user's loop, recorded as `open`
        while True:
            session.begin_tick()
            mujoco.mj_step(model, data)
            session.end_tick()

    session = Session.attach(model, data)      # one line in an existing script: its steps of data are the session's

The process that makes the `Session` is the authority. Front and recorder are child processes, which are restarted when
they die (`session.processes`).
"""

from __future__ import annotations

import atexit
import copy
import dataclasses
import logging
import os
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Final, Self

import mujoco

from iris_session.control.config import OUTPUT_TARGETS
from iris_session.journal.environment import use_one_blas_thread
from iris_session.physics import Pacer, PacerStats, load_model
from iris_session.physics.load import compute_scene_hash, encode_model
from iris_session.physics.names import list_body_names
from iris_session.protocol.client_messages import Assign, Control, SetScale
from iris_session.protocol.common import MAX_TEXT, Pose
from iris_session.protocol.names import ControlAction, LateCause
from iris_session.protocol.specs import ObjectSpec
from iris_session.session.actions import ActionDrive
from iris_session.session.attachment import Attachment, require_free
from iris_session.session.config import (
    SessionConfig,
    check_arguments,
    check_objects,
    check_robots,
    check_timestep,
    choose_shown,
)
from iris_session.session.core import SessionCore, make_session_core, read_plant_state
from iris_session.session.errors import ConfigError, OwnershipError
from iris_session.session.model_follower import ModelFollower
from iris_session.session.processes import SessionProcesses
from iris_session.session.resume import prepare_session
from iris_session.session.robots import (
    FixedChoice,
    RobotChoice,
    choose_again,
    choose_robots,
    find_drivable_robots,
    fix_choice,
)
from iris_session.session.scene_change import adopt_timestep, prepare_scene
from iris_session.session.session_base import SessionBase
from iris_session.session.simulation import copy_state, require_simulation, unwrap_data, unwrap_model
from iris_session.session.status import DataFault
from iris_session.session.stepper import (
    NextPatch,
    NextScene,
    PendingInputs,
    Stepper,
    make_session_clock,
)
from iris_session.session.tasks import TaskRunner, check_same_task, find_progress_path, load_task
from iris_session.session.tick_times import TickTimes
from iris_session.session.user_loop import UserLoop
from iris_session.system.priority import freeze_garbage_collector, tick_priority

#: Zero-tick steps while paused come at 100 Hz (at least 50 Hz, so that leases and heartbeats go on).
PAUSED_STEP_S: Final = 0.01
#: Most ticks of one step while paused: at 1 ms a tick, steps still come at 50 Hz.
PAUSED_STEP_TICKS: Final = 10
#: The log names an overrun at most so often.
OVERRUN_LOG_PERIOD_NS: Final = 10_000_000_000
#: What `action()` says once participants drive a simulation that `sync` shows.
NO_ACTION: Final = (
    "no adapter fits the action of a simulation that sync() shows, so action() returns it as it is: read "
    "session.targets() and session.grippers(), and write the action of the robots in session.driven_robots() yourself"
)

_log = logging.getLogger(__name__)


class Session(SessionBase):
    """A shared session over one MuJoCo model.

    With `config.resume`, model, state, robots and objects come from the recording. Inputs such as `marker`, `pause` and
    `start_episode` are queued as by `post`, and raise as it does.

    Args:
        model: An `MjModel`, or the path of an MJCF or MJB file.
        data: The state to begin with; `None` for keyframe `home`, else the model's default. `run()` advances a copy of
            it, which is `session.data` from then on.
        config: Settings; `None` for the defaults.
        robots: Robots that can be driven: `None` or `auto` finds them in the model, `none` offers none; or names of
            robots found (legs and fingers, too), the path of a robots file, or specifications.
        objects: Free bodies that robots and hands can take; `None` finds them in the model.
        groups: Groups of geoms that clients show, instead of those of `config`; see `SessionConfig`.
        sites: Groups of sites that clients show; see `SessionConfig`.

    Attributes:
        model, data, robots, objects: Of the present scene.
        origin_ns: `time.monotonic_ns()` at session time 0.
        clock: Returns session time [ns].
        recording_fault: After `close()`, why the recording is incomplete; empty when it is complete.

    Raises:
        ConfigError: A value that cannot be used.
        ResumeError: The recording of `config.resume` cannot be continued.
        TypeError: `model` is no model, `data` no `MjData`.
    """

    def __init__(
        self,
        model: mujoco.MjModel | str | Path | None = None,
        data: mujoco.MjData | None = None,
        config: SessionConfig | None = None,
        *,
        robots: RobotChoice = None,
        objects: Sequence[ObjectSpec] | None = None,
        groups: Iterable[int] | None = None,
        sites: bool | Iterable[int] | None = None,
    ) -> None:
        if (groups is not None or sites is not None) and isinstance(config, SessionConfig | None):
            config = SessionConfig() if config is None else config
            config = dataclasses.replace(config, **choose_shown(config, groups, sites)._asdict())
        self._past, self.config, scene = prepare_session(config, model, data, robots, objects)
        self.model, self.robots, self.objects, self._robot_notices = scene
        self._task = load_task(self.config.task)
        if self._past is not None and self._task is not None:
            check_same_task(self._task, self._past.core.config.authority.task)
        self._task_runner: TaskRunner | None = None
        self._robot_choice: FixedChoice = None
        self._object_choice: tuple[ObjectSpec, ...] | None = None  # of an attached program
        self.data = data
        self.origin_ns = time.monotonic_ns() if self._past is None else self._past.origin_ns
        self.clock = make_session_clock(self.origin_ns)
        self._processes: SessionProcesses | None = None
        self._core: SessionCore | None = None
        self._stepper: Stepper | None = None
        self._user_loop: UserLoop | None = None
        self._inputs = PendingInputs()
        self._pacer: Pacer | None = None
        self._stop = threading.Event()
        self._attachment: Attachment | None = None
        self._follower: ModelFollower | None = None
        self._actions: ActionDrive | None = None  # of an environment that is driven by its action
        self._warns_of_action = False
        self._requested_ticks = 0  # by a director, while paused
        self._scheduling = "normal"
        self._next_overrun_log_ns = 0
        self.recording_fault = ""
        self._log_robot_notices()

    def _list_world_notes(self) -> Sequence[str]:
        return self._robot_notices

    def _log_robot_notices(self) -> None:
        for text in self._robot_notices:
            _log.warning("%s", text)

    # --- life --------------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Open the sockets and the recording. Called by `with`. Participants can join from here on.

        Raises:
            ControlError, PhysicsError, ConfigError: The robots cannot be driven; nothing was opened.
            StartError: A port is in use, a folder cannot be written, a key is missing.
            OwnershipError: The session is closed, or MuJoCo's control callback is set.
        """
        if self._processes is None:
            self._require_open()
            if mujoco.get_mjcb_control() is not None:  # called for the session's own data, and while models compile
                raise OwnershipError("mjcb_control is set, for every data of this process: write ctrl before mj_step")
            core = self._make_core(user_owned=False)
            processes = SessionProcesses(self.config, core, self.origin_ns, self._past)
            try:
                processes.start()
            except BaseException:
                if self._past is not None:
                    self._past.close()  # else no other process could resume it until this one ends
                raise
            processes.reporter.warning_sources.append(lambda: [text[:MAX_TEXT] for text in self._robot_notices])
            self._processes, self._process = processes, os.getpid()

    def close(self) -> bool:
        """Notify clients, finish the recording, end every child process. May be called twice.

        In a user loop the robots that participants drive are left at rest where they are commanded (torque actuators:
        with the torques that hold them now); all others are the owner's as before.

        Returns:
            False when the recording is incomplete; `recording_fault` says why.
        """
        if self._is_forked:
            return True
        self._stop.set()
        self._is_closed = True
        atexit.unregister(self.close)
        if self._attachment is not None:
            self._attachment.close()
            self._attachment = None
        try:
            if self._user_loop is not None:
                self._user_loop.close()
        finally:
            if self._task_runner is not None:
                self._task_runner.close()
            if self._processes is not None:
                self.recording_fault = self._processes.close()
                self._recording, self._processes = self._processes.recording, None
            if self._past is not None:
                self._past.close()
        return not self.recording_fault

    # --- our loop ----------------------------------------------------------------------------------------------------

    def run(self, seconds: float | None = None, until: Callable[[], object] | None = None) -> None:
        """Advance physics in real time until `stop()`, Ctrl-C or SIGTERM, or until an argument ends the run.

        Every step has one tick. A tick that misses its deadline is taken late and counted (`status().lateness`).

        Args:
            seconds: Session time to run [s]; `None` for no limit.
            until: Called before every step; a true result ends the run. It may call methods of the session.

        Raises:
            ConfigError: The timestep of the model is out of range.
            OwnershipError: The session is not started, or a user loop drives it.
        """
        check_timestep(self.model)
        use_one_blas_thread()  # for the same bits in every run
        stepper = self._make_stepper(user_owned=False)
        with self.signals(), freeze_garbage_collector(), tick_priority(self.config.realtime) as self._scheduling:
            # Counted from here: collecting garbage in a large process takes longer than a short run.
            end_ns = None if seconds is None else self.clock() + int(seconds * 1e9)
            pacer = self._pacer = Pacer(stepper.core.world.tick_period_ns, self.clock())
            times = self._measure_ticks(stepper, pacer)
            while not self._stop.is_set():
                now_ns = self.clock()
                if (end_ns is not None and now_ns >= end_ns) or (until is not None and until()):
                    break
                self._take_step(stepper, pacer, times)
        pacer.pause(self.clock())  # no tick is late after the end of the run

    def _take_step(self, stepper: Stepper, pacer: Pacer, times: TickTimes) -> None:
        """Wait until the next step is due, take it, and look after the processes."""
        times.lap(LateCause.OWNER)
        if stepper.paused:
            self._take_paused_step(stepper, pacer, times)
            times.restart_chain()
        else:
            self._take_tick(stepper, pacer, times)
        self._require_started().supervise(stepper)
        times.lap(LateCause.SUPERVISION)

    def _measure_ticks(self, stepper: Stepper, pacer: Pacer) -> TickTimes:
        """Measure the parts of every tick from here on, for status reports."""
        times = TickTimes(pacer.period_ns, self.clock)
        stepper.on_lap = times.lap
        reporter = self._require_started().reporter
        reporter.pacer, reporter.times, reporter.scheduling = pacer, times, self._scheduling
        return times

    def _take_tick(self, stepper: Stepper, pacer: Pacer, times: TickTimes) -> None:
        self._requested_ticks = 0
        now_ns = self.clock()
        pacer.resume(now_ns)
        wait_ns = pacer.next_deadline_ns - now_ns
        if wait_ns > 0:
            time.sleep(wait_ns * 1e-9)
            times.begin_chain(pacer.next_deadline_ns)
        else:
            self._count_skipped(pacer.skip_backlog(now_ns), times)
        began_ns = max(now_ns, pacer.next_deadline_ns)
        stepper.step(1)
        if not adopt_timestep(stepper, pacer, times, began_ns):
            lateness_ns = pacer.finish_tick(self.clock())
            times.finish_tick(lateness_ns)
            stepper.lateness_ns = max(stepper.lateness_ns, lateness_ns)

    def _count_skipped(self, ticks: int, times: TickTimes) -> None:
        times.count_skipped(ticks)
        if ticks and self.clock() >= self._next_overrun_log_ns:
            self._next_overrun_log_ns = self.clock() + OVERRUN_LOG_PERIOD_NS
            _log.warning("tick loop overrun: %d ticks were skipped", ticks)

    def _take_paused_step(self, stepper: Stepper, pacer: Pacer, times: TickTimes) -> None:
        """Take a step with zero ticks, or a few of those that a director asked for: an e-stop never waits for many."""
        assert stepper.last is not None
        pacer.pause(self.clock())
        time.sleep(PAUSED_STEP_S)
        decision = stepper.last.decision
        left = 0 if decision.reset else self._requested_ticks
        self._requested_ticks = min(left + decision.step_ticks, self.config.authority.max_step_ticks)
        n_ticks = min(self._requested_ticks, PAUSED_STEP_TICKS)
        self._requested_ticks -= n_ticks
        stepper.step(n_ticks)
        adopt_timestep(stepper, pacer, times, self.clock())

    # --- user loop ---------------------------------------------------------------------------------------------

    def begin_tick(self) -> None:
        """Process inputs of participants and write `data.ctrl` of the robots that they drive; call right before
        `mj_step`, after you have written yours.

        Raises:
            OwnershipError: The session is closed, or has no `data`, or is driven by `run()`.
        """
        self._require_user_loop().begin_tick()

    def end_tick(self) -> None:
        """Publish the state after the user's `mj_step`.

        Raises:
            OwnershipError: No tick has begun.
        """
        self._require_user_loop().end_tick()

    def driven_robots(self) -> tuple[str, ...]:
        """Return the robots whose `ctrl` the session writes in your own loop; all others are yours.

        A participant holds them and has engaged, or they are on their way back to you.
        """
        with self._hold_steps():
            return () if self._user_loop is None else self._user_loop.driven

    def targets(self) -> dict[str, Pose]:
        """Return the end-effector targets `T_world_tip` by robot, for an environment's own controller [m].

        In your own loop, use those of `driven_robots()`; for other robots they are where the robot is.
        """
        self._require_started()
        with self._hold_steps():
            return {} if self._core is None else dict(self._core.controller.get_targets())

    def grippers(self) -> dict[str, float]:
        """Return how far the gripper of each robot that has one is to be closed: 0 open to 1 closed.

        In your own loop, use those of `driven_robots()`; for other robots they are what your `ctrl` commands.
        """
        self._require_started()
        with self._hold_steps():
            return {} if self._core is None else self._core.controller.get_grippers()

    def action(self, action: Any) -> Any:
        """Return the action of a policy with the part of the participants in it, for an environment that was shared by
        `share(env, drive="action")`.

        Call it before each `env.step`: `env.step(session.action(action))`. It replaces the entries of the robots in
        `driven_robots()`; their end effectors follow `targets()`, their grippers `grippers()`. No entry jumps by more
        than one step of the environment allows, also when a robot is given back.

        Nothing that a participant does makes it raise an error. A robot that it cannot drive stays yours, and a warning
        in the session's status and in the log says why: where only the shape tells that the action is joint positions,
        two steps in a row must have set `ctrl` to an action that is not zero; after `sync` it can drive none.

        Args:
            action: Array of one environment, shape (n,), or a list or tuple of numbers.

        Returns:
            A copy of the same type, shape and dtype. The very same object while no participant drives.

        Raises:
            ConfigError: No adapter fits this environment and action, or the session was not shared in this way.
            OwnershipError: The session was not started.
        """
        if self._is_closed or self._is_forked:  # by another thread; or the parent has the session
            return action
        self._require_started()
        if self._attachment is None and self._user_loop is not None and self.config.control.output == OUTPUT_TARGETS:
            self._warn_of_action(self._user_loop)
            return action
        if self._actions is None or self._attachment is None:
            raise ConfigError(
                'action() needs an environment that steps MuJoCo in Python, shared by share(env, drive="action"); '
                "targets() and grippers() say where the robots of any other are to go"
            )
        loop = self._require_user_loop()
        self._attachment.follow_environment()
        with loop.lock:
            # The data of a model that is not followed says nothing about where robots are.
            driven = () if self._attachment.fault else loop.driven
            scene = loop.model, loop.data, self.robots
            if not driven or self._core is None:
                return self._actions.apply(action, scene, (), {}, {})
            held = self._core.controller.list_held()
            return self._actions.apply(action, scene, driven, self.targets(), self.grippers(), held)

    def _warn_of_action(self, loop: UserLoop) -> None:
        """Warn once participants drive that `action()` has no part in a simulation that `sync` shows."""
        if self._warns_of_action or not loop.driven:
            return
        self._warns_of_action = True
        _log.warning("%s", NO_ACTION)
        self.processes.reporter.warning_sources.append(lambda: (NO_ACTION,) if loop.driven else ())

    def sync(self, data: Any) -> None:
        """Show the state of a simulation that steps outside of Python's MuJoCo: MJX, another process, a real robot.

        Call it after each of its steps. It is copied into `session.data`, where `ctrl` then has what participants
        command for the robots in `driven_robots()`, and the simulation's own values for all others.

        Args:
            data: Any object with `qpos`, shape (nq,), and what else it knows of `time` [s], `qvel`, `act`, `ctrl`,
                `mocap_pos`, `mocap_quat`, as arrays of NumPy or JAX. A state of MuJoCo Playground has it in `.data`.

        Raises:
            OwnershipError: The session is closed, or has no `data`, or is driven by `run()`.
            PublishError: The arrays are not those of the model.
        """
        loop = self._require_user_loop()
        began_ns, began_time = loop.read_clock(), float(loop.data.time)
        copy_state(data, loop.data)
        if loop.is_driving:
            loop.begin_tick()
            loop.end_tick()
        else:
            loop.note_step(began_ns, began_time)
            loop.look()

    def describe_robots(self) -> str:
        """Return the lines of a robots file of the present model, for you to complete and give as `robots=`.

        Returns:
            TOML: the robots that are found, and those about which something is unclear, with comments that say what.
        """
        return find_drivable_robots(self.model, self.config.control).to_toml()

    @classmethod
    def attach(
        cls,
        model: mujoco.MjModel | None = None,
        data: mujoco.MjData | None = None,
        config: SessionConfig | None = None,
        *,
        environment: object = None,
        step: str = "step",
        robots: RobotChoice = None,
        objects: Sequence[ObjectSpec] | None = None,
        groups: Iterable[int] | None = None,
        sites: bool | Iterable[int] | None = None,
    ) -> Self:
        """Share a script's own simulation: every `mj_step(model, data)` after this line is seen by the session.

        `mujoco.mj_step` and `mj_step2` are wrapped, in every module that uses them, and act as before on all other
        data. Models and data that the script makes meanwhile are not touched. Time that goes back is a reset. While a
        participant drives, every step is a tick of the session; otherwise the state is looked at as often as it is
        published. The session ends with `close()`, or with the script.

        Args:
            model: The model that the script simulates; `None` for that of `environment`. Bindings of dm_control and
                robosuite are accepted, too.
            data: The data that the script advances; `None` for that of `environment`.
            config: Settings; `None` for the defaults.
            environment: Object that owns the simulation: a Gymnasium, robosuite or dm_control environment or physics,
                or any object with `model` and `data`. The session follows it to the model and data that it builds at a
                reset. Its step is a tick by itself where it does not call MuJoCo's functions in Python.
            step: Name of its method that advances the simulation.
            robots: As of `Session`. The choice holds for models that are built at a reset, too; what one of them lacks
                is in `notes`.
            objects: As of `Session`.
            groups: As of `Session`.
            sites: As of `Session`.

        Returns:
            The started session.

        Raises:
            OwnershipError: A session is attached to this data already, or `environment` has no such method.
            ConfigError: No model and data are given, and `environment` shows none.
            StartError: A port is in use, a folder cannot be written, a key is missing.
        """
        model, data = unwrap_model(model) or model, unwrap_data(data) or data
        if model is None or data is None:
            if environment is None:
                raise ConfigError("attach: no model and data are given: Session.attach(model, data)")
            model, data = require_simulation(environment)
            if data is None:
                kind = type(environment).__name__
                raise ConfigError(f"attach: {kind} has no MjData: use share(environment), and sync(data) after steps")
        if environment is not None and not callable(getattr(environment, step, None)):
            raise OwnershipError(f"environment of type {type(environment).__name__} has no method {step!r} to wrap")
        require_free(data)
        robots = check_robots(robots)
        session = cls(model, data, config, robots=robots, objects=objects, groups=groups, sites=sites)
        try:
            session._robot_choice = fix_choice(model, robots, session.config.control)
            session._object_choice = None if objects is None else session.objects
            session.start()
            loop = session._require_user_loop()
            if environment is not None and session.config.control.output == OUTPUT_TARGETS:
                session._actions = ActionDrive(environment, session.config.control)
            interventions = None if session._actions is None else session._actions.list_interventions
            session._attachment = Attachment(loop, environment, step, session._change_model, interventions)
            session.processes.reporter.warning_sources.append(session._attachment.list_warnings)
            session._attachment.on_environment = session._look_at_goals
            if session._actions is not None:
                session.processes.reporter.warning_sources.append(session._actions.list_warnings)
        except BaseException:
            session.close()
            raise
        atexit.register(session.close)  # a script may simply end
        return session

    def _look_at_goals(self, is_reset: bool) -> None:
        """Look at goals after every step and reset of the environment, where they are as it draws them."""
        attachment = self._attachment
        if self._follower is not None and self.data is not None and attachment is not None and not self._is_closed:
            with self._hold_steps():
                self._follower.follow_environment(attachment.environment, self.data, is_reset=is_reset)

    def _change_model(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Go on with another model and data of the attached environment."""
        loop, stepper, scenes = self._require_user_loop(), self.stepper, self._require_started().scenes

        def prepare(state: bytes) -> NextScene | None:
            if compute_scene_hash(encode_model(model)) == stepper.core.world.scene_hash:
                return None
            found = choose_again(model, self._robot_choice, self.config.control)
            objects = self._object_choice
            if objects is not None:
                bodies = list_body_names(model)
                objects = tuple(spec for spec in objects if spec.body in bodies)
            scene = prepare_scene(stepper.core, scenes, model, state, found, objects)
            if scene.notices != self._robot_notices:
                self._robot_notices = scene.notices
                self._log_robot_notices()
            return scene

        loop.change_model(model, data, prepare)
        self.model, self.data = model, data
        if self._follower is not None:
            self._follower.follow_model(model)
        self.robots, self.objects = stepper.core.scene.robots, stepper.core.scene.objects

    def _hold_steps(self) -> AbstractContextManager[object]:
        """Return a context in which the helper thread of a user loop takes no step."""
        # In a child that was forked the helper thread does not go on, and may have held the lock.
        return nullcontext() if self._user_loop is None or self._is_forked else self._user_loop.lock

    def _find_data_fault(self) -> DataFault | None:
        return None if self._user_loop is None else self._user_loop.fault

    def _require_user_loop(self) -> UserLoop:
        if self._user_loop is None:
            if self.data is None:
                raise OwnershipError("begin_tick() needs the data that your loop advances: Session(model, data)")
            stepper = self._make_stepper(user_owned=True)
            processes = self._require_started()
            self._user_loop = UserLoop(self.model, self.data, stepper, processes)
            processes.reporter.warning_sources.append(self._user_loop.list_warnings)
        return self._user_loop

    # --- inputs of the owner ---------------------------------------------------------------------------------------

    def pause(self) -> None:
        """Pause physics; leases, heartbeats and requests continue."""
        self.post(Control(request_id=0, action="pause"))

    def resume(self) -> None:
        """Continue physics; robots hold until participants clutch again."""
        self.post(Control(request_id=0, action="resume"))

    def reset(self) -> None:
        """Return to the initial state, in a new `scene_epoch`.

        In a user loop this announces that the loop does so before the next tick.
        """
        if self._user_loop is not None:
            self._user_loop.reset()
        else:
            self.post(Control(request_id=0, action="reset"))

    def assign(self, robots: Sequence[str], participant: str = "") -> None:
        """Give robots to a participant, also when another one holds them.

        Args:
            robots: Names of robots.
            participant: Id of the participant; empty to release the robots.
        """
        self.post(Assign(request_id=0, robots=tuple(robots), participant=participant))

    def set_scale(self, robot: str, scale: float) -> None:
        """Set the motion scale of a robot until its holder changes.

        Args:
            robot: Name of the robot.
            scale: Motion of the robot per motion of the hand: 1 moves as far, 0.1 a tenth.
        """
        self.post(SetScale(request_id=0, robots=(robot,), scale=scale))

    @property
    def stepper(self) -> Stepper:
        """The stepper of this session, for benchmarks and tests; not part of the public API."""
        return self._make_stepper(user_owned=self._user_loop is not None)

    def lateness(self, *, anew: bool = False) -> PacerStats | None:
        """Return the lateness of ticks of the newest `run()`, `None` before it.

        Args:
            anew: Begin the percentiles again from here.
        """
        return None if self._pacer is None else self._pacer.get_stats(self.clock(), anew=anew)

    def load_scene(
        self,
        model: mujoco.MjModel | str | Path,
        data: mujoco.MjData | None = None,
        *,
        robots: RobotChoice = None,
        objects: Sequence[ObjectSpec] | None = None,
        groups: Iterable[int] | None = None,
        sites: bool | Iterable[int] | None = None,
    ) -> Future[None]:
        """Load another scene into the running session: a new `scene_epoch` with the same participants.

        The holder of a robot whose name the new scene has too keeps it and must clutch again; other leases end. The
        model is compiled and prepared in a thread while the session continues with the old scene. Ticks then have the
        timestep of the new model, and clients are notified.

        Call it once `run()` has begun: from another thread, from `until`, or between two runs (the next one loads the
        scene).

        Args:
            model: An `MjModel`, or the path of an MJCF or MJB file.
            data: The state to begin with; `None` for keyframe `home`, else the model's default.
            robots: As of `Session`.
            objects: `None` finds them in the model.
            groups: As of `Session`, for this scene.
            sites: As of `Session`, for this scene.

        Returns:
            A future that is done when the scene is ready for the next step. It raises `ModelNotFoundError`,
            `ModelInvalidError`, `ControlError`, or `ConfigError` for a timestep out of range.

        Raises:
            OwnershipError: In a user loop, whose model is not ours, and before the first `run()`.
            TypeError: `model` is no model.
            ConfigError: `robots` or `objects` are none, or `groups` or `sites` no groups.
        """
        if self._user_loop is not None:
            raise OwnershipError("load_scene: your own loop owns the model; end this session and begin another with it")
        if not isinstance(model, str | Path):
            check_arguments(model, data, self.config)
        stepper = self._stepper
        if stepper is None:
            raise OwnershipError(
                "load_scene needs a session that has begun to run: call it after the first run(), or during it; "
                "what a session begins with is given to Session(model)"
            )
        done: Future[None] = Future()
        scenes = self._require_started().scenes
        chosen, things = check_robots(robots), check_objects(objects)
        shown = choose_shown(self.config, groups, sites)
        state_data = copy.copy(data)  # the caller may continue with theirs

        def prepare() -> None:
            try:
                loaded = load_model(model) if isinstance(model, str | Path) else model
                check_arguments(loaded, state_data, self.config)
                state = b"" if state_data is None else read_plant_state(loaded, state_data)
                found = choose_robots(loaded, chosen, self.config.control)
                scene = prepare_scene(stepper.core, scenes, loaded, state, found, things, shown)
                with scenes.lock:
                    self._inputs.queue_scene(scene)
                    scenes.show(scene.shown)
            except BaseException as error:  # raised by the future
                done.set_exception(error)
            else:
                done.set_result(None)

        done.set_running_or_notify_cancel()
        threading.Thread(target=prepare, name="iris-scene", daemon=True).start()
        return done

    def _follow_scene(self, scene: NextScene | NextPatch) -> None:
        if isinstance(scene, NextPatch):
            return
        plant = scene.plant
        self.model, self.data = plant.world.model, plant.world.data
        self.robots, self.objects, self._robot_notices = plant.scene.robots, plant.scene.objects, scene.notices
        self._log_robot_notices()

    # --- inside ------------------------------------------------------------------------------------------------------

    def _make_stepper(self, *, user_owned: bool) -> Stepper:
        if self._stepper is not None:
            if user_owned != self._stepper.core.config.authority.user_owned_loop:
                raise OwnershipError("a session is driven either by run(), or by begin_tick() and end_tick()")
        else:
            live, core = self._require_started(), self._make_core(user_owned=user_owned)
            stepper = live.make_stepper(core, self.clock, self._inputs, user_owned=user_owned)
            stepper.list_notices = lambda: self._robot_notices
            if core.config.authority.task is not None:
                given = self.config.task
                progress = find_progress_path(Path(given)) if isinstance(given, str | Path) else None
                self._task_runner = TaskRunner(stepper, progress, is_new=self._past is None)
            if user_owned:  # its data is used as it is now: there is nothing to reset
                for message in self._inputs.messages.copy():
                    if isinstance(message, Control) and message.action == ControlAction.RESET:
                        self._inputs.messages.remove(message)
            else:
                self.data = core.world.data
                stepper.on_scene.append(self._follow_scene)
            self._follower = ModelFollower(live.scenes, stepper, self.patch_scene)
            stepper.on_publish.append(self._follower.follow_publish)
            self._stepper = stepper
        return self._stepper

    def _make_core(self, *, user_owned: bool) -> SessionCore:
        """Return the core for the data as it is now; the one made at the start when nothing has changed since."""
        if self._past is not None:
            if user_owned:
                raise OwnershipError("a resumed session is driven by run(): its physics are in the recording")
            return self._past.core
        scene = self.model, self.data, self.robots, self.objects
        self._core = make_session_core(self.config, *scene, user_owned, self._core, self._task)
        return self._core
