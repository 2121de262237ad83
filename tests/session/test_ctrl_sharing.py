"""Whose `ctrl` counts in a user's loop: the owner's, until a participant that holds the robot engages, and after it."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import mujoco
import numpy as np
import pytest

from iris_session.protocol.client_messages import Assign, ClearEStop, EStop
from iris_session.protocol.common import Pose
from iris_session.protocol.names import Role
from iris_session.protocol.server_messages import MarkerAdded
from tests.session.loops import Agent, Rig, largest_step, take_over
from tests.session.play import TICK_NS

#: Position actuators of a robot within its speed limit: 2.5 rad/s in a tick of 2 ms, and the owner's own motion.
SPEED_STEP = 2.5 * 0.002


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.loop.close()


def swing(rig: Rig, amplitude: float = 0.3) -> Callable[[mujoco.MjData], None]:
    """A suite's own policy: every actuator of the left robot swings about its home."""
    home = rig.data.ctrl.copy()
    arm = rig.actuators()[:-1]

    def policy(data: mujoco.MjData) -> None:
        data.ctrl[arm] = home[arm] + amplitude * np.sin(2.0 * data.time)

    return policy


def sideways(here: Pose, speed: float = 0.1) -> Callable[[float], Pose]:
    return lambda t: Pose((here.p[0], here.p[1] + speed * t, here.p[2]), here.q)


def run_without(rig: Rig, rounds: int) -> np.ndarray:
    """The owner's trajectory without a session."""
    data = mujoco.MjData(rig.model)
    mujoco.mj_resetDataKeyframe(rig.model, data, 0)
    states = []
    for _ in range(rounds):
        rig.policy(data)
        mujoco.mj_step(rig.model, data)
        states.append(np.concatenate((data.qpos, data.qvel, data.ctrl)))
    return np.array(states)


def run_with(rig: Rig, rounds: int) -> np.ndarray:
    states = []
    for _ in range(rounds):
        rig.round()
        states.append(np.concatenate((rig.data.qpos, rig.data.qvel, rig.data.ctrl)))
    return np.array(states)


def test_observers_and_a_holder_that_has_not_engaged_change_nothing(rig: Rig) -> None:
    rig.policy = swing(rig)
    expected = run_without(rig, 300)
    agent = Agent(rig)
    Agent(rig, connection=2, role=Role.OBSERVER)
    states = list(run_with(rig, 100))
    rig.applied.clear()
    begun = rig.data.time
    agent.acquire()  # three rounds
    agent.sample(agent.tip(), clutch=False)
    rig.rounds(1)
    assert rig.stepper.core.authority.list_holders()["left"] == ("p1",)
    states_after = run_with(rig, 196)
    assert begun > 0.0
    assert np.array_equal(np.array(states), expected[:100])
    assert np.array_equal(states_after, expected[104:])
    assert rig.loop.driven == ()


def test_engaging_begins_at_the_present_ctrl_and_the_policy_is_out(rig: Rig) -> None:
    agent = Agent(rig)
    rig.round()
    rig.policy = swing(rig)
    agent.acquire()
    rig.rounds(100)
    agent.sample(agent.tip(), clutch=False)
    rig.round()
    arm = rig.actuators()
    rig.policy(rig.data)
    present = rig.data.ctrl.copy()
    agent.sample(agent.tip(), clutch=True)
    rig.round()
    assert np.abs(rig.applied[-1][arm] - present[arm]).max() < 1e-9, "the first engaged step leaves ctrl as it was"
    rig.applied = rig.applied[-1:]
    agent.drive(sideways(agent.tip()), 0.6)
    assert rig.loop.driven == ("left",)
    assert largest_step(rig.applied, arm) <= SPEED_STEP
    measured = rig.data.qpos[rig.joints()]
    assert np.abs(rig.data.ctrl[arm[:-1]] - measured).max() < 0.1


def test_a_release_gives_the_owners_ctrl_back_without_a_jump(rig: Rig) -> None:
    rig.policy = swing(rig)
    agent = take_over(rig)
    agent.drive(sideways(agent.tip(), 0.2), 1.5)
    agent.release()
    rig.applied = rig.applied[-1:]
    rig.rounds(600)
    arm = rig.actuators()
    assert largest_step(rig.applied, arm) <= 2.0 * SPEED_STEP
    assert rig.loop.driven == ()
    owner = mujoco.MjData(rig.model)
    owner.ctrl[:], owner.time = rig.data.ctrl, rig.data.time - 0.002
    rig.policy(owner)
    assert np.array_equal(rig.data.ctrl, owner.ctrl), "in the end it is the owner's to the bit"


def test_what_the_owner_writes_while_a_robot_is_driven_counts_when_it_is_given_back(rig: Rig) -> None:
    agent = take_over(rig)
    arm = rig.actuators()[:-1]
    rig.data.ctrl[arm[0]] = 0.2
    agent.drive(sideways(agent.tip()), 0.1)
    assert rig.data.ctrl[arm[0]] != 0.2
    agent.release()
    rig.rounds(1000)
    assert rig.data.ctrl[arm[0]] == 0.2


def test_the_clutch_open_holds_and_a_new_holder_has_to_engage(rig: Rig) -> None:
    rig.policy = swing(rig)
    agent, other = take_over(rig), Agent(rig, connection=2)
    boss = Agent(rig, connection=3, role=Role.DIRECTOR)
    agent.drive(sideways(agent.tip()), 0.4)
    here = agent.tip()
    agent.drive(lambda t: here, 0.5, clutch=False)
    arm = rig.actuators()
    assert largest_step(rig.applied[-50:], arm) < 1e-9, "the holder's robot stands, whatever the policy wants"
    boss.say(Assign(1, ("left",), "p2"))
    rig.rounds(1000)
    assert rig.loop.driven == (), "the new holder has not engaged"
    assert other.version == 0


