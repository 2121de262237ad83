"""Read back the observations of anchors, the head poses, and the alignments in force from a recording.

Observations and samples are recorded as received, by connection. The participant of a connection follows from the joins
in the journal and the events of the same step; the time of a jump of a tracking frame follows from the alarms likewise.
A step is identified by its session time, which strictly grows: rows of the journal and events number steps differently.
"""

from __future__ import annotations

from array import array
from bisect import bisect_right, insort
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import msgspec
import numpy as np

from iris_session.protocol.client_messages import Observation, Sample
from iris_session.protocol.codec import BAD_BYTES
from iris_session.protocol.common import Alignment, Pose, Vec3
from iris_session.protocol.entries import AlignmentAlarm, Join, decode_entries
from iris_session.protocol.names import AlarmKind, AlignmentKind, Device
from iris_session.protocol.server_messages import (
    AlignmentAlarmed,
    AlignmentChanged,
    AnchorMoved,
    Event,
    ParticipantChanged,
    ParticipantInfo,
    ParticipantJoined,
    ParticipantLeft,
)
from iris_session.recording.reader import Recording

#: Maximum time between an observation and the head pose assigned to it.
NEAR_NS: Final = 50_000_000
#: Prefix of the capability by which a client states that it continues an earlier tracking frame.
RUN_PREFIX: Final = "run:"
#: Items between two calls of `on_progress`.
TOLD_EVERY: Final = 20_000
_KINDS: Final = (
    ParticipantJoined,
    ParticipantChanged,
    ParticipantLeft,
    AlignmentChanged,
    AlignmentAlarmed,
    AnchorMoved,
)
_decode = msgspec.msgpack.Decoder(Sample | Observation).decode


class TrackingFrame(NamedTuple):
    """Key of one tracking frame: participant, run of its app (counted from 1), and tracking epoch.

    `jumps`: number of jump alarms in this run before it: a client that did not notice the jump keeps its epoch.
    """

    participant: str
    run: int
    tracking_epoch: int
    jumps: int = 0


class RecordedObservation(NamedTuple):
    """One observation and the position of the head at that time [m], same tracking frame; None if no sample is near."""

    observation: Observation
    p_tracking_head: Vec3 | None


class AlignmentPeriod(NamedTuple):
    """An alignment and the session time in which it was in force [ns]; `until_ns` -1: until the end."""

    frame: TrackingFrame
    alignment: Alignment
    since_ns: int
    until_ns: int = -1


class AnchorMove(NamedTuple):
    """A change of the pose of an anchor by a director."""

    session_time: int
    anchor_id: str
    T_world_anchor: Pose


@dataclass
class RecordedParticipant:
    """A participant. `aligned`: it has a headset that needs an alignment. `runs`: names of its clients' runs."""

    id: str
    name: str
    role: str
    aligned: bool
    runs: list[str] = field(default_factory=list)


@dataclass
class AlignmentHistory:
    """Observations and alignments of a recording.

    `participants`: all that joined, by id. `observations`: by tracking frame, in order of capture. `unreadable`:
    number of messages that do not decode; `unowned`: number of observations over connections whose join is not in this
    recording.
    """

    participants: dict[str, RecordedParticipant] = field(default_factory=dict)
    observations: dict[TrackingFrame, list[RecordedObservation]] = field(default_factory=dict)
    in_force: list[AlignmentPeriod] = field(default_factory=list)
    anchor_moves: list[AnchorMove] = field(default_factory=list)
    unreadable: int = 0
    unowned: int = 0


@dataclass
class _Roster:
    """State while events are replayed.

    `owners`: participant and run, by connection. `jumps`: capture times of jumps, sorted, by participant and run.
    `present`: alignments in force, by participant.
    """

    owners: dict[int, tuple[str, int]] = field(default_factory=dict)
    jumps: dict[tuple[str, int], list[int]] = field(default_factory=dict)
    present: dict[str, AlignmentPeriod] = field(default_factory=dict)


class _StepEntries(NamedTuple):
    """Joins and jump alarms in the journal of one step, with connections, that no event has been matched to yet."""

    joins: list[tuple[int, Join]]
    jumps: list[tuple[int, AlignmentAlarm]]


