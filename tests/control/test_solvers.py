"""One step of inverse kinematics: convergence, bounds and singular postures with each solver, and that both agree."""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anchors.pose import quat_from_rotvec
from iris_session.control import ControlConfig
from iris_session.control.arm_model import ArmModel, Floats
from iris_session.control.config import SOLVER_AUTO, SOLVER_MINK, SOLVER_NUMPY
from iris_session.control.solvers import IkSolver, make_solver, minimize_in_box, name_solver
from tests.control.rigs import (
    PANDA_HOME,
    Rig,
    apart,
    decision,
    old,
    panda_model,
    panda_spec,
    pose_command,
)

FREE = np.full(7, 0.1)
HOME = np.array(PANDA_HOME)
each_solver = pytest.mark.parametrize("name", [SOLVER_MINK, SOLVER_NUMPY])
bounds = st.lists(st.floats(0.0, 0.1), min_size=7, max_size=7).map(np.array)
offsets = st.lists(st.floats(-1.5, 1.5), min_size=7, max_size=7).map(np.array)


def make_arm() -> ArmModel:
    return ArmModel(panda_model(), panda_spec())


def solver_of(arm: ArmModel, name: str) -> IkSolver:
    return make_solver(arm, ControlConfig(solver=name))


@each_solver
def test_reachable_poses_converge_to_within_a_hair(name: str) -> None:
    arm = make_arm()
    solver, rng = solver_of(arm, name), np.random.default_rng(3)
    for _ in range(20):
        goal = arm.forward_kinematics(HOME + rng.uniform(-0.3, 0.3, 7))
        q = HOME.copy()
        for _ in range(25):
            q = solver.step(q, HOME, goal, -FREE, FREE).q
        distance, angle = apart(arm.forward_kinematics(q), goal)
        assert distance < 1e-4
        assert angle < 0.02


@each_solver
def test_joints_in_another_order_than_the_chains_give_the_same_motion(name: str) -> None:
    robot = panda_spec()
    turned = msgspec.structs.replace(robot, joints=robot.joints[3:] + robot.joints[:3])
    arm, other = make_arm(), ArmModel(panda_model(), turned)
    q, rest, goal = HOME + 0.1, HOME - 0.05, arm.forward_kinematics(HOME + np.linspace(-0.1, 0.2, 7))
    lower, upper = np.linspace(-0.01, -0.07, 7), np.linspace(0.08, 0.02, 7)
    direct = solver_of(arm, name).step(q, rest, goal, lower, upper).q
    order = [3, 4, 5, 6, 0, 1, 2]
    mixed = solver_of(other, name).step(q[order], rest[order], goal, lower[order], upper[order]).q
    assert mixed.tobytes() == direct[order].tobytes()


@each_solver
def test_a_stretched_arm_is_reported_as_singular(name: str) -> None:
    arm, straight = make_arm(), np.zeros(7)
    solver = solver_of(arm, name)
    assert solver.step(straight, straight, arm.forward_kinematics(straight), -FREE, FREE).singular
    assert not solver.step(HOME, HOME, arm.forward_kinematics(HOME), -FREE, FREE).singular


@each_solver
def test_a_program_without_solution_leaves_the_joints(name: str) -> None:
    arm = make_arm()
    step = solver_of(arm, name).step(HOME, HOME, arm.forward_kinematics(HOME + 0.1), FREE, -FREE)
    assert (step.q == HOME).all()
    assert step.singular


@each_solver
def test_the_way_to_a_target_gets_shorter_in_every_step(name: str) -> None:
    arm = make_arm()
    solver, q = solver_of(arm, name), HOME.copy()
    (x, y, z), quat = arm.forward_kinematics(HOME)
    goal = (x + 0.05, y - 0.1, z + 0.1), quat
    left = [apart(arm.forward_kinematics(q), goal)[0]]
    while left[-1] > 2e-5:
        q = solver.step(q, HOME, goal, -0.025 * np.ones(7), 0.025 * np.ones(7)).q
        left.append(apart(arm.forward_kinematics(q), goal)[0])
        assert left[-1] < left[-2]
    assert len(left) < 30


@given(start=offsets, aim=offsets, lower=bounds, upper=bounds)
def test_bounds_are_kept_and_the_same_arguments_give_the_same_bits(
    start: Floats, aim: Floats, lower: Floats, upper: Floats
) -> None:
    """Whatever was solved before; targets far away and singular postures included."""
    arm = make_arm()
    solver, q = solver_of(arm, SOLVER_NUMPY), HOME + start
    goal = arm.forward_kinematics(HOME + aim)
    first = solver.step(q, HOME, goal, -lower, upper)
    assert (first.q >= q - lower).all()
    assert (first.q <= q + upper).all()
    solver.step(HOME, q, goal, -FREE, FREE)
    again = solver.step(q, HOME, goal, -lower, upper)
    assert again.q.tobytes() == first.q.tobytes()
    assert again.singular == first.singular


