"""`iris-session anchors status`, `align`, `place`, `move` on paper: screens, who is meant, what is sent."""

from __future__ import annotations

import argparse
import json
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import pytest

from iris_session.authority import AuthorityConfig
from iris_session.cli import anchors
from iris_session.cli.anchors import format_alignment_status, select_participants, to_dict
from iris_session.cli.common import CommandError
from iris_session.cli.main import main
from iris_session.client import Client, DeniedError
from iris_session.protocol.common import IDENTITY, Alignment, Denial, Pose
from iris_session.protocol.server_messages import AlignmentRun, AnchorMoved, Event, ParticipantInfo
from iris_session.protocol.status import (
    AlignmentReport,
    AnchorReport,
    AnchorSeen,
    CrossCheckReport,
    ParticipantReport,
    StatusReport,
)
from tests.client.harness import LiveSession

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
DESK = ParticipantReport("p3", "desk", "agent", True, alignment="not_needed")
REPORT = StatusReport(
    1,
    "s1",
    "lab",
    60 * S,
    participants=(ANN, BOB, DESK),
    anchors=(AnchorReport("table", Pose((0.0, -0.45, 0.0), IDENTITY.q), 0.16), AnchorReport("door", IDENTITY)),
    cross_checks=(
        CrossCheckReport("p1", "p2", "table", 0.031, 0.01, 0.0082, 4 * S, 40),
        CrossCheckReport("p1", "gone", "door", 0.003, 0.0, 0.0082, 4 * S, 40),
    ),
)


def test_the_screen_says_what_every_alignment_rests_on() -> None:
    text = "\n".join(format_alignment_status(REPORT))
    ann = next(line for line in format_alignment_status(REPORT) if "ann" in line)
    assert " ".join(ann.split()).endswith("(p1) measured 7 61 s 2.1 mm 4.4 mm 210 3 0.2 deg -")
    assert "saw door 90 times, 4 s ago; table 120 times, 5 min ago; 2 of no use" in text
    assert "none STOPPED" in text
    assert "12.0 mm, 0.00 deg to go" in text
    assert "void for 4 s" in text
    assert "ALARM jump: off by 120 mm, 5 s ago" in text
    assert "advice: step closer" in text
    assert "anchor 'table': at 0.0000, -0.4500, 0.0000 m, turned 1,0,0,0, 160 mm" in text
    assert "anchor 'door': at 0.0000, 0.0000, 0.0000 m, turned 1,0,0,0" in text
    pair, other = (line for line in format_alignment_status(REPORT) if " apart at " in line)
    assert "bob (p2): 31.0 mm, 0.57 deg apart at 'table', 95 % expected below 8.2 mm; 40 looks, 4 s ago" in pair
    assert pair.endswith("TOO FAR APART")
    assert " - gone: 3.0 mm" in other
    assert not other.endswith("TOO FAR APART")
    assert "desk" not in text


def test_names_of_strangers_move_no_cursor() -> None:
    assert all(line.isprintable() for line in format_alignment_status(REPORT))


def test_offsets_and_placed_alignments_state_no_error() -> None:
    for fields in (
        {"alignment": "placed"},
        {"alignment_report": msgspec.structs.replace(ANN.alignment_report, offset=True)},
    ):
        report = msgspec.structs.replace(REPORT, participants=(msgspec.structs.replace(ANN, **fields),))
        assert "2.1 mm" not in "\n".join(format_alignment_status(report))


def test_what_an_old_session_does_not_say_is_left_out() -> None:
    old = StatusReport(1, "s1", "lab", 0, participants=(msgspec.structs.replace(ANN, alignment_report=None),))
    assert any("ann" in line for line in format_alignment_status(old))
    assert "this session has no anchors" in format_alignment_status(old)
    assert to_dict(old)["participants"][0]["alignment_report"] is None


def test_json_has_everything() -> None:
    told = json.loads(json.dumps(to_dict(REPORT)))
    assert [one["id"] for one in told["participants"]] == ["p1", "p2"]
    assert told["participants"][0]["alignment_report"]["seen"][0]["anchor_id"] == "table"
    assert [one["as_expected"] for one in told["cross_checks"]] == [False, True]
    assert told["anchors"][0]["T_world_anchor"] == [[0.0, -0.45, 0.0], [1.0, 0.0, 0.0, 0.0]]


# --- who is meant, and what a director sends --------------------------------------------------------------------------

MEASURED = Alignment(1, "measured", IDENTITY)


