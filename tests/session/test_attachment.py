"""`Session.attach`: MuJoCo's step functions are wrapped for the data attached, and for nothing else."""

from __future__ import annotations

import contextlib
import copy
import functools
import os
import pickle
import sys
import threading
import types
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest

from iris_session import ConfigError, OwnershipError, Session
from iris_session.demo.scenes import n_arms_scene, scene_path
from iris_session.physics import load_model
from iris_session.protocol.server_messages import SceneChanged
from iris_session.session.attachment import STEP_FUNCTIONS, Attachment
from iris_session.simulators.wrapping import wrap_calls
from tests.rig.owned import keep_journal
from tests.session.loops import Agent, Rig
from tests.session.test_session import QUIET
from tests.session.test_stepper import MS

ORIGINALS = {name: getattr(mujoco, name) for name in STEP_FUNCTIONS}


@pytest.fixture(autouse=True)
def _no_trace() -> Iterator[None]:
    yield
    assert mujoco.get_mjcb_control() is None
    for name, function in ORIGINALS.items():
        assert getattr(mujoco, name) is function, "the last session gives MuJoCo's functions back"


class Attached:
    """A loop without processes whose data is attached, and a program so slow that a state is due after every step."""

    def __init__(self, model: mujoco.MjModel | None = None) -> None:
        self.rig = Rig(model)
        self.rig.stepper.clock = self.read_clock
        self.model, self.data = self.rig.model, self.rig.data
        self.attachment = Attachment(self.rig.loop, None, "step", lambda model, data: None)

    def read_clock(self) -> int:
        self.rig.now_ns += 10 * MS
        return self.rig.now_ns

    @property
    def counts(self) -> list[int]:
        """Ticks of every step of the session: none in those that only look."""
        return [row.n_ticks for row in self.rig.recorder.rows]

    def changes(self) -> int:
        """New epochs so far."""
        events = [event.body for decision in self.rig.front.decisions for event in decision.events]
        return len([body for body in events if isinstance(body, SceneChanged)])

    def close(self) -> None:
        self.attachment.close()
        self.rig.loop.close()


@pytest.fixture
def attached() -> Iterator[Attached]:
    attached = Attached()
    yield attached
    attached.close()


def make_data(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    return data


# --- what is wrapped --------------------------------------------------------------------------------------------------


def test_models_can_be_compiled_and_forward_is_no_tick(attached: Attached) -> None:
    model, data = attached.model, attached.data
    assert mujoco.get_mjcb_control() is None
    assert mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>").nbody == 1
    mujoco.mj_forward(model, data)
    assert attached.counts == []
    mujoco.mj_step(model, data)
    mujoco.mj_step(m=model, d=data, nstep=3)
    assert attached.counts == [0] * 4
    mujoco.mj_step1(model, data)
    mujoco.mj_step2(model, data)
    assert attached.counts == [0] * 5
    assert data.time == pytest.approx(5 * 0.002)


def test_names_bound_before_are_wrapped_in_every_module_and_restored(monkeypatch: pytest.MonkeyPatch) -> None:
    script, late = types.ModuleType("a_script"), types.ModuleType("imported_later")
    exec("from mujoco import mj_step\nfrom mujoco import mj_step as advance, mj_step2", script.__dict__)
    monkeypatch.setitem(sys.modules, "a_script", script)
    with contextlib.closing(Attached()) as attached:
        script.mj_step(attached.model, attached.data)
        script.advance(attached.model, attached.data)
        exec("from mujoco import mj_step", late.__dict__)
        monkeypatch.setitem(sys.modules, "imported_later", late)
        late.mj_step(attached.model, attached.data)
        assert attached.counts == [0, 0, 0]
    assert script.mj_step is script.advance is late.mj_step is ORIGINALS["mj_step"]
    assert script.mj_step2 is ORIGINALS["mj_step2"]


@pytest.mark.parametrize("first", [0, 1])
def test_two_sessions_in_one_process_close_in_any_order(first: int) -> None:
    with contextlib.closing(Attached()) as a, contextlib.closing(Attached()) as b:
        both = [a, b]
        with pytest.raises(OwnershipError, match="attached"):
            Attachment(both[0].rig.loop, None, "step", lambda model, data: None)
        for one in both:
            mujoco.mj_step(one.model, one.data)
        assert [one.counts for one in both] == [[0], [0]]
        both[first].close()
        for one in both:
            mujoco.mj_step(one.model, one.data)
        assert [len(one.counts) for one in both] == ([1, 2] if first == 0 else [2, 1])


@pytest.mark.usefixtures("simulation")
def test_a_control_callback_of_the_script_is_refused(model: mujoco.MjModel) -> None:
    """MuJoCo calls it for the session's own data, too, and compiles no model while it is set."""
    try:
        mujoco.set_mjcb_control(lambda m, d: None)
        with pytest.raises(OwnershipError, match="mjcb_control"):
            Session.attach(model, make_data(model), QUIET)
    finally:
        mujoco.set_mjcb_control(None)


# --- resets -----------------------------------------------------------------------------------------------------------


def test_a_reset_after_exactly_one_step_is_seen(attached: Attached) -> None:
    model, data = attached.model, attached.data
    mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_step(model, data)
    assert attached.changes() == 1
    mujoco.mj_step(model, data)
    mujoco.mj_resetData(model, data)
    for _ in range(3):
        mujoco.mj_step(model, data)
    assert attached.changes() == 2


# --- environments -----------------------------------------------------------------------------------------------------


class Environment:
    """As Gymnasium's and robosuite's: `ctrl` is written in `step`; a hard reset builds model and data anew."""

    def __init__(self, arms: int = 2, advance: Any = None) -> None:
        self.arms, self.advance = arms, advance
        self.reset()

    def reset(self) -> None:
        self.model = n_arms_scene(self.arms, objects=1).compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)

    def step(self, frames: int = 5) -> str:
        for _ in range(frames):
            (self.advance or mujoco.mj_step)(self.model, self.data)
        return "observation"


