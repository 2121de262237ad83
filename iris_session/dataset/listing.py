"""Episodes of recordings with the numbers that people choose by: how long, who, how busy, how far, what was in view.

They come from the events and the recorded states: nothing is simulated. The decisions in the curations stand beside
them. Recordings that cannot be in one data set are listed too, and marked.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.dataset.cameras import CameraSpec
from iris_session.dataset.episodes import (
    UNKNOWN,
    Curation,
    DatasetError,
    EpisodeCuration,
    find_difference,
    identify_recording,
    read_curation,
)
from iris_session.dataset.posed_scene import PosedScene, Projection
from iris_session.physics.errors import PhysicsError
from iris_session.protocol.server_messages import (
    EngagementChanged,
    Handover,
    Intervention,
    ParticipantChanged,
    ParticipantJoined,
    SamplesRejected,
)
from iris_session.recording import Recording, RecordingError, SessionHeader
from iris_session.recording.episodes import RecordedEpisode
from iris_session.recording.summary import EpisodeSummary, build_summary
from iris_session.rrd.batches import RecordedState
from iris_session.session.verification import verify_recording

#: Steps and states between two calls of `progress`.
_PROGRESS: Final = 500
_RUNNING: Final = "running"


class ListedEpisode(EpisodeSummary, frozen=True):
    """An episode and its numbers, which are of all of it, before a trim. Number 0 is the whole of a recording without
    episodes.

    Attributes:
        recording: First file of its recording.
        instruction: What was to be done, in words.
        simulated_s: Simulated time, as far as states are recorded [s].
        people: Names of those that moved a robot in it.
        handovers, interventions: Numbers of them.
        idle_share: Share of session time in which no robot was engaged.
        clutches: How often a robot was engaged.
        rejected: Rejected samples, which are counted once a second.
        path_m: Length of the path of each robot's end effector [m].
        closest_m: Least distance of the end effectors of two robots [m]; None with fewer than two.
        outside: Share of time in which an end effector of its robots was not in the picture, by camera.
        is_editable: False for one that was recorded again under the same number.
        edit: Decisions about it.
    """

    recording: str = ""
    instruction: str = ""
    simulated_s: float = 0.0
    people: tuple[str, ...] = ()
    handovers: int = 0
    interventions: int = 0
    idle_share: float = 0.0
    clutches: int = 0
    rejected: int = 0
    path_m: dict[str, float] = msgspec.field(default_factory=dict)
    closest_m: float | None = None
    outside: dict[str, float] = msgspec.field(default_factory=dict)
    is_editable: bool = True
    edit: EpisodeCuration = EpisodeCuration()

    @property
    def final_verdict(self) -> str:
        """Return the verdict that an export goes by."""
        return self.edit.label or (UNKNOWN if self.verdict == _RUNNING else self.verdict)

    @property
    def span_ns(self) -> tuple[int, int]:
        """Return when it begins and ends in session time [ns]."""
        return round(self.at_s * 1e9), round((self.at_s + self.duration_s) * 1e9)

    @property
    def length_s(self) -> float:
        """Return the greatest time that a trim may have [s]."""
        return max(self.duration_s, self.simulated_s)


class ListedRecording(msgspec.Struct, frozen=True):
    """A recording and its episodes. `problems`: why it, or its curation, cannot be exported, one line each."""

    path: str
    id: str = ""
    session_name: str = ""
    problems: tuple[str, ...] = ()
    episodes: tuple[ListedEpisode, ...] = ()


class ListOptions(msgspec.Struct, frozen=True):
    """Options of a list.

    `cameras`: those whose pictures are looked at. `aspect`: width of a picture by its height. `verify`: simulate every
    recording again.
    """

    cameras: tuple[CameraSpec, ...] = ()
    aspect: float = 4.0 / 3.0
    verify: bool = False


def list_recordings(
    files: Sequence[Path], options: ListOptions | None = None, progress: Callable[[Path, str], None] | None = None
) -> Iterator[ListedRecording]:
    """Yield recordings with their episodes, without edits. One that cannot be read does not hide the others.

    Args:
        files: Recordings, as by `list_files`.
        options: What is listed.
        progress: Called now and then with a file and how far the work on it is.
    """
    options = options or ListOptions()
    first: tuple[Path, SessionHeader] | None = None
    for path in files:

        def say(text: str, path: Path = path) -> None:
            if progress is not None:
                progress(path, text)

        problems: list[str] = []
        try:
            if options.verify and not (report := verify_recording(path, lambda n, of: say(f"step {n} of {of}"))).ok:
                problems.append(f"does not verify: {report.line()}")
            with Recording.open(path, warn=False) as recording:
                header = msgspec.structs.replace(recording.header, model=b"")
                if first is not None and (difference := find_difference(header, first[1])):
                    problems.append(f"does not fit {first[0]} in one data set: {difference}")
                first = first or (path, header)
                listed = _list_recording(recording, options, problems, say)
        except RecordingError as error:
            yield ListedRecording(str(path), problems=(*problems, str(error)))
            continue
        yield listed


def attach_edits(listed: ListedRecording) -> ListedRecording:
    """Return a recording with the decisions that its curation has now."""
    if not listed.id:
        return listed
    try:
        curation = read_curation(listed.path, listed.id)
    except DatasetError as error:
        return msgspec.structs.replace(listed, problems=(*listed.problems, str(error)))
    known = {one.number for one in listed.episodes}
    unknown = [number for number in curation.episodes if number not in known]
    problems = [f"its curation names episode {number}, which it does not have" for number in unknown]
    episodes = tuple(
        msgspec.structs.replace(one, edit=curation.episodes.get(one.number, EpisodeCuration()))
        if one.is_editable
        else one
        for one in listed.episodes
    )
    return msgspec.structs.replace(listed, problems=(*listed.problems, *problems), episodes=episodes)


def read_lengths(listed: ListedRecording) -> tuple[Curation, dict[int, float]]:
    """Return the curation of a recording, and the length of each episode that can be edited, by number [s].

    Raises:
        DatasetError: The curation cannot be read.
    """
    lengths_s = {one.number: one.length_s for one in listed.episodes if one.is_editable}
    return read_curation(listed.path, listed.id), lengths_s


def _list_recording(
    recording: Recording, options: ListOptions, problems: list[str], say: Callable[[str], None]
) -> ListedRecording:
    builder, damage = build_summary(recording, lambda done, of: say(f"step {done} of {of}" if of else f"step {done}"))
    problems += [f"is damaged: {line}" for line in damage]
    found, summaries = recording.episodes, builder.list_episodes()
    if not found:  # it is exported as a whole
        begin_ns, end_ns = builder.begin_ns, builder.end_ns
        found = (RecordedEpisode(0, start_ns=begin_ns, end_ns=end_ns),)
        summaries = (
            EpisodeSummary(0, UNKNOWN, "", round(begin_ns * 1e-9, 3), round((end_ns - begin_ns) * 1e-9, 3), ""),
        )
    counted = _count_events(recording, found)
    measured = _Measures(recording, found, options, problems).measure(say)
    newest = {one.number: i for i, one in enumerate(found)}
    path = recording.files[0]
    rows = tuple(
        ListedEpisode(
            **{name: getattr(summary, name) for name in EpisodeSummary.__struct_fields__},
            **counts,
            **measures,
            recording=path,
            instruction=episode.instruction,
            is_editable=newest[episode.number] == i,
        )
        for i, (episode, summary, counts, measures) in enumerate(zip(found, summaries, counted, measured, strict=True))
    )
    name = recording.header.session_name
    return ListedRecording(path, identify_recording(recording), name, tuple(problems), rows)


# --- from events ------------------------------------------------------------------------------------------------------


def _count_events(recording: Recording, episodes: Sequence[RecordedEpisode]) -> list[dict[str, Any]]:
    """Return what the events say of each episode."""
    names: dict[str, str] = {}
    begun: dict[tuple[str, str], int] = {}  # by robot and participant
    engaged: list[tuple[int, int, str]] = []  # from, until, participant
    handovers: list[int] = []
    interventions: list[int] = []
    rejected: dict[tuple[str, str, str], list[tuple[int, int]]] = {}  # times and counts since the participant joined
    now_ns = 0
    for event in recording.events():
        body, now_ns = event.body, event.session_time
        match body:
            case ParticipantJoined(participant=info) | ParticipantChanged(participant=info):
                names[info.id] = info.name
            case EngagementChanged(robot=robot, participant=who, engaged=True):
                begun.setdefault((robot, who), now_ns)
            case EngagementChanged(robot=robot, participant=who):
                if (since_ns := begun.pop((robot, who), None)) is not None:
                    engaged.append((since_ns, now_ns, who))
            case Handover():
                handovers.append(now_ns)
            case Intervention(active=True):
                interventions.append(now_ns)
            case SamplesRejected(participant=who, device=device, reason=reason, count=count):
                rejected.setdefault((who, device, reason), []).append((now_ns, count))
    last_ns = max((one.end_ns for one in episodes), default=now_ns)
    engaged += [(since_ns, last_ns, who) for (_, who), since_ns in begun.items()]
    return [
        {
            "people": tuple(sorted({names.get(who, who) for _, _, who in _overlaps(engaged, one)})),
            "clutches": sum(one.start_ns <= since_ns < one.end_ns for since_ns, _, _ in engaged),
            "idle_share": round(1.0 - _join_spans(_overlaps(engaged, one)) / max(1, one.end_ns - one.start_ns), 4),
            "handovers": sum(one.start_ns <= at_ns <= one.end_ns for at_ns in handovers),
            "interventions": sum(one.start_ns <= at_ns <= one.end_ns for at_ns in interventions),
            "rejected": sum(_count_within(counts, one) for counts in rejected.values()),
        }
        for one in episodes
    ]


def _overlaps(engaged: Iterable[tuple[int, int, str]], episode: RecordedEpisode) -> list[tuple[int, int, str]]:
    """Return the parts of engagements that are within an episode."""
    cut = ((max(since, episode.start_ns), min(until, episode.end_ns), who) for since, until, who in engaged)
    return sorted(one for one in cut if one[0] < one[1])


def _join_spans(spans: Iterable[tuple[int, int, str]]) -> int:
    """Return how long at least one of the spans lasts, in order of their beginnings."""
    total = reached = 0
    for since, until, _ in spans:
        total += max(0, until - max(since, reached))
        reached = max(reached, until)
    return total


def _count_within(counts: Sequence[tuple[int, int]], episode: RecordedEpisode) -> int:
    """Return by how much a count rose within an episode; it begins anew when a participant joins again."""
    before, total = 0, 0
    for at_ns, count in counts:
        if episode.start_ns <= at_ns <= episode.end_ns:
            total += count - before if count >= before else count
        before = count
    return total


# --- from states ------------------------------------------------------------------------------------------------------


class _Moment(msgspec.Struct):
    """End effectors by robot [m], and those that each camera does not see, at one state."""

    tips: dict[str, NDArray[np.float64]]
    unseen: dict[str, frozenset[str]]


class _Measures:
    """Numbers of episodes from the states of their recording. `problems`: what could not be measured is added."""

    def __init__(
        self, recording: Recording, episodes: Sequence[RecordedEpisode], options: ListOptions, problems: list[str]
    ) -> None:
        self._recording, self._episodes = recording, episodes
        self._projections: dict[str, Projection] = {}
        self._scene: PosedScene | None = None
        self._bodies: object = None
        if not episodes:
            return
        try:
            self._scene = PosedScene(recording)
            self._tips = self._scene.make_tips(recording.header.robots)
            for camera in options.cameras:
                self._projections[camera.name] = Projection(self._scene, camera, options.aspect)
        except (PhysicsError, DatasetError) as error:
            problems.append(f"is not measured: {error}")
            self._scene = None

    def measure(self, say: Callable[[str], None]) -> list[dict[str, Any]]:
        """Return the numbers of each episode."""
        found = [_EpisodeMeasure(one) for one in self._episodes]
        if self._scene is None or not found:
            return [{} for _ in found]
        moments: dict[int, _Moment | None] = {}
        starts, first = [one.start_ns for one in self._episodes], 0
        for n, (state, after) in enumerate(pairwise(self._pad(self._recording.states()))):
            if n % _PROGRESS == 0:
                say(f"state {n}")
            while first < len(found) and self._episodes[first].end_ns <= state.session_time:
                first += 1
            around = found[first : bisect_left(starts, after.session_time)]
            if not around:
                continue
            here, there = (moments.get(one.session_time) or self._look(one) for one in (state, after))
            moments = {after.session_time: there}
            for one in around:
                one.add(state, here, after, there)
        return [one.finish(self._projections) for one in found]

    def _pad(self, states: Iterable[RecordedState]) -> Iterator[RecordedState]:
        """Yield states, and the last one again at the end of the last episode: nothing says that anything moved."""
        state = None
        for state in states:
            yield state
        end_ns = self._episodes[-1].end_ns
        if state is not None and state.session_time < end_ns:
            yield state._replace(session_time=end_ns)

    def _look(self, state: RecordedState) -> _Moment | None:
        """Return end effectors at a state; None for one of a scene that was loaded later."""
        scene = self._scene
        assert scene is not None
        if state.bodies is not self._bodies and state.bodies != scene.bodies:
            return None
        self._bodies = state.bodies  # the same object in all states of a scene
        scene.show(state.poses)
        tips = {name: np.array(tip.read_position(scene.data)) for name, tip in self._tips.items()}
        unseen = {
            camera: frozenset(name for name, tip in tips.items() if not projection.sees(tip))
            for camera, projection in self._projections.items()
        }
        return _Moment(tips, unseen)


class _EpisodeMeasure:
    """Numbers of one episode while states are added, two that follow each other at a time."""

    def __init__(self, episode: RecordedEpisode) -> None:
        self._episode = episode
        self.start_ns = episode.start_ns
        self._seen_ns = 0
        self._simulated_s = 0.0
        self._path_m: dict[str, float] = {}
        self._closest_m: float | None = None
        self._outside_ns: dict[str, int] = {}
        self._is_whole = True

    def add(self, state: RecordedState, here: _Moment | None, after: RecordedState, there: _Moment | None) -> None:
        """Add the time between two states."""
        if here is None or there is None:
            self._is_whole = False
            return
        begin_ns = max(state.session_time, self.start_ns)
        end_ns = min(after.session_time, self._episode.end_ns)
        if end_ns <= begin_ns:
            return
        share = (end_ns - begin_ns) / (after.session_time - state.session_time)
        self._seen_ns += end_ns - begin_ns
        is_reset = after.sim_time < state.sim_time
        self._simulated_s += 0.0 if is_reset else share * (after.sim_time - state.sim_time)
        for name, tip in here.tips.items():
            step_m = 0.0 if is_reset else share * float(np.linalg.norm(there.tips[name] - tip))
            self._path_m[name] = self._path_m.get(name, 0.0) + step_m
        for moment in (here, there) if after.session_time <= end_ns else (here,):
            for one, other in combinations(moment.tips.values(), 2):
                distance_m = float(np.linalg.norm(one - other))
                self._closest_m = distance_m if self._closest_m is None else min(self._closest_m, distance_m)
        robots = self._episode.robots or tuple(here.tips)
        for camera, unseen in here.unseen.items():
            if not unseen.isdisjoint(robots):
                self._outside_ns[camera] = self._outside_ns.get(camera, 0) + end_ns - begin_ns

    def finish(self, cameras: Iterable[str]) -> dict[str, Any]:
        """Return the numbers; none where some of it is in a scene that was loaded later, or has no states."""
        if not self._is_whole or not self._seen_ns:
            return {}
        return {
            "simulated_s": round(self._simulated_s, 3),
            "path_m": {name: round(path, 4) for name, path in self._path_m.items()},
            "closest_m": None if self._closest_m is None else round(self._closest_m, 4),
            "outside": {name: round(self._outside_ns.get(name, 0) / self._seen_ns, 4) for name in cameras},
        }
