"""The robots file: `RobotSpec`s as TOML, for models whose robots cannot be found, or need other names.

    [[robot]]
    name = "left"
    joints = ["left/joint1", "left/joint2", "left/joint3"]
    site = "left/tcp"

Only these three keys are needed; `actuators` and `base_body` are derived where the model leaves no choice. Without a
site, `tip_body` and `tip_offset` say where the end effector is. What has no name in the model is given by its number,
an actuator also by its joint. Every mistake is one line that lists what would have been right.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import mujoco

from iris_session.physics.errors import RobotsFileError, one_line
from iris_session.physics.gripper import find_partners
from iris_session.physics.names import (
    find_element_id,
    get_element_name,
    get_reference,
    is_wire_name,
    list_body_names,
)
from iris_session.physics.tree import KinematicTree
from iris_session.protocol.common import Pose
from iris_session.protocol.names import LeaseMode
from iris_session.protocol.specs import ARM, HAND, ON_RELEASE_HOLD, ON_RELEASE_HOME, GripperActuator, RobotSpec

#: The keys in their order, and what a value must be.
_TEXT, _REFERENCES, _ONE_OR_MORE, _NUMBERS, _VECTOR, _QUATERNION = (
    "a string",
    "a list of names or numbers",
    "a name or number, or a list of them",
    "a number, or a list of them",
    "three numbers [m]",
    "a quaternion, w first",
)
_KEYS: Final = {
    "name": _TEXT,
    "joints": _REFERENCES,
    "actuators": _REFERENCES,
    "site": _TEXT,
    "tip_body": _TEXT,
    "tip_offset": _VECTOR,
    "tip_rotation": _QUATERNION,
    "base_body": _TEXT,
    "gripper_actuator": _ONE_OR_MORE,
    "gripper_open": _NUMBERS,
    "gripper_closed": _NUMBERS,
    "finger_bodies": _REFERENCES,
    "mode": _TEXT,
    "hold": _TEXT,
    "kind": _TEXT,
    "on_release": _TEXT,
}
_HOLDS: Final = ("", "gravity_pd")
_KINDS: Final = (ARM, HAND)
_ON_RELEASE: Final = (ON_RELEASE_HOLD, ON_RELEASE_HOME)


def load_robots_toml(path_or_text: str | Path, model: mujoco.MjModel) -> tuple[RobotSpec, ...]:
    """Read the robots of a model from TOML.

    Args:
        path_or_text: Path of a file, or TOML text (anything with a line break or an equals sign).
        model: Model whose joints, sites and actuators the file names.

    Returns:
        The robots, in the order of the file.

    Raises:
        RobotsFileError: The TOML is damaged, or a table lacks or repeats something.
        UnknownNameError: The model does not have a name in it.
    """
    where, text = _read_text(path_or_text)
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise RobotsFileError(f"{where}: {one_line(error)}") from error
    unknown = sorted(set(document) - {"robot"})
    tables = document.get("robot", [])
    if unknown or not isinstance(tables, list) or not all(isinstance(t, dict) for t in tables):
        raise RobotsFileError(f"{where}: expected only [[robot]] tables, found {', '.join(unknown) or 'robot'}")
    tree = KinematicTree(model)
    return tuple(_parse_robot(tree, table, f"{where}, robot {index + 1}") for index, table in enumerate(tables))


def dump_robots_toml(robots: Sequence[RobotSpec], notes: Sequence[Mapping[str, str]] = ()) -> str:
    """Return TOML text that `load_robots_toml` reads back. `notes`: per robot, key -> comment behind that key."""
    lines = ["# Robots of this model. Needed: name, joints, and site or tip_body. Gripper values are ctrl units."]
    for index, robot in enumerate(robots):
        comments = dict(notes[index]) if index < len(notes) else {}
        lines += ["", "[[robot]]"]
        values = _list_values(robot)
        for key in _KEYS:
            comment = f"# {one_line(comments[key])}" if key in comments else ""
            if key in values:
                lines.append(f"{key} = {_format_value(values[key])}{comment and '  '}{comment}")
            elif comment:
                lines.append(f"# {key}: {comment[2:]}")
    return "\n".join(lines) + "\n"


def _list_values(robot: RobotSpec) -> dict[str, Any]:
    """Return the values of the keys that say something: no defaults."""
    grippers = robot.gripper_actuators
    values: dict[str, Any] = {
        "name": robot.name,
        "joints": list(robot.joints),
        "actuators": list(robot.actuators),
        "site": robot.site,
        "base_body": robot.base_body,
        "finger_bodies": list(robot.finger_bodies),
        "mode": robot.mode,
        "hold": robot.hold,
        "kind": robot.kind if robot.kind != ARM else "",
        "on_release": robot.on_release if robot.on_release != ON_RELEASE_HOLD else "",
    }
    if not robot.site:
        tip = robot.T_body_tip
        turned = tip.q != (1.0, 0.0, 0.0, 0.0)
        values |= {"tip_body": robot.tip_body, "tip_offset": list(tip.p), "tip_rotation": list(tip.q) if turned else ""}
    for key in ("actuator", "open", "closed"):
        several = [getattr(one, key) for one in grippers]
        values[f"gripper_{key}"] = several[0] if len(several) == 1 else several
    return {key: value for key, value in values.items() if value or (key == "actuators" and value == [])} | {
        key: values[key] for key in ("gripper_open", "gripper_closed") if grippers
    }


def _format_value(value: Any) -> str:
    """Return the TOML of a value: its strings and arrays are those of JSON but for DEL, floats are `repr`."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")


