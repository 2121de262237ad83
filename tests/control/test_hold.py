"""Holds and anti-windup: a blocked arm does not wind up, is let go, does not lunge, and never creeps.

That every cause of a hold lets go of what the arm presses is in `tests/bench/test_stop.py`.
"""

from __future__ import annotations

import copy
from functools import cache

import mujoco
import numpy as np
import pytest

from iris_session.bench.stop import KINDS, make_wall_model, make_wall_robot, measure_push, remove_wall
from iris_session.control import ControlConfig, Controller
from iris_session.protocol.names import HoldReason
from iris_session.protocol.steps import Command, Decision, FixedView
from tests.control.rigs import Rig, decision, hold_command, old, pose_command


def wall(kind: str) -> Rig:
    rig = Rig(make_wall_model(kind), [make_wall_robot(kind)])
    rig.hold(100)
    return rig


def drive(rig: Rig, y: float, steps: int, *, begin: float = 0.0, engagement: int = 1, **more: object) -> None:
    """The hand moves from `begin` to `y` [m] within half the steps, 71 Hz of samples, and then stands."""
    source = None
    for k in range(steps):
        if k % 7 == 0 or source is None:
            p = (0.0, begin + (y - begin) * min(1.0, 2.0 * k / steps), 0.0)
            source = rig.source(p, engagement=engagement)
        rig.step(decision([pose_command("arm", source, **more)]))
        source = old(source)


def press(rig: Rig, engagement: int = 1) -> float:
    """Press the arm against the wall for a second; the greatest joint torque beyond gravity."""
    drive(rig, 0.0, 20, engagement=engagement)
    drive(rig, 0.6, 800, engagement=engagement, gripper=0.5)
    assert rig.data.ncon > 0
    return float(np.abs(measure_push(rig.data)).max())


@cache
def _press_once(kind: str) -> tuple[Rig, float, bytes]:
    rig = wall(kind)
    force = press(rig)
    return rig, force, rig.controller.snapshot()


def pressed(kind: str) -> tuple[Rig, float]:
    """Return a rig of its own whose arm presses against the wall, and the force."""
    first, force, snapshot = _press_once(kind)
    rig = copy.copy(first)
    rig.model, rig.data = copy.copy(first.model), copy.copy(first.data)
    rig.controller = Controller(rig.model, rig.robots)
    rig.controller.restore(snapshot)
    return rig, force


def hold(rig: Rig, steps: int, reason: str = HoldReason.CLUTCH_OPEN) -> None:
    for _ in range(steps):
        rig.step(Decision((Command("arm", "hold", reason),), estop=reason == HoldReason.ESTOP))


def lunge(rig: Rig, steps: int = 300) -> float:
    """How far a joint moves once the wall is gone."""
    remove_wall(rig.data)
    q, worst = rig.data.qpos[:3].copy(), 0.0
    for _ in range(steps):
        hold(rig, 1)
        worst = max(worst, float(np.abs(rig.data.qpos[:3] - q).max()))
    return worst


@pytest.mark.parametrize("kind", KINDS)
def test_a_commanded_joint_does_not_wind_up_against_an_obstacle(kind: str) -> None:
    rig, _ = pressed(kind)
    worst = np.abs(rig.controller._joints.q - rig.data.qpos[:3]).max()
    assert worst <= 0.15 + 0.08  # 60 ms at 2.5 rad/s, and the weakest servo's droop
    assert "tracking" in rig.controller.get_status()[0].limits


def test_the_activation_of_a_blocked_integrator_does_not_wind_up_either() -> None:
    """The force limit hides it: an activation that leads by radians pushes no harder, but comes back later."""
    rig = wall("integrated_velocity")
    press(rig)
    drive(rig, 0.6, 1000, begin=0.6)
    assert np.abs(rig.data.act - rig.data.qpos[:3]).max() <= 0.15 + 0.08


@pytest.mark.parametrize("kind", KINDS)
def test_a_restored_controller_lets_go_too(kind: str) -> None:
    rig, force = pressed(kind)
    snapshot = rig.controller.snapshot()
    rig.controller = Controller(rig.model, rig.robots)
    rig.controller.restore(snapshot)
    hold(rig, 20)
    snapshot = rig.controller.snapshot()  # while the arm still gives way
    rig.controller = Controller(rig.model, rig.robots)
    rig.controller.restore(snapshot)
    hold(rig, 80)
    assert np.abs(measure_push(rig.data)).max() <= 0.3 * force
    assert lunge(rig) <= 0.03


@pytest.mark.parametrize("kind", KINDS)
def test_the_last_ctrl_of_a_session_does_not_push(kind: str) -> None:
    rig, force = pressed(kind)
    rig.controller.write_rest(rig.data)
    for _ in range(100):
        mujoco.mj_step2(rig.model, rig.data)
        mujoco.mj_step1(rig.model, rig.data)
    if kind in ("integrated_velocity", "gravity_pd"):  # these need a law that runs: their last ctrl is only bounded
        return
    assert np.abs(measure_push(rig.data)).max() <= 0.6 * force  # the wall, pressed in, gives a part of it back


