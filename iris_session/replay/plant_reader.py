"""Numbers of robots and objects, read from the world of a replayed step.

Everything but contact forces is read as MuJoCo has it after the step. Contact forces exist only while a step is solved,
so they are solved once more, in data of their own: those of the state that the other numbers are of, with the `ctrl` of
the last tick. They differ by one tick from `Feedback.contact_n`, which has those that the last tick was solved with.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.physics.contacts import ContactTables
from iris_session.physics.names import find_element_id
from iris_session.physics.robot_signals import find_opening_law
from iris_session.physics.tip import Tip
from iris_session.physics.tree import KinematicTree
from iris_session.physics.world import STATE
from iris_session.protocol.common import Pose
from iris_session.protocol.server_messages import BodyInfo
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.replay.simulation import Replay, ReplayedStep, StepSelector
from iris_session.session.core import SessionCore

#: Names of the numbers of a pose: position [m], unit quaternion from the frame to the world.
POSE: Final = ("x", "y", "z", "qw", "qx", "qy", "qz")
FORCE: Final = ("normal_n",)
SPEED: Final = ("linear_m_s", "angular_rad_s")

JOINTS: Final = "joints"
VELOCITIES: Final = "velocities"
END_EFFECTOR: Final = "end_effector"
TIP_SPEED: Final = "tip_speed"
GRIPPER: Final = "gripper"
CONTACT_FORCE: Final = "contact_force"
POSES: Final = "pose"
CTRL: Final = "ctrl"


class Quantity(NamedTuple):
    """Numbers that belong together. `read` returns them as they are now, one per name."""

    names: tuple[str, ...]
    read: Callable[[], Sequence[float]]


class PlantReader:
    """Reads the world of a core as it is now. Make another one when the core has another world (a scene was loaded).

    Attributes:
        world: The world that is read.
        robots: Quantities by robot and kind: those that it has.
        objects: Quantities by object and kind. In a world without robots and objects, as most published ones are: of
            the bodies that move.
        ctrl: `ctrl` of the actuators of each robot, its gripper last.
    """

    def __init__(self, core: SessionCore) -> None:
        self.world = core.world
        self._model, self._data = self.world.model, self.world.data
        self._specs = core.scene.robots
        self._tree = KinematicTree(self._model)
        self._tables = ContactTables(self._model, self._specs, core.scene.objects, self._tree)
        self._scratch: Any = None
        self._solved = b""
        self._forces: tuple[tuple[float, ...], NDArray[np.float64]] = ((), np.empty((0, 4)))
        self.robots = {spec.name: self._list_robot(i, spec) for i, spec in enumerate(self._specs)}
        self.objects = {spec.name: self._list_object(i, spec) for i, spec in enumerate(core.scene.objects)}
        if not (self.robots or self.objects):
            self.objects = {name: self._list_body(name) for name in list_moving(self.world.bodies)}
        self.ctrl = {spec.name: self._make_ctrl(spec) for spec in self._specs}

    def _list_robot(self, index: int, spec: RobotSpec) -> dict[str, Quantity]:
        joints = [find_element_id(self._model, "joint", joint) for joint in spec.joints]
        qpos = np.asarray(self._model.jnt_qposadr, np.intp)[joints]
        dof = np.asarray(self._model.jnt_dofadr, np.intp)[joints]
        view, name = self.world.view(), spec.name
        found = {
            JOINTS: Quantity(spec.joints, _make_reader(self._data.qpos, qpos)),
            VELOCITIES: Quantity(spec.joints, _make_reader(self._data.qvel, dof)),
            END_EFFECTOR: Quantity(POSE, lambda: _to_numbers(view.tip_pose(name))),
            TIP_SPEED: Quantity(SPEED, self._make_speed(spec)),
        }
        if spec.gripper_actuator:
            found[GRIPPER] = Quantity(("opening",), self._make_opening(spec))
        if spec.finger_bodies:
            found[CONTACT_FORCE] = Quantity(FORCE, lambda: (self.solve_forces()[0][index],))
        return found

    def _list_object(self, index: int, spec: ObjectSpec) -> dict[str, Quantity]:
        view, name = self.world.view(), spec.name
        found = {POSES: Quantity(POSE, lambda: _to_numbers(view.object_pose(name)))}
        bodies = self._tree.list_subtree(find_element_id(self._model, "body", spec.body))
        if any(int(self._model.body_geomnum[body]) for body in bodies):  # without geoms nothing touches it
            found[CONTACT_FORCE] = Quantity(FORCE, lambda: (float(self.solve_forces()[1][index, 0]),))
        return found

    def _list_body(self, name: str) -> dict[str, Quantity]:
        body, data = find_element_id(self._model, "body", name), self._data
        return {POSES: Quantity(POSE, lambda: (*data.xpos[body].tolist(), *data.xquat[body].tolist()))}

    def _make_ctrl(self, spec: RobotSpec) -> Quantity:
        names = (*spec.actuators, *(one.actuator for one in spec.gripper_actuators))
        rows = np.array([find_element_id(self._model, "actuator", name) for name in names], np.intp)
        return Quantity(names, _make_reader(self._data.ctrl, rows))

    def _make_speed(self, spec: RobotSpec) -> Callable[[], Sequence[float]]:
        """Return a function that returns linear [m/s] and angular [rad/s] speed of the end effector."""
        tip = Tip(self._model, spec)

        def read() -> Sequence[float]:
            wx, wy, wz, vx, vy, vz = tip.read_velocity(self._data).tolist()
            return math.hypot(vx, vy, vz), math.hypot(wx, wy, wz)

        return read

    def _make_opening(self, spec: RobotSpec) -> Callable[[], Sequence[float]]:
        """Return a function that returns the measured opening of a gripper: 0 closed, 1 open.

        It is where a position actuator is now, in units of its `ctrl`, between the values that close and open it. Other
        actuators do not say where they are, and give NaN.
        """
        actuator, data = find_element_id(self._model, "actuator", spec.gripper_actuator), self._data
        scale, offset = find_opening_law(self._model, actuator, spec) or (math.nan, math.nan)
        return lambda: (scale * float(data.actuator_length[actuator]) + offset,)

    def solve_forces(self, state: bytes = b"") -> tuple[tuple[float, ...], NDArray[np.float64]]:
        """Return the contact forces on grippers and objects [N], as of `ContactTables`, solved once per state.

        Args:
            state: `World.save_state`; empty: the present one.
        """
        state = state or self.world.save_state()
        if state != self._solved:
            if self._scratch is None:
                self._scratch = mujoco.MjData(self._model)
            mujoco.mj_setState(self._model, self._scratch, np.frombuffer(state).copy(), STATE)
            mujoco.mj_forward(self._model, self._scratch)
            tables = self._tables
            self._forces = (
                tables.gripper_forces(self._model, self._scratch),
                tables.object_forces(self._model, self._scratch),
            )
            self._solved = state
        return self._forces


def list_moving(bodies: Sequence[BodyInfo]) -> list[str]:
    """Return the names of the bodies that move."""
    return [body.name for body in bodies if body.moving]


def read_steps(replay: Replay, selector: StepSelector) -> Iterator[tuple[ReplayedStep, PlantReader]]:
    """Take the steps of a replay again, and yield the selected ones with a reader of the world after each."""
    reader: PlantReader | None = None
    for step in replay.steps():
        if selector.selects(step.session_time):
            if reader is None or reader.world is not replay.core.world:
                reader = PlantReader(replay.core)
            yield step, reader


def _make_reader(numbers: NDArray[np.float64], rows: NDArray[np.intp]) -> Callable[[], Sequence[float]]:
    """Return a function that returns some of the numbers as they are then."""

    def read() -> Sequence[float]:
        picked: list[float] = numbers[rows].tolist()
        return picked

    return read


def _to_numbers(pose: Pose) -> tuple[float, ...]:
    return *pose.p, *pose.q