def test_during_an_estop_nothing_is_given_back(rig: Rig) -> None:
    rig.policy = swing(rig)
    agent, boss = take_over(rig), Agent(rig, connection=2, role=Role.DIRECTOR)
    agent.drive(sideways(agent.tip(), 0.2), 0.5)
    agent.release()
    rig.rounds(50)
    assert rig.loop.driven == ("left",)
    agent.estop()
    rig.rounds(150)  # 0.3 s: the arm stops, and yields for 0.15 s
    arm = rig.actuators()
    stopped = len(rig.applied)
    rig.rounds(500)
    assert largest_step(rig.applied[stopped:], arm) < 1e-9
    boss.say(ClearEStop(1, stop_seq=1))
    rig.rounds(1000)
    assert rig.loop.driven == ()
    assert largest_step(rig.applied[stopped:], arm) <= 2.0 * SPEED_STEP


def test_a_robot_that_is_taken_again_on_its_way_back_does_not_jump(rig: Rig) -> None:
    rig.policy = swing(rig)
    agent = take_over(rig)
    agent.drive(sideways(agent.tip(), 0.2), 0.8)
    agent.release()
    rig.rounds(60)
    agent.acquire()
    rig.applied = rig.applied[-1:]
    agent.engage()
    agent.drive(sideways(agent.tip(), 0.1), 0.4)
    assert largest_step(rig.applied, rig.actuators()) <= 2.0 * SPEED_STEP


@pytest.mark.parametrize("how", ["time", "pose", "said"])
def test_after_a_reset_a_driven_robot_is_where_its_owner_put_it(rig: Rig, how: str) -> None:
    home = rig.data.ctrl.copy()
    agent = take_over(rig)
    agent.drive(sideways(agent.tip(), 0.2), 1.0)
    joint = rig.joints()[0]
    if how == "time":
        mujoco.mj_resetData(rig.model, rig.data)
        mujoco.mj_forward(rig.model, rig.data)
    elif how == "said":
        rig.loop.reset()
    rig.data.qpos[rig.joints()] = 0.3
    rig.data.qvel[:] = 0.0
    if how == "said":
        rig.data.ctrl[rig.actuators()[:-1]] = 0.3
    elif how == "pose":
        rig.data.ctrl[:] = home
    mujoco.mj_forward(rig.model, rig.data)
    owner = rig.data.ctrl.copy()
    twin = mujoco.MjData(rig.model)
    mujoco.mj_copyData(twin, rig.model, rig.data)
    agent.drive(sideways(agent.tip(), 0.2), 0.3)  # with the clutch closed all the time
    for _ in range(150):
        mujoco.mj_step(rig.model, twin)
    assert np.array_equal(rig.data.ctrl, owner)
    assert rig.data.qpos[joint] == pytest.approx(twin.qpos[joint], abs=1e-12)


def test_a_real_robot_may_be_moved_by_its_owner_between_ticks(rig: Rig) -> None:
    """Measured joints are written into the data, nothing is simulated: no reset."""
    agent = take_over(rig)
    arm, joints = rig.actuators()[:-1], rig.joints()
    goal = sideways(agent.tip(), 0.1)
    for i in range(200):
        if i % 7 == 0:
            agent.sample(goal(i / 500), clutch=True)
        rig.now_ns += TICK_NS
        rig.data.qpos[joints] = rig.data.ctrl[arm]
        rig.data.time += 0.002
        rig.loop.begin_tick()
        rig.loop.end_tick()
    assert rig.loop.driven == ("left",)
    assert rig.resets() == []


@pytest.mark.parametrize("array", ["qvel", "ctrl", "xfrc_applied"])
def test_numbers_that_are_not_finite_are_reported_once_and_never_written(rig: Rig, array: str) -> None:
    agent = take_over(rig)
    agent.drive(sideways(agent.tip(), 0.2), 0.2)
    arm = rig.actuators()
    before = rig.data.ctrl[arm].copy()
    for _ in range(3):
        getattr(rig.data, array)[-1] = np.nan
        rig.now_ns += TICK_NS
        rig.loop.begin_tick()
        assert np.array_equal(rig.data.ctrl[arm], before)
        rig.loop.end_tick()
    fault = rig.loop.fault
    assert fault is not None
    assert fault.arrays == (array,)
    events = [e.body for d in rig.front.decisions for e in d.events]
    assert len([e for e in events if isinstance(e, MarkerAdded) and array in e.text]) == 1
    assert any(array in text for text in rig.loop.list_warnings())
    getattr(rig.data, array)[-1] = 0.0
    rig.round()
    assert rig.loop.fault is None


def test_ctrl_that_is_changed_inside_of_a_tick_is_reported(rig: Rig) -> None:
    take_over(rig)
    rig.now_ns += TICK_NS
    rig.loop.begin_tick()
    rig.data.ctrl[rig.actuators()[0]] += 0.5
    rig.loop.end_tick()
    assert rig.loop.overwritten == 1
    assert any("begin_tick" in text for text in rig.loop.list_warnings())


def test_an_estop_of_an_observer_leaves_the_owners_robot_to_the_owner(rig: Rig) -> None:
    rig.policy = swing(rig)
    expected = run_without(rig, 100)
    Agent(rig, role=Role.OBSERVER).say(EStop("!"))
    assert np.array_equal(run_with(rig, 100), expected)
