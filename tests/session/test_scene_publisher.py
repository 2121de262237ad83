"""`ScenePublisher` in simulated time: errors, times, threads, and replay of its recordings."""

from __future__ import annotations

import errno
import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from iris_session import (
    Client,
    ConfigError,
    OwnershipError,
    PublishError,
    SceneBuilder,
    ScenePublisher,
    SessionConfig,
)
from iris_session.protocol.scene import Environment, RemoveVisual, SetVisual
from iris_session.protocol.server_messages import MarkerAdded, SceneChanged
from iris_session.scene import AssetStore
from iris_session.session.publish_loop import SILENT_NS
from iris_session.session.scene_publisher import AHEAD_NS, _check_capture
from tests.rig.owned import simulate_sessions
from tests.rig.simulation import Simulation

CONFIG = SessionConfig(control_port=0, state_port=0, beacon_port=0, record=False, web=False)
NAN = float("nan")


def scene() -> SceneBuilder:
    builder = SceneBuilder("bench")
    builder.add_plane("floor")
    builder.add_box("box", half_size=(0.1, 0.1, 0.1), movable=True, position=(1.0, 0.0, 0.0))
    builder.add_deformable("cloth", [(0, 0, 1), (0, 1, 1), (1, 0, 1)], [(0, 1, 2)])
    return builder


@pytest.fixture(scope="module", autouse=True)
def simulation() -> Iterator[Simulation]:
    with simulate_sessions() as simulation:
        yield simulation


@pytest.fixture(scope="module")
def session(simulation: Simulation) -> Iterator[ScenePublisher]:
    """One publisher for all tests that leave it running; like a simulator it gives a time with every state."""
    with ScenePublisher(scene(), CONFIG) as session:
        yield session


def kinds(session: ScenePublisher) -> list[type]:
    return [type(event.body) for event in session.recent_events()]


def box(session: ScenePublisher) -> list[float]:
    """Return the pose of the box in the session."""
    with session._hold_steps():
        assert session._stepper is not None
        return session._stepper.core.world.data.xpos[1].tolist()  # type: ignore[no-any-return]


def test_only_published_values_are_in_the_state(session: ScenePublisher) -> None:
    before = box(session)
    session.set_pose("box", (0.0, 0.0, 2.0))
    session.run(seconds=0.05)
    assert box(session) == before
    session.publish(12.5)
    session.run(until=lambda: box(session) == [0.0, 0.0, 2.0], seconds=30.0)
    assert (session.status().sim_time, session.status().tick) == (12.5, 12_500)


def test_owner_posts_and_patches(session: ScenePublisher) -> None:
    session.marker("begin")
    session.estop("from a script")
    session.run(until=lambda: session.status().estop, seconds=30.0)
    session.clear_estop()
    assert session.scene is not None
    floor = session.scene.visuals[0]
    with pytest.raises(ConfigError, match=r"operation 1, SetVisual: .*rgba\[2\]"):
        session.patch_scene(SetVisual(floor.id, rgba=(0.0, 0.0, NAN, 1.0)))
    session.patch_scene(SetVisual(floor.id, rgba=(0.0, 0.0, 1.0, 1.0)))
    session.run(until=lambda: SceneChanged in kinds(session) and not session.status().estop, seconds=30.0)
    assert MarkerAdded in kinds(session)
    assert session.scene.visuals[0].rgba == (0.0, 0.0, 1.0, 1.0)


@pytest.mark.parametrize(
    ("wrong", "value"),
    [
        (lambda s: s.begin_tick(), "publish"),
        (lambda s: s.end_tick(), "Session"),
        (lambda s: s.load_scene("scene.xml"), "scene"),
        (lambda s: s.assign(["arm"], "ann"), "nothing that people drive"),
        (lambda s: s.set_scale("arm", 0.5), "nothing that people drive"),
        (lambda s: s.pause(), "publish"),
        (lambda s: s.resume(), "publish"),
    ],
)  # fmt: skip
def test_unsupported_methods_of_a_publisher_raise(wrong: Callable[[ScenePublisher], None], value: str) -> None:
    with pytest.raises(OwnershipError, match=value):
        wrong(ScenePublisher(scene(), CONFIG))


