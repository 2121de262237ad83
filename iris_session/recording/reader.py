"""Reads a recording back exactly: header, journal, keyframes, states, events, raw samples; damaged files too.

A recording is `session.rrd` and, when its recorder was started anew, `session.part2.rrd` and so on. `Recording.open`
takes all of them; steps that two parts hold count once. Copies that Rerun's tools have made read like the original.
"""

from __future__ import annotations

import os
import tempfile
import warnings
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Hashable, Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.server_messages import Event
from iris_session.recording import paths, rrd_file
from iris_session.recording import record_batches as items
from iris_session.recording.errors import NotARecordingError
from iris_session.recording.journal import (
    FORMAT,
    JournalRow,
    Keyframe,
    SessionHeader,
    blob_root,
    open_blob,
    unpack_model,
)
from iris_session.recording.messages import DenialRecord, decode_header
from iris_session.recording.probe import Prober
from iris_session.recording.record_batches import (
    UNREADABLE,
    RawSample,
    RecordedState,
    count_joined_rows,
    group_spans,
    join_pieces,
)

_T = TypeVar("_T")
#: Lines of `damage` at most: a file may be damaged in any number of places.
MOST_DAMAGE: Final = 200
MORE_DAMAGE: Final = "and more of it is damaged than is listed here"
#: A new part repeats at most what the feed's window held: minutes of rows.
REPEATED_ITEMS: Final = 200_000


