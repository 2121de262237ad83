"""The clutch alone: relative motion, blending without jumps, workspace, twists."""

from __future__ import annotations

import numpy as np
import pytest

from anchors.pose import PoseTuple, quat_angle, quat_from_rotvec, quat_mul
from iris_session.control import ControlConfig, ControlError, clutch
from iris_session.protocol.common import Pose
from iris_session.protocol.steps import Command, CommandSource
from tests.control.rigs import PANDA_HOME, Rig, decision, panda_model, panda_spec

BASE: PoseTuple = ((0.5, 0.1, 0.8), quat_from_rotvec((0.3, -1.0, 0.2)))
TURN = quat_from_rotvec((0.0, 0.0, 0.4))
ONE = (1.0, 0.0, 0.0, 0.0)


def source(name: str, p: tuple[float, float, float], q: tuple[float, float, float, float] = ONE, **more: object):  # type: ignore[no-untyped-def]
    fields = {"engagement": 1, "seq": 1, "capture_ns": 0, "receive_ns": 0, "pose_world": Pose(p, q), **more}
    return CommandSource(name, "controller/right", **fields)


def command(*sources: CommandSource) -> Command:
    return Command("r", "pose", sources=sources)


def test_translation_is_scaled_and_rotation_is_about_the_worlds_axes() -> None:
    start = quat_from_rotvec((1.0, 0.5, 0.0))
    state = clutch.latch_sources(command(source("a", (9.0, 9.0, 9.0), start)), 2.0, BASE)
    clutch.follow_poses(state, [source("a", (9.1, 9.0, 8.9), quat_mul(TURN, start))], None)
    assert state.target[0] == pytest.approx((0.7, 0.1, 0.6))
    assert quat_angle(state.target[1], quat_mul(TURN, BASE[1])) < 1e-12


def test_back_at_the_latch_the_target_is_the_base_exactly() -> None:
    first = source("a", (1.0, 2.0, 3.0), TURN)
    state = clutch.latch_sources(command(first), 1.0, BASE)
    for k in range(100):
        clutch.follow_poses(
            state, [source("a", (1.0 + 0.01 * k, 2.0, 3.0), quat_from_rotvec((0.01 * k, 0.0, 1.0)))], None
        )
    clutch.follow_poses(state, [first], None)
    assert state.target == BASE


def test_joining_and_leaving_moves_nothing_and_loses_nothing() -> None:
    state = clutch.latch_sources(command(source("a", (0.0, 0.0, 0.0))), 1.0, BASE)
    clutch.follow_poses(state, [source("a", (0.1, 0.0, 0.0))], None)
    before = state.target
    both = [source("a", (0.1, 0.0, 0.0), weight=0.5), source("b", (7.0, 7.0, 7.0), weight=0.5)]
    state = clutch.latch_sources(command(*both), 1.0, state.target, state)
    clutch.follow_poses(state, both, None)
    assert state.target[0] == pytest.approx(before[0], abs=1e-15)
    # b moves, then a leaves in the same step in which b moves on: b's motion goes on from its last sample.
    clutch.follow_poses(state, [both[0], source("b", (7.0, 7.2, 7.0), weight=0.5)], None)
    assert state.target[0] == pytest.approx((0.6, 0.2, 0.8))
    alone = source("b", (7.0, 7.3, 7.0))
    assert not clutch.has_same_sources(state, command(alone), 1.0)
    state = clutch.latch_sources(command(alone), 1.0, state.target, state)
    clutch.follow_poses(state, [alone], None)
    assert state.target[0] == pytest.approx((0.6, 0.3, 0.8))


def test_absolute_poses_are_the_target_themselves() -> None:
    first = source("a", (0.2, 0.3, 0.4), TURN, absolute=True)
    state = clutch.latch_sources(command(first), 1.0, BASE)
    assert state.target == BASE
    clutch.follow_poses(state, [first], None)
    assert state.target == ((0.2, 0.3, 0.4), TURN)


def test_the_workspace_bounds_the_target_and_never_throws_it_in() -> None:
    box = ((0.0, 0.0, 0.0), (0.4, 1.0, 0.9))  # the robot stands outside in x
    state = clutch.latch_sources(command(source("a", (0.0, 0.0, 0.0))), 1.0, BASE)
    clutch.follow_poses(state, [source("a", (0.1, 0.0, 0.5))], box)
    assert state.target[0] == (0.5, 0.1, 0.9)
    assert state.clamped
    clutch.follow_poses(state, [source("a", (-0.2, 0.0, 0.0))], box)
    assert state.target[0] == pytest.approx((0.3, 0.1, 0.8))
    assert not state.clamped


