"""The composition: what is written and what is not, twists, absolute targets, sharing, resets, targets without IK."""

from __future__ import annotations

import math

import msgspec
import mujoco
import numpy as np
import pytest

from anchors.pose import quat_from_rotvec
from iris_session.control import ControlConfig, ControlError, Controller
from iris_session.control.arm_model import read_site_pose
from iris_session.physics import find_robots, load_model
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import ObjectSpec
from iris_session.protocol.steps import Command, ObjectCommand
from tests.control.rigs import (
    PANDA_HOME,
    Rig,
    aloha_model,
    aloha_robots,
    apart,
    decision,
    hold_command,
    old,
    panda_model,
    panda_spec,
    pose_command,
)
from tests.models import MENAGERIE, PANDA

#: No environment moves the arm here, so that the target may lead it by any distance; see `test_hold` for the bound.
TARGETS = ControlConfig(output="targets", target_lead_m=9.0, target_lead_rad=9.0)


def panda(config: ControlConfig | None = None) -> Rig:
    made = Rig(panda_model(), [panda_spec()], config, home=PANDA_HOME)
    made.hold(3)
    return made


def drive(made: Rig, *sources: object, steps: int = 1, **more: object) -> None:
    for _ in range(steps):
        made.step(decision([pose_command("panda", *sources, **more)]))  # type: ignore[arg-type]
        sources = tuple(old(s) for s in sources)  # type: ignore[arg-type]


def twist(made: Rig, v: tuple[float, ...], **more: object) -> Command:
    return Command("panda", "twist", sources=(made.source((0.0,) * 3, pose_world=None, twist_world=v, **more),))


def test_control_must_be_told_where_the_robots_stand() -> None:
    model = panda_model()
    with pytest.raises(ControlError, match=r"call reset\(data\) or restore\(bytes\) first"):
        Controller(model, [panda_spec()]).tick(mujoco.MjData(model))


def test_only_the_ctrl_of_its_own_robots_is_written() -> None:
    rig = Rig(aloha_model(), aloha_robots()[:1])
    right = [rig.model.actuator(f"right/{n}").id for n in ("waist", "elbow", "gripper")]
    rig.data.ctrl[right] = (0.11, 0.22, 0.033)
    for k in range(50):
        rig.step(decision([pose_command("left", rig.source((0.001 * k, 0.0, 0.0)), gripper=0.5)]))
    assert rig.data.ctrl[right].tolist() == [0.11, 0.22, 0.033]
    assert not rig.data.xfrc_applied.any()


def test_a_robot_without_a_command_or_sources_holds_and_unknown_robots_are_refused() -> None:
    rig = panda()
    drive(rig, rig.source((0.0, 0.0, 0.0)), steps=2)
    drive(rig, rig.source((0.1, 0.0, 0.0)), steps=20)
    assert rig.controller._joints.moving
    rig.step(decision([]))
    assert rig.controller._states[0].latch is None
    drive(rig, rig.source((0.0, 0.0, 0.0), engagement=2), steps=2)
    rig.step(decision([Command("panda", "pose")]))
    assert rig.controller._states[0].latch is None
    with pytest.raises(ControlError, match=r"robot 'ur5' is not known. Available robots: panda"):
        rig.step(decision([hold_command("ur5")]))


def test_steps_without_ticks_take_samples_but_move_nothing() -> None:
    rig = panda()
    drive(rig, rig.source((0.0, 0.0, 0.0)))
    ctrl, applied = rig.data.ctrl.copy(), rig.controller.get_status()[0].applied
    last = rig.source((0.05, 0.0, 0.0))
    for source in (rig.source((0.02, 0.0, 0.0)), last, old(last)):
        rig.step(decision([pose_command("panda", source)]), n_ticks=0)
    assert (rig.data.ctrl == ctrl).all()
    assert rig.controller.get_status()[0].applied is applied
    rig.step(decision([pose_command("panda", old(last))]), n_ticks=3)
    now = rig.controller.get_status()[0].applied
    assert now is not None
    assert (now.seq, now.step_ns) == (last.seq, rig.steps * 2_000_000)


