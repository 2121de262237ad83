"""Robot detection in real models and in every shape of arm and gripper that decides a rule."""

from __future__ import annotations

import re

import mujoco
import pytest

from iris_session.physics import World, find_objects, load_model, load_robots_toml
from iris_session.physics import find_robots as detect
from iris_session.physics.fingers import find_fingers
from iris_session.physics.names import find_element_id, list_body_names, list_element_names
from iris_session.physics.tree import KinematicTree
from iris_session.protocol.specs import HAND, GripperActuator, ObjectSpec, RobotSpec
from tests.models import MENAGERIE
from tests.physics.models import FINGERS, GRIPPER_TENDON, arm, model, scene


def find_robots(m: mujoco.MjModel, **how: bool) -> tuple[RobotSpec, ...]:
    """Return the robots of a model in which everything is clear."""
    found = detect(m, **how)
    assert found.notices == ()
    return found.robots


#: Two fingers without an end-effector site, and an actuator for each.
TWO_FINGERS = FINGERS.replace('<site name="{p}pinch" pos="0 0 .15"/>', "")
BOTH = "".join(f'<position name="{s}" joint="finger_{s}" ctrlrange="0 .04"/>' for s in "lr")
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
        found = detect(scene(body, actuators + grip, equality))
        (notice,) = found.notices
        assert notice.text == (
            "robot 'a' is found without its gripper: gripper actuator 'a/grip' has an unknown open end"
        )
        assert [robot.gripper_actuator for robot in found.robots] == [""]
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
    ("kwargs", "extra", "text", "offered"),
    [
        (
            {},
            '<velocity name="twice" joint="a/j1"/>',
            "can only be watched: joint 'a/j1' has 2 actuators (a/a1, twice)",
            0,
        ),
        ({"end": FINGERS}, '<motor name="f1" joint="a/finger_l"/>', "gripper actuator 'f1' has no ctrlrange", 1),
        ({"end": FINGERS}, '<motor joint="a/finger_l"/>', "gripper actuator '#4' has no ctrlrange", 1),
    ],
)
def test_unclear_robots_are_notices_with_a_file_that_is_accepted(
    kwargs: dict[str, str], extra: str, text: str, offered: int
) -> None:
    body, actuators = arm("a", **kwargs)  # type: ignore[arg-type]
    m = scene(body, actuators + extra)
    found = detect(m)
    (notice,) = found.notices
    assert text in notice.text
    assert "\n" not in notice.text
    assert notice.text.startswith("robot 'a' ")
    assert len(found.robots) == offered
    (robot,) = load_robots_toml(notice.toml, m)
    assert load_robots_toml(found.to_toml(), m) == (robot,)
    assert robot.joints == ("a/j0", "a/j1", "a/j2", "a/j3")


def test_an_arm_with_several_actuators_per_joint_is_not_driven_by_its_file_as_printed() -> None:
    body, actuators = arm("a", joints=3, actuator="motor")
    more = "".join(f'<position name="p{i}" joint="a/j{i}"/>' for i in range(2))
    m = scene(body, actuators + more)
    (notice,) = detect(m).notices
    candidates = "a/j0: a/a0 or p0; a/j1: a/a1 or p1; a/j2: a/a2"
    assert f"actuators = []  # one per joint; candidates: {candidates}\n" in notice.toml
    (robot,) = load_robots_toml(detect(m).to_toml(), m)
    assert robot.actuators == ()


def test_half_a_gripper_is_not_offered() -> None:
    body, actuators = arm("a", end=FINGERS)
    left = '<position name="l" joint="a/finger_l" ctrlrange="0 .04"/><motor name="r" joint="a/finger_r"/>'
    m = scene(body, actuators + left)
    found = detect(m)
    (robot,) = found.robots
    assert (robot.gripper_actuators, robot.finger_bodies) == ((), ())
    assert "# gripper_actuator: gripper actuator 'r' has no ctrlrange; candidates: l, r;" in found.to_toml()
    assert load_robots_toml(found.to_toml(), m) == (robot,)


# --- the end effector ---


