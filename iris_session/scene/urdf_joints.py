"""Joints of a URDF: which link is the root, which joints are set, which follow others, and that all makes one tree."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from iris_session.protocol.common import Vec3
from iris_session.scene.articulation import Joint
from iris_session.scene.errors import SceneBuildError

_MOVING: Final = frozenset({"revolute", "continuous", "prismatic"})
_TREE: Final = "a URDF is a tree, leave one of them out (closed chains: in MJCF, one joint as an equality constraint)"
_KNOWN: Final = _MOVING | {"fixed", "floating", "planar"}


class Drive(NamedTuple):
    """What moves one joint: joint `joint` of the table, times `multiplier` plus `offset`, along or around `axis`."""

    joint: int
    multiplier: float
    offset: float
    axis: Vec3


class JointTable(NamedTuple):
    """`joints` that are set, in the order of the file; `drives` by the names of moving joints; `mimics`."""

    joints: tuple[Joint, ...]
    drives: Mapping[str, Drive]
    mimics: Mapping[str, str]


def root_link(file: str, robot: Any) -> str:
    """The link that no joint holds. Raises `SceneBuildError` unless links and joints are one tree."""
    names = [link.name for link in robot.links]
    if len(set(names)) != len(names) or not names:
        raise SceneBuildError(f"{file}: no link, or two of one name: {_repeated(names)}")
    held: dict[str, str] = {}
    known = set(names)
    for joint in robot.joints:
        for link in (joint.parent, joint.child):
            if link not in known:
                raise SceneBuildError(f"{file}: joint {joint.name} refers to link {link!r}, which is not there")
        if joint.child in held:
            raise SceneBuildError(
                f"{file}: link {joint.child} hangs on two joints, {held[joint.child]} and {joint.name}: {_TREE}"
            )
        held[joint.child] = joint.name
    roots = [name for name in names if name not in held]
    if len(roots) > 1:
        raise SceneBuildError(
            f"{file}: {len(roots)} links hang on no joint ({', '.join(roots[:8])}): in a URDF one does, join the others"
        )
    below: dict[str, list[str]] = {}
    for joint in robot.joints:
        below.setdefault(joint.parent, []).append(joint.child)
    reached, waiting = set(roots), roots.copy()
    while waiting:
        found = below.get(waiting.pop(), [])
        reached.update(found)
        waiting += found
    if len(reached) != len(names):
        joints = _loop(robot, next(name for name in names if name not in reached))
        raise SceneBuildError(f"{file}: the joints {', '.join(joints[:8])} make a loop: {_TREE}")
    return str(roots[0])


def _loop(robot: Any, link: str) -> list[str]:
    """The joints of the loop that a link hangs in or below, from link to link."""
    above = {joint.child: (joint.parent, joint.name) for joint in robot.joints}
    places: dict[str, int] = {}
    joints: list[str] = []
    while link not in places:
        places[link] = len(joints)
        link, name = above[link]
        joints.append(name)
    return joints[places[link] :][::-1]


def read_joints(file: str, robot: Any) -> JointTable:
    """The joints of a robot that is a tree. Raises `SceneBuildError`."""
    by_name = {joint.name: joint for joint in robot.joints}
    if len(by_name) != len(robot.joints):
        raise SceneBuildError(f"{file}: two joints of one name: {_repeated([joint.name for joint in robot.joints])}")
    for joint in robot.joints:
        if joint.type not in _KNOWN:
            raise SceneBuildError(
                f"{file}: joint {joint.name} of type {joint.type!r}; types are {', '.join(sorted(_KNOWN))}"
            )
    moving = [joint for joint in robot.joints if joint.type in _MOVING]
    free = [joint for joint in moving if joint.mimic is None]
    places = {joint.name: place for place, joint in enumerate(free)}
    drives, mimics = {}, {}
    for joint in moving:
        source, multiplier, offset = _followed(file, joint, by_name)
        drives[joint.name] = Drive(places[source], multiplier, offset, _axis(file, joint))
        if joint.mimic is not None:
            mimics[joint.name] = source
    return JointTable(tuple(_limits(file, joint) for joint in free), drives, mimics)


def _followed(file: str, joint: Any, by_name: Mapping[str, Any]) -> tuple[str, float, float]:
    """The joint that is set, and what its position is multiplied by and added to, along a chain of mimics."""
    multiplier, offset, seen = 1.0, 0.0, {joint.name}
    while joint.mimic is not None:
        times = 1.0 if joint.mimic.multiplier is None else float(joint.mimic.multiplier)
        plus = 0.0 if joint.mimic.offset is None else float(joint.mimic.offset)
        if not (math.isfinite(times) and math.isfinite(plus)):
            raise SceneBuildError(f"{file}: joint {joint.name} follows by a number that is not finite")
        multiplier, offset = multiplier * times, offset + multiplier * plus
        followed = by_name.get(joint.mimic.joint)
        if followed is None or followed.type not in _MOVING or followed.name in seen:
            raise SceneBuildError(
                f"{file}: joint {joint.name} follows {joint.mimic.joint!r}, which does not move, or follows it in turn"
            )
        seen.add(followed.name)
        joint = followed
    return joint.name, multiplier, offset


def _axis(file: str, joint: Any) -> Vec3:
    axis = np.asarray(joint.axis, np.float64).reshape(-1)
    length = float(np.linalg.norm(axis)) if axis.shape == (3,) else 0.0
    if not math.isfinite(length) or length < 1e-9:
        raise SceneBuildError(f"{file}: the axis of joint {joint.name} is {joint.axis}: three numbers, not all 0")
    x, y, z = (axis / length).tolist()
    return x, y, z


def _limits(file: str, joint: Any) -> Joint:
    """URDF counts a missing limit as 0; a joint without both has none."""
    low, high = -math.inf, math.inf
    limit = joint.limit
    if joint.type != "continuous" and limit is not None and (limit.lower is not None or limit.upper is not None):
        low, high = float(limit.lower or 0.0), float(limit.upper or 0.0)
    if math.isnan(low) or math.isnan(high) or low > high:
        raise SceneBuildError(f"{file}: joint {joint.name} has limits from {low} to {high}")
    return Joint(joint.name, joint.type, low, high, min(max(0.0, low), high))


def _repeated(names: list[str]) -> str:
    return ", ".join(sorted({name for name in names if names.count(name) > 1})) or "none"