def test_the_gripper_follows_and_stays_in_hold() -> None:
    rig = Rig(aloha_model(), aloha_robots())
    gripper = rig.model.actuator("left/gripper").id
    both = [hold_command("right")]
    for _ in range(20):
        rig.step(decision([pose_command("left", rig.source((0.0, 0.0, 0.0)), gripper=1.0), *both]))
    assert 0.002 < rig.data.ctrl[gripper] < 0.036
    before = rig.data.ctrl[gripper]
    rig.hold(50)
    assert rig.data.ctrl[gripper] == before
    for _ in range(200):
        rig.step(decision([pose_command("left", rig.source((0.0, 0.0, 0.0), engagement=2), gripper=1.0), *both]))
    assert rig.data.ctrl[gripper] == 0.002
    for _ in range(20):
        rig.step(decision([pose_command("left", rig.source((0.0, 0.0, 0.0), engagement=2)), *both]))
    assert rig.data.ctrl[gripper] == 0.002  # None: unchanged


def test_a_twist_moves_at_its_speed_and_stops_with_hold() -> None:
    rig = panda()
    start = rig.target()
    command = twist(rig, (0.0, 0.1, 0.0, 0.0, 0.0, 0.2))
    before = rig.data.ctrl.copy()
    rig.step(decision([command]))
    assert (rig.data.ctrl == before).all()
    for _ in range(500):
        rig.step(decision([command]))
    assert np.subtract(rig.target()[0], start[0]) == pytest.approx((0.0, 0.1, 0.0), abs=2e-3)
    assert apart(start, rig.target())[1] == pytest.approx(math.degrees(0.2), abs=0.5)
    rig.hold(100)
    stopped = rig.target()
    rig.hold(100)
    assert apart(rig.target(), stopped)[0] < 2e-4  # it is where the arm stands, which comes to rest
    assert not rig.controller._joints.moving


