"""`iris-session anchors status`, `align`, `place`, `move` and `solve`: screens, requests, results."""

from __future__ import annotations

import argparse
import json
import math
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from anchors.alignment import AlignmentEstimate
from anchors.constellation import Constellation
from anchors.pose import PoseTuple, compose, distance, inverse, quat_from_rotvec
from iris_session.alignment.smoother import AlignmentSmoother, AnchorHistory, fuse_estimates
from iris_session.cli import anchors_session
from iris_session.cli.anchors_session import format_alignment_status, select_participants, to_dict
from iris_session.cli.common import CommandError, find_participant
from iris_session.cli.main import main
from iris_session.client import Client, DeniedError
from iris_session.protocol.common import IDENTITY, Alignment, Denial, Pose
from iris_session.protocol.server_messages import AlignmentAlarmed, AnchorMoved, ParticipantInfo
from iris_session.protocol.status import (
    AlignmentReport,
    AnchorReport,
    AnchorSeen,
    CrossCheckReport,
    ParticipantReport,
    StatusReport,
)
from iris_session.recording import Recording, TrackingFrame, read_alignment_history
from iris_session.session.config import load_anchors
from tests.anchors.worlds import shifted, tracking_frame
from tests.recording.headsets import Played

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
)


def test_screen_shows_basis_of_every_alignment() -> None:
    text = "\n".join(format_alignment_status(REPORT))
    ann = next(line for line in format_alignment_status(REPORT) if "ann" in line)
    assert " ".join(ann.split()).endswith("(p1) measured 7 61 s 2.1 mm 4.4 mm 210 3 0.2 deg -")
    for value in ("door 90 times", "table 120 times", "2 unusable"):
        assert value in text
    assert "none STOPPED" in text
    assert "12.0 mm, 0.00 deg" in text
    assert "void for 4 s" in text
    assert "ALARM jump" in text
    assert "advice: step closer" in text
    assert "0.0000, -0.4500, 0.0000 m, rotation 1,0,0,0, 160 mm" in text
    assert "0.0000, 0.0000, 0.0000 m, rotation 1,0,0,0" in text
    pair, other = (line for line in format_alignment_status(REPORT) if " apart at " in line)
    for value in ("bob (p2)", "31.0 mm, 0.57 deg", "'table'", "8.2 mm", "40 observations"):
        assert value in pair
    assert pair.endswith("TOO FAR APART")
    assert " - gone: 3.0 mm" in other
    assert not other.endswith("TOO FAR APART")
    assert "desk" not in text
    assert all(line.isprintable() for line in format_alignment_status(REPORT))


def test_offsets_and_placed_alignments_state_no_error() -> None:
    for fields in (
        {"alignment": "placed"},
        {"alignment_report": msgspec.structs.replace(ANN.alignment_report, offset=True)},
    ):
        report = msgspec.structs.replace(REPORT, participants=(msgspec.structs.replace(ANN, **fields),))
        assert "2.1 mm" not in "\n".join(format_alignment_status(report))


def test_missing_fields_of_old_sessions_are_omitted() -> None:
    old = StatusReport(1, "s1", "lab", 0, participants=(msgspec.structs.replace(ANN, alignment_report=None),))
    assert any("ann" in line for line in format_alignment_status(old))
    assert "no anchors" in "\n".join(format_alignment_status(old))
    assert to_dict(old)["participants"][0]["alignment_report"] is None


def test_json_has_everything() -> None:
    result = json.loads(json.dumps(to_dict(REPORT)))
    assert [one["id"] for one in result["participants"]] == ["p1", "p2"]
    assert result["participants"][0]["alignment_report"]["seen"][0]["anchor_id"] == "table"
    assert [one["as_expected"] for one in result["cross_checks"]] == [False, True]
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

    @contextmanager
    def join_as_director(arguments: argparse.Namespace) -> Iterator[Session]:
        yield here

    monkeypatch.setattr(anchors_session, "join_as_director", join_as_director)
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