def _read_text(path_or_text: str | Path) -> tuple[str, str]:
    if isinstance(path_or_text, str) and ("\n" in path_or_text or "=" in path_or_text):
        return "robots", path_or_text
    path = Path(path_or_text).expanduser()
    try:
        return path.name, path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RobotsFileError(f"robots file {str(path)!r} cannot be read: {one_line(error)}") from error


def _parse_robot(tree: KinematicTree, table: dict[str, Any], where: str) -> RobotSpec:
    fields = _check_types(table, where)
    where = f"{where} ({fields['name']}): "
    for key, allowed in (
        ("mode", sorted(LeaseMode.ALL)),
        ("hold", _HOLDS),
        ("kind", _KINDS),
        ("on_release", _ON_RELEASE),
    ):
        if fields.get(key, allowed[0]) not in allowed:
            listed = ", ".join(one or "empty" for one in allowed)
            raise RobotsFileError(f"{where}{key} {fields[key]!r} is none of {listed}")
    joints = [find_element_id(tree.model, "joint", j, where) for j in fields["joints"]]
    _check_joints(tree, fields, joints, where)
    fields["joints"] = tuple(get_reference(tree.model, "joint", j) for j in joints)
    tip = _take_tip(tree, fields, where)
    fields["actuators"] = _choose_actuators(tree, fields, joints, where)
    fields["base_body"] = _base_body(tree, fields, joints, tip, where)
    _take_gripper(tree, fields, joints, where)
    return RobotSpec(**fields)


