"""`Recording` of the public API: a recording open for reading, with the numbers of its robots and objects.

    with Recording.open(path) as recording:
        joints = recording.robot("left").joints(hz=100)

The names of the reading itself are in `recording.reader`. Every call that gives numbers of robots or objects replays
the session once (`simulation`) and keeps the selected rows of the columns that were asked for.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from iris_session.physics import UnknownNameError
from iris_session.recording import Recording as RecordedFile
from iris_session.recording import RecordingError
from iris_session.recording.records import DeviceSamples, list_event_records, read_device_samples
from iris_session.replay import plant_reader
from iris_session.replay.plant_reader import PlantReader, Quantity, list_moving, read_steps
from iris_session.replay.simulation import Replay, ReplayedStep, StepSelector
from iris_session.rrd import batches as record_batches
from iris_session.rrd import paths

ROBOT: Final = "robot"
OBJECT: Final = "object"


class TimeSeries(NamedTuple):
    """Numbers over time. Every row is a step of the session as it was: nothing is interpolated.

    Attributes:
        names: Name of each column of `values`.
        steps: Step of each row, shape (n,) int64. It jumps where steps are missing in the recording.
        session_time_ns: Session time of the step [ns], shape (n,) int64.
        sim_time_s: Simulated time [s], shape (n,) float64; a reset sets it back.
        values: Shape (n, len(names)) float64.
    """

    names: tuple[str, ...]
    steps: NDArray[np.int64]
    session_time_ns: NDArray[np.int64]
    sim_time_s: NDArray[np.float64]
    values: NDArray[np.float64]

    @property
    def times_s(self) -> NDArray[np.float64]:
        """Session time of each row [s], shape (n,)."""
        return self.session_time_ns.astype(np.float64) * 1e-9

    def to_dict(self) -> dict[str, NDArray[Any]]:
        """Return all columns by name, each of shape (n,), for example for `pandas.DataFrame`."""
        head = {"step": self.steps, "session_time_ns": self.session_time_ns, "sim_time_s": self.sim_time_s}
        return head | {name: self.values[:, i] for i, name in enumerate(self.names)}


class CommandSeries(NamedTuple):
    """Commands of one robot over time, and the `ctrl` that they became. The first five as in `TimeSeries`.

    Attributes:
        names: Actuators of the robot, its gripper last.
        values: Their `ctrl` in the last tick of the step, shape (n, len(names)) float64.
        kinds: `CommandKind` of each row: hold, pose, twist or joints; shape (n,) of str.
        hold_reasons: `HoldReason` of a hold, else empty; shape (n,) of str.
        participants: Id of who commands, of several (mode `shared`) with commas between; shape (n,) of str.
        devices: Likewise their devices; shape (n,) of str.
        gripper: 0 open to 1 closed, shape (n,) float64; NaN: unchanged.
        scale: Motion scaling, shape (n,) float64.
    """

    names: tuple[str, ...]
    steps: NDArray[np.int64]
    session_time_ns: NDArray[np.int64]
    sim_time_s: NDArray[np.float64]
    values: NDArray[np.float64]
    kinds: NDArray[np.object_]
    hold_reasons: NDArray[np.object_]
    participants: NDArray[np.object_]
    devices: NDArray[np.object_]
    gripper: NDArray[np.float64]
    scale: NDArray[np.float64]

    @property
    def times_s(self) -> NDArray[np.float64]:
        """Session time of each row [s], shape (n,)."""
        return self.session_time_ns.astype(np.float64) * 1e-9

    def to_dict(self) -> dict[str, NDArray[Any]]:
        """Return all columns by name, each of shape (n,), with the names that they have in exported tables."""
        columns: dict[str, NDArray[Any]] = {
            "step": self.steps,
            "session_time_ns": self.session_time_ns,
            "sim_time_s": self.sim_time_s,
            "kind": self.kinds,
            "hold_reason": self.hold_reasons,
            "participant": self.participants,
            "device": self.devices,
            "gripper": self.gripper,
            "scale": self.scale,
        }
        return columns | {f"ctrl/{name}": self.values[:, i] for i, name in enumerate(self.names)}


class RecordedRobot:
    """Numbers of one robot of a recording, from `Recording.robot`.

    All methods take `hz`, the rate of rows [1/s] in session time, and select steps, one per period; None, or the rate
    of the session, gives every step. All replay the session, at a few times its speed, and raise:

    - ReplayError: A step gives another result here than in the recording: it needs the same versions and processor.
    - UnknownNameError: No scene of the recording has such a robot.
    - RecordingError: The robot has no such part, for example no gripper.
    - ValueError: `hz` is not a positive number.

    In recordings of class `closed` a row is the state after the step; in class `open` that at its beginning, as the
    program that owns the scene gave it.
    """

    def __init__(self, recording: SessionRecording, name: str) -> None:
        self._recording = recording
        self.name = name

    def joints(self, hz: float | None = None) -> TimeSeries:
        """Return joint positions [rad or m], in the order of `RobotSpec.joints`: `qpos`, bit for bit."""
        return self._read(plant_reader.JOINTS, hz)

    def velocities(self, hz: float | None = None) -> TimeSeries:
        """Return joint velocities [rad/s or m/s], in the order of `RobotSpec.joints`."""
        return self._read(plant_reader.VELOCITIES, hz)

    def end_effector(self, hz: float | None = None) -> TimeSeries:
        """Return `T_world_tip` of the end-effector site: `x y z` [m], `qw qx qy qz`."""
        return self._read(plant_reader.END_EFFECTOR, hz)

    def tip_speed(self, hz: float | None = None) -> TimeSeries:
        """Return linear [m/s] and angular [rad/s] speed of the end-effector site in the world."""
        return self._read(plant_reader.TIP_SPEED, hz)

    def gripper(self, hz: float | None = None) -> TimeSeries:
        """Return the measured opening of the gripper: 0 at its `gripper_closed`, 1 at its `gripper_open`.

        It follows from the position of the gripper's actuator, and may lie somewhat outside. NaN for actuators that
        are no position servos. The commanded value is in `commands`.
        """
        return self._read(plant_reader.GRIPPER, hz)

    def contact_force(self, hz: float | None = None) -> TimeSeries:
        """Return the sum of the normal contact forces on the gripper's finger bodies [N].

        They are those that MuJoCo solves for the state of the row. A contact between two fingers counts once; friction
        is not in it.
        """
        return self._read(plant_reader.CONTACT_FORCE, hz)

    def commands(self, hz: float | None = None) -> CommandSeries:
        """Return the command of each step and the `ctrl` that the actuators got for it.

        In recordings of class `open` authority and control run again for it; `ctrl` of a robot that no participant
        drives is its owner's.
        """
        return self._recording._read_commands(self.name, hz)

    def _read(self, kind: str, hz: float | None) -> TimeSeries:
        return self._recording._read_series(ROBOT, self.name, kind, hz)


class RecordedObject:
    """Numbers of one object of a recording, from `Recording.object`. `hz` and errors as for robots."""

    def __init__(self, recording: SessionRecording, name: str) -> None:
        self._recording = recording
        self.name = name

    def poses(self, hz: float | None = None) -> TimeSeries:
        """Return `T_world_object` of its body: `x y z` [m], `qw qx qy qz`."""
        return self._recording._read_series(OBJECT, self.name, plant_reader.POSES, hz)

    def contact_force(self, hz: float | None = None) -> TimeSeries:
        """Return the sum of the normal contact forces on its bodies [N], by whatever touches it: grippers, a table.

        They are those that MuJoCo solves for the state of the row; friction is not in it. Objects of a published world
        have none: nothing is simulated there.
        """
        return self._recording._read_series(OBJECT, self.name, plant_reader.CONTACT_FORCE, hz)


class SessionRecording(RecordedFile):
    # `Recording` for users. Its docstring is that of the reader, inherited: it is the first text of the reference.

    def robot(self, name: str) -> RecordedRobot:
        """Return access to the numbers of a robot: joints, end effector, gripper, forces, commands.

        Args:
            name: As in `header.robots`, or of a scene that was loaded later. Rows of scenes in which it does not
                exist, or has other joints, are left out.

        Raises:
            UnknownNameError: There is no such robot.
        """
        self._require(ROBOT, name)
        return RecordedRobot(self, name)

    def object(self, name: str) -> RecordedObject:
        """Return access to the numbers of an object: poses, contact force.

        Args:
            name: As in `header.objects`, or of a scene that was loaded later. In a world without robots and objects, as
                most published ones are: a body that moves.

        Raises:
            UnknownNameError: There is no such object.
        """
        self._require(OBJECT, name)
        return RecordedObject(self, name)

    def device_samples(self, participant: str, device: str) -> DeviceSamples:
        """Return the raw samples of one device of a participant, decoded.

        Args:
            participant: Name or id.
            device: For example `head`, `hand/left`, `controller/right`.

        Returns:
            Arrays with one row per sample, in order of receipt; poses in the tracking frame of the participant.

        Raises:
            RecordingError: There are none; the message lists those that there are.
        """
        return read_device_samples(self, participant, device)

    def event_records(self) -> list[dict[str, Any]]:
        """Return the events as dictionaries of plain values, with names of participants beside their ids.

        Returns:
            Records with `event_seq`, `session_time_ns` (that of its step), `time_s`, `event` (its kind), and the fields
            of the event: `giver_participant` and `giver_participant_name` of a `handover`, for example.
        """
        return list(list_event_records(self))

    def _list_names(self, kind: str) -> list[str]:
        """Return the names of robots or objects of the first scene."""
        header = self.header
        if kind == OBJECT and not (header.robots or header.objects):
            return list_moving(header.bodies)
        return [one.name for one in (header.robots if kind == ROBOT else header.objects)]

    def _require(self, kind: str, name: str) -> None:
        """Raise `UnknownNameError` at once where only the first scene can have the name."""
        known = self._list_names(kind)
        if name not in known and next(self._iterate(paths.MODELS, record_batches.decode_models), None) is None:
            raise UnknownNameError(kind, name, known)

    def _read_series(self, target: str, name: str, kind: str, hz: float | None) -> TimeSeries:
        def find(reader: PlantReader) -> Quantity:
            found = (reader.robots if target == ROBOT else reader.objects)[name]
            if kind not in found:
                raise RecordingError(f"{target} {name!r} has no {kind}: it has {', '.join(found)}")
            return found[kind]

        return TimeSeries(*_collect(self._read_steps(target, name, hz), find))

    def _read_commands(self, name: str, hz: float | None) -> CommandSeries:
        steps = self._read_steps(ROBOT, name, hz, with_control=True)
        columns = _collect(steps, lambda reader: reader.ctrl[name], _COMMAND, lambda step: describe_command(step, name))
        return CommandSeries(*columns)

    def _read_steps(
        self, target: str, name: str, hz: float | None, *, with_control: bool = False
    ) -> Iterator[tuple[ReplayedStep, PlantReader]]:
        """Yield the selected steps of scenes in which a robot or object exists."""
        selector = StepSelector(hz, self.header.tick_period_ns)
        replay = Replay(self, with_control=with_control)
        known = dict.fromkeys(self._list_names(target))
        for step, reader in read_steps(replay, selector):
            names = reader.robots if target == ROBOT else reader.objects
            if name in names:
                yield step, reader
            known.update(dict.fromkeys(names))
        if name not in known:
            raise UnknownNameError(target, name, known)
        if replay.left_out:
            warnings.warn(f"{self.files[0]}: {replay.describe_left_out()}", stacklevel=7)


_HEAD: Final = (("step", np.int64), ("session_time_ns", np.int64), ("sim_time_s", np.float64))
#: Types of what `describe_command` returns.
_COMMAND: Final = (
    *((key, np.object_) for key in ("kind", "hold_reason", "participants", "devices")),
    *((key, np.float64) for key in ("gripper", "scale")),
)


def _collect(
    steps: Iterator[tuple[ReplayedStep, PlantReader]],
    find: Callable[[PlantReader], Quantity],
    types: Sequence[tuple[str, Any]] = (),
    describe: Callable[[ReplayedStep], tuple[Any, ...]] = lambda step: (),
) -> tuple[Any, ...]:
    """Return the columns of a series: names, step, times, values of a quantity, and those that `describe` adds.

    The first row decides the names. Rows with others, of a robot of another scene that has the same name, are left out.
    """
    first = next(steps, None)
    names = () if first is None else find(first[1]).names
    rows = (
        (step.step, step.session_time, reader.world.view().sim_time, quantity.read(), *describe(step))
        for step, reader in (() if first is None else chain((first,), steps))
        if (quantity := find(reader)).names == names
    )
    table = np.fromiter(rows, [*_HEAD, ("values", np.float64, (len(names),)), *types])
    return names, *(table[name].copy() for name in table.dtype.names or ())


def describe_command(step: ReplayedStep, robot: str) -> tuple[str, str, str, str, float, float]:
    """Return the command of a robot in a step that was taken with control: kind, reason to hold, ids of participants
    and their devices with commas between, gripper (NaN: unchanged), scale.
    """
    assert step.outcome is not None
    command = next(one for one in step.outcome.decision.commands if one.robot == robot)
    texts = (
        *(command.kind, command.hold_reason, ",".join(one.participant for one in command.sources)),
        ",".join(one.device for one in command.sources),
    )
    kind, reason, participants, devices = map(sys.intern, texts)  # few different ones in any number of rows
    gripper = np.nan if command.gripper is None else command.gripper
    return kind, reason, participants, devices, gripper, command.scale


#: The name under which it is public.
Recording: TypeAlias = SessionRecording