class Session:
    """Stands for a client in a session: who is there, and what was asked of it."""

    def __init__(self, *people: ParticipantInfo) -> None:
        self.participants = {one.id: one for one in people}
        self.mirror = self
        self.asked: list[tuple[Any, ...]] = []
        self.denies: set[str] = set()
        self.report = REPORT

    def align(self, action: str, participant: str) -> None:
        if participant in self.denies:
            raise DeniedError(Denial("role", "not yours"))
        self.asked.append((action, participant))

    def place_alignment(self, participant: str, pose: Any, *, offset: bool) -> None:
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

    @contextmanager
    def join_as_director(arguments: argparse.Namespace) -> Iterator[Session]:
        yield here

    monkeypatch.setattr(anchors, "join_as_director", join_as_director)
    return here


def test_participants_are_meant_by_id_or_name(session: Any) -> None:
    assert [one.id for one in select_participants(session, "ann")] == ["p1"]
    assert [one.id for one in select_participants(session, "p10")] == ["p10"]
    assert [one.id for one in select_participants(session, "all")] == ["p1", "p2"], "who is here and has a headset"
    with pytest.raises(
        CommandError, match=r"2 participants are called 'bob', give an id: p2 \(operator\), p10 \(observ"
    ):
        select_participants(session, "bob")
    with pytest.raises(CommandError, match=r"called 'carl'; with a headset: ann \(p1\), bob \(p2\), bob \(p10\)$"):
        select_participants(session, "carl")
    with pytest.raises(CommandError, match="no participant is called 'all'"):
        select_participants(session, "all", allow_all=False)


def test_nobody_to_align(monkeypatch: pytest.MonkeyPatch) -> None:
    empty: Any = Session()
    with pytest.raises(CommandError, match="nobody in this session has a headset") as caught:
        select_participants(empty, "all")
    assert caught.value.status == 1


def test_runs_are_started_and_stopped(session: Session, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["anchors", "align", "start"]) == 0
    assert main(["anchors", "align", "stop", "ann", "--json"]) == 0
    assert session.asked == [("start", "p1"), ("start", "p2"), ("stop", "p1")]
    out = capsys.readouterr().out.splitlines()
    assert out[0] == "ann (p1): started: look at the sheets"
    assert json.loads(out[2]) == {
        "ok": True,
        "action": "stop",
        "participants": [{"id": "p1", "name": "ann", "denied": ""}],
    }


def test_one_denial_of_several_is_told_and_the_others_go_on(
    session: Session, capsys: pytest.CaptureFixture[str]
) -> None:
    session.denies = {"p1"}
    assert main(["anchors", "align", "start"]) == 1
    assert session.asked == [("start", "p2")]
    assert "ann (p1): denied (role): not yours" in capsys.readouterr().out
    assert main(["anchors", "align", "start", "ann"]) == 2
    assert capsys.readouterr().err == "iris-session: denied (role): not yours\n"


