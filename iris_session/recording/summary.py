"""Summary of a recording: who took part, what happened, how long, and what is damaged, in one pass over the files.

`summarise` reads an open recording. `SummaryBuilder` takes its events and other items one by one and is pure. All times
are session time in seconds. Nothing here simulates: a whole summary does not say that the recording verifies.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

import msgspec
import numpy as np

from iris_session.journal.messages import ABRUPT, DenialRecord, EndMark
from iris_session.protocol.common import Alignment, Lease
from iris_session.protocol.names import TargetKind
from iris_session.protocol.server_messages import (
    AlignmentAlarmed,
    AlignmentChanged,
    EStopChanged,
    Event,
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
from iris_session.recording.episodes import EpisodeCollector
from iris_session.recording.reader import Recording
from iris_session.rrd.assets import AssetCollector, AssetFault, AssetPiece, AssetsSummary, RecordedScene
from iris_session.rrd.batches import FrameTime, RecordedStream, RowTimes
from iris_session.rrd.file import get_size

#: Maximum number of lines about missing steps, and about missing events: a file may have any number of gaps.
MOST_GAPS: Final = 100
_RUNNING: Final = "running"
#: Longest time from the e-stop of a client that joins to the same one under its name.
_JOIN_NS: Final = 2_000_000_000


class AlignmentSummary(msgspec.Struct, frozen=True):
    """Alignments of a person.

    `kind`: of the newest. `error_at_anchor_m`, `error_at_robot_m`: its stated errors (95 %) [m], 0 if none is stated.
    `worst_error_at_robot_m`: the largest of all. `changes`: number of alignments. `alarms`: number by `AlarmKind`.
    """

    kind: str = "none"
    error_at_anchor_m: float = 0.0
    error_at_robot_m: float = 0.0
    worst_error_at_robot_m: float = 0.0
    changes: int = 0
    alarms: dict[str, int] = {}


class PersonSummary(msgspec.Struct, frozen=True):
    """Participants of one name and role, for example a person who joined twice.

    `ids`: their ids. `devices`: all that they declared. `joins`: how often they joined or resumed. `present_s`: time
    connected. `stayed`: connected at the end. `held_s`: time that they held each robot. `rejected`: number of their
    samples that were rejected, by `RejectReason`.
    """

    name: str
    role: str
    ids: tuple[str, ...]
    devices: tuple[str, ...] = ()
    joins: int = 0
    present_s: float = 0.0
    stayed: bool = False
    held_s: dict[str, float] = {}
    alignment: AlignmentSummary = AlignmentSummary()
    rejected: dict[str, int] = {}


class EpisodeSummary(msgspec.Struct, frozen=True):
    """An episode. `verdict`: success, failure, discarded, unknown; running: it did not end. `label`: free text. `at_s`:
    its start, or its end if it began before the recording; `duration_s` is then 0. `by`: who gave the verdict, or
    started it.
    """

    number: int
    verdict: str
    label: str
    at_s: float
    duration_s: float
    by: str
    task: str = ""
    started_by: str = ""
    robots: tuple[str, ...] = ()


class HandoverSummary(msgspec.Struct, frozen=True):
    """A handover: robots, and names of those who drove them. `at_s`: its end. `both_held_s`: both held the object."""

    object: str
    giver: str
    giver_name: str
    receiver: str
    receiver_name: str
    at_s: float
    both_held_s: float


class StopSummary(msgspec.Struct, frozen=True):
    """An e-stop or a pause. `by`: name, empty for a connection that had not joined. `duration_s`: until it was cleared;
    `ended` false: it was not, and lasts to the end.
    """

    at_s: float
    by: str
    reason: str
    duration_s: float
    ended: bool


class SceneChangeSummary(msgspec.Struct, frozen=True):
    """A reset, another scene, or a patch. `cause`: as in `SceneChanged`."""

    at_s: float
    cause: str


class StreamSummary(msgspec.Struct, frozen=True):
    """Recorded frames of a cloud or of pictures. `encoding`: `cloud` or `jpeg`. `hz`: frames per second between
    the first and the last, 0 for fewer than two. `title`, `fault`: of the newest description.
    """

    name: str
    encoding: str
    title: str = ""
    frames: int = 0
    duration_s: float = 0.0
    hz: float = 0.0
    fault: str = ""


class DropSummary(msgspec.Struct, frozen=True):
    """Counts of what the session dropped and denied, as far as they are in the recording.

    `rejected_samples`: by `RejectReason`. `denials`: by `DenialReason`. `lost_steps`: steps that did not fit into the
    recording. `stalls`, `stalled_s`: times without a step. `down_s`: from the recording that this one continues to its
    first step. `samples_left_out`: raw messages of clients that were not recorded.
    """

    rejected_samples: dict[str, int] = {}
    denials: dict[str, int] = {}
    lost_steps: int = 0
    stalls: int = 0
    stalled_s: float = 0.0
    down_s: float = 0.0
    samples_left_out: int = 0


class RecordingSummary(msgspec.Struct, frozen=True):
    """Content of a recording.

    `ok`: nothing is damaged or missing inside; `finished`: the recorder closed the file; `ending`: in what way it is
    not the end of the session, empty if it is. `files`: the parts that were read; `bytes`: of them. `recording_class`:
    `closed` or `open`. `created_utc`: when the recording began. `begin_s`: session time of the first step;
    `duration_s`: to the last step or event. `continues`: file that a resumed session continues. `deformables`: those
    of its scenes, if their assets are recorded. `scene_changes`: resets among them. `damage`: one line per place that
    is damaged or missing. `notes`: what else is unusual.
    """

    path: str
    ok: bool
    files: tuple[str, ...]
    bytes: int
    session_name: str
    session_id: str
    created_utc: str
    format: int
    recording_class: str
    finished: bool
    ending: str
    begin_s: float
    duration_s: float
    steps: int
    continues: str
    robots: tuple[str, ...]
    objects: tuple[str, ...]
    deformables: tuple[str, ...]
    bodies: int
    people: tuple[PersonSummary, ...]
    episodes: tuple[EpisodeSummary, ...]
    handovers: tuple[HandoverSummary, ...]
    stops: tuple[StopSummary, ...]
    pauses: tuple[StopSummary, ...]
    scene_changes: tuple[SceneChangeSummary, ...]
    streams: tuple[StreamSummary, ...]
    drops: DropSummary
    damage: tuple[str, ...]
    notes: tuple[str, ...]
    assets: AssetsSummary = AssetsSummary()


def summarise(recording: Recording, progress: Callable[[int, int], None] | None = None) -> RecordingSummary:
    """Summarise an open recording.

    Args:
        recording: The recording; its bytes are compared with the recorder's checksums too.
        progress: Called as `progress(done, total)` with numbers of steps, `total` 0 if the recording is not finished.

    Returns:
        The summary; damage that was found is in it.

    Raises:
        NotARecordingError: A file can no longer be read.
    """
    header = recording.header
    builder, damage = build_summary(recording, progress)
    past = header.continues
    return RecordingSummary(
        path=recording.files[0],
        ok=not damage,
        files=tuple(os.path.basename(file) for file in recording.files),
        bytes=sum(max(0, get_size(file)) for file in recording.files),
        session_name=header.session_name,
        session_id=header.session_id,
        created_utc=header.created_utc,
        format=header.format,
        recording_class=header.recording_class,
        finished=recording.finished,
        ending=_describe_ending(recording, builder.end_ns),
        begin_s=_to_s(builder.begin_ns),
        duration_s=_to_s(builder.end_ns - builder.begin_ns),
        steps=builder.steps,
        continues="" if past is None else f"{past.file} after step {past.step}",
        robots=tuple(robot.name for robot in header.robots),
        objects=tuple(one.name for one in header.objects),
        deformables=tuple(builder.assets.deformables),
        bodies=len(header.bodies),
        people=builder.list_people(),
        episodes=builder.list_episodes(),
        handovers=tuple(builder.handovers),
        stops=builder.list_stops(builder.stops),
        pauses=builder.list_stops(builder.pauses),
        scene_changes=tuple(builder.scene_changes),
        streams=builder.list_streams(),
        drops=builder.make_drops(recording.samples_left_out),
        damage=damage,
        notes=tuple(recording.notes),
        assets=builder.assets.summarise(),
    )


def build_summary(
    recording: Recording, progress: Callable[[int, int], None] | None = None
) -> tuple[SummaryBuilder, tuple[str, ...]]:
    """Return the parts of a summary, and what is damaged or missing. Arguments and errors as for `summarise`."""
    header, end = recording.header, recording.end
    builder = SummaryBuilder(header.begins_after, resumed=header.continues is not None)
    total = 0 if end is None else max(0, end.step - header.begins_after)
    for item in recording.outline():
        builder.add(item)
        if progress is not None and isinstance(item, RowTimes):
            progress(builder.steps, total)
    changed = recording.changed_spans()
    lost = builder.assets.list_problems(finished=recording.all_closed)
    return builder, (*recording.missing, *recording.damage, *builder.list_gaps(end), *changed, *lost)


def _describe_ending(recording: Recording, end_ns: int) -> str:
    """Return one line about an end that is not that of a session, empty for one that is."""
    if recording.is_being_written:
        return f"is being written: read as far as {_to_s(end_ns):g} s"
    if recording.end is not None:
        return recording.end.reason[:200] or (ABRUPT if recording.end.is_abrupt else "")
    cuts = "".join(f"; {cut}" for cut in recording.cuts)
    lost = "at most 0.25 s, or 2 s at rest, if its recorder was killed, more if the file was cut"
    return f"not closed after {_to_s(end_ns):g} s: what may have followed is missing, {lost}{cuts}"


@dataclass
class _Person:
    """A participant while events are added. `since_ns`: of its present connection."""

    name: str
    role: str = ""
    devices: dict[str, None] = field(default_factory=dict)
    joins: int = 0
    present_ns: int = 0
    since_ns: int | None = None
    held_ns: Counter[str] = field(default_factory=Counter)
    alignment: Alignment | None = None
    worst_error_m: float = 0.0
    changes: int = 0
    alarms: Counter[str] = field(default_factory=Counter)
    rejected: dict[tuple[str, str], int] = field(default_factory=dict)  # by device and reason


@dataclass
class _Stop:
    """An e-stop or pause. `participant`: id."""

    at_ns: int
    participant: str
    reason: str
    until_ns: int | None = None


@dataclass
class _Stream:
    encoding: str = ""
    title: str = ""
    fault: str = ""
    frames: int = 0
    first_ns: int = 0
    last_ns: int = 0


class SummaryBuilder:
    """Builds the parts of a summary from the items of `Recording.outline`, those of one kind in order. Pure.

    `begins_after`: step before the first one. `resumed`: the session began in an earlier recording.

    Attributes:
        steps: Number of steps.
        begin_ns: Session time of the first step.
        end_ns: Session time of the newest step or event.
        handovers: In order.
        stops: E-stops in order.
        pauses: In order.
        scene_changes: In order.
        assets: Those of the scenes.
    """

    def __init__(self, begins_after: int = -1, *, resumed: bool = False) -> None:
        self.steps = 0
        self.begin_ns = self.end_ns = 0
        self.handovers: list[HandoverSummary] = []
        self.stops: list[_Stop] = []
        self.pauses: list[_Stop] = []
        self.scene_changes: list[SceneChangeSummary] = []
        self.assets = AssetCollector()
        self._last_step = begins_after
        self._step_ns: int | None = None  # session time of that step
        self._step_gaps: list[str] = []
        self._lost_steps = self._lost_ns = 0
        self._event_gaps: list[str] = []
        self._event_seq: int | None = None if resumed else 0
        self._event_ns = 0
        self._people: dict[str, _Person] = {}
        self._holders: dict[str, dict[str, int]] = {}  # by robot: since when, by participant
        self._episodes = EpisodeCollector()
        self._streams: dict[str, _Stream] = {}
        self._unattributed: dict[tuple[str, str], int] = {}  # rejected samples of connections that had not joined
        self._denials: Counter[str] = Counter()
        self._gaps: list[Gap] = []

    def add(self, item: object) -> None:
        """Add one item of `Recording.outline`."""
        if isinstance(item, RowTimes):
            self._add_rows(item)
        elif isinstance(item, Event):
            self._add_event(item)
        elif isinstance(item, DenialRecord):
            self._denials[item.denial.reason] += 1
        elif isinstance(item, FrameTime):
            self._add_frame(item)
        elif isinstance(item, RecordedStream):
            self._describe_stream(item)
        elif isinstance(item, RecordedScene | AssetPiece | AssetFault):
            self.assets.add(item)

    def _add_rows(self, rows: RowTimes) -> None:
        new = rows.steps > self._last_step  # a part repeats steps of the one before
        steps, times = rows.steps[new], rows.session_times[new]
        if not len(steps):
            return
        if not self.steps:
            self.begin_ns = int(times[0])
        before = np.concatenate(([self._last_step], steps[:-1]))
        for i in np.flatnonzero(steps - before > 1):
            until = f"{_to_s(int(times[i])):g} s"
            since = self._step_ns if i == 0 else int(times[i - 1])
            span = f"before {until}" if since is None else f"from {_to_s(since):g} s to {until}"
            self._add_gap(self._step_gaps, f"{_format_range('step', int(before[i]) + 1, int(steps[i]) - 1)}, {span}")
            self._lost_steps += int(steps[i] - before[i]) - 1
            self._lost_ns += 0 if since is None else int(times[i]) - since
        self.steps += len(steps)
        self._last_step, self._step_ns = int(steps.max()), int(times[-1])
        self.end_ns = max(self.end_ns, self._step_ns)

    def _add_gap(self, gaps: list[str], text: str) -> None:
        if len(gaps) < MOST_GAPS:
            gaps.append(text)
        elif len(gaps) == MOST_GAPS:
            gaps.append("and more are missing than are listed here")

    def _add_event(self, event: Event) -> None:
        now_ns = event.session_time
        if self._event_seq is not None and event.event_seq > self._event_seq + 1:
            missing = _format_range("event", self._event_seq + 1, event.event_seq - 1)
            self._add_gap(self._event_gaps, f"{missing}, from {_to_s(self._event_ns):g} s to {_to_s(now_ns):g} s")
        self._event_seq, self._event_ns = event.event_seq, now_ns
        self.end_ns = max(self.end_ns, now_ns)
        self._episodes.add(event)
        self._apply_person(event.body, now_ns)
        self._apply_history(event.body, now_ns)

    def _apply_person(self, body: object, now_ns: int) -> None:
        """Apply an event about a participant."""
        match body:
            case ParticipantJoined(participant=info):
                person = self._update_person(info)
                person.joins += 1
                person.since_ns = now_ns if person.since_ns is None else person.since_ns
            case ParticipantChanged(participant=info):
                self._update_person(info)
            case ParticipantLeft(participant=name):
                person = self._find_person(name)
                if person.since_ns is not None:
                    person.present_ns += now_ns - person.since_ns
                    person.since_ns = None
            case LeaseChanged(lease=lease):
                self._change_holders(lease, now_ns)
            case LeasesChanged(leases=leases):
                for lease in leases:
                    self._change_holders(lease, now_ns)
            case AlignmentChanged(participant=name, alignment=alignment):
                person = self._find_person(name)
                before, person.alignment = person.alignment, alignment
                person.changes += before is None or before.version != alignment.version  # else it has aged
                person.worst_error_m = max(person.worst_error_m, _finite(alignment.error_at_robot_m))
            case AlignmentAlarmed(participant=name, kind=kind):
                self._find_person(name).alarms[kind] += 1
            case SamplesRejected(participant=name, device=device, reason=reason, count=count):
                counts = self._find_person(name).rejected if name else self._unattributed
                counts[device, reason] = count  # since the participant joined

    def _apply_history(self, body: object, now_ns: int) -> None:
        """Apply an event about the session."""
        match body:
            case Handover():
                self.handovers.append(
                    HandoverSummary(
                        body.object,
                        body.giver,
                        self._get_name(body.giver_participant),
                        body.receiver,
                        self._get_name(body.receiver_participant),
                        _to_s(now_ns),
                        _to_s(body.duration_ns),
                    )
                )
            case EStopChanged(active=active, participant=name, reason=reason):
                _change_stops(self.stops, _Stop(now_ns, name, reason), active=active)
            case PauseChanged(paused=paused, participant=name, reason=reason):
                _change_stops(self.pauses, _Stop(now_ns, name, reason), active=paused)
            case SceneChanged(cause=cause):
                self.scene_changes.append(SceneChangeSummary(_to_s(now_ns), cause))
            case Gap():
                self._gaps.append(body)

    def _find_person(self, participant: str) -> _Person:
        """Return a participant; one that joined before the recording has its id as name."""
        return self._people.setdefault(participant, _Person(participant))

    def _update_person(self, info: ParticipantInfo) -> _Person:
        person = self._find_person(info.id)
        person.name, person.role = info.name, info.role
        person.devices.update(dict.fromkeys(info.devices))
        if info.alignment is not None and person.alignment is None:  # not needed, or of an earlier recording
            person.alignment = info.alignment
            person.worst_error_m = _finite(info.alignment.error_at_robot_m)
        return person

    def _get_name(self, participant: str) -> str:
        known = self._people.get(participant)
        return participant if known is None else known.name

    def _change_holders(self, lease: Lease, now_ns: int) -> None:
        """Note who holds a robot. In mode `priority` the one who stands by does not hold it."""
        if lease.kind != TargetKind.ROBOT:
            return
        if lease.sub_holders and len(lease.weights) == len(lease.sub_holders):
            pairs = zip(lease.sub_holders, lease.weights, strict=True)
            holders = {name for name, weight in pairs if weight > 0.0}
        else:
            holders = {lease.holder} - {""}
        before = self._holders.get(lease.target, {})
        for name, since_ns in before.items():
            if name not in holders:
                self._find_person(name).held_ns[lease.target] += now_ns - since_ns
        self._holders[lease.target] = {name: before.get(name, now_ns) for name in holders}

    def _add_frame(self, frame: FrameTime) -> None:
        stream = self._streams.setdefault(frame.stream, _Stream())
        if not stream.frames:
            stream.encoding, stream.first_ns = frame.encoding, frame.capture_ns
        stream.frames += 1
        stream.last_ns = frame.capture_ns

    def _describe_stream(self, described: RecordedStream) -> None:
        stream = self._streams.setdefault(described.stream, _Stream())
        stream.encoding = described.encoding
        if described.info is not None:
            stream.title, stream.fault = described.info.title, described.info.fault

    def list_gaps(self, end: EndMark | None = None) -> list[str]:
        """Return a line per place where steps or events are missing. `end`: mark of a closed recording."""
        gaps = list(self._step_gaps)
        if end is not None and end.step > self._last_step:
            gaps.append(f"{_format_range('step', self._last_step + 1, end.step)}, after {_to_s(self.end_ns):g} s")
        return gaps + self._event_gaps

    def count_lost_steps(self, end: EndMark | None = None) -> tuple[int, float]:
        """Return how many steps are missing, and the time that they span, without those at the end [s]."""
        at_end = 0 if end is None else max(0, end.step - self._last_step)
        return self._lost_steps + at_end, _to_s(self._lost_ns)

    def list_people(self) -> tuple[PersonSummary, ...]:
        """Return the participants in the order of their first joins, those of one name and role together."""
        held_ns = {participant: Counter(person.held_ns) for participant, person in self._people.items()}
        for robot, holders in self._holders.items():
            for name, since_ns in holders.items():
                held_ns.setdefault(name, Counter())[robot] += self.end_ns - since_ns
        together: dict[tuple[str, str], list[str]] = {}
        for participant, person in self._people.items():
            together.setdefault((person.name, person.role), []).append(participant)
        return tuple(self._summarise_person(ids, _sum(held_ns[one] for one in ids)) for ids in together.values())

    def _summarise_person(self, ids: list[str], held_ns: Counter[str]) -> PersonSummary:
        people = [self._people[one] for one in ids]
        present_ns = sum(one.present_ns for one in people)
        present_ns += sum(self.end_ns - one.since_ns for one in people if one.since_ns is not None)
        return PersonSummary(
            people[-1].name,
            people[-1].role,
            tuple(ids),
            tuple(dict.fromkeys(device for one in people for device in one.devices)),
            sum(one.joins for one in people),
            _to_s(present_ns),
            any(one.since_ns is not None for one in people),
            {robot: _to_s(ns) for robot, ns in sorted(held_ns.items())},
            _summarise_alignment(people),
            _count_by_reason(one.rejected for one in people),
        )

    def list_episodes(self) -> tuple[EpisodeSummary, ...]:
        """Return the episodes in order."""
        return tuple(
            EpisodeSummary(
                one.number,
                one.label if one.ended else _RUNNING,
                one.text,
                _to_s(one.start_ns),
                _to_s(one.end_ns - one.start_ns),
                one.ended_by or one.started_by,
                one.task,
                one.started_by,
                one.robots,
            )
            for one in self._episodes.list_episodes(self.end_ns)
        )

    def list_stops(self, stops: Iterable[_Stop]) -> tuple[StopSummary, ...]:
        """Return `stops` or `pauses` with names and durations."""
        return tuple(
            StopSummary(
                _to_s(one.at_ns),
                self._get_name(one.participant),
                one.reason,
                _to_s((self.end_ns if one.until_ns is None else one.until_ns) - one.at_ns),
                one.until_ns is not None,
            )
            for one in stops
        )

    def list_streams(self) -> tuple[StreamSummary, ...]:
        """Return the streams of clouds and pictures by name."""
        return tuple(
            StreamSummary(
                name,
                one.encoding,
                one.title,
                one.frames,
                _to_s(one.last_ns - one.first_ns),
                round((one.frames - 1) / (one.last_ns - one.first_ns) * 1e9, 2) if one.last_ns > one.first_ns else 0.0,
                one.fault,
            )
            for name, one in sorted(self._streams.items())
        )

    def make_drops(self, samples_left_out: int = 0) -> DropSummary:
        """Return what was dropped and denied."""
        rejected = (self._unattributed, *(person.rejected for person in self._people.values()))
        stalls = [gap for gap in self._gaps if gap.kind == "stalled"]
        return DropSummary(
            _count_by_reason(rejected),
            dict(self._denials),
            sum(gap.rows for gap in self._gaps if gap.kind == "recording"),
            len(stalls),
            _to_s(sum(gap.duration_ns for gap in stalls)),
            _to_s(sum(gap.duration_ns for gap in self._gaps if gap.kind == "resumed")),
            samples_left_out,
        )


def _change_stops(stops: list[_Stop], stop: _Stop, *, active: bool) -> None:
    """Add a stop, or end all that are in force.

    A client that stops the session while it joins says so twice: the second time under its name.
    """
    if active:
        last = stops[-1] if stops else None
        early = last is not None and not last.participant and last.until_ns is None and last.reason == stop.reason
        if last is not None and early and stop.at_ns - last.at_ns <= _JOIN_NS:
            last.participant = stop.participant
        else:
            stops.append(stop)
        return
    for one in reversed(stops):
        if one.until_ns is not None:
            return
        one.until_ns = stop.at_ns


def _summarise_alignment(people: list[_Person]) -> AlignmentSummary:
    newest = next((one.alignment for one in reversed(people) if one.alignment is not None), None)
    return AlignmentSummary(
        "none" if newest is None else newest.kind,
        0.0 if newest is None else _finite(newest.error_at_anchor_m),
        0.0 if newest is None else _finite(newest.error_at_robot_m),
        max(one.worst_error_m for one in people),
        sum(one.changes for one in people),
        dict(_sum(one.alarms for one in people)),
    )


def _sum(counters: Iterable[Counter[str]]) -> Counter[str]:
    total: Counter[str] = Counter()
    for one in counters:
        total.update(one)
    return total


def _count_by_reason(rejected: Iterable[Mapping[tuple[str, str], int]]) -> dict[str, int]:
    """Return numbers of rejected samples by reason, from those by device and reason."""
    return dict(_sum(Counter({reason: count}) for one in rejected for (_, reason), count in one.items()))


def _format_range(noun: str, first: int, last: int) -> str:
    if first == last:
        return f"{noun} {first} is missing"
    return f"{noun}s {first} to {last} are missing ({last - first + 1:,})"


def _finite(value: float) -> float:
    """Return `value`, 0 for numbers that are not finite: a file may hold any."""
    return value if math.isfinite(value) else 0.0


def _to_s(ns: int) -> float:
    return round(ns * 1e-9, 3)
