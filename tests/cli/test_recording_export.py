"""`recording export`: a line per table or one JSON object, and one line for what cannot be done."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from iris_session.cli.main import main
from tests.replay.support import Played, play


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    made = play(tmp_path_factory.mktemp("played") / "session.rrd", 60)
    made.write()
    return made


def test_a_line_for_each_table(played: Played, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "tables"
    command = ["recording", "export", str(played.path.parent), "--to", "csv", "-o", str(out)]
    assert main([*command, "--hz", "50", "--robot", "left", "--table", "robots", "--table", "events"]) == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    lines = shown.out.splitlines()
    assert lines[0] == f"{out}/robot-left.csv: 6 rows, 28 columns"
    assert lines[1].startswith(f"{out}/events.csv: ")
    assert sorted(os.listdir(out)) == ["events.csv", "robot-left.csv"]
    assert main(command) == 2
    assert capsys.readouterr().err == f"iris-session: the folder {out} is not empty: give another one, or --force\n"
    assert main([*command, "--force", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["folder"] == str(out)
    assert report["left_out"] == report["damage"] == []
    assert report["tables"][0] == {
        "kind": "robots",
        "name": "left",
        "file": "robot-left.csv",
        "rows": 12,
        "columns": 28,
    }


def test_damage_is_said_and_is_a_status(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gap = play(tmp_path / "session.rrd", 45)
    del gap.batch.rows[30]
    path = gap.write()
    assert main(["recording", "export", str(path), "--to", "npz", "-o", str(tmp_path / "tables")]) == 1
    shown = capsys.readouterr()
    assert shown.err == f"iris-session: {path} is damaged: steps 30 to 39 are left out\n"
    assert f"{tmp_path / 'tables'}/events.npz" in shown.out


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--robot", "lift"], "robot 'lift' does not exist in the model. Available robots: left, right."),
        (["--object", "cup"], "object 'cup' does not exist in the model. Available objects: hammer, board."),
    ],
)
def test_names_that_are_none_are_one_line(
    options: list[str], line: str, played: Played, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "tables"
    assert main(["recording", "export", str(played.path), "--to", "csv", "-o", str(out), *options]) == 2
    assert capsys.readouterr().err == f"iris-session: {line}\n"
    assert not out.exists()


def test_files_that_are_none_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "session.rrd").write_text("something else")
    for path in (tmp_path / "session.rrd", tmp_path / "none.rrd"):
        assert main(["recording", "export", str(path), "--to", "csv", "-o", str(tmp_path / "tables")]) == 2
        err = capsys.readouterr().err
        assert err.startswith("iris-session: ")
        assert err.count("\n") == 1


@pytest.mark.parametrize("hz", ["0", "-1", "nan", "fast"])
def test_a_rate_that_is_none_is_refused(hz: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["recording", "export", "session.rrd", "--to", "csv", "-o", str(tmp_path / "tables"), f"--hz={hz}"])
    assert "is not a rate: give rows per second above 0" in capsys.readouterr().err
