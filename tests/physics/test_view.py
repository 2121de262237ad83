"""The live view against MuJoCo: poses, contacts of objects, grip and its force."""

from __future__ import annotations

from typing import Any

import msgspec
import mujoco
import numpy as np
import pytest

from iris_session.demo.scenes.deformables import cloth_scene, soft_scene
from iris_session.physics import UnknownNameError, World, find_objects, find_robots
from iris_session.physics.contacts import ContactTables
from iris_session.physics.tree import KinematicTree
from iris_session.protocol.steps import ObjectContact, WorldView
from tests.physics.models import GRIPPER_TENDON, model

#: A gripper that closes on a box on a table; the passive arm `other` is a post that can be pushed over.
GRASP = (
    """<mujoco><compiler angle="radian"/><option timestep="0.002" cone="{cone}" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="table"><geom type="box" size=".5 .5 .05" pos="0 0 -.05"/></body>
    <body name="cube" pos="0 0 .02"><freejoint/><geom type="box" size=".02 .02 .02" mass=".1" condim="4"/>
      <body name="lid" pos="0 0 .025"><geom type="box" size=".005 .005 .005" mass=".01"/></body></body>
    <body name="spare" pos=".3 .3 .0199"><freejoint/><geom type="sphere" size=".02" mass=".1"/></body>
    <body name="lonely" pos="0 0 2" gravcomp="1"><freejoint/><geom size=".02"/></body>
    <body name="base" gravcomp="1" pos="0 0 .3">
      <joint name="j0" type="slide" axis="0 0 1"/><geom size=".01" mass="1" pos="0 0 .1"/>
      <body name="l1" gravcomp="1"><joint name="j1" type="slide" axis="1 0 0"/><geom size=".01" mass="1" pos="0 0 .1"/>
      <body name="l2" gravcomp="1"><joint name="j2" type="slide" axis="0 1 0"/><geom size=".01" mass="1" pos="0 0 .1"/>
        <site name="tcp" pos="0 0 -.28" euler="0 .3 0"/>
        <body name="left_pad" gravcomp="1" pos="0 0 -.28">
          <joint name="finger_l" type="slide" axis="0 1 0" range="0 .04"/>
          <geom type="box" size=".01 .005 .01" pos="0 .03 0" condim="4" mass=".1"/></body>
        <body name="right_pad" gravcomp="1" pos="0 0 -.28">
          <joint name="finger_r" type="slide" axis="0 -1 0" range="0 .04"/>
          <geom type="box" size=".01 .005 .01" pos="0 -.03 0" condim="4" mass=".1"/></body>
      </body></body></body>
  </worldbody>"""
    + GRIPPER_TENDON
    + """
  <equality><joint joint1="finger_l" joint2="finger_r"/></equality>
  <actuator>
    <position name="a0" joint="j0" kp="3000" dampratio="1"/><position name="a1" joint="j1" kp="3000" dampratio="1"/>
    <position name="a2" joint="j2" kp="3000" dampratio="1"/>
    <general name="grip" tendon="split" ctrlrange="-20 20"/>
  </actuator></mujoco>"""
)


def grasp_world(cone: str) -> World:
    m = model(GRASP.format(cone=cone).replace('range="0 .04"', 'range="-.04 .04"'))
    robots = find_robots(m).robots
    assert [r.name for r in robots] == ["robot"]
    assert robots[0].finger_bodies == ("left_pad", "right_pad")
    assert (robots[0].gripper_open, robots[0].gripper_closed) == (20.0, -20.0)
    return World(m, robots, find_objects(m))


