"""Leader robots: the follower takes their joints, is ramped when apart, and is blended when several lead."""

from __future__ import annotations

import numpy as np
import pytest

from iris_session.control import ControlConfig, ControlError
from iris_session.protocol.steps import Command
from tests.control.rigs import IIWA_HOME, Rig, decision, iiwa_model, iiwa_spec

HOME = np.array(IIWA_HOME)


def rig() -> Rig:
    made = Rig(iiwa_model(), [iiwa_spec()], home=IIWA_HOME)
    made.hold(5)
    return made


def lead(made: Rig, q: np.ndarray, qd: np.ndarray | None = None, **more: object) -> Command:
    source = made.source(
        (0.0, 0.0, 0.0), pose_world=None, q=tuple(q), qd=() if qd is None else tuple(qd), device="joints", **more
    )
    return Command("iiwa", "joints", sources=(source,))


def test_the_first_engaged_step_changes_nothing_then_the_follower_arrives_exactly() -> None:
    made, goal = rig(), HOME + 0.1
    before = made.data.ctrl.copy()
    made.step(decision([lead(made, goal)]))
    assert (made.data.ctrl == before).all()
    for _ in range(200):
        made.step(decision([lead(made, goal, new=False)]))  # the one sample, taken in the second step
    assert (made.data.ctrl == goal).all()
    assert made.controller.status()[0].limits == ()


def test_a_leader_that_is_far_is_caught_up_with_slowly() -> None:
    made, goal = rig(), HOME + 0.5
    ramped, previous, limits = 0.0, made.data.ctrl.copy(), []
    for k in range(700):
        made.step(decision([lead(made, goal, new=k % 7 == 0)]))
        limits.append(made.controller.status()[0].limits)
        if limits[-1]:
            ramped = max(ramped, float(np.abs(made.data.ctrl - previous).max()) / 0.002)
        previous = made.data.ctrl.copy()
    assert ramped == pytest.approx(0.5, abs=1e-3)
    assert limits[5] == limits[400] == ("leader_apart",)
    assert limits[-1] == ()
    assert made.data.ctrl == pytest.approx(goal)


def test_velocity_predicts_across_the_interpolation_delay() -> None:
    def lag(with_velocity: bool) -> float:
        made, speed, error = rig(), np.full(7, 0.4), 0.0
        for k in range(300):
            now = HOME + speed * 0.002 * k
            made.step(decision([lead(made, now, speed if with_velocity else None, new=k % 7 == 0)]))
            error = float(np.abs(made.data.ctrl - now).max())
        return error

    assert lag(True) < 0.6 * lag(False)


def test_joint_limits_bound_the_leader() -> None:
    made = rig()
    for k in range(3000):
        made.step(decision([lead(made, np.full(7, 9.0), new=k % 7 == 0)]))
    assert (made.data.ctrl <= made.model.jnt_range[:, 1]).all()


def test_several_leaders_are_blended_without_a_jump() -> None:
    made = rig()

    def both(a: float, b: float) -> Command:
        one = lead(made, HOME + a, participant="a", weight=0.75).sources[0]
        two = lead(made, HOME + b, participant="b", weight=0.25).sources[0]
        return Command("iiwa", "joints", sources=(one, two))

    made.step(decision([both(0.0, 0.5)]))
    for _ in range(100):
        made.step(decision([both(0.0, 0.5)]))
    assert made.data.ctrl == pytest.approx(HOME)
    for _ in range(300):
        made.step(decision([both(0.04, 0.54)]))
    assert made.data.ctrl == pytest.approx(HOME + 0.04)
    # One leaves, and the other goes on without a jump.
    for _ in range(300):
        made.step(decision([both(0.04, 0.62)]))
    assert made.data.ctrl == pytest.approx(HOME + 0.06)


@pytest.mark.parametrize("sizes", [(6, 0), (7, 3)])
def test_samples_of_the_wrong_length_are_refused(sizes: tuple[int, int]) -> None:
    made = rig()
    made.step(decision([lead(made, HOME)]))
    with pytest.raises(ControlError, match=f"has {sizes[0]} joints; it must have 7"):
        made.step(decision([lead(made, np.zeros(sizes[0]), np.zeros(sizes[1]) if sizes[1] else None)]))


def test_the_ramp_has_hysteresis() -> None:
    from iris_session.control.leader import ramping

    config = ControlConfig()
    assert [ramping(False, 0.19, config), ramping(False, 0.21, config)] == [False, True]
    assert [ramping(True, 0.19, config), ramping(True, 0.01, config)] == [True, False]


def test_a_leader_does_not_take_the_follower_out_of_its_workspace() -> None:
    tip = rig().target()[0]
    box = ((-2.0, -2.0, tip[2] - 0.02), (2.0, 2.0, 2.0))
    made = Rig(iiwa_model(), [iiwa_spec()], ControlConfig(workspaces={"iiwa": box}), home=IIWA_HOME)
    low = HOME + np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0])  # the shoulder leans forward: the tip sinks
    lowest = tip[2]
    for k in range(400):
        made.step(decision([lead(made, low, new=k % 7 == 0)]))
        lowest = min(lowest, made.target()[0][2])
    assert lowest == pytest.approx(tip[2] - 0.02, abs=1e-3)
    assert lowest >= tip[2] - 0.02 - 1e-4
    assert "workspace" in made.controller.status()[0].limits
    for k in range(400):
        made.step(decision([lead(made, HOME, new=k % 7 == 0)]))
    assert made.data.ctrl == pytest.approx(HOME, abs=1e-6)
    assert made.controller.status()[0].limits == ()
