"""Inverse kinematics at its rates: convergence over several solves, order of robots, limits and their names."""

from __future__ import annotations

import numpy as np
import pytest

from anchors.pose import Vec3, quat_from_rotvec
from iris_session.control import ControlConfig
from tests.control.rigs import (
    PANDA_HOME,
    Rig,
    apart,
    decision,
    hold_command,
    old,
    panda_arms,
    panda_model,
    panda_spec,
    pose_command,
)


def rig(config: ControlConfig | None = None) -> Rig:
    made = Rig(panda_model(), [panda_spec()], config, home=PANDA_HOME)
    made.hold(5)
    return made


def count_solves(made: Rig) -> list[tuple[int, int]]:
    """Records (tick, robot) of every solve from now on."""
    solves: list[tuple[int, int]] = []
    solve = made.controller._ik.solve

    def counted(i, r, state, tick):  # type: ignore[no-untyped-def]
        solves.append((tick, i))
        solve(i, r, state, tick)

    made.controller._ik.solve = counted  # type: ignore[method-assign]
    return solves


def test_one_far_sample_converges_over_several_solves_at_bounded_speed() -> None:
    made = rig()
    start = made.target()
    first, far = made.source((0.0, 0.0, 0.0)), made.source((0.05, 0.25, -0.1))
    made.step(decision([pose_command("panda", first)]))
    solves = count_solves(made)
    previous, fastest = made.data.ctrl.copy(), 0.0
    for k in range(600):
        made.step(decision([pose_command("panda", far if k == 0 else old(far))]))
        fastest = max(fastest, float(np.abs(made.data.ctrl - previous).max()) / 0.002)
        previous = made.data.ctrl.copy()
    goal = ((start[0][0] + 0.05, start[0][1] + 0.25, start[0][2] - 0.1), start[1])
    reached = made.controller._ik.compute_tip(0, made.controller._states[0])
    assert apart(reached, goal)[0] < 3e-5
    assert apart(made.target(), goal)[0] < 1e-12
    assert 1.0 < fastest <= 2.5 + 1e-6
    assert 8 < len(solves) < 60  # and then it stopped
    assert made.controller.get_status()[0].limits == ()


def test_solves_are_at_most_100_hz_per_robot_and_two_a_tick_and_all_robots_get_theirs() -> None:
    model, robots = panda_arms([(1.5 * (i % 4), 1.5 * (i // 4), 0.0) for i in range(8)])
    made = Rig(model, robots, home=PANDA_HOME)
    solves = count_solves(made)
    for k in range(400):  # a new sample of everybody in every step: five times as many as may be solved
        x = 0.1 * np.sin(0.01 * k)
        made.step(decision(pose_command(r.name, made.source((x, 0.0, 0.0))) for r in robots))
    ticks = np.array([t for t, _ in solves])
    assert np.bincount(ticks).max() == 2
    assert np.bincount(ticks)[::5].max() <= 1  # ticks in which distances between robots are checked too
    for i in range(8):
        own = np.array([t for t, robot in solves if robot == i])
        assert np.diff(own).min() >= 5  # 10 ms
        assert np.diff(own).max() <= 6
        assert len(own) > 70


@pytest.mark.parametrize(("n", "tick_s", "interval_ticks"), [(4, 0.005, 2), (12, 0.002, 5)])
def test_long_ticks_and_many_robots_starve_nobody(n: int, tick_s: float, interval_ticks: int) -> None:
    """A robot that is solved less often than its device sends moves slower than its hand."""
    model, robots = panda_arms([(1.5 * (i % 4), 1.5 * (i // 4), 0.0) for i in range(n)])
    model.opt.timestep = tick_s
    made = Rig(model, robots, home=PANDA_HOME)
    solves = count_solves(made)
    for k in range(40):
        made.step(decision(pose_command(r.name, made.source((0.001 * k, 0.0, 0.0))) for r in robots))
    assert np.bincount([t for t, _ in solves]).max() <= 3
    for i in range(n):
        own = [t for t, robot in solves if robot == i]
        assert np.diff(own)[1:].max() <= interval_ticks + 1
        assert np.diff(own)[1:].mean() < interval_ticks + 0.2


def test_a_new_sample_is_solved_in_its_own_tick() -> None:
    made = rig()
    made.step(decision([pose_command("panda", made.source((0.0, 0.0, 0.0)))]))
    for k in range(1, 100):
        source = made.source((0.001 * k, 0.0, 0.0), new=True)
        made.step(decision([pose_command("panda", source)]))
        applied = made.controller.get_status()[0].applied
        assert applied is not None
        assert (applied.seq, applied.step_ns) == (source.seq, made.steps * 2_000_000)
        assert (applied.robot, applied.participant, applied.device) == ("panda", "p1", "controller/right")
        for _ in range(6):
            made.step(decision([pose_command("panda", old(source))]))
        assert made.controller.get_status()[0].applied is applied


def test_out_of_reach_is_reported_and_solving_ends_until_the_hand_comes_back() -> None:
    made = rig()
    far = [made.source((0.0, 0.0, 0.0)), made.source((3.0, 0.0, 0.0))]
    made.step(decision([pose_command("panda", far[0])]))
    made.step(decision([pose_command("panda", far[1])]))
    for _ in range(1500):
        made.step(decision([pose_command("panda", old(far[1]))]))
    limits = made.controller.get_status()[0].limits
    assert "reach" in limits
    solves = count_solves(made)
    for _ in range(100):
        made.step(decision([pose_command("panda", old(far[1]))]))
    assert solves == []
    back = made.source((0.0, 0.0, 0.0))
    made.step(decision([pose_command("panda", back)]))
    for _ in range(1500):
        made.step(decision([pose_command("panda", old(back))]))
    assert "reach" not in made.controller.get_status()[0].limits
    made.step(decision([hold_command("panda")]))
    assert made.controller.get_status()[0].limits == ()


@pytest.mark.parametrize(
    ("aim", "turn", "expected"),
    [
        ((-0.3, 0.0, -0.9), (0.0, 0.0, 3.0), {"joint2"}),
        ((-0.5, 0.0, -0.3), (0.0, 0.0, 0.0), {"joint4"}),
        ((0.0, 0.0, 0.0), (0.0, 2.0, 0.0), {"joint6"}),
    ],
)
def test_joint_limits_hold_and_are_named(aim: Vec3, turn: Vec3, expected: set[str]) -> None:
    made = rig()
    made.step(decision([pose_command("panda", made.source((0.0, 0.0, 0.0)))]))
    far, named = made.source(aim, quat_from_rotvec(turn)), set()
    for k in range(1000):
        made.step(decision([pose_command("panda", far if k == 0 else old(far))]))
        named |= {name for name in made.controller.get_status()[0].limits if name.startswith("joint")}
        q = made.controller._joints.q
        assert (q >= made.model.jnt_range[:, 0] - 1e-9).all()
        assert (q <= made.model.jnt_range[:, 1] + 1e-9).all()
    assert named >= expected


def test_a_robot_that_starts_outside_its_range_is_not_thrown_back() -> None:
    made = Rig(panda_model(), [panda_spec()], home=(0.0, -0.16, 0.0, -3.15, 0.0, 2.99, 0.785))  # joint4 ends at -3.0718
    made.hold(3)
    source = made.source((0.0, 0.0, 0.0))
    made.step(decision([pose_command("panda", source)]))
    before = made.data.ctrl.copy()
    made.step(decision([pose_command("panda", made.source((0.0, 0.0, 0.001)))]))
    assert np.abs(made.data.ctrl - before).max() < 2.5 * 0.002
    assert "joint4" in made.controller.get_status()[0].limits
