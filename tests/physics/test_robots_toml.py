"""The robots file: derived fields, and a one-line error that lists the valid values for every mistake."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import mujoco
import pytest

from iris_session.physics import PhysicsError, RobotsFileError, dump_robots_toml, find_robots, load_robots_toml
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import GripperActuator
from tests.physics.models import FINGERS, arm, scene


@pytest.mark.parametrize("name", ["aloha", "panda", "handover"])
def test_detected_robots_round_trip(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    m = request.getfixturevalue(name)
    robots = find_robots(m).robots
    text = dump_robots_toml(robots)
    assert load_robots_toml(text, m) == robots
    (tmp_path / "robots.toml").write_text(text)
    assert load_robots_toml(tmp_path / "robots.toml", m) == load_robots_toml(str(tmp_path / "robots.toml"), m) == robots


def test_three_keys_are_enough(panda: mujoco.MjModel) -> None:
    joints = ", ".join(f'"joint{i}"' for i in range(1, 8))
    text = f'[[robot]]\nname = "k"\njoints = [{joints}]\nsite = "attachment_site"\nhold = "gravity_pd"\n'
    (robot,) = load_robots_toml(text, panda)
    assert robot.actuators == tuple(f"actuator{i}" for i in range(1, 8))
    assert robot.base_body == "link1"
    assert robot.mode == "exclusive"
    assert robot.hold == "gravity_pd"
    assert load_robots_toml("\n", panda) == ()


GOOD = {
    "name": '"l"',
    "joints": '["left/joint1", "left/joint2", "left/joint3", "left/joint4", "left/joint5", "left/joint6"]',
    "site": '"left/tcp"',
}
GRIP = {"gripper_actuator": '"left/gripper"', "gripper_open": "0.04", "gripper_closed": "0"}
ACTS = '["left/joint1", "left/joint2", "left/joint3", "left/joint4", "left/joint5", "left/joint6"]'
MISTAKES = [
    ({"joints": '["left_j1"]'}, "joint 'left_j1' does not exist in the model. Available joints: left/joint1, left/"),
    ({"site": '"tip"'}, "site 'tip' does not exist in the model. Available sites: "),
    ({"joints": '"left/joint1"'}, "'joints' must be a list of names or numbers"),
    ({"gripper_open": '"wide"'}, "'gripper_open' must be a number"),
    ({"joint": "[]"}, "unknown key 'joint'. Available keys: name, joints, actuators"),
    ({"name": '"' + "x" * 65 + '"'}, "longer than 64 characters"),
    ({"joints": '["left/finger_joint_left"]'}, "needs one actuator, has none; actuators = [] is for"),
    ({"actuators": '["left/joint1"]'}, "6 joints but 1 actuators"),
    ({"actuators": ACTS.replace("left/joint3", "left/joint7")}, "actuator 'left/joint7' does not drive joint"),
    (
        {"base_body": '"table"'},
        "base_body 'table' must carry all its joints and its end effector. Available bodies:",
    ),
    ({"finger_bodies": '["left/finger_left"]'}, "gripper values or finger bodies without a gripper_actuator"),
    ({**GRIP, "gripper_open": "0"}, "gripper_open and gripper_closed are both 0.0"),
    ({**GRIP, "gripper_open": "4"}, "gripper value 4.0 is outside the ctrlrange 0.0 to 0.04 of 'left/gripper'"),
    ({**GRIP, "gripper_actuator": '"left/joint1"'}, "is also an actuator of the arm"),
    ({"mode": '"mine"'}, "mode 'mine' is none of exclusive, priority, request, shared, takeover"),
    ({"tip_body": '"table"'}, "site and tip_body both say where the end effector is"),
    ({"site": '""'}, "'site' is missing or empty; without a site, tip_body and tip_offset"),
    ({"site": '""', "tip_body": '"left/hnd"'}, "body 'left/hnd' does not exist in the model. Available bodies: "),
    ({"tip_offset": "[0, 1]"}, "'tip_offset' must be three numbers [m], not [0, 1]"),
    ({"tip_rotation": "[0, 0, 0, 0]"}, "'tip_rotation' must be a quaternion, w first"),
    ({"joints": "[0, 99]"}, "joint '#99' does not exist in the model"),
    ({**GRIP, "gripper_open": "[0.04, 0]"}, "1 gripper actuators but 2 values of gripper_open"),
    ({"kind": '"leg"'}, "kind 'leg' is none of arm, hand"),
    ({"on_release": '"fall"'}, "on_release 'fall' is none of hold, home"),
    ({"hold": '"magic"'}, "hold 'magic' is none of empty, gravity_pd"),
]


@pytest.mark.parametrize(("change", "text"), MISTAKES)
def test_mistakes_are_reported_with_valid_values(change: dict[str, str], text: str, handover: mujoco.MjModel) -> None:
    toml = "[[robot]]\n" + "".join(f"{k} = {v}\n" for k, v in {**GOOD, **change}.items())
    with pytest.raises(PhysicsError) as caught:
        load_robots_toml(toml, handover)
    assert text in str(caught.value)
    assert str(caught.value).startswith("robots, robot 1")
    assert "\n" not in str(caught.value)


def test_invalid_files_are_rejected(handover: mujoco.MjModel, tmp_path: Path) -> None:
    with pytest.raises(RobotsFileError, match=r"gone\.toml' cannot"):
        load_robots_toml(tmp_path / "gone.toml", handover)
    (tmp_path / "bad.toml").write_text("[[robot]\nname = 3")
    with pytest.raises(RobotsFileError, match=r"^bad\.toml: .*line 1"):
        load_robots_toml(tmp_path / "bad.toml", handover)
    for text, found in (("robot = 3", "robot"), ("[robots]\n", "robots"), ("[robot]\nname='x'", "robot")):
        with pytest.raises(RobotsFileError, match=rf"\[\[robot\]\] tables, found {found}$"):
            load_robots_toml(text, handover)


def test_free_joints_and_unusual_names() -> None:
    body, actuators = arm("é'", joints=3)
    m = scene(body + '<body name="b"><freejoint name="float"/><geom size=".1"/></body>', actuators)
    (robot,) = find_robots(m).robots
    assert load_robots_toml(dump_robots_toml([robot]), m) == (robot,)
    with pytest.raises(RobotsFileError, match="joint 'float' is"):
        load_robots_toml(dump_robots_toml([robot]).replace("joints = [", 'joints = ["float", '), m)


def test_end_effector_is_a_body_with_an_offset(panda: mujoco.MjModel) -> None:
    joints = ", ".join(f'"joint{i}"' for i in range(1, 8))
    text = f"""[[robot]]
