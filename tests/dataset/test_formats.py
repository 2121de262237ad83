"""Every format: whole after being killed at any write, and finished with the same bytes. What each command refuses."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import av
import msgspec
import numpy as np
import pytest

from iris_session.cli.main import main
from iris_session.dataset.cameras import CameraSpec, PictureSpec, parse_cameras
from iris_session.dataset.episodes import Plan, make_plan
from iris_session.dataset.formats import FORMATS, open_writer
from iris_session.dataset.frames import Schema, make_schema
from iris_session.dataset.run import EpisodeMaker, EpisodeTask
from tests.dataset import test_lerobot, test_mcap, test_robomimic
from tests.dataset.support import make_grey, read_files, record
from tests.replay.support import Played

#: For each format: reads a set as its readers do and returns its episodes; files that are written at the beginning, and
#: for an episode.
READERS = {
    "lerobot": (test_lerobot.load, 4, 6),
    "robomimic": (test_robomimic.load, 2, 2),
    "mcap": (test_mcap.load, 3, 2),
}


class Killed(BaseException):
    """Takes the place of SIGKILL: nothing that has begun is finished or cleaned up."""


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    captures = [(step, 0) for step in range(10, 200, 20)]
    return record(tmp_path_factory.mktemp("played") / "session.rrd", captures=captures)


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
    cameras = (*parse_cameras("operator"), CameraSpec("front", stream="room-front", size=(48, 32)))
    has_layers = FORMATS[to].has_layers
    pictures = PictureSpec(cameras, 64, 48, plain=True, depth=has_layers, masks=has_layers)
    schema = msgspec.structs.replace(make_schema(played.core, 50), recorded=("front",))
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


#: Pictures before the first episode, at a frame, just after one, late in it, within the second, after which it ended.
CAPTURES = ((5, 0), (30, 0), (40, 1), (70, -1), (120, 0), (130, 0))


def read_pictures(to: str, folder: Path) -> list[tuple[Any, Any]]:
    """Return ages and pictures of the real camera in each episode of a set."""
    episodes = READERS[to][0](folder)
    if to == "robomimic":
        return [(one["obs/pictures.front.age_s"][:, 0], one["obs/front_image"]) for one in episodes]
    if to == "mcap":
        ages = [[data["age_s"][0] for _, data in one["/pictures/front"]] for one in episodes]
        videos = [test_mcap.decode_video([one.data for _, one in episode["/cameras/front"]]) for episode in episodes]
        return list(zip(ages, videos, strict=True))
    found = []
    for one, path in zip(episodes, sorted(folder.glob("videos/observation.images.front/*/*.mp4")), strict=True):
        with av.open(str(path)) as video:
            pictures = [picture.to_ndarray(format="rgb24") for picture in video.decode(video=0)]
        ages = one["frames"]["pictures.front.age_s"].to_pylist()
        assert one["stats/pictures.front.age_s/max"] == [max(ages)]
        found.append((ages, pictures))
    return found


@pytest.mark.parametrize("to", FORMATS)
def test_pictures_of_a_real_camera_are_the_newest_that_are_not_later(
    to: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = record(tmp_path / "session.rrd", captures=CAPTURES)
    command = ["export", str(made.path), "--to", to, "--out", str(tmp_path / "set"), "--fps", "100"]
    cameras = ["--cameras", "operator,front=room-front", "--size", "64x48", "--plain"]
    labels = ["--labels", "success,failure", "--looks", "1"]
    assert main([*command, *cameras, *labels]) == 1
    printed = capsys.readouterr().out
    assert "session.rrd: episode 3 is left out: no picture of 'room-front' was taken in it" in printed
    assert "episode 1: 10 of 14 frames repeat a picture of front; they are up to 0.05 s old" in printed
    captures = np.array([made.session_time[step] + later_ns for step, later_ns in CAPTURES])
    episodes = read_pictures(to, tmp_path / "set")
    assert len(episodes) == 4, "two, in two looks each"
    for (ages, pictures), first, n in zip(episodes, (20, 20, 100, 100), (14, 14, 10, 10), strict=True):
        times = np.array(made.session_time)[first : first + 5 * n : 5]
        newest = [max(i for i, captured in enumerate(captures) if captured <= time) for time in times]
        assert np.array(ages).tolist() == ((times - captures[newest]) * 1e-9).tolist()
        assert np.shape(pictures) == (n, 32, 48, 3)
        assert np.abs(np.mean(pictures, axis=(1, 2, 3)) - [make_grey(i) for i in newest]).max() < 3.0
    assert main([*command, "--cameras", "room-back"]) == 2
    assert "no camera 'room-back' in the scene, and no recorded picture of it: give a camera of the scene" in (
        error := capsys.readouterr().err
    )
    assert f"a stream of {made.path} (room-front)" in error


def test_depth_and_masks_are_refused_where_the_format_has_none(
    played: Played, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["export", str(played.path), "--to", "lerobot", "--out", str(tmp_path / "set")]
    assert main([*command, "--cameras", "operator", "--depth"]) == 2
    assert "--to lerobot has no depth and masks, its videos have 8 bits: --to robomimic or mcap" in (
        capsys.readouterr().err
    )
