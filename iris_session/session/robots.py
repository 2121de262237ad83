"""Robots that a session offers: those found in its model that control can drive, or those that its owner chooses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec
import mujoco

from iris_session.control.config import OUTPUT_CTRL, ControlConfig, ControlError
from iris_session.control.controller import check_robot
from iris_session.physics import FoundRobots, RobotNotice, find_robots, load_robots_toml
from iris_session.protocol.specs import RobotSpec
from iris_session.session.errors import ConfigError

#: Words instead of robots: those found in the model, and none.
AUTO: Final = "auto"
NONE: Final = "none"
#: What may be given as the robots of a session: specifications, names, a word, or the path of a robots file.
RobotChoice = Sequence[RobotSpec] | Sequence[str] | str | Path | None


def find_drivable_robots(model: mujoco.MjModel, control: ControlConfig, *, all_limbs: bool = False) -> FoundRobots:
    """Return the robots of a model that `control` drives. Raises nothing for a robot: it can then only be watched.

    Args:
        model: The model.
        control: Its output decides whether the actuators matter.
        all_limbs: Also legs, heads and fingers.
    """
    found = find_robots(model, all_limbs=all_limbs)
    robots, notices = [], list(found.notices)
    for robot in found.robots:
        try:
            check_robot(model, robot, control)
        except ControlError as error:
            notices.append(_make_watched(robot, str(error)))
        else:
            robots.append(robot)
    return FoundRobots(tuple(robots), tuple(notices))


def choose_robots(model: mujoco.MjModel, choice: RobotChoice, control: ControlConfig) -> FoundRobots:
    """Return the robots that a session offers, and notices about those that can only be watched.

    Args:
        model: The model.
        choice: `None` or `auto` for those found; `none`; the path of a robots file; names of robots found, legs and
            fingers included, as a sequence or separated by commas; or specifications.
        control: How they are driven.

    Raises:
        ConfigError: A name that the model does not have.
        PhysicsError: The robots file cannot be used.
    """
    if choice is None or choice == AUTO:
        return find_drivable_robots(model, control)
    if isinstance(choice, Path) or (isinstance(choice, str) and choice.endswith(".toml")):
        return _split_watched(load_robots_toml(Path(choice), model), control)
    if isinstance(choice, str):
        choice = [] if choice == NONE else [name.strip() for name in choice.split(",")]
    names = [one for one in choice if isinstance(one, str)]
    specs = [one for one in choice if isinstance(one, RobotSpec)]
    return _pick(model, names, control) if names else _split_watched(specs, control)


def _pick(model: mujoco.MjModel, names: Sequence[str], control: ControlConfig) -> FoundRobots:
    """Return the robots of these names."""
    offered, others = find_drivable_robots(model, control), find_drivable_robots(model, control, all_limbs=True)
    known = {robot.name: robot for robot in (*others.robots, *offered.robots)}
    for name in names:
        if name not in known:
            reasons = [notice.text for notice in (*offered.notices, *others.notices) if notice.spec.name == name]
            listed = ", ".join(known) or "none"
            why = f": {reasons[0]}" if reasons else f" does not exist in the model. Available robots: {listed}"
            raise ConfigError(f"robots: {name!r}{why}")
    return FoundRobots(tuple(known[name] for name in dict.fromkeys(names)))


def _split_watched(robots: Sequence[RobotSpec], control: ControlConfig) -> FoundRobots:
    """Leave out robots without actuators where control would have to write their `ctrl`."""
    watched = [robot for robot in robots if not robot.actuators and control.output == OUTPUT_CTRL]
    notices = tuple(_make_watched(robot, "it has no actuators") for robot in watched)
    return FoundRobots(tuple(robot for robot in robots if robot not in watched), notices)


def _make_watched(robot: RobotSpec, reason: str) -> RobotNotice:
    """Return the notice of a robot that control cannot drive: in the lines of a robots file it has no actuators."""
    spec = msgspec.structs.replace(robot, actuators=())
    return RobotNotice(f"robot {robot.name!r} can only be watched: {reason}", spec, {"actuators": reason})
