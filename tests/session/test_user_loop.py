"""The session in a user's loop: resets, several steps per tick, what is published when, and how it ends."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from iris_session import DataFault, OwnerRequest, OwnershipError, Session
from iris_session.protocol.client_messages import Control, Episode
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import OwnerListens, StalledGap
from iris_session.protocol.names import Role
from iris_session.protocol.server_messages import SceneChanged
from tests.session.loops import Agent, Rig, take_over
from tests.session.play import TICK_NS
from tests.session.test_session import QUIET
from tests.session.test_stepper import MS


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.loop.close()


def test_a_reset_is_read_with_the_state_after_it(rig: Rig) -> None:
    """The helper's steps between the word and the tick are on the old plant."""
    rig.rounds(5)
    moved = rig.model.joint(rig.stepper.core.config.robots[0].joints[0]).qposadr[0]
    rig.loop.reset()
    rig.data.qpos[moved] += 0.4
    rig.idle()
    assert rig.resets() == []
    rig.rounds(1)
    (plant,) = rig.resets()
    assert np.frombuffer(plant)[1 + moved] == pytest.approx(rig.data.qpos[moved], abs=0.01)
    assert np.array_equal(rig.data.ctrl, rig.model.key_ctrl[0]), "nobody drives the robot: its ctrl is the owner's"


def test_a_tick_is_published_when_it_ends_with_its_own_step(rig: Rig) -> None:
    recorded: list[tuple[int, int]] = []
    state = rig.recorder.add_state
    rig.recorder.add_state = lambda step, tick, *rest: (recorded.append((step, tick)), state(step, tick, *rest))[1]  # type: ignore[method-assign,assignment]
    for tick in range(1, 4):
        rig.now_ns += TICK_NS
        rig.loop.begin_tick()
        assert len(rig.front.states) == tick - 1, "the state of this tick does not exist yet"
        mujoco.mj_step(rig.model, rig.data)
        rig.now_ns += MS
        rig.loop.end_tick()
        assert (rig.front.states[-1].tick, rig.front.states[-1].session_time) == (tick, rig.now_ns)
    assert recorded == [(0, 1), (1, 2), (2, 3)]


def test_several_steps_between_begin_and_end_are_as_many_ticks(rig: Rig) -> None:
    rig.rounds(4, steps=5)
    assert [row.n_ticks for row in rig.recorder.rows] == [1, 5, 5, 5]
    assert rig.front.states[-1].tick == 20
    rig.data.time += 1e6
    rig.rounds(1)
    assert rig.recorder.rows[-1].n_ticks == 5, "a time that jumps is no motion"


def test_calls_that_do_not_fit(rig: Rig) -> None:
    with pytest.raises(OwnershipError, match="call begin_tick"):
        rig.loop.end_tick()
    rig.rounds(1)
    with pytest.raises(OwnershipError, match="call begin_tick"):
        rig.loop.end_tick()
    rig.loop.begin_tick()
    mujoco.mj_step(rig.model, rig.data)
    rig.now_ns += TICK_NS
    rig.loop.begin_tick()  # ends the one before
    assert rig.front.states[-1].tick == 2
    rig.loop.close()
    with pytest.raises(OwnershipError, match="closed"):
        rig.loop.begin_tick()


@pytest.mark.parametrize("when", ["within a tick", "after an ended tick", "after a tick that was not ended"])
def test_a_silence_is_a_gap(rig: Rig, when: str) -> None:
    """A script that trains, between `begin_tick` and `end_tick` or between two rounds."""
    rig.rounds(3)
    rig.now_ns += TICK_NS
    rig.loop.begin_tick()
    mujoco.mj_step(rig.model, rig.data)
    if when == "after an ended tick":
        rig.loop.end_tick()
    rig.now_ns += 5000 * MS
    if when == "within a tick":
        rig.loop.end_tick()
        rig.now_ns += TICK_NS
    rig.loop.begin_tick()
    gaps = [entry.message for _, entry, _ in rig.read if isinstance(entry.message, StalledGap)]
    assert [gap.duration_ns for gap in gaps] == [5000 * MS + TICK_NS * (when == "within a tick")]


