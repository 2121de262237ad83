"""Robots of a session: what control can drive is offered, everything else is a notice."""

from __future__ import annotations

from pathlib import Path

import msgspec
import mujoco
import pytest

from iris_session.client import DeniedError
from iris_session.control.config import ControlConfig
from iris_session.demo.scenes import scene_path
from iris_session.physics import RobotsFileError, load_model, load_robots_toml
from iris_session.session.config import SessionConfig
from iris_session.session.errors import ConfigError
from iris_session.session.robots import (
    RobotChoice,
    choose_again,
    choose_robots,
    find_drivable_robots,
    fix_choice,
    list_notices_again,
)
from iris_session.session.session import Session
from tests.models import MENAGERIE
from tests.physics.models import FINGERS, GRIPPER_TENDON, arm, scene
from tests.rig.session import Rig

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
    assert notice.text.startswith("robot 'right' can only be watched: actuator 'right/a0' needs")
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
    other_suffix = file.rename(tmp_path / "robots.txt")
    assert [r.name for r in choose_robots(model, str(other_suffix), CTRL).robots] == ["r"]
    with pytest.raises(ConfigError, match=r"^robots: 'top' does not exist .* Available robots: left, right"):
        choose_robots(model, "top", CTRL)
    with pytest.raises(RobotsFileError, match="cannot be read"):
        choose_robots(model, "other.toml", CTRL)


def test_legs_are_offered_by_name_only() -> None:
    model = load_model(MENAGERIE / "unitree_go1" / "go1.xml")
    assert find_drivable_robots(model, CTRL).robots == ()
    assert [robot.name for robot in choose_robots(model, "FL_leg", CTRL).robots] == ["FL_leg"]


def test_a_name_means_one_robot_whether_or_not_all_limbs_are_listed() -> None:
    neck, neck_drives = arm("r", joints=3, joint_name="{p}neck{i}")
    left, drives = arm("r", joints=5, joint_name="{p}elbow{i}")
    neck, neck_drives = neck.replace('body name="r/', 'body name="n/'), neck_drives.replace('name="r/a', 'name="n/a')
    model = scene(
        f'<body name="torso">{neck}{left.replace("r/tcp", "tcp")}</body>'.replace("r/tcp", "n/tcp"),
        neck_drives + drives,
    )
    listed = find_drivable_robots(model, CTRL, all_limbs=True).robots
    assert [(robot.name, robot.joints[0]) for robot in listed] == [("r_2", "r/neck0"), ("r", "r/elbow0")]
    for robot in listed:
        assert choose_robots(model, robot.name, CTRL).robots == (robot,)
    found = find_drivable_robots(model, CTRL)
    assert found.robots == listed[1:]
    assert found.texts == ("1 limb named as a leg or head is not offered: r_2",)


def test_one_notice_says_everything_about_a_robot() -> None:
    """Its actuators have no law, and its gripper is unclear."""
    body, actuators = arm("a", end=FINGERS, actuator=MUSCLE)
    model = scene(body, actuators + '<motor name="f1" joint="a/finger_l"/>')
    (notice,) = find_drivable_robots(model, CTRL).notices
    assert notice.text.startswith("robot 'a' can only be watched: ")
    assert notice.text.endswith("; gripper actuator 'f1' has no ctrlrange")
    assert set(notice.notes) == {"actuators", "gripper_actuator"}
    (robot,) = load_robots_toml(notice.toml, model)
    assert (robot.actuators, robot.gripper_actuator) == ((), "")


def test_notices_of_robots_that_are_chosen_by_name_or_resumed_are_kept() -> None:
    body, actuators = arm("a", end=FINGERS)
    other, others = arm("b")
    model = scene(body + other, actuators + others + '<motor name="f1" joint="a/finger_l"/>')
    found = choose_robots(model, "a", CTRL)
    (text,) = found.texts
    assert text == "robot 'a' is found without its gripper: gripper actuator 'f1' has no ctrlrange"
    assert choose_robots(model, "b", CTRL).texts == ()
    assert list_notices_again(model, found.robots, CTRL) == (text,)
    assert list_notices_again(model, find_drivable_robots(model, CTRL).robots, CTRL) == (text,)
    assert list_notices_again(model, (), CTRL) == ()


