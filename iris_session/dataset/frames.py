"""Frames of an episode: numbers of robots and objects at t0 + k / fps of simulated time, exactly as they were.

A frame is the state at which a tick begins, and the commands of that tick: the newest state that is not later than the
time of the frame. Class `closed`: the session is simulated again, tick by tick, and compared bit for bit. Class `open`:
the states are in the recording; authority and control run again for the commands. Nothing is interpolated, and nothing
in a frame is later than it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cached_property
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.dataset.episodes import DatasetError, PlannedEpisode, PlannedRecording
from iris_session.physics.names import find_element_id
from iris_session.physics.robot_signals import find_opening_law
from iris_session.protocol.names import CommandKind, LateCause
from iris_session.protocol.specs import RobotSpec
from iris_session.protocol.steps import Decision
from iris_session.recording import CLOSED, Recording
from iris_session.replay.plant_reader import (
    CONTACT_FORCE,
    END_EFFECTOR,
    FORCE,
    GRIPPER,
    JOINTS,
    POSE,
    POSES,
    VELOCITIES,
    PlantReader,
)
from iris_session.replay.simulation import Replay
from iris_session.session.core import SessionCore

#: Kinds of columns.
FLOAT: Final = "float64"
INT: Final = "int64"
BOOL: Final = "bool"
SIM_TIME: Final = "sim_time_s"
SESSION_TIME: Final = "session_time_ns"
ACTION: Final = "action"
#: A loop is called late when so much more session time than simulated time has passed since the beginning [s].
LATE_S: Final = 0.05
#: No pose: no operator moves the robot by one.
_NO_POSE: Final = (0.0,) * 7


class FrameColumn(msgspec.Struct, frozen=True):
    """Numbers of each frame. `key`: for example `robots.left.joint_positions`. `names`: of its numbers."""

    key: str
    kind: str
    names: tuple[str, ...]


class RobotColumns(msgspec.Struct, frozen=True):
    """A robot of a data set. `has_gripper`: its opening can be measured; `has_force`: contacts of its gripper.

    `ranges`: lowest and highest command of each actuator; 0 and 0 where the model has no limits.
    """

    name: str
    joints: tuple[str, ...]
    actuators: tuple[str, ...]
    ranges: tuple[tuple[float, float], ...]
    has_gripper: bool
    has_force: bool

    def make_key(self, quantity: str) -> str:
        """Return the key of a column of the robot."""
        return f"robots.{to_key(self.name)}.{quantity}"


class Schema(msgspec.Struct, frozen=True):
    """Content of every frame of a data set. `ticks_per_s`: of the simulation, as a fraction. `recorded`: cameras whose
    pictures were recorded.
    """

    fps: int
    ticks_per_s: tuple[int, int]
    robots: tuple[RobotColumns, ...]
    objects: tuple[str, ...]
    recorded: tuple[str, ...] = ()

    def list_columns(self) -> list[FrameColumn]:
        """Return the columns of a frame, in order."""
        columns = [FrameColumn(SIM_TIME, FLOAT, ("s",)), FrameColumn(SESSION_TIME, INT, ("ns",))]
        for robot in self.robots:
            key = robot.make_key
            columns += [
                FrameColumn(key("joint_positions"), FLOAT, robot.joints),
                FrameColumn(key("joint_velocities"), FLOAT, robot.joints),
                FrameColumn(key("end_effector"), FLOAT, POSE),
            ]
            if robot.has_gripper:
                columns.append(FrameColumn(key("gripper"), FLOAT, ("closed",)))
            if robot.has_force:
                columns.append(FrameColumn(key(CONTACT_FORCE), FLOAT, FORCE))
            columns += [
                FrameColumn(key(ACTION), FLOAT, robot.actuators),
                FrameColumn(key("operator_pose"), FLOAT, POSE),
                FrameColumn(key("operator"), INT, ("person",)),
                FrameColumn(key("engaged"), BOOL, ("engaged",)),
                FrameColumn(key("intervention"), BOOL, ("intervention",)),
            ]
        for name in self.objects:
            columns.append(FrameColumn(make_object_key(name, POSES), FLOAT, POSE))
            columns.append(FrameColumn(make_object_key(name, CONTACT_FORCE), FLOAT, ("x_n", "y_n", "z_n")))
        columns += [FrameColumn(make_age_key(camera), FLOAT, ("s",)) for camera in self.recorded]
        return columns

    def find_tick(self, frame: int) -> int:
        """Return the tick at which a frame is: the last that begins at frame / fps or earlier."""
        ticks, seconds = self.ticks_per_s
        return frame * ticks // (self.fps * seconds)


def to_key(name: str) -> str:
    """Return the name of a robot or object as part of a key: formats use the slash for their own folders."""
    return name.replace("/", "_")


def make_object_key(name: str, quantity: str) -> str:
    """Return the key of a column of an object."""
    return f"objects.{to_key(name)}.{quantity}"


def make_age_key(camera: str) -> str:
    """Return the key of the age of recorded pictures."""
    return f"pictures.{camera}.age_s"


class Table(NamedTuple):
    """Frames of one episode.

    Attributes:
        columns: By key, shape (n, numbers of the column).
        states: `mjSTATE_INTEGRATION` of each frame, shape (n, k) float64: commands at the rate of the ticks, applied
            to the first, give the episode again, bit for bit.
        notes: What has to be known of the episode, one line each.
    """

    columns: dict[str, NDArray[Any]]
    states: NDArray[np.float64]
    notes: tuple[str, ...]

    @property
    def n_frames(self) -> int:
        return len(self.columns[SIM_TIME])


class EpisodeLeftOutError(DatasetError):
    """An episode has no exact frames: steps are missing, or the scene was reset within it. Others are not concerned."""


def make_schema(core: SessionCore, fps: int) -> Schema:
    """Return the columns of a session's present scene.

    Raises:
        DatasetError: The rate is higher than that of the ticks, or the scene has no robots.
    """
    model = core.world.model
    period = Fraction(float(model.opt.timestep)).limit_denominator(1_000_000)
    rate = 1 / period
    if fps > rate:
        raise DatasetError(f"--fps {fps} is more than the {float(rate):g} ticks a second of the recording: give less")
    if not core.scene.robots:
        raise DatasetError("the recording has no robots: there is nothing to learn from it")

    def describe(spec: RobotSpec) -> RobotColumns:
        actuators = (*spec.actuators, *(one.actuator for one in spec.gripper_actuators))
        can_measure = bool(spec.gripper_actuator) and (
            find_opening_law(model, find_element_id(model, "actuator", spec.gripper_actuator), spec) is not None
        )
        ids = [find_element_id(model, "actuator", name) for name in actuators]
        ranges = model.actuator_ctrlrange * model.actuator_ctrllimited[:, None]
        limits = tuple((float(ranges[i, 0]), float(ranges[i, 1])) for i in ids)
        return RobotColumns(spec.name, spec.joints, actuators, limits, can_measure, bool(spec.finger_bodies))

    robots = tuple(map(describe, core.scene.robots))
    return Schema(fps, (rate.numerator, rate.denominator), robots, tuple(one.name for one in core.scene.objects))


class FrameReader:
    """Reads the frames of the episodes of one recording, in their order; the files are read once for all. What belongs
    to recorded pictures is not in them.

    Args:
        recording: The open recording.
        planned: It in the plan.
        schema: What frames must have.

    Raises:
        ReplayError: The session cannot be built from the header.
    """

    def __init__(self, recording: Recording, planned: PlannedRecording, schema: Schema) -> None:
        self._recording, self._planned = recording, planned
        self._schema = msgspec.structs.replace(schema, recorded=())
        self._is_closed = recording.header.recording_class == CLOSED
        self._replay = Replay(recording, lap=self._notice)
        self._taking: _Taking | None = None

    @property
    def core(self) -> SessionCore:
        return self._replay.core

    def read(self, episode: PlannedEpisode, draw: Callable[[SessionCore], None] = lambda core: None) -> Table:
        """Return the frames of an episode.

        Args:
            episode: One that is later than those that were read before.
            draw: Called at every frame, with the session in its state.

        Raises:
            EpisodeLeftOutError: The episode has no exact frames.
            DatasetError: Its robots, objects or ticks are others than those of the schema.
            ReplayError: A step gives another result here than in the recording: it does not verify.
        """
        steps = None if self._is_closed else self._find_steps(episode)
        taking = self._taking = _Taking(episode, self._planned, self._schema, draw, steps)
        n_steps = 0
        for step in self._replay.steps_between(episode.first_step, episode.end_step):
            assert step.outcome is not None
            if step.step < episode.first_step:
                continue
            if step.step != episode.first_step + n_steps:
                break
            n_steps += 1
            if not self._is_closed:
                taking.add_state(self.core, step.step)
            if taking.error is not None:
                raise taking.error
            taking.end_step(step.outcome.decision, step.session_time)
            if taking.is_complete:
                return taking.make_table()
        if n_steps < episode.end_step - episode.first_step:
            missing = f"step {episode.first_step + n_steps} is missing or damaged, or follows such a one"
            raise EpisodeLeftOutError(f"{missing}: trim it to before")
        return taking.make_table()

    def _notice(self, cause: str) -> None:
        """Take a frame where a tick begins: its state is there still, and its commands are there already."""
        taking = self._taking
        if taking is None or taking.error is not None or self._replay.step < taking.episode.first_step:
            return
        if cause == LateCause.AUTHORITY or (cause == LateCause.PHYSICS and self._is_closed):
            taking.state_before = self.core.world.save_state()
        elif cause == LateCause.CONTROL and self._is_closed:
            try:
                taking.add_tick(self.core)
            except Exception as error:  # of a full disk, for example: the step, which is not to blame, is finished
                taking.error = error

    @cached_property
    def _times(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Steps of class `open` that have a state, and its simulated time [s]."""
        rows = ((row.step, row.plant[:8]) for row in self._recording.rows() if row.plant and row.n_ticks)
        found = [(step, float(np.frombuffer(time, np.float64)[0])) for step, time in rows]
        return np.array([step for step, _ in found], np.int64), np.array([time for _, time in found])

    def _find_steps(self, episode: PlannedEpisode) -> list[int]:
        """Return the step of each frame of an episode of class `open`."""
        steps, times = self._times
        first, end = np.searchsorted(steps, [episode.first_step, episode.end_step])
        steps, times = steps[first:end], times[first:end]
        periods = np.diff(times)
        if not len(periods) or not (periods > 0.0).all():
            raise EpisodeLeftOutError("its simulated time does not go on: it is too short, or was reset within it")
        rate = 1.0 / float(np.median(periods))
        if self._schema.fps > rate * 1.001:
            raise DatasetError(
                f"--fps {self._schema.fps} is more than the {rate:g} states a second of {self._planned.path}: give less"
            )
        begin, until = episode.trim or (0.0, math.inf)
        n = int((min(until, float(times[-1] - times[0])) - begin) * self._schema.fps + 1e-6) + 1
        at = times[0] + begin + np.arange(max(0, n)) / self._schema.fps
        # A time of a state and that of a frame may differ by rounding where they are meant to be the same.
        return [int(one) for one in steps[np.searchsorted(times, at + 1e-6 / rate, side="right") - 1]]


