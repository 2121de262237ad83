"""Reads a recording back exactly: header, journal, keyframes, states, events, raw samples; damaged files too.

A recording is `session.rrd` and, when its recorder was started anew, `session.part2.rrd` and so on. `Recording.open`
takes all of them; steps that two parts hold count once.
"""

from __future__ import annotations

import os
import tempfile
import warnings
from collections import deque
from collections.abc import Callable, Hashable, Iterator
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple, Self, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.common import Applied
from iris_session.protocol.server_messages import Event, PresenceItem
from iris_session.recording import paths, rrd_file
from iris_session.recording.errors import NotARecordingError
from iris_session.recording.journal import FORMAT, JournalRow, Keyframe, SessionHeader, open_blob, root_of, unpack_model
from iris_session.recording.messages import DenialRecord, EndMark, SceneModel, decode_header, decode_scene
from iris_session.recording.probe import Prober

_decode_event = msgspec.msgpack.Decoder(Event).decode
_decode_denial = msgspec.msgpack.Decoder(DenialRecord).decode
_decode_keyframe = msgspec.msgpack.Decoder(Keyframe).decode
_decode_end = msgspec.msgpack.Decoder(EndMark).decode
_decode_mark = msgspec.msgpack.Decoder(rrd_file.Mark).decode
_decode_presence = msgspec.msgpack.Decoder(tuple[PresenceItem, ...]).decode
_decode_applied = msgspec.msgpack.Decoder(tuple[Applied, ...]).decode


#: What decoding of bytes that mean something else may raise.
_UNREADABLE: Final = (msgspec.DecodeError, LookupError, TypeError, ValueError, ArithmeticError, NotImplementedError)
_T = TypeVar("_T")
#: A new part repeats at most what the feed's window held: minutes of rows.
REPEATED_ITEMS: Final = 200_000


class RawSample(NamedTuple):
    """A message of a client as it came. `receive_ns`: session time."""

    connection: int
    receive_ns: int
    data: bytes


class State(NamedTuple):
    """`poses`: float64 (n_bodies, 7) `x y z qw qx qy qz`, world frame, exactly as the session had them."""

    step: int
    tick: int
    sim_time: float
    session_time: int
    poses: NDArray[np.float64]
    presence: tuple[PresenceItem, ...]
    applied: tuple[Applied, ...]


