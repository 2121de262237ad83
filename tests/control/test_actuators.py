"""`ctrl` laws by actuator type, and the actuators that are refused."""

from __future__ import annotations

import msgspec
import mujoco
import numpy as np
import pytest

from iris_session.control import ControlConfig, ControlError
from iris_session.control.actuators import ActuatorLaws, Grippers
from iris_session.protocol.specs import GripperActuator, RobotSpec
from tests.control.rigs import aloha_model, aloha_robots

MODEL = """<mujoco><compiler angle="radian"/><option integrator="implicitfast"/>
<worldbody><body name="base"><body name="link" gravcomp="{gravcomp}"><joint name="j" axis="0 1 0" {joint}/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/><site name="tip" pos=".3 0 0"/></body></body>
</worldbody><tendon><fixed name="t"><joint joint="j" coef="1"/></fixed></tendon>
<actuator>{actuator}</actuator></mujoco>"""


FAST = np.array([2.5])


def laws(
    actuator: str, hold: str = "", joint: str = "", actuators: tuple[str, ...] = ("a",), gravcomp: str = "0"
) -> tuple[ActuatorLaws, mujoco.MjModel]:
    model = mujoco.MjModel.from_xml_string(MODEL.format(actuator=actuator, joint=joint, gravcomp=gravcomp))
    robot = RobotSpec("r", ("j",), actuators, "tip", "base", hold=hold)
    return ActuatorLaws(model, [robot], ControlConfig()), model


def settle(
    actuator: str, q: float, seconds: float = 4.0, hold: str = "", gravcomp: str = "0"
) -> tuple[float, mujoco.MjData]:
    """Holds at `q` for a while; the joint's last position."""
    law, model = laws(actuator, hold, gravcomp=gravcomp)
    data = mujoco.MjData(model)
    data.qpos[0] = q
    mujoco.mj_forward(model, data)
    for _ in range(round(seconds / model.opt.timestep)):
        law.write(data, np.array([q]), np.zeros(1), FAST)
        mujoco.mj_step2(model, data)
        mujoco.mj_step1(model, data)
    return float(data.qpos[0]), data


@pytest.mark.parametrize(
    "actuator",
    [
        '<position name="a" joint="j" kp="4000" kv="60"/>',
        '<position name="a" joint="j" kp="4000" kv="60" gear="-2.5"/>',
        '<general name="a" joint="j" gainprm="15.7" biastype="affine" biasprm="40 -4000 -60"/>',
        '<position name="a" joint="j" kp="4000" kv="60" timeconst="0.05"/>',
    ],
)
def test_position_actuators_settle_where_commanded_whatever_their_units(actuator: str) -> None:
    q, _ = settle(actuator, 0.5)
    assert q == pytest.approx(0.5, abs=1e-3)  # 1.5 N m of gravity on 4000 N m/rad


def test_plain_position_ctrl_is_the_position_bitwise() -> None:
    law, model = laws('<position name="a" joint="j" kp="100"/>')
    data = mujoco.MjData(model)
    law.write(data, np.array([0.1 + 0.2]), np.zeros(1), FAST)
    assert data.ctrl[0] == 0.1 + 0.2


def test_velocity_actuators_get_exactly_zero_within_the_deadband_and_bounded_drift_beyond() -> None:
    law, model = laws('<velocity name="a" joint="j" kv="20"/>')
    data = mujoco.MjData(model)
    data.qpos[0] = 0.3005
    law.write(data, np.array([0.3]), np.zeros(1), FAST)
    assert data.ctrl[0] == 0.0
    law.write(data, np.array([0.3]), np.array([0.7]), FAST)
    assert data.ctrl[0] == 0.7
    data.qpos[0] = 0.9  # pushed far away: it comes back no faster than it may move
    law.write(data, np.array([0.3]), np.zeros(1), FAST)
    assert data.ctrl[0] == -2.5
    # 1.46 N m of gravity: zero alone creeps at 73 mrad/s; the bound is deadband + torque / (kv * gain) = 4.7 mrad.
    one, _ = settle('<velocity name="a" joint="j" kv="20"/>', 0.3, seconds=2.0)
    ten, _ = settle('<velocity name="a" joint="j" kv="20"/>', 0.3, seconds=20.0)
    assert abs(ten - 0.3) < 4.7e-3
    assert abs(ten - one) < 1e-6


def test_integrated_velocity_ends_with_zero_ctrl() -> None:
    q, data = settle('<intvelocity name="a" joint="j" kp="400" kv="20" actrange="-3 3"/>', 0.3, seconds=8.0)
    assert q == pytest.approx(0.3, abs=1.2e-3)
    assert data.ctrl[0] == 0.0


