"""Summaries: from events made by hand, and of small files, whole, damaged and in parts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from iris_session.journal.messages import DenialRecord
from iris_session.journal.rows import FORMAT
from iris_session.protocol.common import IDENTITY, Alignment, Denial, Lease
from iris_session.protocol.server_messages import (
    AlignmentAlarmed,
    AlignmentChanged,
    EpisodeChanged,
    EStopChanged,
    Event,
    EventBody,
    Gap,
    Handover,
    LeaseChanged,
    LeasesChanged,
    ParticipantChanged,
    ParticipantInfo,
    ParticipantJoined,
    ParticipantLeft,
    PauseChanged,
    SamplesRejected,
    SceneChanged,
)
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.recording import Recording, RecordingSummary, summarise
from iris_session.recording.summary import SummaryBuilder
from iris_session.recording.writer import RrdWriter
from iris_session.rrd.batches import RowTimes
from iris_session.rrd.paths import part_path
from tests.recording.support import TICK_NS, journal
from tests.recording.test_media import message

S = 1_000_000_000
ANN = ParticipantInfo("p1", "ann", "operator", True, ("head", "hand/left"))
BOB = ParticipantInfo("p2", "bob", "operator", True, ("controller/right",))


def lease(target: str, holder: str, version: int = 1, **fields: object) -> Lease:
    return Lease(target, "robot", "exclusive", holder, version, **fields)  # type: ignore[arg-type]


def build(history: Sequence[tuple[float, EventBody]], end_s: float = 10.0, resumed: bool = False) -> SummaryBuilder:
    """Add events at these times [s], and a step at the end."""
    builder = SummaryBuilder(resumed=resumed)
    for seq, (at_s, body) in enumerate(history, 1):
        builder.add(Event(seq, seq, round(at_s * S), body))  # type: ignore[arg-type]
    builder.add(RowTimes(np.array([0, 1]), np.array([0, round(end_s * S)])))
    return builder


def test_people_have_their_time_and_the_robots_that_they_held() -> None:
    builder = build(
        [
            (1.0, ParticipantJoined(ANN)),
            (2.0, ParticipantJoined(BOB)),
            (2.0, LeasesChanged((lease("left", "p1"), lease("right", "p1")), "assigned", ("", ""))),
            (3.0, LeaseChanged(lease("right", "p2", 2), "takeover", "p1")),
            (4.0, ParticipantLeft("p1", "lost", grace=True)),
            (4.0, LeaseChanged(lease("left", "p1", expires_ns=5), "left", "p1")),
            (6.0, ParticipantJoined(ANN, resumed=True)),
            (6.0, LeaseChanged(lease("left", "p1", 3), "resumed")),
            (6.5, LeaseChanged(lease("left", "", 4), "released", "p1")),
            (6.5, LeaseChanged(msgspec.structs.replace(lease("hammer", "p1"), kind="object"), "acquired")),
            (7.0, ParticipantLeft("p1", "bye")),
            (8.0, ParticipantChanged(msgspec.structs.replace(BOB, name="bobby"))),
        ]
    )
    ann, bob = builder.list_people()
    assert (ann.name, ann.role, ann.joins, ann.present_s, ann.stayed) == ("ann", "operator", 2, 4.0, False)
    assert ann.devices == ("head", "hand/left")
    assert ann.held_s == {"left": 4.5, "right": 1.0}, "a lease is held while its holder is disconnected"
    assert (bob.name, bob.present_s, bob.stayed, bob.held_s) == ("bobby", 8.0, True, {"right": 7.0})


def test_who_stands_by_holds_nothing_and_who_shares_does() -> None:
    def shared(version: int, weights: tuple[float, ...]) -> LeaseChanged:
        return LeaseChanged(lease("left", "p2", version, sub_holders=("p1", "p2"), weights=weights), "priority")

    joined = [(0.0, ParticipantJoined(one)) for one in (ANN, BOB)]
    ann, bob = build([*joined, (1.0, shared(1, (0.0, 1.0))), (4.0, shared(2, (0.5, 0.5)))]).list_people()
    assert (ann.held_s, bob.held_s) == ({"left": 6.0}, {"left": 9.0})


def test_a_person_who_joins_anew_is_one_person() -> None:
    again = msgspec.structs.replace(ANN, id="p7", devices=("head",))
    director = msgspec.structs.replace(ANN, id="p8", role="director")
    people = build(
        [
            (0.0, ParticipantJoined(ANN)),
            (1.0, SamplesRejected("p1", "head", "stale", 3)),
            (2.0, ParticipantLeft("p1", "bye")),
            (5.0, ParticipantJoined(again)),
            (5.5, SamplesRejected("p7", "head", "stale", 1)),
            (6.0, SamplesRejected("p7", "head", "stale", 2)),
            (7.0, ParticipantJoined(director)),
        ]
    ).list_people()
    assert [(one.ids, one.joins, one.present_s) for one in people] == [(("p1", "p7"), 2, 7.0), (("p8",), 1, 3.0)]
    assert people[0].rejected == {"stale": 5}, "counts grow while a participant is there"


def test_alignment_has_the_newest_and_the_worst_stated_error() -> None:
    def aligned(version: int, at_robot_m: float) -> AlignmentChanged:
        stated = Alignment(version, "measured", IDENTITY, error_at_anchor_m=0.003, error_at_robot_m=at_robot_m)
        return AlignmentChanged("p1", stated)

    alarm = AlignmentAlarmed("p1", "jump", "table", 0.05)
    (ann,) = build(
        [(0.0, ParticipantJoined(ANN)), (1.0, aligned(1, 0.02)), (2.0, alarm), (3.0, aligned(2, math.nan))]
    ).list_people()
    one = ann.alignment
    assert (one.kind, one.error_at_anchor_m, one.changes, one.alarms) == ("measured", 0.003, 2, {"jump": 1})
    assert (one.error_at_robot_m, one.worst_error_at_robot_m) == (0.0, 0.02), "JSON has no NaN"


def test_history_names_people_and_lasts_as_long_as_it_did() -> None:
    builder = build(
        [
            (0.0, ParticipantJoined(ANN)),
            (1.0, EpisodeChanged(1, "running", "pour", "p1")),
            (3.0, Handover("hammer", "left", "right", "p1", "p9", S // 2)),
            (4.0, EpisodeChanged(1, "success", "pour", "p1")),
            (4.0, EpisodeChanged(2, "running", "", "p1")),
            (5.0, EStopChanged(True, "", "hand in the way", 1)),
            (5.5, EStopChanged(True, "p1", "", 2)),
            (5.6, EStopChanged(True, "", "from a terminal", 2)),
            (5.7, EStopChanged(True, "p1", "from a terminal", 2)),
            (6.0, EStopChanged(False, "p1", "", 2)),
            (7.0, EStopChanged(True, "p1", "", 3)),
            (7.0, PauseChanged(True, "p1")),
            (8.0, PauseChanged(False, "p1")),
            (9.0, SceneChanged(2, 0, "reset")),
            (9.0, SamplesRejected("", "head", "quota", 4)),
            (9.5, Gap("stalled", S)),
            (9.6, Gap("recording", 0, 12)),
        ]
    )
    first, second = builder.list_episodes()
    assert (first.verdict, first.label, first.at_s, first.duration_s, first.by) == ("success", "pour", 1.0, 3.0, "ann")
    assert (second.verdict, second.duration_s) == ("running", 6.0)
    (handover,) = builder.handovers
    assert (handover.giver_name, handover.receiver_name, handover.both_held_s) == ("ann", "p9", 0.5)
    stops = builder.list_stops(builder.stops)
    assert [(one.by, one.duration_s, one.ended) for one in stops] == [
        ("", 1.0, True),
        ("ann", 0.5, True),
        ("ann", 0.4, True),
        ("ann", 3.0, False),
    ]
    assert [one.duration_s for one in builder.list_stops(builder.pauses)] == [1.0]
    assert [(one.cause, one.at_s) for one in builder.scene_changes] == [("reset", 9.0)]
    drops = builder.make_drops()
    assert (drops.rejected_samples, drops.lost_steps, drops.stalls, drops.stalled_s) == ({"quota": 4}, 12, 1, 1.0)


def test_missing_steps_and_events_are_named_with_their_times() -> None:
    builder = SummaryBuilder()
    builder.add(RowTimes(np.array([2, 3, 7]), np.array([2, 3, 7]) * S))
    builder.add(RowTimes(np.array([6, 7, 8]), np.array([6, 7, 8]) * S))  # the next part repeats two
    builder.add(RowTimes(np.array([10]), np.array([10]) * S))
    for seq in (1, 2, 6):
        builder.add(Event(seq, seq, seq * S, ParticipantJoined(ANN)))
    assert builder.list_gaps() == [
        "steps 0 to 1 are missing (2), before 2 s",
        "steps 4 to 6 are missing (3), from 3 s to 7 s",
        "step 9 is missing, from 8 s to 10 s",
        "events 3 to 5 are missing (3), from 2 s to 6 s",
    ]
    assert builder.steps == 5


def test_a_resumed_session_misses_nothing_before_it() -> None:
    builder = SummaryBuilder(41, resumed=True)
    builder.add(RowTimes(np.array([42, 43]), np.array([80, 81]) * S))
    builder.add(Event(17, 0, 80 * S, ParticipantLeft("p1", "session_resumed", grace=True)))
    builder.add(Event(18, 0, 80 * S, Gap("resumed", 30 * S)))
    assert builder.list_gaps() == []
    assert [(one.name, one.role, one.joins) for one in builder.list_people()] == [("p1", "", 0)]
    assert builder.make_drops().down_s == 30.0


# --- files ---


def write_session(path: Path, *, first: int = 0, last: int = 200) -> Path:
    """Write steps `first` to `last` of a session of 200 steps of 2 ms, with people, a denial, and pictures."""
    header, batch = journal(200)
    robots = tuple(RobotSpec(name, (), (), "", "") for name in ("left", "right"))
    created = "2026-11-25T16:28:51.270+00:00"
    header = msgspec.structs.replace(
        header, robots=robots, objects=(ObjectSpec("hammer", "hammer"),), created_utc=created
    )
    writer = RrdWriter(path, "id")
    writer.write_header(header)
    history: list[tuple[int, EventBody]] = [
        (0, ParticipantJoined(ANN)),
        (20, LeaseChanged(lease("left", "p1"), "acquired")),
        (120, Handover("hammer", "left", "right", "p1", "p1", 30 * TICK_NS)),
    ]
    for begin in range(first, last, 20):
        part = range(begin, begin + 20)
        batch_of_part = msgspec.structs.replace(batch, rows=batch.rows[begin : begin + 20])
        batch_of_part.keyframes = [one for one in batch.keyframes if one.step in part]
        batch_of_part.events = [
            Event(seq, step, (step + 1) * TICK_NS, body)  # type: ignore[arg-type]
            for seq, (step, body) in enumerate(history, 1)
            if step in part
        ]
        denied = DenialRecord(begin, (begin + 1) * TICK_NS, 7, Denial("held", "bob has it"))
        batch_of_part.denials = [denied] if begin in (40, 120) else []
        writer.add(batch_of_part)
        writer.add_media(message("wrist", b"\xff\xd8\xff\xc0\x00\x11\x08\x00\x02\x00\x03", begin, begin * S, "jpeg"))
        writer.flush()
    writer.close()
    return path


def read(path: Path) -> RecordingSummary:
    with Recording.open(path, warn=False) as recording:
        return summarise(recording)


def test_a_small_recording_is_summarised(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    with Recording.open(write_session(tmp_path / "session.rrd")) as recording:
        summary = summarise(recording, lambda done, total: seen.append((done, total)))
    assert (summary.ok, summary.finished, summary.ending, summary.damage) == (True, True, "", ())
    assert (summary.steps, summary.begin_s, summary.duration_s) == (200, 0.002, 0.398)
    assert (summary.robots, summary.objects, summary.bodies) == (("left", "right"), ("hammer",), 4)
    assert (summary.format, summary.recording_class, summary.files) == (FORMAT, "closed", ("session.rrd",))
    assert summary.bytes == (tmp_path / "session.rrd").stat().st_size
    (ann,) = summary.people
    assert (ann.present_s, ann.held_s) == (0.398, {"left": 0.358})
    assert [(one.object, one.both_held_s) for one in summary.handovers] == [("hammer", 0.06)]
    assert summary.drops.denials == {"held": 2}
    assert [(one.name, one.encoding, one.frames, one.hz) for one in summary.streams] == [("wrist", "jpeg", 10, 0.05)]
    assert seen[-1] == (200, 200)


def test_parts_are_summarised_once(tmp_path: Path) -> None:
    first = write_session(tmp_path / "session.rrd", last=140)
    write_session(Path(part_path(str(first), 2)), first=100)
    summary = read(first)
    assert (summary.ok, summary.finished, summary.files) == (True, True, ("session.rrd", "session.part2.rrd"))
    assert (summary.steps, summary.drops.denials, len(summary.handovers)) == (200, {"held": 2}, 1)
    assert summary.streams[0].frames == 10