@pytest.mark.parametrize(
    ("end", "expected"),
    [
        ('<site name="imu"/><site name="{p}end"/>', "a/end"),
        ('<site name="wrist"/><site name="flange"/><site name="grasp"/>', "grasp"),
        ('<site name="p1"/><site name="p2"/>', ("a/link3", (0.0, 0.0, 0.12))),
        ('<site name="l_tcp"/><site name="r_tcp"/>', ("a/link3", (0.0, 0.0, 0.12))),
        ("", ("a/link3", (0.0, 0.0, 0.12))),
        ('<body name="right_hand" pos="0 0 .2"/>', ("right_hand", (0.0, 0.0, 0.0))),
        ('<body pos="0 0 .2"><geom size=".01"/></body>', ("a/link3", (0.0, 0.0, 0.21))),
    ],
)
def test_end_effector_is_a_site_or_the_end_of_the_last_link(end: str, expected: object) -> None:
    (robot,) = find_robots(scene(*arm("a", end=end)))
    if isinstance(expected, str):
        assert (robot.site, robot.tip_body) == (expected, "")
    else:
        assert robot.site == ""
        assert (robot.tip_body, robot.T_body_tip.p) == expected


def test_end_effector_is_the_middle_between_finger_tips() -> None:
    body, actuators = arm(end=TWO_FINGERS)
    (robot,) = find_robots(scene(body, actuators + BOTH))
    assert (robot.tip_body, robot.T_body_tip.p) == ("hand", (0.0, 0.0, 0.06))  # a centimetre before their ends


def test_sites_of_other_things_that_are_fixed_to_the_world_are_not_taken() -> None:
    """All of them have the weld id of a palm that is fixed to the world."""
    fingers, closing = hand("h_", 4)
    table = '<body name="table"><geom size=".1"/><site name="tool_rack"/></body>'
    palm = f'<body name="palm" pos="1 0 0"><geom type="box" size=".05 .02 .03"/>{fingers}</body>'
    m = scene(table + palm, closing)
    (robot,) = find_robots(m)
    assert (robot.site, robot.tip_body) == ("", "palm")
    assert load_robots_toml(detect(m).to_toml(), m) == (robot,)


# --- grippers of several actuators ---


def test_two_actuators_of_two_fingers_are_one_gripper() -> None:
    body, actuators = arm("a", end=FINGERS)
    left = '<position name="l" joint="a/finger_l" ctrlrange="0 .04"/>'
    right = '<position joint="a/finger_r" gear="-1" ctrlrange="-.04 0"/>'
    (robot,) = find_robots(scene(body, actuators + left + right))
    assert robot.gripper_actuators == (GripperActuator("l", 0.04, 0.0), GripperActuator("#5", -0.04, 0.0))


def hand(prefix: str, fingers: int = 3) -> tuple[str, str]:
    """Return bodies and actuators of the fingers of a hand: two curling joints each, and one that spreads."""
    bodies, actuators = "", ""
    for i in range(fingers):
        inner = f"""<body name="{prefix}d{i}" pos="0 0 .04"><joint name="{prefix}d{i}" axis="1 0 0" range="0 1.6"/>
          <geom type="box" size=".008 .008 .02" pos="0 0 .02"/></body>"""
        bodies += f"""<body name="{prefix}f{i}" pos="{0.03 * i} 0 .05">
          <joint name="{prefix}s{i}" axis="0 1 0" range="-.4 .4"/>
          <joint name="{prefix}k{i}" axis="1 0 0" range="0 1.6"/>
          <geom type="box" size=".008 .008 .02" pos="0 0 .02"/>{inner}</body>"""
        for joint, low, high in (("s", -0.4, 0.4), ("k", 0, 1.6), ("d", 0, 1.6)):
            actuators += f'<position name="{prefix}{joint}{i}" joint="{prefix}{joint}{i}" ctrlrange="{low} {high}"/>'
    return bodies, actuators


def test_fingers_of_a_hand_close_together_and_do_not_spread() -> None:
    fingers, closing = hand("h_")
    body, actuators = arm("a", joints=6, end=fingers)
    (robot,) = find_robots(scene(body, actuators + closing))
    assert robot.gripper_actuators == tuple(GripperActuator(f"h_{j}{i}", 0.0, 1.6) for i in range(3) for j in "kd")
    assert len(robot.joints) == 6


