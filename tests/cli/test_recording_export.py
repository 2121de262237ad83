"""`recording export`: a line per table or one JSON object, and one line for what cannot be done."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from iris_session.protocol.scene import decode_scene
from iris_session.rrd.assets import list_recorded_assets
from iris_session.scene import AssetStore
from tests.cli.conftest import CommandLine
from tests.recording.test_recorded_assets import Shared, record
from tests.replay.support import Played, play


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    made = play(tmp_path_factory.mktemp("played") / "session.rrd", 60)
    made.write()
    return made


def test_a_line_for_each_table(played: Played, tmp_path: Path, cli: CommandLine) -> None:
    out = tmp_path / "tables"
    command = ["recording", "export", str(played.path.parent), "--to", "csv", "-o", str(out)]
    cli.run(*command, "--hz", "50", "--robot", "left", "--table", "robots", "--table", "events")
    assert cli.err == ""
    lines = cli.out.splitlines()
    assert lines[0] == f"{out}/robot-left.csv: 6 rows, 28 columns"
    assert lines[1].startswith(f"{out}/events.csv: ")
    assert sorted(os.listdir(out)) == ["events.csv", "robot-left.csv"]
    assert cli.refuse(*command) == f"iris-session: the folder {out} is not empty: give another one, or --force\n"
    report = cli.json(*command, "--force")
    assert report["folder"] == str(out)
    assert report["left_out"] == report["damage"] == []
    assert report["tables"][0] == {
        "kind": "robots",
        "name": "left",
        "file": "robot-left.csv",
        "rows": 12,
        "columns": 28,
    }


def test_damage_is_said_and_is_a_status(tmp_path: Path, cli: CommandLine) -> None:
    gap = play(tmp_path / "session.rrd", 45)
    del gap.batch.rows[30]
    path = gap.write()
    cli.run("recording", "export", path, "--to", "npz", "-o", tmp_path / "tables", status=1)
    assert cli.err == f"iris-session: {path} is damaged: steps 30 to 39 are left out\n"
    assert f"{tmp_path / 'tables'}/events.npz" in cli.out


def test_assets_are_files_by_hash(tmp_path: Path, cli: CommandLine) -> None:
    shared = Shared(tmp_path / "store")
    path = record(tmp_path / "session.rrd", shared)
    out = tmp_path / "scene-files"
    command = ["recording", "export", str(path), "--to", "assets", "-o", str(out)]
    report = cli.json(*command)
    wanted = {shared.scene_hash, *list_recorded_assets(shared.spec, "scene")}
    assert (report["scenes"], report["assets"], report["damage"]) == (1, len(wanted), [])
    (scene,) = json.loads((out / "scenes.json").read_text())["scenes"]
    assert scene == {"step": -1, "time_s": 0.0, "hash": shared.scene_hash}
    copied = AssetStore(out)
    assert decode_scene(copied.get(scene["hash"])) == shared.spec
    assert {address: copied.get(address) for address in wanted} == {a: shared.store.get(a) for a in wanted}
    assert cli.refuse(*command) == f"iris-session: the folder {out} is not empty: give another one, or --force\n"
    damaged = AssetStore(out).path(scene["hash"])
    damaged.write_bytes(bytes(damaged.stat().st_size))
    cli.run(*command, "--force")
    assert AssetStore(out).get(scene["hash"]) == shared.store.get(scene["hash"]), "files that are there are replaced"
    assert cli.out == f"{out}: {len(wanted)} assets, {report['bytes'] / 1e6:.1f} MB, scenes: 1\n"
    assert "--robot choose tables: leave them out with --to assets" in cli.refuse(
        *command, "--force", "--robot", "left"
    )