@pytest.mark.parametrize(("gear", "carried"), [("1", "0"), ("-7", "0"), ("1", "1")])
def test_torque_actuators_hold_against_gravity(gear: str, carried: str) -> None:
    """`carried`: the model compensates gravity itself, which must not be done twice."""
    q, data = settle(f'<motor name="a" joint="j" gear="{gear}"/>', 0.4, hold="gravity_pd", gravcomp=carried)
    assert q == pytest.approx(0.4, abs=1e-9)
    assert (abs(data.ctrl[0]) > 0.1) == (carried == "0")


def test_commandable_range_is_what_joint_and_actuator_share() -> None:
    law, _ = laws(
        '<position name="a" joint="j" kp="100" gear="2" ctrlrange="-1 1" ctrllimited="true"/>',
        joint='range="-0.3 1" limited="true"',
    )
    assert (law.lower.tolist(), law.upper.tolist()) == ([-0.3], [0.5])
    free, _ = laws('<velocity name="a" joint="j" kv="1" ctrlrange="-1 1" ctrllimited="true"/>')
    assert (free.lower.tolist(), free.upper.tolist()) == ([-np.inf], [np.inf])


@pytest.mark.parametrize(
    ("actuator", "message"),
    [
        (
            '<motor name="a" joint="j"/>',
            "a torque actuator, which cannot hold by itself: declare hold = 'gravity_pd'",
        ),
        ('<position name="a" tendon="t"/>', "must act on the joint of the same place"),
        ('<general name="a" joint="j" gainprm="0"/>', "needs a fixed gain and a gear other than zero"),
        ('<damper name="a" joint="j" kv="1" ctrlrange="0 1"/>', "needs a fixed gain"),
        ('<general name="a" joint="j" dyntype="integrator" gainprm="1"/>', "must be a position, velocity, integrated"),
        ('<motor name="b" joint="j"/>', "actuator 'a' does not exist in the model. Available actuators: b"),
    ],
)
def test_actuators_without_a_law_are_refused_in_one_line(actuator: str, message: str) -> None:
    with pytest.raises(ControlError) as refused:
        laws(actuator)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_one_actuator_per_joint() -> None:
    with pytest.raises(ControlError, match="has 1 joints and 2 actuators"):
        laws('<motor name="a" joint="j"/>', actuators=("a", "a"))


# --- grippers move at bounded speed ---


def aloha() -> tuple[Grippers, mujoco.MjData, int, int]:
    model = aloha_model()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    robots = aloha_robots()
    for robot in robots:
        data.actuator(robot.gripper_actuator).ctrl[:] = robot.gripper_open
    plain = msgspec.structs.replace(robots[0], name="plain", gripper_actuator="")
    grippers = Grippers(model, [robots[0], plain, robots[1]], ControlConfig(gripper_speed=4.0), 0.002)
    grippers.reset(data)
    return grippers, data, model.actuator("left/gripper").id, model.actuator("right/gripper").id


def test_closing_is_as_fast_as_allowed_and_ends_exactly() -> None:
    grippers, data, left, right = aloha()
    grippers.set_goal(0, 1.0)
    for _ in range(5):
        grippers.tick(data)
    assert data.ctrl[left] == pytest.approx(0.037 - 5 * 0.035 * 4.0 * 0.002)
    for _ in range(130):
        grippers.tick(data)
    assert data.ctrl[left] == 0.002
    assert data.ctrl[right] == 0.037


def test_actuators_of_one_gripper_arrive_together() -> None:
    """The second one closes the other way, over half the stroke."""
    model = aloha_model()
    data = mujoco.MjData(model)
    partner = GripperActuator("right/gripper", 0.002, 0.02)
    robot = msgspec.structs.replace(aloha_robots()[0], gripper_partners=(partner,))
    left, right = model.actuator("left/gripper").id, model.actuator("right/gripper").id
    data.ctrl[[left, right]] = robot.gripper_open, partner.open
    grippers = Grippers(model, [robot], ControlConfig(gripper_speed=4.0), 0.002)
    grippers.reset(data)
    assert grippers.find_output(0, 0.002)[0] == [left, right]
    grippers.set_goal(0, 0.5)
    for _ in range(20):
        grippers.tick(data)
        shares = (data.ctrl[left] - 0.037) / (0.002 - 0.037), (data.ctrl[right] - 0.002) / (0.02 - 0.002)
        assert shares[0] == pytest.approx(shares[1])
    grippers.stop(0)
    assert grippers.goal.tolist() == grippers.ctrl.tolist()