class Recording:
    """An open recording. Use as a context manager, or `close` it: damaged parts have temporary copies.

    `damage`: one line per thing that could not be read, `MOST_DAMAGE` at most. `missing`: one per part that ought to be
    there. `notes`: parts in which nothing is, or more than one recording. `cuts`: parts that end in the middle of a
    write, as a kill leaves them. `root`: the chain value before the first row. `end`: as noted when the last part was
    closed, None when its recorder was killed or when a part is missing at the end.
    """

    def __init__(self, files: list[str]) -> None:
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.files: list[str] = []
        self._readable: list[str] = []
        self.damage: list[str] = []
        self.missing: list[str] = []
        self.notes: list[str] = []
        self.cuts: list[str] = []
        self._rewritten: set[str] = set()
        self._several: list[tuple[str, int]] = []  # files with more than one recording in them
        try:
            with Prober() as prober:
                for path in files:
                    self._add_part(path, prober)
            self.header = self._header(files[0])
            ends = dict(self._items(paths.END, items.decode_ends))
        except BaseException:
            self.close()
            raise
        one = f"session {self.header.session_name!r} of {self.header.created_utc or 'an unknown day'}"
        for name, n in self._several:
            self.notes.append(f"{name} holds {n} recordings: only {one} is read; make a file of each of the others")
        self._find_missing(files)
        self.end = ends.get(len(self.files) - 1)

    @property
    def finished(self) -> bool:
        """False when the recorder was killed: the newest quarter of a second may be missing."""
        return self.end is not None

    @classmethod
    def open(cls, path: str | Path, *, warn: bool = True) -> Recording:
        """Opens the recording whose first file (or only surviving part) is `path`.

        Later parts are found by their names, also behind one that is missing. Warns (`UserWarning`) of damage.

        Raises `NotARecordingError` with one line: no such file, no Rerun file, no session in it.
        """
        first = str(path)
        if os.path.isdir(first):
            raise NotARecordingError(f"{first} is a folder: name the first file of the recording in it, session.rrd")
        if not os.path.isfile(first):
            raise NotARecordingError(f"there is no recording {first}")
        base, number = paths.split_part(first)
        folder = os.path.dirname(first)
        try:
            names = os.listdir(folder or ".")
        except OSError as error:
            raise NotARecordingError(f"{folder} cannot be read: {error.strerror or error}") from error
        found = (paths.split_part(os.path.join(folder, name)) for name in names)
        later = sorted(part for stem, part in found if stem == base and part > number)
        recording = cls([first, *(paths.part_path(base, part) for part in later)])
        problems = recording.damage + recording.missing
        if problems and warn:
            more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
            warnings.warn(f"{first} is damaged: {problems[0]}{more}", stacklevel=2)
        return recording

    def rows(self, after: int | None = None) -> Iterator[JournalRow]:
        """The journal in order, or what comes after a step of it. Where rows are missing, `step` jumps."""
        if after is None:
            return self._unique(paths.ROWS, items.decode_rows, lambda row: row.chain)

        def later(batch: Any) -> Iterator[JournalRow]:
            return items.decode_rows(batch) if max(items.read_index(batch, paths.STEP)) > after else iter(())

        return (row for row in self._unique(paths.ROWS, later, lambda row: row.chain) if row.step > after)

    def count_rows(self) -> int:
        """Number of rows in the files, for showing progress."""
        return self._count(paths.ROWS)

    def count_samples(self) -> int:
        """Number of raw messages in the files, for showing progress."""
        return self._count(paths.SAMPLES)

    def keyframes(self) -> Iterator[Keyframe]:
        """The keyframes in order."""
        return self._unique(paths.KEYFRAMES, items.decode_keyframes, lambda keyframe: (keyframe.step, keyframe.chain))

    def states(self) -> Iterator[RecordedState]:
        """Poses of all bodies at the state rate, with presence and the applied samples."""
        # By steps, not times: the state of the row before a scene is later than that row, by the time that it took.
        # A scene from before the first row has time 0.
        scenes = (scene for _, scene in self._items(paths.MODELS, items.decode_models))
        loaded = [(scene.step if scene.session_time else -1, scene.bodies) for scene in scenes]
        loaded.sort(key=lambda scene: scene[0])
        before = [step for step, _ in loaded]  # the newest step that each was not yet there in
        bodies = [self.header.bodies, *(bodies for _, bodies in loaded)]
        for state in self._unique(paths.STATE, items.decode_states, lambda state: state.session_time):
            yield state._replace(bodies=bodies[bisect_left(before, state.step)])

    def model(self, model_hash: str) -> bytes:
        """Binary form (mjb) of the model of a scene that was loaded in the session, else `LookupError`."""
        for _, scene in self._items(paths.MODELS, items.decode_models):
            if scene.model_hash == model_hash:
                return unpack_model(scene.model)
        raise LookupError(f"the recording does not hold the model {model_hash[:12]} of a scene that was loaded")

    def events(self) -> Iterator[Event]:
        """The shared history in order of `event_seq`."""
        return self._unique(paths.EVENTS, items.decode_events, lambda event: event.event_seq)

    def denials(self) -> Iterator[DenialRecord]:
        """Every typed no, in order."""
        return (record for _, record in self._unique(paths.DENIALS, items.numbered_denial_decoder(), lambda pair: pair))

    def samples(self) -> Iterator[RawSample]:
        """Raw messages of clients, in the order of receipt."""
        return (sample for _, sample in self._items(paths.SAMPLES, items.decode_samples))

    def metrics(self) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Per name: session times [ns] and values."""
        found: dict[str, tuple[list[int], list[float]]] = {}
        for _, scalar in self._items(f"{paths.METRICS}/**", items.decode_scalars):
            times, values = found.setdefault(scalar.entity.removeprefix(paths.METRICS + "/"), ([], []))
            times.append(scalar.session_time)
            values.append(scalar.value)
        return {name: (np.array(t, np.int64), np.array(v, np.float64)) for name, (t, v) in found.items()}

    def changed_spans(self) -> list[str]:
        """Spans of bytes that were changed since the recorder wrote them, wherever in the file; a line each."""
        marks: dict[int, list[rrd_file.Mark]] = {}
        for part, mark in self._items(paths.MARKS, items.decode_marks):
            marks.setdefault(part, []).append(mark)
        return [
            f"{os.path.basename(self.files[part])}: {line}"
            for part, noted in marks.items()
            for line in rrd_file.changed_spans(self.files[part], noted)
        ]

    def close(self) -> None:
        """Removes temporary copies."""
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _unique(
        self, entity: str, decode: Callable[[Any], Iterator[_T]], key: Callable[[_T], Hashable]
    ) -> Iterator[_T]:
        """Items of all parts; what a part repeats from the end of the one before counts once. A file that Rerun's tools
        have rewritten may hold several parts: there, whatever comes again counts once."""
        before: frozenset[Hashable] = frozenset()
        tail: deque[Hashable] = deque(maxlen=REPEATED_ITEMS)
        seen: set[Hashable] = set()  # what of a rewritten file is in `tail`
        part = 0
        for i, item in self._items(entity, decode):
            if i != part:
                part, before = i, frozenset(tail)
            name = key(item)
            if name in before or name in seen:
                continue
            if self._readable[i] in self._rewritten:
                if len(tail) == REPEATED_ITEMS:
                    seen.discard(tail[0])
                seen.add(name)
            tail.append(name)
            yield item

    def _items(self, entity: str, decode: Callable[[Any], Iterator[_T]]) -> Iterator[tuple[int, _T]]:
        """Part number and item. What does not decode is left out with the rest of its chunk, and said in `damage`."""
        for i, pieces in self._spans(entity):
            try:
                yield from ((i, item) for item in decode(join_pieces(pieces)))
            except UNREADABLE as error:
                place = f"{os.path.basename(self.files[i])}: {entity}"
                self._harmed(f"{place} holds something damaged, which is left out: {_said(error)}")

    def _count(self, entity: str) -> int:
        return sum(count_joined_rows(pieces) for _, pieces in self._spans(entity))

    def _spans(self, entity: str) -> Iterator[tuple[int, list[Any]]]:
        """Part number (from 0) and the record batches of some rows of an entity, over all parts in order."""
        for i, path in enumerate(self._readable):
            for pieces in group_spans(chunk.to_record_batch() for chunk in rrd_file.read_chunks(path, entity)):
                yield i, pieces

    def _add_part(self, path: str, prober: Prober) -> None:
        """A part that holds nothing (its recorder ended before the first write) is said, not fatal."""
        try:
            found = rrd_file.scan_file(path) if os.path.getsize(path) else None
            if found is None or not (found.messages or found.holes):
                self.notes.append(f"{os.path.basename(path)}: nothing was written into it")
                return
            if found.cut:
                self.cuts.append(f"{os.path.basename(path)}: ends in the middle of a write, at byte {found.good_bytes}")
            whole = found.good_bytes == found.size and not found.holes and prober.is_readable(path)
            readable = path if whole else self._salvaged(path, prober)
        except NotARecordingError as error:
            self._harmed(str(error))
            return
        except OSError as error:
            self._harmed(f"{path} cannot be read: {error.strerror or error}")
            return
        if found.indexed:
            self._rewritten.add(readable)
            if whole and (n := prober.count_recordings(path)) > 1:
                self._several.append((os.path.basename(path), n))
        self._readable.append(readable)
        self.files.append(path)

    def _salvaged(self, path: str, prober: Prober) -> str:
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="iris-recording-")
        name = os.path.basename(path)
        copy = os.path.join(self._folder.name, name)
        try:
            self._harmed(*(f"{name}: {line}" for line in rrd_file.salvage(path, copy, prober)))
        except OSError as error:
            said = error.strerror or error
            raise NotARecordingError(
                f"{name} is damaged, and cannot be copied to {self._folder.name}: {said}"
            ) from error
        return copy

    def _harmed(self, *lines: str) -> None:
        """Each once, and no more than anybody reads."""
        for line in lines:
            if len(self.damage) <= MOST_DAMAGE and line not in self.damage:
                self.damage.append(line if len(self.damage) < MOST_DAMAGE else MORE_DAMAGE)

    def _find_missing(self, files: list[str]) -> None:
        """`files`: what was found, in order. A name may hold any number, so gaps are not counted out."""
        base = os.path.basename(paths.split_part(files[0])[0])
        numbers = [paths.split_part(path)[1] for path in files]
        for before, after in pairwise(numbers):
            first, last = paths.part_path(base, before + 1), paths.part_path(base, after - 1)
            if after == before + 2:
                self.missing.append(f"{first} is missing")
            elif after > before + 2:
                self.missing.append(f"{first} to {last} are missing")

    def _headers(self) -> Iterator[tuple[int, Any]]:
        """The header of each part that has one: a chunk near its beginning, so that nobody need read on."""
        for i, path in enumerate(self._readable):
            chunk = next(rrd_file.read_chunks(path, paths.HEADER), None)
            if chunk is not None:
                yield i, chunk.to_record_batch()

    def _header(self, path: str) -> SessionHeader:
        for _, batch in self._headers():
            try:
                blob, intact = open_blob(items.read_values(batch, "blob")[0])
                header = decode_header(blob)
            except UNREADABLE as error:
                raise NotARecordingError(f"the header of {path} is damaged: {_said(error)}") from error
            if header.format != FORMAT and intact:
                had = f"{path} was recorded in format {header.format} on {header.created_utc[:10] or 'an unknown day'}"
                raise NotARecordingError(f"{had}, this iris-session reads format {FORMAT}: use the one that made it")
            self.root = blob_root(blob)
            if intact:
                self._leave_out_others()
            else:
                self._harmed("header: its bytes were changed (checksum)")
            return header
        said = self.damage + self.notes
        why = f" ({said[0]})" if said else ": nothing was recorded, or it is not ours"
        raise NotARecordingError(f"{path} holds no session header{why}")

    def _leave_out_others(self) -> None:
        """A part with another header is of another session, whose file has come to lie here."""
        for i, batch in reversed(list(self._headers())):
            with suppress(*UNREADABLE):
                blob, intact = open_blob(items.read_values(batch, "blob")[0])
                if intact and blob_root(blob) != self.root:
                    self._harmed(f"{os.path.basename(self.files[i])} is of another session, and left out")
                    del self.files[i], self._readable[i]


def _said(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