def read_alignment_history(
    recording: Recording, on_progress: Callable[[int, int], None] | None = None
) -> AlignmentHistory:
    """Read the observations of anchors and the alignments in force from a recording.

    Args:
        recording: An open recording.
        on_progress: Called as `on_progress(done, total)` with counts of rows and raw messages.

    Returns:
        Participants, observations by tracking frame, periods of alignments and moves of anchors.

    Raises:
        NotARecordingError: A file can no longer be read.
    """
    n_rows, n_samples = recording.count_rows(), recording.count_samples()
    say = on_progress or (lambda done, total: None)
    events = [event for event in recording.events() if isinstance(event.body, _KINDS)]
    found = AlignmentHistory()
    roster = _replay_events(recording, events, found, lambda done: say(done, n_rows + n_samples))
    _read_messages(recording, roster, found, lambda done: say(n_rows + done, n_rows + n_samples))
    say(n_rows + n_samples, n_rows + n_samples)
    return found


def read_owners(recording: Recording) -> dict[int, str]:
    """Return the id of the participant of each connection whose join is in the recording.

    Raises:
        NotARecordingError: A file can no longer be read.
    """
    events = [event for event in recording.events() if isinstance(event.body, _KINDS)]
    owners = _replay_events(recording, events, AlignmentHistory(), lambda done: None).owners
    return {connection: participant for connection, (participant, _) in owners.items()}


def _replay_events(
    recording: Recording, events: list[Event], found: AlignmentHistory, say: Callable[[int], None]
) -> _Roster:
    """Replay the events: add participants, alignments and anchor moves to `found`; return owners of connections."""
    wanted = {e.session_time for e in events if isinstance(e.body, ParticipantJoined) or _is_jump(e.body)}
    said: dict[int, _StepEntries] = {}
    for done, row in enumerate(recording.rows()):
        if done % TOLD_EVERY == 0:
            say(done)
        if row.now_ns in wanted:
            said[row.now_ns] = _decode_step(row.entries)
    roster = _Roster()
    for event in events:
        _apply_event(event, said.get(event.session_time, _StepEntries([], [])), roster, found)
    found.in_force.extend(roster.present.values())
    found.in_force.sort(key=lambda one: one.since_ns)
    return roster


def _is_jump(body: object) -> bool:
    return isinstance(body, AlignmentAlarmed | AlignmentAlarm) and body.kind == AlarmKind.JUMP


def _decode_step(entries: bytes) -> _StepEntries:
    try:
        said = [(entry.connection, entry.message) for entry in decode_entries(entries)]
    except msgspec.DecodeError:  # damaged: participants that joined in this step stay unknown
        said = []
    joins = [(connection, message) for connection, message in said if isinstance(message, Join)]
    alarms = [(connection, message) for connection, message in said if isinstance(message, AlignmentAlarm)]
    return _StepEntries(joins, [alarm for alarm in alarms if _is_jump(alarm[1])])


def _apply_event(event: Event, said: _StepEntries, roster: _Roster, found: AlignmentHistory) -> None:
    """Apply one event of the history. `said`: joins and alarms in the journal row of its step."""
    body, now_ns, present = event.body, event.session_time, roster.present
    if isinstance(body, AnchorMoved):
        found.anchor_moves.append(AnchorMove(now_ns, body.anchor_id, body.T_world_anchor))
    elif isinstance(body, AlignmentChanged):
        before = present.get(body.participant)
        if before is not None and before.alignment.version == body.alignment.version:
            return  # it has aged: the period goes on
        _end_period(body.participant, now_ns, present, found)
        person = found.participants.get(body.participant)
        run = len(person.runs) if person else 0
        jumps = len(roster.jumps.get((body.participant, run), ()))
        frame = TrackingFrame(body.participant, run, body.alignment.tracking_epoch, jumps)
        present[body.participant] = AlignmentPeriod(frame, body.alignment, now_ns)
    elif isinstance(body, AlignmentAlarmed):
        if _is_jump(body):
            _end_period(body.participant, now_ns, present, found)
            person = found.participants.get(body.participant)
            _record_jump(body.participant, len(person.runs) if person else 0, now_ns, said.jumps, roster)
    elif isinstance(body, ParticipantLeft):
        if not body.grace:
            _end_period(body.participant, now_ns, present, found)
    elif isinstance(body, ParticipantJoined | ParticipantChanged):
        info = body.participant
        if info.alignment is None:
            _end_period(info.id, now_ns, present, found)
        aligned = info.alignment is None or info.alignment.kind != AlignmentKind.NOT_NEEDED
        person = found.participants.setdefault(info.id, RecordedParticipant(info.id, info.name, info.role, aligned))
        if isinstance(body, ParticipantJoined):
            _match_join(person, info, said.joins, roster.owners)