# --- another model ---


def gripper_on_a_tendon(conveyor: bool) -> mujoco.MjModel:
    """Return an arm whose gripper actuator has no name; its number is 4, or that of the actuator of a conveyor."""
    body, actuators = arm(end=FINGERS)
    belt = '<body name="belt"><joint name="belt" type="slide"/><geom size=".1"/></body>'
    drive = '<position name="belt" joint="belt" ctrlrange="0 1"/>' if conveyor else ""
    return scene(belt + body, f'{actuators}{drive}<position tendon="split" ctrlrange="0 .04"/>', GRIPPER_TENDON)


def test_a_number_is_not_carried_over_to_another_model() -> None:
    first, second = gripper_on_a_tendon(False), gripper_on_a_tendon(True)
    (found,) = find_drivable_robots(first, CTRL).robots
    assert found.gripper_actuator == "#4"
    for choice in (None, found.name, [found]):
        (robot,) = choose_again(second, fix_choice(first, choice, CTRL), CTRL).robots
        assert (robot.name, robot.gripper_actuator) == (found.name, "#5")
    by_hand = msgspec.structs.replace(found, mode="request")
    again = choose_again(second, fix_choice(first, [by_hand], CTRL), CTRL)
    assert again.robots == ()
    (text,) = again.texts
    assert "can only be watched: it names elements by number" in text


def test_a_choice_holds_for_another_model(tmp_path: Path) -> None:
    both, (body, actuators) = two_arms(), arm("right")
    other = scene(body, actuators)  # without the left arm
    for choice in ("none", ()):
        assert choose_again(other, fix_choice(both, choice, CTRL), CTRL) == ((), (), ())
    (robot,) = choose_again(other, fix_choice(both, "right", CTRL), CTRL).robots
    assert robot == choose_robots(both, "right", CTRL).robots[0]
    found = choose_again(other, fix_choice(both, "right,left,right", CTRL), CTRL)
    assert found.robots == (robot,)
    assert found.texts == ("robot 'left' can only be watched: the new model has no such robot",)
    file = tmp_path / "robots.toml"
    file.write_text(
        "".join(
            f'[[robot]]\nname = "{name}"\njoints = ["{side}/j0", "{side}/j1"]\ntip_body = "{side}/link1"\n'
            for name, side in (("l", "left"), ("r", "right"))
        )
    )
    kept = fix_choice(both, file, CTRL)
    assert [r.name for r in choose_again(both, kept, CTRL).robots] == ["l", "r"]
    found = choose_again(other, kept, CTRL)
    assert [r.name for r in found.robots] == ["r"]
    assert "robot 'l' can only be watched: " in found.texts[0]


def unnamed_arm(*arms: str, last: str = "") -> mujoco.MjModel:
    """Return arms of which the joints are the only names that tell them apart: robots of the same generated name."""
    drives, bodies = "", ""
    for index, one in enumerate(arms):
        body, actuators = arm(joint_name=f"{one}{{i}}", end="")
        for i in range(4):
            body = body.replace(f'"link{i}"', f'"{one}link{i}"')
            actuators = actuators.replace(f'name="a{i}"', f'name="{one}a{i}"')
        bodies += body.replace('"base"', '"base"' if not index else '"pedestal"')
        drives += actuators if not last else actuators.replace(f'name="{one}a3"', "")
    return scene(bodies, drives)


