"""Objects held by a hand without a robot: a bounded spring-damper wrench toward the commanded pose, weight carried.

Stiffness and damping follow mass and inertia of the whole object, its hinged parts included as they stand (critically
damped at `grasp_frequency`), so light and heavy objects move alike until the force bound is met. The bound does not
count the object's weight.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from anchors.pose import PoseTuple, Vec3, apply, quat_conj, quat_mul, quat_rotate, quat_to_rotvec
from iris_session.control.arm_model import Floats, find_id
from iris_session.control.clutch import to_pose_tuple
from iris_session.control.config import ControlConfig, ControlError
from iris_session.protocol.specs import ObjectSpec
from iris_session.protocol.steps import ObjectCommand


class Grasps:
    """Writer of `data.xfrc_applied` of the objects that are commanded; clears it once when they no longer are."""

    def __init__(self, model: mujoco.MjModel, objects: Sequence[ObjectSpec], config: ControlConfig) -> None:
        """Raise `ControlError` for an object whose body is not free."""
        self._model = model
        self._config = config
        self._bodies: dict[str, int] = {}
        #: All bodies of an object, by its own body: those with a free joint hang on the world, so they are its root.
        self._parts: dict[int, NDArray[np.intp]] = {}
        for item in objects:
            body = find_id(model, "body", item.body)
            joint = int(model.body_jntadr[body])
            if joint < 0 or int(model.jnt_type[joint]) != int(mujoco.mjtJoint.mjJNT_FREE):
                raise ControlError(f"object {item.name!r}: body {item.body!r} must have a free joint")
            self._bodies[item.name] = body
            self._parts[body] = np.flatnonzero(np.asarray(model.body_rootid) == body)
        #: Commanded poses by object, in the order of the decision.
        self.commanded: dict[str, PoseTuple] = {}
        #: Objects whose wrench this room has written and not cleared yet.
        self.written: list[str] = []

    def set_goals(self, commands: Sequence[ObjectCommand]) -> None:
        """Set the commanded poses of this step. Raises `ControlError` for an unknown object."""
        if not commands and not self.commanded:
            return
        for c in commands:
            if c.object not in self._bodies:
                raise ControlError(f"object {c.object!r} is not known. Available objects: {', '.join(self._bodies)}")
        self.commanded = {c.object: to_pose_tuple(c.T_world_object) for c in commands}

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
            data.xfrc_applied[body] = self._compute_wrench(data, body, T_world_object)

    def _compute_wrench(self, data: mujoco.MjData, body: int, T_world_object: PoseTuple) -> Floats:
        """Return force [N] and torque [N m] at the body's centre of mass, world axes, shape (6,); zero
        if not finite.
        """
        w, config = self._config.grasp_frequency, self._config
        qw, qx, qy, qz = data.xquat[body].tolist()
        q = (qw, qx, qy, qz)
        mass, p_centre, inertia, weight, p_weight = self._measure_object(data, body)
        lever: Floats = p_centre - data.xpos[body]
        lx, ly, lz = lever.tolist()
        p_goal = np.array(apply(T_world_object, quat_rotate(quat_conj(q), (lx, ly, lz))))
        # A free joint's velocity: linear of the body's origin in world axes, angular in body axes.
        velocity = data.qvel[self._model.body_dofadr[body] : self._model.body_dofadr[body] + 6]
        wx, wy, wz = velocity[3:].tolist()
        omega = np.array(quat_rotate(q, (wx, wy, wz)))
        v_centre = velocity[:3] + np.cross(omega, lever)
        force = _limit_length(mass * (w * w * (p_goal - p_centre) - 2.0 * w * v_centre), config.grasp_max_force)
        turn: Vec3 = quat_to_rotvec(quat_mul(T_world_object[1], quat_conj(q)))
        torque = _limit_length(inertia @ (w * w * np.array(turn) - 2.0 * w * omega), config.grasp_max_torque)
        at = data.xipos[body]  # where MuJoCo applies it
        torque = torque + np.cross(p_centre - at, force) - np.cross(p_weight - at, weight)
        wrench = np.concatenate((force - weight, torque))
        return wrench if np.isfinite(wrench).all() else np.zeros(6)

    def _measure_object(self, data: mujoco.MjData, body: int) -> tuple[float, Floats, Floats, Floats, Floats]:
        """Return the object as one rigid body, all in the world.

        Mass [kg], centre (3,) [m], inertia about it (3, 3), weight (3,) [N] that the model does not carry itself, and
        where that acts (3,) [m].
        """
        model, parts = self._model, self._parts[body]
        masses, p = np.asarray(model.body_mass)[parts], data.xipos[parts]
        mass = float(masses.sum())
        p_centre: Floats = masses @ p / mass
        R = data.ximat[parts].reshape(-1, 3, 3)
        r = p - p_centre
        inertia: Floats = np.einsum("kij,kj,klj->il", R, model.body_inertia[parts], R)
        inertia += float(masses @ np.sum(r * r, axis=1)) * np.eye(3) - (masses[:, None] * r).T @ r
        carried = masses * (1.0 - np.asarray(model.body_gravcomp)[parts])
        p_weight = carried @ p / carried.sum() if carried.sum() else p_centre
        return mass, p_centre, inertia, carried.sum() * model.opt.gravity, p_weight


def _limit_length(vector: Floats, limit: float) -> Floats:
    length = float(np.linalg.norm(vector))
    return vector if length <= limit else vector * (limit / length)
