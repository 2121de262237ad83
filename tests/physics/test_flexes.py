"""Deformables of a world: the packaged scenes with them, restoring them bit for bit, and who touches them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from iris_session.demo.scenes.deformables import BOX_HIGH, BOX_LOW, FOLD_PAIRS, cloth_scene, soft_scene
from iris_session.physics import World
from iris_session.physics.errors import UnknownNameError
from iris_session.physics.objects import find_objects
from iris_session.physics.robots import find_robots

SCENES = {"cloth": cloth_scene, "soft": soft_scene}


@pytest.fixture(scope="module", params=list(SCENES))
def model(request: pytest.FixtureRequest) -> Any:
    return SCENES[request.param]().compile()


@pytest.fixture(scope="module")
def soft() -> Any:
    return soft_scene().compile()


def world_of(model: Any) -> World:
    return World(model, find_robots(model), find_objects(model))


def slides_of(world: World, name: str) -> list[int]:
    """First of the three slides (x, y, z) of every vertex or node of a deformable: address in `qpos` and `qvel`."""
    model, flex = world.model, world.flexes.names.index(name)
    nodes, first = int(model.flex_nodenum[flex]), int(model.flex_nodeadr[flex])
    bodies = model.flex_nodebodyid[first : first + nodes]
    if not nodes:
        first, count = int(model.flex_vertadr[flex]), int(model.flex_vertnum[flex])
        bodies = model.flex_vertbodyid[first : first + count]
    return [int(model.jnt_qposadr[model.body_jntadr[body]]) for body in bodies]


def move(world: World, name: str, by: np.ndarray) -> None:
    for at in slides_of(world, name):
        world.data.qpos[at : at + 3] += by
    world.set_state_bytes(world.state_bytes())


def test_two_arms_and_no_objects(model: Any) -> None:
    assert [robot.name for robot in find_robots(model)] == ["left", "right"]
    assert find_objects(model) == ()


def test_vertices_are_no_bodies_of_the_stream(model: Any) -> None:
    names = {body.name for body in world_of(model).bodies}
    assert {"table", "sheet", "left/base", "right/hand"} <= names
    assert len(names) < 30 < model.nbody


def test_a_deformed_world_is_restored_bit_for_bit(model: Any) -> None:
    """Flexes have caches outside of `mjSTATE_INTEGRATION`; nothing later may depend on them."""
    world, other, rng = world_of(model), world_of(model), np.random.default_rng(3)
    for name in world.flexes.names:
        for at in slides_of(world, name):
            world.data.qvel[at : at + 3] = rng.normal(0.0, 0.4, 3)
    for _ in range(15):
        world.tick()
    saved = world.snapshot()
    for _ in range(15):
        world.tick()
    for _ in range(5):  # another past
        other.tick()
    other.restore(saved)
    for _ in range(15):
        other.tick()
    assert other.state_bytes() == world.state_bytes()
    for name in world.flexes.names:
        assert (other.flexes.vertices(name) == world.flexes.vertices(name)).all()


def test_the_corners_that_fold_are_the_near_and_the_far_ones() -> None:
    vertices = world_of(cloth_scene().compile()).flexes.vertices("cloth")
    for near, far in FOLD_PAIRS:
        assert vertices[far] - vertices[near] == pytest.approx([0.0, 0.36, 0.0], abs=1e-6)
        assert abs(vertices[near][0]) == pytest.approx(0.18)


def test_the_box_of_the_goal_is_that_of_the_scene(soft: Any) -> None:
    world = world_of(soft)
    walls = {side: world.data.geom(f"box_{side}").xpos for side in ("west", "east", "south", "north")}
    thick = soft.geom("box_west").size[0]
    assert BOX_LOW[0] == pytest.approx(walls["west"][0] + thick)
    assert BOX_HIGH[0] == pytest.approx(walls["east"][0] - thick)
    assert BOX_LOW[1] == pytest.approx(walls["south"][1] + thick)
    assert BOX_HIGH[1] == pytest.approx(walls["north"][1] - thick)
    assert BOX_HIGH[2] == pytest.approx(walls["west"][2] + soft.geom("box_west").size[2])


def test_who_touches_a_deformable_and_how_hard_the_gripper_holds_it(soft: Any) -> None:
    world = world_of(soft)
    tip = np.array(world.view().tip_pose("right").p)
    move(world, "mint", tip - world.flexes.vertices("mint").mean(axis=0))
    assert world.flexes.touching("mint") == ()
    world.ctrl[-1] = 0.0  # the gripper of the right arm closes
    for _ in range(60):
        world.tick()
    assert world.flexes.touching("mint") == ("right",)
    assert world.flexes.touching("rose") == ()
    assert world.view().gripper_force("right") > 20.0
    assert world.view().gripper_force("left") == 0.0
    assert world.flexes.vertices("mint")[:, 2].mean() == pytest.approx(tip[2], abs=0.02)  # held by friction


def test_an_unknown_deformable_says_which_there_are(soft: Any) -> None:
    world = world_of(soft)
    for ask in (world.flexes.vertices, world.flexes.touching):
        with pytest.raises(UnknownNameError, match="rose"):
            ask("cloth")