def test_runs_are_started_and_stopped(session: Session, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["anchors", "align", "start"]) == 0
    assert main(["anchors", "align", "stop", "ann", "--json"]) == 0
    assert session.asked == [("start", "p1"), ("start", "p2"), ("stop", "p1")]
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith("ann (p1): started")
    assert json.loads(out[2]) == {
        "ok": True,
        "action": "stop",
        "participants": [{"id": "p1", "name": "ann", "denied": ""}],
    }


def test_align_continues_after_a_denial(session: Session, capsys: pytest.CaptureFixture[str]) -> None:
    session.denies = {"p1"}
    assert main(["anchors", "align", "start"]) == 1
    assert session.asked == [("start", "p2")]
    assert "denied (role): not yours" in capsys.readouterr().out
    assert main(["anchors", "align", "start", "ann"]) == 2
    assert "denied (role)" in capsys.readouterr().err


def test_headsets_are_placed_and_anchors_moved(session: Session, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["anchors", "place", "ann", "--pose", "0.4,0,0,1,0,0,0"]) == 0
    assert main(["anchors", "place", "p2", "--offset", "--pose", "-0.01,0,0,1,0,0,0"]) == 0, "a minus is no option"
    assert main(["anchors", "move", "table", "--pose=-0.2,0.1,0,0,0,0,1", "--json"]) == 0
    assert session.asked == [
        ("p1", ((0.4, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), False),
        ("p2", ((-0.01, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), True),
        ("table", ((-0.2, 0.1, 0.0), (0.0, 0.0, 0.0, 1.0))),
    ]
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result.pop("moved_m") == pytest.approx(0.585, abs=1e-3)
    assert result == {"ok": True, "anchor": "table", "follow": ["p1"], "stay": []}, "bob is not aligned at all"


def test_move_lists_alignments_that_follow(session: Session, capsys: pytest.CaptureFixture[str]) -> None:
    stopped = msgspec.structs.replace(ANN.alignment_report, running=False)
    others = [
        msgspec.structs.replace(ANN, id="p4", name="cay", alignment_report=stopped),
        msgspec.structs.replace(ANN, id="p5", name="dan", alignment="placed"),
        msgspec.structs.replace(ANN, id="p6", name="eve", connected=False),
        msgspec.structs.replace(ANN, id="p7", name="fay", alignment_report=AlignmentReport(3)),
    ]
    session.report = msgspec.structs.replace(REPORT, participants=(ANN, BOB, AGENT, *others))
    assert main(["anchors", "move", "table", "--pose", "0,-0.4,0,1,0,0,0"]) == 0
    first, *stay = capsys.readouterr().out.splitlines()
    assert first.startswith("anchor 'table' moved by 50 mm: 1 ")
    stopped_run, placed, *not_observed = stay
    assert "cay (p4)" in stopped_run
    assert "align start p4" in stopped_run
    assert "dan (p5)" in placed
    assert "align start p5" in placed
    assert [line.split(": ")[1] for line in not_observed] == ["eve (p6)", "fay (p7)"]
    assert all("'table'" in line for line in not_observed)


def test_far_move_of_an_anchor_needs_force(session: Session, capsys: pytest.CaptureFixture[str]) -> None:
    far = ["anchors", "move", "table", "--pose", "450,-0.45,0,1,0,0,0"]
    session.denies = {"table"}
    assert main(far) == 2
    assert session.asked == []
    assert "denied (too_far)" in capsys.readouterr().err
    assert main([*far, "--force"]) == 0
    assert [asked[0] for asked in session.asked] == ["table"]


@pytest.mark.parametrize("command", [["status"], ["align", "start"]])
def test_unreachable_session_fails_at_once(
    command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing listens at the port: the command must not wait for a session to begin."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound without listening: no other process gets the port, connections are refused
        monkeypatch.setattr(Client, "open", lambda self: pytest.fail("waits"))
        where = f"127.0.0.1:{taken.getsockname()[1]}"
        there = [where] if command == ["status"] else ["--address", where]
        assert main(["anchors", *command, *there]) == 2
    err = capsys.readouterr().err
    assert f"at {where}" in err
    assert "refused" in err


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["place", "ann"], "--pose"),
        (["place", "ann", "--pose", "1,2,3"], "is not a pose"),
        (["move", "table", "--pose", "0,0,0,1,1,0,0"], "a unit quaternion"),
        (["align", "begin"], "choose from"),
        (["move", "--pose", "0,0,0,1,0,0,0"], "ANCHOR"),
    ],
)
def test_invalid_commands_are_rejected(words: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["anchors", *words])
    assert caught.value.code == 2
    assert expected in capsys.readouterr().err


