"""Tasks: their file, their progress, and places of objects that are free of contact and repeatable."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from iris_session import scene_path
from iris_session.physics import World, find_objects
from iris_session.protocol.client_messages import Control, Episode
from iris_session.protocol.entries import EntryMessage, ObjectsPlaced
from iris_session.protocol.server_messages import EpisodeChanged
from iris_session.protocol.specs import ObjectRange, TaskSpec
from iris_session.session.config import SessionConfig
from iris_session.session.core import make_session_core
from iris_session.session.errors import ConfigError
from iris_session.session.tasks import (
    PlacementError,
    TaskRunner,
    check_same_task,
    draw_places,
    load_task,
    write_progress,
)
from tests.session.test_stepper import Rig

POUR = """
name = "swap"
instruction = "Swap the hammer and the board."
wanted = 50
robots = ["left", "right"]
seed = 7

[objects.hammer]
x = [-0.3, 0.3]
y = [0.05, 0.3]
yaw = [-3.14, 3.14]

[objects.board]
x = [-0.3, 0.3]
y = [0.05, 0.3]
z = [0.1, 0.2]
"""
HAMMER = ObjectRange("hammer", (-0.3, 0.3), (0.05, 0.3), None, (-3.14, 3.14))
BOARD = ObjectRange("board", (-0.3, 0.3), (0.05, 0.3), (0.1, 0.2))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "swap.toml"
    path.write_text(POUR)
    return path


def make_world() -> World:
    model = mujoco.MjModel.from_xml_path(str(scene_path("handover")))
    return World(model, (), find_objects(model))


def test_a_file_gives_the_task_and_its_progress_goes_on_where_it_stopped(file: Path) -> None:
    text = "Swap the hammer and the board."
    task = TaskSpec("swap", text, 50, ("left", "right"), (HAMMER, BOARD), 7)
    assert load_task(file) == task
    assert load_task(str(file)) == load_task(task) == task
    assert load_task(None) is None
    write_progress(file.with_name("swap.progress.json"), EpisodeChanged(14, "success", task="swap", successes=12))
    again = load_task(file)
    assert again is not None
    assert (again.recorded, again.successes) == (14, 12)


def test_the_example_of_the_guide_is_a_task_of_its_scene(file: Path) -> None:
    guide = (Path(__file__).parents[2] / "docs" / "guide.md").read_text()
    file.write_text(guide.partition("```toml\n")[2].partition("```")[0])
    task = load_task(file)
    assert task is not None
    assert draw_places(make_world(), b"", task, 1).objects == ("hammer", "board")


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("name = 1", "Expected `str`"),
        ("name", "swap.toml"),
        ('instruction = "x"', "missing required field `name`"),
        ('name = "x"\nwhere = 1', "unknown field `where`"),
        (f'name = "{"x" * 65}"', "length <= 64"),
        ('name = "x"\nwanted = -1', "wanted"),
        ('name = "x"\n[objects.a]\nx = [2, 1]\ny = [0, 0]', r"objects.a.x is \[2, 1\]: lower bound first"),
        ('name = "x"\n[objects.a]\nx = [nan, 1]\ny = [0, 0]', "lower bound first"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_with_what_is_wrong(file: Path, text: str, error: str) -> None:
    file.write_text(text)
    with pytest.raises(ConfigError, match=error) as raised:
        load_task(file)
    assert "\n" not in str(raised.value)


def test_progress_that_is_damaged_or_of_another_task_is_refused(file: Path) -> None:
    progress = file.with_name("swap.progress.json")
    for content in ("{", '{"task": "pour", "recorded": 3, "successes": 2}'):
        progress.write_text(content)
        with pytest.raises(ConfigError, match="delete it"):
            load_task(file)
    with pytest.raises(ConfigError, match="cannot be used: No such file"):
        load_task(file.with_name("none.toml"))
    with pytest.raises(ConfigError, match="has no task, not 'pour'"):
        check_same_task(TaskSpec("pour"), None)


def test_progress_that_cannot_be_written_is_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_progress(tmp_path / "none" / "x.json", EpisodeChanged(1, "success", task="x"))
    assert "cannot be written" in caplog.text


def count_contacts(world: World, placed: Any) -> int:
    world.reset()
    world.place_objects(placed.objects, placed.poses)
    return int((world.data.contact.dist < -1e-3).sum())


def test_places_are_free_of_contact_in_their_ranges_and_follow_from_seed_and_number() -> None:
    world, task = make_world(), TaskSpec("swap", objects=(HAMMER, BOARD), seed=7)
    seen = set()
    for number in range(1, 30):
        placed = draw_places(world, b"", task, number)
        assert placed == draw_places(world, b"", task, number)
        assert (placed.objects, placed.number, placed.seed) == (("hammer", "board"), number, 7)
        assert count_contacts(world, placed) == 0
        (hx, hy, hz), (bx, by, bz) = (pose.p for pose in placed.poses)
        assert max(map(abs, (hx, bx))) <= 0.3
        assert hz == pytest.approx(0.016)
        assert 0.05 <= min(hy, by) <= max(hy, by) <= 0.3
        assert 0.1 <= bz <= 0.2
        assert all(np.linalg.norm(pose.q) == pytest.approx(1.0, abs=1e-12) for pose in placed.poses)
        seen.add(placed.poses)
    assert len(seen) == 29
    other = draw_places(world, b"", TaskSpec("swap", objects=(HAMMER, BOARD), seed=8), 1)
    assert other.poses != draw_places(world, b"", task, 1).poses


def test_without_a_free_place_the_objects_are_named() -> None:
    inside = ObjectRange("board", (0.0, 0.0), (0.0, 0.0), (-0.02, -0.02))
    with pytest.raises(PlacementError, match="no places of board are free of contact"):
        draw_places(make_world(), b"", TaskSpec("swap", objects=(inside,)), 1)


class Desk(Rig):
    """A session of a task in steps of one tick."""

    def __init__(self) -> None:
        model = mujoco.MjModel.from_xml_path(str(scene_path("handover")))
        objects, data = find_objects(model), mujoco.MjData(model)
        self.task = TaskSpec("swap", objects=(HAMMER, BOARD))
        super().__init__(make_session_core(SessionConfig(), model, data, (), objects, user_owned=False, task=self.task))

    def say(self, *messages: EntryMessage) -> str:
        """Return the state of the episode after a step."""
        for message in messages:
            self.stepper.inputs.post_own(message)
        self.step()
        assert self.core.authority.episode is not None
        return self.core.authority.episode.state

    def is_placed(self, number: int) -> bool:
        """Return whether the hammer lies where it is placed in an episode."""
        drawn = draw_places(self.core.world, b"", self.task, number).poses[0].p
        return self.core.world.view().object_pose("hammer").p[:2] == pytest.approx(drawn[:2], abs=1e-3)


def test_a_session_that_ended_before_its_objects_were_placed_places_them_when_it_resumes() -> None:
    desk = Desk()
    assert desk.say(ObjectsPlaced((), (), 1), Episode(0, "start", countdown_ns=0)) == "running"
    assert desk.say(Episode(0, "success")) == "closing"
    runner = TaskRunner(desk.stepper, None, is_new=False)
    assert desk.say() == "success"
    assert desk.is_placed(2)
    runner.close()


def test_an_episode_that_was_started_before_the_first_step_has_its_places() -> None:
    desk = Desk()
    desk.stepper.inputs.post(Episode(0, "start", countdown_ns=0))
    runner = TaskRunner(desk.stepper, None)
    assert desk.say() == "running"
    assert desk.is_placed(1)
    runner.close()


@pytest.mark.parametrize("order", ["reset | start", "start reset", "start | reset"])
def test_an_episode_that_begins_beside_a_reset_has_its_own_places(order: str) -> None:
    desk = Desk()
    runner = TaskRunner(desk.stepper, None)
    countdown_ns = 2_000_000 if order == "start | reset" else 0
    words: dict[str, EntryMessage] = {
        "reset": Control(0, "reset"),
        "start": Episode(0, "start", countdown_ns=countdown_ns),
    }
    desk.say()
    states = [desk.say(*(words[word] for word in step.split())) for step in order.split(" | ")]
    while states[-1] != "running":
        states.append(desk.say())
    assert len(states) <= 3
    assert desk.is_placed(1)
    runner.close()
