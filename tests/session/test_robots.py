"""Robots of a session: what control can drive is offered, everything else is a notice."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest

from iris_session.control.config import ControlConfig
from iris_session.physics import RobotsFileError, load_model, load_robots_toml
from iris_session.session.config import SessionConfig
from iris_session.session.errors import ConfigError
from iris_session.session.robots import choose_robots, find_drivable_robots
from iris_session.session.session import Session
from tests.models import MENAGERIE
from tests.physics.models import arm, scene

#: An actuator that control has no law for.
MUSCLE = 'muscle lengthrange="-1 1"'
CTRL, TARGETS = ControlConfig(), ControlConfig(output="targets")


def two_arms(actuator: str = "position") -> mujoco.MjModel:
    """Return an arm that is clear, and one with these actuators."""
    left, right = arm("left"), arm("right", actuator=actuator)
    return scene(left[0] + right[0], left[1] + right[1])


def test_an_actuator_without_a_law_makes_a_robot_that_is_watched() -> None:
    model = two_arms(MUSCLE)
    found = find_drivable_robots(model, CTRL)
    assert [robot.name for robot in found.robots] == ["left"]
    (notice,) = found.notices
    assert notice.text.startswith("robot 'right' can only be watched: robot 'right': actuator 'right/a0' needs")
    assert [robot.name for robot in find_drivable_robots(model, TARGETS).robots] == ["left", "right"]
    left, right = load_robots_toml(found.to_toml(), model)
    assert (len(left.actuators), right.actuators) == (4, ())
    assert choose_robots(model, [left, right], CTRL).robots == (left,)
    assert choose_robots(model, [left, right], TARGETS).robots == (left, right)


def test_a_session_starts_with_what_is_clear_and_says_the_rest(caplog: pytest.LogCaptureFixture) -> None:
    session = Session(two_arms(MUSCLE), config=SessionConfig(record=False))
    assert [robot.name for robot in session.robots] == ["left"]
    assert [note for note in session.notes if "'right' can only be watched" in note]
    assert "'right' can only be watched" in caplog.text


def test_robots_are_chosen_by_a_word_names_or_a_file(tmp_path: Path) -> None:
    model = two_arms()
    left, right = choose_robots(model, "auto", CTRL).robots
    assert choose_robots(model, "none", CTRL).robots == ()
    assert choose_robots(model, (), CTRL).robots == ()
    assert choose_robots(model, "right", CTRL).robots == (right,)
    assert choose_robots(model, "right, left", CTRL).robots == (right, left)
    assert choose_robots(model, ("left",), CTRL).robots == (left,)
    file = tmp_path / "robots.toml"
    file.write_text('[[robot]]\nname = "r"\njoints = ["right/j0", "right/j1"]\ntip_body = "right/link1"\n')
    assert [r.name for r in choose_robots(model, str(file), CTRL).robots] == ["r"]
    assert choose_robots(model, file, CTRL) == choose_robots(model, str(file), CTRL)
    with pytest.raises(ConfigError, match=r"^robots: 'top' does not exist .* Available robots: left, right"):
        choose_robots(model, "top", CTRL)
    with pytest.raises(RobotsFileError, match="cannot be read"):
        choose_robots(model, "other.toml", CTRL)


def test_legs_are_offered_by_name_only() -> None:
    model = load_model(MENAGERIE / "unitree_go1" / "go1.xml")
    assert find_drivable_robots(model, CTRL).robots == ()
    assert [robot.name for robot in choose_robots(model, "FL_leg", CTRL).robots] == ["FL_leg"]
