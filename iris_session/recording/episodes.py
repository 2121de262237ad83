"""Episodes of a recording, from its events: pure, and the same for recordings of earlier versions, which say less."""

from __future__ import annotations

import msgspec

from iris_session.protocol.names import EpisodeState
from iris_session.protocol.server_messages import EpisodeChanged, Event, ParticipantChanged, ParticipantJoined


class RecordedEpisode(msgspec.Struct, frozen=True):
    """An episode, as the people in the session ran it.

    Attributes:
        number: From 1. In a task it counts the episodes of earlier sessions, too. One that was recorded again has the
            number of the discarded one before it.
        task, instruction: Of the task; empty without one.
        label: `success`, `failure`, `discarded` or `unknown`.
        text: Free text that was given with it.
        started_by: Name of the participant that started it.
        ended_by: Name of the one that ended it; empty when the recording ends first.
        start_ns, end_ns: Session time from which, and until which, it was recorded [ns].
        robots: Robots that belong to it.
        ended: False when the recording ends first; its label is `unknown` then.
    """

    number: int
    task: str = ""
    instruction: str = ""
    label: str = EpisodeState.UNKNOWN
    text: str = ""
    started_by: str = ""
    ended_by: str = ""
    start_ns: int = 0
    end_ns: int = 0
    robots: tuple[str, ...] = ()
    ended: bool = False


class EpisodeCollector:
    """Collects episodes from events in their order, given one by one to `add`."""

    def __init__(self) -> None:
        self._over: list[RecordedEpisode] = []
        self._now: RecordedEpisode | None = None
        self._names: dict[str, str] = {}
        self._last_ns = 0

    def add(self, event: Event) -> None:
        """Take an event of the session."""
        body, self._last_ns = event.body, event.session_time
        if isinstance(body, ParticipantJoined | ParticipantChanged):
            self._names[body.participant.id] = body.participant.name
        elif isinstance(body, EpisodeChanged):
            self._follow(body, event.session_time)

    def _follow(self, body: EpisodeChanged, now_ns: int) -> None:
        if body.state in (EpisodeState.IDLE, EpisodeState.COUNTDOWN, EpisodeState.CANCELLED):
            return
        who, now = self._names.get(body.participant, body.participant), self._now
        if now is None or (now.number != body.number and body.state == EpisodeState.RUNNING):
            if now is not None:
                self._over.append(msgspec.structs.replace(now, end_ns=now.end_ns or now_ns))
            started_by = body.started_by_name or who
            now = RecordedEpisode(body.number, started_by=started_by, start_ns=body.started_ns or now_ns)
        given = {"task": body.task, "instruction": body.instruction, "text": body.label, "robots": body.robots}
        now = msgspec.structs.replace(now, **{name: value for name, value in given.items() if value})
        if body.state not in EpisodeState.RECORDED and not now.end_ns:
            now = msgspec.structs.replace(now, end_ns=now_ns)  # closing, or in recordings of earlier versions the end
        self._now = now
        if body.state in EpisodeState.OVER:
            self._over.append(msgspec.structs.replace(now, label=body.state, ended_by=who, ended=True))
            self._now = None

    def list_episodes(self, end_ns: int = 0) -> tuple[RecordedEpisode, ...]:
        """Return the episodes in order. One that did not end lasts until `end_ns`, the end of the recording."""
        if self._now is None:
            return tuple(self._over)
        last_ns = self._now.end_ns or max(end_ns, self._last_ns)
        return (*self._over, msgspec.structs.replace(self._now, end_ns=last_ns))
