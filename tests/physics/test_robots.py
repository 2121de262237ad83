"""Robot detection in real models and in every shape of arm and gripper that decides a rule."""

from __future__ import annotations

import mujoco
import pytest

from iris_session.physics import AmbiguousModelError, World, find_objects, find_robots
from iris_session.physics.names import find_element_id, list_body_names, list_element_names
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from tests.physics.models import FINGERS, GRIPPER_TENDON, arm, model, scene

VIPERX = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")


def test_aloha_has_two_arms(aloha: mujoco.MjModel) -> None:
    assert find_robots(aloha) == tuple(
        RobotSpec(
            name=side,
            joints=tuple(f"{side}/{j}" for j in VIPERX),
            actuators=tuple(f"{side}/{j}" for j in VIPERX),
            site=f"{side}/gripper",
            base_body=f"{side}/base_link",
            gripper_actuator=f"{side}/gripper",
            gripper_open=0.037,
            gripper_closed=0.002,
            finger_bodies=(f"{side}/left_finger_link", f"{side}/right_finger_link"),
        )
        for side in ("left", "right")
    )


def test_scene_without_robots() -> None:
    assert find_robots(model("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")) == ()
    assert find_robots(scene(*arm("door", joints=2))) == ()


def test_gripper_on_a_tendon_where_larger_ctrl_closes() -> None:
    body, actuators = arm(joints=5, end=FINGERS)
    closing = '<general name="grip" tendon="split" gear="-1" ctrlrange="0 255"/>'
    (robot,) = find_robots(scene(body, actuators + closing, GRIPPER_TENDON, name="pandalike scene"))
    assert robot.name == "pandalike"
    assert robot.site == "pinch"
    assert (robot.gripper_actuator, robot.gripper_open, robot.gripper_closed) == ("grip", 0.0, 255.0)
    assert robot.finger_bodies == ("left_pad", "right_pad")


@pytest.mark.parametrize(("slope", "axis", "opened"), [(1, "0 -1 0", 0.04), (-1, "0 1 0", 0.04), (1, "0 1 0", None)])
def test_gripper_with_a_coupled_finger(slope: int, axis: str, opened: float | None) -> None:
    """One finger is driven, the other follows by an equality; parallel motion neither opens nor closes."""
    fingers = FINGERS.replace('axis="0 -1 0" range="0 .04"', f'axis="{axis}" range="{min(0, slope) * 0.04} .04"')
    body, actuators = arm("a", end=fingers)
    equality = f'<equality><joint joint1="a/finger_r" joint2="a/finger_l" polycoef="0 {slope} 0 0 0"/></equality>'
    grip = '<position name="a/grip" joint="a/finger_l" ctrlrange="0 .04"/>'
    if opened is None:
        with pytest.raises(AmbiguousModelError, match="gripper actuator 'a/grip'"):
            find_robots(scene(body, actuators + grip, equality.replace("0 1 0 0 0", "0 1 0 0 0")))
        return
    (robot,) = find_robots(scene(body, actuators + grip, equality))
    assert (robot.gripper_open, robot.gripper_closed) == (opened, 0.0)


def test_jaw_at_the_end_of_the_chain_belongs_to_the_gripper() -> None:
    jaw = """<site name="{p}grasp" pos="0 0 .1"/><body name="{p}moving" pos=".02 0 0">
      <joint name="{p}jaw" axis="0 1 0" range="0 1"/><geom type="box" size=".005 .01 .05" pos="0 0 .05"/></body>"""
    body, actuators = arm("so", joints=5, end=jaw)
    jaw_actuator = '<position name="so/jaw" joint="so/jaw" ctrlrange="0 1"/>'
    (robot,) = find_robots(scene(body, actuators + jaw_actuator))
    assert len(robot.joints) == 5
    assert (robot.gripper_actuator, robot.gripper_open, robot.gripper_closed) == ("so/jaw", 1.0, 0.0)
    assert robot.finger_bodies == ("so/moving",)


def test_torso_with_two_arms_and_two_separate_arms() -> None:
    left, right = arm("l"), arm("r", actuator="motor")
    torso = f"""<body name="torso"><joint name="yaw" axis="0 0 1"/><geom size=".1"/>{left[0]}{right[0]}</body>"""
    robots = find_robots(scene(torso, '<position name="yaw" joint="yaw"/>' + left[1] + right[1]))
    assert [(r.name, r.base_body, len(r.joints)) for r in robots] == [("l", "l/base", 4), ("r", "r/base", 4)]
    robots = find_robots(scene(left[0] + right[0], left[1] + right[1]))
    assert [r.name for r in robots] == ["l", "r"]


def test_mobile_base_is_part_of_its_arm_and_a_camera_is_not() -> None:
    body, actuators = arm("arm")
    camera = '<body name="cam"><joint name="pan" axis="0 0 1"/><geom size=".02"/></body>'
    cart = f"""<body name="cart"><joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
      <geom size=".1"/>{camera}{body}</body>"""
    drive = "".join(f'<velocity name="{j}" joint="{j}" kv="10"/>' for j in ("x", "y", "pan"))
    (robot,) = find_robots(scene(cart, drive + actuators))
    assert robot.joints == ("x", "y", "arm/j0", "arm/j1", "arm/j2", "arm/j3")
    assert robot.base_body == "cart"
    assert robot.name == "cart"