@pytest.mark.parametrize("wrist", ["", '<joint name="wrist" axis="0 0 1"/>'])
def test_hand_without_an_arm_is_one_robot(wrist: str) -> None:
    fingers, closing = hand("h_", 4)
    palm = f'<body name="palm">{wrist}<geom type="box" size=".05 .02 .03"/>{fingers}</body>'
    m = scene(palm, closing + ('<position name="wrist" joint="wrist"/>' if wrist else ""))
    (robot,) = find_robots(m)
    assert (robot.kind, robot.name, robot.tip_body) == (HAND, "h", "palm") if not wrist else ("hand", "hand", "palm")
    assert len(robot.joints) == 12 + bool(wrist)
    (info,) = World(m, [robot], []).robot_infos
    assert info.kind == HAND  # a page offers no handles for it
    fingers_only = find_robots(m, all_limbs=True)
    assert [r.name for r in fingers_only] == [f"h_finger{n}" for n in ("", "_2", "_3", "_4")]


def test_joints_of_a_hand_that_are_left_out_are_a_notice() -> None:
    fingers, closing = hand("h_")
    palm = f'<body name="palm"><geom type="box" size=".05 .02 .03"/>{fingers}</body>'
    m = scene(palm, closing + '<velocity name="twice" joint="h_k0"/>')
    found = detect(m)
    (robot,), (notice,) = found.robots, found.notices
    assert len(robot.joints) == 8
    assert notice.text == "robot 'h' is found without some joints: joint 'h_k0' has 2 actuators (h_k0, twice)"
    assert load_robots_toml(found.to_toml(), m) == (robot,)


# --- fingers, and what else is on the last link ---


CAMERA = """<body name="{name}" pos="0 .05 .1"><joint name="{name}_tilt" axis="1 0 0" range="-1 1"/>
  <geom type="box" size=".01 .01 .02" pos="0 .02 0"/></body>"""
CAMERA_DRIVE = '<position name="tilt" joint="{name}_tilt" ctrlrange="-1 1"/>'
JAW = """<geom type="box" size=".01 .005 .03" pos="0 .02 .12"/><body name="{name}" pos="0 0 .1">
  <joint name="{name}" axis="1 0 0" range="0 1"/><geom type="box" size=".01 .005 .03" pos="0 0 .03"/></body>"""


def plain(text: str) -> str:
    """Return two fingers whose names do not say that they are fingers."""
    return re.sub("finger_|left_pad|right_pad", lambda found: {"finger_": "f_"}.get(found[0], found[0][0] + "p"), text)


@pytest.mark.parametrize("words", [True, False])
@pytest.mark.parametrize("tendon", [True, False])
@pytest.mark.parametrize("name", ["camera", "thing"])
def test_what_tilts_beside_two_fingers_is_not_driven(words: bool, tendon: bool, name: str) -> None:
    grip = '<position name="g" tendon="split" ctrlrange="0 .04"/>' if tendon else BOTH
    texts = (TWO_FINGERS, grip, GRIPPER_TENDON if tendon else "")
    ends, drives, extra = texts if words else (plain(text) for text in texts)
    body, actuators = arm(end=ends + CAMERA.format(name=name))
    m = scene(body, actuators + drives + CAMERA_DRIVE.format(name=name), extra)
    found = detect(m)
    (robot,) = found.robots
    assert [one.actuator for one in robot.gripper_actuators] == (["g"] if tendon else ["l", "r"])
    assert {(one.open, one.closed) for one in robot.gripper_actuators} == {(0.04, 0.0)}
    assert (robot.tip_body, robot.T_body_tip.p) == ("hand", (0.0, 0.0, 0.06))
    assert len(robot.finger_bodies) == 2
    assert found.texts == (f"robot {robot.name!r} is found: actuators that move no finger are not driven: tilt",)
    assert load_robots_toml(found.to_toml(), m) == (robot,)


