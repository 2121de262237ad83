"""Objects held by hands: they follow, carry their weight, stay within the force bound, and are let go cleanly."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from anchors.pose import quat_from_rotvec
from iris_session.control import ControlConfig, ControlError
from iris_session.control.grasp import Grasps
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import ObjectSpec
from iris_session.protocol.steps import ObjectCommand

SCENE = """<mujoco><option timestep="0.002"/><worldbody>
<body name="box" pos="0 0 1"><freejoint/><geom type="box" size=".05 .03 .02" mass="{mass}" pos=".02 0 0"/></body>
<body name="ball" pos="2 0 1" gravcomp="1"><freejoint/><geom size=".05" mass="0.1"/></body>
<body name="wall"><geom type="box" size=".1 1 1" pos="{wall} 0 1"/></body></worldbody></mujoco>"""
OBJECTS = [ObjectSpec("box", "box"), ObjectSpec("ball", "ball")]


def scene(mass: float = 0.5, wall: float = 9.0) -> tuple[mujoco.MjModel, mujoco.MjData, Grasps]:
    model = mujoco.MjModel.from_xml_string(SCENE.format(mass=mass, wall=wall))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data, Grasps(model, OBJECTS, ControlConfig())


def run(model: mujoco.MjModel, data: mujoco.MjData, grasps: Grasps, ticks: int) -> None:
    for _ in range(ticks):
        grasps.tick(data)
        mujoco.mj_step2(model, data)
        mujoco.mj_step1(model, data)


def to(
    name: str, p: tuple[float, float, float], q: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
) -> list[ObjectCommand]:
    return [ObjectCommand(name, 1, Pose(p, q))]


@pytest.mark.parametrize("mass", [0.05, 0.5, 20.0])
def test_it_follows_and_stays_there_whatever_its_mass(mass: float) -> None:
    model, data, grasps = scene(mass)
    turn = quat_from_rotvec((0.2, -0.4, 0.7))
    grasps.set_goals(to("box", (0.1, 0.2, 1.3), turn))
    run(model, data, grasps, 1500)
    assert data.body("box").xpos == pytest.approx((0.1, 0.2, 1.3), abs=1e-5)
    assert abs(float(np.dot(data.body("box").xquat, turn))) == pytest.approx(1.0, abs=1e-9)


PLIERS = """<mujoco><option timestep="0.002"/><worldbody><body name="box" pos="0 0 1"><freejoint/>
<geom type="box" size=".02 .02 .02" mass=".2"/><body name="jaw" pos=".1 0 0"><joint type="hinge" axis="0 1 0"
stiffness="200" damping="2"/><geom type="box" size=".08 .02 .02" pos=".08 0 0" mass=".6"/></body></body>
<body name="ball" pos="2 0 1"><freejoint/><geom size=".05" mass="0.1"/></body></worldbody></mujoco>"""


def test_an_object_of_several_parts_is_carried_as_a_whole() -> None:
    model = mujoco.MjModel.from_xml_string(PLIERS)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    grasps = Grasps(model, OBJECTS, ControlConfig())
    grasps.set_goals(to("box", (0.0, 0.0, 1.2)))
    run(model, data, grasps, 2000)
    assert data.xfrc_applied[1][2] == pytest.approx(0.8 * 9.81, rel=1e-3)
    # The hinge gives under the jaw's weight by 0.3 degrees, and the whole is at its place.
    assert data.body("box").xpos == pytest.approx((0.0, 0.0, 1.2), abs=2e-3)
    assert float(np.abs(data.body("box").xquat[0])) == pytest.approx(1.0, abs=1e-4)


def test_the_first_tick_at_its_own_pose_only_carries_the_weight() -> None:
    _, data, grasps = scene()
    grasps.set_goals(to("box", (0.0, 0.0, 1.0)))
    grasps.tick(data)
    assert data.body("box").xfrc_applied == pytest.approx((0, 0, 0.5 * 9.81, 0, 0, 0), abs=1e-9)
    grasps.set_goals(to("ball", (2.0, 0.0, 1.0)))
    grasps.tick(data)
    assert not data.body("ball").xfrc_applied.any()  # the model carries this one itself


def test_force_and_torque_are_bounded() -> None:
    model, data, grasps = scene(wall=0.3)
    grasps.set_goals(to("box", (5.0, 0.0, 1.0), quat_from_rotvec((0.0, 0.0, math.pi - 0.1))))
    worst = np.zeros(2)
    for _ in range(1000):
        run(model, data, grasps, 1)
        wrench = data.body("box").xfrc_applied - (0, 0, 0.5 * 9.81, 0, 0, 0)
        worst = np.maximum(worst, (np.linalg.norm(wrench[:3]), np.linalg.norm(wrench[3:])))
    assert worst[0] == pytest.approx(40.0)
    assert worst[1] <= 4.0 + 1e-9
    assert data.body("box").xpos[0] < 0.25  # the wall stopped it


def test_let_go_clears_the_wrench_once_and_leaves_others_alone() -> None:
    model, data, grasps = scene()
    data.body("ball").xfrc_applied[:] = 7.0
    grasps.set_goals(to("box", (0.0, 0.0, 1.2)))
    run(model, data, grasps, 5)
    assert data.body("box").xfrc_applied.any()
    grasps.set_goals([])
    grasps.tick(data)
    assert not data.body("box").xfrc_applied.any()
    data.body("box").xfrc_applied[2] = 3.0  # the user's own
    grasps.set_goals([])
    grasps.tick(data)
    assert data.body("box").xfrc_applied[2] == 3.0
    assert (data.body("ball").xfrc_applied == 7.0).all()


def test_unknown_and_fixed_objects_are_refused() -> None:
    model, _, grasps = scene()
    with pytest.raises(ControlError, match=r"object 'cup' is not known. Available objects: box, ball"):
        grasps.set_goals(to("cup", (0.0, 0.0, 0.0)))
    with pytest.raises(ControlError, match="body 'wall' must have a free joint"):
        Grasps(model, [ObjectSpec("wall", "wall")], ControlConfig())
    with pytest.raises(ControlError, match="body 'cup' does not exist"):
        Grasps(model, [ObjectSpec("cup", "cup")], ControlConfig())
