"""`ScenePublisher` in simulated time: errors, times, threads, and replay of its recordings."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from iris_session import (
    ConfigError,
    OwnershipError,
    PublishError,
    RobotSpec,
    SceneBuilder,
    ScenePublisher,
    SessionConfig,
)
from iris_session.protocol.scene import Environment, SetVisual
from iris_session.protocol.server_messages import MarkerAdded, SceneChanged
from tests.rig.owned import simulate_sessions
from tests.rig.simulation import Simulation
from tests.session.test_session import QUIET

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
    with ScenePublisher(scene(), QUIET) as session:
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


def test_stream_names_of_deformables_are_reserved(session: ScenePublisher) -> None:
    with pytest.raises(ValueError, match="'deformable-0'"):
        session.publish_media("deformable-0", b"points")
    session.publish_media("deformable-1", b"points")  # of nothing here


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


def test_setting_before_start_and_publishing_after_close_raise() -> None:
    session = ScenePublisher(scene(), QUIET)
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
        ("scene.xml", QUIET, "SceneBuilder"),
        (scene(), "config", "SessionConfig"),
        (scene(), SessionConfig(resume=tmp_path), "recording"),
        (scene(), SessionConfig(assets=False), "assets|draw"),
    ):
        with pytest.raises(ConfigError, match=value):
            ScenePublisher(builder, config)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="scene"):
        ScenePublisher(broken, QUIET).start()


def test_robots_that_the_scene_does_not_have_are_refused_in_one_line(simulation: Simulation) -> None:
    with pytest.raises(ConfigError, match="'nowhere'") as caught:
        ScenePublisher(scene(), QUIET, robots=[RobotSpec("arm", (), (), "", "box", tip_body="nowhere")]).start()
    assert "\n" not in str(caught.value)
