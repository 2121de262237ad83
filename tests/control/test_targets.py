"""Output `targets`: the environment's own controller moves the joints, so where they are is measured."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from iris_session.control import ControlConfig
from iris_session.control.state import decode_state
from iris_session.protocol.steps import Command
from tests.control.rigs import PANDA_HOME, Rig, aloha_robots, decision, panda_model, panda_spec, pose_command
from tests.models import ALOHA

#: Nothing recomputes the tip here, so that the target may lead it by any distance; see `test_hold` for the bound.
TARGETS = ControlConfig(output="targets", target_lead_m=9.0, target_lead_rad=9.0)


def lead(rig: Rig, q: np.ndarray, steps: int, engagement: int = 1) -> list[tuple[str, ...]]:
    """A leader at `q` whose environment moves the arm there at 1 rad/s."""
    limits, now = [], rig.data.qpos.copy()
    for _ in range(steps):
        source = rig.source((0.0,) * 3, pose_world=None, q=tuple(q.tolist()), device="joints", engagement=engagement)
        rig.step(decision([Command("panda", "joints", sources=(source,))]))
        now += np.clip(q - now, -0.002, 0.002)
        rig.data.qpos[:] = now
        rig.data.qvel[:] = 0.0
        limits.append(rig.controller.get_status()[0].limits)
    return limits


def test_a_leader_is_apart_until_the_environment_has_caught_up() -> None:
    rig = Rig(panda_model(), [panda_spec()], TARGETS, home=PANDA_HOME)
    limits = lead(rig, np.add(PANDA_HOME, 0.5), 400)
    assert limits[10] == ("leader_apart",)
    assert limits[-1] == ()


def test_the_workspace_of_a_leader_starts_where_the_arm_was_taken_by_others() -> None:
    """What a hand has moved through the environment in between is no detour for the leader that comes next."""
    rig = Rig(panda_model(), [panda_spec()], TARGETS, home=PANDA_HOME)
    there = np.add(PANDA_HOME, 0.3)
    lead(rig, there, 300)
    rig.step(decision([pose_command("panda", rig.source((0.0, 0.0, 0.0), engagement=2))]))
    rig.data.qpos[:] = PANDA_HOME
    rig.hold(1)
    assert rig.controller._joints.goal == pytest.approx(PANDA_HOME)
    lead(rig, np.add(PANDA_HOME, 0.05), 3, engagement=3)
    assert rig.controller.get_status()[0].limits == ()


def open_gripper(rig: Rig, steps: int) -> list[float]:
    """A person opens the gripper. Return how far it is closed after each step."""
    shares = []
    for _ in range(steps):
        command = pose_command("left", rig.source((0.0, 0.0, 0.0)), gripper=0.0)
        rig.step(decision([command]))
        shares.append(rig.controller.get_grippers()["left"])
    return shares


def make_aloha(**changes: bool) -> Rig:
    spec = mujoco.MjSpec.from_file(str(ALOHA))
    for key in list(spec.keys):
        spec.delete(key)
    return Rig(spec.compile(), aloha_robots(), ControlConfig(output="targets", **changes))


def test_a_gripper_goes_on_from_a_snapshot() -> None:
    rig = make_aloha()
    open_gripper(rig, 20)
    snapshot = rig.controller.snapshot()
    expected = open_gripper(rig, 40)
    assert expected == sorted(expected, reverse=True)
    assert 1.0 > expected[0] > expected[-1] > 0.0
    other = make_aloha()
    other.controller.restore(snapshot)
    assert other.controller.get_grippers()["left"] > expected[0]
    assert open_gripper(other, 40) == expected


def test_recordings_made_before_have_no_grippers() -> None:
    """Their snapshots are those of a controller that does not command them."""
    rig = make_aloha(target_grippers=False)
    with pytest.raises(KeyError):
        open_gripper(rig, 20)
    snapshot = decode_state(rig.controller.snapshot())
    assert snapshot.grippers == [b"", b""]
