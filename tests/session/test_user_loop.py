"""The session in a user's loop: resets, several steps per tick, what is published when, and how it ends."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
import pytest

from iris_session import OwnershipError, Session
from iris_session.demo.scenes import scene_path
from iris_session.physics import load_model
from iris_session.protocol.entries import Entry, ExternalReset, StalledGap
from iris_session.protocol.server_messages import SceneChanged
from iris_session.session.stepper import Stepper
from iris_session.session.user_loop import UserLoop
from tests.session.loops import Watch, wait_for
from tests.session.play import TICK_NS, make_core
from tests.session.test_session import QUIET
from tests.session.test_stepper import MS, Front, Recorder


class Rig:
    """A user's loop over the demo scene whose clock the test moves; the helper thread is real."""

    def __init__(self, model: mujoco.MjModel | None = None) -> None:
        self.now_ns = 0
        self.model = model or load_model(scene_path("handover"))
        self.data = mujoco.MjData(self.model)
        if self.model.nkey:
            mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        self.front, self.recorder = Front(), Recorder()
        core = make_core(self.model, user_owned_loop=True)
        self.stepper = Stepper(core, self.front, self.recorder, lambda: self.now_ns, MS, 1000 * MS, b"root")
        self.read: list[tuple[int, Entry, bytes]] = []  # step, entry and the plant of that step
        self.stepper.on_entries = self._note
        self.loop = UserLoop(self.model, self.data, self.stepper, Watch())  # type: ignore[arg-type]

    def _note(self, entries: Sequence[Entry]) -> None:
        plant = self.stepper.core.world.save_state()
        self.read += [(self.stepper.step_count, entry, plant) for entry in entries]

    def resets(self) -> list[bytes]:
        return [plant for _, entry, plant in self.read if isinstance(entry.message, ExternalReset)]

    def rounds(self, n: int, steps: int = 1) -> None:
        for _ in range(n):
            self.now_ns += TICK_NS
            self.loop.begin_tick()
            for _ in range(steps):
                mujoco.mj_step(self.model, self.data)
            self.loop.end_tick()

    def idle(self) -> None:
        """The user's loop is silent until the helper has taken a step."""
        steps = self.stepper.step_count
        self.now_ns += 40 * MS
        wait_for(lambda: self.stepper.step_count > steps)


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.loop.close()


def test_a_reset_is_read_with_the_state_after_it(rig: Rig) -> None:
    """The helper's steps between the word and the tick are on the old plant: robots would be driven back to it."""
    rig.rounds(5)
    moved = rig.model.joint(rig.stepper.core.config.robots[0].joints[0]).qposadr[0]
    rig.loop.reset()
    rig.data.qpos[moved] += 0.4
    rig.idle()
    assert rig.resets() == []
    rig.rounds(1)
    (plant,) = rig.resets()
    assert np.frombuffer(plant)[1 + moved] == pytest.approx(rig.data.qpos[moved], abs=0.01)
    actuator = rig.model.actuator(rig.stepper.core.config.robots[0].actuators[0]).id
    assert rig.data.ctrl[actuator] == pytest.approx(rig.data.qpos[moved], abs=0.02)


def test_a_reset_without_finite_numbers_waits_for_them(rig: Rig) -> None:
    rig.rounds(3)
    rig.data.qpos[0] = np.nan
    rig.loop.reset()
    rig.loop.begin_tick()
    assert rig.resets() == []
    mujoco.mj_resetDataKeyframe(rig.model, rig.data, 0)
    rig.loop.end_tick()
    rig.rounds(1)
    assert len(rig.resets()) == 1


def test_time_that_goes_back_is_one_reset(rig: Rig) -> None:
    rig.rounds(5)
    mujoco.mj_resetDataKeyframe(rig.model, rig.data, 0)
    rig.rounds(5)
    rig.loop.begin_tick()
    mujoco.mj_resetDataKeyframe(rig.model, rig.data, 0)
    rig.loop.end_tick()
    rig.idle()
    rig.rounds(2)
    assert len(rig.resets()) == 2
    assert len(rig.front.states) > 5


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
    assert rig.recorder.rows[-1].n_ticks == 100, "a time that jumps is no motion"


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


@pytest.mark.parametrize("ended", [True, False])
def test_a_silence_is_a_gap_whether_the_tick_was_ended_or_not(rig: Rig, ended: bool) -> None:
    rig.rounds(3)
    rig.now_ns += TICK_NS
    rig.loop.begin_tick()
    mujoco.mj_step(rig.model, rig.data)
    if ended:
        rig.loop.end_tick()
    rig.now_ns += 5000 * MS
    rig.loop.begin_tick()
    gaps = [entry.message for _, entry, _ in rig.read if isinstance(entry.message, StalledGap)]
    assert [gap.duration_ns for gap in gaps] == [5000 * MS]