@given(st.data())
def test_the_minimum_in_a_box_is_where_no_element_can_improve_it(data: st.DataObject) -> None:
    """The conditions of Karush, Kuhn and Tucker, for programs as steps have them: rank 6 and some damping."""
    n = data.draw(st.integers(1, 10))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    J = rng.normal(size=(6, n))
    H = J.T @ J + 10.0 ** data.draw(st.floats(-4.0, 0.0)) * np.eye(n)
    c = rng.normal(size=n) * data.draw(st.floats(0.0, 1.0))
    upper = rng.uniform(0.0, 0.1, n) * (rng.uniform(size=n) < 0.8)
    lower = -rng.uniform(0.0, 0.1, n)
    x = minimize_in_box(H, c, lower, upper)
    assert x is not None
    assert (x >= lower).all()
    assert (x <= upper).all()
    gradient = H @ x + c
    assert (gradient[x > lower] <= 1e-9).all()
    assert (gradient[x < upper] >= -1e-9).all()


def test_a_program_with_numbers_that_are_none_has_no_solution() -> None:
    nan = np.full(2, np.nan)
    assert minimize_in_box(np.eye(2), nan, -np.ones(2), np.ones(2)) is None
    assert minimize_in_box(np.zeros((2, 2)), np.ones(2), -np.ones(2), np.ones(2)) is None
    assert minimize_in_box(np.eye(2), np.ones(2), nan, np.ones(2)) is None


# --- which solver ---


@pytest.mark.parametrize(
    ("aim", "turn", "reached"),
    [
        ((0.0, 0.0, 0.05), (0.0, 0.0, 0.0), True),
        ((0.05, 0.25, -0.1), (0.0, 0.0, 0.5), True),
        ((3.0, 0.0, 0.0), (0.0, 0.0, 0.0), False),
        ((0.0, 0.0, 0.0), (0.0, 2.0, 0.0), False),  # out of the range of joint6
    ],
)
def test_both_solvers_take_a_robot_to_the_same_place(
    aim: tuple[float, float, float], turn: tuple[float, float, float], reached: bool
) -> None:
    ends = []
    for name in (SOLVER_MINK, SOLVER_NUMPY):
        config = ControlConfig(solver=name, compensate_sag=False)  # the range of joint6 is met by a hair
        rig = Rig(panda_model(), [panda_spec()], config, home=PANDA_HOME)
        rig.hold(5)
        rig.step(decision([pose_command("panda", rig.source((0.0, 0.0, 0.0)))]))
        far = rig.source(aim, quat_from_rotvec(turn))
        for k in range(700):
            rig.step(decision([pose_command("panda", far if k == 0 else old(far))]))
        tip = rig.controller._ik.compute_tip(0, rig.controller._states[0])
        ends.append((tip, rig.controller._joints.goal.copy(), rig.controller.get_status()[0].limits))
    (mink_tip, mink_q, mink_limits), (tip, q, limits) = ends
    distance, angle = apart(mink_tip, tip)
    assert distance < 5e-5
    assert angle < 0.3  # degrees
    assert np.abs(mink_q - q).max() < 0.01
    assert limits == mink_limits
    assert ("reach" not in limits) == reached


@pytest.mark.parametrize(
    ("version", "solver"),
    [
        ("1.1rc1", SOLVER_MINK),
        ("1.10.dev0+g1a2b", SOLVER_MINK),
        ("2", SOLVER_MINK),
        ("1.0b2", SOLVER_NUMPY),
        ("unknown", SOLVER_NUMPY),
    ],
)
def test_versions_of_mink_may_have_any_form(monkeypatch: pytest.MonkeyPatch, version: str, solver: str) -> None:
    monkeypatch.setattr("importlib.metadata.version", lambda _: version)
    assert name_solver(ControlConfig()).solver == solver


@pytest.mark.parametrize("error", [ValueError, RuntimeError])
def test_auto_does_without_a_library_that_fails_when_imported(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: type[Exception]
) -> None:
    (tmp_path / "daqp.py").write_text(f"raise {error.__name__}('numpy.dtype size changed,\\nmay indicate ...')")
    monkeypatch.delitem(sys.modules, "daqp", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    assert name_solver(ControlConfig()).solver == SOLVER_NUMPY
    with pytest.raises(ImportError, match=r"^solver 'mink' needs .*numpy\.dtype size changed, may"):
        make_solver(make_arm(), ControlConfig(solver=SOLVER_MINK))


def test_auto_is_the_solver_that_can_be_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    assert name_solver(ControlConfig()).solver == SOLVER_MINK
    assert name_solver(ControlConfig(solver=SOLVER_NUMPY)).solver == SOLVER_NUMPY
    monkeypatch.setattr("importlib.metadata.version", lambda _: "0.0.5")  # that robosuite pins
    assert name_solver(ControlConfig()).solver == SOLVER_NUMPY
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "mink", None)
    assert name_solver(ControlConfig()).solver == SOLVER_NUMPY
    assert name_solver(ControlConfig(output="targets")).solver == SOLVER_AUTO  # nothing to solve
    make_solver(make_arm(), ControlConfig())
    with pytest.raises(ImportError, match=r"iris-session\[mink\]"):
        make_solver(make_arm(), ControlConfig(solver=SOLVER_MINK))
    with pytest.raises(ValueError, match="'ipopt'"):
        ControlConfig(solver="ipopt")