def test_headsets_are_placed_and_anchors_moved(session: Session, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["anchors", "place", "ann", "--pose", "0.4,0,0,1,0,0,0"]) == 0
    assert main(["anchors", "place", "p2", "--offset", "--pose", "-0.01,0,0,1,0,0,0"]) == 0, "a minus is no option"
    assert main(["anchors", "move", "table", "--pose=-0.2,0.1,0,0,0,0,1", "--json"]) == 0
    assert session.asked == [
        ("p1", ((0.4, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), False),
        ("p2", ((-0.01, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), True),
        ("table", ((-0.2, 0.1, 0.0), (0.0, 0.0, 0.0, 1.0))),
    ]
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told.pop("moved_m") == pytest.approx(0.585, abs=1e-3)
    assert told == {"ok": True, "anchor": "table", "follow": ["p1"], "stay": []}, "bob is not aligned at all"


def test_a_moved_anchor_tells_whose_alignments_follow(session: Session, capsys: pytest.CaptureFixture[str]) -> None:
    stopped = msgspec.structs.replace(ANN.alignment_report, running=False)
    others = [
        msgspec.structs.replace(ANN, id="p4", name="cay", alignment_report=stopped),
        msgspec.structs.replace(ANN, id="p5", name="dan", alignment="placed"),
        msgspec.structs.replace(ANN, id="p6", name="eve", connected=False),
        msgspec.structs.replace(ANN, id="p7", name="fay", alignment_report=AlignmentReport(3)),
    ]
    session.report = msgspec.structs.replace(REPORT, participants=(ANN, BOB, DESK, *others))
    assert main(["anchors", "move", "table", "--pose", "0,-0.4,0,1,0,0,0"]) == 0
    first, *stay = capsys.readouterr().out.splitlines()
    assert first == "anchor 'table' moved by 50 mm: alignments that are measured to it follow (1)"
    assert [line.strip() for line in stay] == [
        "not that of cay (p4): its run is stopped; `iris-session anchors align start p4`",
        "not that of dan (p5): a director placed it; `iris-session anchors align start p5` measures it",
        "not that of eve (p6): it has not looked at 'table' since it came; it follows when it does",
        "not that of fay (p7): it has not looked at 'table' since it came; it follows when it does",
    ]


def test_an_anchor_is_moved_far_only_by_force(session: Session, capsys: pytest.CaptureFixture[str]) -> None:
    far = ["anchors", "move", "table", "--pose", "450,-0.45,0,1,0,0,0"]
    session.denies = {"table"}
    assert main(far) == 2
    assert session.asked == []
    assert "denied (too_far): anchor table would be moved by 450.0 m: --force" in capsys.readouterr().err
    assert main([*far, "--force"]) == 0
    assert [asked[0] for asked in session.asked] == ["table"]


@pytest.mark.parametrize("command", [["status"], ["align", "start"], ["move", "table", "--pose", "0,0,0,1,0,0,0"]])
def test_that_nobody_is_there_is_found_out_without_waiting(
    command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing listens at the port: no client is made, which would wait for a session to begin."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # nobody else gets it, and it takes no connections
        monkeypatch.setattr(Client, "open", lambda self: pytest.fail("waits"))
        where = f"127.0.0.1:{taken.getsockname()[1]}"
        there = [where] if command == ["status"] else ["--address", where]
        assert main(["anchors", *command, *there]) == 2
    err = capsys.readouterr().err
    assert f"no session answers at {where}: is `iris-session serve` running there? (TCP port" in err
    assert "refused" in err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["place", "ann"], "--pose"),
        (["place", "ann", "--pose", "1,2,3"], "is not a pose: x,y,z in metres"),
        (["move", "table", "--pose", "0,0,0,1,1,0,0"], "a unit quaternion"),
        (["align", "begin"], "choose from"),
        (["move", "--pose", "0,0,0,1,0,0,0"], "ANCHOR"),
    ],
)
def test_commands_that_cannot_be_meant(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["anchors", *words])
    assert caught.value.code == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("action", ["status", "align", "place", "move", "solve", "example"])
def test_help_has_examples(action: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["anchors", action, "--help"])
    assert caught.value.code == 0
    assert re.search(rf"examples:\n  iris-session anchors {action}", capsys.readouterr().out)


def test_address_that_is_none(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["anchors", "status", "nowhere:port"]) == 2
    assert main(["anchors", "move", "table", "--pose", "0,0,0,1,0,0,0", "--address", "nowhere:port"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert all("is not HOST:PORT" in line for line in lines)


def test_a_running_session_takes_what_a_director_says(capsys: pytest.CaptureFixture[str]) -> None:
    """The same commands with a real front and authority."""
    config = AuthorityConfig(anchors={"table": IDENTITY})
    live = LiveSession(config)
    events: list[Event] = []
    try:
        with Client(live.address, name="ann", alignment="measured", on_event=events.append) as ann:
            there = ["--address", live.address]
            assert main(["anchors", "place", "ann", "--pose", "0.4,0,0,1,0,0,0", *there]) == 0
            assert main(["anchors", "align", "stop", ann.participant_id, *there]) == 0
            assert main(["anchors", "align", "start", *there]) == 0
            assert main(["anchors", "move", "table", "--pose=-0.2,0.1,0,1,0,0,0", *there]) == 0
            assert ann.wait_for(lambda _: any(isinstance(e.body, AnchorMoved) for e in events))
            assert ann.alignment is not None
            assert ann.alignment.kind == "placed"
            runs = [(e.body.participant, e.body.running) for e in events if isinstance(e.body, AlignmentRun)]
            assert runs == [(ann.participant_id, False), (ann.participant_id, True)]
            assert [e.body.T_world_anchor.p for e in events if isinstance(e.body, AnchorMoved)] == [(-0.2, 0.1, 0.0)]
            capsys.readouterr()
            assert main(["anchors", "move", "shelf", "--pose", "0,0,0,1,0,0,0", *there]) == 2
            assert "denied" in capsys.readouterr().err
    finally:
        live.close()
