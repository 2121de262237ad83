"""`iris-session anchors print`, `example`, `status`, `align`, `place` and `move`: sheets, screens, requests."""

from __future__ import annotations

import json
import tomllib
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import msgspec
import pytest

from iris_session import SessionConfig
from iris_session.cli import anchors
from iris_session.cli.anchors import format_alignment_status, select_participants, to_dict
from iris_session.cli.common import CommandError, find_participant
from iris_session.client import DeniedError
from iris_session.protocol.common import IDENTITY, Alignment, Denial, Pose
from iris_session.protocol.server_messages import ParticipantInfo
from iris_session.protocol.status import (
    AlignmentReport,
    AnchorReport,
    AnchorSeen,
    CrossCheckReport,
    ParticipantReport,
    StatusReport,
    UnverifiedReport,
)
from tests.cli.conftest import CommandLine

# --- print ------------------------------------------------------------------------------------------------------------


def test_print_writes_pdf_and_svg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: CommandLine) -> None:
    monkeypatch.chdir(tmp_path)
    for options, name, begin in (
        (("--out", "a.svg"), "a.svg", b"<?xml"),
        ((), "cell_1_door.pdf", b"%PDF-1.4"),  # named after the anchor
    ):
        result = cli.json("anchors", "print", "--size", "12cm", "--id", "cell 1/door", *options)
        assert (result["file"], result["id"], result["size_m"], result["paper"]) == (name, "cell 1/door", 0.12, "a4")
        assert Path(name).read_bytes().startswith(begin)
        assert result["for_headsets"]
    assert not cli.json("anchors", "print", "--size", "49mm")["for_headsets"]
    printed = cli.json("anchors", "print")
    assert SessionConfig().sheet_sizes() == {printed["id"]: printed["size_m"]}, "the sheet that sessions expect"


def test_printed_marks_are_those_of_the_anchors_file(tmp_path: Path, cli: CommandLine) -> None:
    out = str(tmp_path / "table.pdf")
    result = cli.json("anchors", "print", "--marks", "-o", out)
    assert (result["size_m"], set(result["marks_m"])) == (0.14, set("1234"))
    lines = cli.run("anchors", "print", "--marks", "--out", out)
    printed = tomllib.loads(lines[lines.index("[anchors") :])["anchors"]["table"]["marks_m"]
    anchors = tomllib.loads(cli.run("anchors", "example", "--marks"))["anchors"]["table"]
    assert anchors["marks_m"] == printed == result["marks_m"]
    assert anchors["size_m"] == 0.14
    assert "at most 142 mm" in cli.refuse("anchors", "print", "--marks", "--size", "150mm", "--out", out)
    cli.run("anchors", "print", "--marks", "--size", "200mm", "--paper", "a3", "--out", out)


