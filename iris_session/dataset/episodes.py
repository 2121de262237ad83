"""Episodes of recordings: which become a data set, in which order, and as what.

They follow from the events of the recording and from its curation, a file beside it (`FILE.episodes.json`) that people
write and that never touches the recording. Nothing here simulates.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from iris_session.protocol.server_messages import Event, Intervention
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.recording import Recording, RecordingError, SessionHeader
from iris_session.recording.episodes import EpisodeCollector, RecordedEpisode
from iris_session.recording.folders import find_recordings
from iris_session.recording.records import read_names
from iris_session.rrd.batches import RowTimes

SUCCESS: Final = "success"
FAILURE: Final = "failure"
UNKNOWN: Final = "unknown"
#: What may be said of an episode that is exported.
LABELS: Final = (SUCCESS, FAILURE, UNKNOWN)
#: Ending of the curation of a recording, behind the name of its file.
CURATION_SUFFIX: Final = ".episodes.json"
#: Columns of a robot that have to be the same in all recordings of a set.
_ROBOT_FIELDS: Final = ("joints", "actuators", "site", "tip_body", "gripper_actuator", "gripper_open", "gripper_closed")
_CUT: Final = ", the recording ends in the middle of it"


class DatasetError(RecordingError):
    """The recordings cannot become one data set, or it cannot be written. One line says what would be right."""


class EpisodeCuration(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Decisions of people about one episode. `trim`: first and last moment that is kept, in seconds of simulated time
    since its beginning. `label`: one of `LABELS`. Empty: as in the recording.
    """

    drop: bool = False
    trim: tuple[float, float] | None = None
    label: str = ""
    task: str = ""


