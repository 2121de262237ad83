"""Every format: whole after being killed at any write, and finished with the same bytes. What each command refuses."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from iris_session.cli.main import main
from iris_session.dataset.cameras import PictureSpec, parse_cameras
from iris_session.dataset.episodes import Plan, make_plan
from iris_session.dataset.formats import FORMATS, open_writer
from iris_session.dataset.frames import Schema, make_schema
from iris_session.dataset.run import EpisodeMaker, EpisodeTask
from tests.dataset import test_lerobot, test_mcap, test_robomimic
from tests.dataset.support import read_files, record
from tests.replay.support import Played

#: For each format: reads a set as its readers do and returns its episodes; files that are written at the beginning, and
#: for an episode.
READERS = {
    "lerobot": (test_lerobot.load, 4, 5),
    "robomimic": (test_robomimic.load, 2, 2),
    "mcap": (test_mcap.load, 3, 2),
}


class Killed(BaseException):
    """Takes the place of SIGKILL: nothing that has begun is finished or cleaned up."""


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    return record(tmp_path_factory.mktemp("played") / "session.rrd")


def make_episodes(to: str, plan: Plan, schema: Schema, pictures: PictureSpec, folder: Path) -> list[Any]:
    maker = EpisodeMaker()
    tasks = [
        EpisodeTask(i, to, plan.recordings[0], one, schema, pictures, str(folder / str(i)))
        for i, one in enumerate(plan.episodes)
    ]
    made = [(task, maker.make(task)) for task in tasks]
    maker.close()
    return made


@pytest.mark.parametrize("to", FORMATS)
def test_killed_at_every_write_it_is_whole_and_finished_with_the_same_bytes(
    to: str, played: Played, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load, n_first, n_each = READERS[to]
    plan = make_plan([played.path])
    pictures = PictureSpec(
        parse_cameras("operator"), 64, 48, plain=True, depth=FORMATS[to].has_layers, masks=FORMATS[to].has_layers
    )
    schema = make_schema(played.core, 50)
    made = make_episodes(to, plan, schema, pictures, tmp_path / "made")

    def write(folder: Path) -> None:
        """Write the set as `export_dataset` does, with episodes that were made before."""
        writer = open_writer(to, folder, plan, schema, pictures, {"fps": 50})
        for task, episode in made[writer.next[0] :]:
            staged = writer.partial / str(task.index)
            shutil.copytree(task.folder, staged)
            writer.close_episode(task.index, 0, episode.table, episode.pictures, staged)
        writer.finish()

    write(tmp_path / "whole")
    expected = read_files(tmp_path / "whole")
    left, kills, closed = 0, 0, []

    def count(real: Any) -> Any:
        def call(*given: Any) -> Any:
            nonlocal left
            left -= 1
            if left < 0:
                raise Killed
            return real(*given)

        return call

    monkeypatch.setattr(os, "fsync", count(lambda descriptor: None))  # there is no power cut here
    monkeypatch.setattr(os, "replace", count(os.replace))
    while True:
        folder, left = tmp_path / str(kills), kills
        try:
            write(folder)
            break
        except Killed:
            pass
        left = 1_000_000
        closed.append(len(load(folder)))
        assert closed[-1] >= max(closed)
        write(folder)
        assert read_files(folder) == expected, f"killed at write {kills}"
        kills += 1
    assert set(closed) == {0, 1, 2}
    # A folder is made durable with each file; robomimic has one model, too.
    assert kills == 3 * (n_first + 2 * n_each + (to == "robomimic")), "all files are written so"


def test_depth_and_masks_are_refused_where_the_format_has_none(
    played: Played, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["export", str(played.path), "--to", "lerobot", "--out", str(tmp_path / "set")]
    assert main([*command, "--cameras", "operator", "--depth"]) == 2
    assert "--to lerobot has no depth and masks, its videos have 8 bits: --to robomimic or mcap" in (
        capsys.readouterr().err
    )
