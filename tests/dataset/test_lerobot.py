"""Sets of LeRobot: every column as it was read, whole after being killed at any write, finished with the same bytes."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from pyarrow import parquet

from iris_session.cli.main import main
from iris_session.dataset.cameras import PictureSpec, parse_cameras
from iris_session.dataset.episodes import DatasetError, PlanOptions
from iris_session.dataset.files import lock_folder
from iris_session.dataset.lerobot import LeRobotWriter
from iris_session.dataset.run import DatasetOptions, export_dataset
from iris_session.system.process import child_environment, module_command
from tests.dataset.support import NAME, read_files, record
from tests.replay.support import Played

LABELS = ("success", "failure", "unknown")
CAMERAS = "operator,top=0.4,-0.3,2.4->0,0,0.7:50"
PICTURES = PictureSpec(parse_cameras(CAMERAS), 64, 48, plain=True)
OPTIONS = DatasetOptions(100, PICTURES, PlanOptions(LABELS))


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    return record(tmp_path_factory.mktemp("played") / "session.rrd")


def load(folder: Path) -> list[dict[str, Any]]:
    """Read a set as LeRobot does, whose number of episodes is that of `info.json`. Return the frames of each."""
    if not (folder / "meta/info.json").exists():
        return []
    info = json.loads((folder / "meta/info.json").read_bytes())
    rows = [parquet.read_table(path).to_pylist()[0] for path in sorted(folder.glob("meta/episodes/*/*.parquet"))]
    assert len(rows) >= info["total_episodes"]
    frames = [parquet.read_table(path) for path in sorted(folder.glob("data/*/*.parquet"))]
    begin, found = 0, []
    for i, row in enumerate(rows[: info["total_episodes"]]):
        assert (row["episode_index"], row["dataset_from_index"]) == (i, begin)
        begin = row["dataset_to_index"]
        assert frames[i]["index"].to_pylist() == list(range(row["dataset_from_index"], begin))
        for key in (key for key, feature in info["features"].items() if feature["dtype"] == "video"):
            chunk, file = row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"]
            path = folder / info["video_path"].format(video_key=key, chunk_index=chunk, file_index=file)
            assert count_pictures(path) == row["length"]
        found.append({**row, "frames": frames[i]})
    assert begin == info["total_frames"]
    return found


def count_pictures(path: Path) -> int:
    import av

    with av.open(str(path)) as container:
        return sum(1 for _ in container.decode(video=0))


def test_a_set_holds_what_was_read(played: Played, tmp_path: Path) -> None:
    report = export_dataset([played.path], tmp_path / "set", "lerobot", OPTIONS)
    assert (report.episodes, report.frames, report.left_out) == (3, 14 + 10 + 6, ())
    rows = load(tmp_path / "set")
    assert [(row["iris/label"], row["length"], row["iris/episode"]) for row in rows] == [
        ("success", 14, 1),
        ("failure", 10, 2),
        ("success", 6, 3),
    ]
    columns = played.columns()
    for row, begin in zip(rows, (20, 100, 160), strict=True):
        steps = range(begin - 1, begin - 1 + 5 * row["length"], 5)
        joints = np.array(row["frames"]["robots.left.joint_positions"].to_pylist())
        assert joints.tobytes() == np.array([played.qpos[step][columns] for step in steps]).tobytes()
        state = np.array(row["frames"]["observation.state"].to_pylist(), np.float32)
        assert state[:, : len(columns)].tobytes() == joints.astype(np.float32).tobytes()
        assert row["frames"]["timestamp"].to_pylist() == [np.float32(k / 100) for k in range(row["length"])]
        assert len(row["iris/first_state"]) * 8 == len(played.core.world.save_state())
        action = np.array(row["frames"]["robots.left.action"].to_pylist())
        assert action.std(axis=0).max() > 0.0 or begin > 150
        stats = {name: row[f"stats/robots.left.action/{name}"] for name in ("min", "max", "mean", "std", "count")}
        assert np.allclose(stats["mean"], action.mean(axis=0))
        assert (stats["min"], stats["max"]) == (action.min(axis=0).tolist(), action.max(axis=0).tolist())
        assert stats["count"] == [row["length"]]
    tasks = pandas.read_parquet(tmp_path / "set/meta/tasks.parquet")
    assert tasks.index.tolist() == [f"{NAME} lifts it"]
    assert tasks.task_index.tolist() == [0]
    stats = json.loads((tmp_path / "set/meta/stats.json").read_bytes())
    every = np.concatenate([np.array(row["frames"]["action"].to_pylist()) for row in rows])
    assert np.allclose(stats["action"]["mean"], every.mean(axis=0))
    assert np.allclose(stats["action"]["std"], every.std(axis=0))
    assert np.shape(stats["observation.images.top"]["mean"]) == (3, 1, 1)


def test_no_name_is_in_any_byte(played: Played, tmp_path: Path) -> None:
    export_dataset([played.path], tmp_path / "with", "lerobot", OPTIONS)
    assert any(NAME.encode() in data for data in read_files(tmp_path / "with").values())
    hidden = DatasetOptions(100, PICTURES, PlanOptions(LABELS, anonymise=True))
    export_dataset([played.path], tmp_path / "without", "lerobot", hidden)
    for name, data in read_files(tmp_path / "without").items():
        assert NAME.lower().encode() not in data.lower(), name
    assert load(tmp_path / "without")[0]["tasks"] == ["p1 lifts it"]


def test_looks_are_further_episodes(played: Played, tmp_path: Path) -> None:
    pictures = PictureSpec(PICTURES.cameras[:1], 64, 48, looks=1, plain=True)
    export_dataset([played.path], tmp_path / "set", "lerobot", DatasetOptions(50, pictures))
    rows = load(tmp_path / "set")
    assert [(row["iris/episode"], row["iris/look"]) for row in rows] == [(1, 0), (1, 1), (3, 0), (3, 1)]
    videos = sorted((tmp_path / "set").glob("videos/*/*/*.mp4"))
    assert len({path.read_bytes() for path in videos}) == 4


def test_a_finished_set_is_left_as_it_is(played: Played, tmp_path: Path) -> None:
    folder, options = tmp_path / "set", DatasetOptions(50)
    export_dataset([played.path], folder, "lerobot", options)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
    assert export_dataset([played.path], folder, "lerobot", options).episodes == 2
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()} == before


def test_other_folders_are_refused(played: Played, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    export_dataset([played.path], folder, "lerobot", DatasetOptions(50))
    with pytest.raises(DatasetError, match=r"has a data set that differs in fps \(50, not 25\)"):
        export_dataset([played.path], folder, "lerobot", DatasetOptions(25))
    with pytest.raises(DatasetError, match=r"differs in pictures.looks \(0, not 2\)"):
        export_dataset([played.path], folder, "lerobot", DatasetOptions(50, PictureSpec(looks=2)))
    record(tmp_path / "later.rrd", recording_class="open")
    with pytest.raises(DatasetError, match=r"a data set without 1 of the recordings: .*later\.rrd"):
        export_dataset([played.path, tmp_path / "later.rrd"], folder, "lerobot", DatasetOptions(50))
    before = read_files(folder)
    with lock_folder(folder), pytest.raises(DatasetError, match="another export writes to"):
        export_dataset([played.path], folder, "lerobot", DatasetOptions(50))
    assert read_files(folder) == before
    with pytest.raises(DatasetError, match="is not empty, and has no data set of this format"):
        export_dataset([played.path], played.path.parent, "lerobot", DatasetOptions(25))
    with pytest.raises(DatasetError, match="is no folder"):
        export_dataset([played.path], played.path, "lerobot", DatasetOptions(25))


def test_a_full_disk_is_one_line_and_costs_the_episode_at_work(
    played: Played, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closing = LeRobotWriter.close_episode

    def fail(self: LeRobotWriter, index: int, *given: Any) -> None:
        if index == 1:
            raise OSError(28, "No space left on device")
        closing(self, index, *given)

    with monkeypatch.context() as patched:
        patched.setattr(LeRobotWriter, "close_episode", fail)
        with pytest.raises(DatasetError, match=r"cannot be written to .*: No space left on device"):
            export_dataset([played.path], tmp_path / "set", "lerobot", OPTIONS)
    assert len(load(tmp_path / "set")) == 1
    export_dataset([played.path], tmp_path / "whole", "lerobot", OPTIONS)
    export_dataset([played.path], tmp_path / "set", "lerobot", OPTIONS)
    assert read_files(tmp_path / "set") == read_files(tmp_path / "whole")


@pytest.mark.e2e
def test_processes_write_the_same_bytes(played: Played, tmp_path: Path) -> None:
    export_dataset([played.path], tmp_path / "one", "lerobot", OPTIONS)
    command = ["export", str(played.path), "--to", "lerobot", "--out", str(tmp_path / "two"), "--jobs", "2"]
    options = ["--fps", "100", "--labels", ",".join(LABELS), "--size", "64x48", "--plain", "--cameras", CAMERAS]
    subprocess.run(module_command("iris_session.cli.main", *command, *options), check=True, env=child_environment())
    assert read_files(tmp_path / "one") == read_files(tmp_path / "two")


def test_command(played: Played, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["export", str(played.path), "--to", "lerobot", "--out", str(tmp_path / "set")]
    assert main([*command, "--fps", "100", "--labels", "success,failure"]) == 0
    assert capsys.readouterr().out.startswith(f"{tmp_path / 'set'}: 3 episodes, 30 frames, lerobot\n")
    assert main(["recording", *command, "--fps", "100", "--labels", "success,failure", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 3
    for wrong, problem in (
        (["--labels", "good"], "give some of success, failure, unknown"),
        (["--size", "33x64", "--cameras", "side"], "a video needs even numbers"),
        (["--hz", "30"], "--hz are for tables"),
        (["--cameras", "nope"], "there is no camera 'nope'"),
        (["--cameras", "top=0,0,2.4-"], "in quotes"),  # what the shell leaves of `0,0,2.4->0,0,0.7`
        (["--looks", "2"], "--looks is about pictures"),
        (["--fps", "501"], "more than the 500 ticks a second"),
    ):
        assert main([*command[:-1], str(tmp_path / "other"), *wrong]) == 2
        captured = capsys.readouterr()
        assert problem in captured.err
        assert captured.err.count("\n") == 1
        assert not (tmp_path / "other").exists()
