"""Read a recording back exactly: header, journal, keyframes, states, events, raw samples; also from damaged files.

A recording is `session.rrd` and, if its recorder was restarted, `session.part2.rrd` and so on. `Recording.open` reads
all of them; steps that two parts hold count once. Copies made by Rerun's tools read like the original.
"""

from __future__ import annotations

import os
import tempfile
import warnings
import zlib
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.server_messages import Event
from iris_session.recording import paths, record_batches, rrd_file
from iris_session.recording.errors import NotARecordingError
from iris_session.recording.folders import find_session_in
from iris_session.recording.journal import (
    FORMAT,
    VERIFIERS,
    JournalRow,
    Keyframe,
    SessionHeader,
    blob_root,
    open_blob,
    unpack_model,
)
from iris_session.recording.lock import describe_writers, find_writers
from iris_session.recording.messages import DenialRecord, decode_header, decode_header_copy
from iris_session.recording.probe import Prober
from iris_session.recording.record_batches import (
    UNREADABLE,
    DrawnVertices,
    FrameTime,
    RawSample,
    RecordedCloud,
    RecordedImage,
    RecordedState,
    RecordedStream,
    RowTimes,
    count_joined_rows,
    get_entity,
    group_spans,
    join_pieces,
)
from iris_session.recording.recorded_assets import (
    AssetCollector,
    AssetFault,
    AssetJoiner,
    AssetPiece,
    RecordedScene,
)
from iris_session.system.extras import require_package

#: Items of `Recording.outline`.
OutlineItem = (
    Event
    | DenialRecord
    | RowTimes
    | FrameTime
    | RecordedStream
    | DrawnVertices
    | RecordedScene
    | AssetPiece
    | AssetFault
)
_T = TypeVar("_T")
_Frame = TypeVar("_Frame", RecordedCloud, RecordedImage)
#: Maximum number of lines in `damage`: a file may be damaged in any number of places.
MOST_DAMAGE: Final = 200
MORE_DAMAGE: Final = "and more of it is damaged than is listed here"
#: Entities of the picture that are fixed to the world, deformables among them, in the first scenes of a part.
_DRAWN: Final = tuple(f"{paths.SCENE}/{n}/world/**" for n in range(1, 17))
_ASSETS: Final = (paths.ASSET_SCENES, paths.ASSETS, paths.ASSET_FAULTS)
_OUTLINE: Final = (
    *_ASSETS,
    *(paths.EVENTS, paths.DENIALS, paths.ROWS, *_DRAWN),
    *(f"{folder}/**" for folder in (paths.CLOUDS, paths.PICTURES, paths.STREAMS)),
)
#: Messages at the end of a file among which a recorder's last mark is: it, the end of the journal, and the end message.
LAST_MESSAGES: Final = 8
#: Upper bound of the items that a new part repeats: the content of the feed's window, minutes of rows.
REPEATED_ITEMS: Final = 200_000


