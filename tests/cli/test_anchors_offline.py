"""`iris-session anchors solve` on small recordings: alignments, outliers and sheets that were moved are found again."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anchors.alignment import AlignmentEstimate
from anchors.constellation import Constellation
from anchors.pose import PoseTuple, compose, distance, inverse, quat_from_rotvec
from iris_session.alignment.smoother import Anchors, Resolver, fused
from iris_session.cli.main import main
from iris_session.protocol.common import IDENTITY, Alignment, Pose
from iris_session.protocol.server_messages import AlignmentAlarmed, AnchorMoved
from iris_session.recording import Frame, Recording, read_looks
from iris_session.session.anchors_file import load_anchors
from tests.anchors.worlds import headset, shifted
from tests.recording.headsets import Played

Capture = pytest.CaptureFixture[str]
TRUE: dict[str, PoseTuple] = {
    "table": ((0.0, -0.45, 0.0), (1.0, 0.0, 0.0, 0.0)),
    "door": ((1.2, 0.1, 0.3), (0.7071067811865476, 0.0, 0.0, 0.7071067811865476)),
    "shelf": ((-0.4, 0.9, 0.5), (1.0, 0.0, 0.0, 0.0)),
}
#: The session believes that the shelf's sheet still is where it was.
BELIEVED = {**TRUE, "shelf": shifted(TRUE["shelf"], (0.03, 0.0, 0.0))}


def frames() -> tuple[PoseTuple, PoseTuple]:
    rng = np.random.default_rng(7)
    return headset(rng), headset(rng)


def play() -> Played:
    """Ann and bob look at three sheets; ann's second alignment is 25 mm off, stated as 3 mm. Carl sees nothing."""
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


def solved(capsys: Capture, *words: str) -> dict[str, Any]:
    assert main(["anchors", "solve", *words, "--json"]) == 0
    told: dict[str, Any] = json.loads(capsys.readouterr().out)
    return told


def test_alignments_are_solved_again_and_compared(recording: Path, capsys: Capture) -> None:
    told = solved(capsys, str(recording))
    ann, bob, carl = told["participants"]
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


def test_looks_at_a_moved_sheet_are_outliers(recording: Path, capsys: Capture) -> None:
    told = solved(capsys, str(recording))
    for person in told["participants"][:2]:
        (outlier,) = person["frames"][0]["outliers"]
        assert outlier["anchor_id"] == "shelf"
        assert outlier["off_m"] == pytest.approx(0.03, abs=0.01)