@pytest.mark.parametrize(
    ("kwargs", "extra", "text"),
    [
        ({"end": ""}, "", "last link 'a/link3'"),
        ({"end": '<site name="p1"/><site name="p2"/>'}, "", r"2 sites .* \(p1, p2\)"),
        ({"end": '<site name="l_tcp"/><site name="r_tcp"/><site name="x"/>'}, "", r"2 sites .* \(l_tcp, r_tcp\)"),
        ({}, '<velocity name="twice" joint="a/j1"/>', r"'a/j1' .*\(a/a1, twice\)"),
        ({"end": FINGERS}, "", ""),
        (
            {"end": FINGERS},
            '<position name="f1" joint="a/finger_l"/><position name="f2" joint="a/finger_r"/>',
            r"2 actuators .*\(f1, f2\)",
        ),
        ({"end": FINGERS}, '<motor name="f1" joint="a/finger_l"/>', "'f1' has no ctrlrange"),
        ({"end": FINGERS}, '<position joint="a/finger_l" ctrlrange="0 .04"/>', "actuator 4 needs"),
    ],
)
def test_ambiguous_models_are_refused_with_a_file_to_edit(kwargs: dict[str, str], extra: str, text: str) -> None:
    body, actuators = arm("a", **kwargs)  # type: ignore[arg-type]
    m = scene(body, actuators + extra)
    if not text:
        assert find_robots(m)[0].gripper_actuator == ""
        return
    with pytest.raises(AmbiguousModelError, match=text) as caught:
        find_robots(m)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("robot 'a': ")
    assert 'joints = ["a/j0", "a/j1", "a/j2", "a/j3"]' in caught.value.toml


@pytest.mark.parametrize("sign", [-1, 1])
def test_jaw_opens_away_from_the_fixed_jaw(sign: int) -> None:
    """Closed at 0, open at `sign` times a right angle, as on a Spot arm, whose jaw opens towards negative angles."""
    low, high = sorted((0.0, sign * 1.57))
    jaw = f"""<site name="{{p}}tcp" pos="0 0 .1"/><geom type="box" size=".005 .02 .05" pos="{-sign * 0.012} 0 .15"/>
      <body name="{{p}}jaw" pos="0 0 .1"><joint name="{{p}}jaw" axis="0 1 0" range="{low} {high}"/>
      <geom type="box" size=".005 .02 .05" pos="0 0 .05"/></body>"""
    body, actuators = arm("s", joints=6, end=jaw)
    (robot,) = find_robots(scene(body, actuators + f'<position name="s/j" joint="s/jaw" ctrlrange="{low} {high}"/>'))
    assert (robot.gripper_open, robot.gripper_closed) == (sign * 1.57, 0.0)


# --- objects are the named free bodies without actuators ---


def test_objects_of_real_scenes(handover: mujoco.MjModel, aloha: mujoco.MjModel, panda: mujoco.MjModel) -> None:
    assert find_objects(handover) == (ObjectSpec("hammer", "hammer"), ObjectSpec("board", "board"))
    assert find_objects(aloha) == find_objects(panda) == ()


def test_robots_fixed_and_unnamed_bodies_are_no_objects() -> None:
    body, actuators = arm("dog")
    free = body.replace('<body name="dog/base">', '<body name="dog/base"><freejoint/><geom size=".1"/>')
    ball = '<body name="ball"><joint type="free"/><geom size=".1"/></body>'
    scissors = (
        '<body name="scissors"><freejoint/><geom size=".1"/>'
        '<body name="blade"><joint axis="0 0 1"/><geom size=".1"/></body></body>'
    )
    rest = '<body><freejoint/><geom size=".1"/></body><body name="post"><geom size=".1"/></body>'
    long = f'<body name="{"n" * 65}"><freejoint/><geom size=".1"/></body>'
    m = scene(free + ball + scissors + rest + long, actuators)
    assert [o.name for o in find_objects(m)] == ["ball", "scissors"]
    flags = {b.name: b.object for b in World(m, (), find_objects(m)).bodies}
    assert [n for n, is_object in flags.items() if is_object] == ["ball", "scissors"]
    assert "n" * 64 in flags


def test_generated_body_names_are_unique_and_short() -> None:
    bodies = "".join(
        f"<body{name}><geom size='.1'/></body>"
        for name in ("", " name='body_1'", f" name='{'x' * 64}'", f" name='{'x' * 65}'", f" name='{'x' * 66}'", "")
    )
    m = model(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    names = list_body_names(m)
    assert names == ("world", "body_1~2", "body_1", "x" * 64, "x" * 62 + "~2", "x" * 62 + "~3", "body_6")
    assert list_element_names(m, "body")[1] == ""
    assert find_element_id(m, "body", "body_1") == 2
