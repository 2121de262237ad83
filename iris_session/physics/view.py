"""Views of MuJoCo data after the last tick: the `WorldView` of authority and control, and deformables (MuJoCo's
flexes).

Both are live: they always show the newest tick. `MujocoView` reads arrays only when asked, and keeps each answer until
the next tick. Contacts of flexes have no geom on the side of the flex; they count as in `contacts`, within
`includemargin`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.physics.contacts import ContactTables
from iris_session.physics.errors import UnknownNameError
from iris_session.physics.names import find_element_id, get_element_name
from iris_session.physics.tip import Tip
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.protocol.steps import ObjectContact

_T = TypeVar("_T")


class MujocoView:
    """The `protocol.steps.WorldView` of one `World`. Made and advanced by the world only."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: Any,
        robots: Sequence[RobotSpec],
        objects: Sequence[ObjectSpec],
        tables: ContactTables,
    ) -> None:
        self._data = data
        self._tables = tables
        self._tip = {r.name: Tip(model, r) for r in robots}
        self._qpos = {
            r.name: np.array(
                [model.jnt_qposadr[find_element_id(model, "joint", j, f"robot {r.name!r}: ")] for j in r.joints],
                np.int64,
            )
            for r in robots
        }
        self._body = {o.name: find_element_id(model, "body", o.body, f"object {o.name!r}: ") for o in objects}
        self._index = {r.name: i for i, r in enumerate(robots)}
        self._xpos, self._xquat, self._q = data.xpos, data.xquat, data.qpos
        self._tick = 0
        self._forces: tuple[float, ...] = (0.0,) * len(robots)
        #: Simulated time of one tick [ns].
        self.tick_period_ns = round(float(model.opt.timestep) * 1e9)
        self._tips: dict[str, Pose] = {}
        self._contacts: tuple[ObjectContact, ...] | None = None

    def advance(self, tick: int, forces: tuple[float, ...]) -> None:
        """Set tick and forces when the world's data shows a new state. For the world only."""
        self._tick = tick
        self._forces = forces
        self._tips.clear()
        self._contacts = None

    @property
    def tick(self) -> int:
        """Physics ticks since the last reset."""
        return self._tick

    @property
    def sim_time(self) -> float:
        """Simulated time [s]."""
        return float(self._data.time)

    def tip_pose(self, robot: str) -> Pose:
        """Return `T_world_tip` of the robot's end effector."""
        pose = self._tips.get(robot)
        if pose is None:
            pose = self._tips[robot] = Pose(*_find(self._tip, "robot", robot).read_pose(self._data))
        return pose

    def joints(self, robot: str) -> tuple[float, ...]:
        """Return joint positions [rad or m] in the order of `RobotSpec.joints`."""
        return tuple(self._q[_find(self._qpos, "robot", robot)].tolist())

    def object_pose(self, name: str) -> Pose:
        """Return `T_world_object` of the object's body frame."""
        body = _find(self._body, "object", name)
        return _to_pose(self._xpos[body].tolist(), self._xquat[body].tolist())

    def object_contacts(self) -> Sequence[ObjectContact]:
        """Return every object that touches something, with its contacts (see `ObjectContact`)."""
        if self._contacts is None:
            self._contacts = self._tables.object_contacts(self._data)
        return self._contacts

    def gripper_force(self, robot: str) -> float:
        """Return the sum of the normal contact forces on the finger bodies [N], as solved in the last tick."""
        return self._forces[_find(self._index, "robot", robot)]


def _to_pose(p: list[float], q: list[float]) -> Pose:
    return Pose((p[0], p[1], p[2]), (q[0], q[1], q[2], q[3]))


def _find(table: dict[str, _T], kind: str, name: str) -> _T:
    try:
        return table[name]
    except KeyError:
        raise UnknownNameError(kind, name, table) from None


class Flexes:
    """The deformables of one world. `names`: by id, `flex_N` where the model has none."""

    def __init__(self, model: mujoco.MjModel, data: Any, robots: Sequence[RobotSpec], tables: ContactTables) -> None:
        self._model, self._data = model, data
        self.names = tuple(get_element_name(model, "flex", f) or f"flex_{f}" for f in range(model.nflex))
        self._id = {name: index for index, name in enumerate(self.names)}
        starts, counts = model.flex_vertadr.tolist(), model.flex_vertnum.tolist()
        self._rows = [slice(start, start + count) for start, count in zip(starts, counts, strict=True)]
        self._robot_names = tuple(robot.name for robot in robots)
        robot_of_body = np.array(tables.body_robot, np.int64)
        #: Robot of each geom; the last entry, which the geom -1 of a flex hits, means none.
        self._geom_robot: NDArray[np.int64] = np.append(robot_of_body[model.geom_bodyid], -1)

    def read_vertices(self, name: str) -> NDArray[np.float64]:
        """Return world positions of all vertices after the last tick [m], shape (n, 3), in the order of the model. A
        copy.
        """
        try:
            rows = self._rows[self._id[name]]
        except KeyError:
            raise UnknownNameError("deformable", name, self._id) from None
        positions: NDArray[np.float64] = self._data.flexvert_xpos[rows].copy()
        return positions

    def find_touching_robots(self, name: str) -> tuple[str, ...]:
        """Return the robots of which any geom touches it, in the order of the robots."""
        if name not in self._id:
            raise UnknownNameError("deformable", name, self._id)
        contact = self._data.contact
        mine = (contact.flex == self._id[name]).any(axis=1) & (contact.dist < contact.includemargin)
        found = np.unique(self._geom_robot[contact.geom[mine]]).tolist()
        return tuple(self._robot_names[robot] for robot in found if robot >= 0)