@pytest.mark.usefixtures("simulation")
def test_an_environment_is_followed_to_the_model_that_it_builds_at_a_reset() -> None:
    environment = Environment()
    session = Session.attach(environment=environment, config=QUIET)
    try:
        journal = keep_journal(session.stepper)
        session.stepper.is_state_due = lambda end_ns: True  # type: ignore[method-assign]
        assert environment.step() == "observation"
        assert [row.n_ticks for row in journal.rows] == [0], (
            "the state at the end of its step is looked at, not that of the first of many in it"
        )
        environment.reset()  # the same model, compiled again
        assert session.data is environment.data, "shown before the step after it"
        environment.step()
        assert [e.body.cause for e in session.recent_events() if isinstance(e.body, SceneChanged)] == ["external"]
        environment.arms = 3
        environment.reset()
        environment.step()
        assert [e.body.cause for e in session.recent_events() if isinstance(e.body, SceneChanged)][1:] == ["new_scene"]
        assert len(session.robots) == 3
        assert session.data is environment.data
        for _ in range(10):
            environment.step()
        mujoco.mj_step(environment.model, mujoco.MjData(environment.model))
        assert len(journal.rows) == 16, "a reset is looked at, too, and a new model is loaded by a step"
        assert session.status().sim_time == pytest.approx(environment.data.time)
    finally:
        session.close()
    assert "step" not in vars(environment)
    assert journal.verify() >= 15


@pytest.fixture
def paced(attached: Attached) -> Attached:
    """A program whose clock the test moves; a state is due every 16 ms."""
    attached.rig.stepper.clock = lambda: attached.rig.now_ns
    attached.rig.stepper._state_period_ns = 16 * MS
    return attached


def test_while_nobody_drives_the_program_is_looked_at_at_the_rate_of_the_state(paced: Attached) -> None:
    rig = paced.rig
    for _ in range(400):
        rig.now_ns += 2 * MS
        mujoco.mj_step(paced.model, paced.data)
    assert paced.counts == [0] * 51, "the first step, and every 16 ms"
    assert len(rig.front.states) == 51
    assert rig.front.states[-1].sim_time == pytest.approx(0.8, abs=0.016)
    assert rig.loop.list_warnings() == ()