class Recording:
    """An open recording. Use as a context manager, or `close` it: damaged parts have temporary copies.

    `damage`: one line per thing that could not be read. `missing`: one per part that ought to be there. `notes`: parts
    in which nothing is. `cuts`: parts that end in the middle of a write, as a kill leaves them. `root`: the chain value
    before the first row. `end`: as noted when
    the last part was closed, None when its recorder was killed or when a part is missing at the end.
    """

    def __init__(self, files: list[str]) -> None:
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.files: list[str] = []
        self._readable: list[str] = []
        self.damage: list[str] = []
        self.missing: list[str] = []
        self.notes: list[str] = []
        self.cuts: list[str] = []
        with Prober() as prober:
            for path in files:
                self._add_part(path, prober)
        self.header = self._header(files[0])
        ends = dict(self._items(paths.END, lambda batch: map(_decode_end, _values(batch, "end"))))
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
        if not os.path.isfile(first):
            raise NotARecordingError(f"there is no recording {first}")
        base, number = paths.split_part(first)
        folder = os.path.dirname(first)
        found = (paths.split_part(os.path.join(folder, name)) for name in os.listdir(folder or "."))
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
            return self._unique(paths.ROWS, _rows, lambda row: row.chain)

        def later(batch: Any) -> Iterator[JournalRow]:
            return _rows(batch) if max(_index(batch, paths.STEP), default=-1) > after else iter(())

        return (row for row in self._unique(paths.ROWS, later, lambda row: row.chain) if row.step > after)

    def count_rows(self) -> int:
        """Number of rows in the files, for showing progress."""
        return sum(batch.num_rows for _, batch in self._batches(paths.ROWS))

    def count_samples(self) -> int:
        """Number of raw messages in the files, for showing progress."""
        return sum(batch.num_rows for _, batch in self._batches(paths.SAMPLES))

    def keyframes(self) -> Iterator[Keyframe]:
        """The keyframes in order."""
        return self._unique(
            paths.KEYFRAMES,
            lambda batch: map(_decode_keyframe, _values(batch, "keyframe")),
            lambda keyframe: (keyframe.step, keyframe.chain),
        )

    def states(self) -> Iterator[State]:
        """Poses of all bodies at the state rate, with presence and the applied samples. Bodies: those of the header, or
        of the scene that was loaded last."""
        return self._unique(paths.STATE, _states, lambda state: state.session_time)

    def model(self, model_hash: str) -> bytes:
        """Binary form (mjb) of the model of a scene that was loaded in the session, else `LookupError`."""
        for _, scene in self._items(paths.MODELS, _models):
            if scene.model_hash == model_hash:
                return unpack_model(scene.model)
        raise LookupError(f"the recording does not hold the model {model_hash[:12]} of a scene that was loaded")

    def events(self) -> Iterator[Event]:
        """The shared history in order of `event_seq`."""
        return self._unique(
            paths.EVENTS, lambda batch: map(_decode_event, _values(batch, "event")), lambda event: event.event_seq
        )

    def denials(self) -> Iterator[DenialRecord]:
        """Every typed no, in order."""
        return self._unique(
            paths.DENIALS, lambda batch: map(_decode_denial, _values(batch, "denial")), lambda record: record
        )

    def samples(self) -> Iterator[RawSample]:
        """Raw messages of clients, in the order of receipt."""
        return (sample for _, sample in self._items(paths.SAMPLES, _samples))

    def metrics(self) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Per name: session times [ns] and values."""
        found: dict[str, tuple[list[int], list[float]]] = {}
        for _, batch in self._batches(f"{paths.METRICS}/**"):
            times, values = found.setdefault(_entity(batch).removeprefix(paths.METRICS + "/"), ([], []))
            times += _index(batch, paths.SESSION_TIME)
            values += _values(batch, "Scalars:scalars")
        return {name: (np.array(t, np.int64), np.array(v, np.float64)) for name, (t, v) in found.items()}

    def changed_spans(self) -> list[str]:
        """Spans of bytes that were changed since the recorder wrote them, wherever in the file; a line each."""
        marks: dict[int, list[rrd_file.Mark]] = {}
        for part, mark in self._items(paths.MARKS, lambda batch: map(_decode_mark, _values(batch, "mark"))):
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
        """Items of all parts; what a part repeats from the end of the one before counts once."""
        before: frozenset[Hashable] = frozenset()
        tail: deque[Hashable] = deque(maxlen=REPEATED_ITEMS)
        part = 0
        for i, item in self._items(entity, decode):
            if i != part:
                part, before = i, frozenset(tail)
            name = key(item)
            if name not in before:
                tail.append(name)
                yield item

    def _items(self, entity: str, decode: Callable[[Any], Iterator[_T]]) -> Iterator[tuple[int, _T]]:
        """Part number and item. What does not decode is left out with the rest of its chunk, and said in `damage`."""
        for i, batch in self._batches(entity):
            try:
                yield from ((i, item) for item in decode(batch))
            except _UNREADABLE as error:
                place = f"{os.path.basename(self.files[i])}: {entity}"
                line = f"{place} holds something damaged, which is left out: {_said(error)}"
                if line not in self.damage:
                    self.damage.append(line)

    def _batches(self, entity: str) -> Iterator[tuple[int, Any]]:
        """Part number (from 0) and record batch of an entity, over all parts in order."""
        for i, path in enumerate(self._readable):
            for chunk in rrd_file.chunks(path, entity):
                yield i, chunk.to_record_batch()

    def _add_part(self, path: str, prober: Prober) -> None:
        """A part that holds nothing (its recorder ended before the first write) is said, not fatal."""
        try:
            found = rrd_file.scan(path) if os.path.getsize(path) else None
            if found is None or not (found.messages or found.holes):
                self.notes.append(f"{os.path.basename(path)}: nothing was written into it")
                return
            if found.cut:
                self.cuts.append(f"{os.path.basename(path)}: ends in the middle of a write, at byte {found.good_bytes}")
            whole = found.good_bytes == found.size and not found.holes and prober.readable(path)
            self._readable.append(path if whole else self._salvaged(path, prober))
            self.files.append(path)
        except NotARecordingError as error:
            self.damage.append(str(error))

    def _salvaged(self, path: str, prober: Prober) -> str:
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="iris-recording-")
        name = os.path.basename(path)
        copy = os.path.join(self._folder.name, name)
        self.damage += [f"{name}: {line}" for line in rrd_file.salvage(path, copy, prober)]
        return copy

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

    def _header(self, path: str) -> SessionHeader:
        for _, batch in self._batches(paths.HEADER):
            try:
                blob, intact = open_blob(_values(batch, "blob")[0])
                header = decode_header(blob)
            except _UNREADABLE as error:
                raise NotARecordingError(f"the header of {path} is damaged: {_said(error)}") from error
            if header.format != FORMAT and intact:
                had = f"{path} was recorded in format {header.format} on {header.created_utc[:10] or 'an unknown day'}"
                raise NotARecordingError(f"{had}, this iris-session reads format {FORMAT}: use the one that made it")
            self.root = root_of(blob)
            if not intact:
                self.damage.append("header: its bytes were changed (checksum)")
            return header
        said = self.damage + self.notes
        why = f" ({said[0]})" if said else ": nothing was recorded, or it is not ours"
        raise NotARecordingError(f"{path} holds no session header{why}")


def _rows(batch: Any) -> Iterator[JournalRow]:
    n = batch.num_rows
    plant = _values(batch, "plant") if "plant" in batch.schema.names else [b""] * n
    columns = zip(
        _index(batch, paths.STEP),
        _index(batch, paths.SESSION_TIME),
        _values(batch, "n_ticks"),
        _values(batch, "entries"),
        _lists(batch, "entry_lengths"),
        _lists(batch, "entry_crcs"),
        _values(batch, "digest"),
        _values(batch, "chain"),
        _lists(batch, "field_crcs"),
        plant,
        strict=True,
    )
    return (JournalRow(*values) for values in columns)


def _models(batch: Any) -> Iterator[SceneModel]:
    for sealed in _values(batch, "scene"):
        blob, intact = open_blob(sealed)
        if not intact:
            raise ValueError("a model was changed (checksum)")
        yield decode_scene(blob)


def _states(batch: Any) -> Iterator[State]:
    decoders: tuple[tuple[str, Callable[[bytes], Any]], ...] = (
        ("presence", _decode_presence),
        ("applied", _decode_applied),
    )
    lists = batch.column("poses")
    ends = np.cumsum(np.asarray(lists.value_lengths(), np.intp))  # another scene has other bodies
    poses = [p.reshape(-1, 7) for p in np.split(np.asarray(lists.flatten(), np.float64), ends[:-1])]
    columns = zip(
        _index(batch, paths.STEP),
        _index(batch, paths.TICK),
        _values(batch, "sim_time_s"),
        _index(batch, paths.SESSION_TIME),
        poses,
        *(map(decode, _values(batch, name)) for name, decode in decoders),
        strict=True,
    )
    return (State(*values) for values in columns)


def _samples(batch: Any) -> Iterator[RawSample]:
    columns = (_values(batch, "connection"), _index(batch, paths.SESSION_TIME), _values(batch, "data"))
    return (RawSample(*values) for values in zip(*columns, strict=True))


def _values(batch: Any, column: str) -> list[Any]:
    """One value per row of a component column."""
    return list(_flat(batch, column).to_pylist())


def _lists(batch: Any, column: str) -> Iterator[tuple[Any, ...]]:
    """A tuple per row of a component column."""
    _flat(batch, column)
    return map(tuple, batch.column(column).to_pylist())


def _flat(batch: Any, column: str) -> Any:
    flat = batch.column(column).flatten()
    if flat.null_count:
        raise ValueError(f"{column} has {flat.null_count} values less than it ought to have")
    return flat


def _said(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _index(batch: Any, timeline: str) -> list[int]:
    """Integer values of a timeline (durations in nanoseconds)."""
    return [int(v) for v in np.asarray(batch.column(timeline).cast("int64"))]


def _entity(batch: Any) -> str:
    return str(batch.schema.metadata[b"rerun:entity_path"].decode())
