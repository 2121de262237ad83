"""Episodes of a recording, from its events."""

from __future__ import annotations

from typing import Any

from iris_session.protocol.server_messages import EpisodeChanged, Event, ParticipantInfo, ParticipantJoined
from iris_session.recording.episodes import EpisodeCollector, RecordedEpisode

ANN = ParticipantInfo("p1", "ann", "operator", True)
BOB = ParticipantInfo("p2", "bob", "operator", True)
OF = {"task": "pour", "instruction": "Pour.", "started_by": "p1", "started_by_name": "ann", "label": "blue"}


def collect(*bodies: Any) -> tuple[RecordedEpisode, ...]:
    collector = EpisodeCollector()
    for i, body in enumerate((ParticipantJoined(ANN), ParticipantJoined(BOB), *bodies)):
        collector.add(Event(i + 1, i, 10 * i, body))
    return collector.list_episodes(500)


def test_an_episode_has_its_starter_its_end_and_the_time_in_which_it_was_recorded() -> None:
    assert collect(
        EpisodeChanged(3, "idle", task="pour"),
        EpisodeChanged(4, "countdown", participant="p1", **OF),
        EpisodeChanged(4, "running", participant="p1", started_ns=40, robots=("left",), **OF),
        EpisodeChanged(4, "confirm", participant="p1", started_ns=40, robots=("left",), **OF),
        EpisodeChanged(4, "left", participant="p1", started_ns=40, robots=("left",), **OF),
        EpisodeChanged(4, "closing", participant="p2", started_ns=40, verdict="success", robots=("left",), **OF),
        EpisodeChanged(4, "success", participant="p2", started_ns=40, robots=("left",), **OF),
        EpisodeChanged(5, "countdown", participant="p1", **OF),
        EpisodeChanged(5, "cancelled", participant="p1", **OF),
    ) == (RecordedEpisode(4, "pour", "Pour.", "success", "blue", "ann", "bob", 40, 70, ("left",), ended=True),)


def test_a_repeated_one_has_the_same_number_and_one_that_the_recording_does_not_end_is_unknown() -> None:
    first, second = collect(
        EpisodeChanged(1, "running", participant="p1", started_ns=20, **OF),
        EpisodeChanged(1, "closing", participant="p1", started_ns=20, verdict="discarded", **OF),
        EpisodeChanged(1, "discarded", participant="p1", started_ns=20, **OF),
        EpisodeChanged(1, "running", participant="p1", started_ns=50, **OF),
    )
    assert (first.number, first.label, first.start_ns, first.end_ns) == (1, "discarded", 20, 30)
    assert (second.number, second.label, second.start_ns, second.end_ns, second.ended) == (1, "unknown", 50, 500, False)


def test_recordings_of_earlier_versions_say_who_started_and_when() -> None:
    assert collect(
        EpisodeChanged(1, "running", "pour", "p1"),
        EpisodeChanged(1, "success", "", "p2"),
        EpisodeChanged(2, "running", "", "p1"),
        EpisodeChanged(3, "running", "", "p1"),
        EpisodeChanged(3, "failure", "", "p2"),
    ) == (
        RecordedEpisode(
            1, label="success", text="pour", started_by="ann", ended_by="bob", start_ns=20, end_ns=30, ended=True
        ),
        RecordedEpisode(2, started_by="ann", start_ns=40, end_ns=50),
        RecordedEpisode(3, label="failure", started_by="ann", ended_by="bob", start_ns=50, end_ns=60, ended=True),
    )