def _match_join(
    person: RecordedParticipant,
    info: ParticipantInfo,
    joins: list[tuple[int, Join]],
    owners: dict[int, tuple[str, int]],
) -> None:
    """Match a joined participant to its join by the name and role in `info`: one that resumes may have a new name.

    Joins of one step are answered in their order, except refused ones.
    """
    for i, (connection, join) in enumerate(joins):
        if (join.name, join.role) == (info.name, info.role):
            run = next((c for c in join.capabilities if c.startswith(RUN_PREFIX)), f"connection {connection}")
            if not person.runs or person.runs[-1] != run:
                person.runs.append(run)
            owners[connection] = person.id, len(person.runs)
            del joins[i]
            return
    person.runs.append("unknown")


def _record_jump(
    participant: str, run: int, now_ns: int, alarms: list[tuple[int, AlignmentAlarm]], roster: _Roster
) -> None:
    """Note the capture time of a jump as in the journal's alarm: the event is later by the latency of messages."""
    at_ns = now_ns
    for i, (connection, alarm) in enumerate(alarms):
        if roster.owners.get(connection, ("", 0))[0] == participant:
            at_ns = alarm.capture_ns or now_ns
            del alarms[i]
            break
    insort(roster.jumps.setdefault((participant, run), []), at_ns)


def _end_period(participant: str, now_ns: int, present: dict[str, AlignmentPeriod], found: AlignmentHistory) -> None:
    was = present.pop(participant, None)
    if was is not None:
        found.in_force.append(was._replace(until_ns=now_ns))


def _read_messages(recording: Recording, roster: _Roster, found: AlignmentHistory, say: Callable[[int], None]) -> None:
    """Add the observations to `found`, each with the head position nearest in time."""
    heads: dict[TrackingFrame, array[float]] = {}
    seen: dict[TrackingFrame, list[Observation]] = {}
    for done, raw in enumerate(recording.samples()):
        if done % TOLD_EVERY == 0:
            say(done)
        try:
            message = _decode(raw.data)
        except BAD_BYTES:
            found.unreadable += 1
            continue
        owner = roster.owners.get(raw.connection)
        if owner is None:
            found.unowned += isinstance(message, Observation)
            continue
        jumps = bisect_right(roster.jumps.get(owner, ()), message.capture_ns)
        frame = TrackingFrame(*owner, message.tracking_epoch, jumps)
        if isinstance(message, Observation):
            seen.setdefault(frame, []).append(message)
        elif message.device == Device.HEAD and message.pose is not None and message.tracked:
            heads.setdefault(frame, array("d")).extend((message.capture_ns, *message.pose.p))
    for frame, observations in sorted(seen.items()):
        found.observations[frame] = _with_heads(observations, heads.get(frame, array("d")))


def _with_heads(observations: list[Observation], heads: array[float]) -> list[RecordedObservation]:
    """Return the observations in order of capture. `heads`: time [ns] and position of the head [m], in any order."""
    observations.sort(key=lambda one: one.capture_ns)
    rows = np.array(heads).reshape(-1, 4)
    rows = rows[np.argsort(rows[:, 0])]  # clocks are slewed, and messages overtake each other
    found: list[RecordedObservation] = []
    for one in observations:
        after = int(np.searchsorted(rows[:, 0], one.capture_ns))
        near = [row for row in rows[max(0, after - 1) : after + 1].tolist() if abs(row[0] - one.capture_ns) <= NEAR_NS]
        nearest = min(near, key=lambda row: abs(row[0] - one.capture_ns), default=None)
        found.append(RecordedObservation(one, None if nearest is None else (nearest[1], nearest[2], nearest[3])))
    return found