class Curation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Decisions about the episodes of one recording, by their numbers. `recording`: `identify_recording`."""

    recording: str
    episodes: dict[int, EpisodeCuration] = {}


class PlannedEpisode(msgspec.Struct, frozen=True):
    """An episode that is exported.

    Attributes:
        recording: Number of its recording in the plan.
        number: As in the session; 0: the whole of a recording without episodes.
        label: One of `LABELS`.
        task: Text of what was to be done.
        first_step, end_step: Its steps: from the first up to, not including, the last.
        trim: First and last moment that is exported [s of simulated time since its beginning]; None: all of it.
    """

    recording: int
    number: int
    label: str
    task: str
    first_step: int
    end_step: int
    trim: tuple[float, float] | None = None


class PlannedRecording(msgspec.Struct, frozen=True):
    """A recording of a plan. `id`: `identify_recording`. `people`: number of each participant in `Plan.people`, by id.

    `interventions`: robot, session time [ns], and whether a human took it from an agent then or gave it back.
    """

    path: str
    id: str
    people: dict[str, int]
    interventions: tuple[tuple[str, int, bool], ...]


class Plan(msgspec.Struct, frozen=True):
    """Episodes of a data set in their order.

    Attributes:
        recordings: All recordings, those without an exported episode too.
        episodes: What is exported.
        tasks: Their texts, each once, in the order of first use.
        people: Names of participants.
        notes: What was left out, one line each.
    """

    recordings: tuple[PlannedRecording, ...]
    episodes: tuple[PlannedEpisode, ...]
    tasks: tuple[str, ...]
    people: tuple[str, ...]
    notes: tuple[str, ...] = ()


class PlanOptions(msgspec.Struct, frozen=True):
    """Choice of episodes. `labels`: those that are exported. `task`: text for all that have no other in the curation.

    `anonymise`: names of participants become p1, p2 and so on, in texts of tasks too.
    """

    labels: tuple[str, ...] = (SUCCESS,)
    task: str = ""
    anonymise: bool = False


def refuse_folder(error: OSError) -> None:
    """Raise `DatasetError` for a folder that cannot be read."""
    raise DatasetError(f"the folder {error.filename} cannot be read: {error.strerror}") from error


def list_files(given: Sequence[Path], on_error: Callable[[OSError], None] = refuse_folder) -> list[Path]:
    """Return the recordings that files and folders name, each once, in the order of their names within a folder.

    `on_error`: called for every folder that cannot be read.

    Raises:
        DatasetError: Something does not exist, or a folder has no recording.
    """
    files: dict[str, Path] = {}
    unread: list[str] = []

    def note(error: OSError) -> None:
        unread.append(str(error.filename))
        on_error(error)

    for path in given:
        unread.clear()
        if not os.path.exists(path):
            raise DatasetError(f"{path} does not exist: give a recording (session.rrd), or a folder with recordings")
        found = find_recordings(path, note) if path.is_dir() else [path]
        if not found and not unread:
            raise DatasetError(f"there is no recording below the folder {path}: give one with .rrd files")
        files |= {os.path.realpath(one): one for one in found}
    return list(files.values())


def identify_recording(recording: Recording) -> str:
    """Return 32 hex digits that no other recording has: the chain value before its first row."""
    return recording.root.hex()


def find_curation(path: str | Path) -> Path:
    """Return where the curation of a recording is, or would be."""
    path = Path(path)
    return path.with_name(path.name + CURATION_SUFFIX)


def read_curation(path: str | Path, identity: str) -> Curation:
    """Return the curation of a recording; an empty one if there is none.

    Args:
        path: First file of the recording.
        identity: Its `identify_recording`.

    Raises:
        DatasetError: The file cannot be read, holds something else, or is of another recording.
    """
    path = find_curation(path)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return Curation(identity)
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror or error}") from error
    try:
        curation = msgspec.json.decode(data, type=Curation)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DatasetError(f"{path} is no curation of a recording: {error}") from error
    if curation.recording != identity:
        raise DatasetError(f"{path} is the curation of another recording ({curation.recording[:8]!r}): remove it")
    for number, one in curation.episodes.items():
        if one.label not in ("", *LABELS):
            raise DatasetError(f"{path}: episode {number} has the label {one.label!r:.40}: give {', '.join(LABELS)}")
        if one.trim is not None and not (0.0 <= one.trim[0] < one.trim[1] < math.inf):
            raise DatasetError(f"{path}: episode {number} has the trim {one.trim}: give two ascending times from 0 [s]")
    return curation


class _Reading(msgspec.Struct):
    """Everything of a recording that planning needs."""

    path: Path
    id: str
    name: str
    tick_period_ns: int
    robots: tuple[RobotSpec, ...]
    objects: tuple[ObjectSpec, ...]
    people: dict[str, str]
    curation: Curation
    episodes: tuple[RecordedEpisode, ...]
    times: RowTimes
    interventions: list[tuple[str, int, bool]]
    is_cut: bool


def make_plan(files: Sequence[Path], options: PlanOptions | None = None) -> Plan:
    """Plan a data set.

    Args:
        files: Recordings, as by `list_files`.
        options: Which episodes; None: successes.

    Raises:
        DatasetError: A recording with an episode to export differs from the first in what all of a set must have, or
            there is none.
        NotARecordingError: A file cannot be read as a recording.
    """
    options = options or PlanOptions()
    read = [_read(path) for path in files]
    names = list(dict.fromkeys(name or id for one in read for id, name in one.people.items()))
    hide = _make_replacement(names) if options.anonymise else str
    notes: list[str] = []
    takes_whole = not any(one.episodes for one in read)
    episodes = [
        episode for i, one in enumerate(read) for episode in _list_episodes(i, one, options, hide, notes, takes_whole)
    ]
    if not episodes:
        why = f": {'; '.join(notes[:3])}" if notes else ""
        raise DatasetError(f"there is no episode to export{why}; give other recordings, or --labels")
    first = read[episodes[0].recording]
    for one in (read[i] for i in dict.fromkeys(episode.recording for episode in episodes)):
        if difference := find_difference(one, first):
            raise DatasetError(
                f"{one.path} does not fit {first.path} in one data set: {difference}; give the recordings of one scene"
            )
    numbers = {name: i for i, name in enumerate(names)}
    recordings = tuple(
        PlannedRecording(
            str(one.path),
            one.id,
            {id: numbers[name or id] for id, name in one.people.items()},
            tuple(one.interventions),
        )
        for one in read
    )
    people = tuple(f"p{i + 1}" for i in range(len(names))) if options.anonymise else tuple(names)
    tasks = tuple(dict.fromkeys(one.task for one in episodes))
    return Plan(recordings, tuple(episodes), tasks, people, tuple(notes))


def find_difference(one: _Reading | SessionHeader, other: _Reading | SessionHeader) -> str:
    """Return in what two recordings differ that must be the same in one data set; empty: in nothing."""
    if one.tick_period_ns != other.tick_period_ns:
        return f"{1e9 / one.tick_period_ns:g} ticks a second, not {1e9 / other.tick_period_ns:g}"
    for kind, here, there in (("robots", one.robots, other.robots), ("objects", one.objects, other.objects)):
        names = [spec.name for spec in here], [spec.name for spec in there]
        if names[0] != names[1]:
            return f"{kind} {', '.join(names[0]) or 'none'}, not {', '.join(names[1]) or 'none'}"
    for mine, its in zip(one.robots, other.robots, strict=True):
        for field in _ROBOT_FIELDS:
            if (here := getattr(mine, field)) != (there := getattr(its, field)):
                return f"robot {mine.name!r} has {field} {here!r:.80}, not {there!r:.80}"
    return ""


def _read(path: Path) -> _Reading:
    """Read what planning needs, in one pass over the files besides that over the names."""
    with Recording.open(path, warn=False) as recording:
        header = recording.header
        rows: list[RowTimes] = []
        episodes = EpisodeCollector()
        interventions: list[tuple[str, int, bool]] = []
        for item in recording.outline():
            if isinstance(item, RowTimes):
                rows.append(item)
            elif isinstance(item, Event):
                episodes.add(item)
                if isinstance(body := item.body, Intervention):
                    interventions.append((body.robot, item.session_time, body.active))
        if not rows:
            raise DatasetError(f"{path} has no step: there is nothing to export")
        if recording.damage:
            raise DatasetError(
                f"{path} is damaged ({recording.damage[0]}): `iris-session recording repair {path} -o FILE` writes "
                "what is left of it"
            )
        steps, first = np.unique(np.concatenate([row.steps for row in rows]), return_index=True)
        times = RowTimes(steps, np.concatenate([row.session_times for row in rows])[first])
        return _Reading(
            *(path, identify_recording(recording), header.session_name, header.tick_period_ns),
            *(header.robots, header.objects, read_names(recording)),
            read_curation(recording.files[0], identify_recording(recording)),
            *(episodes.list_episodes(int(times.session_times[-1])), times, interventions),
            is_cut=not recording.finished,
        )


def _list_episodes(
    index: int, read: _Reading, options: PlanOptions, hide: Callable[[str], str], notes: list[str], takes_whole: bool
) -> Iterator[PlannedEpisode]:
    """Yield the episodes of a recording that are exported; note those that are not.

    `takes_whole`: one without any episode is exported as a whole.
    """
    where, steps, times = read.path.name, read.times.steps, read.times.session_times
    episodes = read.episodes
    if not episodes and not takes_whole:
        notes.append(f"{where} is left out: it has no episodes")
        return
    if not episodes:
        notes.append(f"{where} has no episodes: it is exported as a whole, with the label {UNKNOWN}")
        episodes = (RecordedEpisode(0, start_ns=int(times[0]), end_ns=int(times[-1])),)
    unknown = set(read.curation.episodes) - {one.number for one in episodes}
    if unknown:
        there_are = ", ".join(str(one.number) for one in episodes)
        raise DatasetError(f"{where} has no episode {min(unknown)}, which its curation names: it has {there_are}")
    newest = {one.number: one for one in episodes}  # one that was recorded again has the number of the discarded one
    for one in episodes:
        curated = read.curation.episodes.get(one.number) if newest[one.number] is one else None
        curated = curated or EpisodeCuration()
        label = curated.label or one.label
        is_cut = read.is_cut and not one.ended
        if curated.drop or (label not in options.labels and one.number):
            why = "dropped" if curated.drop else f"{label}{_CUT}" if is_cut else label
            notes.append(f"{where}: episode {one.number} is left out: {why}")
            continue
        first = int(np.searchsorted(times, one.start_ns))
        is_open = not one.ended and one.end_ns >= int(times[-1])
        end = len(times) if is_open else int(np.searchsorted(times, one.end_ns))
        if first >= end:
            notes.append(f"{where}: episode {one.number} is left out: it has no step")
            continue
        if is_cut:
            notes.append(f"{where}: episode {one.number} is not whole{_CUT}")
        task = hide(curated.task or options.task or one.instruction or one.task or one.text or read.name)
        span = int(steps[first]), int(steps[end - 1]) + 1
        yield PlannedEpisode(index, one.number, label, task, *span, curated.trim)


def _make_replacement(names: Sequence[str]) -> Callable[[str], str]:
    """Return a function that replaces names in a text by p1, p2, ..., whatever their case."""
    numbers = {name.lower(): i for i, name in reversed(list(enumerate(names, 1)))}
    longest_first = sorted(filter(None, numbers), key=len, reverse=True)
    if not longest_first:
        return str
    pattern = re.compile("|".join(map(re.escape, longest_first)), re.IGNORECASE)
    return lambda text: pattern.sub(lambda found: f"p{numbers.get(found[0].lower(), 0)}", text)