def test_measured_sheet_gives_the_lines_of_the_anchors_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: CommandLine
) -> None:
    monkeypatch.chdir(tmp_path)
    table = tomllib.loads(cli.run("anchors", "print", "--marks", "--measured", "139mm"))["anchors"]["table"]
    assert table["size_m"] == 0.139
    assert table["marks_m"]["1"] == [-0.09174, 0.13066, 0.0], "the crosses are as far off as the code"
    old = tomllib.loads(cli.run("anchors", "print", "--marks", "--layout", 1, "--measured", "139mm"))["anchors"][
        "table"
    ]
    assert old["marks_m"]["3"] == [0.09174, -0.0556, 0.0]
    assert "print at 100 %" in cli.refuse("anchors", "print", "--measured", "182mm")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["--size", "160mm"], "at most 152 mm"),
        (["--paper", "a9"], "no paper 'a9'"),
        (["--id", ""], "id of a sheet"),
        (["--out", "sheet.png"], ".pdf or .svg"),
        (["--out", "/nowhere/sheet.pdf"], "cannot be written"),
    ],
)
def test_print_rejects_invalid_arguments(
    arguments: list[str], error: str, cli: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert error in cli.refuse("anchors", "print", *arguments)
    assert list(tmp_path.iterdir()) == []


# --- status -----------------------------------------------------------------------------------------------------------

S = 1_000_000_000
ANN = ParticipantReport(
    "p1",
    "ann \x1b[2J",
    "operator",
    True,
    alignment="measured",
    alignment_age_ns=61 * S,
    alignment_report=AlignmentReport(
        7,
        error_at_anchor_m=0.0021,
        error_at_robot_m=0.0044,
        residual_tilt_rad=0.0035,
        observations=210,
        viewpoints=3,
        unusable=2,
        seen=(AnchorSeen("table", 120, 300 * S), AnchorSeen("door", 90, 4 * S)),
    ),
)
BOB = ParticipantReport(
    "p2",
    "bob",
    "operator",
    True,
    alignment="none",
    alignment_void_ns=4 * S,
    alignment_report=AlignmentReport(
        0, False, advice="step closer", alarm="jump", alarm_size_m=0.12, alarm_ns=5 * S, pending_m=0.012
    ),
)
AGENT = ParticipantReport("p3", "desk", "agent", True, alignment="not_needed")
REPORT = StatusReport(
    1,
    "s1",
    "lab",
    60 * S,
    participants=(ANN, BOB, AGENT),
    anchors=(AnchorReport("table", Pose((0.0, -0.45, 0.0), IDENTITY.q), 0.16), AnchorReport("door", IDENTITY)),
    cross_checks=(
        CrossCheckReport("p1", "p2", "table", 0.031, 0.01, 0.0082, 4 * S, 40),
        CrossCheckReport("p1", "gone", "door", 0.003, 0.0, 0.0082, 4 * S, 40),
    ),
    unverified=(UnverifiedReport("p2", "p1", "table"),),
)


def test_screen_shows_basis_of_every_alignment() -> None:
    text = "\n".join(format_alignment_status(REPORT))
    ann = next(line for line in text.split("\n") if "ann" in line)
    assert " ".join(ann.split()).endswith("(p1) measured 7 61.0 s 2.1 mm 4.4 mm 210 3 0.2 deg -")
    for value in (
        *("door 90 times", "table 120 times", "2 unusable", "none STOPPED", "12.0 mm, 0.00 deg", "void for 4.0 s"),
        *("ALARM jump", "advice: step closer", "0.0000, -0.4500, 0.0000 m, rotation 1,0,0,0, 160 mm"),
        *("0.0000, 0.0000, 0.0000 m, rotation 1,0,0,0", "bob - ann \x1b[2J: UNVERIFIED"),
    ):
        assert value in text
    pair, other = (line for line in text.split("\n") if " apart at " in line)
    for value in ("bob (p2)", "31.0 mm, 0.57 deg", "'table'", "8.2 mm", "40 observations"):
        assert value in pair
    assert pair.endswith("TOO FAR APART")
    assert " - gone: 3.0 mm" in other
    assert not other.endswith("TOO FAR APART")
    assert "desk" not in text


@pytest.mark.parametrize(
    "fields",
    [{"alignment": "placed"}, {"alignment_report": msgspec.structs.replace(ANN.alignment_report, offset=True)}],
)
def test_placed_and_moved_alignments_have_no_stated_error(fields: dict[str, Any]) -> None:
    report = msgspec.structs.replace(REPORT, participants=(msgspec.structs.replace(ANN, **fields),))
    assert "2.1 mm" not in "\n".join(format_alignment_status(report))


def test_json_has_everything() -> None:
    result = json.loads(json.dumps(to_dict(REPORT), default=msgspec.to_builtins))
    assert [one["id"] for one in result["participants"]] == ["p1", "p2"]
    assert result["participants"][0]["alignment_report"]["seen"][0]["anchor_id"] == "table"
    assert [one["as_expected"] for one in result["cross_checks"]] == [False, True]
    assert result["unverified"] == [{"participant": "p2", "other": "p1", "anchor_id": "table"}]
    assert result["anchors"][0]["T_world_anchor"] == [[0.0, -0.45, 0.0], [1.0, 0.0, 0.0, 0.0]]


# --- selection of participants, and requests of a director ------------------------------------------------------------

MEASURED = Alignment(1, "measured", IDENTITY)


class Session:
    """A client double: its participants, and the requests made of it."""

    def __init__(self, *people: ParticipantInfo) -> None:
        self.participants = {one.id: one for one in people}
        self.mirror = self.alignment = self
        self.participant_id = "p20"  # its own
        self.asked: list[tuple[Any, ...]] = []
        self.denies: set[str] = set()
        self.report = REPORT

    def start_run(self, participant: str) -> None:
        if participant in self.denies:
            raise DeniedError(Denial("role", "not yours"))
        self.asked.append(("start", participant))

    def stop_run(self, participant: str) -> None:
        self.asked.append(("stop", participant))

    def place(self, participant: str, pose: Any, *, offset: bool) -> None:
        self.asked.append((participant, pose, offset))

    def move_anchor(self, anchor_id: str, pose: Any, *, force: bool) -> None:
        if anchor_id in self.denies and not force:
            raise DeniedError(Denial("too_far", f"anchor {anchor_id} would be moved by 450.0 m: --force"))
        self.asked.append((anchor_id, pose))

    def status(self) -> StatusReport:
        return self.report


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch) -> Session:
    here = Session(
        ParticipantInfo("p1", "ann", "operator", True),
        ParticipantInfo("p2", "bob", "operator", True, alignment=MEASURED),
        ParticipantInfo("p10", "bob", "observer", False, alignment=MEASURED),
        ParticipantInfo("p3", "desk", "agent", True, alignment=Alignment(0, "not_needed", IDENTITY)),
    )

    monkeypatch.setattr(anchors, "make_client", lambda *_: nullcontext(here))
    return here