def test_the_newest_state_of_a_slow_program_is_shown_at_once_although_the_old_one_was_just_shown_again(
    paced: Attached,
) -> None:
    rig = paced.rig
    for _ in range(10):
        mujoco.mj_step(paced.model, paced.data)
        assert rig.front.states[-1].sim_time == pytest.approx(paced.data.time, abs=1e-9)
        shown = len(rig.front.states)
        for _ in range(5):
            rig.now_ns += 10 * MS
            rig.loop._take_helper_step()
        assert len(rig.front.states) > shown
        assert not rig.stepper.is_state_due(rig.now_ns)


def test_a_robot_that_is_engaged_in_a_step_of_the_helper_is_driven_from_the_next_step_of_the_program_on(
    attached: Attached,
) -> None:
    rig = attached.rig
    ann = Agent(rig)
    rig.rounds(4)
    ann.acquire()
    mujoco.mj_step(attached.model, attached.data)
    ctrl = attached.data.ctrl.copy()
    here = ann.tip()
    ann.sample(here, clutch=False)
    rig.loop._take_helper_step()
    ann.sample(here, clutch=True)
    rig.now_ns += 100 * MS
    rig.loop._take_helper_step()
    assert rig.loop.is_driving
    attached.data.ctrl[:] = ctrl + 0.1  # the program goes on
    mujoco.mj_step(attached.model, attached.data)
    assert rig.recorder.rows[-1].n_ticks == 1
    np.testing.assert_allclose(attached.data.ctrl, ctrl + 0.1, atol=0.01)


# --- other data -------------------------------------------------------------------------------------------------------


class Followed(Attached):
    """A program that is attached without its environment, as the rig's session follows it."""

    def __init__(self) -> None:
        super().__init__()
        self.rig.stepper.clock = lambda: self.rig.now_ns
        self.found: list[Any] = []
        self.attachment._change_model = self.change_model  # type: ignore[method-assign]

    def change_model(self, model: Any, data: Any) -> None:
        self.found.append(data)
        self.rig.loop.change_model(model, data, lambda state: None)

    def step(self, model: Any, data: Any, seconds: float) -> None:
        for _ in range(round(seconds * 100)):
            self.rig.now_ns += 10 * MS
            mujoco.mj_step(model, data)


@pytest.fixture
def followed() -> Iterator[Followed]:
    followed = Followed()
    yield followed
    followed.close()


@pytest.mark.parametrize("is_same_model", [False, True])
def test_data_that_the_program_has_thrown_away_is_followed_by_the_next(followed: Followed, is_same_model: bool) -> None:
    """Of the same model after a second: a planner may step copies of `session.data`, which only the session holds."""
    followed.step(followed.model, followed.data, 0.1)
    followed.rig.now_ns += 10 * MS
    del followed.data
    followed.rig.data = None  # type: ignore[assignment]
    held = followed.rig.loop.data  # as the session holds it, too
    model = followed.model if is_same_model else load_model(scene_path("handover"))
    anew = make_data(model)
    if is_same_model:
        followed.step(model, anew, 0.9)
        assert followed.found == []
        followed.step(model, anew, 0.2)
    else:
        mujoco.mj_step(model, anew)
    assert followed.found == [anew]
    assert followed.rig.loop.data is anew
    del held


def test_a_world_that_is_built_anew_is_followed_although_the_old_one_is_kept(followed: Followed) -> None:
    followed.step(followed.model, followed.data, 0.1)
    model = load_model(scene_path("handover"))
    data = make_data(model)
    followed.step(model, data, 0.2)
    assert followed.found == []
    followed.step(model, data, 0.2)
    assert followed.found == [data]
    assert followed.changes() == 1
    assert followed.attachment.list_warnings() == ()


def test_copies_that_a_planner_steps_are_not_followed_and_a_warning_says_so(followed: Followed) -> None:
    followed.step(followed.model, followed.data, 0.1)
    copy_, other = make_data(followed.model), mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
    followed.step(followed.model, copy_, 0.4)
    assert followed.attachment.list_warnings() == ()
    followed.step(other, mujoco.MjData(other), 0.4)
    assert followed.found == []
    (warning,) = followed.attachment.list_warnings()
    assert "share(env)" in warning
    followed.step(followed.model, followed.data, 0.1)
    assert followed.attachment.list_warnings() == (), "the attached data goes on"


