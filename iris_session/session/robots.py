"""Robots that a session offers: those found in its model that control can drive, or those that its owner chooses."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import mujoco

from iris_session.control.config import OUTPUT_CTRL, ControlConfig, ControlError
from iris_session.control.controller import check_robot
from iris_session.physics import FoundRobots, PhysicsError, RobotNotice, World, find_robots, load_robots_toml
from iris_session.physics.limbs import MIN_JOINTS
from iris_session.physics.names import list_body_names, list_element_names
from iris_session.protocol.specs import RobotSpec
from iris_session.session.errors import ConfigError

#: Words instead of robots: those found in the model, and none.
AUTO: Final = "auto"
NONE: Final = "none"
#: What may be given as the robots of a session: specifications, names, a word, or the path of a robots file.
RobotChoice = Sequence[RobotSpec] | Sequence[str] | str | Path | None


class Chosen(NamedTuple):
    """A robot as it was chosen. `is_found_again`: another model has it under its name, with elements of its own."""

    spec: RobotSpec
    is_found_again: bool


#: A choice that can be repeated for another model: all robots found, or these.
FixedChoice = tuple[Chosen, ...] | None


def find_drivable_robots(model: mujoco.MjModel, control: ControlConfig, *, all_limbs: bool = False) -> FoundRobots:
    """Return the robots of a model that `control` drives. Raises nothing for a robot: it can then only be watched.

    Args:
        model: The model.
        control: Its output decides whether the actuators matter.
        all_limbs: Also legs, heads and fingers.
    """
    found = find_robots(model, all_limbs=all_limbs)
    robots, notices = [], {notice.spec.name: notice for notice in found.notices}
    for robot in found.robots:
        try:
            if not robot.actuators and control.output == OUTPUT_CTRL:
                raise ControlError("a mocap body moves it, not actuators: share it with drive='action'")  # noqa: TRY301
            check_robot(model, robot, control)
        except ControlError as error:
            notices[robot.name] = _make_watched(robot, str(error), notices.get(robot.name))
        else:
            robots.append(robot)
    return FoundRobots(tuple(robots), tuple(notices.values()), found.hidden)


def explain_no_robots(model: mujoco.MjModel) -> str:
    """Return one line that says why no robot was found in a model, and what a robot needs."""
    has = f"the model has {model.nu} actuators and {model.njnt} joints" if model.nu else "the model has no actuators"
    return (
        f"no robots found, so participants can only watch and take objects: a robot is an arm of at least "
        f"{MIN_JOINTS} actuated joints or a hand, no leg, and {has}"
    )


def choose_robots(model: mujoco.MjModel, choice: RobotChoice, control: ControlConfig) -> FoundRobots:
    """Return the robots that a session offers, and notices about those that can only be watched.

    Args:
        model: The model.
        choice: `None` or `auto` for those found; `none`; the path of a robots file, which exists or ends in `.toml`;
            names of robots found, legs and fingers included, as a sequence or separated by commas; or specifications.
        control: How they are driven.

    Raises:
        ConfigError: A name that the model does not have.
        PhysicsError: The robots file cannot be used.
    """
    if _is_auto(choice):
        return find_drivable_robots(model, control)
    given = _read_choice(model, choice)
    names = [one for one in given if isinstance(one, str)]
    specs = [one for one in given if isinstance(one, RobotSpec)]
    return _pick(model, names, control) if names else _split_watched(specs, control)


def fix_choice(model: mujoco.MjModel, choice: RobotChoice, control: ControlConfig) -> FixedChoice:
    """Return a choice for `model`, which `choose_robots` has accepted, as `choose_again` repeats it for others.

    Robots are found again that are chosen by name, and specifications with numbers as they are found in the model.
    """
    if _is_auto(choice):
        return None
    every = _read_choice(model, choice)
    given = [one for index, one in enumerate(every) if one not in every[:index]]
    if not given:
        return ()
    found = [robot for limbs in (False, True) for robot in find_robots(model, all_limbs=limbs).robots]
    known = {robot.name: robot for robot in reversed(found)}  # those that are offered first
    return tuple(
        Chosen(known[one], True) if isinstance(one, str) else Chosen(one, one in found and _has_numbers(model, one))
        for one in given
    )


def choose_again(model: mujoco.MjModel, choice: FixedChoice, control: ControlConfig) -> FoundRobots:
    """Return the robots of another model by the choice for the first one. Raises nothing for a robot.

    What was chosen and is not there is a notice; nothing else is offered in its place: a robot that is found again has
    the same joints, as far as they have names. A specification of one's own with a number of an element is not used:
    the number may mean another element here.
    """
    if choice is None:
        return find_drivable_robots(model, control)
    known, notices = _find_all(model, control)
    robots: list[RobotSpec] = []
    said: dict[str, RobotNotice] = {}
    for one in choice:
        spec, name = one.spec, one.spec.name
        if one.is_found_again:
            if name in notices:
                said[name] = notices[name]
            again = known.get(name)
            if again is None:
                missing = RobotSpec(name, (), (), "", "")
                said.setdefault(name, _make_watched(missing, "the new model has no such robot"))
                continue
            if _list_joint_names(again) != _list_joint_names(spec):
                listed = ", ".join(again.joints)
                said[name] = _make_watched(again, f"the new model has another robot of this name, with joints {listed}")
                continue
            spec = again
        why = _find_misfit(model, robots, spec, control, by_hand=not one.is_found_again)
        if why:
            said[name] = _make_watched(spec, why)
        else:
            robots.append(spec)
    found = _split_watched(robots, control)
    return FoundRobots(found.robots, (*said.values(), *found.notices))


def _list_joint_names(robot: RobotSpec) -> list[str]:
    """Return the names of the joints in order, empty for one that has a number only."""
    return ["" if joint.startswith("#") else joint for joint in robot.joints]


def _find_misfit(
    model: mujoco.MjModel, others: Sequence[RobotSpec], spec: RobotSpec, control: ControlConfig, *, by_hand: bool
) -> str:
    """Return why a robot cannot be used in another model, empty where it can."""
    if by_hand and _has_numbers(model, spec):
        return "it names elements by number, which may mean others in the new model: give them names"
    try:
        World(model, (*others, spec), ())
        check_robot(model, spec, control)
    except (ControlError, PhysicsError) as error:
        return str(error)
    return ""


def list_notices_again(model: mujoco.MjModel, robots: Sequence[RobotSpec], control: ControlConfig) -> tuple[str, ...]:
    """Return what is unclear about the robots of a session that goes on, a line each: of all robots found where they
    are those offered, else of the offered ones.
    """
    found = find_drivable_robots(model, control)
    if found.robots == tuple(robots):
        return found.texts
    names = {robot.name for robot in robots}
    return tuple(notice.text for notice in found.notices if notice.spec.name in names)


def _has_numbers(model: mujoco.MjModel, robot: RobotSpec) -> bool:
    """Return true for a robot with an element that has no name in the model."""
    references = (*robot.joints, *robot.actuators, robot.site, *(one.actuator for one in robot.gripper_actuators))
    bodies = {robot.base_body, robot.tip_body, *robot.finger_bodies}
    unnamed = set(list_body_names(model)) - set(list_element_names(model, "body"))
    return any(reference.startswith("#") for reference in references) or bool(bodies & unnamed)


def _is_auto(choice: RobotChoice) -> bool:
    return choice is None or choice == AUTO


def _read_choice(model: mujoco.MjModel, choice: RobotChoice) -> Sequence[RobotSpec | str]:
    """Return the names or specifications of a choice other than `auto`."""
    assert choice is not None
    if isinstance(choice, str) and choice == NONE:
        return ()
    if isinstance(choice, str) and not (choice.endswith(".toml") or os.path.isfile(os.path.expanduser(choice))):
        return [name.strip() for name in choice.split(",")]
    return load_robots_toml(Path(choice), model) if isinstance(choice, str | Path) else tuple(choice)


def _find_all(model: mujoco.MjModel, control: ControlConfig) -> tuple[dict[str, RobotSpec], dict[str, RobotNotice]]:
    """Return the robots and the notices of all limbs of a model by name, those that are offered first."""
    both = [find_drivable_robots(model, control, all_limbs=every) for every in (False, True)]
    robots = {robot.name: robot for found in both for robot in found.robots}
    return robots, {notice.spec.name: notice for found in both for notice in found.notices}


def _pick(model: mujoco.MjModel, names: Sequence[str], control: ControlConfig) -> FoundRobots:
    """Return the robots of these names."""
    known, notices = _find_all(model, control)
    for name in names:
        if name not in known:
            listed = ", ".join(known) or "none"
            missing = f" does not exist in the model. Available robots: {listed}"
            raise ConfigError(f"robots: {name!r}{f': {notices[name].text}' if name in notices else missing}")
    chosen = tuple(dict.fromkeys(names))
    return FoundRobots(
        tuple(known[name] for name in chosen), tuple(notices[name] for name in chosen if name in notices)
    )


def _split_watched(robots: Sequence[RobotSpec], control: ControlConfig) -> FoundRobots:
    """Leave out robots without actuators where control would have to write their `ctrl`."""
    watched = [robot for robot in robots if not robot.actuators and control.output == OUTPUT_CTRL]
    notices = tuple(_make_watched(robot, "it has no actuators") for robot in watched)
    return FoundRobots(tuple(robot for robot in robots if robot not in watched), notices)


def _make_watched(robot: RobotSpec, reason: str, earlier: RobotNotice | None = None) -> RobotNotice:
    """Return the notice of a robot that control cannot drive: in the lines of a robots file it has no actuators.

    `earlier`: what is unclear about it besides, which becomes part of the one notice.
    """
    spec = msgspec.structs.replace(robot, actuators=())
    reason = reason.removeprefix(f"robot {robot.name!r}: ")
    text, notes = f"robot {robot.name!r} can only be watched: {reason}", {"actuators": reason}
    if earlier is None:
        return RobotNotice(text, spec, notes)
    return RobotNotice(f"{text}; {earlier.text.partition(': ')[2]}", spec, {**earlier.notes, **notes})
