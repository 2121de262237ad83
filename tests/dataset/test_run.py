"""How episodes are made: in order, so many at once, anywhere; and the pool is closed whatever happens."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import pytest

from iris_session.dataset.cameras import PictureSpec
from iris_session.dataset.episodes import LABELS, DatasetError, PlanOptions, make_plan
from iris_session.dataset.frames import make_schema
from iris_session.dataset.run import EpisodeMaker, EpisodeTask, make_in_order
from tests.dataset.support import record
from tests.replay.support import Played


class Pool:
    """A pool that notes what it does. Making `fails_at` fails."""

    def __init__(self, depth: int, fails_at: int = -1) -> None:
        self.depth, self._fails_at = depth, fails_at
        self.did: list[str] = []
        self.begun: set[int] = set()
        self.most = 0

    def begin(self, task: int) -> str:
        self.begun.add(task)
        self.most = max(self.most, len(self.begun))
        self.did.append(f"begin {task}")
        return f"handle {task}"

    def take(self, task: int, begun: str) -> str:
        assert begun == f"handle {task}"
        self.begun.remove(task)
        self.did.append(f"take {task}")
        if task == self._fails_at:
            raise DatasetError("it fails")
        return f"episode {task}"

    def close(self) -> None:
        self.did.append("close")


@pytest.mark.parametrize("depth", [1, 3, 20])
def test_episodes_come_in_order_and_no_more_than_the_depth_are_begun(depth: int) -> None:
    pool = Pool(depth)
    assert list(make_in_order(range(7), pool)) == [(i, f"episode {i}") for i in range(7)]
    assert pool.most == min(depth, 7)
    assert pool.did.count("close") == 1
    assert pool.did[-1] == "close"


def test_a_cluster_that_grows_and_shrinks_is_followed() -> None:
    pool = Pool(1)
    episodes = make_in_order(range(9), pool)
    next(episodes)
    pool.depth = 4
    next(episodes)
    assert len(pool.begun) == 3  # of four that were begun, one was taken
    pool.depth = 2
    next(episodes)
    next(episodes)
    assert len(pool.begun) == 1
    assert [task for task, _ in episodes] == [4, 5, 6, 7, 8]


@pytest.mark.parametrize("fails_at", [0, 2])
def test_a_pool_is_closed_when_an_episode_fails(fails_at: int) -> None:
    pool = Pool(3, fails_at)
    with pytest.raises(DatasetError, match="it fails"):
        list(make_in_order(range(7), pool))
    assert pool.did[-1] == "close"
    assert f"begin {fails_at + 3}" not in pool.did


def test_a_pool_is_closed_when_the_export_ends_early() -> None:
    pool = Pool(2)
    episodes = make_in_order(range(7), pool)
    next(episodes)
    episodes.close()
    assert pool.did == ["begin 0", "begin 1", "take 0", "close"]


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    return record(tmp_path_factory.mktemp("played") / "session.rrd")


def make_tasks(played: Played, folder: Path) -> Sequence[EpisodeTask]:
    plan, schema = make_plan([played.path], PlanOptions(LABELS)), make_schema(played.core, 100)
    return [
        EpisodeTask(i, "lerobot", plan.recordings[0], episode, schema, PictureSpec(), str(folder / str(i)))
        for i, episode in enumerate(plan.episodes)
    ]


def test_a_maker_makes_episodes_in_any_order(played: Played, tmp_path: Path) -> None:
    tasks = make_tasks(played, tmp_path)
    expected = [EpisodeMaker().make(task).table.states.tobytes() for task in tasks]
    maker = EpisodeMaker()
    for i in (1, 2, 0, 0, 2, 1):
        assert maker.make(tasks[i]).table.states.tobytes() == expected[i]
    maker.close()


def test_another_recording_at_the_path_is_refused(played: Played, tmp_path: Path) -> None:
    task = make_tasks(played, tmp_path)[0]
    other = msgspec.structs.replace(task, planned=msgspec.structs.replace(task.planned, id="0" * 32))
    with pytest.raises(DatasetError, match="is not the recording of that path that was planned"):
        EpisodeMaker().make(other)
