"""Checks of robots and objects that are used together: nothing of a model belongs to two of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import mujoco

from iris_session.physics.errors import SpecError, UnknownNameError
from iris_session.physics.names import list_body_names
from iris_session.protocol.specs import ObjectSpec, RobotSpec


def check_specs(model: mujoco.MjModel, robots: Sequence[RobotSpec], objects: Sequence[ObjectSpec]) -> None:
    """Raise `SpecError` for anything that two robots or two objects share, `UnknownNameError` for finger bodies."""
    shared = find_shared_by_robots(robots)
    if shared:
        raise SpecError(shared)
    bodies = list_body_names(model)
    for robot in robots:
        for body in robot.finger_bodies:
            if body not in bodies:
                raise UnknownNameError("body", body, bodies[1:], f"robot {robot.name!r}: ")
    shared = _find_shared("object", ((item.name, (("name", item.name), ("body", item.body))) for item in objects))
    if shared:
        raise SpecError(shared)


def find_shared_by_robots(robots: Sequence[RobotSpec]) -> str:
    """Return in one line what two robots, or one robot twice, claim for themselves; empty when nothing."""
    return _find_shared("robot", ((robot.name, _list_owned(robot)) for robot in robots))


def _list_owned(robot: RobotSpec) -> list[tuple[str, str]]:
    actuators = [name for name in (*robot.actuators, robot.gripper_actuator) if name]
    return [("name", robot.name), *(("joint", j) for j in robot.joints), *(("actuator", a) for a in actuators)]


def _find_shared(kind: str, claims: Iterable[tuple[str, Iterable[tuple[str, str]]]]) -> str:
    owner: dict[tuple[str, str], str] = {}
    for claimant, claimed in claims:
        for key in claimed:
            if key in owner:
                return f"{key[0]} {key[1]!r} belongs to {kind} {owner[key]!r} and to {kind} {claimant!r}"
            owner[key] = claimant
    return ""