def test_twists_are_integrated_within_their_limits() -> None:
    turn = CommandSource("a", "desktop", 1, 1, 0, 0, twist_world=(3.0, 0.0, 0.0, 0.0, 0.0, 9.0))
    state = clutch.latch_sources(command(turn), 1.0, BASE)
    assert not clutch.integrate_twists(state, 0.002, 1.0, 2.0, None)  # the latching sample has not been taken yet
    clutch.follow_poses(state, [turn], None)
    for _ in range(100):
        assert clutch.integrate_twists(state, 0.002, 1.0, 2.0, None)
    assert state.target[0] == pytest.approx((0.7, 0.1, 0.8))
    assert quat_angle(state.target[1], BASE[1]) == pytest.approx(0.4)
    clutch.follow_poses(state, [CommandSource("a", "desktop", 1, 2, 0, 0, twist_world=(0.0,) * 6)], None)
    assert not clutch.integrate_twists(state, 0.002, 1.0, 2.0, None)


# --- leader robots ---


HOME = np.array(PANDA_HOME)


def rig() -> Rig:
    made = Rig(panda_model(), [panda_spec()], home=PANDA_HOME)
    made.hold(5)
    return made


def lead(made: Rig, q: np.ndarray, qd: np.ndarray | None = None, **more: object) -> Command:
    source = made.source(
        (0.0, 0.0, 0.0), pose_world=None, q=tuple(q), qd=() if qd is None else tuple(qd), device="joints", **more
    )
    return Command("panda", "joints", sources=(source,))


def test_the_first_engaged_step_changes_nothing_then_the_follower_arrives() -> None:
    made, goal = rig(), HOME + 0.1
    before = made.data.ctrl.copy()
    made.step(decision([lead(made, goal)]))
    assert (made.data.ctrl == before).all()
    for _ in range(500):
        made.step(decision([lead(made, goal, new=False)]))  # the one sample, taken in the second step
    assert made.data.qpos == pytest.approx(goal, abs=1e-3)
    assert made.controller.get_status()[0].limits == ()


def test_a_leader_that_is_far_is_caught_up_with_slowly() -> None:
    made, goal = rig(), HOME + 0.5
    ramped, previous, limits = 0.0, made.data.ctrl.copy(), []
    for k in range(1000):
        made.step(decision([lead(made, goal, new=k % 7 == 0)]))
        limits.append(made.controller.get_status()[0].limits)
        if limits[-1]:
            ramped = max(ramped, float(np.abs(made.data.ctrl - previous).max()) / 0.002)
        previous = made.data.ctrl.copy()
    assert ramped == pytest.approx(0.5, abs=1e-3)
    assert limits[5] == limits[400] == ("leader_apart",)
    assert limits[-1] == ()
    assert made.data.qpos == pytest.approx(goal, abs=1e-3)


def test_joint_limits_bound_the_leader() -> None:
    made = rig()
    for k in range(1500):
        made.step(decision([lead(made, np.full(7, 9.0), new=k % 7 == 0)]))
    assert (made.data.ctrl <= made.model.jnt_range[:, 1]).all()


@pytest.mark.parametrize("sizes", [(6, 0), (7, 3)])
def test_samples_of_the_wrong_length_are_refused(sizes: tuple[int, int]) -> None:
    made = rig()
    made.step(decision([lead(made, HOME)]))
    with pytest.raises(ControlError, match=f"has {sizes[0]} joints; it must have 7"):
        made.step(decision([lead(made, np.zeros(sizes[0]), np.zeros(sizes[1]) if sizes[1] else None)]))


def test_a_leader_does_not_take_the_follower_out_of_its_workspace() -> None:
    tip = rig().target()[0]
    box = ((-2.0, -2.0, tip[2] - 0.02), (2.0, 2.0, 2.0))
    made = Rig(panda_model(), [panda_spec()], ControlConfig(workspaces={"panda": box}), home=PANDA_HOME)
    low = HOME + np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0])  # the shoulder leans forward: the tip sinks
    lowest = tip[2]
    for k in range(400):
        made.step(decision([lead(made, low, new=k % 7 == 0)]))
        lowest = min(lowest, made.target()[0][2])
    assert lowest == pytest.approx(tip[2] - 0.02, abs=1e-3)
    assert lowest >= tip[2] - 0.02 - 1e-4
    assert "workspace" in made.controller.get_status()[0].limits
    for k in range(400):
        made.step(decision([lead(made, HOME, new=k % 7 == 0)]))
    assert made.data.qpos == pytest.approx(HOME, abs=1e-3)
    assert made.controller.get_status()[0].limits == ()