Capture = pytest.CaptureFixture[str]
TRUE: dict[str, PoseTuple] = {
    "table": ((0.0, -0.45, 0.0), (1.0, 0.0, 0.0, 0.0)),
    "door": ((1.2, 0.1, 0.3), (0.7071067811865476, 0.0, 0.0, 0.7071067811865476)),
    "shelf": ((-0.4, 0.9, 0.5), (1.0, 0.0, 0.0, 0.0)),
}
#: The session assumes that the shelf's sheet is at its configured place.
BELIEVED = {**TRUE, "shelf": shifted(TRUE["shelf"], (0.03, 0.0, 0.0))}


def frames() -> tuple[PoseTuple, PoseTuple]:
    rng = np.random.default_rng(7)
    return tracking_frame(rng), tracking_frame(rng)


def play() -> Played:
    """Ann and bob observe three sheets; ann's second alignment is 25 mm off, stated as 3 mm. Carl observes nothing."""
    played = Played(BELIEVED, {"table": 0.16})
    ann, bob = frames()
    played.join(1, "p1", "ann \x1b[2J")
    played.join(2, "p2", "bob")
    played.join(3, "p3", "carl", role="observer")
    played.join(4, "p4", "desk", role="agent", alignment=Alignment(0, "not_needed", IDENTITY))
    for viewpoint in (1, 2, 3):
        played.look(1, "table", TRUE["table"], ann, viewpoint)
    played.aligned("p1", 1, ann, 0.003)
    for viewpoint in (4, 5):
        played.look(1, "door", TRUE["door"], ann, viewpoint)
    played.aligned("p1", 2, shifted(ann, (0.0, 0.025, 0.0)), 0.003)
    played.look(1, "shelf", TRUE["shelf"], ann, 6)
    for viewpoint, name in enumerate(("table", "door", "shelf", "table", "door"), 1):
        played.look(2, name, TRUE[name], bob, viewpoint)
    played.aligned("p2", 1, bob, 0.003)
    return played


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return play().write(tmp_path_factory.mktemp("solve") / "session.rrd")


def solve(capsys: Capture, *words: str) -> dict[str, Any]:
    assert main(["anchors", "solve", *words, "--json"]) == 0
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    return result


def test_alignments_are_solved_again_and_compared(recording: Path, capsys: Capture) -> None:
    result = solve(capsys, str(recording))
    ann, bob, carl = result["participants"]
    assert (ann["id"], bob["name"], carl["frames"]) == ("p1", "bob", [])
    (frame,) = ann["frames"]
    assert (frame["looks"], frame["sheets"]) == (120, {"table": 60, "door": 40, "shelf": 20})
    T = frame["T_world_tracking"]
    assert distance(tuple(T["position_m"]), frames()[0][0]) < 0.01
    first, second = frame["alignments"]
    assert first["off_m"] < 0.005
    assert not first["beyond"]
    assert second["off_m"] == pytest.approx(0.025, abs=0.005)
    assert second["beyond"]
    assert (second["stated_m"], second["until_s"]) == (0.003, None)
    assert 0.0005 < second["solved_m"] < 0.006
    assert not bob["frames"][0]["alignments"][0]["beyond"]


