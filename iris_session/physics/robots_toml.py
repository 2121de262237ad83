"""The robots file: `RobotSpec`s as TOML, for models whose robots cannot be found, or need other names.

    [[robot]]
    name = "left"
    joints = ["left/joint1", "left/joint2", "left/joint3"]
    site = "left/tcp"

Only these three keys are needed; `actuators` and `base_body` are derived where the model leaves no choice. Every
mistake is one line that lists what would have been right.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import mujoco

from iris_session.physics.errors import RobotsFileError, one_line
from iris_session.physics.names import find_element_id, get_element_name, is_wire_name
from iris_session.physics.tree import KinematicTree
from iris_session.protocol.names import LeaseMode
from iris_session.protocol.specs import RobotSpec

_TEXTS: Final = ("name", "site", "base_body", "gripper_actuator", "mode", "hold")
_LISTS: Final = ("joints", "actuators", "finger_bodies")
_NUMBERS: Final = ("gripper_open", "gripper_closed")
_REQUIRED: Final = ("name", "joints", "site")
_ORDER: Final = tuple(RobotSpec.__struct_fields__)
_HOLDS: Final = ("", "gravity_pd")


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
    lines = ["# Robots of this model. Needed: name, joints, site. Gripper values are ctrl units."]
    for index, robot in enumerate(robots):
        comments = notes[index] if index < len(notes) else {}
        lines += ["", "[[robot]]"]
        for key in _ORDER:
            comment = f"  # {one_line(comments[key])}" if key in comments else ""
            lines.append(f"{key} = {_format_value(getattr(robot, key))}{comment}")
    return "\n".join(lines) + "\n"


def _format_value(value: str | float | tuple[str, ...]) -> str:
    """Return the TOML of a value: its strings and arrays of strings are those of JSON but for DEL,
    floats are `repr`.
    """
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value if isinstance(value, str) else list(value), ensure_ascii=False).replace("\x7f", "\\u007F")


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
    name = fields["name"]
    where = f"{where} ({name}): "
    joints = [find_element_id(tree.model, "joint", j, where) for j in fields["joints"]]
    _check_joints(tree, fields, joints, where)
    site = find_element_id(tree.model, "site", fields["site"], where)
    fields["actuators"] = _choose_actuators(tree, fields, joints, where)
    fields["base_body"] = _base_body(tree, fields, joints, site, where)
    _check_gripper(tree, fields, where)
    if fields.get("mode", LeaseMode.EXCLUSIVE) not in LeaseMode.ALL:
        raise RobotsFileError(f"{where}mode {fields['mode']!r} is none of {', '.join(sorted(LeaseMode.ALL))}")
    if fields.get("hold", "") not in _HOLDS:
        raise RobotsFileError(f"{where}hold {fields['hold']!r} must be empty or 'gravity_pd'")
    return RobotSpec(**fields)


def _check_types(table: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the table with known keys and right types only; lists become tuples."""
    unknown = sorted(set(table) - set(_ORDER))
    if unknown:
        raise RobotsFileError(f"{where}: unknown key {unknown[0]!r}. Available keys: {', '.join(_ORDER)}.")
    missing = [key for key in _REQUIRED if not table.get(key)]
    if missing:
        raise RobotsFileError(f"{where}: {missing[0]!r} is missing or empty")
    fields: dict[str, Any] = {}
    for key, value in table.items():
        if key in _TEXTS and isinstance(value, str):
            fields[key] = value
        elif key in _NUMBERS and isinstance(value, (int, float)) and not isinstance(value, bool):
            fields[key] = float(value)
        elif key in _LISTS and isinstance(value, list) and all(isinstance(v, str) for v in value):
            fields[key] = tuple(value)
        else:
            kind = "a string" if key in _TEXTS else "a number" if key in _NUMBERS else "a list of strings"
            raise RobotsFileError(f"{where}: {key!r} must be {kind}, not {value!r}")
    if not is_wire_name(fields["name"]):
        raise RobotsFileError(f"{where}: name {fields['name']!r} is longer than 64 characters")
    return fields