class Owner(Environment):
    """An environment in the rig. `count`: its own calls of `step`."""

    def __init__(self, rig: Rig) -> None:
        self.model, self.data, self.count, self.advance = rig.model, rig.data, 0, None
        self.place: Any = self.place_and_step

    def place_and_step(self) -> None:
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        mujoco.mj_step(self.model, self.data)

    def reset(self) -> None:
        self.place()

    def step(self, frames: int = 5) -> str:
        self.count += 1
        return super().step(frames)


class PlainEnvironment:
    """An environment that can be pickled."""

    count = 0

    def step(self) -> int:
        self.count += 1
        return self.count


class Owned(Attached):
    """A loop without processes whose environment is attached."""

    def __init__(self) -> None:
        self.rig = Rig()
        self.rig.stepper.clock = self.read_clock
        self.model, self.data = self.rig.model, self.rig.data
        self.environment = Owner(self.rig)
        self.error: Exception | None = None
        self.attachment = Attachment(self.rig.loop, self.environment, "step", self.change_model)

    def change_model(self, model: Any, data: Any) -> None:
        if self.error is not None:
            raise self.error
        self.rig.loop.change_model(model, data, lambda state: None)


@pytest.fixture
def owned() -> Iterator[Owned]:
    owned = Owned()
    yield owned
    owned.close()


@pytest.mark.parametrize("is_opaque", [False, True])
def test_while_someone_drives_every_step_is_a_tick(owned: Owned, is_opaque: bool) -> None:
    """An environment whose steps are not seen through gives as many ticks as its step had."""
    rig = owned.rig
    rig.stepper.clock, rig.stepper._state_period_ns = lambda: rig.now_ns, 16 * MS
    owned.environment.advance = functools.partial(ORIGINALS["mj_step"]) if is_opaque else None

    def take_step(steps: int = 1) -> None:
        rig.now_ns += 10 * MS
        owned.environment.step()

    rig.round = take_step  # type: ignore[method-assign]
    ann = Agent(rig)
    rig.rounds(4)
    ann.acquire()
    ann.engage(0.04)
    assert rig.loop.is_driving
    before = len(owned.counts)
    rig.rounds(3)
    assert [n for n in owned.counts[before:] if n] == ([5] * 3 if is_opaque else [1] * 15)
    assert rig.loop.overwritten == 0
    ann.release()
    rig.rounds(60)
    assert not rig.loop.is_driving
    before = len(owned.counts)
    rig.rounds(16)
    assert len(owned.counts) - before == 10, "16 steps of 10 ms, a look each 16 ms"


def test_a_copy_or_pickle_of_the_environment_steps_itself(owned: Owned) -> None:
    twin = copy.deepcopy(owned.environment)
    before = owned.data.time
    twin.step()
    assert (owned.environment.count, twin.count) == (0, 1)
    assert owned.data.time == before < twin.data.time
    assert twin.step.__self__ is twin  # type: ignore[attr-defined]
    plain = PlainEnvironment()
    remove = wrap_calls(plain, "step", lambda call, *_: call())
    twin_of_plain = pickle.loads(pickle.dumps(plain))
    assert (plain.step(), twin_of_plain.step(), twin_of_plain.step()) == (1, 1, 2)
    remove()


def test_a_step_that_is_not_seen_through_is_looked_at(owned: Owned) -> None:
    owned.environment.advance = functools.partial(ORIGINALS["mj_step"])
    for _ in range(4):
        owned.environment.step()
    assert owned.counts == [0] * 4
    assert owned.rig.front.states[-1].sim_time == pytest.approx(owned.data.time)
    owned.close()
    owned.environment.step()
    assert len(owned.counts) == 4


def test_a_reset_that_steps_is_one_new_epoch(owned: Owned) -> None:
    owned.environment.step()
    for _ in range(3):
        owned.environment.reset()
        owned.environment.step()
    assert owned.changes() == 3


def test_another_pose_at_the_same_time_is_a_reset(owned: Owned) -> None:
    """A participant may have engaged while the program was silent: the robot does not go back to where it stood."""

    def push() -> None:
        owned.data.qpos[owned.rig.joints()] += 0.3

    owned.environment.place = push
    for count in (1, 2):
        owned.environment.reset()
        assert len(owned.rig.resets()) == count


