"""Text lines, and properties that a re-simulation must share with the recording."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import msgspec

from iris_session.protocol.common import Alignment, Lease, Pose
from iris_session.protocol.names import AuditKind
from iris_session.protocol.server_messages import (
    AlignmentAlarmed,
    AlignmentChanged,
    AlignmentRun,
    AnchorMoved,
    Audited,
    ConsentRequested,
    EngagementChanged,
    EpisodeChanged,
    EStopChanged,
    Event,
    EventKind,
    Gap,
    Handover,
    HeadsetsCompared,
    Intervention,
    LeaseChanged,
    LeasesChanged,
    MarkerAdded,
    Notice,
    ObjectGrasped,
    ParticipantChanged,
    ParticipantInfo,
    ParticipantJoined,
    ParticipantLeft,
    PauseChanged,
    SamplesRejected,
    ScaleChanged,
    SceneChanged,
    TipCalibrated,
)
from iris_session.viewer.narration import PALETTE, EventNarration, LogLine

POSE = Pose((0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0))


def lease(target: str, holder: str, previous: str = "", cause: str = "acquired") -> LeaseChanged:
    return LeaseChanged(Lease(target, "robot", "exclusive", holder, 4), cause, previous)


def ann_and_bob() -> EventNarration:
    narration = EventNarration()
    narration.add_people(
        [ParticipantInfo("p1", "ann", "operator", True), ParticipantInfo("p2", "bob", "operator", True)]
    )
    return narration


def narrate(narration: EventNarration, *bodies: EventKind) -> list[LogLine]:
    return [narration.add(Event(i, i, i, body)).line for i, body in enumerate(bodies)]


def test_lost_rows_are_an_error_and_rejected_samples_are_for_debugging() -> None:
    lines = narrate(ann_and_bob(), Gap("recording", 7, 12), SamplesRejected("p1", "controller/left", "stale", 3))
    assert [line.level for line in lines] == ["ERROR", "DEBUG"]


def test_security_events_are_sentences_and_the_return_to_another_session_is_for_debugging() -> None:
    bodies = [Audited(kind, "1f2e", "ann", "10.0.0.9", "operator", 2) for kind in get_values(AuditKind)]
    lines = dict(zip(get_values(AuditKind), narrate(ann_and_bob(), *bodies), strict=True))
    assert all(line.text.endswith(": ann, 10.0.0.9, operator, 2 times") for line in lines.values())
    assert not [line.text for line in lines.values() if "=" in line.text or "_" in line.text or "1f2e" in line.text]
    assert {kind for kind, line in lines.items() if line.level == "DEBUG"} == {AuditKind.TOKEN_REFUSED}
    assert lines[AuditKind.FLOOD].level == "WARN"


def get_values(kinds: type) -> list[str]:
    return [value for name, value in vars(kinds).items() if name.isupper()]


def test_checks_of_two_headsets_are_told_when_they_change() -> None:
    narration = ann_and_bob()

    def check(error_m: float, a: str = "p1", b: str = "p2") -> str:
        compared = HeadsetsCompared(a, b, "table", error_m, 0.0, 0.006, (0.0, 0.0, 0.0), 40)
        return narrate(narration, compared)[0].level

    assert [check(0.001), check(0.005), check(0.011, "p2", "p1")] == ["INFO", "DEBUG", "DEBUG"]
    assert [check(0.02), check(0.03), check(0.004)] == ["INFO", "DEBUG", "INFO"]
    narrate(narration, ParticipantLeft("p2", "bye"))
    assert check(0.001) == "INFO", "another participant has the name"


def test_every_kind_of_event_has_a_line_without_ids() -> None:
    ann = ParticipantInfo("p1", "ann", "operator", True)
    every = (
        ParticipantJoined(ann, resumed=True),
        ParticipantChanged(msgspec.structs.replace(ann, worn=False)),
        ParticipantLeft("p1", "timeout", grace=True),
        lease("left", "p1"),
        LeasesChanged((lease("left", "p2").lease,), "queue", ("p2",)),
        ConsentRequested(1, "left", "p2", "p1"),
        Intervention("left", "p1", "p2", True),
        EngagementChanged("left", "p1", True),
        ScaleChanged("left", 0.5, "p1"),
        AlignmentChanged("p1", Alignment(1, "none", POSE)),
        AlignmentRun("p1", True, 1),
        AlignmentAlarmed("p1", "jump", "table", 0.1),
        AnchorMoved("table", POSE, "p1"),
        TipCalibrated("p1", "controller/left", refused=True, advice="turn it"),
        HeadsetsCompared("p1", "p2", "table", 0.001, 0.01, 0.003, (0.0, 0.0, 0.0), 9),
        SceneChanged(1, 1, "new_scene"),
        EStopChanged(False, "p1"),
        PauseChanged(False, "p1"),
        EpisodeChanged(1, "running", "", "p1"),
        ObjectGrasped("cup", "p1", "hand/left", True),
        Handover("cup", "left", "right", "p1", "p2", 1),
        MarkerAdded("p1", "now"),
        SamplesRejected("p1", "head", "seq", 1),
        Gap("stalled", 1),
        Notice("warning", "look", "p1"),
        Audited("flood", name="ann"),
    )
    assert {type(body) for body in every} == set(get_args(EventKind))
    for body, line in zip(every, narrate(ann_and_bob(), *every), strict=True):
        assert line.text, body
        assert not {"p1", "p2"} & set(re.findall(r"\w+", line.text)), line.text


def changes(narration: EventNarration, *bodies: EventKind) -> list[tuple[str, str]]:
    """Return the changed lanes and their new states."""
    found = [change for body in bodies for change in narration.add(Event(1, 1, 1, body)).lanes]
    return [("/".join(change.lane), change.state) for change in found]


def test_states_that_last_are_lanes() -> None:
    narration = ann_and_bob()
    robot = lease("left", "p1")
    assert changes(
        narration,
        robot,
        EngagementChanged("left", "p1", True),
        AlignmentChanged("p1", Alignment(2, "placed", POSE)),
        AlignmentChanged("p1", Alignment(3, "placed", POSE)),
        ObjectGrasped("cup", "p1", "hand/left", True),
        ObjectGrasped("cup", "p1", "hand/left", False),
        Handover("hammer", "left", "right", "p1", "p2", 1),
        EStopChanged(True, "p1"),
        PauseChanged(True, "p1"),
        EpisodeChanged(1, "running"),
        EpisodeChanged(1, "failure"),
        SceneChanged(2, 0, "patch"),
    ) == [
        ("robots/left/holder", "ann"),
        ("robots/left/clutch", "closed"),
        ("alignment/ann", "placed"),
        ("objects/cup", "ann"),
        ("objects/cup", ""),
        ("objects/hammer", "handed to bob"),
        ("e-stop", "stopped"),
        ("pause", "paused"),
        ("episode", "episode 1"),
        ("episode", "failure"),
    ]
    assert changes(narration, SceneChanged(3, 0, "reset")) == [("robots/left/clutch", ""), ("objects/hammer", "")]
    assert changes(narration, ParticipantLeft("p1", "lost", grace=True)) == []
    assert changes(narration, ParticipantLeft("p1", "bye")) == [("alignment/ann", "")]
    assert [(c.lane, c.state) for c in narration.add_hold("left", "no_lease")] == [], "the lane of the holder says so"
    assert [(c.lane, c.state) for c in narration.add_hold("left", "not_worn")] == [
        (("robots", "left", "hold"), "not worn")
    ]


def test_lanes_of_a_later_part_end_what_began_before_it() -> None:
    free = lease("left", "", "p1", "released")
    assert changes(EventNarration(), free) == []
    later = EventNarration(is_first=False)
    later.add_people([ParticipantInfo("p1", "ann", "operator", True)])
    assert changes(later, free) == [("robots/left/holder", "")]
    assert changes(later, ParticipantLeft("p1", "bye")) == [("alignment/ann", "")]


def test_colours_are_those_of_the_page() -> None:
    text = (Path(__file__).parents[2] / "web_client/src/view/avatars.ts").read_text()
    (listed,) = re.findall(r"PARTICIPANT_COLORS = \[(.*?)\]", text)
    assert [bytes.fromhex(one) for one in re.findall(r"#(\w{6})", listed)] == [bytes(colour) for colour in PALETTE]
