"""Tables of an export hold the numbers of the recording exactly, and appear as a whole or not at all."""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow.parquet
import pytest

from iris_session.recording import RecordingError
from iris_session.replay import export
from iris_session.replay.export import (
    COMMANDS,
    EVENTS,
    FORMATS,
    OBJECTS,
    ROBOTS,
    SAMPLES,
    Column,
    ExportError,
    ExportOptions,
    ExportReport,
    export_recording,
)
from iris_session.replay.recorded_session import SessionRecording
from iris_session.session.core import SessionCore
from tests.replay.support import Played, play

STEPS = 70


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    made = play(tmp_path_factory.mktemp("played") / "session.rrd", STEPS)
    made.write()
    return made


def write(played: Played, folder: Path, to: str, **options: Any) -> ExportReport:
    with SessionRecording.open(played.path, warn=False) as recording:
        return export_recording(recording, folder, to, ExportOptions(**options))


def read(path: Path) -> dict[str, list[Any]]:
    """Return the columns of a table of any format, in its order."""
    if path.suffix == ".parquet":
        return dict(pyarrow.parquet.read_table(path).to_pydict())
    if path.suffix == ".csv":
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))
        return {name: [row[i] for row in rows[1:]] for i, name in enumerate(rows[0])}
    columns: dict[str, list[Any]] = {}
    with np.load(path) as arrays:
        for key in arrays.files:
            if f"{key}_names" in arrays.files:
                columns |= {f"{key}/{n}": arrays[key][:, i].tolist() for i, n in enumerate(arrays[f"{key}_names"])}
            elif not key.endswith("_names"):
                columns[key] = arrays[key].tolist()
    return columns


def to_floats(values: list[Any]) -> list[float]:
    return [float(value) for value in values]


@pytest.mark.parametrize("to", FORMATS)
def test_tables_hold_what_the_recording_holds(to: str, played: Played, tmp_path: Path) -> None:
    report = write(played, tmp_path / "new" / "tables", to, hz=500)
    names = [f"{stem}.{to}" for stem in ("robot-left", "robot-right", "object-board", "object-hammer", "commands-left")]
    assert [one.file for one in report.tables] == [
        *names,
        *(f"{n}.{to}" for n in ("commands-right", "samples", "events")),
    ]
    assert sorted(os.listdir(report.folder)) == sorted(one.file for one in report.tables)
    tables = {one.file.partition(".")[0]: read(tmp_path / "new" / "tables" / one.file) for one in report.tables}
    for one in report.tables:
        columns = tables[one.file.partition(".")[0]]
        assert (one.columns, {one.rows}) == (len(columns), {len(values) for values in columns.values()})
    left, commands = tables["robot-left"], tables["commands-left"]
    with SessionRecording.open(played.path) as recording:
        robot = recording.robot("left")
        for kind, series in (("joints", robot.joints()), ("end_effector", robot.end_effector())):
            for i, name in enumerate(series.names):
                assert to_floats(left[f"{kind}/{name}"]) == series.values[:, i].tolist()
        ctrl = robot.commands()
        hammer = recording.object("hammer").poses()
        events = recording.event_records()
        desktop = recording.device_samples("ann", "desktop")
    assert list(map(int, left["session_time_ns"])) == played.session_time
    assert list(map(int, left["step"])) == list(range(STEPS))
    assert to_floats(tables["object-hammer"]["pose/z"]) == hammer.values[:, 2].tolist()
    assert to_floats(commands["ctrl/left/joint2"]) == ctrl.values[:, 1].tolist()
    assert commands["kind"] == ctrl.kinds.tolist()
    assert set(commands["participant_name"]) == {"", "ann"}
    assert tables["events"]["event"] == [one["event"] for one in events]
    assert [msgspec.json.decode(text) for text in tables["events"]["fields"]] == [
        {key: value for key, value in one.items() if key not in ("event_seq", "session_time_ns", "time_s", "event")}
        for one in events
    ]
    samples = tables["samples"]
    assert set(samples["participant_name"]) == {"ann"}
    assert to_floats(samples["pose/y"]) == desktop.poses[:, 1].tolist()
    assert list(map(int, samples["seq"])) == desktop.seq.tolist()
    assert np.isnan(to_floats(samples["twist/vx"])).all()
    assert [str(one).lower() for one in samples["clutch"]] == [str(one).lower() for one in desktop.clutch.tolist()]


@pytest.mark.parametrize("to", FORMATS)
def test_chunks_are_joined(to: str, played: Played, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(played, tmp_path / "whole", to, tables=(ROBOTS,))
    monkeypatch.setattr(export, "CHUNK_ROWS", 7)
    write(played, tmp_path / "chunks", to, tables=(ROBOTS,))
    assert read(tmp_path / "chunks" / f"robot-left.{to}") == read(tmp_path / "whole" / f"robot-left.{to}")


def test_what_is_not_asked_for_is_not_written(played: Played, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    only = write(
        played, tmp_path / "some", "csv", tables=(ROBOTS, OBJECTS, COMMANDS), robots=("right",), objects=("board",)
    )
    assert [one.file for one in only.tables] == ["robot-right.csv", "object-board.csv", "commands-right.csv"]
    assert [one.rows for one in only.tables] == [14, 14, 14], "100 rows a second"
    monkeypatch.delattr(SessionCore, "step")
    history = write(played, tmp_path / "history", "csv", tables=(SAMPLES, EVENTS))
    assert [one.file for one in history.tables] == ["samples.csv", "events.csv"], "nothing is simulated for them"


# --- files ------------------------------------------------------------------------------------------------------------


def test_a_folder_with_files_is_replaced_only_on_request(played: Played, tmp_path: Path) -> None:
    folder = tmp_path / "tables"
    folder.mkdir()
    write(played, folder, "csv", tables=(EVENTS,))
    (folder / "events.csv").write_text("mine")
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(ExportError, match="is not empty: give another one, or --force"):
        write(played, folder, "csv", tables=(EVENTS,))
    assert (folder / "events.csv").read_text() == "mine"
    write(played, folder, "csv", tables=(EVENTS,), force=True)
    assert (folder / "events.csv").read_text().startswith('"event_seq"')
    assert sorted(os.listdir(folder)) == ["events.csv", "notes.txt"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RecordingError("damaged"), OSError(28, "disk full")])
def test_nothing_is_left_of_an_export_that_ended(
    error: BaseException, played: Played, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(export, "_write_events", fail)
    with pytest.raises(ExportError if isinstance(error, OSError) else type(error)) as found:
        write(played, tmp_path / "tables", "csv")
    assert os.listdir(tmp_path) == []
    if isinstance(error, OSError):
        assert str(found.value) == f"the tables cannot be written to {tmp_path / 'tables'}: disk full"


def test_names_of_files_are_safe_and_each_once(tmp_path: Path) -> None:
    with export._Staging(tmp_path / "tables", "csv", force=False) as staging:
        for name in ("../../etc/passwd", "a/b", "a:b", "A_B", "", "x" * 64 + "é"):
            staging.make_table(OBJECTS, name, (Column("step", "int"),)).add((1,))
        files = [one.file for one in staging.commit()]
    assert sorted(files) == sorted(os.listdir(tmp_path / "tables"))
    assert {"object-.._.._etc_passwd.csv", "object-a_b.csv", "object-a_b~2.csv", "object-A_B~3.csv"} <= set(files)
    assert os.listdir(tmp_path) == ["tables"]
