"""`ScenePublisher`: a session whose world is not a MuJoCo simulation but another simulator or a real robot.

    scene = SceneBuilder("lab")
    scene.add_box("box", half_size=(0.1, 0.1, 0.1), movable=True)
    with ScenePublisher(scene) as session, session.signals():
        while not session.stopping:
            session.set_pose("box", position, quaternion)
            session.publish()

The process that creates it is the authority, as with `Session`. Participants see the scene, point, talk and set
markers. They lease the robots that are given, of which only the end effectors are known here: `targets()` has where
they want them, for the controller of the program. Objects cannot be grasped: for that use `Session(model, data)` with
`begin_tick()` and `end_tick()`.
"""

from __future__ import annotations

import operator
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any, Final

import msgspec
from numpy.typing import ArrayLike

from iris_session.control.config import OUTPUT_TARGETS, ControlError
from iris_session.physics import PhysicsError
from iris_session.physics.kinematic_model import KinematicModel
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import RobotSpec
from iris_session.scene import AssetStore, SceneBuildError
from iris_session.scene.builder import SceneBuilder
from iris_session.session.config import SessionConfig
from iris_session.session.core import make_session_core
from iris_session.session.errors import ConfigError, OwnershipError, PublishError, StartError
from iris_session.session.pending_state import PendingState
from iris_session.session.processes import PublishedScene, SessionProcesses
from iris_session.session.publish_loop import PublishedVertices, PublishLoop
from iris_session.session.session_base import SessionBase
from iris_session.session.stepper import PendingInputs, make_session_clock

#: Period at which `run` calls `until` [s].
RUN_PERIOD_S: Final = 1.0 / 60.0
#: Largest `time_s` [s], 285 years: recordings store nanoseconds in 63 bits.
LONGEST_S: Final = 9e9
#: A capture may lie so far ahead of the session's clock, because the clocks are read one after the other.
AHEAD_NS: Final = 1_000_000


