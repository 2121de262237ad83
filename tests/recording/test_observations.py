"""Observations read back: participant, tracking frame, head pose, and alignment in force."""

from __future__ import annotations

from pathlib import Path

import pytest

from anchors.pose import PoseTuple, distance
from iris_session.protocol.common import IDENTITY, Alignment
from iris_session.protocol.server_messages import AlignmentAlarmed, ParticipantChanged, ParticipantInfo, ParticipantLeft
from iris_session.recording import AlignmentHistory, Recording, TrackingFrame, read_alignment_history
from tests.recording.headsets import Played, S

TABLE: PoseTuple = ((0.0, -0.45, 0.0), (1.0, 0.0, 0.0, 0.0))
HERE: PoseTuple = ((0.3, 0.2, 0.0), (1.0, 0.0, 0.0, 0.0))
NOT_NEEDED = Alignment(0, "not_needed", IDENTITY)


@pytest.fixture
def played() -> Played:
    return Played({"table": TABLE})


def read(played: Played, folder: Path) -> AlignmentHistory:
    with Recording.open(played.write(folder / "session.rrd")) as recording:
        return read_alignment_history(recording)


def test_observations_are_assigned_to_their_participants(played: Played, tmp_path: Path) -> None:
    """Several participants join in one step, one is refused, two have one name."""
    played.join(1, "", "eve", refused=True)
    played.join(2, "p1", "ann")
    played.join(3, "p2", "ann")
    played.join(4, "p3", "desk", role="agent", alignment=NOT_NEEDED)
    played.wait(1.0)
    played.look(3, "table", TABLE, HERE, 1, n=4)
    played.look(2, "table", TABLE, HERE, 2, n=3)
    played.look(9, "table", TABLE, HERE, 3, n=2)
    found = read(played, tmp_path)
    assert {frame: len(looks) for frame, looks in found.observations.items()} == {
        TrackingFrame("p1", 1, 0): 3,
        TrackingFrame("p2", 1, 0): 4,
    }
    assert found.unowned == 2, "nobody joined by that connection"
    assert {id: one.aligned for id, one in found.participants.items()} == {"p1": True, "p2": True, "p3": False}


def test_every_run_and_epoch_is_a_tracking_frame(played: Played, tmp_path: Path) -> None:
    played.join(1, "p1", "ann", run="run:a")
    played.look(1, "table", TABLE, HERE, 1, n=2)
    played.look(1, "table", TABLE, HERE, 2, n=3, epoch=1)
    played.join(2, "p1", "ann", run="run:a")  # the connection broke, the tracking went on
    played.look(2, "table", TABLE, HERE, 3, n=4, epoch=1)
    played.join(3, "p1", "ann", run="run:b")  # the app was started anew
    played.look(3, "table", TABLE, HERE, 4, n=5)
    found = read(played, tmp_path)
    assert {frame: len(looks) for frame, looks in found.observations.items()} == {
        TrackingFrame("p1", 1, 0): 2,
        TrackingFrame("p1", 1, 1): 7,
        TrackingFrame("p1", 2, 0): 5,
    }


def test_jump_begins_a_tracking_frame(played: Played, tmp_path: Path) -> None:
    """From its capture on, although the session is notified later, and only in that run of that participant."""
    played.join(1, "p1", "ann", run="run:a")
    played.join(2, "p2", "bob")
    played.look(1, "table", TABLE, HERE, 1, n=2)
    played.wait(0.05)
    before_ns = played.now_ns
    played.jumped(1, "p1", late_s=0.3)
    heard_ns, played.now_ns = played.now_ns, before_ns - 2 * S + 100_000_000
    played.look(1, "table", TABLE, HERE, 2, n=1)  # 0.1 s after the jump, 0.2 s before it is heard of
    played.look(2, "table", TABLE, HERE, 1, n=4)
    played.now_ns = max(played.now_ns, heard_ns)
    played.aligned("p1", 1, HERE, 0.004)
    played.join(3, "p1", "ann", run="run:b")
    played.look(3, "table", TABLE, HERE, 3, n=3)
    found = read(played, tmp_path)
    assert {frame: len(looks) for frame, looks in found.observations.items()} == {
        TrackingFrame("p1", 1, 0): 2,
        TrackingFrame("p1", 1, 0, 1): 1,
        TrackingFrame("p1", 2, 0): 3,
        TrackingFrame("p2", 1, 0): 4,
    }
    assert all(look.p_tracking_head is not None for look in found.observations[TrackingFrame("p1", 1, 0, 1)])
    assert [one.frame for one in found.in_force] == [TrackingFrame("p1", 1, 0, 1)]


@pytest.mark.parametrize(("late_ns", "known"), [(5_000_000, True), (-50_000_000, True), (50_000_001, False)])
def test_observation_has_the_nearest_head_pose(played: Played, tmp_path: Path, late_ns: int, known: bool) -> None:
    played.join(1, "p1", "ann")
    played.look(1, "table", TABLE, HERE, 1, n=1, head_late_ns=late_ns)
    played.sample(1, (9.0, 9.0, 9.0), played.now_ns + 2 * abs(late_ns))
    (look,) = read(played, tmp_path).observations[TrackingFrame("p1", 1, 0)]
    assert (look.p_tracking_head is not None) == known
    if look.p_tracking_head is not None:
        assert distance(look.p_tracking_head, look.observation.T_tracking_anchor.p) < 0.7


def test_alignments_hold_until_something_ends_them(played: Played, tmp_path: Path) -> None:
    played.join(1, "p1", "ann")
    played.aligned("p1", 1, HERE, 0.004)
    played.wait(1.0)
    played.aligned("p1", 2, HERE, 0.004)
    played.wait(1.0)
    played.event(AlignmentAlarmed("p1", "differs", "table", 0.02))  # says something, ends nothing
    played.wait(1.0)
    played.event(AlignmentAlarmed("p1", "jump", "", 0.2))
    played.wait(1.0)
    played.aligned("p1", 3, HERE, 0.004)
    played.wait(1.0)
    played.event(ParticipantChanged(ParticipantInfo("p1", "ann", "operator", True, tracking_epoch=1)))
    played.aligned("p1", 4, HERE, 0.004, epoch=1)
    played.wait(1.0)
    played.event(ParticipantLeft("p1", "silent", grace=True))
    played.wait(1.0)
    played.event(ParticipantLeft("p1", "expired"))
    played.join(2, "p2", "bob")
    played.aligned("p2", 1, HERE, 0.004)
    found = read(played, tmp_path).in_force
    assert [(one.alignment.version, one.since_ns // S, one.until_ns // S) for one in found] == [
        (1, 0, 1),
        (2, 1, 3),
        (3, 4, 5),
        (4, 5, 7),
        (1, 7, -1),
    ]
    assert found[3].frame == TrackingFrame("p1", 1, 1, 1), "jumps are counted through a run, whatever epochs it tells"


def test_undecodable_messages_are_counted(played: Played, tmp_path: Path) -> None:
    played.join(1, "p1", "ann")
    played.raw(1, b"\xc1")
    played.raw(1, b"\x81\xa4type\xa3bye")
    played.look(1, "table", TABLE, HERE, 1, n=2)
    found = read(played, tmp_path)
    assert (found.unreadable, len(found.observations[TrackingFrame("p1", 1, 0)])) == (2, 2)
