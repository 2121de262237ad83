"""Decisions are written beside the recording, which stays as it is, and an export follows them."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
from pyarrow import parquet

from iris_session.cli.main import main
from iris_session.dataset.curation import Edits, edit_curation, parse_edits, write_curation
from iris_session.dataset.episodes import Curation, DatasetError, EpisodeCuration, PlanOptions, find_curation, make_plan
from iris_session.dataset.run import DatasetOptions, export_dataset
from tests.dataset.support import record
from tests.replay.support import Played

LENGTHS = {1: 2.0, 2: 3.0}


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    return record(tmp_path_factory.mktemp("played") / "session.rrd")


def test_edits_are_parsed() -> None:
    edits = parse_edits(
        drop=["4,5", "6"], trim=["3=1.2:8.5, 4=.5:2"], label=["5=success"], task=["Lift: 3 = 2 + 1", "2=Put it down"]
    )
    assert edits == Edits(
        drop=(4, 5, 6),
        trim={3: (1.2, 8.5), 4: (0.5, 2.0)},
        label={5: "success"},
        task={2: "Put it down"},
        task_of_all="Lift: 3 = 2 + 1",
    )
    assert parse_edits(reset=["all"]) == Edits(reset_all=True)
    assert not parse_edits()


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"drop": ["four"]}, "--drop 'four': give numbers of episodes"),
        ({"drop": ["1"], "keep": ["1"]}, "episode 1 is given to --drop and --keep"),
        ({"trim": ["1=2"]}, "--trim '1=2': give NUMBER=FROM:TO"),
        ({"trim": ["1=-1:2"]}, "give NUMBER=FROM:TO"),
        ({"label": ["success"]}, "--label 'success': give NUMBER=LABEL"),
        ({"task": ["a", "b"]}, "--task is given twice"),
        ({"task": [" "]}, "give a text of 1 to 512 characters"),
    ],
)
def test_other_edits_are_refused(given: dict[str, list[str]], problem: str) -> None:
    with pytest.raises(DatasetError, match=problem):
        parse_edits(**given)


def test_edits_add_to_those_before() -> None:
    before = Curation("id", {1: EpisodeCuration(drop=True, task="lift")})
    after = edit_curation(before, LENGTHS, Edits(label={1: "failure"}, trim={2: (0.0, 3.0)}))
    assert after.episodes == {
        1: EpisodeCuration(drop=True, task="lift", label="failure"),
        2: EpisodeCuration(trim=(0.0, 3.0)),
    }
    assert edit_curation(after, LENGTHS, Edits(keep=(1,), reset=(2,))).episodes == {
        1: EpisodeCuration(task="lift", label="failure")
    }
    assert edit_curation(after, LENGTHS, Edits(reset_all=True)).episodes == {}
    assert edit_curation(Curation("id"), LENGTHS, Edits(drop=(1,), label={2: ""})).episodes == {
        1: EpisodeCuration(drop=True)
    }


@pytest.mark.parametrize(
    ("edits", "problem"),
    [
        (Edits(drop=(3,)), "there is no episode 3 in the recording: there are 1, 2"),
        (Edits(reset=(0,)), "there is no episode 0"),
        (Edits(label={1: "good"}), "episode 1 cannot have the label 'good': give one of success, failure, unknown"),
        (
            Edits(trim={1: (0.5, 9.0)}),
            "episode 1 cannot be trimmed to 0.5:9: give two ascending times from 0 to 2.00 s",
        ),
        (Edits(trim={1: (1.0, 1.0)}), "give two ascending times"),
    ],
)
def test_impossible_edits_are_refused(edits: Edits, problem: str) -> None:
    with pytest.raises(DatasetError, match=problem):
        edit_curation(Curation("id"), LENGTHS, edits)


def test_a_curation_without_decisions_is_no_file(tmp_path: Path) -> None:
    recording = tmp_path / "session.rrd"
    write_curation(recording, Curation("id", {1: EpisodeCuration(drop=True)}))
    assert json.loads(find_curation(recording).read_bytes()) == {"recording": "id", "episodes": {"1": {"drop": True}}}
    write_curation(recording, Curation("id"))
    assert os.listdir(tmp_path) == []
    write_curation(recording, Curation("id"))
    with pytest.raises(DatasetError, match=r"cannot be written: No such file"):
        write_curation(tmp_path / "none" / "session.rrd", Curation("id", {1: EpisodeCuration(drop=True)}))


def test_an_export_follows_the_edits_and_the_recording_stays(
    played: Played, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = Path(shutil.copy(played.path, tmp_path))
    path.chmod(0o400)
    before, made = path.read_bytes(), path.stat().st_mtime_ns
    edits = ["--drop", "1", "--label", "2=success", "--trim", "3=0.01:0.04", "--task", "2=Lift it"]
    assert main(["recording", "episodes", str(path), *edits, "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)["episodes"]
    assert [(one["verdict"], one["final_verdict"]) for one in shown] == [
        ("success", "success"),
        ("failure", "success"),
        ("success", "success"),
    ]
    assert [one["edit"] for one in shown] == [
        {"drop": True},
        {"label": "success", "task": "Lift it"},
        {"trim": [0.01, 0.04]},
    ]
    report = export_dataset([path], tmp_path / "set", "lerobot", DatasetOptions(500))
    assert (report.episodes, report.tasks, report.left_out) == (2, ("Lift it", "Zebulon lifts it"), ())
    files = sorted((tmp_path / "set").glob("meta/episodes/*/*.parquet"))
    rows = [parquet.read_table(file).to_pylist()[0] for file in files]
    found = [(row["iris/episode"], row["iris/label"], row["length"], row["tasks"]) for row in rows]
    assert found == [(2, "success", 50, ["Lift it"]), (3, "success", 16, ["Zebulon lifts it"])]
    assert main(["recording", "episodes", str(path), "--reset", "all", "--json"]) == 0
    assert not find_curation(path).exists()
    assert len(make_plan([path], PlanOptions()).episodes) == 2
    assert (path.read_bytes(), path.stat().st_mtime_ns) == (before, made)


@pytest.mark.parametrize(
    ("edit", "problem"),
    [
        (["--drop", "9"], "iris-session: there is no episode 9 in the recording: there are 1, 2, 3"),
        (["--label", "2=good"], "iris-session: episode 2 cannot have the label 'good'"),
        (["--trim", "2=0:7"], "iris-session: episode 2 cannot be trimmed to 0:7"),
    ],
)
def test_the_command_refuses_in_one_line(
    played: Played, capsys: pytest.CaptureFixture[str], edit: list[str], problem: str
) -> None:
    assert main(["recording", "episodes", str(played.path), *edit]) == 2
    shown = capsys.readouterr()
    assert shown.err.startswith(problem)
    assert (shown.err.count("\n"), shown.out) == (1, "")
    assert not find_curation(played.path).exists()


def test_the_table_fits_a_terminal(played: Played, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["recording", "episodes", str(played.path), "--cameras", "operator,side,top=0,0,3->0,0,0"]
    assert main(arguments) == 0
    out = capsys.readouterr().out
    assert all(len(line) <= 100 for line in out.splitlines() if str(played.path) not in line)
    assert "2  failure" in out
    assert main([*arguments, "--csv"]) == 0
    head, *rows = capsys.readouterr().out.splitlines()
    assert (len(rows), "path_m.left" in head, "outside.top" in head) == (3, True, True)
    assert main(["recording", "episodes", str(played.path), str(played.path.parent), "--drop", "1"]) == 0
    assert main(["recording", "episodes", str(played.path), "--reset", "all"]) == 0
    record(tmp_path / "other.rrd", {3: "start", 9: "success"}, steps=12)
    assert main(["recording", "episodes", str(played.path), str(tmp_path), "--drop", "1"]) == 2
    assert "decisions are about one recording, not 2" in capsys.readouterr().err