@pytest.mark.parametrize("by", ["spec", "file", "name"])
def test_a_robot_is_never_another_one_of_the_same_name(by: str, tmp_path: Path) -> None:
    """The name of both is generated: the first of the model has it."""
    first, both, other = unnamed_arm("x"), unnamed_arm("y", "x"), unnamed_arm("y")
    (spec,) = choose_robots(first, "auto", CTRL).robots
    file = tmp_path / "robots.toml"
    file.write_text(find_drivable_robots(first, CTRL).to_toml())
    choices: dict[str, RobotChoice] = {"spec": [spec], "file": file, "name": spec.name}
    fixed = fix_choice(first, choices[by], CTRL)
    for model in (both, other):
        assert spec.name in [robot.name for robot in choose_robots(model, "auto", CTRL).robots]
        found = choose_again(model, fixed, CTRL)
        if by == "name" or model is other:
            assert found.robots == ()
            (text,) = found.texts
            assert text.startswith(f"robot {spec.name!r} can only be watched: ")
        else:
            # Its base may carry another name; its joints and actuators are what was chosen.
            assert [(r.joints, r.actuators) for r in found.robots] == [(spec.joints, spec.actuators)]
            assert found.texts == ()
    (again,) = choose_again(first, fixed, CTRL).robots
    assert again == spec


def test_a_robot_with_a_number_is_found_again_with_the_same_joints_only() -> None:
    first, second = unnamed_arm("x", last="#"), unnamed_arm("y", last="#")
    (spec,) = choose_robots(first, "auto", CTRL).robots
    assert spec.actuators[3] == "#3"
    fixed = fix_choice(first, [spec], CTRL)
    assert choose_again(first, fixed, CTRL).robots == (spec,)
    found = choose_again(second, fixed, CTRL)
    assert found.robots == ()
    assert "the new model has another robot of this name, with joints y0, y1, y2, y3" in found.texts[0]


def test_an_arm_that_a_mocap_body_pulls_is_driven_by_actions_only() -> None:
    """As those of Fetch and Meta-World: a base on slides, joints without actuators, a hand welded to a mocap body."""
    links = "".join(
        f'<body name="link{i}" pos="0 0 .2"><joint name="arm_j{i}" axis="{i % 2} {1 - i % 2} 0"/><geom size=".04"/>'
        for i in range(5)
    )
    finger = '<body pos="0 {0} .1"><joint name="f{1}" type="slide" axis="0 1 0"/><geom size=".01"/></body>'
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="mocap" mocap="true"/><body name="base"><joint type="slide"/><geom size=".1"/>'
        f"{links}{finger.format(0.03, 'l')}{finger.format(-0.03, 'r')}{'</body>' * 6}</worldbody>"
        '<equality><weld body1="mocap" body2="link4"/></equality><actuator>'
        '<position joint="fl" kp="9" ctrlrange="0 .05"/><position joint="fr" kp="9" ctrlrange="-.05 0"/></actuator>'
        "</mujoco>"
    )
    (robot,) = find_drivable_robots(model, ControlConfig(output="targets")).robots
    assert robot.joints == tuple(f"arm_j{i}" for i in range(5))
    assert robot.actuators == ()
    assert [one.actuator for one in robot.gripper_actuators] == ["#0", "#1"]
    found = find_drivable_robots(model, ControlConfig())
    assert found.robots == ()
    assert "drive='action'" in found.texts[0]


def test_a_denial_says_why_a_robot_can_only_be_watched() -> None:
    spec = mujoco.MjSpec.from_file(str(scene_path("handover")))
    for actuator in spec.actuators:
        if actuator.name.startswith("right/"):
            actuator.biastype = mujoco.mjtBias.mjBIAS_USER
    with Rig(spec) as rig:
        (notice,) = rig.session._robot_notices
        ann = rig.join("ann")
        for name, is_said in (("right", True), ("none", False)):
            with pytest.raises(DeniedError) as caught:
                ann.acquire([name])
            assert (caught.value.denial.message == notice) == is_said
            assert caught.value.denial.target == name
