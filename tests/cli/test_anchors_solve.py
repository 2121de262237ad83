"""`iris-session anchors solve`: alignments solved again, sheets that were moved, and what cannot be used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from anchors.alignment import AlignmentEstimate
from anchors.constellation import Constellation
from anchors.pose import PoseTuple, compose, distance, inverse
from iris_session.alignment.smoother import AlignmentSmoother, AnchorHistory, fuse_estimates
from iris_session.protocol.common import IDENTITY, Alignment, Pose
from iris_session.protocol.server_messages import AnchorMoved
from iris_session.recording import Recording, TrackingFrame, read_alignment_history
from iris_session.session.config import load_anchors
from tests.anchors.worlds import shifted, tracking_frame
from tests.cli.conftest import CommandLine
from tests.recording.headsets import Played

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


def test_alignments_are_solved_again_and_compared(recording: Path, cli: CommandLine) -> None:
    result = cli.json("anchors", "solve", recording)
    ann, bob, carl = result["participants"]
    for person in (ann, bob):
        (outlier,) = person["frames"][0]["outliers"]
        assert outlier["anchor_id"] == "shelf", "it was moved"
        assert outlier["off_m"] == pytest.approx(0.03, abs=0.01)
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


def test_true_anchor_poses_can_be_given(recording: Path, tmp_path: Path, cli: CommandLine) -> None:
    path = tmp_path / "true.toml"
    path.write_text(Constellation("table", TRUE, {}, {"table": 0.16}).to_toml())
    result = cli.json("anchors", "solve", recording, "--anchors", path)
    assert [one["frames"][0]["outliers"] for one in result["participants"][:2]] == [[], []]
    assert result["constellation"]["moved"] == []


def test_relative_sheet_poses_and_moved_sheet(recording: Path, tmp_path: Path, cli: CommandLine) -> None:
    out = tmp_path / "anchors.toml"
    result = cli.json("anchors", "solve", recording, "--out", out)
    (moved,) = result["constellation"]["moved"]
    assert moved["anchor_id"] == "shelf"
    assert moved["distance_m"] == pytest.approx(0.03, abs=0.008)
    found = load_anchors(out)
    assert found.anchors["table"] == TRUE["table"], "the reference stays where it is"
    for name in TRUE:
        seen, true = (compose(inverse(c["table"]), c[name]) for c in (found.anchors, TRUE))
        assert distance(seen[0], true[0]) <= 2.0 * found.error_m[name] < 0.04, name
    assert found.sizes == dict.fromkeys(TRUE, 0.16)


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


def test_unusable_observations_are_counted(tmp_path: Path, cli: CommandLine) -> None:
    played, T = Played({"table": TRUE["table"]}, {"table": 0.12}), frames()[0]
    played.join(1, "p1", "ann")
    played.look(1, "table", TRUE["table"], T, 1, n=6)
    played.look(1, "door", TRUE["door"], T, 2, n=5)
    result = cli.json("anchors", "solve", str(played.write(tmp_path / "session.rrd")))
    (frame,) = result["participants"][0]["frames"]
    assert frame["refused"]
    assert "160 mm, not 120 mm" in frame["advice"]
    assert frame["unused"] == {"unknown anchor": 5, "wrong size": 6}


def test_recordings_without_headsets_or_with_one_sheet(tmp_path: Path, cli: CommandLine) -> None:
    played = Played({"table": TRUE["table"]})
    empty = str(played.write(tmp_path / "empty.rrd"))
    assert "headset" in cli.run("anchors", "solve", empty)
    assert cli.refuse("anchors", "solve", empty, "--out", tmp_path / "x.toml", status=1).endswith(
        "is not written: 0 sheets were seen: 2 are needed to say where they lie to each other\n"
    )
    assert not (tmp_path / "x.toml").exists()


def test_solve_reports_unusable_files(tmp_path: Path, recording: Path, cli: CommandLine) -> None:
    assert cli.refuse("anchors", "solve", tmp_path / "none.rrd").count("\n") == 1
    assert "`iris-session anchors example`" in cli.refuse(
        "anchors", "solve", str(recording), "--anchors", str(tmp_path / "none.toml")
    )
    assert "cannot be written" in cli.refuse(
        "anchors", "solve", str(recording), "--out", str(tmp_path / "no" / "folder.toml")
    )


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