@pytest.mark.parametrize(
    ("jaw", "other", "members"),
    [("jaw", "camera", ["g"]), ("jaw", "thing", ["g"]), ("part", "camera", ["g"]), ("part", "thing", [])],
)
def test_a_jaw_beside_something_else_is_told_by_names(jaw: str, other: str, members: list[str]) -> None:
    body, actuators = arm(end=JAW.format(name=jaw) + CAMERA.format(name=other))
    drives = f'<position name="g" joint="{jaw}" ctrlrange="0 1"/>' + CAMERA_DRIVE.format(name=other)
    m = scene(body, actuators + drives)
    (robot,), (notice,) = (found := detect(m)).robots, found.notices
    assert [one.actuator for one in robot.gripper_actuators] == members
    assert "tilt" in notice.text
    assert load_robots_toml(notice.toml, m) == (robot,)
    if jaw == "jaw":
        (alone,) = find_robots(scene(arm(end=JAW.format(name=jaw))[0], actuators + drives.partition("/>")[0] + "/>"))
        assert (robot.gripper_actuators, robot.T_body_tip) == (alone.gripper_actuators, alone.T_body_tip)
    if not members:
        assert "is found without its gripper: gripper actuator 'g' moves one of several parts" in notice.text


def test_a_finger_joint_with_two_actuators_makes_the_gripper_unclear() -> None:
    more = "".join(f'<velocity name="v{s}" joint="finger_{s}" ctrlrange="-1 1"/>' for s in "lr")
    body, actuators = arm(end=TWO_FINGERS)
    (robot,), (notice,) = (found := detect(scene(body, actuators + BOTH + more))).robots, found.notices
    assert robot.gripper_actuators == ()
    assert "gripper actuator 'l' is one of 2 that drive joint 'finger_l'" in notice.text


def test_two_fingers_with_four_actuators_are_no_hand() -> None:
    """Closing by the rule of a hand, away from zero, would open their slides."""
    end = TWO_FINGERS
    for side in "lr":
        tip = f'<body pos="0 0 .04"><joint name="t{side}" axis="1 0 0" range="-.5 .5"/><geom size=".01"/></body>'
        end = end.replace('.02"/></body>', f'.02"/>{tip}</body>', 1)
    body, actuators = arm(end=end)
    more = "".join(f'<position name="t{s}" joint="t{s}" ctrlrange="-.5 .5"/>' for s in "lr")
    (robot,), (notice,) = (found := detect(scene(body, actuators + BOTH + more))).robots, found.notices
    assert robot.gripper_actuators == ()
    assert "gripper actuator 'l' is one of 4 that move 2 fingers" in notice.text


def test_what_nothing_drives_does_not_move_the_end_effector() -> None:
    cable = '<body name="cable"><joint name="c" axis="1 0 0"/><geom size=".004" fromto=".05 0 0 .05 0 -.3" '
    cable += 'type="capsule"/></body>'
    (without,), (robot,) = (find_robots(scene(*arm(end=end))) for end in ("", cable))
    assert robot == without
    (without,), (robot,) = (
        find_robots(scene((found := arm(end=TWO_FINGERS + end))[0], found[1] + BOTH)) for end in ("", cable)
    )
    assert robot == without


def test_a_finger_of_a_closed_linkage_is_one_finger() -> None:
    """Only its crank is driven; the rod is joined to it, and carries the pad."""
    part = """<body name="{n}" pos="0 {y} .1"><joint name="{n}" axis="1 0 0" range="0 .8"/>
      <geom type="box" size=".01 .01 .02" pos="0 0 .02"/></body>"""
    parts = {"cl": 0.02, "rl": 0.04, "cr": -0.02, "rr": -0.04}
    body, actuators = arm(end="".join(part.format(n=n, y=y) for n, y in parts.items()))
    loops = "".join(f'<connect body1="c{s}" body2="r{s}" anchor="0 0 .04"/>' for s in "lr")
    crank = '<position name="{n}" joint="{n}" ctrlrange="0 .8"/>'
    m = scene(body, actuators + crank.format(n="cl") + crank.format(n="cr"), f"<equality>{loops}</equality>")
    fingers = find_fingers(KinematicTree(m), find_element_id(m, "body", "link3"))
    assert (len(fingers.roots), fingers.number, fingers.is_clear) == (4, 2, True)


