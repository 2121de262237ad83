"""Grippers move at bounded speed, stay where they are in hold, and are untouched without a command."""

from __future__ import annotations

import math

import msgspec
import mujoco
import pytest

from iris_session.control import ControlConfig
from iris_session.control.gripper import Grippers
from tests.control.rigs import aloha_model, aloha_robots


def aloha() -> tuple[Grippers, mujoco.MjData, int, int]:
    model = aloha_model()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    robots = aloha_robots()
    plain = msgspec.structs.replace(robots[0], name="plain", gripper_actuator="")
    grippers = Grippers(model, [robots[0], plain, robots[1]], ControlConfig(gripper_speed=4.0), 0.002)
    grippers.reset(data)
    return grippers, data, model.actuator("left/gripper").id, model.actuator("right/gripper").id


def test_closing_is_as_fast_as_allowed_and_ends_exactly() -> None:
    grippers, data, left, right = aloha()
    grippers.command(0, 1.0)
    for _ in range(5):
        grippers.tick(data)
    assert data.ctrl[left] == pytest.approx(0.037 - 5 * 0.035 * 4.0 * 0.002)
    for _ in range(130):
        grippers.tick(data)
    assert data.ctrl[left] == 0.002
    assert data.ctrl[right] == 0.037


def test_a_stopped_gripper_stays_bitwise() -> None:
    grippers, data, left, _ = aloha()
    grippers.command(0, 1.0)
    grippers.tick(data)
    grippers.stop(0)
    before = data.ctrl[left]
    for _ in range(10):
        grippers.tick(data)
    assert data.ctrl[left] == before


def test_nothing_is_asked_of_robots_without_gripper_or_by_no_number() -> None:
    grippers, data, left, right = aloha()
    grippers.command(1, 1.0)
    grippers.stop(1)
    grippers.command(0, None)
    grippers.command(2, math.nan)
    grippers.tick(data)
    assert (data.ctrl[left], data.ctrl[right]) == (0.037, 0.037)
    grippers.command(2, 7.0)
    for _ in range(200):
        grippers.tick(data)
    assert data.ctrl[right] == 0.002


def test_no_grippers_at_all() -> None:
    model = aloha_model()
    data = mujoco.MjData(model)
    before = data.ctrl.copy()
    grippers = Grippers(model, [], ControlConfig(), 0.002)
    grippers.reset(data)
    grippers.tick(data)
    assert (data.ctrl == before).all()