def test_a_twist_target_does_not_run_away_from_an_arm_that_cannot_follow() -> None:
    rig = panda()
    command = twist(rig, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    for _ in range(1500):
        rig.step(decision([command]))
    state = rig.controller._states[0]
    assert state.latch is not None
    assert apart(rig.controller._ik.compute_tip(0, state), state.latch.target)[0] <= 0.05 + 1e-9
    # A zero twist ends it, and the opposite one works at once.
    back = twist(rig, (-0.2, 0.0, 0.0, 0.0, 0.0, 0.0))
    where = rig.tip()[0][0]
    for _ in range(500):
        rig.step(decision([back]))
    assert rig.tip()[0][0] < where - 0.1


def test_an_absolute_target_is_reached_at_bounded_speed_from_one_sample() -> None:
    rig = panda(ControlConfig(tip_speed=0.25))
    start = rig.target()
    goal = ((start[0][0], start[0][1] + 0.2, start[0][2]), start[1])
    before = rig.data.ctrl.copy()
    drive(rig, rig.source(*goal, absolute=True, device="target"))
    assert (rig.data.ctrl == before).all()
    drive(rig, old(rig.source(*goal, absolute=True, device="target")), steps=150)
    assert 0.02 < rig.target()[0][1] - start[0][1] < 0.3 * 0.25 + 0.02
    drive(rig, old(rig.source(*goal, absolute=True, device="target")), steps=1000)
    assert apart(rig.controller._ik.compute_tip(0, rig.controller._states[0]), goal)[0] < 3e-5


def test_changing_the_scale_while_engaged_does_not_jump() -> None:
    rig = panda()
    start = rig.target()
    drive(rig, rig.source((0.0, 0.0, 0.0)))
    for _ in range(40):
        drive(rig, rig.source((0.1, 0.0, 0.0)), steps=7)
    for _ in range(40):
        drive(rig, rig.source((0.1, 0.0, 0.0)), steps=7, scale=0.1)
    assert np.subtract(rig.target()[0], start[0]) == pytest.approx((0.1, 0.0, 0.0), abs=1e-9)
    for _ in range(40):
        drive(rig, rig.source((0.2, 0.0, 0.0)), steps=7, scale=0.1)
    assert np.subtract(rig.target()[0], start[0]) == pytest.approx((0.11, 0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize("successor", [{"participant": "b"}, {"engagement": 2}, {"device": "hand/left"}])
def test_a_successor_without_a_hold_between_does_not_inherit_the_motion(successor: dict[str, object]) -> None:
    rig = panda()
    drive(rig, rig.source((0.0, 0.0, 0.0)))
    drive(rig, rig.source((0.0, 0.5, 0.0)), steps=30)  # still far from there, and moving fast
    assert np.abs(rig.controller._joints.v).max() > 0.5
    goal = rig.controller._joints.q + rig.controller._joints.v**2 / 80 * np.sign(rig.controller._joints.v)
    for _ in range(40):
        drive(rig, rig.source((3.0, 3.0, 3.0), **successor), steps=7)
    assert rig.data.ctrl == pytest.approx(goal, abs=0.015)
    assert np.abs(rig.controller._joints.v).max() < 0.02  # no more than the elbow on its way to the rest posture


def test_the_workspace_is_kept_and_reported() -> None:
    tip = panda().target()[0]
    box = ((-2.0, -2.0, tip[2] - 0.02), (2.0, 2.0, 2.0))
    rig = panda(ControlConfig(workspaces={"panda": box}))
    drive(rig, rig.source((0.0, 0.0, 0.0)))
    for _ in range(60):
        drive(rig, rig.source((0.0, 0.0, -0.3)), steps=7)
    assert rig.target()[0][2] == pytest.approx(tip[2] - 0.02)
    assert rig.controller.get_status()[0].limits == ("workspace",)


def test_a_robot_that_cannot_get_where_it_is_commanded_is_reported() -> None:
    rig = panda()
    drive(rig, rig.source((0.0, 0.0, 0.0)))
    rig.data.qpos[:] += 0.4  # as if something held it
    mujoco.mj_forward(rig.model, rig.data)
    for _ in range(5):
        rig.controller.tick(rig.data)
    assert rig.controller.get_status()[0].limits == ("tracking",)
    rig.hold(2000)
    assert rig.controller.get_status()[0].limits == ()


def test_reset_forgets_everything() -> None:
    box = """<body name="box" pos="3 0 1"><freejoint/><geom size=".1"/></body>"""
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{box}</worldbody></mujoco>")
    arm = mujoco.MjSpec.from_file(str(PANDA))
    body = arm.worldbody.add_body(name="box", pos=spec.body("box").pos)
    body.add_freejoint()
    body.add_geom(size=[0.1, 0, 0])
    for key in list(arm.keys):
        arm.delete(key)
    rig = Rig(arm.compile(), [panda_spec()], objects=[ObjectSpec("box", "box")], home=PANDA_HOME)
    grasp = (ObjectCommand("box", 1, Pose((3.0, 0.0, 1.5), (1.0, 0.0, 0.0, 0.0))),)
    for k in range(60):
        source = rig.source((0.002 * k, 0.0, 0.0))
        rig.step(decision([pose_command("panda", source)], grasp))
    assert rig.data.body("box").xfrc_applied.any()
    assert rig.data.body("box").xpos[2] > 1.02
    mujoco.mj_resetData(rig.model, rig.data)
    mujoco.mj_forward(rig.model, rig.data)
    rig.controller.reset(rig.data)
    fresh = Rig(rig.model, [panda_spec()], objects=[ObjectSpec("box", "box")])
    assert rig.controller.snapshot() == fresh.controller.snapshot()
    assert rig.controller.get_status()[0].applied is None


def test_a_robot_on_a_moving_base_reaches_world_targets() -> None:
    arm = mujoco.MjSpec.from_file(str(PANDA))
    for key in list(arm.keys):
        arm.delete(key)
    base = arm.body("link0")
    base.add_joint(name="rail", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0])
    rig = Rig(arm.compile(), [panda_spec()], home=PANDA_HOME)
    goal = rig.target()
    for k in range(700):
        rig.data.joint("rail").qpos[:] = 0.0002 * k
        rig.data.joint("rail").qvel[:] = 0.1
        mujoco.mj_forward(rig.model, rig.data)
        rig.step(decision([pose_command("panda", rig.source(*goal, absolute=True, new=k % 7 == 0))]))
    state = rig.controller._states[0]
    assert state.T_world_root[0][0] == pytest.approx(0.139, abs=2e-3)
    assert apart(rig.controller._ik.compute_tip(0, state), goal)[0] < 5e-3  # follows at 0.1 m/s


def test_targets_without_ik_move_at_bounded_speed() -> None:
    rig = panda(TARGETS)
    rig.data.ctrl[:] = PANDA_HOME
    rig.hold(500)
    start, ctrl = rig.target(), rig.data.ctrl.copy()
    drive(rig, rig.source((0.0, 0.0, 0.0)))
    assert rig.target() == start
    drive(rig, rig.source((0.0, 0.3, 0.0), quat_from_rotvec((0.0, 0.0, 0.2))), steps=50)
    assert rig.target()[0][1] - start[0][1] == pytest.approx(50 * 0.002 * 1.5)
    drive(rig, rig.source((0.0, 0.3, 0.0), quat_from_rotvec((0.0, 0.0, 0.2))), steps=100)
    assert rig.target()[0][1] - start[0][1] == pytest.approx(0.3)
    assert apart(start, rig.target())[1] == pytest.approx(math.degrees(0.2))
    applied = rig.controller.get_status()[0].applied
    assert applied is not None
    assert applied.seq == rig.seq
    held = rig.target()
    rig.hold(10)
    assert rig.target() == held
    for _ in range(251):
        rig.step(decision([twist(rig, (0.0, 0.0, -0.2, 0.0, 0.0, 0.0), engagement=2)]))
    assert rig.target()[0][2] - held[0][2] == pytest.approx(-0.1, abs=1e-3)
    q = np.add(PANDA_HOME, 0.02)
    rig.hold(1)
    joints = Command("panda", "joints", sources=(rig.source((0.0,) * 3, pose_world=None, q=tuple(q), engagement=3),))
    for _ in range(400):
        rig.step(decision([joints]))
    data = mujoco.MjData(rig.model)
    data.qpos[:] = q
    mujoco.mj_kinematics(rig.model, data)
    assert apart(read_site_pose(data, 0), rig.target())[0] < 1e-9
    assert (rig.data.ctrl == ctrl).all()


def test_a_snapshot_of_other_robots_is_refused() -> None:
    two, one = Rig(aloha_model(), aloha_robots()), Rig(aloha_model(), aloha_robots()[:1])
    with pytest.raises(ControlError, match="snapshot is of 1 robots with 6 joints; this controller has 2 with 12"):
        two.controller.restore(one.controller.snapshot())
    with pytest.raises(msgspec.DecodeError):
        two.controller.restore(b"\x00")


def test_a_hand_follows_joints_and_no_pose() -> None:
    """Each finger is a chain of its own; the palm has no joint."""
    model = load_model(MENAGERIE / "leap_hand" / "scene_right.xml")
    (hand,) = find_robots(model).robots
    made = Rig(model, [hand])
    made.hold(500)
    before = made.data.ctrl.copy()
    for k in range(20):
        made.step(decision([pose_command(hand.name, made.source((0.01 * k, 0.0, 0.0)))]))
    assert made.data.ctrl == pytest.approx(before, abs=1e-5)
    assert made.controller.get_status()[0].limits == ("joints_only",)
    made.hold(5)
    goal = tuple(0.1 for _ in hand.joints)
    for k in range(300):
        source = made.source((0.0, 0.0, 0.0), engagement=2, pose_world=None, q=goal, device="joints", new=k < 2)
        made.step(decision([Command(hand.name, "joints", sources=(source,))]))
    joints = [int(model.joint(name).qposadr[0]) for name in hand.joints]
    assert made.data.qpos[joints] == pytest.approx(np.full(16, 0.1), abs=2e-3)