class ScenePublisher(SessionBase):
    """A shared session over a scene of a `SceneBuilder`, whose poses and vertices your program publishes.

    `set_pose`, `set_poses`, `set_joints`, `set_vertices` and `publish` may be called from any thread: a `publish` sends
    everything that any thread has set before it. Call `start`, `close` and `signals` from one thread. Methods that need
    a running session raise `OwnershipError` before `start` and after `close`; inputs such as `marker` and
    `start_episode` are queued as by `post`, and raise as it does.

    Args:
        scene: The scene. What is added to it after `start` is not shown.
        config: Settings; `None` for the defaults. `resume` is not possible, and `assets` cannot be False.
        robots: Robots that participants can lease: `RobotSpec(name, (), (), "", base_body, tip_body=...)` with movable
            bodies of the scene, without joints, actuators and site. `targets()` has where they want them.

    Attributes:
        config: The settings.
        robots: Robots that participants can lease.
        origin_ns: `time.monotonic_ns()` at session time 0.
        clock: Returns session time [ns].
        recording_fault: After `close()`, why the recording is incomplete; empty when it is complete.

    Raises:
        ConfigError: An argument cannot be used.
    """

    def __init__(
        self, scene: SceneBuilder, config: SessionConfig | None = None, *, robots: Sequence[RobotSpec] = ()
    ) -> None:
        self.config = _check_arguments(scene, SessionConfig() if config is None else config)
        self.robots = tuple(robots)
        if self.robots:
            control = msgspec.structs.replace(self.config.control, output=OUTPUT_TARGETS)
            self.config = replace(self.config, control=control)
        self.origin_ns = time.monotonic_ns()
        self.clock = make_session_clock(self.origin_ns)
        self._builder = scene
        self._stop = threading.Event()
        self._pending: PendingState | None = None
        self._loop: PublishLoop | None = None
        self._order = threading.Lock()  # of frames; guards the times and the reset of the next one
        self._capture_ns = 0
        self._time_s: float | None = None
        self._own_time = False
        self._anew = False
        self._inputs = PendingInputs()
        #: After `close()`, why the recording is incomplete; empty when it is complete.
        self.recording_fault = ""

    # --- life --------------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Build the scene, open the sockets and the recording. Called by `with`. Participants can join from here on.

        Raises:
            ConfigError: The scene cannot be built.
            StartError: A port is in use, a folder cannot be written, a key is missing.
            OwnershipError: The session is closed.
        """
        if self._processes is not None:
            return
        self._require_open()
        where = self.config.assets
        try:
            store = AssetStore(None if isinstance(where, bool) else where)
            composed = self._builder.build(store)
            kinematic_model = KinematicModel(composed.moving, composed.poses)
        except (SceneBuildError, PhysicsError) as error:
            raise ConfigError(f"the scene cannot be built: {error}") from None
        except OSError as error:
            raise StartError(f"assets: {error.filename or where}: {error.strerror or error}") from None
        try:
            core = make_session_core(self.config, kinematic_model.model, None, self.robots, (), user_owned=True)
        except (PhysicsError, ControlError) as error:
            raise ConfigError(f"these robots cannot be offered: {error}") from None
        vertices = PublishedVertices(composed)
        published = PublishedScene(composed, vertices.meshes)
        processes = SessionProcesses(self.config, core, self.origin_ns, published=published)
        processes.start()
        processes.notes += composed.notes
        self._processes = processes
        try:
            self._stepper = processes.make_stepper(core, self.clock, self._inputs, user_owned=True)
            self._pending = PendingState(composed)
            self._loop = PublishLoop(kinematic_model, vertices, self._stepper, processes, processes.state_period_ns)
            sources = [self._loop.warnings, self._pending.warnings, lambda: composed.notes]
            processes.reporter.warning_sources += sources
            self._loop.start()
        except BaseException:
            self.close()
            raise

    def close(self) -> bool:
        """Publish the pending state, notify clients, finish the recording, end every child process.

        May be called twice.

        Returns:
            False when the recording is incomplete; `recording_fault` says why.
        """
        self._stop.set()
        self._is_closed = True
        try:
            if self._loop is not None:
                self._loop.close()
        finally:
            if self._processes is not None:
                self.recording_fault = self._processes.close()
                self._recording, self._processes = self._processes.recording, None
        return not self.recording_fault

    def run(self, seconds: float | None = None, until: Callable[[], object] | None = None) -> None:
        """Wait until `stop()`, Ctrl-C or SIGTERM, or until an argument ends the run. Your program keeps publishing.

        Args:
            seconds: Session time to run [s]; `None` for no limit.
            until: Called at 60 Hz; a true result ends the run. It may set poses and publish.
        """
        loop = self._require_parts()[1]
        with self.signals():
            end_ns = None if seconds is None else self.clock() + int(seconds * 1e9)
            while (end_ns is None or self.clock() < end_ns) and not (until is not None and until()):
                if self._stop.wait(RUN_PERIOD_S):
                    break
                loop.raise_if_ended()

    # --- the world ---------------------------------------------------------------------------------------------------

    def set_pose(
        self, name: str, position: Sequence[float], quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0)
    ) -> None:
        """Set the pose of a movable body, or of the root of an articulation. The next `publish` sends it.

        Args:
            name: Name of the body or articulation, or of a body on a floating or planar joint of an articulation.
            position: Position of the body in the world frame, (x, y, z) [m].
            quaternion: Rotation from the body to the world frame, (w, x, y, z). It is normalised; its length may be off
                by 0.001.

        Raises:
            PublishError: No such body, or a value that cannot be used; nothing has changed.
        """
        self._require_parts()[0].set_pose(name, position, quaternion)

    def set_poses(self, names: Sequence[str], positions: ArrayLike, quaternions: ArrayLike) -> None:
        """Set the poses of many bodies at once, all or none. The next `publish` sends them.

        Args:
            names: Names of n different movable bodies; roots of articulations are set with `set_pose`.
            positions: Positions in the world frame, shape (n, 3) [m].
            quaternions: Rotations from body to world frame as (w, x, y, z), shape (n, 4); normalised as by `set_pose`.

        Raises:
            PublishError: No such body, a name given twice, or a value that cannot be used; nothing has changed.
        """
        self._require_parts()[0].set_poses(names, positions, quaternions)

    def set_joints(self, name: str, positions: Mapping[str, float]) -> None:
        """Set joint positions of an articulation. The next `publish` sends them.

        Positions beyond the limits of a joint are accepted, as real robots report some. Those far beyond are named in
        the warnings of the session's status.

        Args:
            name: Name of the articulation.
            positions: Position by name of the joint, [rad] or, for prismatic joints, [m]. Other joints stay.

        Raises:
            PublishError: No such articulation or joint, or a value that cannot be used; nothing has changed.
        """
        self._require_parts()[0].set_joints(name, positions)

    def set_vertices(self, name: str, vertices: ArrayLike) -> None:
        """Set the vertices of a deformable. The next `publish` sends them.

        Args:
            name: Name of the deformable.
            vertices: Positions in the world frame, shape (n, 3) [m], in the order in which they were added.

        Raises:
            PublishError: No such deformable, another shape, or a value that cannot be used; nothing has changed.
        """
        self._require_parts()[0].set_vertices(name, vertices)

    def publish(self, time_s: float | None = None, *, capture_ns: int | None = None) -> None:
        """Publish all poses, joints and vertices as they are set now, as one state of the world.

        States are sent at `config.state_hz` at most. Of states published faster than that the newest is sent;
        `superseded` counts the others.

        Args:
            time_s: Time of the world [s], which clients see as `sim_time`; default: session time. A smaller value than
                before means that the world was reset: a new `scene_epoch` begins. Give it in every call or in none.
            capture_ns: Session time (as of `clock()`) at which the world was in this state [ns]; default: now. It must
                not decrease.

        Raises:
            PublishError: A time that is out of range, out of order, or given only sometimes.
        """
        pending, loop = self._require_parts()
        loop.raise_if_ended()
        now_ns = self.clock()
        captured_ns = now_ns if capture_ns is None else _check_capture(capture_ns, now_ns)
        given_s = None if time_s is None else _check_time(time_s)
        with self._order:
            if capture_ns is None:  # of two threads the second may have read the clock first
                captured_ns = max(captured_ns, self._capture_ns)
            elif captured_ns < self._capture_ns:
                before_ms = (self._capture_ns - captured_ns) * 1e-6
                raise PublishError(
                    f"capture_ns lies {before_ms:.3f} ms before that of the state before: publish them in their order"
                )
            if self._time_s is not None and self._own_time != (given_s is not None):
                raise PublishError("give time_s with every publish() or with none: without it, it is session time")
            self._own_time = given_s is not None
            at_s = captured_ns * 1e-9 if given_s is None else given_s
            anew = self._anew or (self._time_s is not None and at_s < self._time_s)
            self._capture_ns, self._time_s, self._anew = captured_ns, at_s, False
            loop.offer(pending.make_frame(captured_ns, at_s, anew))

    def reset(self) -> None:
        """Declare that the world is reset before the next `publish`, which begins a new `scene_epoch`."""
        self._require_parts()
        with self._order:
            self._anew = True

    @property
    def superseded(self) -> int:
        """Number of published states that were not sent because a newer one replaced them before they were due."""
        return 0 if self._loop is None else self._loop.superseded

    # --- robots ------------------------------------------------------------------------------------------------------

    def driven_robots(self) -> tuple[str, ...]:
        """Return the robots that a participant holds and has engaged: your program moves them to their `targets()`."""
        loop = self._require_parts()[1]
        with loop.lock:
            return loop.core.driven

    def targets(self) -> dict[str, Pose]:
        """Return the end-effector targets `T_world_tip` by robot, for your program's own controller [m].

        Use those of `driven_robots()`; for other robots they are where the robot was when it was published last. They
        move with `publish`, at bounded speed, and lead the published tip by at most 5 cm and 0.25 rad.
        """
        loop = self._require_parts()[1]
        with loop.lock:
            return dict(loop.core.controller.get_targets())

    def grippers(self) -> dict[str, float]:
        """Return how far participants want grippers closed, 0 open to 1 closed, by robot. Those are missing that no
        participant has moved since the robot is driven.
        """
        loop = self._require_parts()[1]
        with loop.lock:
            return dict(loop.grippers)

    # --- inside ------------------------------------------------------------------------------------------------------

    def _require_steps(self) -> None:
        self._require_started()
        self._require_parts()[1].raise_if_ended()

    def _hold_steps(self) -> AbstractContextManager[object]:
        return nullcontext() if self._loop is None else self._loop.lock

    def _require_parts(self) -> tuple[PendingState, PublishLoop]:
        self._require_open()
        if self._pending is None or self._loop is None:
            raise OwnershipError("the session is not started: use `with ScenePublisher(...) as session`, or start()")
        return self._pending, self._loop


def _check_arguments(scene: SceneBuilder, config: SessionConfig) -> SessionConfig:
    if not isinstance(scene, SceneBuilder):
        raise ConfigError(
            f"scene is {type(scene).__name__}: a SceneBuilder is expected; for a MuJoCo model use Session"
        )
    if not isinstance(config, SessionConfig):
        raise ConfigError(f"config is {type(config).__name__}: a SessionConfig is expected")
    if config.resume is not None:
        raise ConfigError(
            "resume: a published scene cannot go on from its recording, which has no program that moves it; begin anew"
        )
    if config.assets is False:
        raise ConfigError("assets is False: a published scene is nothing but what clients draw; True, or a folder")
    return config


def _check_time(time_s: Any) -> float:
    try:
        given_s = -1.0 if isinstance(time_s, str | bytes) else float(time_s)
    except (TypeError, ValueError):
        given_s = -1.0
    if not 0.0 <= given_s <= LONGEST_S:  # NaN is neither
        raise PublishError(f"time_s is {time_s!r}: seconds from 0 to {LONGEST_S:g} are expected")
    return given_s


def _check_capture(capture_ns: int, now_ns: int) -> int:
    try:
        given_ns = operator.index(capture_ns)
    except TypeError:
        given_ns = -1
    if given_ns < 0:
        raise PublishError(f"capture_ns is {capture_ns!r}: whole nanoseconds of session.clock() are expected")
    if given_ns > now_ns + AHEAD_NS:
        ahead_ms = (given_ns - now_ns) * 1e-6
        raise PublishError(f"capture_ns lies {ahead_ms:.1f} ms ahead of session.clock(), by which it is to be given")
    return min(given_ns, now_ns)
