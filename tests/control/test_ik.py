"""Inverse kinematics of one arm: convergence, bounds, singular postures, and the error without the extra."""

from __future__ import annotations

import builtins
from typing import Any

import msgspec
import numpy as np
import pytest

from iris_session.control import ControlConfig
from iris_session.control.arm_model import ArmModel
from iris_session.control.ik import IkSolver, require_solver
from tests.control.rigs import IIWA_HOME, aloha_model, aloha_robots, apart, iiwa_model, iiwa_spec

FREE = np.full(7, 0.1)


def test_reachable_poses_converge_to_within_a_hair() -> None:
    arm = ArmModel(iiwa_model(), iiwa_spec())
    solver, rng, rest = IkSolver(arm, ControlConfig()), np.random.default_rng(3), np.array(IIWA_HOME)
    for _ in range(20):
        goal = arm.fk(rest + rng.uniform(-0.3, 0.3, 7))
        q = rest.copy()
        for _ in range(25):
            q = solver.step(q, rest, goal, -FREE, FREE).q
        distance, angle = apart(arm.fk(q), goal)
        assert distance < 1e-4
        assert angle < 0.02


def test_joints_in_another_order_than_the_chains_give_the_same_motion() -> None:
    robot = iiwa_spec()
    turned = msgspec.structs.replace(robot, joints=robot.joints[3:] + robot.joints[:3])
    arm, other = ArmModel(iiwa_model(), robot), ArmModel(iiwa_model(), turned)
    home = np.array(IIWA_HOME)
    q, rest, goal = home + 0.1, home - 0.05, arm.fk(home + np.linspace(-0.1, 0.2, 7))
    lower, upper = np.linspace(-0.01, -0.07, 7), np.linspace(0.08, 0.02, 7)
    direct = IkSolver(arm, ControlConfig()).step(q, rest, goal, lower, upper).q
    order = [3, 4, 5, 6, 0, 1, 2]
    mixed = IkSolver(other, ControlConfig()).step(q[order], rest[order], goal, lower[order], upper[order]).q
    assert mixed.tobytes() == direct[order].tobytes()


def test_bounds_hold_in_every_joint_and_order() -> None:
    arm = ArmModel(aloha_model(), aloha_robots()[0])
    solver = IkSolver(arm, ControlConfig())
    q = np.array([0.0, -0.96, 1.16, 0.0, -0.3, 0.0])
    lower, upper = np.array([-0.01, 0.0, -0.02, -0.01, -0.01, -0.03]), np.array([0.01, 0.01, 0.0, 0.02, 0.01, 0.0])
    far = ((0.5, 0.5, 1.0), (0.0, 1.0, 0.0, 0.0))
    dq = solver.step(q, q, far, lower, upper).q - q
    assert (dq >= lower - 1e-9).all()
    assert (dq <= upper + 1e-9).all()
    assert np.abs(dq).max() > 0.009  # it did go for it


def test_result_depends_on_the_arguments_alone() -> None:
    arm, home = ArmModel(iiwa_model(), iiwa_spec()), np.array(IIWA_HOME)
    used, fresh = IkSolver(arm, ControlConfig()), IkSolver(arm, ControlConfig())
    goal = arm.fk(home + 0.2)
    for k in range(10):
        used.step(home + 0.1 * k, home, goal, -FREE, FREE)
    a, b = used.step(home, home, goal, -FREE, FREE).q, fresh.step(home, home, goal, -FREE, FREE).q
    assert a.tobytes() == b.tobytes()


def test_a_stretched_arm_is_reported_as_singular() -> None:
    arm = ArmModel(iiwa_model(), iiwa_spec())
    solver, home = IkSolver(arm, ControlConfig()), np.array(IIWA_HOME)
    straight = np.zeros(7)
    assert solver.step(straight, straight, arm.fk(straight), -FREE, FREE).singular
    assert not solver.step(home, home, arm.fk(home), -FREE, FREE).singular


def test_a_program_without_solution_leaves_the_joints() -> None:
    arm, home = ArmModel(iiwa_model(), iiwa_spec()), np.array(IIWA_HOME)
    step = IkSolver(arm, ControlConfig()).step(home, home, arm.fk(home + 0.1), FREE, -FREE)
    assert (step.q == home).all()
    assert step.singular


def test_the_missing_extra_is_named_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def no_mink(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "mink":
            raise ImportError("No module named 'mink'", name="mink")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", no_mink)
    with pytest.raises(ImportError, match=r"mink is missing.*iris-session\[control\]") as missing:
        require_solver()
    assert "\n" not in str(missing.value)
