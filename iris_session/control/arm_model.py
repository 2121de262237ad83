"""The kinematic chain of one robot alone: a tiny `MjModel` for inverse kinematics, built from the scene's arrays.

Solving on the arm alone costs a fifth of solving on the scene. Nothing is read from files, so it works for every
compiled model. The root of the chain is the body that carries the first arm joint: poses here are `T_root_tip`, and
the caller supplies `T_world_root` (constant unless the robot's base moves).
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from anchors.pose import PoseTuple
from iris_session.control.config import ControlError
from iris_session.physics.errors import UnknownNameError
from iris_session.physics.names import find_element_id
from iris_session.physics.tip import Tip
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import HAND, RobotSpec

Floats = NDArray[np.float64]

_JOINT_TYPES = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def find_id(model: mujoco.MjModel, kind: str, name: str) -> int:
    """Return the id of a named element. Raises `ControlError` with the available names."""
    try:
        return find_element_id(model, kind, name)
    except UnknownNameError as error:
        raise ControlError(str(error)) from None


class ArmModel:
    """Forward kinematics of one robot's chain. Joint vectors are in the order of `RobotSpec.joints`, shape (n,).

    Joints of a hand that do not move its tip (its fingers') are not in the model.
    """

    def __init__(self, scene: mujoco.MjModel, robot: RobotSpec) -> None:
        """Raise `ControlError` when the joints do not form one hinge/slide chain that ends at the end effector."""
        self.joint_ids, self.tip, chain = find_arm(scene, robot)
        self.root_body = int(scene.body_parentid[chain[0]]) if chain else self.tip.body
        self.model = _build_arm(scene, chain, self.tip.T_body_tip)
        self.data = mujoco.MjData(self.model)
        chain_ids = [j for body in chain for j in _list_joints(scene, body)]
        #: `q_chain = q[to_chain]`, `q = q_chain[from_chain]`.
        self.to_chain = np.array([self.joint_ids.index(j) for j in chain_ids], dtype=np.intp)
        self.from_chain = np.argsort(self.to_chain)

    def forward_kinematics(self, q: Floats) -> PoseTuple:
        """Return `T_root_tip` at joint positions `q`."""
        self.data.qpos[:] = q[self.to_chain]
        mujoco.mj_kinematics(self.model, self.data)
        return read_site_pose(self.data, 0)


def find_arm(scene: mujoco.MjModel, robot: RobotSpec) -> tuple[list[int], Tip, list[int]]:
    """Return the ids of the robot's joints, its tip, and the bodies from the first joint to the tip.

    Raises `ControlError` as `ArmModel` does; compiles nothing.
    """
    joint_ids = [find_id(scene, "joint", name) for name in robot.joints]
    try:
        tip = Tip(scene, robot)
    except UnknownNameError as error:
        raise ControlError(str(error)) from None
    return joint_ids, tip, _find_chain(scene, robot, joint_ids, tip.body)


def read_site_pose(data: mujoco.MjData, site_id: int) -> PoseTuple:
    """Return the world pose of a site, as plain floats."""
    x, y, z = data.site_xpos[site_id].tolist()
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, data.site_xmat[site_id])
    w, i, j, k = quat.tolist()
    return ((x, y, z), (w, i, j, k))


def has_moving_base(scene: mujoco.MjModel, body: int) -> bool:
    """Return true when `body` can move relative to the world (joints or mocap above it)."""
    while body > 0:
        if scene.body_jntnum[body] > 0 or scene.body_mocapid[body] >= 0:
            return True
        body = int(scene.body_parentid[body])
    return False


def read_joint_ranges(scene: mujoco.MjModel, arms: Sequence[ArmModel]) -> tuple[Floats, Floats]:
    """Return lower and upper limits of all arms' joints, shape (n,) each; infinite where there is none."""
    ids = np.array([joint for arm in arms for joint in arm.joint_ids], dtype=np.intp)
    limited, ranges = np.asarray(scene.jnt_limited)[ids].astype(bool), np.asarray(scene.jnt_range)[ids]
    return np.where(limited, ranges[:, 0], -np.inf), np.where(limited, ranges[:, 1], np.inf)


def _list_joints(scene: mujoco.MjModel, body: int) -> list[int]:
    start = int(scene.body_jntadr[body])
    return list(range(start, start + int(scene.body_jntnum[body])))


def _find_chain(scene: mujoco.MjModel, robot: RobotSpec, joint_ids: list[int], tip: int) -> list[int]:
    """Return the bodies from the first arm joint to the body of the tip; none for a hand without a wrist."""
    path = []
    body = tip
    while body > 0:
        path.append(body)
        body = int(scene.body_parentid[body])
    path.reverse()
    wanted = set(joint_ids)
    carrying = [k for k, b in enumerate(path) if any(j in wanted for j in _list_joints(scene, b))]
    chain = path[carrying[0] :] if carrying else []
    found = [j for b in chain for j in _list_joints(scene, b)]
    tip_name = f"site {robot.site!r}" if robot.site else f"body {robot.tip_body!r}"
    for joint, name in zip(joint_ids, robot.joints, strict=True):
        if joint not in found and robot.kind != HAND:
            raise ControlError(
                f"robot {robot.name!r}: joint {name!r} does not move {tip_name}; name joints on its chain only"
            )
        if int(scene.jnt_type[joint]) not in _JOINT_TYPES:
            raise ControlError(f"robot {robot.name!r}: joint {name!r} must be a hinge or a slide joint")
    extra = [mujoco.mj_id2name(scene, int(mujoco.mjtObj.mjOBJ_JOINT), j) or f"#{j}" for j in found if j not in wanted]
    # The model of a published world has no joints: its program moves the tip.
    is_tip_alone = not robot.joints and not any(_list_joints(scene, b) for b in path)
    if extra or (not found and robot.kind != HAND and not is_tip_alone):
        raise ControlError(
            f"robot {robot.name!r}: joints {', '.join(extra) or '(none)'} lie between its joints and {tip_name}; "
            "the chain must consist of the robot's own joints"
        )
    return chain


def _build_arm(scene: mujoco.MjModel, chain: list[int], T_body_tip: Pose) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    parent = spec.worldbody
    for body in chain:
        parent = parent.add_body(pos=scene.body_pos[body], quat=scene.body_quat[body])
        # Only kinematics is asked of this model; the compiler wants every moving body to have a mass.
        parent.mass, parent.inertia, parent.explicitinertial = 1.0, [1.0, 1.0, 1.0], True
        for joint in _list_joints(scene, body):
            parent.add_joint(
                type=mujoco.mjtJoint(int(scene.jnt_type[joint])),
                pos=scene.jnt_pos[joint],
                axis=scene.jnt_axis[joint],
                ref=scene.qpos0[scene.jnt_qposadr[joint]],
                limited=int(mujoco.mjtLimited.mjLIMITED_FALSE),  # limits are bounds of the solver, see `ik`
            )
    parent.add_site(name="tip", pos=T_body_tip.p, quat=T_body_tip.q)
    return spec.compile()
