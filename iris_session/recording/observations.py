"""Reads back what headsets saw of anchors, where their heads were, and which alignments were in force meanwhile.

Observations and samples lie in the recording as they came, by connection. Whose connection that was is told by the
joins in the journal and the events of the same step; when a tracking frame jumped, by the alarms likewise. A step is
known by its session time, which strictly grows: rows of the journal and events number steps differently.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right, insort
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import msgspec

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

#: A head pose further from an observation in time says nothing about it.
NEAR_NS: Final = 50_000_000
#: Capability by which a client says that its tracking frame is the one from before.
RUN_PREFIX: Final = "run:"
#: Items between two calls of `told`.
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
    """One tracking frame: of a participant, in one run of its app (counted from 1), in one tracking epoch. `jumps`: how
    often in this run an alarm said that the frame had moved, which a client that did not notice tells by no epoch."""

    participant: str
    run: int
    tracking_epoch: int
    jumps: int = 0


class RecordedObservation(NamedTuple):
    """One observation, and where the head was then, in the same tracking frame; None where no sample is near."""

    observation: Observation
    p_tracking_head: Vec3 | None


class AlignmentPeriod(NamedTuple):
    """An alignment and from when to when it held, session time; `until_ns` -1: to the end."""

    frame: TrackingFrame
    alignment: Alignment
    since_ns: int
    until_ns: int = -1


class AnchorMove(NamedTuple):
    """A director moved an anchor."""

    session_time: int
    anchor_id: str
    T_world_anchor: Pose


@dataclass
class RecordedParticipant:
    """`aligned`: has a headset that is to be aligned. `runs`: what its clients called the runs of their tracking."""

    id: str
    name: str
    role: str
    aligned: bool
    runs: list[str] = field(default_factory=list)


@dataclass
class AlignmentHistory:
    """`people`: everybody who joined, by id. `looks`: by tracking frame, in order of capture. `unreadable`: messages
    that do not decode; `unowned`: observations over connections whose join is not in this recording."""

    participants: dict[str, RecordedParticipant] = field(default_factory=dict)
    observations: dict[TrackingFrame, list[RecordedObservation]] = field(default_factory=dict)
    in_force: list[AlignmentPeriod] = field(default_factory=list)
    anchor_moves: list[AnchorMove] = field(default_factory=list)
    unreadable: int = 0
    unowned: int = 0


@dataclass
class _Roster:
    """`owners`: participant and run, by connection. `jumps`: times of capture of jumps, sorted, by participant and run.
    `present`: alignments in force, by participant."""

    owners: dict[int, tuple[str, int]] = field(default_factory=dict)
    jumps: dict[tuple[str, int], list[int]] = field(default_factory=dict)
    present: dict[str, AlignmentPeriod] = field(default_factory=dict)


@dataclass
class _Said:
    """What the journal says of one step that no event has answered yet, with connections."""

    joins: list[tuple[int, Join]] = field(default_factory=list)
    jumps: list[tuple[int, AlignmentAlarm]] = field(default_factory=list)


class _Heads:
    """Where one head was, over time."""

    def __init__(self) -> None:
        self._times, self._places = array("q"), array("d")
        self._order: list[int] | None = None

    def add(self, capture_ns: int, p: Vec3) -> None:
        self._times.append(capture_ns)
        self._places.extend(p)

    def sort(self) -> None:
        """By time: clocks are slewed, and messages overtake each other."""
        order = sorted(range(len(self._times)), key=self._times.__getitem__)
        places = self._places
        self._times = array("q", [self._times[i] for i in order])
        self._places = array("d", [c for i in order for c in places[3 * i : 3 * i + 3]])

    def at(self, capture_ns: int) -> Vec3 | None:
        """The place nearest in time."""
        i = bisect_left(self._times, capture_ns)
        near = min(
            (k for k in (i - 1, i) if 0 <= k < len(self._times)),
            key=lambda k: abs(self._times[k] - capture_ns),
            default=-1,
        )
        if near < 0 or abs(self._times[near] - capture_ns) > NEAR_NS:
            return None
        x, y, z = self._places[3 * near : 3 * near + 3]
        return x, y, z


def read_alignment_history(
    recording: Recording, on_progress: Callable[[int, int], None] | None = None
) -> AlignmentHistory:
    """Everything that `Looks` has. `told(done, total)` hears how far it is."""
    n_rows, n_samples = recording.count_rows(), recording.count_samples()
    say = on_progress or (lambda done, total: None)
    events = [event for event in recording.events() if isinstance(event.body, _KINDS)]
    found = AlignmentHistory()
    roster = _roster(recording, events, found, lambda done: say(done, n_rows + n_samples))
    _messages(recording, roster, found, lambda done: say(n_rows + done, n_rows + n_samples))
    say(n_rows + n_samples, n_rows + n_samples)
    return found


def _roster(recording: Recording, events: list[Event], found: AlignmentHistory, say: Callable[[int], None]) -> _Roster:
    """Fills in people, alignments and moved anchors."""
    wanted = {e.session_time for e in events if isinstance(e.body, ParticipantJoined) or _is_jump(e.body)}
    said: dict[int, _Said] = {}
    for done, row in enumerate(recording.rows()):
        if done % TOLD_EVERY == 0:
            say(done)
        if row.now_ns in wanted:
            said[row.now_ns] = _said(row.entries)
    roster = _Roster()
    for event in events:
        _take(event, said.get(event.session_time, _Said()), roster, found)
    found.in_force.extend(roster.present.values())
    found.in_force.sort(key=lambda one: one.since_ns)
    return roster


def _is_jump(body: object) -> bool:
    return isinstance(body, AlignmentAlarmed | AlignmentAlarm) and body.kind == AlarmKind.JUMP


def _said(entries: bytes) -> _Said:
    said = _Said()
    try:
        for entry in decode_entries(entries):
            if isinstance(entry.message, Join):
                said.joins.append((entry.connection, entry.message))
            elif isinstance(entry.message, AlignmentAlarm) and _is_jump(entry.message):
                said.jumps.append((entry.connection, entry.message))
    except msgspec.DecodeError:  # damaged: those who came in this step stay unknown
        return _Said()
    return said


def _take(event: Event, said: _Said, roster: _Roster, found: AlignmentHistory) -> None:
    """One event of the history. `said`: by the journal, in its step."""
    body, now_ns, present = event.body, event.session_time, roster.present
    if isinstance(body, AnchorMoved):
        found.anchor_moves.append(AnchorMove(now_ns, body.anchor_id, body.T_world_anchor))
    elif isinstance(body, AlignmentChanged):
        _end(body.participant, now_ns, present, found)
        person = found.participants.get(body.participant)
        run = len(person.runs) if person else 0
        jumps = len(roster.jumps.get((body.participant, run), ()))
        frame = TrackingFrame(body.participant, run, body.alignment.tracking_epoch, jumps)
        present[body.participant] = AlignmentPeriod(frame, body.alignment, now_ns)
    elif isinstance(body, AlignmentAlarmed):
        if _is_jump(body):
            _end(body.participant, now_ns, present, found)
            person = found.participants.get(body.participant)
            _jump(body.participant, len(person.runs) if person else 0, now_ns, said.jumps, roster)
    elif isinstance(body, ParticipantLeft):
        if not body.grace:
            _end(body.participant, now_ns, present, found)
    elif isinstance(body, ParticipantJoined | ParticipantChanged):
        info = body.participant
        if info.alignment is None:
            _end(info.id, now_ns, present, found)
        aligned = info.alignment is None or info.alignment.kind != AlignmentKind.NOT_NEEDED
        person = found.participants.setdefault(info.id, RecordedParticipant(info.id, info.name, info.role, aligned))
        if isinstance(body, ParticipantJoined):
            _own(person, info, said.joins, roster.owners)


def _own(
    person: RecordedParticipant,
    info: ParticipantInfo,
    joins: list[tuple[int, Join]],
    owners: dict[int, tuple[str, int]],
) -> None:
    """The join that this person came with, by its name and role (`info`), as who resumes may have another name. Those
    of one step are answered in their order, but for refused ones."""
    for i, (connection, join) in enumerate(joins):
        if (join.name, join.role) == (info.name, info.role):
            run = next((c for c in join.capabilities if c.startswith(RUN_PREFIX)), f"connection {connection}")
            if not person.runs or person.runs[-1] != run:
                person.runs.append(run)
            owners[connection] = person.id, len(person.runs)
            del joins[i]
            return
    person.runs.append("unknown")


def _jump(participant: str, run: int, now_ns: int, alarms: list[tuple[int, AlignmentAlarm]], roster: _Roster) -> None:
    """Notes when it was captured, as the alarm in the journal says: the event is later by what messages take."""
    at_ns = now_ns
    for i, (connection, alarm) in enumerate(alarms):
        if roster.owners.get(connection, ("", 0))[0] == participant:
            at_ns = alarm.capture_ns or now_ns
            del alarms[i]
            break
    insort(roster.jumps.setdefault((participant, run), []), at_ns)


def _end(participant: str, now_ns: int, present: dict[str, AlignmentPeriod], found: AlignmentHistory) -> None:
    was = present.pop(participant, None)
    if was is not None:
        found.in_force.append(was._replace(until_ns=now_ns))


def _messages(recording: Recording, roster: _Roster, found: AlignmentHistory, say: Callable[[int], None]) -> None:
    """Fills in the looks: observations with the head pose nearest in time."""
    heads: dict[TrackingFrame, _Heads] = {}
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
            heads.setdefault(frame, _Heads()).add(message.capture_ns, message.pose.p)
    for frame, observations in sorted(seen.items()):
        found.observations[frame] = _with_heads(observations, heads.get(frame))


def _with_heads(observations: Iterable[Observation], heads: _Heads | None) -> list[RecordedObservation]:
    if heads is not None:
        heads.sort()
    ordered = sorted(observations, key=lambda one: one.capture_ns)
    return [RecordedObservation(one, None if heads is None else heads.at(one.capture_ns)) for one in ordered]
