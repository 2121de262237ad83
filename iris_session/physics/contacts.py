"""Contacts: contact arrays of MuJoCo to `ObjectContact`s and gripper forces, vectorised.

Lookup tables are made once per model. A contact counts when its distance is within `includemargin`, the condition under
which MuJoCo makes a constraint of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.physics.names import find_element_id, get_element_name, list_body_names
from iris_session.physics.tree import KinematicTree
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.protocol.steps import ObjectContact

_NONE = -1
_PYRAMIDAL = int(mujoco.mjtCone.mjCONE_PYRAMIDAL)


class ContactTables:
    """Geom -> object, body -> robot and finger, for one model. Geom index -1 (a flex) hits the last table row."""

    def __init__(
        self, model: mujoco.MjModel, robots: Sequence[RobotSpec], objects: Sequence[ObjectSpec], tree: KinematicTree
    ) -> None:
        names = list_body_names(model)
        id_of = {name: index for index, name in enumerate(names)}
        body_object = [_NONE] * model.nbody
        for index, item in enumerate(objects):
            for body in tree.list_subtree(find_element_id(model, "body", item.body, f"object {item.name!r}: ")):
                body_object[body] = index
        #: Robot index of each body: of nested robots the deeper one; a shared base belongs to no particular robot.
        self.body_robot = [_NONE] * model.nbody
        #: Rigid finger of each body: the id of the body it is welded to, -1 for what is no finger.
        self.body_finger = [_NONE] * model.nbody
        roots = [(i, root) for i, spec in enumerate(robots) for root in _find_roots(model, tree, spec)]
        for index, root in sorted(roots, key=lambda pair: len(tree.list_ancestors(pair[1]))):
            for body in tree.list_subtree(root):
                self.body_robot[body] = index
        self._fingers_of: list[int] = []
        geom_finger_robot = np.full(model.ngeom + 1, _NONE, np.int64)
        for index, spec in enumerate(robots):
            fingers = [id_of[n] for n in spec.finger_bodies]
            for body in fingers:
                self.body_finger[body] = tree.weld[body]
                first, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
                geom_finger_robot[first : first + count if count else first] = index
            self._fingers_of.append(len({tree.weld[b] for b in fingers}))
        self._geom_finger_robot = geom_finger_robot
        geom_body: NDArray[np.int64] = np.append(model.geom_bodyid, 0).astype(np.int64)
        self._geom_object: NDArray[np.int64] = np.append(np.array(body_object, np.int64)[geom_body[:-1]], _NONE)
        self._geom_partner = geom_body
        self._n_partners = model.nbody + model.nflex
        self._flex_first = model.nbody if model.nflex else 0
        flex_names = [get_element_name(model, "flex", f) or f"flex_{f}" for f in range(model.nflex)]
        self._partner_names = (*names, *flex_names)
        self._robot_names = tuple(spec.name for spec in robots)
        self._object_names = tuple(spec.name for spec in objects)
        #: Contacts change rarely from tick to tick: what was found for the same ones last time is found again.
        self._last_active = b""
        self._last_contacts: tuple[ObjectContact, ...] = ()
        self._last_geoms = b""
        self._finger_rows: NDArray[np.int64] = np.zeros(0, np.int64)
        self._finger_robots: list[set[int]] = []
        self._has_fingers = bool((geom_finger_robot >= 0).any())
        self._no_forces = (0.0,) * len(robots)

    def object_contacts(self, data: Any) -> tuple[ObjectContact, ...]:
        """Return the objects that touch anything, in the order of the objects; names within in the order of ids."""
        if not data.ncon or not self._object_names:
            return ()
        contact = data.contact
        geom = contact.geom
        active = contact.dist < contact.includemargin
        seen = geom.tobytes() + active.tobytes()
        if self._flex_first:
            seen += contact.flex.tobytes()
        if seen == self._last_active:
            return self._last_contacts
        objects = self._geom_object[geom]
        partners = self._geom_partner[geom]
        if self._flex_first:
            partners = np.where(geom < 0, self._flex_first + contact.flex, partners)
        keys = np.where(objects >= 0, objects * self._n_partners + partners[:, ::-1], _NONE)[active]
        self._last_active = seen
        self._last_contacts = self._group_by_object(sorted(set(keys.ravel().tolist()) - {_NONE}))
        return self._last_contacts

    def _group_by_object(self, pairs: list[int]) -> tuple[ObjectContact, ...]:
        """Return one `ObjectContact` per object from sorted pairs `object * n_partners + partner`."""
        found: list[ObjectContact] = []
        start = 0
        while start < len(pairs):
            index = pairs[start] // self._n_partners
            end = start
            while end < len(pairs) and pairs[end] // self._n_partners == index:
                end += 1
            found.append(self._build_contact(index, [p - index * self._n_partners for p in pairs[start:end]]))
            start = end
        return tuple(found)

    def _build_contact(self, index: int, partners: list[int]) -> ObjectContact:
        touching: dict[int, set[int]] = {}
        others: list[str] = []
        for partner in partners:
            robot = self.body_robot[partner] if partner < len(self.body_robot) else _NONE
            if robot == _NONE:
                if self._partner_names[partner] != self._object_names[index]:
                    others.append(self._partner_names[partner])
                continue
            touching.setdefault(robot, set()).add(self.body_finger[partner])
        robots = sorted(touching)
        grippers = tuple(self._robot_names[r] for r in robots if self._is_holding(r, touching[r]))
        return ObjectContact(
            self._object_names[index], grippers, tuple(self._robot_names[r] for r in robots), tuple(others)
        )

    def _is_holding(self, robot: int, fingers: set[int]) -> bool:
        touched = len(fingers - {_NONE})
        return touched >= 2 or (touched == 1 and self._fingers_of[robot] == 1)

    def gripper_forces(self, model: mujoco.MjModel, data: Any) -> tuple[float, ...]:
        """Return per robot the sum of the normal contact forces on its finger bodies [N], from solved constraints.

        Only valid between `mj_step2` (or `mj_forward`) and the next `mj_step1`. A contact between two fingers of one
        robot counts once.
        """
        if not data.ncon or not self._has_fingers:
            return self._no_forces
        contact = data.contact
        geom = contact.geom
        geoms = geom.tobytes()
        if geoms != self._last_geoms:
            self._last_geoms = geoms
            robots = self._geom_finger_robot[geom]
            self._finger_rows = np.nonzero(robots.max(axis=1) >= 0)[0]
            self._finger_robots = [set(pair) - {_NONE} for pair in robots[self._finger_rows].tolist()]
        if not self._finger_robots:
            return self._no_forces
        forces = list(self._no_forces)
        efc_force = data.efc_force
        pyramidal = int(model.opt.cone) == _PYRAMIDAL
        address = contact.efc_address[self._finger_rows].tolist()
        dims = contact.dim[self._finger_rows].tolist()
        for robots_of, adr, dim in zip(self._finger_robots, address, dims, strict=True):
            if adr < 0:  # excluded from the solver
                continue
            # A pyramidal contact has 2 (dim - 1) edge forces whose sum is the normal force.
            width = 2 * (dim - 1) if pyramidal and dim > 1 else 1
            normal = sum(efc_force[adr : adr + width].tolist())
            for robot in robots_of:
                forces[robot] += normal
        return tuple(forces)

    def object_forces(self, model: mujoco.MjModel, data: Any) -> NDArray[np.float64]:
        """Return the contact forces on the bodies of each object [N], shape (n, 4). Valid as for `gripper_forces`.

        The sum of the normal forces, then the vector sum with friction, world frame. Contacts between bodies of one
        object do not count.
        """
        forces = np.zeros((len(self._object_names), 4))
        if not data.ncon or not len(forces):
            return forces
        contact, contact_force = data.contact, np.empty(6)
        pairs = self._geom_object[contact.geom]
        for row in np.nonzero(pairs[:, 0] != pairs[:, 1])[0].tolist():
            mujoco.mj_contactForce(model, data, row, contact_force)
            force_world = contact_force[:3] @ contact.frame[row].reshape(3, 3)  # on the second geom
            for index, sign in zip(pairs[row].tolist(), (-1.0, 1.0), strict=True):
                if index >= 0:
                    forces[index, 0] += contact_force[0]
                    forces[index, 1:] += sign * force_world
        return forces


def _find_roots(model: mujoco.MjModel, tree: KinematicTree, spec: RobotSpec) -> tuple[int, ...]:
    """Return the base body of a robot, and the highest body that one of its joints moves."""
    where = f"robot {spec.name!r}: "
    moved = [tree.joint_body[find_element_id(model, "joint", j, where)] for j in spec.joints]
    highest = [min(moved, key=lambda b: len(tree.list_ancestors(b)))] if moved else []
    return find_element_id(model, "body", spec.base_body, where), *highest
