"""Targets of joints: within limits, at bounded speed, back to where the joints are, with their load; fingers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike

from iris_session.simulators.joint_targets import MAX_SPEED, Joints, JointTargets, place_fingers

DT = 0.01
FREE = ([0.0], [-1.0])  # PyBullet's form of no limits


def stand(q: list[float], limits: tuple[ArrayLike, ArrayLike] = FREE, speeds: ArrayLike = MAX_SPEED) -> Joints:
    """Return joints that stand, and whose drives aim at where they are."""
    return Joints(q, [0.0] * len(q), q, *limits, speeds)


def test_a_jump_of_the_solution_becomes_motion_at_bounded_speed() -> None:
    targets = JointTargets()
    goals = [targets.limit("arm", (i * DT, DT), stand([0.0]), [math.pi])[0] for i in range(200)]
    assert np.diff(goals).max() <= MAX_SPEED * DT + 1e-9
    assert goals[-1] == pytest.approx(math.pi), "drives that lag get there, too"
    joints = stand([0.0, 0.0, 0.0], FREE, [0.5, 0.0, 100.0])
    slow = JointTargets().limit("arm", (0.0, DT), joints, [1.0, 1.0, 1.0])
    assert slow.tolist() == pytest.approx([0.5 * DT, MAX_SPEED * DT, MAX_SPEED * DT])


def test_targets_return_to_the_joints_at_once() -> None:
    targets = JointTargets()
    for i in range(50):
        targets.limit("arm", (i * DT, DT), stand([0.0]), [1.0])
    assert targets.limit("arm", (50 * DT, DT), stand([0.1]), [0.1])[0] == pytest.approx(0.1)
    assert targets.limit("arm", (51 * DT, DT), stand([0.2]), None)[0] == pytest.approx(0.2)


def test_targets_begin_where_a_robot_stands_when_it_was_not_driven_or_time_went_back() -> None:
    for time_s in (10.0, 0.0):
        targets = JointTargets()
        targets.limit("arm", (5.0, DT), stand([0.0]), [0.0])
        assert targets.limit("arm", (time_s, DT), stand([2.0]), [0.0])[0] == pytest.approx(2.0 - MAX_SPEED * DT)


class Spring:
    """A joint on a drive that is a spring, sagging by `lead` under its weight."""

    def __init__(self, lead: float) -> None:
        self.lead, self.q, self.v, self.target, self.time_s = lead, -lead, 0.0, 0.0, 0.0
        self.targets = JointTargets()

    def step(self, found: float | None) -> None:
        joints = Joints([self.q], [self.v], [self.target], *FREE)
        self.target = float(self.targets.limit("arm", (self.time_s, DT), joints, None if found is None else [found])[0])
        self.wait()

    def wait(self) -> None:
        """A step in which the joint goes a fifth of the way to where it hangs."""
        before, self.time_s = self.q, self.time_s + DT
        self.q += 0.2 * (self.target - self.lead - self.q)
        self.v = (self.q - before) / DT


def test_a_joint_that_is_taken_and_given_back_does_not_sag() -> None:
    joint = Spring(0.08)
    for _ in range(10):
        for found in [joint.q] * 5 + [None]:  # the same goal, then let go
            joint.step(found)
            assert joint.q == pytest.approx(-0.08), "neither when it is taken, nor when it is given back"
        for _ in range(10):
            joint.wait()
    for i in range(100):
        joint.step(-0.08 + 0.003 * i)
    assert joint.q == pytest.approx(-0.08 + 0.003 * 99, abs=0.02)
    for found in (None, joint.q):  # let go in motion, and taken again before it stands
        joint.step(found)
        before = joint.q
        for _ in range(10):
            joint.wait()
        assert joint.q == pytest.approx(before, abs=1e-6)


@pytest.mark.parametrize(("v", "target"), [(0.5, 0.1), (0.0, 1.0)])
def test_the_lead_of_a_joint_that_moves_or_aims_far_away_is_no_load(v: float, target: float) -> None:
    goal = JointTargets().limit("arm", (0.0, DT), Joints([0.0], [v], [target], *FREE), None)
    assert goal[0] == 0.0


def test_targets_are_within_limits_and_finite() -> None:
    found, now = [9.0, -9.0, 9.0, math.nan], [0.99, -0.99, 0.0, 0.5]
    limits = ([-1.0, -1.0, -math.inf, -1.0], [1.0, 1.0, math.inf, 1.0])
    goal = JointTargets().limit("arm", (0.0, DT), stand(now, limits), found)
    assert goal.tolist() == pytest.approx([1.0, -1.0, MAX_SPEED * DT, 0.5])


def test_fingers_that_slide_close_to_zero_and_others_by_turning_up() -> None:
    assert [place_fingers([(7, 0.0, 0.04, True)], c) for c in (0.0, 1.0)] == [{7: 0.04}, {7: 0.0}]
    assert [place_fingers([(7, -0.04, 0.0, True)], c) for c in (0.0, 1.0)] == [{7: -0.04}, {7: 0.0}]
    assert [place_fingers([(7, 0.0, 0.8, False)], c) for c in (0.0, 0.5)] == [{7: 0.0}, {7: 0.4}]


def test_fingers_without_limits_are_left_out() -> None:
    endless = [(1, -math.inf, math.inf, False), (2, 0.0, -1.0, True), (3, math.nan, 1.0, True), (4, 0.0, 0.1, True)]
    assert place_fingers(endless, 1.0) == {4: 0.0}