VELOCITY = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
<body name="arm"><joint name="j1" axis="0 0 1"/><geom size=".05"/>
<body name="b" pos=".3 0 0"><joint name="j2" axis="0 1 0"/><geom size=".05"/>
<body name="c" pos=".3 0 0"><joint name="j3" axis="0 1 0"/><geom size=".05"/><site name="tip"/></body></body></body>
<body name="ball" pos="0 0 2"><freejoint/><geom size=".1"/></body></worldbody>
<actuator><velocity name="a1" joint="j1" kv="5"/><velocity name="a2" joint="j2" kv="5"/>
<velocity name="a3" joint="j3" kv="5"/></actuator></mujoco>"""


def test_at_the_end_driven_robots_rest_and_objects_are_free() -> None:
    rig = Rig(mujoco.MjModel.from_xml_string(VELOCITY))
    agent = take_over(rig, rig.stepper.core.config.robots[0].name)
    here = agent.tip()
    agent.drive(lambda t: Pose((here.p[0], here.p[1] + t, here.p[2]), here.q), 0.1)
    ball = rig.model.body("ball").id
    rig.stepper.core.controller._grasps.commanded = {"ball": ((0.5, 0.0, 2.0), (1.0, 0.0, 0.0, 0.0))}
    rig.data.xfrc_applied[ball] = 0.125
    rig.now_ns += TICK_NS
    rig.stepper.core.controller._grasps.set_goals = lambda commands: None  # type: ignore[method-assign]
    rig.loop.begin_tick()
    assert rig.data.ctrl.any()
    assert np.abs(rig.data.xfrc_applied[ball]).max() > 0.2
    rig.loop.close()
    assert not rig.data.ctrl.any()
    assert (rig.data.xfrc_applied[ball] == 0.125).all(), "the owner's forces are back"


@pytest.fixture
def session(simulation: object, model: mujoco.MjModel) -> Iterator[Session]:
    with Session(model, mujoco.MjData(model), QUIET) as session:
        yield session


def test_reset_before_the_first_tick_has_nothing_to_go_back_from(session: Session) -> None:
    session.reset()
    session.set_scale("left", 0.5)
    session.begin_tick()
    mujoco.mj_step(session.model, session.data)
    session.end_tick()
    assert session.recent_events() == []
    session.reset()
    session.begin_tick()
    assert [type(event.body) for event in session.recent_events()] == [SceneChanged]


def test_what_directors_ask_reaches_the_owner_once(rig: Rig) -> None:
    """Whom the authority answers how: `tests/authority/test_session_control.py`."""
    boss, watcher = Agent(rig, role=Role.DIRECTOR), Agent(rig, connection=2, role=Role.OBSERVER)
    rig.round()
    rig.stepper.inputs.post_own(OwnerListens())
    watcher.say(Control(1, "reset"))
    boss.say(Control(4, "reset"))
    boss.say(Episode(5, "start", "stack", 0))
    rig.round()
    for request_id in (6, 7):  # a discard is asked for twice
        boss.say(Episode(request_id, "rerecord", "again"))
        rig.round()
    asked = [(r.kind, r.name, r.label) for r in rig.stepper.requests]
    assert asked == [("reset", "p1", ""), ("rerecord", "p1", "again")]


def test_polling_requests_is_known_to_the_authority_from_then_on(session: Session) -> None:
    assert session.poll_requests() == []
    session.begin_tick()
    session.stepper.requests.append(OwnerRequest("reset", "p1", "ann"))
    assert session.poll_requests() == [OwnerRequest("reset", "p1", "ann")]
    assert session.poll_requests() == []
    assert session.stepper.core.authority._ctx.state.owner_listens
    assert session.driven_robots() == ()
    assert session.status().data_fault is None
    session.data.qvel[0] = np.nan
    session.begin_tick()
    assert session.status().data_fault == DataFault(("qvel",), pytest.approx(session.clock() * 1e-9, abs=60.0))


def test_error_beside_a_step_of_the_helper_is_raised_at_every_tick(rig: Rig) -> None:
    faults = [OSError("no descriptor left")]

    def break_down(_: object) -> None:
        if faults:  # once: the helper's, not that of the call after it
            raise faults.pop()

    rig.rounds(1)
    rig.loop._processes.supervise = break_down  # type: ignore[method-assign]
    rig.now_ns += 40 * MS
    rig.loop._run_helper()
    depths = set()
    for _ in range(3):
        with pytest.raises(OSError, match="no descriptor left") as caught:
            rig.rounds(1)
        depths.add(len(caught.traceback))
    assert len(depths) == 1, "it does not grow"
