"""Episodes in a session with its people, in simulated time. Every rig verifies its journal bit for bit at the end."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from iris_session import scene_path
from iris_session.client import Client, DeniedError
from iris_session.protocol.server_messages import EpisodeChanged
from iris_session.session.errors import ConfigError
from iris_session.session.tasks import load_task
from tests.rig.session import Rig
from tests.session.test_tasks import POUR

TICK = 0.01  # [s]


@pytest.fixture
def task(tmp_path: Path) -> Path:
    path = tmp_path / "swap.toml"
    path.write_text(POUR)
    return path


def see_objects(client: Client) -> NDArray[np.float64]:
    """Return where a client sees the objects of the task, shape (2, 3) [m]."""
    state = client.scene.state
    assert state is not None
    return state.poses[[client.mirror.body_index[name] for name in ("hammer", "board")], :3].astype(np.float64)


def states(rig: Rig, name: str) -> list[tuple[int, str]]:
    return [(event.number, event.state) for _, event in rig.list_events(name, EpisodeChanged)]


def test_two_people_record_a_task_whose_objects_lie_elsewhere_each_time(task: Path) -> None:
    with Rig(timestep=TICK, task=task) as rig:
        ann, bob = rig.drive("ann", "left"), rig.drive("bob", "right")
        assert ann.client.connection.welcome is not None
        assert ann.client.connection.welcome.task_robots == ("left", "right")
        first = see_objects(ann.client)
        begun = ann.client.start_episode("blue")
        assert begun == bob.client.mirror.episode
        assert (begun.number, begun.instruction, begun.robots) == (
            1,
            "Swap the hammer and the board.",
            ("left", "right"),
        )
        rig.run(1.0)
        ended = bob.client.end_episode()
        assert (ended.state, ended.successes, ended.wanted, ended.label) == ("success", 1, 50, "blue")
        rig.run(0.2)
        second = see_objects(ann.client)
        assert np.abs(first - second)[:, :2].max() > 0.01
        ann.client.start_episode(countdown_s=0)
        again = ann.client.discard_episode(again=True)
        assert (again.state, again.number) == ("countdown", 2)
        rig.run(0.2)
        third = see_objects(ann.client)
        assert third == pytest.approx(second, abs=2e-3), "the same number has the same places"
        bob.client.estop("a visitor")
        rig.run(0.2)
        assert states(rig, "ann")[-1] == (2, "cancelled")
    so_far = load_task(task)
    assert so_far is not None
    assert (so_far.recorded, so_far.successes) == (2, 1)
    with Rig(timestep=TICK, task=task) as rig:
        desk = rig.join("desk", "director")
        assert desk.mirror.episode is not None
        assert (desk.mirror.episode.state, desk.mirror.episode.successes) == ("idle", 1)
        assert desk.start_episode(countdown_s=0).number == 3
        rig.session.reset()
        rig.run(0.5)
        assert states(rig, "desk")[-1] == (3, "unknown")


def test_desk_takes_over_an_episode_whose_starter_was_killed_and_another_one_ends_unknown() -> None:
    with Rig(timestep=TICK) as rig:
        ann, bob = rig.drive("ann", "left"), rig.join("bob")
        rig.join("desk", "director")
        ann.client.start_episode(countdown_s=0)
        with pytest.raises(DeniedError, match="who is there"):
            bob.take_over_episode()
        rig.kill(ann.client)
        rig.run_until(lambda: states(rig, "desk")[-1] == (1, "left"), "the starter is gone", 5.0)
        assert bob.take_over_episode().led_by == bob.participant_id
        assert bob.end_episode("failure").state == "failure"
        bob.acquire("right")
        bob.start_episode(countdown_s=0)
        rig.kill(bob)
        rig.run_until(lambda: states(rig, "desk")[-1] == (2, "left"), "the starter is gone", 5.0)
        rig.run(10.1)
        assert states(rig, "desk")[-1] == (2, "unknown")


def test_a_task_that_does_not_fit_the_scene_is_refused_at_the_start(task: Path) -> None:
    task.write_text(POUR.replace("objects.board", "objects.moon"))
    with pytest.raises(ConfigError, match=r"unknown objects \['moon'\]"), Rig(timestep=TICK, task=task):
        pass


def test_in_another_scene_objects_are_placed_too_and_episodes_close_at_once(task: Path) -> None:
    with Rig(timestep=TICK, task=task) as rig:
        desk = rig.join("desk", "director")
        desk.start_episode(countdown_s=0)
        model = mujoco.MjModel.from_xml_path(str(scene_path("handover")))
        model.opt.timestep = TICK
        rig.session.load_scene(model).result(60.0)
        rig.run_until(lambda: states(rig, "desk")[-1] == (1, "unknown"), "the scene is another one", 1.0)
        rig.run(0.2)
        first = see_objects(desk)
        home = model.key_qpos[0] if model.nkey else model.qpos0
        at = [model.jnt_qposadr[model.body_jntadr[model.body(name).id]] for name in ("hammer", "board")]
        assert np.abs(first - [home[i : i + 3] for i in at]).max() > 0.01, "they do not lie where the file has them"
        desk.start_episode(countdown_s=0)
        desk.end_episode()
        rig.run(0.2)
        assert states(rig, "desk")[-2:] == [(2, "closing"), (2, "success")]
        closing, success = (now_ns for now_ns, _ in rig.list_events("desk", EpisodeChanged)[-2:])
        assert success - closing <= 2 * TICK * 1e9
        assert np.abs(see_objects(desk) - first).max() > 0.01