def contacts_of(world: World) -> dict[str, ObjectContact]:
    return {c.object: c for c in world.view().object_contacts()}


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_grasp_is_reported_with_its_force(cone: str) -> None:
    world = grasp_world(cone)
    view: WorldView = world.view()
    objects = find_objects(world.model)
    tables = ContactTables(world.model, find_robots(world.model).robots, objects, KinematicTree(world.model))

    def forces() -> dict[str, list[float]]:
        """Return the sum of the normal forces on each object, and their vector sum with friction."""
        mujoco.mj_forward(world.model, world.data)
        found = tables.object_forces(world.model, world.data).tolist()
        return dict(zip([one.name for one in objects], found, strict=True))

    for _ in range(500):
        world.tick()
    weights = {"cube": 0.11 * 9.81, "spare": 0.1 * 9.81, "lonely": 0.0}  # the lid is a part of the cube
    for name, found in forces().items():
        assert found == pytest.approx([weights[name], 0.0, 0.0, weights[name]], rel=0.01, abs=1e-3)
    assert contacts_of(world) == {
        "cube": ObjectContact("cube", (), (), ("table",)),
        "spare": ObjectContact("spare", (), (), ("table",)),
    }
    assert view.gripper_force("robot") == 0.0
    world.ctrl[3] = -20.0
    for _ in range(500):
        world.tick()
    assert contacts_of(world)["cube"] == ObjectContact("cube", ("robot",), ("robot",), ("table",))
    # The tendon carries 20 N at coefficient 1/2, so each of the two fingers presses with 10 N.
    assert view.gripper_force("robot") == pytest.approx(20.0, rel=0.02)
    world.ctrl[0] = 0.1
    for _ in range(500):
        world.tick()
    assert contacts_of(world)["cube"] == ObjectContact("cube", ("robot",), ("robot",), ())
    assert view.object_pose("cube").p[2] > 0.1
    normal, *vector = forces()["cube"]
    assert normal == pytest.approx(20.0, rel=0.02), "two fingers, and nothing below"
    assert vector == pytest.approx([0.0, 0.0, weights["cube"]], abs=0.02), "friction carries it"
    restored = grasp_world(cone)
    restored.restore(world.snapshot())
    assert restored.view().gripper_force("robot") == view.gripper_force("robot") > 19.0
    assert restored.view().object_contacts() == view.object_contacts()


def test_single_finger_grips_only_where_it_is_the_only_one() -> None:
    world = grasp_world("elliptic")
    m, robots, objects = world.model, find_robots(world.model).robots, find_objects(world.model)
    push = lambda w: (w.data.qpos.__setitem__(slice(0, 3), (0.0, 0.026, 0.02)), w.restore_state(w.save_state()))  # noqa: E731
    push(world)
    assert contacts_of(world)["cube"].touching == ("robot",)
    assert contacts_of(world)["cube"].grippers == ()
    one = World(m, [msgspec.structs.replace(robots[0], finger_bodies=("left_pad",))], objects)
    push(one)
    assert contacts_of(one)["cube"].grippers == ("robot",)


def test_objects_touch_each_other_the_world_and_cloth() -> None:
    m = model("""<mujoco><option timestep="0.002"/><worldbody><geom type="plane" size="1 1 1"/>
      <body name="low" pos="0 0 .0999"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
      <body name="high" pos="0 0 .2997"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
      <body name="wide" pos="1 0 .0999"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
      <body name="near" pos="1 0 .33"><freejoint/><geom type="box" size=".1 .1 .1" gap=".05"/></body>
      <flexcomp name="cloth" type="grid" count="6 6 1" spacing=".08 .08 .08" pos="0 0 .408" dim="2" mass=".3"
        radius=".01"><edge equality="true"/></flexcomp></worldbody></mujoco>""")
    world = World(m, (), find_objects(m))
    for _ in range(3):
        world.tick()
    found = contacts_of(world)
    assert found["low"].others == ("world", "high")
    assert found["high"].others == ("low", "cloth")
    assert found["wide"].others == ("world",)
    assert "near" not in found, "within the gap, but not touching"


