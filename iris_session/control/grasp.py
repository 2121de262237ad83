"""Objects held by a hand without a robot: a bounded spring-damper wrench toward the commanded pose, weight carried.

Stiffness and damping follow the object's own mass and inertia (critically damped at `grasp_frequency`), so light and
heavy objects move alike until the force bound is met. The bound does not count the object's weight.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from anchors.pose import PoseTuple, Vec3, apply, quat_conj, quat_mul, quat_rotate, quat_to_rotvec
from iris_session.control.arm_model import Floats, named_id
from iris_session.control.clutch import pose_tuple
from iris_session.control.config import ControlConfig
from iris_session.control.errors import ControlError
from iris_session.protocol.specs import ObjectSpec
from iris_session.protocol.steps import ObjectCommand


class Grasps:
    """Writes `data.xfrc_applied` of the objects that are commanded, and clears it once when they no longer are."""

    def __init__(self, model: mujoco.MjModel, objects: Sequence[ObjectSpec], config: ControlConfig) -> None:
        """Raises `ControlError` for an object whose body is not free."""
        self._model = model
        self._config = config
        self._bodies: dict[str, int] = {}
        for item in objects:
            body = named_id(model, mujoco.mjtObj.mjOBJ_BODY, item.body, "body")
            joint = int(model.body_jntadr[body])
            if joint < 0 or int(model.jnt_type[joint]) != int(mujoco.mjtJoint.mjJNT_FREE):
                raise ControlError(f"object {item.name!r}: body {item.body!r} must have a free joint")
            self._bodies[item.name] = body
        #: Commanded poses by object, in the order of the decision.
        self.commanded: dict[str, PoseTuple] = {}
        #: Objects whose wrench this room has written and not cleared yet.
        self.written: list[str] = []

    def command(self, commands: Sequence[ObjectCommand]) -> None:
        """The objects of this step. Raises `ControlError` for an unknown object."""
        if not commands and not self.commanded:
            return
        for c in commands:
            if c.object not in self._bodies:
                raise ControlError(f"object {c.object!r} is not known. Available objects: {', '.join(self._bodies)}")
        self.commanded = {c.object: pose_tuple(c.T_world_object) for c in commands}

    def reset(self, data: mujoco.MjData) -> None:
        self.commanded = {}
        self.tick(data)

    def tick(self, data: mujoco.MjData) -> None:
        for name in self.written:
            if name not in self.commanded:
                data.xfrc_applied[self._bodies[name]] = 0.0
        self.written = list(self.commanded)
        for name, T_world_object in self.commanded.items():
            body = self._bodies[name]
            data.xfrc_applied[body] = self._wrench(data, body, T_world_object)

    def _wrench(self, data: mujoco.MjData, body: int, T_world_object: PoseTuple) -> Floats:
        """Force [N] and torque [N m] at the centre of mass, world axes, shape (6,)."""
        model, w = self._model, self._config.grasp_frequency
        px, py, pz = model.body_ipos[body].tolist()
        p_goal = np.array(apply(T_world_object, (px, py, pz)))
        qw, qx, qy, qz = data.xquat[body].tolist()
        q = (qw, qx, qy, qz)
        # A free joint's velocity: linear of the body's origin in world axes, angular in body axes.
        velocity = data.qvel[model.body_dofadr[body] : model.body_dofadr[body] + 6]
        wx, wy, wz = velocity[3:].tolist()
        omega = np.array(quat_rotate(q, (wx, wy, wz)))
        lever = data.xipos[body] - data.xpos[body]
        v_centre = velocity[:3] + np.cross(omega, lever)
        mass = float(model.body_mass[body])
        force = mass * (w * w * (p_goal - data.xipos[body]) - 2.0 * w * v_centre)
        turn: Vec3 = quat_to_rotvec(quat_mul(T_world_object[1], quat_conj(q)))
        R_world_inertial = data.ximat[body].reshape(3, 3)
        inertia = R_world_inertial @ np.diag(model.body_inertia[body]) @ R_world_inertial.T
        torque = inertia @ (w * w * np.array(turn) - 2.0 * w * omega)
        force = _bounded(force, self._config.grasp_max_force)
        weight = mass * (1.0 - float(model.body_gravcomp[body])) * model.opt.gravity
        return np.concatenate((force - weight, _bounded(torque, self._config.grasp_max_torque)))


def _bounded(vector: Floats, limit: float) -> Floats:
    length = float(np.linalg.norm(vector))
    return vector if length <= limit else vector * (limit / length)
