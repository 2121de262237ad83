"""Planned handovers: people hand a box over between arms that they have never seen, or one line says why not."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import mujoco
import pytest

from iris_session.cli.main import main
from iris_session.demo.demos import make_planned_handover
from iris_session.demo.handover_plan import plan_handover
from iris_session.demo.named_scenes import NamedScene
from iris_session.emulator.behaviours.plan import HandoverPlan
from iris_session.physics.robots import find_objects, find_robots
from iris_session.session.errors import ConfigError
from tools.handover_rig import Rig
from tools.handover_scenes import make_rig, make_scene

pytestmark = pytest.mark.usefixtures("untraced")


def plan(spec: mujoco.MjSpec, thing: str = "cube", giver: str = "", receiver: str = "") -> HandoverPlan:
    model = spec.compile()
    return plan_handover(model, find_robots(model).robots, find_objects(model), thing, giver, receiver)


def hand_over(seed: int) -> str:
    """Return an empty text when the handover in a generated scene succeeds."""
    rig = make_rig(make_scene(seed).compile(), seed)
    rig.run(60.0, until=Rig.over)
    return rig.verdict()


def test_box_is_handed_over_between_arms_that_no_one_has_seen() -> None:
    assert hand_over(6) == ""


@pytest.mark.long
def test_most_handovers_in_generated_scenes_succeed() -> None:
    verdicts = []
    for seed in range(10):
        try:
            verdicts.append(hand_over(seed))
        except ConfigError as error:
            verdicts.append(str(error))
    assert verdicts.count("") >= 8, verdicts


def test_plan_is_the_same_again_and_fits_into_a_demo() -> None:
    spec = make_scene(6)
    first = plan(spec)
    assert plan(spec) == first
    assert {first.giver.robot, first.receiver.robot} == {"left", "right"}
    play = make_planned_handover(NamedScene(spec.compile()), episodes=3)
    assert [person.plan for person in play.headsets] == [first, first]
    assert play.task is not None
    assert (play.task.wanted, play.task.robots) == (3, (first.giver.robot, first.receiver.robot))
    (places,) = play.task.objects
    assert places.x[0] < first.T_world_lying[0][0] < places.x[1]


@pytest.mark.parametrize(
    ("options", "names", "why"),
    [
        ({"half_m": 0.06}, ("cube",), r"'left' opens to \d+ mm; it is 120 mm wide, and 8 mm are needed beside it"),
        ({"apart_m": 3.0}, ("cube", "left"), "'left' and 'right', 3.00 m apart, find no place where both reach it"),
        ({"apart_m": 3.0}, ("cube", "right"), "'right' does not reach it where it lies: .* mm are missing from above"),
        ({}, ("ball",), "no free body 'ball'. Free bodies: cube"),
        ({}, ("cube", "middle"), "no robot 'middle'. Robots: left, right"),
        ({}, ("cube", "left", "left"), "'left' cannot give to itself"),
    ],
)
def test_what_cannot_be_handed_over_is_refused_with_reason(
    options: dict[str, float], names: tuple[str, ...], why: str
) -> None:
    with pytest.raises(ConfigError, match=why) as caught:
        plan(make_scene(6, **options), *names)
    assert "\n" not in str(caught.value)


def test_scene_without_a_second_gripper_is_refused() -> None:
    spec = make_scene(6)
    for actuator in [a for a in spec.actuators if a.name.startswith("right/finger")]:
        spec.delete(actuator)
    for key in list(spec.keys):
        spec.delete(key)
    with pytest.raises(ConfigError, match="two arms with grippers, the scene has 1; 'right' has no gripper"):
        plan(spec)


def test_plan_needs_no_names() -> None:
    spec = make_scene(6)
    for element in (spec.body("left/finger_a"), *(one for one in spec.actuators if one.name.startswith("left/"))):
        element.name = ""
    giver = plan(spec, giver="left").giver
    assert any(finger.startswith("body_") for finger in giver.fingers)


def without_keyframe(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    for key in list(spec.keys):
        spec.delete(key)
    return spec


def use_motors(spec: mujoco.MjSpec, names: str, most: float) -> mujoco.MjSpec:
    """Let actuators whose names contain this push with a force up to `most` [N, N m] instead of to a position."""
    for body in spec.bodies:
        body.gravcomp = 0.0
    for actuator in (one for one in spec.actuators if names in one.name):
        actuator.biastype, actuator.gainprm[0] = mujoco.mjtBias.mjBIAS_NONE, 1.0
        actuator.ctrlrange = (-most, most)
    return spec


def test_arm_that_begins_straight_is_asked_for_a_keyframe() -> None:
    why = "'left' begins straight or with aligned axes .singular.: a keyframe 'home' with bent joints"
    with pytest.raises(ConfigError, match=f"are missing from above.*; {why}"):
        plan(without_keyframe(make_scene(6)), "cube", "left", "right")


def test_arm_with_few_joints_lacks_turn_and_not_reach() -> None:
    spec = without_keyframe(make_scene(6))
    for side, k in itertools.product(("left", "right"), (4, 6)):
        spec.delete(spec.actuator(f"{side}/joint{k}"))
        spec.delete(spec.joint(f"{side}/joint{k}"))
    why = r"'left' does not reach it where it lies: \d+ degrees of turn are missing from above; 'left' has 4 joints"
    with pytest.raises(ConfigError, match=why):
        plan(spec)


def test_motors_that_cannot_hold_are_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"the gripper of 'left' presses with 0.1 N and holds .* N by friction, but the object weighs"
    ):
        plan(use_motors(make_scene(6), "finger", 0.1))
    with pytest.raises(
        ConfigError, match=r"motor 'left/joint2' has 2 N m, but holding 'left' on its way takes [\d.]+ N m"
    ):
        plan(use_motors(make_scene(6), "joint", 2.0))
    assert plan(use_motors(use_motors(make_scene(6), "joint", 150.0), "finger", 40.0)).object == "cube"


def test_operator_says_that_the_object_slipped_and_where_it_lies() -> None:
    spec = make_scene(6)
    for geom in spec.geoms:
        geom.friction[0] = 0.002
    rig = make_rig(spec.compile(), 6)
    rig.run(60.0, until=Rig.over)
    slip = r"the cube slipped out of the gripper of left 0\.\d s after it closed"
    assert re.match(rf"{slip}; the cube lies \d+ mm and \d+ degrees from its", rig.behaviours["left"].failed)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("handover", "--object", "cube"), "--object: name the scene"),
        (("panda", "scene.xml"), "demo panda has its own scene"),
        (("handover", "handover"), "--object says which object is handed over. Free bodies of this scene: "),
    ],
)
def test_command_says_what_is_missing(
    arguments: tuple[str, ...], why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["demo", *arguments, "--record", str(tmp_path / "a.rrd")]) == 2
    assert why in capsys.readouterr().err