def _check_types(table: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the table with known keys and right types only: references become texts, lists tuples."""
    unknown = sorted(set(table) - set(_KEYS))
    if unknown:
        raise RobotsFileError(f"{where}: unknown key {unknown[0]!r}. Available keys: {', '.join(_KEYS)}.")
    missing = [key for key in ("name", "joints") if not table.get(key)]
    if missing:
        raise RobotsFileError(f"{where}: {missing[0]!r} is missing or empty")
    fields = {}
    for key, value in table.items():
        read = _read_value(_KEYS[key], value)
        if read is None:
            raise RobotsFileError(f"{where}: {key!r} must be {_KEYS[key]}, not {value!r}")
        fields[key] = read
    if not is_wire_name(fields["name"]):
        raise RobotsFileError(f"{where}: name {fields['name']!r} is longer than 64 characters")
    return fields


def _read_value(kind: str, value: Any) -> Any:
    """Return a value as its kind has it, `None` for a wrong one."""
    if kind == _TEXT:
        return value if isinstance(value, str) else None
    several = value if isinstance(value, list) else [value] if kind in (_ONE_OR_MORE, _NUMBERS) else None
    if several is None or any(isinstance(one, bool) for one in several):
        return None
    if kind in (_REFERENCES, _ONE_OR_MORE):
        texts = [f"#{one}" if isinstance(one, int) and one >= 0 else one for one in several]
        return tuple(one for one in texts if one) if all(isinstance(one, str) for one in texts) else None
    if not all(isinstance(one, int | float) and math.isfinite(one) for one in several):
        return None
    numbers = tuple(float(one) for one in several)
    if kind == _QUATERNION and len(numbers) == 4 and (norm := math.hypot(*numbers)) > 0.5:
        return tuple(one / norm for one in numbers)
    return numbers if kind == _NUMBERS or (kind == _VECTOR and len(numbers) == 3) else None


def _check_joints(tree: KinematicTree, fields: dict[str, Any], joints: list[int], where: str) -> None:
    for name, joint in zip(fields["joints"], joints, strict=True):
        if joint not in tree.list_scalar_joints(tree.joint_body[joint]):
            raise RobotsFileError(f"{where}joint {name!r} is a free or ball joint; a robot's are hinges and slides")
        if joints.count(joint) > 1:
            raise RobotsFileError(f"{where}joint {name!r} is listed twice")


def _take_tip(tree: KinematicTree, fields: dict[str, Any], where: str) -> int:
    """Replace the keys of the end effector by the fields of `RobotSpec`; return the body that carries it."""
    offset, rotation = fields.pop("tip_offset", None), fields.pop("tip_rotation", None)
    site, body = fields.setdefault("site", ""), fields.get("tip_body", "")
    if site:
        if body or offset or rotation:
            raise RobotsFileError(f"{where}site and tip_body both say where the end effector is: give one of them")
        return int(tree.model.site_bodyid[find_element_id(tree.model, "site", site, where)])
    if not body:
        raise RobotsFileError(
            f"{where}'site' is missing or empty; without a site, tip_body and tip_offset = [x, y, z] in its frame give "
            "the end effector"
        )
    fields["T_body_tip"] = Pose(offset or (0.0, 0.0, 0.0), rotation or (1.0, 0.0, 0.0, 0.0))
    return find_element_id(tree.model, "body", body, where)


def _find_actuator(tree: KinematicTree, reference: str, where: str) -> int:
    """Return the id of an actuator given by its name or number, or by the joint that it alone drives."""
    model = tree.model
    if int(mujoco.mj_name2id(model, int(mujoco.mjtObj.mjOBJ_ACTUATOR), reference)) < 0:
        joint = int(mujoco.mj_name2id(model, int(mujoco.mjtObj.mjOBJ_JOINT), reference))
        driving = [] if joint < 0 else [a for a, driven in enumerate(tree.driven) if joint in driven]
        if len(driving) == 1:
            return driving[0]
    return find_element_id(model, "actuator", reference, where)


def _choose_actuators(tree: KinematicTree, fields: dict[str, Any], joints: list[int], where: str) -> tuple[str, ...]:
    """Return one actuator per joint: as listed (each must drive its joint), or the only one that each joint has."""
    listed: tuple[str, ...] | None = fields.get("actuators")
    if listed == ():
        return ()
    if listed and len(listed) != len(joints):
        raise RobotsFileError(f"{where}{len(joints)} joints but {len(listed)} actuators; one per joint, in order")
    chosen = []
    for index, joint in enumerate(joints):
        candidates = tree.actuators_of_joint[joint]
        have = ", ".join(get_reference(tree.model, "actuator", a) for a in candidates) or "none"
        if not listed:
            if len(candidates) != 1:
                advice = "" if candidates else "; actuators = [] is for a robot that only your own program moves"
                raise RobotsFileError(
                    f"{where}joint {fields['joints'][index]!r} needs one actuator, has {have}{advice}"
                )
            chosen.append(candidates[0])
            continue
        chosen.append(_find_actuator(tree, listed[index], where))
        if chosen[-1] not in candidates:
            raise RobotsFileError(
                f"{where}actuator {listed[index]!r} does not drive joint {fields['joints'][index]!r}; that has {have}"
            )
    return tuple(get_reference(tree.model, "actuator", a) for a in chosen)


def _base_body(tree: KinematicTree, fields: dict[str, Any], joints: list[int], tip: int, where: str) -> str:
    """Return the given base, which must carry every joint and the tip, or the body of the first joint's root."""
    carried = [tree.joint_body[j] for j in joints] + [tip]
    common = [b for b in tree.list_ancestors(carried[0]) if all(b in tree.list_ancestors(c) for c in carried)]
    bodies = list_body_names(tree.model)
    given = fields.get("base_body", "")
    if not given and common:
        named = [b for b in common if is_wire_name(get_element_name(tree.model, "body", b))]
        return bodies[(named or common)[0]]
    if not given or find_element_id(tree.model, "body", given, where) not in common:
        listed = ", ".join(bodies[b] for b in common) or "none (they share no body)"
        raise RobotsFileError(
            f"{where}base_body {given!r} must carry all its joints and its end effector. Available bodies: {listed}."
        )
    return str(given)


def _take_gripper(tree: KinematicTree, fields: dict[str, Any], joints: list[int], where: str) -> None:
    """Replace the keys of the gripper, which may be lists, by the fields of `RobotSpec`."""
    names = fields.pop("gripper_actuator", ())
    ends = {key: fields.pop(f"gripper_{key}", None) for key in ("open", "closed")}
    if not names:
        if any(any(values or ()) for values in ends.values()) or fields.get("finger_bodies"):
            raise RobotsFileError(f"{where}gripper values or finger bodies without a gripper_actuator")
        return
    for key, values in ends.items():
        if values is not None and len(values) != len(names):
            raise RobotsFileError(f"{where}{len(names)} gripper actuators but {len(values)} values of gripper_{key}")
    opened, closed = (values or (0.0,) * len(names) for values in ends.values())
    actuators = [_find_actuator(tree, name, where) for name in names]
    members = [
        _check_gripper(tree, fields, actuator, one, where)
        for actuator, *one in zip(actuators, names, opened, closed, strict=True)
    ]
    if len(set(actuators)) < len(actuators):
        raise RobotsFileError(f"{where}a gripper_actuator is listed twice: {', '.join(names)}")
    missing = [] if fields.get("finger_bodies") else find_partners(tree, tree.joint_body[joints[-1]], actuators)
    if missing:
        both = [*actuators, *missing]
        listed = json.dumps([get_reference(tree.model, "actuator", a) for a in both], ensure_ascii=False)
        raise RobotsFileError(
            f"{where}gripper_actuator {names[0]!r} moves one of two fingers: gripper_actuator = {listed}, with lists "
            "of the same length as gripper_open and gripper_closed, moves both; or finger_bodies of the one alone"
        )
    first, bodies = members[0], list_body_names(tree.model)
    fingers = [find_element_id(tree.model, "body", body, where) for body in fields.get("finger_bodies", ())]
    fields |= {
        "finger_bodies": tuple(bodies[body] for body in fingers),
        "gripper_actuator": first.actuator,
        "gripper_open": first.open,
        "gripper_closed": first.closed,
        "gripper_partners": tuple(members[1:]),
    }


def _check_gripper(
    tree: KinematicTree, fields: dict[str, Any], actuator: int, given: Sequence[Any], where: str
) -> GripperActuator:
    name, opened, closed = given
    reference = get_reference(tree.model, "actuator", actuator)
    if reference in fields["actuators"]:
        raise RobotsFileError(f"{where}gripper_actuator {name!r} is also an actuator of the arm")
    if opened == closed:
        raise RobotsFileError(f"{where}gripper_open and gripper_closed are both {opened}; give two ctrl values")
    low, high = tree.model.actuator_ctrlrange[actuator].tolist()
    for value in (opened, closed):
        if int(tree.model.actuator_ctrllimited[actuator]) and not low <= value <= high:
            raise RobotsFileError(f"{where}gripper value {value} is outside the ctrlrange {low} to {high} of {name!r}")
    return GripperActuator(reference, opened, closed)
