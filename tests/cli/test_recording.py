"""`recording inspect`: a recording as text and JSON, a folder as lines."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import msgspec
import pytest

from iris_session.cli.common import MOST_LINES
from iris_session.cli.main import INTERRUPTED, main
from iris_session.cli.recording import format_line, format_summary
from iris_session.protocol.server_messages import EpisodeChanged, Event
from iris_session.recording import parts
from iris_session.recording.summary import (
    AlignmentSummary,
    DropSummary,
    EpisodeSummary,
    HandoverSummary,
    PersonSummary,
    RecordingSummary,
    StopSummary,
    StreamSummary,
)
from iris_session.recording.writer import RrdWriter
from iris_session.rrd.assets import AssetsSummary
from tests.cli.conftest import CommandLine
from tests.recording.support import TICK_NS, journal, write
from tests.recording.test_summary import write_session

SUMMARY = RecordingSummary(
    path="s/session.rrd",
    ok=False,
    files=("session.rrd", "session.part2.rrd"),
    bytes=7_100_000,
    session_name="lab",
    session_id="s1",
    created_utc="2026-11-25T16:28:51.270+00:00",
    format=4,
    recording_class="closed",
    finished=False,
    ending="not closed after 25 s: what may have followed is missing",
    begin_s=1.0,
    duration_s=125.0,
    steps=12_345,
    continues="",
    robots=("left", "right"),
    objects=(),
    deformables=("cloth",),
    bodies=26,
    people=(
        PersonSummary(
            *("ann", "operator", ("p1",), ("head", "hand/left"), 2, 24.0, True, {"left": 20.0}),
            AlignmentSummary("measured", 0.003, 0.012, 0.02, 3, {"jump": 1}),
            {"stale": 12},
        ),
        PersonSummary("bob\x1b[2J", "observer", ("p2",)),
    ),
    episodes=(EpisodeSummary(1, "success", "pour", 2.0, 5.0, "ann"), EpisodeSummary(2, "success", "", 8.0, 5.0, "ann")),
    handovers=(HandoverSummary("hammer", "left", "ann", "right", "bob", 3.25, 0.56),),
    stops=(StopSummary(4.0, "", "hand in the way", 1.0, True), StopSummary(9.0, "ann", "", 1.0, False)),
    pauses=(),
    scene_changes=(),
    streams=(StreamSummary("room", "cloud", "Room", 48, 24.0, 1.96, "stuck"),),
    drops=DropSummary({"stale": 12}, {"held": 1}, 7, 1, 0.3, samples_left_out=90),
    damage=tuple(f"bytes {i} are gone" for i in range(MOST_LINES + 5)),
    notes=(),
    assets=AssetsSummary("scene", 1, 12, 11, 4_200_000, ("asset 7777 (mesh arm): it cannot be read",)),
)


def test_a_summary_is_lines_for_people() -> None:
    text = "\n".join(format_summary(SUMMARY))
    for line in (
        "lab  2026-11-25 16:28:51 UTC  2 min 5 s",
        "  file       s/session.rrd, 7.1 MB, format 4, 2 parts: session.rrd, session.part2.rrd",
        "  objects    none",
        "  people     ann (operator, head, hand/left): 24.0 s, joined 2 times, there at the end; held left for 20.0 s; "
        "12 stale rejected samples",
        "             bob\x1b[2J (observer): 0.0 s; held no robot",
        "  alignment  ann: measured, stated error 3.0 mm at the anchor, 12.0 mm at the robot (worst 20.0 mm), 95 %; "
        "3 changes; alarms: 1 jump",
        "  episodes   1 success 'pour' at 2.00 s, 5.0 s, by ann",
        "  handovers  hammer: left (ann) to right (bob) at 3.25 s, both held it for 0.56 s",
        "  e-stops    at 4.00 s by a connection that had not joined (hand in the way), for 1.0 s",
        "  streams    room (Room): cloud, 48 frames in 24.0 s, 2.0 Hz; FAULT stuck",
        "  assets     scene: 11 of 12 of 1 scene, 4.2 MB",
        "             7 steps did not fit into the recording",
        "             90 raw samples not recorded (disk slow or nearly full, or the budget); the journal is whole",
        "  damage     bytes 0 are gone",
        "             and 5 more: --json has all",
    ):
        assert line in text, text
    assert format_line(SUMMARY) == (
        "s/session.rrd  2026-11-25 16:28:51 UTC  2 min 5 s  lab  ann  2 episodes (2 success)  1 handover  2 e-stops  "
        "not closed after 25 s  DAMAGED: bytes 0 are gone"
    )


def test_inspect_shows_a_recording(tmp_path: Path, cli: CommandLine) -> None:
    path = write_session(tmp_path / "session.rrd")
    out = cli.run("recording", "inspect", path)
    assert cli.err == ""
    assert "ann (operator, head, hand/left): 0.4 s, there at the end; held left for 0.4 s" in out
    assert "  damage     none" in out
    assert "  assets     none: made by an earlier version, or the session shared no scene" in out
    result = cli.json("recording", "inspect", path)
    assert sorted(result) == sorted(RecordingSummary.__struct_fields__)
    assert (result["ok"], result["steps"], result["people"][0]["held_s"]) == (True, 200, {"left": 0.358})


def test_episodes_of_a_recording_are_listed(tmp_path: Path, cli: CommandLine) -> None:
    header, batch = journal(20)
    running, over = (EpisodeChanged(1, state, "pour", "p1") for state in ("running", "success"))
    batch.events = [Event(1, 5, 6 * TICK_NS, running), Event(2, 15, 16 * TICK_NS, over)]
    path = tmp_path / "session.rrd"
    writer = RrdWriter(path, "id")
    writer.write_header(header)
    writer.add(batch)
    writer.close()
    shown = cli.json("recording", "episodes", path)
    (inspected,) = cli.json("recording", "inspect", path)["episodes"]
    assert shown["episodes"][0].items() >= inspected.items()
    assert [one["verdict"] for one in shown["episodes"]] == ["success"]


def test_a_folder_is_a_line_for_every_recording(tmp_path: Path, cli: CommandLine) -> None:
    for name in ("a/session.rrd", "b/session.part2.rrd", "b/session.part3.rrd", "b/session.resume2.rrd"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"no recording")
    (tmp_path / "notes.txt").write_text("none either")
    write(tmp_path / "a/session.rrd", *journal(20))
    (line,) = cli.run("recording", "inspect", tmp_path, status=1).splitlines()
    assert line.startswith(f"{tmp_path}/a/session.rrd  ")
    assert cli.err.count("iris-session: ") == cli.err.count("\n") == 2
    result = cli.json("recording", "inspect", tmp_path, status=1)
    assert [row["ok"] for row in result["recordings"]] == [True, False, False]
    assert "not a Rerun file" in result["recordings"][1]["error"]


@pytest.mark.parametrize(
    ("command", "number"),
    [
        (("recording", "inspect"), signal.SIGTERM),
        (("recording", "repair", "-o", "repaired.rrd"), signal.SIGHUP),
        (("recording", "export", "-o", "tables", "--to", "csv"), signal.SIGTERM),
        (("verify",), signal.SIGTERM),
    ],
)
def test_end_from_outside_is_taken_as_ctrl_c(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...], number: signal.Signals
) -> None:
    """A copy of a damaged recording may be as large as that."""
    path = write(tmp_path / "session.rrd", *journal(5))

    def refuse(*_: object) -> None:
        raise AssertionError(f"{number.name} ends the command at once")

    def is_being_written(_: object) -> bool:
        os.kill(os.getpid(), number)
        return False

    monkeypatch.setattr(parts, "is_being_written", is_being_written)
    monkeypatch.chdir(tmp_path)
    before = signal.signal(number, refuse), signal.getsignal(signal.SIGINT)
    try:
        assert main([*command, str(path)]) == INTERRUPTED
    finally:
        signal.signal(number, before[0])
        signal.signal(signal.SIGINT, before[1])


def test_text_of_a_file_controls_no_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    header, batch = journal(5)
    fields: tuple[dict[str, Any], ...] = ({"versions": {"\x1b[2J": "1"}}, {"format": 3, "created_utc": "\x1b[2J"})
    for i, changes in enumerate(fields):
        path = write(tmp_path / f"{i}.rrd", msgspec.structs.replace(header, **changes), batch)
        for command in (("verify",), ("recording", "inspect")):
            main([*command, str(path)])
    out, err = capsys.readouterr()
    assert "\N{REPLACEMENT CHARACTER}[2J" in out
    assert "\N{REPLACEMENT CHARACTER}[2J" in err
    assert "\x1b" not in out + err


def test_what_is_no_recording_is_one_line(tmp_path: Path, cli: CommandLine) -> None:
    text = f"iris-session: there is no recording below the folder {tmp_path}: give one with .rrd files"
    assert cli.refuse("recording", "inspect", tmp_path).startswith(text)
    assert "does not exist" in cli.refuse("recording", "inspect", "x" * 5000)
