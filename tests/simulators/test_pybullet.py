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
from iris_session.simulators.wrapping import AlreadyWrappedError

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


class BulletClient:
    stepSimulation: Any


class Clients:
    """The module with several clients: the stand-in of `pybullet`, whose session `i` notes the steps of client `i`."""

    def __init__(self) -> None:
        self.steps: list[int] = []
        self.seen: list[int] = []
        self.module = SimpleNamespace(stepSimulation=lambda physicsClientId=0: self.steps.append(physicsClientId))
        self.module.disconnect = lambda physicsClientId=0: None
        self.module.getPhysicsEngineParameters = lambda physicsClientId: {"fixedTimeStep": DT}
        self.originals = dict(vars(self.module))

    def follow(self, client: int) -> Any:
        adapter: Any = object.__new__(PyBulletAdapter)
        adapter._p = adapter._owner = self.module
        adapter._client, adapter._time_s = client, 0.0
        return adapter.wrap_step(lambda: None, lambda: self.seen.append(client))


@pytest.fixture
def clients(monkeypatch: pytest.MonkeyPatch) -> Clients:
    for name in ("pybullet_utils", "pybullet_utils.bullet_client"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setattr(sys.modules["pybullet_utils.bullet_client"], "BulletClient", BulletClient, raising=False)
    return Clients()


@pytest.mark.parametrize("first", [0, 1])
def test_functions_come_back_with_the_last_session(clients: Clients, first: int) -> None:
    ends = [clients.follow(client) for client in (0, 1)]
    wrapped: Any = BulletClient()
    wrapped._client = 1
    wrapped.stepSimulation()
    ends[first]()
    wrapped.stepSimulation()
    clients.module.stepSimulation()
    assert clients.steps == [1, 1, 0]
    assert clients.seen == ([1, 1] if first == 0 else [1, 0])
    ends[1 - first]()
    assert "stepSimulation" not in vars(BulletClient)
    assert "disconnect" not in vars(BulletClient)
    assert vars(clients.module) == clients.originals


def test_a_client_with_the_number_of_one_that_was_disconnected_is_another_simulation(clients: Clients) -> None:
    end = clients.follow(0)
    with pytest.raises(AlreadyWrappedError):
        clients.follow(0)
    clients.module.disconnect(physicsClientId=1)
    with pytest.raises(AlreadyWrappedError):
        clients.follow(0)
    clients.module.disconnect()
    end_second = clients.follow(0)
    end()  # of the first session, later
    clients.module.stepSimulation()
    assert clients.seen == [0]
    end_second()
    assert vars(clients.module) == clients.originals