name = "p"
joints = [{joints}]
tip_body = "link7"
tip_offset = [0, 0, 0.107]
tip_rotation = [2, 0, 0, 0]
"""
    (robot,) = load_robots_toml(text, panda)
    assert (robot.site, robot.tip_body) == ("", "link7")
    assert robot.T_body_tip == Pose((0.0, 0.0, 0.107), (1.0, 0.0, 0.0, 0.0))
    assert load_robots_toml(dump_robots_toml([robot]), panda) == (robot,)


def test_joints_and_actuators_are_given_by_number_or_joint() -> None:
    body, actuators = arm(end=FINGERS)
    m = scene(body, re.sub(r' name="a\d"', "", actuators) + '<position joint="finger_l" ctrlrange="0 .04"/>')
    fingers = 'gripper_actuator = "finger_l"\ngripper_open = 0.04\n'
    text = f'[[robot]]\nname = "r"\njoints = [0, 1, "j2", "#3"]\nsite = "pinch"\n{fingers}'
    (robot,) = load_robots_toml(text, m)
    assert robot.joints == ("j0", "j1", "j2", "j3")
    assert robot.actuators == ("#0", "#1", "#2", "#3")
    assert robot.gripper_actuator == "#4"
    assert load_robots_toml(text + 'actuators = [0, "j1", "#2", 3]\n', m) == (robot,)
    assert load_robots_toml(dump_robots_toml([robot]), m) == (robot,)


def test_robot_without_actuators(handover: mujoco.MjModel) -> None:
    text = "[[robot]]\n" + "".join(f"{k} = {v}\n" for k, v in GOOD.items()) + "actuators = []\n"
    (robot,) = load_robots_toml(text, handover)
    assert robot.actuators == ()
    assert load_robots_toml(dump_robots_toml([robot]), handover) == (robot,)


def test_a_robot_may_go_home_when_it_is_released(handover: mujoco.MjModel) -> None:
    robot, _ = find_robots(handover).robots
    assert robot.on_release == "hold"
    home = msgspec.structs.replace(robot, on_release="home")
    assert load_robots_toml(dump_robots_toml([home]), handover) == (home,)


def test_one_of_two_finger_actuators_is_refused_with_both() -> None:
    body, actuators = arm(end=FINGERS)
    both = (
        '<position name="l" joint="finger_l" ctrlrange="0 .04"/><position name="r" joint="finger_r" ctrlrange="0 .04"/>'
    )
    m = scene(body, actuators + both)
    text = '[[robot]]\nname = "r"\njoints = ["j0", "j1", "j2", "j3"]\nsite = "pinch"\n'
    with pytest.raises(RobotsFileError, match=r"moves one of two fingers: gripper_actuator = \[\"l\", \"r\"\]"):
        load_robots_toml(text + 'gripper_actuator = "l"\ngripper_open = 0.04\n', m)
    alone = 'gripper_actuator = "l"\ngripper_open = 0.04\nfinger_bodies = ["left_pad"]\n'
    assert [one.actuator for one in load_robots_toml(text + alone, m)[0].gripper_actuators] == ["l"]
    ends = "gripper_open = [0.04, 0.04]\ngripper_closed = [0, 0]\n"
    (robot,) = load_robots_toml(f'{text}gripper_actuator = ["l", "r"]\n{ends}', m)
    assert robot.gripper_actuators == (GripperActuator("l", 0.04, 0.0), GripperActuator("r", 0.04, 0.0))
    assert load_robots_toml(dump_robots_toml([robot]), m) == (robot,)


def test_a_camera_beside_a_jaw_is_no_second_finger() -> None:
    jaw = """<body name="jaw" pos="0 0 .1"><joint name="jaw" axis="1 0 0" range="0 1"/>
      <geom type="box" size=".01 .005 .03"/></body>"""
    camera = '<body name="cam" pos="0 .05 .1"><joint name="tilt" axis="1 0 0"/><geom size=".01"/></body>'
    body, actuators = arm(end=f'<site name="tcp"/>{jaw}{camera}')
    drives = '<position name="jaw" joint="jaw" ctrlrange="0 1"/><position name="tilt" joint="tilt" ctrlrange="-1 1"/>'
    text = '[[robot]]\nname = "r"\njoints = ["j0", "j1", "j2", "j3"]\nsite = "tcp"\ngripper_actuator = "jaw"\n'
    (robot,) = load_robots_toml(text + "gripper_open = 1\n", scene(body, actuators + drives))
    assert robot.gripper_actuators == (GripperActuator("jaw", 1.0, 0.0),)
