"""Casts of the demos, and that they fit their scenes."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from iris_session.demo.demos import Demo, make_demo
from iris_session.demo.scenes.deformables import BOX_HIGH, BOX_LOW
from iris_session.emulator.behaviours.deformables import CORNERS
from iris_session.emulator.behaviours.objects import find_object, get_arm_kind
from iris_session.emulator.behaviours.stower import BOX, BOX_INSIDE
from iris_session.physics import World, find_objects, find_robots
from iris_session.session.errors import ConfigError

CASTS = [
    ("handover", 2),
    ("handover", 8),
    ("panda", 2),
    ("aloha", 2),
    ("cloth", 2),
    ("soft", 2),
    ("cloud", 2),
]


@pytest.fixture(params=CASTS, ids=lambda cast: f"{cast[0]}-{cast[1]}")
def play(request: pytest.FixtureRequest) -> Demo:
    name, operators = request.param
    return make_demo(name, operators, observers=3, seed=7)


def test_robots_of_each_person_exist_and_are_exclusive(play: Demo) -> None:
    robots = {robot.name for robot in find_robots(play.model).robots}
    taken = [task.robot for person in play.headsets for task in person.tasks]
    assert sorted(taken) == sorted(set(taken))
    assert set(taken) == robots
    assert sum(person.observer for person in play.headsets) == 3
    assert len({person.name for person in play.headsets}) == len(play.headsets)
    assert len({person.seed for person in play.headsets}) == len(play.headsets)


def test_every_object_goes_from_one_person_to_another(play: Demo) -> None:
    tasks = {task.robot: (person.name, task) for person in play.headsets for task in person.tasks}
    names = {o.name for o in find_objects(play.model)}
    for thing in play.objects:
        assert thing in names
        assert find_object(thing).half_width > 0.0
        (giver,) = [t for _, t in tasks.values() if t.behaviour == "giver" and t.object == thing]
        (receiver,) = [t for _, t in tasks.values() if t.behaviour == "receiver" and t.object == thing]
        assert (giver.partner, receiver.partner) == (receiver.robot, giver.robot)
        assert tasks[giver.robot][0] != tasks[receiver.robot][0]


def test_every_goal_is_a_task_with_the_corners_of_the_scene(play: Demo) -> None:
    world = World(play.model, find_robots(play.model).robots, find_objects(play.model))
    for goal in play.goals:
        assert goal.deformable in {task.object for person in play.headsets for task in person.tasks}
        vertices = world.flexes.read_vertices(goal.deformable)
        corners = vertices[list(CORNERS[goal.deformable])]
        ends = [corners.min(axis=0), corners.max(axis=0)]
        np.testing.assert_allclose(ends, [vertices.min(axis=0), vertices.max(axis=0)], atol=1e-9)
        assert not goal.is_met(vertices)
    if play.name == "soft":  # people know the box by its body and its size
        np.testing.assert_allclose(np.subtract(BOX_HIGH, BOX_LOW)[:2] / 2.0, BOX_INSIDE[:2], atol=1e-9)
        np.testing.assert_allclose(np.add(BOX_HIGH, BOX_LOW)[:2] / 2.0, world.data.body(BOX).xpos[:2], atol=1e-9)


def test_robot_descriptions_match_the_scene(play: Demo) -> None:
    """Body names exist, and closed pads meet at the tip."""
    data = mujoco.MjData(play.model)
    mujoco.mj_resetDataKeyframe(play.model, data, 0)
    mujoco.mj_forward(play.model, data)
    for task in (task for person in play.headsets for task in person.tasks):
        arm = get_arm_kind(task.arm)
        assert data.body(f"{task.robot}/{arm.base}").xpos[2] == pytest.approx(arm.above_table, abs=2e-3)
        pads = [
            data.body(f"{task.robot}/{finger}").xpos + data.body(f"{task.robot}/{finger}").xmat.reshape(3, 3) @ pad
            for finger, pad in zip(arm.fingers, arm.pads, strict=True)
        ]
        tip = data.site(f"{task.robot}/tcp")
        assert np.linalg.norm((pads[0] + pads[1]) / 2 - tip.xpos) < 4e-3
        across = (pads[1] - pads[0]) / np.linalg.norm(pads[1] - pads[0])
        assert abs(across @ tip.xmat.reshape(3, 3)[:, 1]) == pytest.approx(1.0, abs=1e-3)


def test_sheet_is_at_its_configured_pose(play: Demo) -> None:
    data = mujoco.MjData(play.model)
    mujoco.mj_resetDataKeyframe(play.model, data, 0)
    mujoco.mj_forward(play.model, data)
    (sheet,) = play.anchors.values()
    np.testing.assert_allclose(data.body("sheet").xpos, sheet[0], atol=1e-9)
    assert {person.T_world_anchor for person in play.headsets} == {sheet}


def test_people_without_a_partner_move_freely_and_are_reported() -> None:
    play = make_demo("handover", 5)
    assert [p.behaviour for p in play.headsets] == ["giver", "receiver", "giver", "receiver", "wander"]
    assert play.headsets[-1].endless
    assert "eli has" in play.notes[0]


@pytest.mark.parametrize(("observers", "names"), [(0, ["watcher1"]), (2, ["watcher1", "watcher2"])])
def test_every_observer_of_the_cloud_watches_all_its_streams(observers: int, names: list[str]) -> None:
    play = make_demo("cloud", observers=observers)
    watching = {person.name: person.streams for person in play.headsets if person.observer}
    assert watching == dict.fromkeys(names, ("room", "room-front", "room-back"))
    assert not any(person.streams for person in play.headsets if not person.observer)


@pytest.mark.parametrize(
    ("demo", "operators", "observers", "why"),
    [
        ("handover", 1, 0, "2 to 8 operators, not 1"),
        ("aloha", 4, 0, "2 operators, not 4"),
        ("handover", 2, 17, "--observers 17 .*0 to 16"),
        ("cloud", 3, 0, "2 operators, not 3.*--observers"),
        ("juggle", 2, 0, "'juggle': handover, panda, aloha, cloth, soft, cloud"),
    ],
)
def test_unsuitable_casts_are_rejected_with_reason(demo: str, operators: int, observers: int, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        make_demo(demo, operators, observers)