class Recording:
    """A recording open for reading, all parts in order. Make it with `Recording.open`.

    Use it as a context manager, or call `close`: damaged parts have temporary copies. All times are session time in
    nanoseconds unless noted otherwise, all poses are in the world frame.

    Attributes:
        header: What is needed to understand and re-simulate the session: configuration, model, bodies, versions.
        files: Paths of the parts, in order; parts that cannot be read are left out.
        unreadable_files: Those of which nothing can be read.
        root: Chain value (16 bytes) before the first row.
        end: Step and chain of the newest row as noted when the last part was closed; None if its recorder was killed
            or a part is missing at the end.
        samples_left_out: Number of raw messages of clients that the recorder did not write, of parts that were closed:
            the disk was slow or nearly full, or the budget nearly used up. Those that the front left out before are
            only in the session's status. The journal has what the session used of them.
        all_closed: Every part was closed by its recorder, so that nothing can be missing within. Not known of a copy by
            Rerun's tools, which may be of parts that were not.
        damage: One line per place that could not be read, at most `MOST_DAMAGE`. Reading on may add lines.
        missing: One line per missing part, or range of parts.
        notes: One line per empty part and per file that holds more than one recording.
        cuts: One line per part that ends in the middle of a write, as a kill leaves it.
        writers: Processes that were writing the recording when it was opened, as far as the system lists them. What
            they have written so far is read, from a copy.
    """

    def __init__(self, files: list[str]) -> None:
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.files: list[str] = []
        self.unreadable_files: list[str] = []
        self._readable: list[str] = []
        self.damage: list[str] = []
        self.missing: list[str] = []
        self.notes: list[str] = []
        self.cuts: list[str] = []
        self.writers: list[int] = find_writers(paths.split_part(files[0])[0])
        self._rewritten: set[str] = set()
        self._several: list[tuple[str, int]] = []  # files with more than one recording in them
        try:
            with Prober() as prober:
                for path in files:
                    self._add_part(path, prober)
            self.header = self._header(files[0])
            ends = dict(self._items(paths.END, record_batches.decode_ends))
        except BaseException:
            self.close()
            raise
        one = f"session {self.header.session_name!r} of {self.header.created_utc or 'an unknown day'}"
        for name, n in self._several:
            self.notes.append(f"{name} holds {n} recordings: only {one} is read; make a file of each of the others")
        self._find_missing(files)
        self.end = ends.get(len(self.files) - 1)
        self.samples_left_out = sum(end.samples_left_out for end in ends.values())
        copied = self._rewritten and not self.damage  # a damaged file of a recorder counts as rewritten, too
        self.all_closed = len(ends) == len(self.files) and not copied
        if self.end is not None and self.end.reason:
            self.notes.append(f"{self.end.reason[:200]}; the session may have gone on")

    @property
    def finished(self) -> bool:
        """True if the recorder closed the last part; otherwise the last 0.25 s of the session may be missing."""
        return self.end is not None

    @property
    def readable_files(self) -> tuple[str, ...]:
        """Files that the parts are read from, in order, until `close`: a temporary copy of a damaged part."""
        return tuple(self._readable)

    @classmethod
    def open(cls, path: str | Path, *, warn: bool = True) -> Self:
        """Open a recording by its first file, or by the only part that is left of it.

        Later parts are found by their names, also after a missing one. A damaged part is read from a temporary copy of
        its readable messages; the file itself is never altered.

        Args:
            path: First file of the recording, usually `session.rrd`, or the folder of that file.
            warn: Issue a `UserWarning` if parts are damaged or missing.

        Returns:
            The open recording.

        Raises:
            NotARecordingError: There is no such file, it is not a Rerun file, it holds no session header, or it was
                recorded in another format; the message is one line.
            ImportError: Rerun is not installed; the message names the extra.
        """
        first = os.path.normpath(path)
        if os.path.isdir(first):
            first = str(find_session_in(Path(first)))
        if os.path.islink(first):
            first = os.path.realpath(first)  # later parts are beside the file, not beside the link
        if not os.path.isfile(first):
            raise NotARecordingError(f"there is no recording {first}")
        if paths.is_view_copy(first):
            right = first.removesuffix(paths.VIEW_SUFFIX) + paths.SUFFIX
            raise NotARecordingError(f"{first} is a copy for the viewer, not the recording: give {right}")
        require_package("rerun", "reading recordings")
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
        """Yield the rows of the journal in order of steps.

        Args:
            after: Step after which to begin; None begins at the first row.

        Returns:
            Iterator over rows, one per step, each once. `step` jumps where rows are missing. Rows that do not decode
            are left out and noted in `damage`.

        Raises:
            NotARecordingError: A file can no longer be read.
        """
        if after is None:
            return self._unique(paths.ROWS, record_batches.decode_rows, lambda row: row.chain)

        def later(batch: Any) -> Iterator[JournalRow]:
            return (
                record_batches.decode_rows(batch)
                if max(record_batches.read_index(batch, paths.STEP)) > after
                else iter(())
            )

        return (row for row in self._unique(paths.ROWS, later, lambda row: row.chain) if row.step > after)

    def count_rows(self) -> int:
        """Return the number of journal rows in the files, for progress reports; repeated rows count again."""
        return self._count(paths.ROWS)

    def count_samples(self) -> int:
        """Return the number of raw messages in the files, for progress reports."""
        return self._count(paths.SAMPLES)

    def keyframes(self) -> Iterator[Keyframe]:
        """Yield the keyframes in order of steps, each once."""
        return self._unique(
            paths.KEYFRAMES, record_batches.decode_keyframes, lambda keyframe: (keyframe.step, keyframe.chain)
        )

    def states(self) -> Iterator[RecordedState]:
        """Yield the states of all bodies at the state rate, in order of time.

        Returns:
            Iterator over states: `poses` (n_bodies, 7) float64, `x y z qw qx qy qz` ([m], unit quaternion), world
            frame, in the order of the state's own `bodies`, which change when a scene is loaded; presence of the
            participants and the applied samples with them. Of class open the poses are exact; of class closed, where
            the simulation gives the exact ones, they were rounded to float32 (0.1 um at 1 m).

        Raises:
            NotARecordingError: A file can no longer be read.
        """
        # By steps, not times: the state of the row before a scene is later than that row, by the duration of the step.
        # A scene that was loaded before the first row has time 0.
        scenes = (scene for _, scene in self._items(paths.MODELS, record_batches.decode_models))
        loaded = [(scene.step if scene.session_time else -1, scene.bodies) for scene in scenes]
        loaded.sort(key=lambda scene: scene[0])
        before = [step for step, _ in loaded]  # for each scene, the newest step before it was loaded
        bodies = [self.header.bodies, *(bodies for _, bodies in loaded)]
        for state in self._unique(paths.STATE, record_batches.decode_states, lambda state: state.session_time):
            yield state._replace(bodies=bodies[bisect_left(before, state.step)])

    def model(self, model_hash: str) -> bytes:
        """Return the MuJoCo model of a scene that was loaded in the session.

        Args:
            model_hash: As in `SceneLoaded`.

        Returns:
            The model in binary form (mjb).

        Raises:
            LookupError: The recording holds no such model.
            zlib.error: The stored model is damaged.
        """
        for _, scene in self._items(paths.MODELS, record_batches.decode_models):
            if scene.model_hash == model_hash:
                return unpack_model(scene.model)
        raise LookupError(f"the recording does not hold the model {model_hash[:12]} of a scene that was loaded")

    def scenes(self) -> Iterator[RecordedScene]:
        """Yield the scenes of the session, patched ones too, each with the hash of its specification, in order.

        Of patches that follow each other within a second, the last is there. Empty for files of versions that did not
        record them, and for sessions that share no scene.

        Raises:
            NotARecordingError: A file can no longer be read.
        """
        return self._unique(paths.ASSET_SCENES, record_batches.decode_asset_scenes, lambda scene: scene)

    def assets(self) -> Iterator[tuple[str, bytes]]:
        """Yield hash and bytes of the assets of the scenes that are whole, each once, in one pass over the files.

        Raises:
            NotARecordingError: A file can no longer be read.
        """
        joiner = AssetJoiner()
        for _, piece in self._items(paths.ASSETS, record_batches.decode_asset_pieces):
            data = joiner.add(piece)
            if data is not None:
                yield piece.address, data

    def asset(self, address: str) -> bytes:
        """Return an asset of a scene: a specification, a mesh, a texture.

        Args:
            address: Its SHA-256, as 64 hex digits: that of a scene, or one that is named in its specification.

        Returns:
            Its bytes, which have this hash.

        Raises:
            LookupError: The recording does not have it, or not whole.
            NotARecordingError: A file can no longer be read.
        """
        for found, data in self.assets():
            if found == address:
                return data
        raise LookupError(f"the recording does not hold the asset {address[:12]} as it was written")

    def events(self) -> Iterator[Event]:
        """Yield the events of the shared history in order of `event_seq`, each once."""
        return self._unique(paths.EVENTS, record_batches.decode_events, lambda event: event.event_seq)

    def denials(self) -> Iterator[DenialRecord]:
        """Yield the denials that participants received, in order, each once."""
        return (
            record
            for _, record in self._unique(paths.DENIALS, record_batches.numbered_denial_decoder(), lambda pair: pair)
        )

    def samples(self) -> Iterator[RawSample]:
        """Yield the raw messages of clients, undecoded, in the order of receipt."""
        return (sample for _, sample in self._items(paths.SAMPLES, record_batches.decode_samples))

    def clouds(self, stream: str = "") -> Iterator[RecordedCloud]:
        """Yield the recorded frames of point clouds, exactly as they were sent.

        Args:
            stream: Name of a stream; empty: of all streams.

        Returns:
            Iterator over frames, those of one stream in the order of its `seq`, each once.

        Raises:
            NotARecordingError: A file can no longer be read.
        """
        return self._media(paths.CLOUDS, stream, record_batches.decode_clouds)

    def pictures(self, stream: str = "") -> Iterator[RecordedImage]:
        """Yield the recorded pictures of cameras, as `clouds` does."""
        return self._media(paths.PICTURES, stream, record_batches.decode_pictures)

    def streams(self, stream: str = "") -> Iterator[RecordedStream]:
        """Yield what clouds and pictures are: descriptions as sources gave them, when they changed.

        Args:
            stream: Name of a stream; empty: of all streams.

        Returns:
            Iterator over descriptions, those of one stream in the order of time, the first one again at the beginning
            of each part. Empty for files of versions that did not record them.

        Raises:
            NotARecordingError: A file can no longer be read.
        """
        return (one for _, one in self._items(f"{paths.STREAMS}/{stream or '**'}", record_batches.decode_streams))

    def _media(self, folder: str, stream: str, decode: Callable[[Any], Iterator[_Frame]]) -> Iterator[_Frame]:
        entity = f"{folder}/{stream or '**'}"
        return self._unique(entity, decode, lambda frame: (frame.stream, frame.seq))

    def metrics(self) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Return the plotted values by name.

        Returns:
            Per name, without the leading `/metrics/`: session times [ns], shape (n,) int64, and values, shape (n,)
            float64, in the unit of the metric.

        Raises:
            NotARecordingError: A file can no longer be read.
        """
        found: dict[str, tuple[list[int], list[float]]] = {}
        for _, scalar in self._items(f"{paths.METRICS}/**", record_batches.decode_scalars):
            times, values = found.setdefault(scalar.entity.removeprefix(paths.METRICS + "/"), ([], []))
            times.append(scalar.session_time)
            values.append(scalar.value)
        return {name: (np.array(t, np.int64), np.array(v, np.float64)) for name, (t, v) in found.items()}

    def outline(self) -> Iterator[OutlineItem]:
        """Yield what a summary needs, in one pass over the files; a pass takes most of the time of any reading.

        Returns:
            Iterator over events and denials, each once; times of the rows of the journal, where steps that two parts
            hold come twice; numbers and times of the frames of clouds and pictures, each once; their descriptions; how
            often the vertices of elements of the picture are in the files; and scenes, pieces of assets, and assets
            that could not be recorded. Those of one kind are in order.

        Raises:
            NotARecordingError: A file can no longer be read.
        """
        return (item for _, item in self._unique(_OUTLINE, _outline_decoder(), lambda pair: pair[0]))

    def changed_spans(self) -> list[str]:
        """Compare the bytes of all parts with the recorder's checksums.

        Returns:
            One line per span of bytes that changed since the recorder wrote it, anywhere in the file. Empty for
            files that another tool has rewritten.

        Raises:
            NotARecordingError: A file can no longer be read.
        """
        marks: dict[int, list[rrd_file.Mark]] = {}
        for part, mark in self._items(paths.MARKS, record_batches.decode_marks):
            marks.setdefault(part, []).append(mark)
        closed = {part for part, _ in self._items(paths.END, record_batches.decode_ends)}
        return [
            f"{os.path.basename(self.files[part])}: {line}"
            for part, noted in marks.items()
            for line in rrd_file.changed_spans(self.files[part], noted, closed=part in closed)
        ]

    def close(self) -> None:
        """Remove the temporary copies of damaged parts. May be called twice."""
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
        self, entities: str | Sequence[str], decode: Callable[[Any], Iterator[_T]], key: Callable[[_T], Hashable]
    ) -> Iterator[_T]:
        """Yield the items of all parts; what a part repeats from the end of the previous one counts once.

        A file that Rerun's tools have rewritten may hold several parts: in it, every repeated item counts once.
        """
        before: frozenset[Hashable] = frozenset()
        tail: deque[Hashable] = deque(maxlen=REPEATED_ITEMS)
        seen: set[Hashable] = set()  # those keys in `tail` that came from a rewritten file
        part = 0
        for i, item in self._items(entities, decode):
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

    def _items(self, entities: str | Sequence[str], decode: Callable[[Any], Iterator[_T]]) -> Iterator[tuple[int, _T]]:
        """Yield part number and item. Undecodable items are skipped with the rest of their chunk, see `damage`."""
        for i, pieces in self._spans(entities):
            try:
                yield from ((i, item) for item in decode(join_pieces(pieces)))
            except UNREADABLE as error:
                place = f"{os.path.basename(self.files[i])}: {get_entity(pieces[0])}"
                self._harmed(f"{place} holds something damaged, which is left out: {_format_error(error)}")

    def _count(self, entity: str) -> int:
        return sum(count_joined_rows(pieces) for _, pieces in self._spans(entity))

    def _spans(self, entities: str | Sequence[str]) -> Iterator[tuple[int, list[Any]]]:
        """Yield part number (from 0) and the record batches of some rows of one entity, over all parts in order."""
        for i, path in enumerate(self._readable):
            for pieces in group_spans(chunk.to_record_batch() for chunk in rrd_file.read_chunks(path, entities)):
                yield i, pieces

    def _add_part(self, path: str, prober: Prober) -> None:
        """Add a part, if readable. A part without content (its recorder ended before the first write) is only noted."""
        try:
            found = rrd_file.scan_file(path) if os.path.getsize(path) else None
            if found is None or not (found.messages or found.holes):
                self.notes.append(f"{os.path.basename(path)}: nothing was written into it")
                return
            if self.writers:
                self._readable.append(self._copied(path, found.good_bytes))
                self.files.append(path)
                return
            if found.cut:
                self.cuts.append(f"{os.path.basename(path)}: ends in the middle of a write, at byte {found.good_bytes}")
            whole = found.good_bytes == found.size and not found.holes and _is_readable(path, found.size, prober)
            readable = path if whole else self._salvaged(path, prober)
        except NotARecordingError as error:
            self._harmed(str(error))
            self.unreadable_files.append(path)
            return
        except OSError as error:
            self._harmed(f"{path} cannot be read: {error.strerror or error}")
            return
        if found.indexed and not (whole and self._is_of_recorder(path, found)):
            self._rewritten.add(readable)
            if whole and (n := prober.count_recordings(path)) > 1:
                self._several.append((os.path.basename(path), n))
        self._readable.append(readable)
        self.files.append(path)

    def _is_of_recorder(self, path: str, found: rrd_file.Scan) -> bool:
        """Return whether a readable file with an index is a recorder's: one of its last marks is where it says."""
        last = found.messages[-LAST_MESSAGES:]
        infos = [m for m in found.messages[:-LAST_MESSAGES] if m.kind == rrd_file.KIND_STORE_INFO]
        with self._copying(path) as copy:
            rrd_file.copy_messages(path, [*infos, *(m for m in last if m.kind != rrd_file.KIND_END)], copy)
        places = {m.offset for m in last}
        with suppress(*UNREADABLE, NotARecordingError):
            for chunk in rrd_file.read_chunks(copy, paths.MARKS):
                if any(mark.end in places for mark in record_batches.decode_marks(chunk.to_record_batch())):
                    return True
        return False

    def _copied(self, path: str, n_bytes: int) -> str:
        """Copy the whole messages of a part that is being written: they stay the same while it is read."""
        with self._copying(path) as copy, open(path, "rb") as source, open(copy, "wb") as target:
            while n_bytes > 0 and (data := source.read(min(n_bytes, 1 << 20))):
                target.write(data)
                n_bytes -= len(data)
        return copy

    @contextmanager
    def _copying(self, path: str) -> Iterator[str]:
        """Yield the path of a temporary copy. Raises `NotARecordingError` if it cannot be written."""
        try:
            if self._folder is None:
                self._folder = tempfile.TemporaryDirectory(prefix="iris-recording-")
            yield os.path.join(self._folder.name, os.path.basename(path))
        except OSError as error:
            said = f"a temporary copy of {os.path.basename(path)} cannot be written: {error.strerror or error}"
            raise NotARecordingError(said) from error

    def _salvaged(self, path: str, prober: Prober) -> str:
        with self._copying(path) as copy:
            damage = rrd_file.salvage(path, copy, prober)
        self._harmed(*(f"{os.path.basename(path)}: {line}" for line in damage))
        return copy

    def _harmed(self, *lines: str) -> None:
        """Add lines to `damage`, each once, up to `MOST_DAMAGE`."""
        for line in lines:
            if len(self.damage) <= MOST_DAMAGE and line not in self.damage:
                self.damage.append(line if len(self.damage) < MOST_DAMAGE else MORE_DAMAGE)

    def _find_missing(self, files: list[str]) -> None:
        """Note gaps in the part numbers of `files` (in order). A name may hold any number, so a gap is one line."""
        base = os.path.basename(paths.split_part(files[0])[0])
        numbers = [paths.split_part(path)[1] for path in files]
        for before, after in pairwise(numbers):
            first, last = paths.part_path(base, before + 1), paths.part_path(base, after - 1)
            if after == before + 2:
                self.missing.append(f"{first} is missing")
            elif after > before + 2:
                self.missing.append(f"{first} to {last} are missing")

    def _headers(self, entity: str = paths.HEADER) -> Iterator[tuple[int, Any]]:
        """Yield part number and header of each part that has one: a chunk near its beginning, so reading is short."""
        for i, path in enumerate(self._readable):
            chunk = next(rrd_file.read_chunks(path, entity), None)
            if chunk is not None:
                yield i, chunk.to_record_batch()

    def _header(self, path: str) -> SessionHeader:
        changed: tuple[SessionHeader, bytes] | None = None
        fault = ""
        for _, batch in self._headers():
            try:
                blob, intact = open_blob(record_batches.read_values(batch, "blob")[0])
                header = decode_header(blob)
            except UNREADABLE as error:
                fault = fault or _format_error(error)
                continue
            if not intact:
                changed = changed or (header, blob_root(blob))
                continue
            if header.format != FORMAT:
                had = f"{path} was recorded in format {header.format} on {header.created_utc[:10] or 'an unknown day'}"
                right = VERIFIERS.get(header.format, "the one that made it")
                raise NotARecordingError(
                    f"{had}, this iris-session reads format {FORMAT}: verify or resume it with {right}"
                )
            self.root = blob_root(blob)
            self._leave_out_others()
            return header
        found = self._restore_header(changed)
        if found is not None:
            return found
        if fault:
            raise NotARecordingError(f"the header of {path} is damaged: {fault}")
        if self.writers and not self.unreadable_files:
            raise NotARecordingError(f"{path} {describe_writers(self.writers)}, and holds nothing to read yet")
        said = self.damage + self.notes
        why = f" ({said[0]})" if said else " (nothing was recorded, or it is not ours)"
        raise NotARecordingError(f"{path} holds no session header{why}: give the .rrd file of a session")

    def _restore_header(self, changed: tuple[SessionHeader, bytes] | None) -> SessionHeader | None:
        """Return the header from its copy, with the model of `changed`, the header whose bytes were changed, if that
        is whole. Without a copy, as in files of earlier versions, return `changed`. `changed` has its own root, too.
        """
        for _, batch in self._headers(paths.HEADER_COPY):
            with suppress(*UNREADABLE):
                blob, intact = open_blob(record_batches.read_values(batch, "blob")[0])
                copy = decode_header_copy(blob)
                if not intact or copy.header.format != FORMAT:
                    continue
                self.root = copy.root
                model = b"" if changed is None else changed[0].model
                try:
                    unpack_model(model)
                    lost = ""
                except zlib.error:
                    model, lost = b"", ", which has no model: the session cannot be simulated again"
                self._harmed(f"header: damaged, and read from its copy{lost}")
                self._leave_out_others()
                return msgspec.structs.replace(copy.header, model=model)
        if changed is None:
            return None
        header, self.root = changed
        self._harmed("header: its bytes were changed (checksum)")
        return header

    def _leave_out_others(self) -> None:
        """Leave out parts with another header: files of another session that were moved into this folder."""
        for i, batch in reversed(list(self._headers())):
            with suppress(*UNREADABLE):
                blob, intact = open_blob(record_batches.read_values(batch, "blob")[0])
                if intact and blob_root(blob) != self.root:
                    self._harmed(f"{os.path.basename(self.files[i])} is of another session, and left out")
                    del self.files[i], self._readable[i]


