"""Plots of a recording: what is measured of robots, delays, errors and counts, each a series with name and unit.

Rows are collected and written together, a chunk per entity: a chunk of ten numbers is mostly its schema.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from iris_session.journal.messages import RobotLabels, StateFrame
from iris_session.rrd import paths
from iris_session.viewer.narration import ALIGNMENT, REJECTED, EventNarration, find_colour
from iris_session.viewer.scene_layer import escape_entity_part
from iris_session.viewer.timelines import Moment, to_time_columns

JOINTS: Final = "joints"
GRIPPER: Final = "gripper"
TIP_SPEED: Final = "tip_speed"


class MetricKind(NamedTuple):
    """A kind of metric, with a view of its own. `label`: of the series of one robot or person, `{}`. `of_people`: it
    is of persons, in their colours, and holds until it changes.
    """

    view: str
    label: str
    of_people: bool = False


INPUT_TO_STEP: Final = "input_to_step_ms"
STATE_AGE: Final = "state_age_ms"
#: By the first part of the name of a metric; what is in no kind has no view.
KINDS: Final = {
    INPUT_TO_STEP: MetricKind("Delays [ms]", "input to step, {} [ms]"),
    "lateness_ms": MetricKind("Lateness [ms]", "lateness of ticks [ms]"),
    STATE_AGE: MetricKind("Age of state [ms]", "{}, 99 % of the states [ms]", of_people=True),
    ALIGNMENT: MetricKind("Alignment error [mm]", "{}, at the robot, 95 % [mm]", of_people=True),
    REJECTED: MetricKind("Rejected samples", "{}, since joining", of_people=True),
}
#: Colours of the joints of a robot in their order (Tol 2021, "muted", lightened for a dark background).
COLOURS: Final = (
    (136, 204, 238),
    (221, 204, 119),
    (68, 170, 153),
    (204, 102, 119),
    (153, 153, 255),
    (170, 210, 90),
    (220, 130, 200),
    (240, 160, 90),
)
#: Metrics that keep their value until the next one.
HELD: Final = (ALIGNMENT, REJECTED)
#: Maximum number of metrics that are known to have a name in the file.
MAX_NAMED: Final = 4096


class MetricPlots:
    """Metrics: one entity for each, below the entity of its kind."""

    def __init__(self, recording: rr.RecordingStream, narration: EventNarration) -> None:
        self._rec = recording
        self._narration = narration
        self._named: set[str] = set()
        self._rows: dict[str, list[tuple[Moment, float]]] = {}
        self._held: dict[str, float] = {}
        self._held_until_ns = -1

    def add(self, kind: str, subject: str, value: float, moment: Moment) -> None:
        """Collect a value. `subject`: id of a robot or participant, empty for a metric of the session."""
        if not math.isfinite(value):
            return
        entity = f"{paths.METRICS}/{kind}" + (f"/{escape_entity_part(subject)}" if subject else "")
        if kind in HELD:
            if self._held.get(entity) == value:
                return
            self._held[entity] = value
        if entity not in self._named:
            self._name(entity, kind, subject)
        rows = self._rows.setdefault(entity, [])
        if kind in HELD and rows and rows[-1][0].session_ns == moment.session_ns:
            rows.pop()  # the newest of one step is in force
        rows.append((moment, value))

    def end(self, kind: str, subject: str, moment: Moment) -> None:
        """End the line of a value that was held until now."""
        entity = f"{paths.METRICS}/{kind}/{escape_entity_part(subject)}"
        if entity in self._held:
            self._rows.setdefault(entity, []).append((moment, self._held.pop(entity)))

    def _name(self, entity: str, kind: str, subject: str) -> None:
        if len(self._named) >= MAX_NAMED:
            self._named.clear()
        self._named.add(entity)
        known = KINDS.get(kind)
        if known is None:
            return
        name = self._narration.find_person(subject).name if known.of_people else subject
        colours = [find_colour(subject)] if known.of_people else None
        steps = rr.components.InterpolationMode.StepAfter if kind in HELD else None
        series = rr.SeriesLines(names=[known.label.format(name)], colors=colours, interpolation_mode=steps)
        self._rec.log(entity, series, static=True, strict=True)

    def write(self, now: Moment) -> None:
        """Write what was collected. Values that are held reach until `now`."""
        for entity, value in self._held.items() if now.session_ns > self._held_until_ns else ():
            rows = self._rows.setdefault(entity, [])
            if not rows or rows[-1][0].session_ns < now.session_ns:
                rows.append((now, value))
        self._held_until_ns = max(now.session_ns, self._held_until_ns)
        collected, self._rows = self._rows, {}
        for entity, rows in collected.items():
            times = to_time_columns(np.array([moment for moment, _ in rows], np.int64).T)
            columns = rr.Scalars.columns(scalars=[value for _, value in rows])
            rr.send_columns(entity, times, [*columns], recording=self._rec, strict=True)


class RobotPlots:
    """Joints, opening of the gripper and speed of the tip of every robot of the present scene."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._rec = recording
        self.robots: tuple[RobotLabels, ...] = ()
        self._named: set[str] = set()
        self._times: list[NDArray[np.int64]] = []
        self._values: list[NDArray[np.float64]] = []
        self._last: tuple[float, NDArray[np.float64]] | None = None  # simulated time [s], tips (n_robots, 3) [m]

    def set_robots(self, robots: tuple[RobotLabels, ...]) -> None:
        """Set the robots of the states that follow; write those before them first."""
        self.robots = robots
        self._named.clear()
        self._last = None

    def add(self, states: Sequence[StateFrame], times: NDArray[np.int64]) -> None:
        """Collect the values of states. `times`: see `to_time_columns`. States of other robots are left out."""
        n = sum(len(robot.joints) for robot in self.robots)
        size = n + 4 * len(self.robots)
        taken = [i for i, state in enumerate(states) if size and len(state.robots) == 8 * size]
        if not taken:
            return
        values = np.array([np.frombuffer(states[i].robots, np.float64) for i in taken])
        rows = np.empty((len(taken), n + 2 * len(self.robots)))
        rows[:, : n + len(self.robots)] = values[:, : n + len(self.robots)]
        for row, i, tips in zip(rows, taken, values[:, n + len(self.robots) :], strict=True):
            row[n + len(self.robots) :] = self._measure_speeds(states[i].sim_time, tips.reshape(-1, 3))
        self._times.append(times[:, taken])
        self._values.append(rows)

    def _measure_speeds(self, time_s: float, tips: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the speed of each tip since the state before [m/s], NaN while time stands still or went back."""
        before, self._last = self._last, (time_s, tips)
        elapsed_s = 0.0 if before is None else time_s - before[0]
        if before is None or elapsed_s <= 0.0:
            return np.full(len(tips), np.nan)
        return np.asarray(np.linalg.norm(tips - before[1], axis=1) / elapsed_s)

    def write(self) -> None:
        """Write what was collected."""
        if not self._times:
            return
        times, values = np.concatenate(self._times, axis=1), np.concatenate(self._values)
        self._times.clear()
        self._values.clear()
        at, n = 0, values.shape[1] - 2 * len(self.robots)
        for i, robot in enumerate(self.robots):
            of = ", ".join(("", robot.name))
            names = [name.removeprefix(f"{robot.name}/") for name in robot.joints]
            labels = [f"{name} [{unit}]" for name, unit in zip(names, robot.units, strict=True)]
            self._send(robot, JOINTS, labels, times, values[:, at : at + len(labels)])
            at += len(labels)
            self._send(robot, GRIPPER, [f"opening{of} [0 to 1]"], times, values[:, [n + i]])
            self._send(robot, TIP_SPEED, [f"tip speed{of} [m/s]"], times, values[:, [n + len(self.robots) + i]])

    def _send(
        self, robot: RobotLabels, name: str, labels: list[str], times: NDArray[np.int64], values: NDArray[np.float64]
    ) -> None:
        known = np.isfinite(values).all(axis=1)
        if not labels or not known.any():
            return
        entity = f"{get_robot_entity(robot.name)}/{name}"
        if entity not in self._named:
            self._named.add(entity)
            colours = [COLOURS[i % len(COLOURS)] for i in range(len(labels))]
            self._rec.log(entity, rr.SeriesLines(names=labels, colors=colours), static=True, strict=True)
        columns = rr.Scalars.columns(scalars=values[known].ravel()).partition([len(labels)] * int(known.sum()))
        times_known: list[Any] = to_time_columns(times[:, known])
        rr.send_columns(entity, times_known, [*columns], recording=self._rec, strict=True)


def get_robot_entity(robot: str) -> str:
    """Return the entity of a robot: its label, and below it what is plotted of it."""
    return f"{paths.ROBOTS}/{escape_entity_part(robot)}"