def test_observations_of_moved_sheet_are_outliers(recording: Path, capsys: Capture) -> None:
    result = solve(capsys, str(recording))
    for person in result["participants"][:2]:
        (outlier,) = person["frames"][0]["outliers"]
        assert outlier["anchor_id"] == "shelf"
        assert outlier["off_m"] == pytest.approx(0.03, abs=0.01)


def test_true_anchor_poses_can_be_given(recording: Path, tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "true.toml"
    path.write_text(Constellation("table", TRUE, {}, {"table": 0.16}).to_toml())
    result = solve(capsys, str(recording), "--anchors", str(path))
    assert [one["frames"][0]["outliers"] for one in result["participants"][:2]] == [[], []]
    assert result["constellation"]["moved"] == []


def test_relative_sheet_poses_and_moved_sheet(recording: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "anchors.toml"
    result = solve(capsys, str(recording), "--out", str(out))
    (moved,) = result["constellation"]["moved"]
    assert moved["anchor_id"] == "shelf"
    assert moved["distance_m"] == pytest.approx(0.03, abs=0.008)
    found = load_anchors(out)
    assert found.anchors["table"] == TRUE["table"], "the reference stays where it is"
    for name in TRUE:
        seen, true = (compose(inverse(c["table"]), c[name]) for c in (found.anchors, TRUE))
        assert distance(seen[0], true[0]) <= 2.0 * found.error_m[name] < 0.04, name
    assert found.sizes == dict.fromkeys(TRUE, 0.16)


def test_solve_prints_text(recording: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "anchors.toml"
    assert main(["anchors", "solve", str(recording), "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    lines = shown.splitlines()
    assert all(line.isprintable() for line in lines)
    assert any("120 observations from 6 places" in line and "table 60" in line for line in lines)
    (beyond,) = [line for line in lines if "EXCEEDS THE STATED ERROR" in line]
    assert beyond.lstrip().startswith("version 2 (measured), 10.0 s to the end: 2")
    assert "stated 3.0 mm" in beyond
    assert any(line.startswith("carl (p3): no ") for line in lines)
    assert sum("outlier: 'shelf'" in line for line in lines) == 2
    assert any(line.startswith("MOVED: sheet 'shelf' lies ") for line in lines)
    assert "desk" not in shown
    assert lines[-1].endswith(f"iris-session serve SCENE --anchors {out}")


def test_moved_anchor_is_used_at_its_pose_of_the_time(tmp_path: Path) -> None:
    """Equal observations before and after: the alignment follows the anchor."""
    played, T = Played({"table": TRUE["table"]}), frames()[0]
    played.join(1, "p1", "ann")
    for viewpoint in (1, 2):
        played.look(1, "table", TRUE["table"], T, viewpoint)
    played.wait(20.0)
    played.event(AnchorMoved("table", Pose(*shifted(TRUE["table"], (0.5, 0.0, 0.0)))))
    moved_ns = played.now_ns
    played.wait(20.0)
    with Recording.open(played.write(tmp_path / "session.rrd")) as recording:
        history = read_alignment_history(recording)
    resolver = AlignmentSmoother(
        history.observations[TrackingFrame("p1", 1, 0)], AnchorHistory(history, {"table": TRUE["table"]}, None), {}
    )
    before, after = resolver.estimate_at(moved_ns - 1), resolver.estimate_at(moved_ns)
    x, y, z = before.T_world_tracking[0]
    assert distance(after.T_world_tracking[0], (x + 0.5, y, z)) < 1e-6


def test_later_observations_are_used(tmp_path: Path) -> None:
    """During the session there were two observations, which are too few; a minute later there were more."""
    played, T = Played({"table": TRUE["table"]}), frames()[0]
    played.join(1, "p1", "ann")
    played.look(1, "table", TRUE["table"], T, 1, n=2)
    early_ns = played.now_ns
    played.wait(60.0)
    played.look(1, "table", TRUE["table"], T, 2)
    with Recording.open(played.write(tmp_path / "session.rrd")) as recording:
        history = read_alignment_history(recording)
    solution = AlignmentSmoother(
        history.observations[TrackingFrame("p1", 1, 0)], AnchorHistory(history, {"table": TRUE["table"]}, None), {}
    ).estimate_at(early_ns)
    assert (solution.refused, solution.n_observations) == (False, 20)


def test_unusable_observations_are_counted(tmp_path: Path, capsys: Capture) -> None:
    played, T = Played({"table": TRUE["table"]}, {"table": 0.12}), frames()[0]
    played.join(1, "p1", "ann")
    played.look(1, "table", TRUE["table"], T, 1, n=6)
    played.look(1, "door", TRUE["door"], T, 2, n=5)
    result = solve(capsys, str(played.write(tmp_path / "session.rrd")))
    (frame,) = result["participants"][0]["frames"]
    assert frame["refused"]
    assert "160 mm, not 120 mm" in frame["advice"]
    assert frame["unused"] == {"unknown anchor": 5, "wrong size": 6}


def test_solve_reports_sheet_against_gravity(tmp_path: Path, capsys: Capture) -> None:
    played, T = Played({"table": TRUE["table"]}), frames()[0]
    upright: PoseTuple = (TRUE["table"][0], quat_from_rotvec((math.pi / 2.0, 0.0, 0.0)))
    played.join(1, "p1", "ann")
    played.look(1, "table", upright, T, 1, n=8)
    assert main(["anchors", "solve", str(played.write(tmp_path / "session.rrd"))]) == 0
    shown = capsys.readouterr().out
    assert "8 against gravity" in shown
    assert "contradict gravity" in shown
    assert "1 sheet was seen" in shown


def test_solve_survives_extreme_values(tmp_path: Path, capsys: Capture) -> None:
    played, T = Played({"table": TRUE["table"]}), frames()[0]
    played.join(1, "p1", "ann")
    played.look(1, "table", ((1e300, -1e300, 1e200), TRUE["table"][1]), T, 1, n=6, noise=0.0)
    played.look(1, "table", TRUE["table"], T, 2, n=6)
    result = solve(capsys, str(played.write(tmp_path / "session.rrd")))
    assert result["participants"][0]["frames"][0]["unused"] == {"not a pose": 6}


def test_recordings_without_headsets_or_with_one_sheet(tmp_path: Path, capsys: Capture) -> None:
    played = Played({"table": TRUE["table"]})
    empty = str(played.write(tmp_path / "empty.rrd"))
    assert main(["anchors", "solve", empty]) == 0
    assert "headset" in capsys.readouterr().out
    assert main(["anchors", "solve", empty, "--out", str(tmp_path / "x.toml")]) == 1
    assert capsys.readouterr().err.endswith(
        "is not written: 0 sheets were seen: 2 are needed to say where they lie to each other\n"
    )
    assert not (tmp_path / "x.toml").exists()


def test_unconnected_sheets_are_named(tmp_path: Path, capsys: Capture) -> None:
    played, (ann, bob) = Played({"table": TRUE["table"]}), frames()
    played.join(1, "p1", "ann")
    played.join(2, "p2", "bob")
    played.look(1, "table", TRUE["table"], ann, 1)
    played.look(2, "door", TRUE["door"], bob, 1)
    result = solve(capsys, str(played.write(tmp_path / "session.rrd")))
    assert result["constellation"]["advice"].startswith("sheets not tied to 'table': door")


def test_solve_reports_unusable_files(tmp_path: Path, recording: Path, capsys: Capture) -> None:
    assert main(["anchors", "solve", str(tmp_path / "none.rrd")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert main(["anchors", "solve", str(recording), "--anchors", str(tmp_path / "none.toml")]) == 2
    assert "`iris-session anchors example`" in capsys.readouterr().err
    assert main(["anchors", "solve", str(recording), "--out", str(tmp_path / "no" / "folder.toml")]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_solutions_of_both_sides_are_weighted_by_their_covariance() -> None:
    """Two solutions of one frame, one ten times more certain; and two that differ by more than their covariance."""
    T = frames()[0]
    sheet = TRUE["table"][0]

    def known(off_m: float, sigma_m: float) -> AlignmentEstimate:
        C = np.diag([sigma_m**2] * 3 + [1e-6] * 3)
        here = shifted(T, (off_m, 0.0, 0.0))
        return AlignmentEstimate(
            here, 0, tuple(C.ravel()), shifted((sheet, T[1]), (off_m, 0, 0))[0], 0.0, 0.0, 9, 2, False, ""
        )

    both = fuse_estimates(known(0.0, 0.001), known(0.01, 0.01))
    assert distance(both.T_world_tracking[0], T[0]) < 0.0005
    assert both.error_at(both.pivot_world) < 0.0028, "no worse than the better one"
    assert both.n_observations == 18
    half = fuse_estimates(known(0.0, 0.002), known(0.004, 0.002))
    assert distance(half.T_world_tracking[0], T[0]) == pytest.approx(0.002, abs=1e-4)
    apart = fuse_estimates(known(0.0, 0.002), known(0.05, 0.002))
    assert apart.error_at_anchor_m > 3.0 * half.error_at_anchor_m


def test_observations_before_and_after_a_jump_are_not_pooled(tmp_path: Path, capsys: Capture) -> None:
    """A headset that misses its jump reports no new epoch: each side of it is a tracking frame of its own."""
    played, (ann, _) = Played(TRUE, {"table": 0.16}), frames()
    jumped = shifted(ann, (0.2, 0.0, 0.0))
    played.join(1, "p1", "ann")
    for viewpoint, name in enumerate(("table", "door", "shelf"), 1):
        played.look(1, name, TRUE[name], ann, viewpoint)
    played.wait(0.5)
    played.event(AlignmentAlarmed("p1", "jump", "", 0.2))
    for viewpoint, name in enumerate(("table", "door"), 4):
        played.look(1, name, TRUE[name], jumped, viewpoint)
    played.aligned("p1", 1, jumped, 0.003)
    result = solve(capsys, str(played.write(tmp_path / "session.rrd")))
    before, after = result["participants"][0]["frames"]
    assert [(one["jumps"], one["looks"]) for one in (before, after)] == [(0, 60), (1, 40)]
    assert (before["outliers"], after["outliers"], result["constellation"]["moved"]) == ([], [], [])
    (alignment,) = after["alignments"]
    assert alignment["off_m"] < 0.01


def test_sheet_contradicted_by_all_others_was_moved(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the live estimator has no majority."""
    original = AlignmentSmoother._solve

    def blind(self: AlignmentSmoother, moment: int, places: dict[str, PoseTuple]) -> AlignmentEstimate:
        return replace(original(self, moment, places), refused="shelf" in places)

    monkeypatch.setattr(AlignmentSmoother, "_solve", blind)
    with Recording.open(recording) as opened:
        history = read_alignment_history(opened)
    resolver = AlignmentSmoother(
        history.observations[TrackingFrame("p1", 1, 0)], AnchorHistory(history, BELIEVED, None), {}
    )
    estimate = resolver.estimate_at(10_000_000_000)
    assert (estimate.refused, estimate.moved) == (False, ("shelf",))
    assert "'shelf'" in estimate.advice
    two = {name: pose for name, pose in BELIEVED.items() if name != "door"}
    assert (
        AlignmentSmoother(history.observations[TrackingFrame("p1", 1, 0)], AnchorHistory(history, two, None), {})
        .estimate_at(10_000_000_000)
        .refused
    )