def test_poses_and_joints(panda: mujoco.MjModel) -> None:
    world = World(panda, find_robots(panda).robots, ())
    view = world.view()
    assert view.tick == 0
    for _ in range(20):
        world.tick()
    assert (view.tick, view.sim_time) == (20, float(world.data.time))
    site = world.data.site("attachment_site")
    pose = view.tip_pose("panda")
    assert pose.p == tuple(site.xpos.tolist())
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.array(pose.q))
    assert np.allclose(matrix, site.xmat, atol=1e-12)
    assert view.joints("panda") == tuple(world.data.qpos.tolist())
    world.tick()
    assert view.tip_pose("panda") != pose


def test_unknown_names_are_rejected_with_known_ones(handover: mujoco.MjModel) -> None:
    view = World(handover, find_robots(handover).robots, find_objects(handover)).view()
    with pytest.raises(UnknownNameError, match=r"robot 'lift' .*: left, right\."):
        view.tip_pose("lift")
    with pytest.raises(UnknownNameError, match="robot 'lift'"):
        view.gripper_force("lift")
    with pytest.raises(UnknownNameError, match=r"'nail' .* hammer, board"):
        view.object_pose("nail")


# --- deformables of a world ---


SCENES = {"cloth": cloth_scene, "soft": soft_scene}


@pytest.fixture(scope="module", params=list(SCENES))
def flex_model(request: pytest.FixtureRequest) -> Any:
    return SCENES[request.param]().compile()


@pytest.fixture(scope="module")
def soft() -> Any:
    return soft_scene().compile()


def world_of(flex_model: Any) -> World:
    return World(flex_model, find_robots(flex_model).robots, find_objects(flex_model))


def slides_of(world: World, name: str) -> list[int]:
    """First of the three slides (x, y, z) of every vertex or node of a deformable: address in `qpos` and `qvel`."""
    flex_model, flex = world.model, world.flexes.names.index(name)
    nodes, first = int(flex_model.flex_nodenum[flex]), int(flex_model.flex_nodeadr[flex])
    bodies = flex_model.flex_nodebodyid[first : first + nodes]
    if not nodes:
        first, count = int(flex_model.flex_vertadr[flex]), int(flex_model.flex_vertnum[flex])
        bodies = flex_model.flex_vertbodyid[first : first + count]
    return [int(flex_model.jnt_qposadr[flex_model.body_jntadr[body]]) for body in bodies]


def move(world: World, name: str, by: np.ndarray) -> None:
    for at in slides_of(world, name):
        world.data.qpos[at : at + 3] += by
    world.restore_state(world.save_state())


def test_deformed_world_is_restored_bit_for_bit(flex_model: Any) -> None:
    """Flexes have caches outside of `mjSTATE_INTEGRATION`; later states must not depend on them."""
    world, other, rng = world_of(flex_model), world_of(flex_model), np.random.default_rng(3)
    for name in world.flexes.names:
        for at in slides_of(world, name):
            world.data.qvel[at : at + 3] = rng.normal(0.0, 0.4, 3)
    for _ in range(15):
        world.tick()
    saved = world.snapshot()
    for _ in range(15):
        world.tick()
    for _ in range(5):  # another history
        other.tick()
    other.restore(saved)
    for _ in range(15):
        other.tick()
    assert other.save_state() == world.save_state()
    for name in world.flexes.names:
        assert (other.flexes.read_vertices(name) == world.flexes.read_vertices(name)).all()


def test_contacts_and_grip_force_of_a_deformable(soft: Any) -> None:
    world = world_of(soft)
    tip = np.array(world.view().tip_pose("right").p)
    move(world, "mint", tip - world.flexes.read_vertices("mint").mean(axis=0))
    assert world.flexes.find_touching_robots("mint") == ()
    world.ctrl[-1] = 0.0  # the gripper of the right arm closes
    for _ in range(60):
        world.tick()
    assert world.flexes.find_touching_robots("mint") == ("right",)
    assert world.flexes.find_touching_robots("rose") == ()
    assert world.view().gripper_force("right") > 20.0
    assert world.view().gripper_force("left") == 0.0
    assert world.flexes.read_vertices("mint")[:, 2].mean() == pytest.approx(tip[2], abs=0.02)  # held by friction
