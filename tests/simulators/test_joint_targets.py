"""Targets of joints: within limits, at bounded speed, and back to where the joints are at once; places of fingers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from iris_session.simulators.joint_targets import MAX_SPEED, JointTargets, place_fingers

DT = 0.01
FREE = ([0.0], [-1.0])  # PyBullet's form of no limits


def test_a_jump_of_the_solution_becomes_motion_at_bounded_speed() -> None:
    targets = JointTargets()
    goals = [targets.limit("arm", (i * DT, DT), [0.0], [math.pi], FREE)[0] for i in range(200)]
    assert np.diff(goals).max() <= MAX_SPEED * DT + 1e-9
    assert goals[-1] == pytest.approx(math.pi), "drives that lag get there, too"
    slow = JointTargets().limit("arm", (0.0, DT), [0.0, 0.0, 0.0], [1.0, 1.0, 1.0], FREE, [0.5, 0.0, 100.0])
    assert slow.tolist() == pytest.approx([0.5 * DT, MAX_SPEED * DT, MAX_SPEED * DT])


def test_targets_return_to_the_joints_at_once() -> None:
    targets = JointTargets()
    for i in range(50):
        targets.limit("arm", (i * DT, DT), [0.0], [1.0], FREE)
    assert targets.limit("arm", (50 * DT, DT), [0.1], [0.1], FREE)[0] == pytest.approx(0.1)


def test_targets_begin_where_a_robot_stands_when_it_was_not_driven_or_time_went_back() -> None:
    for time_s in (10.0, 0.0):
        targets = JointTargets()
        targets.limit("arm", (5.0, DT), [0.0], [0.0], FREE)
        assert targets.limit("arm", (time_s, DT), [2.0], [0.0], FREE)[0] == pytest.approx(2.0 - MAX_SPEED * DT)


def test_targets_are_within_limits_and_finite() -> None:
    found, now = [9.0, -9.0, 9.0, math.nan], [0.99, -0.99, 0.0, 0.5]
    limits = ([-1.0, -1.0, -math.inf, -1.0], [1.0, 1.0, math.inf, 1.0])
    goal = JointTargets().limit("arm", (0.0, DT), now, found, limits)
    assert goal.tolist() == pytest.approx([1.0, -1.0, MAX_SPEED * DT, 0.5])


def test_fingers_that_slide_close_to_zero_and_others_by_turning_up() -> None:
    assert [place_fingers([(7, 0.0, 0.04, True)], c) for c in (0.0, 1.0)] == [{7: 0.04}, {7: 0.0}]
    assert [place_fingers([(7, -0.04, 0.0, True)], c) for c in (0.0, 1.0)] == [{7: -0.04}, {7: 0.0}]
    assert [place_fingers([(7, 0.0, 0.8, False)], c) for c in (0.0, 0.5)] == [{7: 0.0}, {7: 0.4}]


def test_fingers_without_limits_are_left_out() -> None:
    endless = [(1, -math.inf, math.inf, False), (2, 0.0, -1.0, True), (3, math.nan, 1.0, True), (4, 0.0, 0.1, True)]
    assert place_fingers(endless, 1.0) == {4: 0.0}