def test_a_hand_on_an_arm_closes_as_before() -> None:
    """All its fingers take part, the thumb too, which is not like the others."""
    panda = mujoco.MjSpec.from_file(str(MENAGERIE / "franka_emika_panda" / "panda_nohand.xml"))
    leap = mujoco.MjSpec.from_file(str(MENAGERIE / "leap_hand" / "right_hand.xml"))
    leap.option.impratio, leap.option.cone = panda.option.impratio, panda.option.cone
    panda.attach(leap, prefix="leap/", site=next(s for s in panda.sites if s.name == "attachment_site"))
    (robot,) = find_robots(panda.compile())
    assert len(robot.gripper_actuators) == 12
    assert all(one.open == 0.0 and one.closed > 1.8 for one in robot.gripper_actuators)
    assert {one.actuator[:7] for one in robot.gripper_actuators} == {"leap/if", "leap/mf", "leap/rf", "leap/th"}


# --- real models ---


@pytest.mark.parametrize(
    ("file", "expected"),
    [
        ("franka_emika_panda/panda.xml", [("panda", 7, "hand", ["actuator8"])]),
        ("franka_emika_panda/mjx_panda_nohand.xml", [("panda", 7, "link7", [])]),
        ("boston_dynamics_spot/spot_arm.xml", [("arm", 6, "arm_link_wr1", ["arm_f1x"])]),
        ("boston_dynamics_spot/spot.xml", []),
        ("unitree_go1/scene.xml", []),
        ("google_barkour_vb/scene.xml", []),
        ("leap_hand/scene_right.xml", [("right", 16, "palm", [])]),
        ("robotiq_2f85_v4/2f85.xml", []),
        ("tetheria_aero_hand_open/right_hand.xml", []),
    ],
)
def test_robots_of_menagerie(file: str, expected: list[object]) -> None:
    m = load_model(MENAGERIE / file)
    found = [
        (r.name, len(r.joints), r.tip_body or r.site, [g.actuator for g in r.gripper_actuators]) for r in find_robots(m)
    ]
    assert found == expected
    for all_limbs in (False, True):
        robots = detect(m, all_limbs=all_limbs)
        assert load_robots_toml(robots.to_toml(), m) == robots.robots
        World(m, robots.robots, ())


def test_grip_point_of_the_panda() -> None:
    """Its manufacturer puts the tool point 103.4 mm before the flange of the hand."""
    (robot,) = find_robots(load_model(MENAGERIE / "franka_emika_panda" / "panda.xml"))
    assert robot.T_body_tip.p == pytest.approx((0.0, 0.0, 0.1034), abs=0.005)


# --- legs, heads, bases ---


def leg(name: str, pos: str, words: bool) -> tuple[str, str]:
    """Return a leg that stands at `pos`; `words`: its joints are named like those of a leg."""
    joints = ("hip", "thigh", "knee") if words else ("a", "b", "c")
    body = '<geom size=".02" pos="0 0 -.2"/>'
    for joint in reversed(joints):
        body = f"""<body name="{name}_{joint}" pos="0 0 -.15"><joint name="{name}_{joint}" axis="0 1 0"/>
          <geom size=".02"/>{body}</body>"""
    return f'<body pos="{pos}">{body}</body>', "".join(
        f'<position name="{name}_{joint}" joint="{name}_{joint}"/>' for joint in joints
    )


@pytest.mark.parametrize("words", [True, False])
def test_legs_of_a_humanoid_are_not_offered(words: bool) -> None:
    left, right = arm("left", joints=5), arm("right", joints=5)
    legs = [leg("LL", "0 .1 0", words), leg("LR", "0 -.1 0", words)]
    head = '<body name="neck"><joint name="neck" axis="0 0 1"/><geom size=".05"/></body>'
    upper = f'<body name="chest"><joint name="waist" axis="0 0 1"/><geom size=".1"/>{left[0]}{right[0]}{head}</body>'
    pelvis = f'<body name="pelvis" pos="0 0 1"><freejoint/><geom size=".1"/>{upper}{legs[0][0]}{legs[1][0]}</body>'
    drives = '<position name="waist" joint="waist"/><position name="neck" joint="neck"/>'
    m = scene(pelvis, drives + left[1] + right[1] + legs[0][1] + legs[1][1])
    assert [(r.name, r.base_body) for r in find_robots(m)] == [("left", "left/base"), ("right", "right/base")]
    assert [r.name for r in find_robots(m, all_limbs=True)] == ["left", "right", "LL_leg", "LR_leg"]


