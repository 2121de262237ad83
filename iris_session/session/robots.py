"""Robots that a session offers: those found in its model that control can drive, and notices about all others."""

from __future__ import annotations

import mujoco

from iris_session.control.config import ControlConfig, ControlError
from iris_session.control.controller import check_robot
from iris_session.physics import FoundRobots, RobotNotice, dump_robots_toml, find_robots


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
            text = f"robot {robot.name!r} can only be watched: {error}"
            notices.append(RobotNotice(robot.name, text, dump_robots_toml([robot])))
        else:
            robots.append(robot)
    return FoundRobots(tuple(robots), tuple(notices))
