"""The adapter for PyBullet, over a stand-in for its module: no PyBullet takes part."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from iris_session.protocol.common import Pose
from iris_session.simulators import TipTarget
from iris_session.simulators.joint_targets import MAX_SPEED, JointTargets
from iris_session.simulators.pybullet import PyBulletAdapter, _Arm, _Joint

DT = 0.005
TARGET = TipTarget(Pose((0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0)), 1.0)


class Bullet:
    """A module with one body: joints 0 to 2 of an arm, and two fingers."""

    POSITION_CONTROL = 2

    def __init__(self) -> None:
        self.found = (9.0, 9.0, 9.0, 0.0, 0.0)
        self.asked: dict[str, Any] = {}
        self.motors: dict[int, tuple[float, float]] = {}  # position and force, by joint

    def getJointStates(self, body: int, joints: list[int], physicsClientId: int) -> list[tuple[float, float]]:
        return [(0.5, 0.0) for _ in joints]

    def getPhysicsEngineParameters(self, physicsClientId: int) -> dict[str, float]:
        return {"fixedTimeStep": DT}

    def calculateInverseKinematics(self, body: int, tip: int, p: Any, q: Any, **kwargs: Any) -> tuple[float, ...]:
        self.asked = kwargs
        return self.found

    def setJointMotorControlArray(
        self,
        body: int,
        joints: list[int],
        mode: int,
        targetPositions: list[float],
        forces: list[float],
        physicsClientId: int,
    ) -> None:
        self.motors = dict(zip(joints, zip(targetPositions, forces, strict=True), strict=True))


@pytest.fixture
def bullet() -> Bullet:
    return Bullet()


@pytest.fixture
def adapter(bullet: Bullet) -> Any:
    adapter: Any = object.__new__(PyBulletAdapter)
    adapter._p, adapter._client, adapter._time_s, adapter._targets = bullet, 0, 0.0, JointTargets()
    joints = {
        0: _Joint(-0.6, 0.501, 87.0, 2.0, False),
        1: _Joint(0.0, -1.0, 0.0, 0.0, False),
        2: _Joint(-2.0, 2.0, 12.0, 100.0, False),
        3: _Joint(0.0, 0.04, 20.0, 0.2, True),
        4: _Joint(0.0, -1.0, 20.0, 0.2, True),
    }
    adapter._arms = {"arm": _Arm(0, 2, joints, [0, 1, 2], [3, 4])}
    return adapter


def test_motors_have_the_limits_of_their_joints(adapter: Any, bullet: Bullet) -> None:
    adapter.apply_targets({"arm": TARGET})
    assert bullet.asked["lowerLimits"][0] == -0.6
    assert bullet.asked["upperLimits"][0] == 0.501
    assert bullet.asked["restPoses"] == [0.5] * 5
    assert min(bullet.asked["jointRanges"]) > 0.0, "also of joints without limits"
    places, forces = ({joint: motor[i] for joint, motor in bullet.motors.items()} for i in (0, 1))
    assert [places[joint] for joint in range(4)] == pytest.approx([0.501, *[0.5 + MAX_SPEED * DT] * 2, 0.0])
    assert (forces[0], forces[2], forces[3]) == (87.0, 12.0, 20.0)
    assert set(bullet.motors) == {0, 1, 2, 3}, "a finger without limits is left out"
    adapter.apply_targets({"arm": TipTarget(TARGET.pose, stops=True)})
    assert {joint: motor[0] for joint, motor in bullet.motors.items()} == {0: 0.5, 1: 0.5, 2: 0.5}


def test_bullet_client_gets_its_step_back_with_the_last_session(monkeypatch: pytest.MonkeyPatch) -> None:
    class BulletClient:
        stepSimulation: Any

    for name in ("pybullet_utils", "pybullet_utils.bullet_client"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setattr(sys.modules["pybullet_utils.bullet_client"], "BulletClient", BulletClient, raising=False)
    steps: list[int] = []
    module = SimpleNamespace(stepSimulation=lambda physicsClientId=0: steps.append(physicsClientId))
    module.getPhysicsEngineParameters = lambda physicsClientId: {"fixedTimeStep": DT}
    adapters, seen = [], []
    for client in (0, 1):
        adapter: Any = object.__new__(PyBulletAdapter)
        adapter._p = adapter._owner = module
        adapter._client, adapter._time_s = client, 0.0
        adapters.append(adapter)
    ends = [a.wrap_step(lambda: None, lambda a=a: seen.append(a._client)) for a in adapters]
    wrapped: Any = BulletClient()
    wrapped._client = 1
    wrapped.stepSimulation()
    ends[0]()
    wrapped.stepSimulation()
    assert (steps, seen) == ([1, 1], [1, 1])
    ends[1]()
    assert "stepSimulation" not in vars(BulletClient)
