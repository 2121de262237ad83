"""Soft position servos reach their target, with and without a payload, never push harder than before, and say what is
left.
"""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iris_session.bench.stop import make_wall_model, make_wall_robot, measure_push, remove_wall
from iris_session.control import ControlConfig, Controller
from tests.control.rigs import PANDA_HOME, Rig, apart, decision, old, panda_spec, pose_command
from tests.models import PANDA

WITHOUT = ControlConfig(compensate_sag=False)


@cache
def soft_model(room: float = 0.0) -> mujoco.MjModel:
    """A Panda with servos ten times softer than its own: the shoulder sags by 3 deg. `room`: for commands [rad]."""
    spec = mujoco.MjSpec.from_file(str(PANDA))
    spec.option.timestep = 0.002
    for key in list(spec.keys):
        spec.delete(key)
    for actuator, home in zip(spec.actuators, PANDA_HOME, strict=True):
        actuator.set_to_position(kp=400.0, kv=50.0)
        if room:
            actuator.ctrlrange = [home - room, home + room]
    return spec.compile()


def soft_arm(config: ControlConfig | None = None, room: float = 0.0) -> Rig:
    rig = Rig(soft_model(room), [panda_spec()], config, home=PANDA_HOME)
    rig.hold(500)
    return rig


def load(rig: Rig, newtons: float) -> None:
    rig.data.xfrc_applied[rig.model.body("link7").id, 2] = -newtons


def drive(rig: Rig, z: float, steps: int, *, begin: float = 0.0, engagement: int = 1) -> None:
    """The hand moves from `begin` up to `z` [m] within 0.5 s, at 71 Hz, and then stands."""
    robot, source = rig.robots[0].name, None
    for k in range(steps):
        if k % 7 == 0 or source is None:
            p = (0.0, 0.0, begin + (z - begin) * min(1.0, k / 250))
            source = rig.source(p, engagement=engagement)
        rig.step(decision([pose_command(robot, source)]))
        source = old(source)


def limits(rig: Rig) -> tuple[str, ...]:
    return rig.controller.get_status()[0].limits


@pytest.mark.parametrize("payload", [0.0, 10.0])
def test_a_soft_arm_reaches_its_target_and_keeps_it_when_let_go(payload: float) -> None:
    left = {}
    for name, config in (("with", None), ("without", WITHOUT)):
        rig = soft_arm(config)
        start = rig.tip()
        drive(rig, 0.01, 300)
        load(rig, payload)  # as taken up by the gripper, and lifted
        drive(rig, 0.1, 1250, begin=0.01)
        left[name] = 1e3 * float(np.linalg.norm(np.subtract(rig.tip()[0], start[0]) - (0.0, 0.0, 0.1)))
        if name == "with":
            assert limits(rig) == ()
            rig.hold(50)
            before, ctrl = rig.tip(), rig.data.ctrl.copy()
            rig.hold(1000)
            assert apart(before, rig.tip())[0] < 1e-3
            assert (rig.data.ctrl == ctrl).all()
    assert left["with"] <= 5.0 < left["without"]


def test_an_engagement_changes_no_ctrl_and_a_hand_that_stands_moves_nothing() -> None:
    rig = soft_arm()
    start, ctrl = rig.tip(), rig.data.ctrl.tobytes()
    rig.step(decision([pose_command("panda", rig.source((4.0, 5.0, 6.0)))]))
    assert rig.data.ctrl.tobytes() == ctrl
    assert apart(rig.target(), start)[0] < 1e-4  # latched where it is measured, not where `ctrl` is
    for _ in range(500):
        rig.step(decision([pose_command("panda", rig.source((4.0, 5.0, 6.0)))]))
    assert apart(rig.tip(), start)[0] < 2e-4


def test_no_joint_is_commanded_faster_than_its_limit() -> None:
    rig = Rig(soft_model(), [panda_spec()], home=PANDA_HOME)  # not sagged yet: the whole support has to come
    rig.hold(1)
    before, before_v = rig.data.ctrl.copy(), np.zeros(7)
    for k in range(600):
        rig.step(decision([pose_command("panda", rig.source((0.0, 0.0, 1e-3 * min(k, 300))))]))
        v = (rig.data.ctrl - before) / 0.002
        assert np.abs(v).max() <= 2.5 + 1e-9
        assert np.abs(v - before_v).max() <= 40.0 * 0.002 + 1e-9
        before, before_v = rig.data.ctrl.copy(), v