def test_invalid_times_raise_and_change_nothing(session: ScenePublisher) -> None:
    session.run(seconds=0.1)
    session.publish(13.0)
    session.run(until=lambda: session.status().sim_time == 13.0, seconds=30.0)
    before = session.status().sim_time
    session.set_pose("box", (9.0, 9.0, 9.0))
    second = 1_000_000_000
    for at, capture, value in (
        (NAN, None, "nan"),
        (-1.0, None, "time_s"),
        (1e10, None, "time_s"),  # more nanoseconds than a recording counts
        ("noon", None, "'noon'"),
        ("1", None, "'1'"),
        (14.0, -1, "nanoseconds"),
        (14.0, 0.5, "nanoseconds"),
        (14.0, session.clock() + second, "session.clock"),
        (14.0, 0, "before"),
        (None, None, "publish"),
    ):
        with pytest.raises(PublishError, match=value):
            session.publish(at, capture_ns=capture)  # type: ignore[arg-type]
    session.run(seconds=0.1)
    assert session.status().sim_time == before
    assert 9.0 not in box(session)
    session.publish(np.float32(14.0), capture_ns=np.int64(session.clock()))  # type: ignore[arg-type]


def test_time_going_back_begins_a_scene_epoch(session: ScenePublisher) -> None:
    before = kinds(session).count(SceneChanged)
    session.publish(15.0)
    session.publish(15.0)  # a world that stands still
    session.publish(4.0)
    session.run(until=lambda: session.status().sim_time == 4.0, seconds=30.0)
    assert kinds(session).count(SceneChanged) == before + 1
    session.reset()
    session.publish(4.5)
    session.run(until=lambda: kinds(session).count(SceneChanged) == before + 2, seconds=30.0)
    session.publish(5.0)
    session.run(until=lambda: session.status().sim_time == 5.0, seconds=30.0)
    assert kinds(session).count(SceneChanged) == before + 2, "a reset is one"


def test_two_states_may_have_the_same_time(session: ScenePublisher) -> None:
    moment = session.clock()
    for time_s in (6.0, 7.0):
        session.publish(time_s, capture_ns=moment)
    session.run(until=lambda: session.status().sim_time == 7.0, seconds=30.0)
    assert session.status().sim_time == 7.0


def test_capture_time_slightly_ahead_is_clamped_to_now() -> None:
    assert _check_capture(7_000 + AHEAD_NS, 7_000) == 7_000
    with pytest.raises(PublishError, match="ahead of"):
        _check_capture(7_001 + AHEAD_NS, 7_000)


def test_reset_during_publish_comes_with_the_next_state(session: ScenePublisher) -> None:
    class Now(float):
        """A time during whose comparison another thread value `reset`."""

        def __gt__(self, other: object) -> bool:
            thread = threading.Thread(target=session.reset)
            thread.start()
            thread.join(0.2)
            return float.__gt__(self, other)  # type: ignore[arg-type, operator]

    session.publish(16.0)
    session.run(until=lambda: session.status().sim_time == 16.0, seconds=30.0)
    before = kinds(session).count(SceneChanged)
    session._time_s = Now(16.0)
    session.publish(16.5)
    session.run(until=lambda: session._anew, seconds=30.0)
    session.publish(17.0)
    session.run(until=lambda: session.status().sim_time == 17.0, seconds=30.0)
    assert kinds(session).count(SceneChanged) == before + 1


def test_silent_publisher_has_aging_state_and_a_warning(session: ScenePublisher) -> None:
    """Like a simulator or a robot driver that hangs: the age of the shown state grows."""
    with Client(session.address, role="observer", name="ann", alignment="not_needed") as ann:
        for i in range(5):
            session.publish(18.0 + 0.1 * i)
        assert ann.wait_for(lambda c: c.scene.state is not None and c.scene.state.header.sim_time == 18.4, 30.0)
        assert ann.scene.state is not None
        shown = ann.scene.state.header
        assert ann.wait_for(lambda c: (c.scene.data_age_ns() or 0) > SILENT_NS, 30.0)
        assert ann.scene.state.header.session_time == shown.session_time
        assert ann.scene.state.header.state_seq > shown.state_seq, "it is sent again, for those who join"
        assert ann.wait_for(lambda c: "nothing was published for" in " ".join(c.status(30.0).warnings), 30.0)
        report = ann.status(30.0)
        way = report.step_to_publish
        assert way is None or way.p99 < 1000.0, "the front is not to blame"
        row = next(row for row in report.participants if row.name == "ann")
        assert row.state_age is None or row.state_age.p99 < 1000.0, "nor her link"
        session.publish(19.0)
        assert ann.wait_for(lambda c: not c.status(30.0).warnings, 30.0)
        assert ann.wait_for(lambda c: c.scene.state is not None and c.scene.state.header.sim_time == 19.0, 30.0)