def test_arm_on_a_quadruped_is_offered_and_its_base_carries_no_leg() -> None:
    body, actuators = arm("arm", joints=6)
    legs = [leg(name, pos, True) for name, pos in (("FL", ".2 .1 0"), ("FR", ".2 -.1 0"), ("RL", "-.2 .1 0"))]
    trunk = f'<body name="trunk" pos="0 0 .6"><freejoint/><geom size=".1"/>{"".join(b for b, _ in legs)}{body}</body>'
    (robot,) = find_robots(scene(trunk, actuators + "".join(a for _, a in legs)))
    assert (robot.name, robot.base_body, len(robot.joints)) == ("arm", "arm/base", 6)


@pytest.mark.parametrize(("body", "name"), [("link4", "tool_head"), ("link4", "eye_in_hand"), ("link0", "toe_robot")])
def test_one_body_named_like_a_leg_or_head_hides_no_arm(body: str, name: str) -> None:
    bodies, actuators = arm(joints=5)
    (robot,) = find_robots(scene(bodies.replace(f'"{body}"', f'"{name}"'), actuators))
    assert len(robot.joints) == 5


def test_limbs_that_are_named_like_legs_on_a_fixed_base_are_not_offered_and_said() -> None:
    legs = [leg(name, pos, True) for name, pos in (("L", "0 .1 0"), ("R", "0 -.1 0"))]
    m = scene(f'<body pos="0 0 1">{legs[0][0]}{legs[1][0]}</body>', legs[0][1] + legs[1][1])
    found = detect(m)
    assert (found.robots, found.notices) == ((), ())
    assert found.texts == ("2 limbs named as legs or heads are not offered: L_leg, R_leg",)
    assert detect(m, all_limbs=True).texts == ()


def test_a_head_has_few_joints() -> None:
    assert find_robots(scene(*arm(joints=3, joint_name="neck{i}"))) == ()
    (robot,) = find_robots(scene(*arm(joints=5, joint_name="neck{i}")))
    assert len(robot.joints) == 5


def test_chains_of_any_length_are_found() -> None:
    """600 hinges in series, too many for Python's stack; the last three are driven; beside it a rope."""
    spec = mujoco.MjSpec()
    for driven in (True, False):
        body = spec.worldbody
        for i in range(600):
            body = body.add_body(pos=[0, 0, 0.02])
            joint = body.add_joint(name=f"{driven}_{i}")
            body.add_geom(size=[0.005, 0, 0], mass=0.01)
            if driven and i >= 597:
                actuator = spec.add_actuator(target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
                actuator.set_to_position(kp=1.0)
    (robot,) = find_robots(spec.compile())
    assert robot.joints == ("True_597", "True_598", "True_599")


def test_a_base_on_wheels_is_no_robot() -> None:
    joints = "".join(f'<joint name="{j}" type="slide" axis="{a}"/>' for j, a in (("x", "1 0 0"), ("y", "0 1 0")))
    lift = '<body name="lift"><joint name="z" type="slide" axis="0 0 1"/><geom size=".1"/></body>'
    base = f'<body name="base">{joints}<joint name="yaw" axis="0 0 1"/><geom size=".2"/>{lift}</body>'
    drives = "".join(f'<velocity name="{j}" joint="{j}"/>' for j in ("x", "y", "yaw", "z"))
    assert find_robots(scene(base, drives)) == ()


# --- actuators ---


def test_torque_actuators_get_a_hold() -> None:
    (robot,) = find_robots(scene(*arm("a", actuator="motor")))
    assert robot.hold == "gravity_pd"


def test_unnamed_actuators_and_joints_are_called_by_their_numbers() -> None:
    body, actuators = arm("a")
    anonymous = re.sub(r' name="a/a\d"', "", actuators)
    m = scene(body, anonymous)
    (robot,) = find_robots(m)
    assert robot.actuators == ("#0", "#1", "#2", "#3")
    World(m, (robot,), ())


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