def weak_rig(kind: str = "position_weak", timestep: float = 0.002) -> Rig:
    model = make_wall_model(kind)
    model.opt.timestep = timestep
    rig = Rig(model, [make_wall_robot(kind)])
    rig.hold(100)
    return rig


@settings(max_examples=12, deadline=None)
@given(
    st.sampled_from(["position", "position_weak", "position_filtered"]), st.floats(0.05, 0.6), st.floats(-15.0, 15.0)
)
def test_a_blocked_arm_never_pushes_above_the_static_bound(kind: str, depth: float, load: float) -> None:
    """Also when the hand moves on and on in little ways, and with a load that was learned before."""
    rig = weak_rig(kind)
    rig.data.xfrc_applied[rig.model.body("link3").id, 2] = load
    hold = rig.controller._hold
    assert hold is not None
    source, touched = None, False
    for k in range(1500):
        if k % 7 == 0 or source is None:
            source = rig.source((0.0, depth * min(1.0, k / 500) + 0.01 * ((k // 100) % 2), 0.02 * min(1.0, k / 100)))
        rig.controller.begin(k, 1, decision([pose_command("arm", source)]), None)  # type: ignore[arg-type]
        rig.controller.tick(rig.data)
        x, v, droop = hold.measure(rig.data)
        lead, bound = rig.controller._joints.q - x, hold.static + hold.servos.lag * np.abs(v) + 1e-9
        assert (lead <= np.maximum(droop, 0.0) + bound).all()
        assert (lead >= np.minimum(droop, 0.0) - bound).all()
        mujoco.mj_step2(rig.model, rig.data)
        mujoco.mj_step1(rig.model, rig.data)
        touched |= rig.data.ncon > 0
        source = old(source)
    assert touched == (depth > 0.3) or depth < 0.3


def test_who_presses_against_an_arm_that_stands_is_pressed_back_no_harder_as_time_passes() -> None:
    rig = weak_rig()
    remove_wall(rig.data)
    drive(rig, 0.02, 1200)
    start, elbow = rig.tip(), 2
    rig.data.qfrc_applied[elbow] = -4.0
    drive(rig, 0.02, 250, begin=0.02)
    first = measure_push(rig.data)[elbow]
    away = apart(start, rig.tip())[0]
    drive(rig, 0.02, 2500, begin=0.02)
    assert measure_push(rig.data)[elbow] == pytest.approx(first, abs=0.05)
    assert apart(start, rig.tip())[0] == pytest.approx(away, abs=1e-3)
    rig.data.qfrc_applied[elbow] = 0.0
    drive(rig, 0.02, 500, begin=0.02)
    assert apart(start, rig.tip())[0] < 1e-3


@pytest.mark.parametrize("moved_before", [False, True])
def test_who_leans_on_an_arm_before_it_is_engaged_is_not_pressed_back_harder(moved_before: bool) -> None:
    rig = soft_arm()
    if moved_before:
        drive(rig, 0.02, 350)  # let go while it would still learn
    load(rig, 20.0)
    rig.hold(500)
    leant_on = rig.tip()
    drive(rig, 0.0, 1500, engagement=2)
    assert apart(rig.tip(), leant_on)[0] < 1e-3
    load(rig, 0.0)
    drive(rig, 0.0, 1500, engagement=2)
    assert apart(rig.tip(), rig.target())[0] < 3e-3


def test_an_arm_that_stands_comes_back_when_its_payload_is_put_down() -> None:
    rig = soft_arm()
    drive(rig, 0.01, 300)
    load(rig, 20.0)
    drive(rig, 0.03, 1500, begin=0.01)
    load(rig, 0.0)
    drive(rig, 0.03, 200, begin=0.03)
    assert apart(rig.tip(), rig.target())[0] > 0.02
    drive(rig, 0.03, 1000, begin=0.03)
    assert apart(rig.tip(), rig.target())[0] < 3e-3
    assert limits(rig) == ()


def test_who_lifts_an_arm_shortly_does_not_take_its_payload() -> None:
    rig = soft_arm()
    drive(rig, 0.01, 300)
    load(rig, 20.0)
    drive(rig, 0.03, 1500, begin=0.01)
    for _ in range(5):
        load(rig, 0.0)
        drive(rig, 0.03, 150, begin=0.03)
        load(rig, 20.0)
        drive(rig, 0.03, 150, begin=0.03)
    drive(rig, 0.03, 300, begin=0.03)
    assert apart(rig.tip(), rig.target())[0] < 3e-3


@pytest.mark.parametrize("timestep", [0.002, 0.01])
def test_what_an_arm_learned_while_it_pressed_is_forgotten(timestep: float) -> None:
    rig = weak_rig(timestep=timestep)
    for y in np.linspace(0.0, 0.5, round(0.8 / timestep)):
        rig.step(decision([pose_command("arm", rig.source((0.0, float(y), 0.0)))]))
    for _ in range(round(3.0 / timestep)):
        rig.step(decision([pose_command("arm", rig.source((0.0, 0.5, 0.0)))]))
    assert rig.data.ncon > 0
    assert "tracking" in limits(rig)
    assert rig.controller._hold is not None
    assert np.abs(rig.controller._hold.load).max() < 0.02


def test_what_an_actuator_cannot_give_is_said_as_sag() -> None:
    rig = soft_arm(room=0.1)
    drive(rig, 0.02, 600)
    assert limits(rig) == ()
    load(rig, 40.0)
    drive(rig, 0.05, 1000, begin=0.02)
    assert "sag" in limits(rig)
    load(rig, 0.0)
    drive(rig, 0.02, 1500, begin=0.05)
    assert "sag" not in limits(rig)
    rig.hold(10)
    assert limits(rig) == ()


@pytest.mark.parametrize("put_down", [False, True])
def test_a_restored_controller_goes_on_bit_for_bit_while_it_learns(put_down: bool) -> None:
    rig = soft_arm()
    load(rig, 10.0)
    drive(rig, 0.05, 550)
    if put_down:
        drive(rig, 0.05, 1200, begin=0.05)
        load(rig, 0.0)
        drive(rig, 0.05, 200, begin=0.05)  # not yet certain of it
    assert rig.controller._hold is not None
    assert rig.controller._hold.load.any()
    state = np.empty(mujoco.mj_stateSize(rig.model, mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_getState(rig.model, rig.data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    snapshot, seen = rig.controller.snapshot(), []
    for restored in (False, True):
        mujoco.mj_setState(rig.model, rig.data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_step1(rig.model, rig.data)
        if restored:
            rig.controller = Controller(rig.model, rig.robots)
            rig.controller.restore(snapshot)
        assert rig.controller.snapshot() == snapshot
        seq, steps = rig.seq, rig.steps
        drive(rig, 0.05, 400, begin=0.05)
        rig.hold(100)
        seen.append(rig.data.qpos.tobytes() + rig.data.ctrl.tobytes() + rig.controller.snapshot())
        rig.seq, rig.steps = seq, steps
    assert seen[0] == seen[1]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_arm_with_few_joints_gives_up_its_orientation_not_its_position(axis: int) -> None:
    left = {}
    for cost in (0.01, None):
        rig = Rig(make_wall_model("position"), [make_wall_robot("position")], few_joints(cost))
        remove_wall(rig.data)
        rig.hold(100)
        start, goal = rig.tip()[0], 0.05 * np.eye(3)[axis]
        for k in range(700):
            p = goal * min(1.0, k / 200)
            rig.step(decision([pose_command("arm", rig.source(tuple(p.tolist())))]))
        left[cost] = 1e3 * float(np.linalg.norm(np.subtract(rig.tip()[0], start) - goal))
    assert left[0.01] <= 5.0 < left[None]


def few_joints(cost: float | None) -> ControlConfig:
    return ControlConfig(few_joints_orientation_cost=cost)