def test_several_threads_may_publish(session: ScenePublisher) -> None:
    faults: list[BaseException] = []

    def work(x: float) -> None:
        try:
            for _ in range(200):
                session.set_pose("box", (x, x, x))
                session.publish(20.0)
        except BaseException as error:
            faults.append(error)

    threads = [threading.Thread(target=work, args=(float(x),)) for x in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not faults
    session.run(until=lambda: session.status().sim_time == 20.0, seconds=30.0)
    assert len(set(box(session))) == 1, "never half of one and half of another"


def test_setting_before_start_and_publishing_after_close_raise() -> None:
    session = ScenePublisher(scene(), CONFIG)
    for call in (session.publish, session.reset, session.run, lambda: session.marker("x"), lambda: session.address):
        with pytest.raises(OwnershipError, match="not started"):
            call()
    assert (session.name, session.recording, session.superseded, session.stopping) == ("session", None, 0, False)
    with session:
        session.stop()
        session.run()  # ends at once
    assert session.stopping
    for call in (session.publish, session.patch_scene, lambda: session.set_pose("box", (0, 0, 0)), session.start):
        with pytest.raises(OwnershipError, match="closed"):
            call()
    assert session.close()
    with pytest.raises(OwnershipError, match="make another"):
        session.start()


def test_invalid_scene_or_configuration_raises(tmp_path: Path) -> None:
    broken = SceneBuilder("broken")
    broken.add_box("box", half_size=(1.0, 1.0, 1.0), movable=True)
    broken.environment = Environment(extent=math.nan)
    for builder, config, value in (
        ("scene.xml", CONFIG, "SceneBuilder"),
        (scene(), "config", "SessionConfig"),
        (scene(), SessionConfig(resume=tmp_path), "recording"),
        (scene(), SessionConfig(assets=False), "assets|draw"),
    ):
        with pytest.raises(ConfigError, match=value):
            ScenePublisher(builder, config)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="scene"):
        ScenePublisher(broken, CONFIG).start()


def test_probable_mistakes_are_notes_and_late_bodies_raise(tmp_path: Path) -> None:
    """A part in millimetres, and a box that is added after the start."""
    builder = scene()
    trimesh.creation.icosphere(radius=50).export(tmp_path / "ball_mm.stl")
    builder.add_file(tmp_path / "ball_mm.stl", movable=True)
    with ScenePublisher(builder, replace(CONFIG, assets=tmp_path)) as session:
        assert [note for note in session.notes if "100 m" in note]
        session.set_pose("ball_mm", (0, 0, 0))
        builder.add_box("late", half_size=(1, 1, 1), movable=True)
        for say in (
            lambda: session.set_pose("late", (0, 0, 0)),
            lambda: session.set_poses(["box", "late"], np.zeros((2, 3)), [(1, 0, 0, 0)] * 2),
            lambda: session.set_joints("late", {}),
            lambda: session.set_vertices("late", [(0, 0, 0)]),
        ):
            with pytest.raises(PublishError, match="'late'"):
                say()
        with pytest.raises(PublishError, match="nearest: 'box'"):
            session.set_pose("boxx", (0, 0, 0))


def test_store_without_locks_is_a_note(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Network drives have no locks: other processes may remove assets, which is a note."""

    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, "no locks")

    monkeypatch.setattr(AssetStore, "hold", no_locks)
    with ScenePublisher(scene(), replace(CONFIG, assets=tmp_path)) as session:
        session.publish()
        assert any("cannot be held" in note for note in session.notes)


def test_error_that_stopped_the_session_is_raised_by_later_calls(monkeypatch: pytest.MonkeyPatch) -> None:
    with ScenePublisher(scene(), CONFIG) as session:
        assert session._stepper is not None
        assert session.scene is not None
        before, floor = session.scene, session.scene.visuals[0]

        def broken(*_: object, **__: object) -> None:
            raise KeyError("the core is broken")

        monkeypatch.setattr(session._stepper.core, "step", broken)
        with pytest.raises(KeyError, match="broken"):
            session.run(seconds=30.0)
        for call in (
            session.publish,
            lambda: session.estop("now"),
            lambda: session.patch_scene(RemoveVisual(floor.id)),
        ):
            with pytest.raises(KeyError, match="broken"):
                call()
        assert session.scene is before