def test_where_the_anchors_really_were_can_be_given(recording: Path, tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "true.toml"
    path.write_text(Constellation("table", TRUE, {}, {"table": 0.16}).to_toml())
    told = solved(capsys, str(recording), "--anchors", str(path))
    assert [one["frames"][0]["outliers"] for one in told["participants"][:2]] == [[], []]
    assert told["constellation"]["moved"] == []


def test_sheets_to_each_other_and_which_one_was_moved(recording: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "anchors.toml"
    told = solved(capsys, str(recording), "--out", str(out))
    (moved,) = told["constellation"]["moved"]
    assert moved["anchor_id"] == "shelf"
    assert moved["distance_m"] == pytest.approx(0.03, abs=0.008)
    found = load_anchors(out)
    assert found.anchors["table"] == TRUE["table"], "the reference stays where it is"
    for name in TRUE:
        seen, true = (compose(inverse(c["table"]), c[name]) for c in (found.anchors, TRUE))
        assert distance(seen[0], true[0]) <= 2.0 * found.error_m[name] < 0.04, name
    assert found.sizes == dict.fromkeys(TRUE, 0.16)


def test_the_text_says_it_too(recording: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "anchors.toml"
    assert main(["anchors", "solve", str(recording), "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    lines = shown.splitlines()
    assert all(line.isprintable() for line in lines)
    assert any("120 looks from 6 places" in line and "table 60" in line for line in lines)
    (beyond,) = [line for line in lines if "BEYOND WHAT WAS STATED" in line]
    assert beyond.lstrip().startswith("version 2 (measured), 10.0 s to the end: 2")
    assert "stated 3.0 mm" in beyond
    assert "carl (p3): no observations" in lines
    assert sum("outlier: 'shelf'" in line for line in lines) == 2
    assert any(line.startswith("MOVED: sheet 'shelf' lies ") for line in lines)
    assert "desk" not in shown
    assert lines[-1].endswith(f"iris-session serve SCENE --anchors {out}")


def test_an_anchor_that_a_director_moved_is_where_it_was_at_the_time(tmp_path: Path) -> None:
    """The same looks before and after: the alignment follows the anchor."""
    played, T = Played({"table": TRUE["table"]}), frames()[0]
    played.join(1, "p1", "ann")
    for viewpoint in (1, 2):
        played.look(1, "table", TRUE["table"], T, viewpoint)
    played.wait(20.0)
    played.event(AnchorMoved("table", Pose(*shifted(TRUE["table"], (0.5, 0.0, 0.0)))))
    moved_ns = played.now_ns
    played.wait(20.0)
    with Recording.open(played.write(tmp_path / "session.rrd")) as recording:
        looks = read_looks(recording)
    resolver = Resolver(looks.looks[Frame("p1", 1, 0)], Anchors(looks, {"table": TRUE["table"]}, None), {})
    before, after = resolver.at(moved_ns - 1), resolver.at(moved_ns)
    x, y, z = before.T_world_tracking[0]
    assert distance(after.T_world_tracking[0], (x + 0.5, y, z)) < 1e-6


def test_what_came_later_counts_too(tmp_path: Path) -> None:
    """Live, there were two looks, which is too few; a minute later there were more."""
    played, T = Played({"table": TRUE["table"]}), frames()[0]
    played.join(1, "p1", "ann")
    played.look(1, "table", TRUE["table"], T, 1, n=2)
    early_ns = played.now_ns
    played.wait(60.0)
    played.look(1, "table", TRUE["table"], T, 2)
    with Recording.open(played.write(tmp_path / "session.rrd")) as recording:
        looks = read_looks(recording)
    solution = Resolver(looks.looks[Frame("p1", 1, 0)], Anchors(looks, {"table": TRUE["table"]}, None), {}).at(early_ns)
    assert (solution.refused, solution.n_observations) == (False, 20)


def test_unusable_observations_are_counted(tmp_path: Path, capsys: Capture) -> None:
    played, T = Played({"table": TRUE["table"]}, {"table": 0.12}), frames()[0]
    played.join(1, "p1", "ann")
    played.look(1, "table", TRUE["table"], T, 1, n=6)
    played.look(1, "door", TRUE["door"], T, 2, n=5)
    told = solved(capsys, str(played.write(tmp_path / "session.rrd")))
    (frame,) = told["participants"][0]["frames"]
    assert frame["refused"]
    assert "measures 160 mm, not 120 mm" in frame["advice"]
    assert frame["unused"] == {"unknown anchor": 5, "wrong size": 6}


def test_a_sheet_on_the_wall_is_told_to_be_none_that_lies(tmp_path: Path, capsys: Capture) -> None:
    played, T = Played({"table": TRUE["table"]}), frames()[0]
    upright: PoseTuple = (TRUE["table"][0], quat_from_rotvec((math.pi / 2.0, 0.0, 0.0)))
    played.join(1, "p1", "ann")
    played.look(1, "table", upright, T, 1, n=8)
    assert main(["anchors", "solve", str(played.write(tmp_path / "session.rrd"))]) == 0
    shown = capsys.readouterr().out
    assert "8 against gravity" in shown
    assert "most looks contradict the vertical: the sheet does not lie as configured" in shown
    assert "1 sheet was seen" in shown


def test_numbers_of_strangers_end_nothing(tmp_path: Path, capsys: Capture) -> None:
    played, T = Played({"table": TRUE["table"]}), frames()[0]
    played.join(1, "p1", "ann")
    played.look(1, "table", ((1e300, -1e300, 1e200), TRUE["table"][1]), T, 1, n=6, noise=0.0)
    played.look(1, "table", TRUE["table"], T, 2, n=6)
    told = solved(capsys, str(played.write(tmp_path / "session.rrd")))
    assert told["participants"][0]["frames"][0]["unused"] == {"not a pose": 6}


def test_recordings_without_headsets_or_with_one_sheet(tmp_path: Path, capsys: Capture) -> None:
    played = Played({"table": TRUE["table"]})
    empty = str(played.write(tmp_path / "empty.rrd"))
    assert main(["anchors", "solve", empty]) == 0
    assert "nobody in this recording had a headset" in capsys.readouterr().out
    assert main(["anchors", "solve", empty, "--out", str(tmp_path / "x.toml")]) == 1
    assert capsys.readouterr().err.endswith(
        "is not written: 0 sheets were seen: 2 are needed to say where they lie to each other\n"
    )
    assert not (tmp_path / "x.toml").exists()


def test_sheets_that_nothing_ties_together_are_named(tmp_path: Path, capsys: Capture) -> None:
    played, (ann, bob) = Played({"table": TRUE["table"]}), frames()
    played.join(1, "p1", "ann")
    played.join(2, "p2", "bob")
    played.look(1, "table", TRUE["table"], ann, 1)
    played.look(2, "door", TRUE["door"], bob, 1)
    told = solved(capsys, str(played.write(tmp_path / "session.rrd")))
    assert told["constellation"]["advice"].startswith("sheets not tied to 'table': door")


def test_files_that_are_none(tmp_path: Path, recording: Path, capsys: Capture) -> None:
    assert main(["anchors", "solve", str(tmp_path / "none.rrd")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert main(["anchors", "solve", str(recording), "--anchors", str(tmp_path / "none.toml")]) == 2
    assert "`iris-session anchors example`" in capsys.readouterr().err
    assert main(["anchors", "solve", str(recording), "--out", str(tmp_path / "no" / "folder.toml")]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_both_sides_of_a_moment_are_weighted_by_what_they_know() -> None:
    """Two solutions of one frame, one known ten times better; and two that differ by more than they state."""
    T = frames()[0]
    sheet = TRUE["table"][0]

    def known(off_m: float, sigma_m: float) -> AlignmentEstimate:
        C = np.diag([sigma_m**2] * 3 + [1e-6] * 3)
        here = shifted(T, (off_m, 0.0, 0.0))
        return AlignmentEstimate(
            here, 0, tuple(C.ravel()), shifted((sheet, T[1]), (off_m, 0, 0))[0], 0.0, 0.0, 9, 2, False, ""
        )

    both = fused(known(0.0, 0.001), known(0.01, 0.01))
    assert distance(both.T_world_tracking[0], T[0]) < 0.0005
    assert both.error_at(both.pivot_world) < 0.0028, "no worse than the better one"
    assert both.n_observations == 18
    half = fused(known(0.0, 0.002), known(0.004, 0.002))
    assert distance(half.T_world_tracking[0], T[0]) == pytest.approx(0.002, abs=1e-4)
    apart = fused(known(0.0, 0.002), known(0.05, 0.002))
    assert apart.error_at_anchor_m > 3.0 * half.error_at_anchor_m


def test_sheets_seen_before_and_after_a_jump_are_not_pooled(tmp_path: Path, capsys: Capture) -> None:
    """A headset that does not notice its jump tells no new epoch: each side of it is a tracking frame of its own."""
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
    told = solved(capsys, str(played.write(tmp_path / "session.rrd")))
    before, after = told["participants"][0]["frames"]
    assert [(one["jumps"], one["looks"]) for one in (before, after)] == [(0, 60), (1, 40)]
    assert (before["outliers"], after["outliers"], told["constellation"]["moved"]) == ([], [], [])
    (alignment,) = after["alignments"]
    assert alignment["off_m"] < 0.01


def test_where_all_but_one_sheet_agree_that_one_was_moved(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the live estimator sees no majority."""
    solve = Resolver._solve

    def blind(self: Resolver, moment: int, places: dict[str, PoseTuple]) -> AlignmentEstimate:
        return replace(solve(self, moment, places), refused="shelf" in places)

    monkeypatch.setattr(Resolver, "_solve", blind)
    with Recording.open(recording) as opened:
        looks = read_looks(opened)
    resolver = Resolver(looks.looks[Frame("p1", 1, 0)], Anchors(looks, BELIEVED, None), {})
    solved = resolver.at(10_000_000_000)
    assert (solved.refused, solved.moved) == (False, ("shelf",))
    assert "sheet 'shelf'; it is not used" in solved.advice
    two = {name: pose for name, pose in BELIEVED.items() if name != "door"}
    assert Resolver(looks.looks[Frame("p1", 1, 0)], Anchors(looks, two, None), {}).at(10_000_000_000).refused
