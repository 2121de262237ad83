"""`WorldView` on MuJoCo data: what the authority and control may see of the world after the last tick.

A live view: it always shows the newest tick, reads arrays only when asked, and keeps each answer until the next tick.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import mujoco
import numpy as np

from iris_session.physics.contacts import ContactTables
from iris_session.physics.errors import UnknownNameError
from iris_session.physics.names import element_id
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.protocol.steps import ObjectContact

_T = TypeVar("_T")


class LiveView:
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
        self._site = {r.name: element_id(model, "site", r.site, f"robot {r.name!r}: ") for r in robots}
        self._qpos = {
            r.name: np.array(
                [model.jnt_qposadr[element_id(model, "joint", j, f"robot {r.name!r}: ")] for j in r.joints], np.int64
            )
            for r in robots
        }
        self._body = {o.name: element_id(model, "body", o.body, f"object {o.name!r}: ") for o in objects}
        self._index = {r.name: i for i, r in enumerate(robots)}
        self._site_xpos, self._site_xmat = data.site_xpos, data.site_xmat
        self._xpos, self._xquat, self._q = data.xpos, data.xquat, data.qpos
        self._quat = np.empty(4)
        self._tick = 0
        self._forces: tuple[float, ...] = (0.0,) * len(robots)
        #: Simulated time of one tick [ns].
        self.tick_period_ns = round(float(model.opt.timestep) * 1e9)
        self._tips: dict[str, Pose] = {}
        self._contacts: tuple[ObjectContact, ...] | None = None

    def advance(self, tick: int, forces: tuple[float, ...]) -> None:
        """Called by the world when its data shows a new state."""
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
        """`T_world_tip` of the robot's end-effector site."""
        pose = self._tips.get(robot)
        if pose is None:
            site = _known(self._site, "robot", robot)
            mujoco.mju_mat2Quat(self._quat, self._site_xmat[site])
            pose = self._tips[robot] = _pose(self._site_xpos[site].tolist(), self._quat.tolist())
        return pose

    def joints(self, robot: str) -> tuple[float, ...]:
        """Joint positions [rad or m] in the order of `RobotSpec.joints`."""
        return tuple(self._q[_known(self._qpos, "robot", robot)].tolist())

    def object_pose(self, name: str) -> Pose:
        """`T_world_object` of the object's body frame."""
        body = _known(self._body, "object", name)
        return _pose(self._xpos[body].tolist(), self._xquat[body].tolist())

    def object_contacts(self) -> Sequence[ObjectContact]:
        """Every object that touches something, and who touches it (see `ObjectContact`)."""
        if self._contacts is None:
            self._contacts = self._tables.object_contacts(self._data)
        return self._contacts

    def gripper_force(self, robot: str) -> float:
        """Sum of the normal contact forces on the finger bodies [N], as solved in the last tick."""
        return self._forces[_known(self._index, "robot", robot)]


def _pose(p: list[float], q: list[float]) -> Pose:
    return Pose((p[0], p[1], p[2]), (q[0], q[1], q[2], q[3]))


def _known(table: dict[str, _T], kind: str, name: str) -> _T:
    try:
        return table[name]
    except KeyError:
        raise UnknownNameError(kind, name, table) from None
