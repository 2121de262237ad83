"""The arm alone gives the same tip poses as the whole scene; wrong chains are refused in one line."""

from __future__ import annotations

import msgspec
import mujoco
import numpy as np
import pytest

from anchors.pose import compose
from iris_session.control import ControlError
from iris_session.control.arm_model import ArmModel, has_moving_base
from iris_session.physics.tip import Tip
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import RobotSpec
from tests.control.rigs import aloha_model, aloha_robots, apart, panda_arms, panda_model, panda_spec


def check_fk(model: mujoco.MjModel, robot: RobotSpec) -> None:
    arm, data, rng = ArmModel(model, robot), mujoco.MjData(model), np.random.default_rng(1)
    for _ in range(20):
        low, high = model.jnt_range[arm.joint_ids].T
        q = rng.uniform(low, high)
        data.qpos[[model.jnt_qposadr[j] for j in arm.joint_ids]] = q
        mujoco.mj_kinematics(model, data)
        x, y, z = data.xpos[arm.root_body].tolist()
        w, i, j, k = data.xquat[arm.root_body].tolist()
        tip = compose(((x, y, z), (w, i, j, k)), arm.forward_kinematics(q))
        distance, angle = apart(tip, arm.tip.read_pose(data))
        assert distance < 1e-12
        assert angle < 1e-6


@pytest.mark.parametrize("side", [0, 1])
def test_fk_equals_the_scene_for_aloha(side: int) -> None:
    check_fk(aloha_model(), aloha_robots()[side])


def test_fk_equals_the_scene_for_turned_arms() -> None:
    model, robots = panda_arms([(0.0, 0.0, 0.3), (0.5, -1.0, 0.0)], [0.7, -2.0])
    for robot in robots:
        check_fk(model, robot)


def test_joint_order_of_the_robot_need_not_be_the_chains() -> None:
    robot = panda_spec()
    check_fk(panda_model(), msgspec.structs.replace(robot, joints=robot.joints[::-1], actuators=robot.actuators[::-1]))


def test_fk_equals_the_scene_for_a_body_with_an_offset() -> None:
    T = Pose((0.01, -0.02, 0.1), (0.5, 0.5, -0.5, 0.5))
    check_fk(panda_model(), msgspec.structs.replace(panda_spec(), site="", tip_body="link7", T_body_tip=T))


def test_a_body_with_an_offset_is_the_site_there() -> None:
    """Pose and velocity, to the last digits."""
    model, rng = panda_model(), np.random.default_rng(3)
    site = model.site(panda_spec().site)
    T = Pose(tuple(site.pos.tolist()), tuple(site.quat.tolist()))
    body = model.body(int(site.bodyid[0])).name
    spec = msgspec.structs.replace(panda_spec(), site="", tip_body=body, T_body_tip=T)
    of_site, of_body, data = Tip(model, panda_spec()), Tip(model, spec), mujoco.MjData(model)
    data.qpos[:7], data.qvel[:7] = rng.normal(size=(2, 7))
    mujoco.mj_forward(model, data)
    assert apart(of_site.read_pose(data), of_body.read_pose(data)) == pytest.approx((0.0, 0.0), abs=1e-5)
    assert of_site.read_velocity(data) == pytest.approx(of_body.read_velocity(data), abs=1e-9)


SLIDER = """<mujoco><worldbody><body name="base">{base}
  <body name="a"><joint name="lift" type="slide" axis="0 0 1" range="-1 1" limited="true" ref="0.2"/><geom size=".05"/>
    <body name="b" pos=".2 0 0">{middle}<geom size=".05"/>
      <body name="c" pos=".2 0 0"><joint name="wrist" axis="0 1 0" range="-1 1" limited="true" ref="-0.1"/>
        <geom size=".05"/><site name="tip" pos=".1 0 0"/></body></body></body>
  <body name="other"><joint name="spin"/><geom size=".05"/></body></body></worldbody></mujoco>"""


def slider(base: str = "", middle: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(SLIDER.format(base=base, middle=middle))


def lift_robot(*joints: str) -> RobotSpec:
    return RobotSpec("lift", joints, joints, "tip", "base")


def test_slides_and_reference_positions() -> None:
    check_fk(slider(), lift_robot("lift", "wrist"))


def test_a_base_that_moves_is_seen() -> None:
    free = slider(base='<freejoint/><geom size=".1"/>')
    assert has_moving_base(free, ArmModel(free, lift_robot("lift", "wrist")).root_body)
    still = slider()
    assert not has_moving_base(still, ArmModel(still, lift_robot("lift", "wrist")).root_body)
    check_fk(free, lift_robot("lift", "wrist"))


@pytest.mark.parametrize(
    ("model", "robot", "message"),
    [
        (slider(), lift_robot("lift", "elbow"), "joint 'elbow' does not exist in the model. Available joints: lift"),
        (slider(), lift_robot("spin"), "joint 'spin' does not move site 'tip'"),
        (slider(middle='<joint name="extra"/>'), lift_robot("lift", "wrist"), "joints extra lie between its joints"),
        (
            slider(middle='<joint name="b" type="ball"/>'),
            lift_robot("lift", "b", "wrist"),
            "must be a hinge or a slide",
        ),
        (slider(), lift_robot(), r"joints \(none\) lie between"),
    ],
)
def test_wrong_chains_are_refused(model: mujoco.MjModel, robot: RobotSpec, message: str) -> None:
    with pytest.raises(ControlError, match=message) as refused:
        ArmModel(model, robot)
    assert "\n" not in str(refused.value)
