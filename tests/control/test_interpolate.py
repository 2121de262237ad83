"""Joint motion never exceeds its limits, never passes its goal, arrives in time and stops exactly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from iris_session.control import ControlConfig, ControlError
from iris_session.control.arm_model import ArmModel
from iris_session.control.interpolate import JointInterpolator, read_speed_limits
from tests.control.rigs import panda_model, panda_spec

DT = 0.002
ALL = slice(0, 3)


def make(velocity: float = 2.0, acceleration: float = 30.0) -> JointInterpolator:
    joints = JointInterpolator(np.full(3, velocity), np.full(3, acceleration), DT)
    joints.place(np.zeros(3))
    return joints


goals = st.lists(st.tuples(*[st.floats(-1.5, 1.5)] * 3), min_size=1, max_size=12)


@settings(max_examples=25, deadline=None)
@example([(1.0, 0.0, 0.0)] * 2 + [(0.0, 0.0, 0.0)] * 5 + [(1.0, 0.0, 0.0)], 1, 1.0, 2.0, False)  # back at once
@given(goals, st.integers(1, 12), st.floats(0.3, 4.0), st.floats(2.0, 60.0), st.booleans())
def test_limits_hold_for_any_goals(
    sequence: list[tuple[float, ...]], every: int, velocity: float, acceleration: float, stop: bool
) -> None:
    joints = make(velocity, acceleration)
    q, v = joints.q.copy(), joints.v.copy()

    def tick() -> None:
        nonlocal q, v
        joints.advance()
        now = (joints.q - q) / DT
        assert (np.abs(now) <= velocity + 1e-6).all()
        assert (np.abs(now - v) <= acceleration * DT + 1e-6).all()
        q, v = joints.q.copy(), now

    for goal in sequence:
        joints.set_goal(ALL, np.array(goal), every * DT)
        for _ in range(every):
            tick()
    if stop:
        shortest = joints.v**2 / (2 * acceleration)
        joints.stop(ALL)
        assert (np.abs(joints.goal - q) <= shortest + 1e-12).all()
    for _ in range(20000):
        if not joints.moving:
            break
        ahead, able = joints.goal - joints.q, np.abs(joints.v) <= np.sqrt(acceleration * np.abs(joints.goal - joints.q))
        tick()
        assert (able <= (ahead * (joints.goal - joints.q) >= -1e-12)).all()  # who can stop at the goal never passes it
    assert not joints.moving
    assert (joints.q == joints.goal).all()
    assert (joints.v == 0.0).all()


def test_speed_limits_by_name_and_by_kind() -> None:
    model, robot = panda_model(), panda_spec()
    config = ControlConfig(velocity_limits={"joint2": 0.7}, acceleration_limits={"joint7": 9.0})
    velocity, acceleration = read_speed_limits(model, [robot], [ArmModel(model, robot)], config)
    assert velocity.tolist() == [2.5, 0.7, 2.5, 2.5, 2.5, 2.5, 2.5]
    assert acceleration.tolist() == [40.0] * 6 + [9.0]
    with pytest.raises(ControlError, match=r"limit of joint 'elbow': no robot has it. Available joints: joint1"):
        read_speed_limits(model, [robot], [ArmModel(model, robot)], ControlConfig(velocity_limits={"elbow": 1.0}))