def _check_joints(tree: KinematicTree, fields: dict[str, Any], joints: list[int], where: str) -> None:
    for name, joint in zip(fields["joints"], joints, strict=True):
        if joint not in tree.list_scalar_joints(tree.joint_body[joint]):
            raise RobotsFileError(f"{where}joint {name!r} is a free or ball joint; a robot's are hinges and slides")
        if joints.count(joint) > 1:
            raise RobotsFileError(f"{where}joint {name!r} is listed twice")


def _choose_actuators(tree: KinematicTree, fields: dict[str, Any], joints: list[int], where: str) -> tuple[str, ...]:
    """Return one actuator per joint: as listed (each must drive its joint), or the only one that each joint has."""
    listed: tuple[str, ...] = fields.get("actuators", ())
    if listed and len(listed) != len(joints):
        raise RobotsFileError(f"{where}{len(joints)} joints but {len(listed)} actuators; one per joint, in order")
    chosen = []
    for index, joint in enumerate(joints):
        candidates = tree.actuators_of_joint[joint]
        names = [n for a in candidates if (n := get_element_name(tree.model, "actuator", a))]
        if not listed:
            if len(names) != 1:
                have = ", ".join(names) or "none"
                raise RobotsFileError(f"{where}joint {fields['joints'][index]!r} needs one named actuator, has {have}")
            chosen.append(names[0])
        elif find_element_id(tree.model, "actuator", listed[index], where) not in candidates:
            have = ", ".join(names) or "none"
            raise RobotsFileError(
                f"{where}actuator {listed[index]!r} does not drive joint {fields['joints'][index]!r}; that has {have}"
            )
    return listed or tuple(chosen)


def _base_body(tree: KinematicTree, fields: dict[str, Any], joints: list[int], site: int, where: str) -> str:
    """Return the given base, which must carry every joint and the site, or the body of the first joint's root."""
    carried = [tree.joint_body[j] for j in joints] + [int(tree.model.site_bodyid[site])]
    common = [b for b in tree.list_ancestors(carried[0]) if all(b in tree.list_ancestors(c) for c in carried)]
    named = [n for b in common if is_wire_name(n := get_element_name(tree.model, "body", b))]
    given = fields.get("base_body", "")
    if not given and named:
        return named[0]
    if not given or find_element_id(tree.model, "body", given, where) not in common:
        listed = ", ".join(named) or "none (they share no named body)"
        raise RobotsFileError(
            f"{where}base_body {given!r} must carry all its joints and its site. Available bodies: {listed}."
        )
    return str(given)


def _check_gripper(tree: KinematicTree, fields: dict[str, Any], where: str) -> None:
    name = fields.get("gripper_actuator", "")
    if not name:
        if fields.get("gripper_open", 0.0) or fields.get("gripper_closed", 0.0) or fields.get("finger_bodies"):
            raise RobotsFileError(f"{where}gripper values or finger bodies without a gripper_actuator")
        return
    actuator = find_element_id(tree.model, "actuator", name, where)
    if name in fields["actuators"]:
        raise RobotsFileError(f"{where}gripper_actuator {name!r} is also an actuator of the arm")
    opened, closed = fields.get("gripper_open", 0.0), fields.get("gripper_closed", 0.0)
    if opened == closed:
        raise RobotsFileError(f"{where}gripper_open and gripper_closed are both {opened}; give two ctrl values")
    low, high = tree.model.actuator_ctrlrange[actuator].tolist()
    for value in (opened, closed):
        if int(tree.model.actuator_ctrllimited[actuator]) and not low <= value <= high:
            raise RobotsFileError(f"{where}gripper value {value} is outside the ctrlrange {low} to {high} of {name!r}")