def check_assets(recording: Recording) -> AssetCollector:
    """Return what is there of the assets of the scenes, and what is damaged.

    Raises:
        NotARecordingError: A file can no longer be read.
    """
    collector = AssetCollector()
    for _, item in recording._unique(_ASSETS, _outline_decoder(), lambda pair: pair[0]):
        collector.add(item)
    return collector


_DECODE_ASSETS: Final[dict[str, Callable[[Any], Iterator[Any]]]] = {
    paths.ASSET_SCENES: record_batches.decode_asset_scenes,
    paths.ASSETS: record_batches.decode_asset_pieces,
    paths.ASSET_FAULTS: record_batches.decode_asset_faults,
}


def _outline_decoder() -> Callable[[Any], Iterator[tuple[Hashable, Any]]]:
    """Return a decoder of the entities of an outline: key of what counts once, and item."""
    decode_denials = record_batches.numbered_denial_decoder()

    def decode(batch: Any) -> Iterator[tuple[Hashable, Any]]:
        entity = get_entity(batch)
        if entity == paths.EVENTS:
            yield from ((event.event_seq, event) for event in record_batches.decode_events(batch))
        elif entity == paths.DENIALS:
            yield from ((pair, pair[1]) for pair in decode_denials(batch))
        elif entity.startswith(paths.STREAMS + "/"):
            yield from (
                ((entity, one.session_time, one.info is None), one) for one in record_batches.decode_streams(batch)
            )
        elif entity.startswith((paths.CLOUDS + "/", paths.PICTURES + "/")):
            yield from (((entity, one.seq), one) for one in record_batches.decode_frame_times(batch))
        elif entity in _DECODE_ASSETS:
            rows = batch.column(record_batches.ROW_ID).to_pylist()
            yield from (((entity, row), one) for row, one in zip(rows, _DECODE_ASSETS[entity](batch), strict=True))
        else:
            first = batch.column(record_batches.ROW_ID)[0].as_py()
            read = record_batches.decode_row_times if entity == paths.ROWS else record_batches.decode_drawn_vertices
            yield (entity, first), read(batch)

    return decode


def _is_readable(path: str, size: int, prober: Prober) -> bool:
    """Return whether a file that had `size` bytes decodes. One that got its index while it was read is read again."""
    return prober.is_readable(path) or (rrd_file.get_size(path) != size and prober.is_readable(path))


def _format_error(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