@pytest.mark.parametrize("kind", KINDS)
def test_an_emergency_stop_lets_go_of_what_came_into_a_held_arm(kind: str) -> None:
    rig = wall(kind)
    drive(rig, 0.0, 20)
    drive(rig, 0.03, 300)
    hold(rig, 300)
    for _ in range(200):  # the wall comes on, 0.1 m in 0.4 s
        rig.data.mocap_pos[0, 1] -= 0.0005
        hold(rig, 1)
    hold(rig, 100)
    force = float(np.abs(measure_push(rig.data)).max())
    assert force > 2.0
    hold(rig, 100, HoldReason.ESTOP)
    assert np.abs(measure_push(rig.data)).max() <= max(0.3 * force, 1.0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_free_arm_stops_from_where_it_is_measured(kind: str) -> None:
    rig = wall(kind)
    remove_wall(rig.data)
    drive(rig, 0.0, 20)
    for k in range(150):
        rig.step(decision([pose_command("arm", rig.source((0.0, 0.0024 * k, 0.0)))]))
    q, v = rig.data.qpos[:3].copy(), rig.data.qvel[:3].copy()
    assert np.abs(v).max() > 1.0
    way = np.zeros(3)
    for _ in range(300):
        hold(rig, 1)
        way = np.maximum(way, np.sign(v) * (rig.data.qpos[:3] - q))
    # v^2 / 2 a within 40 rad/s^2, and what a servo of 12 Nms/rad or a filter of 30 ms cannot brake any better.
    assert (way <= v * v / 80.0 + 0.03 * np.abs(v) + 0.01).all()
    assert np.abs(rig.data.qvel[:3]).max() < 0.05


@pytest.mark.long
@pytest.mark.parametrize("load", [0.0, -15.0])
@pytest.mark.parametrize("kind", KINDS)
def test_holds_that_begin_again_and_again_do_not_make_the_arm_creep_down(kind: str, load: float) -> None:
    """Also under a load that the model does not know: 15 N at the hand, six times the dead band of the weak servo."""
    rig = wall(kind)
    remove_wall(rig.data)
    rig.data.xfrc_applied[rig.model.body("link3").id, 2] = load
    heights = []
    for cycle in range(1, 21):
        for _ in range(2):
            drive(rig, 0.002 * (-1) ** cycle, 20, engagement=cycle)  # a hand that never stands quite still
        drive(rig, 0.0, 60, engagement=cycle)
        hold(rig, 120)
        heights.append(rig.tip()[0][2])
    assert heights[2] - heights[-1] < 1e-3
    assert load or heights[0] - heights[-1] < 1e-3


def test_without_a_push_a_hold_changes_nothing_bitwise() -> None:
    rig = wall("position_weak")
    hold(rig, 500)
    for engagement in range(1, 6):
        before = rig.data.ctrl[:3].tobytes()
        rig.step(decision([pose_command("arm", rig.source((1.0, 2.0, 3.0), engagement=engagement))]))
        assert rig.data.ctrl[:3].tobytes() == before
        hold(rig, 50)
        assert rig.data.ctrl[:3].tobytes() == before


def test_a_held_arm_yields_to_a_strong_push_and_stays_there() -> None:
    rig = wall("position_weak")
    remove_wall(rig.data)
    drive(rig, 0.0, 20)
    hold(rig, 150)
    start = rig.data.qpos[0]
    rig.data.qfrc_applied[0] = 40.0
    hold(rig, 200)
    moved = rig.data.qpos[0] - start
    assert moved > 0.4
    rig.data.qfrc_applied[0] = 0.0
    hold(rig, 500)
    assert rig.data.qpos[0] - start > moved - 0.3


@pytest.mark.parametrize("kind", ["position", "gravity_pd"])
def test_a_user_loop_with_many_ticks_a_round_is_not_slowed_down(kind: str) -> None:
    """20 ticks of control on one measured state: the bound widens with the age of the measurement."""
    one, twenty = wall(kind), wall(kind)
    for rig, n in ((one, 1), (twenty, 20)):
        remove_wall(rig.data)
        drive(rig, 0.0, 21)
        for k in range(400 // n):
            p = (0.0, 0.001 * n * k, 0.0)
            rig.controller.begin(0, n, decision([pose_command("arm", rig.source(p))]), FixedView())
            if n == 1:
                rig.controller.tick(rig.data)
            else:
                for _ in range(n):
                    rig.controller.tick(rig.data)
            for _ in range(n):
                mujoco.mj_step2(rig.model, rig.data)
                mujoco.mj_step1(rig.model, rig.data)
    assert abs(twenty.tip()[0][1] - one.tip()[0][1]) < 0.06  # one round of 40 ms at 0.5 m/s, three times


# --- environments that read targets -----------------------------------------------------------------------------------


def targets() -> Rig:
    rig = Rig(make_wall_model("position"), [make_wall_robot("position")], ControlConfig(output="targets"))
    mujoco.mj_forward(rig.model, rig.data)
    return rig


def test_a_target_does_not_run_away_from_a_tip_that_cannot_follow() -> None:
    rig = targets()
    for k in range(400):
        rig.step(decision([pose_command("arm", rig.source((0.0, 0.002 * k, 0.0)))]))
    assert np.linalg.norm(np.subtract(rig.target()[0], rig.tip()[0])) <= 0.05 + 0.2 * 0.1


def test_a_hold_takes_the_target_back_to_a_blocked_tip_once() -> None:
    rig = targets()
    rig.data.qvel[:] = 0.0
    for k in range(400):
        rig.controller.begin(0, 1, decision([pose_command("arm", rig.source((0.0, 0.002 * k, 0.0)))]), FixedView())
        rig.controller.tick(rig.data)
    for _ in range(200):
        rig.controller.begin(0, 1, decision([hold_command("arm")]), FixedView())
        rig.controller.tick(rig.data)
    assert np.linalg.norm(np.subtract(rig.target()[0], rig.tip()[0])) <= 1e-5
