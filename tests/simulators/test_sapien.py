"""The adapter for SAPIEN, over stand-ins for an articulation and its kinematics: no SAPIEN takes part."""

from __future__ import annotations

import math
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from iris_session.protocol.common import Pose
from iris_session.simulators import TipTarget
from iris_session.simulators.joint_targets import MAX_SPEED, JointTargets
from iris_session.simulators.sapien import SapienAdapter, _Arm

DT = 0.01
TARGET = TipTarget(Pose((0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0)), 1.0)


class Joint:
    def __init__(self, low: float, high: float, kind: str = "revolute", max_velocity: float = 100.0) -> None:
        self.limits, self.type, self.max_velocity = [[low, high]], kind, max_velocity
        self.target: float | None = None
        self.drive_target = np.zeros(1)  # of the program

    def set_drive_target(self, value: float) -> None:
        self.target = value


class Model:
    """Finds one solution, whatever is asked."""

    is_solved = True

    def compute_inverse_kinematics(self, *_: Any, **__: Any) -> tuple[Any, bool, Any]:
        return np.full(5, 9.0), self.is_solved, np.zeros(6)


@pytest.fixture
def joints() -> list[Joint]:
    free = (-math.inf, math.inf)
    return [
        Joint(-1.0, 0.001),
        Joint(*free),
        Joint(*free, max_velocity=0.5),
        Joint(0.0, 0.04, "prismatic"),
        Joint(*free),
    ]


@pytest.fixture
def adapter(joints: list[Joint], monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setitem(sys.modules, "sapien", SimpleNamespace(Pose=lambda p, q: (p, q)))
    adapter: Any = object.__new__(SapienAdapter)
    root = SimpleNamespace(p=np.zeros(3), q=np.array([1.0, 0.0, 0.0, 0.0]))
    articulation = SimpleNamespace(root_pose=root, dof=5, qpos=np.zeros(5), qvel=np.zeros(5), active_joints=joints)
    adapter._arms = {"arm": _Arm(articulation, Model(), 3, [0, 1, 2], [3, 4])}
    adapter._scene, adapter._time_s, adapter._targets = SimpleNamespace(timestep=DT), 0.0, JointTargets()
    return adapter


def test_drives_have_targets_within_limits_and_at_bounded_speed(adapter: Any, joints: list[Joint]) -> None:
    adapter.apply_targets({"arm": TARGET})
    assert [joint.target for joint in joints] == [0.001, pytest.approx(MAX_SPEED * DT), 0.005, 0.0, None]


def test_a_failed_solution_is_skipped(adapter: Any, joints: list[Joint], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Model, "is_solved", False)
    adapter.apply_targets({"arm": TARGET})
    assert [joint.target for joint in joints] == [None, None, None, 0.0, None]
    joints[1].drive_target[:] = 0.1  # carries the arm
    adapter.apply_targets({"arm": TipTarget(TARGET.pose, stops=True)})
    assert [joint.target for joint in joints] == [0.0, 0.1, 0.0, 0.0, None], "a robot that stops needs no solution"
