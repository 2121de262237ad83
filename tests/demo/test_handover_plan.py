"""Planned handovers: people hand a box over between arms that they have never seen, or one line says why not."""

from __future__ import annotations

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