VELOCITY = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
<body name="arm"><joint name="j1" axis="0 0 1"/><geom size=".05"/>
<body name="b" pos=".3 0 0"><joint name="j2" axis="0 1 0"/><geom size=".05"/>
<body name="c" pos=".3 0 0"><joint name="j3" axis="0 1 0"/><geom size=".05"/><site name="tip"/></body></body></body>
<body name="ball" pos="0 0 2"><freejoint/><geom size=".1"/></body></worldbody>
<actuator><velocity name="a1" joint="j1" kv="5"/><velocity name="a2" joint="j2" kv="5"/>
<velocity name="a3" joint="j3" kv="5"/></actuator></mujoco>"""


def test_at_the_end_robots_rest_and_objects_are_free() -> None:
    rig = Rig(mujoco.MjModel.from_xml_string(VELOCITY))
    rig.rounds(3)
    ball = rig.model.body("ball").id
    controller = rig.stepper.core.controller
    controller._joints.v[:] = 1.0  # as in the middle of a motion
    controller._grasps.commanded = {"ball": ((0.5, 0.0, 2.0), (1.0, 0.0, 0.0, 0.0))}
    twin = rig.stepper.core.world.data
    controller.tick(twin)
    rig.loop._write_controls()
    assert rig.data.ctrl.any()
    assert rig.data.xfrc_applied[ball].any()
    rig.loop.close()
    assert not rig.data.ctrl.any()
    assert not rig.data.xfrc_applied.any()


def test_the_helper_never_steps_while_something_is_read() -> None:
    model = load_model(scene_path("handover"))
    with Session(model, mujoco.MjData(model), QUIET) as session:
        session.begin_tick()
        stepper = session.stepper
        wait_for(lambda: stepper.step_count > 2)  # the helper's
        lock = session._hold_steps()
        with lock:
            steps = stepper.step_count
            reader = threading.Thread(target=session.status)
            reader.start()
            reader.join(0.1)
            assert reader.is_alive(), "status() waits for the lock of the steps"
            assert stepper.step_count == steps
        reader.join(10.0)
        assert session.targets().keys() == {"left", "right"}


def test_reset_before_the_first_tick_has_nothing_to_go_back_from() -> None:
    model = load_model(scene_path("handover"))
    data = mujoco.MjData(model)
    with Session(model, data, QUIET) as session:
        session.reset()
        session.set_scale("left", 0.5)
        session.begin_tick()
        mujoco.mj_step(model, data)
        session.end_tick()
        assert session.recent_events() == []
        session.reset()
        session.begin_tick()
        assert [type(event.body) for event in session.recent_events()] == [SceneChanged]


def test_attach_sees_a_reset_after_exactly_one_step() -> None:
    model = load_model(scene_path("handover"))
    data = mujoco.MjData(model)
    session = Session.attach(model, data, QUIET)
    try:
        mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        mujoco.mj_forward(model, data)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_step(model, data)
        assert [type(event.body) for event in session.recent_events()] == [SceneChanged]
        mujoco.mj_step(model, data)
        mujoco.mj_resetData(model, data)
        for _ in range(3):
            mujoco.mj_step(model, data)
        assert [type(event.body) for event in session.recent_events()] == [SceneChanged] * 2
    finally:
        session.close()


def test_attach_takes_no_viewer_for_a_reset() -> None:
    """MuJoCo's passive viewer clears the timers of the data at every sync."""
    model = load_model(scene_path("handover"))
    data = mujoco.MjData(model)
    session = Session.attach(model, data, QUIET)
    try:
        for step in range(60):
            mujoco.mj_step(model, data)
            if step % 8 == 0:
                data.timer.number[:] = 0
                mujoco.mj_forward(model, data)
                data.timer.number[:] = 0
                mujoco.mj_forward(model, data)
        assert session.recent_events() == []
        assert session.status().tick >= 59
    finally:
        session.close()


def test_a_callback_of_somebody_else_stays() -> None:
    model = load_model(scene_path("handover"))
    session = Session.attach(model, mujoco.MjData(model), QUIET)

    def other(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        pass

    try:
        mujoco.set_mjcb_control(other)
        session.close()
        assert mujoco.get_mjcb_control() is other
    finally:
        mujoco.set_mjcb_control(None)
        session.close()


def test_what_stopped_the_helper_is_raised_at_every_tick_and_does_not_fill_the_memory(rig: Rig) -> None:
    def broken(*_: object, **__: object) -> None:
        raise KeyError("the core is broken")

    rig.rounds(1)
    rig.stepper.core.step = broken  # type: ignore[method-assign,assignment]
    rig.now_ns += 40 * MS
    rig.loop._helper.join(10.0)
    depths = set()
    for _ in range(3):
        with pytest.raises(KeyError, match="broken") as caught:
            rig.rounds(1)
        depths.add(len(caught.traceback))
    assert len(depths) == 1