class _Taking:
    """Frames of one episode while it is read. `steps`: of the frames, in class `open`."""

    def __init__(
        self,
        episode: PlannedEpisode,
        planned: PlannedRecording,
        schema: Schema,
        draw: Callable[[SessionCore], None],
        steps: Sequence[int] | None,
    ) -> None:
        self.episode, self._planned, self._schema, self._draw = episode, planned, schema, draw
        self._columns = schema.list_columns()
        self._values: dict[str, list[Any]] = {column.key: [] for column in self._columns}
        self._steps = steps
        ticks, seconds = schema.ticks_per_s
        begin, until = episode.trim or (0.0, math.inf)
        self._period_s = seconds / ticks
        #: The first tick that is a frame, and the one before which the last is.
        self._first_tick = math.ceil(begin / self._period_s - 1e-6)
        self._end_tick = math.inf if math.isinf(until) else math.floor(until / self._period_s + 1e-6) + 1
        self._n_ticks = self._n_frames = self._n_pending = self._repeated = 0
        self._begin_s, self._begin_ns, self._late_s, self._late_at_s = 0.0, 0, 0.0, 0.0
        #: State of the coming tick, with the inputs of the one before.
        self.state_before = b""
        #: What happened within a step, which has to be finished first.
        self.error: Exception | None = None
        self._reader: PlantReader | None = None
        self._states: list[bytes] = []
        self._next_intervention = 0
        self._intervened: dict[str, bool] = {}

    @property
    def is_complete(self) -> bool:
        """Return whether later steps have no frame, because of the trim."""
        return self._n_ticks >= self._end_tick

    def add_tick(self, core: SessionCore) -> None:
        """Take the state at which a tick begins, if it is a frame."""
        now_s = core.world.view().sim_time
        tick, self._n_ticks = self._n_ticks, self._n_ticks + 1
        if tick == 0:
            self._begin_s = now_s
        elif abs(now_s - self._begin_s - tick * self._period_s) > self._period_s / 2.0:
            at_s = tick * self._period_s
            self.error = EpisodeLeftOutError(
                f"the scene was reset or loaded {at_s:.2f} s after its beginning: trim it to before"
            )
            return
        due = self._first_tick + self._schema.find_tick(self._n_frames)
        if tick == due and tick < self._end_tick:
            self._take(core)

    def add_state(self, core: SessionCore, step: int) -> None:
        """Take the state of a step of class `open` as often as it is a frame."""
        assert self._steps is not None
        if self._n_frames == 0:
            self._begin_s = core.world.view().sim_time
        count = 0
        while self._n_frames < len(self._steps) and self._steps[self._n_frames] == step:
            self._take(core)
            count += 1
        self._repeated += max(0, count - 1)

    def _take(self, core: SessionCore) -> None:
        reader = self._reader
        if reader is None or reader.world is not core.world:
            here = make_schema(core, self._schema.fps)
            if here != self._schema:
                raise DatasetError(
                    f"{self._planned.path}: the scene of episode {self.episode.number} differs from that of the first: "
                    f"{find_schema_difference(here, self._schema)}"
                )
            reader = self._reader = PlantReader(core)
        view, values = reader.world.view(), self._values
        self._states.append(core.world.save_state())
        values[SIM_TIME].append(view.sim_time)
        for robot in self._schema.robots:
            key, found = robot.make_key, reader.robots[robot.name]
            values[key("joint_positions")].append(found[JOINTS].read())
            values[key("joint_velocities")].append(found[VELOCITIES].read())
            values[key("end_effector")].append(found[END_EFFECTOR].read())
            values[key(ACTION)].append(reader.ctrl[robot.name].read())
            if robot.has_gripper:
                values[key("gripper")].append(1.0 - found[GRIPPER].read()[0])
            if robot.has_force:
                values[key(CONTACT_FORCE)].append(view.gripper_force(robot.name))
        forces = reader.solve_forces(self.state_before)[1][:, 1:] if self._schema.objects else ()
        for name, force in zip(self._schema.objects, forces, strict=True):
            values[make_object_key(name, POSES)].append(reader.objects[name][POSES].read())
            values[make_object_key(name, CONTACT_FORCE)].append(force)
        self._n_frames += 1
        self._n_pending += 1
        self._draw(core)

    def end_step(self, decision: Decision, session_time: int) -> None:
        """Add to the frames of a step what the authority decided in it."""
        changes = self._planned.interventions
        while self._next_intervention < len(changes) and changes[self._next_intervention][1] <= session_time:
            robot_name, _, active = changes[self._next_intervention]
            self._intervened[robot_name] = active
            self._next_intervention += 1
        if not self._n_pending:
            return
        values, commands = self._values, {one.robot: one for one in decision.commands}
        self._measure_lateness(session_time)
        for _ in range(self._n_pending):
            values[SESSION_TIME].append(session_time)
            for robot in self._schema.robots:
                command, key = commands[robot.name], robot.make_key
                source = command.sources[0] if command.sources else None
                pose = source.pose_world if source else None
                values[key("operator_pose")].append((*pose.p, *pose.q) if pose else _NO_POSE)
                values[key("operator")].append(self._planned.people.get(source.participant, -1) if source else -1)
                values[key("engaged")].append(command.kind != CommandKind.HOLD)
                values[key("intervention")].append(self._intervened.get(robot.name, False))
        self._n_pending = 0

    def _measure_lateness(self, session_time: int) -> None:
        self._begin_ns = self._begin_ns or session_time
        now_s = self._values[SIM_TIME][-1] - self._values[SIM_TIME][0]
        late_s = (session_time - self._begin_ns) * 1e-9 - now_s
        if late_s > self._late_s:
            self._late_s, self._late_at_s = late_s, now_s

    def make_table(self) -> Table:
        """Return the frames."""
        if not self._n_frames:
            raise EpisodeLeftOutError("it has no tick of physics, or none within its trim")
        shapes = ((column, (self._n_frames, len(column.names))) for column in self._columns)
        columns = {one.key: np.array(self._values[one.key], one.kind).reshape(shape) for one, shape in shapes}
        notes = []
        if self._late_s > LATE_S:
            notes.append(
                f"the loop was late or paused, {self._late_s:.2f} s in all at {self._late_at_s:.2f} s: frames are "
                "exact in simulated time"
            )
        if self._repeated:
            notes.append(
                f"{self._repeated} frames repeat the state before: the recording has no newer one at their time"
            )
        states = np.frombuffer(b"".join(self._states), np.float64).reshape(self._n_frames, -1)
        return Table(columns, states, tuple(notes))


def find_schema_difference(one: Schema, other: Schema) -> str:
    """Return in what two schemas differ, in a few words; empty: in nothing."""
    here, there = msgspec.to_builtins(one), msgspec.to_builtins(other)
    different = [field for field in here if here[field] != there[field]]
    return "; ".join(f"{field}: {here[field]!r:.120}, not {there[field]!r:.120}" for field in different)