def test_a_forked_child_steps_without_the_session(owned: Owned) -> None:
    began = owned.data.time
    child = os.fork()
    if child == 0:
        owned.environment.step()
        mujoco.mj_step(owned.model, owned.data)
        is_stepped = owned.environment.count == 1 and owned.data.time == pytest.approx(began + 6 * 0.002)
        os._exit(0 if is_stepped and not owned.counts else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_an_error_beside_a_step_of_the_session_ends_it_and_not_the_program(owned: Owned) -> None:
    """A process that cannot be started, for example."""

    def fail(*_: object) -> None:
        raise OSError("no space left on device")

    owned.environment.step()
    owned.rig.loop._processes.supervise = fail  # type: ignore[method-assign]
    owned.rig.loop.reset()
    owned.environment.step()
    assert owned.rig.loop.is_closed
    owned.environment.step()
    assert owned.environment.count == 3


def test_a_session_that_ends_meanwhile_raises_nothing_into_the_step(owned: Owned) -> None:
    def advance(model: Any, data: Any) -> None:
        mujoco.mj_step(model, data)
        owned.rig.loop.close()

    owned.environment.advance = advance
    assert owned.environment.step() == "observation"
    owned.environment.advance = None
    mujoco.mj_step(owned.model, owned.data)
    assert owned.environment.step() == "observation"


def test_ctrl_c_in_a_step_of_the_session_ends_the_session_and_not_the_program(
    owned: Owned, monkeypatch: pytest.MonkeyPatch
) -> None:
    owned.environment.step()
    with monkeypatch.context() as patch:

        def interrupt(*_: Any, **__: Any) -> None:
            raise KeyboardInterrupt

        patch.setattr(owned.rig.stepper.core, "step", interrupt)
        with pytest.raises(KeyboardInterrupt):
            owned.environment.step()
    before = owned.data.time
    assert owned.environment.step() == "observation"
    mujoco.mj_step(owned.model, owned.data)
    assert owned.data.time == pytest.approx(before + 6 * 0.002)
    assert owned.rig.loop.is_closed


def test_a_model_that_the_session_cannot_take_is_a_warning(owned: Owned) -> None:
    owned.environment.step()
    owned.error = OSError("no space left on device")
    owned.environment.model = load_model(scene_path("handover"))
    owned.environment.data = make_data(owned.environment.model)
    for _ in range(3):
        owned.environment.step()
    (warning,) = owned.attachment.list_warnings()
    assert "no space" in warning
    refused, owned.environment.data = owned.environment.data, owned.data
    owned.environment.step()
    assert owned.attachment.list_warnings() == (), "the program is at the old data again"
    owned.environment.data = refused
    owned.environment.step()
    assert owned.attachment.list_warnings() != ()
    owned.error = None
    owned.environment.data = make_data(owned.environment.model)
    owned.environment.step()
    assert owned.rig.loop.data is owned.environment.data
    assert owned.attachment.list_warnings() == ()


def test_an_environment_is_followed_in_whatever_thread_it_steps(owned: Owned) -> None:
    owned.environment.step()
    owned.environment.data = make_data(owned.model)
    thread = threading.Thread(target=owned.environment.step)
    thread.start()
    thread.join()
    assert owned.rig.loop.data is owned.environment.data


def test_what_cannot_be_attached_is_refused(model: mujoco.MjModel) -> None:
    with pytest.raises(ConfigError, match="model and data"):
        Session.attach(config=QUIET)
    with pytest.raises(OwnershipError, match="'advance_it'"):
        Session.attach(environment=Environment(), config=QUIET, step="advance_it")


def test_steps_that_are_not_seen_are_a_warning(attached: Attached) -> None:
    for _ in range(600):
        ORIGINALS["mj_step"](attached.model, attached.data)
    assert any("outside of the session's ticks" in text for text in attached.rig.loop.list_warnings())


@pytest.mark.usefixtures("simulation")
@pytest.mark.parametrize("choice", ["none", "arm1"])
def test_the_choice_of_robots_holds_for_the_model_that_is_built_at_a_reset(choice: str) -> None:
    environment = Environment(arms=3)
    with Session.attach(environment=environment, config=QUIET, robots=choice) as session:
        chosen = [robot.name for robot in session.robots]
        assert chosen == ([] if choice == "none" else [choice])
        environment.step()
        environment.arms = 4
        environment.reset()
        environment.step()
        assert session.model is environment.model
        assert [robot.name for robot in session.robots] == chosen
