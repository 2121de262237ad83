"""The kinematic tree of a model as Python lists: parents, children, joints, and which actuators drive which joints."""

from __future__ import annotations

import functools
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_BALL = int(mujoco.mjtJoint.mjJNT_BALL)
_TRN_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_TRN_TENDON = int(mujoco.mjtTrn.mjTRN_TENDON)
_WRAP_JOINT = int(mujoco.mjtWrap.mjWRAP_JOINT)
_EQ_JOINT = int(mujoco.mjtEq.mjEQ_JOINT)
_EQ_WELD = int(mujoco.mjtEq.mjEQ_WELD)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)


#: Geoms without a box.
_UNBOUNDED = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def _to_matrix(data: Any, geom: int) -> NDArray[np.float64]:
    matrix: NDArray[np.float64] = data.geom_xmat[geom].reshape(3, 3)
    return matrix


class KinematicTree:
    """Read-only view of the bodies, joints and actuators of `model`. All numbers are MuJoCo ids."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.parent: list[int] = model.body_parentid.tolist()
        self.weld: list[int] = model.body_weldid.tolist()
        self.children: list[list[int]] = [[] for _ in range(model.nbody)]
        for body in range(1, model.nbody):
            self.children[self.parent[body]].append(body)
        self.joint_body: list[int] = model.jnt_bodyid.tolist()
        self.joint_type: list[int] = model.jnt_type.tolist()
        self.free_bodies = tuple(self.joint_body[j] for j in range(model.njnt) if self.joint_type[j] == _FREE)
        #: Per actuator: the joints it drives, with the ratio d(transmission length)/d(joint position).
        self.driven: list[dict[int, float]] = [self._driven_joints(a) for a in range(model.nu)]
        #: Per joint: actuators with a joint transmission on it.
        self.actuators_of_joint: list[list[int]] = [[] for _ in range(model.njnt)]
        for actuator in range(model.nu):
            if int(model.actuator_trntype[actuator]) in _TRN_JOINTS:
                self.actuators_of_joint[int(model.actuator_trnid[actuator, 0])].append(actuator)
        #: Joint equalities as (dependent joint, leading joint, slope at the reference).
        self.couplings = tuple(
            (int(model.eq_obj1id[e]), int(model.eq_obj2id[e]), float(model.eq_data[e, 1]))
            for e in range(model.neq)
            if int(model.eq_type[e]) == _EQ_JOINT and int(model.eq_obj2id[e]) >= 0
        )

    @functools.cached_property
    def mocap_joints(self) -> frozenset[int]:
        """Joints of arms that a mocap body pulls along by a weld, as of Fetch and Meta-World: those on the way to the
        welded body, without slides at its base, where none has an actuator.
        """
        model, found = self.model, set()
        for e in range(model.neq):
            if int(model.eq_type[e]) != _EQ_WELD or self._is_weld_of_sites(e):
                continue
            bodies = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
            for mocap, welded in (bodies, bodies[::-1]):
                if int(model.body_mocapid[mocap]) < 0:
                    continue
                path = [j for b in reversed(self.list_ancestors(welded)) for j in self.list_scalar_joints(b)]
                while path and self.joint_type[path[0]] == _SLIDE:
                    path.pop(0)
                if not any(self.actuators_of_joint[j] for j in path):
                    found.update(path)
        return frozenset(found)

    def _is_weld_of_sites(self, equality: int) -> bool:
        types = getattr(self.model, "eq_objtype", None)
        return types is not None and int(types[equality]) != int(mujoco.mjtObj.mjOBJ_BODY)

    def is_driven(self, joint: int) -> bool:
        """Return true for a joint with an actuator of its own, and for those of `mocap_joints`."""
        return bool(self.actuators_of_joint[joint]) or joint in self.mocap_joints

    def _driven_joints(self, actuator: int) -> dict[int, float]:
        model = self.model
        kind, target = int(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator, 0])
        gear = float(model.actuator_gear[actuator, 0])
        if kind in _TRN_JOINTS:
            return {target: gear}
        if kind != _TRN_TENDON:
            return {}
        wraps = range(int(model.tendon_adr[target]), int(model.tendon_adr[target]) + int(model.tendon_num[target]))
        return {
            int(model.wrap_objid[w]): gear * float(model.wrap_prm[w])
            for w in wraps
            if int(model.wrap_type[w]) == _WRAP_JOINT
        }

    @functools.cached_property
    def rest(self) -> Any:
        """Data of the model with the kinematics of its reference configuration, `qpos0`."""
        data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, data)
        return data

    @functools.cached_property
    def reach(self) -> list[int]:
        """Per body: most driven hinges and slides on any path down from it, its own included."""
        reach = [0] * len(self.parent)
        for body in range(len(reach) - 1, 0, -1):  # parents have lower ids
            own = sum(self.is_driven(j) for j in self.list_scalar_joints(body))
            reach[body] = own + max((reach[child] for child in self.children[body]), default=0)
        return reach

    def list_corners(self, body: int, data: Any = None) -> NDArray[np.float64]:
        """Return the corners of the bounding boxes of a body's geoms in the world [m], shape (8 n, 3).

        `data`: where the bodies are; `rest` if none is given. Planes have no corners.
        """
        model, data = self.model, self.rest if data is None else data
        first, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
        corners = [
            data.geom_xpos[g] + (model.geom_aabb[g, :3] + _SIGNS * model.geom_aabb[g, 3:]) @ _to_matrix(data, g).T
            for g in range(first, first + count)
            if int(model.geom_type[g]) not in _UNBOUNDED
        ]
        return np.concatenate(corners) if corners else np.empty((0, 3))

    def list_joints(self, body: int) -> range:
        """Return the joint ids of one body, in order."""
        first = int(self.model.body_jntadr[body])
        return range(first, first + int(self.model.body_jntnum[body])) if first >= 0 else range(0)

    def list_scalar_joints(self, body: int) -> list[int]:
        """Return the hinges and slides of one body."""
        return [j for j in self.list_joints(body) if self.joint_type[j] not in (_FREE, _BALL)]

    def list_subtree(self, body: int) -> list[int]:
        """Return `body` and everything below it, parents first, by id among siblings."""
        found = [body]
        for b in found:
            found.extend(self.children[b])
        return found

    def list_ancestors(self, body: int) -> list[int]:
        """Return `body` and its ancestors up to and without the world."""
        found = []
        while body > 0:
            found.append(body)
            body = self.parent[body]
        return found

    def list_jointed_below(self, body: int) -> list[int]:
        """Return the nearest bodies below `body` that have hinges or slides: the branches at this body."""
        found: list[int] = []
        left = self.children[body][::-1]  # not by recursion: chains may be longer than Python's stack
        while left:
            child = left.pop()
            if self.list_scalar_joints(child):
                found.append(child)
            else:
                left.extend(reversed(self.children[child]))
        return found

    def find_moving_bodies(self) -> list[bool]:
        """Return for every body whether it can move: by a joint or the user, or because it is fixed on one that can."""
        mocap = (self.model.body_mocapid >= 0).tolist()
        moving = [False] * len(mocap)
        for b, parent in enumerate(self.model.body_parentid.tolist()):
            # Before MuJoCo 3.4 mocap bodies, and what is fixed on them, are welded to the world.
            moving[b] = b > 0 and (self.weld[b] != 0 or mocap[b] or moving[parent])
        return moving

    def find_flex_vertex_bodies(self) -> frozenset[int]:
        """Return the bodies that MuJoCo made for the vertices or nodes of a flex.

        They have one to three slides each (`dof` of a flexcomp), and nothing on them or below. Pinned and rigid
        vertices belong to ordinary bodies, which are not among them. The target of a light or camera is not either.
        """
        model = self.model
        used = {*model.light_bodyid.tolist(), *model.cam_bodyid.tolist(), *model.site_bodyid.tolist()}
        used |= {*model.light_targetbodyid.tolist(), *model.cam_targetbodyid.tolist()}
        listed: set[int] = set()
        for array in ("flex_vertbodyid", "flex_nodebodyid"):
            if model.nflex and hasattr(model, array):
                bodies, points = np.unique(getattr(model, array), return_counts=True)
                listed.update(bodies[points == 1].tolist())
        return frozenset(
            b
            for b in listed
            if b > 0
            and b not in used
            and not self.children[b]
            and int(model.body_geomnum[b]) == 0
            and 1 <= int(model.body_jntnum[b]) <= 3
            and self._has_only_slides(b)
        )

    def _has_only_slides(self, body: int) -> bool:
        """Return true when all joints of a body are slides."""
        first, n = int(self.model.body_jntadr[body]), int(self.model.body_jntnum[body])
        return bool((self.model.jnt_type[first : first + n] == mujoco.mjtJoint.mjJNT_SLIDE).all())
