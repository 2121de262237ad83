"""The end effector of a robot: a site of the model, or a body with an offset where the model has no site."""

from __future__ import annotations

import math
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.physics.errors import SpecError
from iris_session.physics.names import find_element_id
from iris_session.protocol.common import Pose, Quat, Vec3
from iris_session.protocol.specs import RobotSpec

#: A quaternion that is shorter has no direction.
_SHORTEST: Final = 1e-6
_SITE, _BODY = int(mujoco.mjtObj.mjOBJ_SITE), int(mujoco.mjtObj.mjOBJ_XBODY)


class Tip:
    """The end effector of `robot` in `model`. Raises `UnknownNameError`, and `SpecError` for a pose that is
    none.

    Attributes:
        site: Id of its site, -1 where it is a body with an offset.
        body: Id of the body that carries it.
        T_body_tip: Its pose in the frame of that body.
    """

    def __init__(self, model: mujoco.MjModel, robot: RobotSpec) -> None:
        where = f"robot {robot.name!r}: "
        self._model = model
        self.site = -1 if robot.tip_body and not robot.site else find_element_id(model, "site", robot.site, where)
        if self.site < 0:
            self.body = find_element_id(model, "body", robot.tip_body, where)
            w, x, y, z = robot.T_body_tip.q
            length = math.hypot(w, x, y, z)
            if not (_SHORTEST < length < math.inf and all(map(math.isfinite, robot.T_body_tip.p))):
                raise SpecError(
                    f"{where}T_body_tip is {robot.T_body_tip}: expected is p [m] and a quaternion (w, x, y, z)"
                )
            self.T_body_tip = Pose(robot.T_body_tip.p, (w / length, x / length, y / length, z / length))
        else:
            self.body = int(model.site_bodyid[self.site])
            (x, y, z), (w, i, j, k) = model.site_pos[self.site].tolist(), model.site_quat[self.site].tolist()
            self.T_body_tip = Pose((x, y, z), (w, i, j, k))
        self._offset, self._turn = np.array(self.T_body_tip.p), np.array(self.T_body_tip.q)
        self._p, self._q = np.empty(3), np.empty(4)

    def read_position(self, data: Any) -> Any:
        """Return the position in the world [m], shape (3,)."""
        if self.site >= 0:
            return data.site_xpos[self.site]
        mujoco.mju_rotVecQuat(self._p, self._offset, data.xquat[self.body])
        return data.xpos[self.body] + self._p

    def read_pose(self, data: Any) -> tuple[Vec3, Quat]:
        """Return `T_world_tip` as plain floats."""
        if self.site >= 0:
            mujoco.mju_mat2Quat(self._q, data.site_xmat[self.site])
        else:
            mujoco.mju_mulQuat(self._q, data.xquat[self.body], self._turn)
        x, y, z = self.read_position(data).tolist()
        w, i, j, k = self._q.tolist()
        return ((x, y, z), (w, i, j, k))

    def read_velocity(self, data: Any) -> NDArray[np.float64]:
        """Return the velocity in the world: angular [rad/s], then linear [m/s], shape (6,)."""
        velocity = np.zeros(6)
        kind, index = (_SITE, self.site) if self.site >= 0 else (_BODY, self.body)
        mujoco.mj_objectVelocity(self._model, data, kind, index, velocity, 0)
        if self.site < 0:  # so far that of the origin of the body
            velocity[3:] += np.cross(velocity[:3], self.read_position(data) - data.xpos[self.body])
        return velocity
