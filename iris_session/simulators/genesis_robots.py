"""Robots of a Genesis scene: found among its entities, and moved by inverse kinematics and position control."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from iris_session.protocol.specs import RobotSpec
from iris_session.simulators.adapter import Floats, TipTarget, find_gripper, make_robot
from iris_session.simulators.joint_targets import Joints, JointTargets, place_fingers


class _Arm(NamedTuple):
    """A robot: entity, link of the tip, degrees of freedom of its arm, and those of its fingers."""

    entity: Any
    tip: Any
    dofs: list[int]
    qs: list[int]
    fingers: list[tuple[int, bool]]


class GenesisRobots:
    """The arms of a scene."""

    def __init__(self, scene: Any) -> None:
        self._scene = scene
        self._arms: dict[str, _Arm] = {}
        self._targets = JointTargets()

    def find(self, entity: Any, own: Sequence[str], name: str) -> RobotSpec | None:
        """Return the robot that an entity is, `None` for another entity.

        Args:
            entity: The entity.
            own: Names of the bodies of its links.
            name: Its name; where another robot has it, that of its first body is taken.
        """
        first = entity.link_start
        parents = [link.parent_idx - first if link.parent_idx >= first else -1 for link in entity.links]
        moves = [any(_is_single(joint) for joint in link.joints) for link in entity.links]
        gripper = find_gripper(parents, moves)
        if gripper is None:
            return None
        name = name if name not in self._arms else own[0]
        tip, fingers = gripper
        chain, at = [], tip
        while at > 0:
            chain += [joint for joint in entity.links[at].joints if _is_single(joint)]
            at = parents[at]
        of_fingers = [(joint.dofs_idx_local[0], _slides(joint)) for f in fingers for joint in entity.links[f].joints]
        dofs = [joint.dofs_idx_local[0] for joint in chain[::-1]]
        qs = [joint.qs_idx_local[0] for joint in chain[::-1]]
        self._arms[name] = _Arm(entity, entity.links[tip], dofs, qs, of_fingers)
        return make_robot(name, own, gripper)

    def apply_targets(self, targets: Mapping[str, TipTarget], time_s: float) -> None:
        """Set the targets of the drives.

        Args:
            targets: Targets by robot.
            time_s: Time of the simulation [s].
        """
        where: dict[str, Any] = {"envs_idx": [0]} if self._scene.n_envs else {}
        at = (time_s, float(self._scene.dt))
        for name, target in targets.items():
            arm, entity = self._arms[name], self._arms[name].entity
            p, q, found = np.array(target.pose.p), np.array(target.pose.q), None
            if not target.stops:
                solved = entity.inverse_kinematics(
                    link=arm.tip, pos=p, quat=q, max_samples=1, dofs_idx_local=arm.dofs, **where
                )
                found = _read(solved[..., arm.qs])
            goal = self._targets.limit(name, at, _read_joints(arm, where), found)
            entity.control_dofs_position(goal, arm.dofs, **where)
            if target.gripper is not None and arm.fingers:
                dofs = [dof for dof, _ in arm.fingers]
                limits = [_read(limit).tolist() for limit in entity.get_dofs_limit(dofs)]
                fingers = zip(dofs, *limits, [slides for _, slides in arm.fingers], strict=True)
                if places := place_fingers(fingers, target.gripper):
                    entity.control_dofs_position(np.array(list(places.values())), list(places), **where)


def _read_joints(arm: _Arm, where: Mapping[str, Any]) -> Joints:
    """Return the joints of an arm. Genesis does not say what its drives aim at: force / gain ahead at rest."""
    entity, dofs = arm.entity, arm.dofs
    q, v, force = (
        _read(read(dofs, **where))
        for read in (entity.get_dofs_position, entity.get_dofs_velocity, entity.get_dofs_control_force)
    )
    try:
        gain = _read(entity.get_dofs_kp(dofs))
    except Exception:  # of Genesis, for actuators that are no springs: these need no lead
        gain = np.zeros_like(q)
    lead = np.divide(force, gain, out=np.zeros_like(q), where=gain > 0.0)
    return Joints(q, v, q + lead, *(_read(limit) for limit in entity.get_dofs_limit(dofs)))


def _read(values: Any) -> Floats:
    """Return values of joints, of the first environment."""
    array = np.asarray(values.cpu(), np.float64)
    return array if array.ndim == 1 else array[0]


def _is_single(joint: Any) -> bool:
    return joint.type.name in ("REVOLUTE", "PRISMATIC")


def _slides(joint: Any) -> bool:
    return bool(joint.type.name == "PRISMATIC")