def test_participants_are_selected_by_id_or_name(session: Any) -> None:
    assert [one.id for one in select_participants(session, "ann")] == ["p1"]
    assert [one.id for one in select_participants(session, "p10")] == ["p10"]
    assert [one.id for one in select_participants(session, "all")] == ["p1", "p2"], "who is here and has a headset"
    with pytest.raises(CommandError, match=r"'bob': .*p2 \(operator\), p10 \(observ"):
        select_participants(session, "bob")
    with pytest.raises(CommandError, match=r"'carl' .*: ann \(p1\), bob \(p2\), .*bob \(p10\)$"):
        select_participants(session, "carl")
    with pytest.raises(CommandError, match="'all'"):
        find_participant(session, "all")
    empty: Any = Session()
    with pytest.raises(CommandError) as caught:
        select_participants(empty, "all")
    assert caught.value.status == 1


def test_runs_are_started_and_stopped(session: Session, cli: CommandLine) -> None:
    assert cli.run("anchors", "align", "start").startswith("ann (p1): started")
    stopped = cli.json("anchors", "align", "stop", "ann")
    assert stopped == {"ok": True, "action": "stop", "participants": [{"id": "p1", "name": "ann", "denied": ""}]}
    assert session.asked == [("start", "p1"), ("start", "p2"), ("stop", "p1")]


def test_align_continues_after_a_denial(session: Session, cli: CommandLine) -> None:
    session.denies = {"p1"}
    cli.run("anchors", "align", "start", status=1)
    assert session.asked == [("start", "p2")]
    assert "denied (role): not yours" in cli.out
    assert "denied (role)" in cli.refuse("anchors", "align", "start", "ann")


def test_headsets_are_placed_and_anchors_moved(session: Session, cli: CommandLine) -> None:
    cli.run("anchors", "place", "ann", "--pose", "0.4,0,0,1,0,0,0")
    cli.run("anchors", "place", "p2", "--offset", "--pose", "-0.01,0,0,1,0,0,0")  # a minus is no option
    result = cli.json("anchors", "move", "table", "--pose=-0.2,0.1,0,0,0,0,1")
    assert session.asked == [
        ("p1", ((0.4, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), False),
        ("p2", ((-0.01, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), True),
        ("table", ((-0.2, 0.1, 0.0), (0.0, 0.0, 0.0, 1.0))),
    ]
    assert result.pop("moved_m") == pytest.approx(0.585, abs=1e-3)
    assert result == {"ok": True, "anchor": "table", "follow": ["p1"], "stay": []}, "bob is not aligned at all"


def test_move_lists_alignments_that_follow(session: Session, cli: CommandLine) -> None:
    stopped = msgspec.structs.replace(ANN.alignment_report, running=False)
    others = [
        msgspec.structs.replace(ANN, id="p4", name="cay", alignment_report=stopped),
        msgspec.structs.replace(ANN, id="p5", name="dan", alignment="placed"),
        msgspec.structs.replace(ANN, id="p6", name="eve", connected=False),
        msgspec.structs.replace(ANN, id="p7", name="fay", alignment_report=AlignmentReport(3)),
    ]
    session.report = msgspec.structs.replace(REPORT, participants=(ANN, BOB, AGENT, *others))
    first, *stay = cli.run("anchors", "move", "table", "--pose", "0,-0.4,0,1,0,0,0").splitlines()
    assert first.startswith("anchor 'table' moved by 50 mm: 1 ")
    stopped_run, placed, *not_observed = stay
    assert "cay (p4)" in stopped_run
    assert "align start p4" in stopped_run
    assert "dan (p5)" in placed
    assert "align start p5" in placed
    assert [line.split(": ")[1] for line in not_observed] == ["eve (p6)", "fay (p7)"]
    assert all("'table'" in line for line in not_observed)


def test_far_move_of_an_anchor_needs_force(session: Session, cli: CommandLine) -> None:
    far = ["anchors", "move", "table", "--pose", "450,-0.45,0,1,0,0,0"]
    session.denies = {"table"}
    assert "denied (too_far)" in cli.refuse(*far)
    assert session.asked == []
    cli.run(*far, "--force")
    assert [asked[0] for asked in session.asked] == ["table"]
