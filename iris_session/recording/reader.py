"""Read a recording back exactly: header, journal, keyframes, states, events, raw samples; also from damaged files.

A recording is `session.rrd` and, if its recorder was restarted, `session.part2.rrd` and so on. `Recording.open` reads
all of them; steps that two parts hold count once. Copies made by Rerun's tools read like the original.
"""

from __future__ import annotations

import os
import warnings
from bisect import bisect_left
from collections.abc import Callable, Hashable, Iterator
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from iris_session.journal.errors import NotARecordingError
from iris_session.journal.messages import DenialRecord
from iris_session.journal.rows import JournalRow, Keyframe, unpack_model
from iris_session.protocol.server_messages import Event
from iris_session.recording.episodes import EpisodeCollector, RecordedEpisode
from iris_session.recording.folders import find_session_in
from iris_session.recording.parts import RecordingParts
from iris_session.rrd import batches, paths
from iris_session.rrd import file as rrd_file
from iris_session.rrd.assets import AssetCollector, AssetFault, AssetJoiner, AssetPiece, RecordedScene
from iris_session.rrd.batches import (
    FrameTime,
    RawSample,
    RecordedCloud,
    RecordedImage,
    RecordedState,
    RecordedStream,
    RowTimes,
    get_entity,
)
from iris_session.system.extras import require_package

#: Items of `Recording.outline`.
OutlineItem = Event | DenialRecord | RowTimes | FrameTime | RecordedStream | RecordedScene | AssetPiece | AssetFault
_Frame = TypeVar("_Frame", RecordedCloud, RecordedImage)
_ASSETS: Final = (paths.ASSET_SCENES, paths.ASSETS, paths.ASSET_FAULTS)
_OUTLINE: Final = (
    *_ASSETS,
    *(paths.EVENTS, paths.DENIALS, paths.ROWS),
    *(f"{folder}/**" for folder in (paths.CLOUDS, paths.PICTURES, paths.STREAMS)),
)


class Recording(RecordingParts):
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
        damage: One line per place that could not be read, at most `MOST_DAMAGE`. Reading on may add lines.
        missing: One line per missing part, or range of parts.
        notes: One line per empty part.
        cuts: One line per part that ends in the middle of a write, as a kill leaves it.
        is_being_written: A process was writing the recording when it was opened. What it has written so far is read,
            from a copy.
    """

    def __init__(self, files: list[str]) -> None:
        super().__init__(files)
        try:
            ends = dict(self._iterate(paths.END, batches.decode_ends))
        except BaseException:
            self.close()
            raise
        self._n_closed = len(ends)
        self.end = ends.get(len(self.files) - 1)
        self.samples_left_out = sum(end.samples_left_out for end in ends.values())
        if self.end is not None and self.end.reason:
            self.notes.append(f"{self.end.reason[:200]}; the session may have gone on")

    @cached_property
    def all_closed(self) -> bool:
        """True if every part was closed by its recorder, so that nothing can be missing within. Not known, so false, of
        a copy by Rerun's tools, which may be of parts that were not."""
        return self._n_closed == len(self.files) and all(
            rrd_file.is_of_recorder(rrd_file.scan_file(self.files[part]), marks)
            for part, marks in self._read_marks().items()
        )

    @property
    def finished(self) -> bool:
        """True if the recorder closed the last part; otherwise its last 0.25 s (at rest 2 s) may be missing."""
        return self.end is not None

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
            return self._iterate_unique(paths.ROWS, batches.decode_rows, lambda row: row.chain)

        def later(batch: Any) -> Iterator[JournalRow]:
            return batches.decode_rows(batch) if max(batches.read_index(batch, paths.STEP)) > after else iter(())

        return (row for row in self._iterate_unique(paths.ROWS, later, lambda row: row.chain) if row.step > after)

    def count_rows(self) -> int:
        """Return the number of journal rows in the files, for progress reports; repeated rows count again."""
        found = self._iterate(paths.ROWS, lambda batch: iter((batches.decode_row_times(batch),)))
        return sum(len(times.steps) for _, times in found)

    def count_samples(self) -> int:
        """Return the number of raw messages in the files, for progress reports."""
        return sum(piece.num_rows for _, pieces in self._iterate_spans(paths.SAMPLES) for piece in pieces)

    def keyframes(self) -> Iterator[Keyframe]:
        """Yield the keyframes in order of steps, each once."""
        return self._iterate_unique(
            paths.KEYFRAMES, batches.decode_keyframes, lambda keyframe: (keyframe.step, keyframe.chain)
        )

    def states(self) -> Iterator[RecordedState]:
        """Yield the states of all bodies at the state rate, in order of time.

        While nothing moves by more than a micrometre for 2 s, there is a state every half minute, and the last one
        before the next motion.

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
        scenes = (scene for _, scene in self._iterate(paths.MODELS, batches.decode_models))
        loaded = [(scene.step if scene.session_time else -1, scene.bodies) for scene in scenes]
        loaded.sort(key=lambda scene: scene[0])
        before = [step for step, _ in loaded]  # for each scene, the newest step before it was loaded
        bodies = [self.header.bodies, *(bodies for _, bodies in loaded)]
        for state in self._iterate_unique(paths.STATE, batches.decode_states, lambda state: state.session_time):
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
        for _, scene in self._iterate(paths.MODELS, batches.decode_models):
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
        return self._iterate_unique(paths.ASSET_SCENES, batches.decode_asset_scenes, lambda scene: scene)

    def assets(self) -> Iterator[tuple[str, bytes]]:
        """Yield hash and bytes of the assets of the scenes that are whole, each once, in one pass over the files.

        Raises:
            NotARecordingError: A file can no longer be read.
        """
        joiner = AssetJoiner()
        for _, piece in self._iterate(paths.ASSETS, batches.decode_asset_pieces):
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
        return self._iterate_unique(paths.EVENTS, batches.decode_events, lambda event: event.event_seq)

    @property
    def episodes(self) -> tuple[RecordedEpisode, ...]:
        """The episodes in order, discarded ones too: number, task, label, starter, session times and robots."""
        found, end_ns = EpisodeCollector(), 0
        for event in self.events():
            found.add(event)
            end_ns = event.session_time
        if (episodes := found.list_episodes()) and not episodes[-1].ended:
            for _, times in self._iterate(paths.ROWS, lambda batch: iter([batches.decode_row_times(batch)])):
                end_ns = max(end_ns, int(times.session_times.max(initial=0)))
        return found.list_episodes(end_ns)

    def denials(self) -> Iterator[DenialRecord]:
        """Yield the denials that participants received, in order, each once."""
        return (
            record
            for _, record in self._iterate_unique(paths.DENIALS, batches.numbered_denial_decoder(), lambda pair: pair)
        )

    def samples(self) -> Iterator[RawSample]:
        """Yield the raw messages of clients, undecoded, in the order of receipt."""
        return (sample for _, sample in self._iterate(paths.SAMPLES, batches.decode_samples))

    def clouds(self, stream: str = "") -> Iterator[RecordedCloud]:
        """Yield the recorded frames of point clouds, exactly as they were sent.

        Args:
            stream: Name of a stream; empty: of all streams.

        Returns:
            Iterator over frames, those of one stream in the order of its `seq`, each once.

        Raises:
            NotARecordingError: A file can no longer be read.
        """
        return self._media(paths.CLOUDS, stream, batches.decode_clouds)

    def pictures(self, stream: str = "") -> Iterator[RecordedImage]:
        """Yield the recorded pictures of cameras, as `clouds` does."""
        return self._media(paths.PICTURES, stream, batches.decode_pictures)

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
        return (one for _, one in self._iterate(f"{paths.STREAMS}/{stream or '**'}", batches.decode_streams))

    def _media(self, folder: str, stream: str, decode: Callable[[Any], Iterator[_Frame]]) -> Iterator[_Frame]:
        entity = f"{folder}/{stream or '**'}"
        return self._iterate_unique(entity, decode, lambda frame: (frame.stream, frame.seq, frame.capture_ns))

    def metrics(self) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Return the plotted values by name.

        Returns:
            Per name, without the leading `/metrics/`: session times [ns], shape (n,) int64, and values, shape (n,)
            float64, in the unit of the metric.

        Raises:
            NotARecordingError: A file can no longer be read.
        """
        found: dict[str, tuple[list[int], list[float]]] = {}
        for _, scalar in self._iterate(f"{paths.METRICS}/**", batches.decode_scalars):
            times, values = found.setdefault(scalar.entity.removeprefix(paths.METRICS + "/"), ([], []))
            times.append(scalar.session_time)
            values.append(scalar.value)
        return {name: (np.array(t, np.int64), np.array(v, np.float64)) for name, (t, v) in found.items()}

    def outline(self) -> Iterator[OutlineItem]:
        """Yield what a summary needs, in one pass over the files; a pass takes most of the time of any reading.

        Returns:
            Iterator over events and denials, each once; times of the rows of the journal, where steps that two parts
            hold come twice; numbers and times of the frames of clouds and pictures, each once; their descriptions; and
            scenes, pieces of assets, and assets that could not be recorded. Those of one kind are in order.

        Raises:
            NotARecordingError: A file can no longer be read.
        """
        return (item for _, item in self._iterate_unique(_OUTLINE, _outline_decoder(), lambda pair: pair[0]))

    def changed_spans(self) -> list[str]:
        """Compare the bytes of all parts with the recorder's checksums.

        Returns:
            One line per span of bytes that changed since the recorder wrote it, anywhere in the file. Empty for
            files that another tool has rewritten.

        Raises:
            NotARecordingError: A file can no longer be read.
        """
        closed = {part for part, _ in self._iterate(paths.END, batches.decode_ends)}
        return [
            f"{os.path.basename(self.files[part])}: {line}"
            for part, noted in self._read_marks().items()
            for line in rrd_file.changed_spans(self.files[part], noted, closed=part in closed)
        ]

    def _read_marks(self) -> dict[int, list[rrd_file.Mark]]:
        """Return the recorder's checksums by part."""
        marks: dict[int, list[rrd_file.Mark]] = {}
        for part, mark in self._iterate(paths.MARKS, batches.decode_marks):
            marks.setdefault(part, []).append(mark)
        return marks

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def check_assets(recording: Recording) -> AssetCollector:
    """Return what is there of the assets of the scenes, and what is damaged.

    Raises:
        NotARecordingError: A file can no longer be read.
    """
    collector = AssetCollector()
    for _, item in recording._iterate_unique(_ASSETS, _outline_decoder(), lambda pair: pair[0]):
        collector.add(item)
    return collector


_DECODE_ASSETS: Final[dict[str, Callable[[Any], Iterator[Any]]]] = {
    paths.ASSET_SCENES: batches.decode_asset_scenes,
    paths.ASSETS: batches.decode_asset_pieces,
    paths.ASSET_FAULTS: batches.decode_asset_faults,
}


def _outline_decoder() -> Callable[[Any], Iterator[tuple[Hashable, Any]]]:
    """Return a decoder of the entities of an outline: key of what counts once, and item."""
    decode_denials = batches.numbered_denial_decoder()

    def decode(batch: Any) -> Iterator[tuple[Hashable, Any]]:
        entity = get_entity(batch)
        if entity == paths.EVENTS:
            yield from ((event.event_seq, event) for event in batches.decode_events(batch))
        elif entity == paths.DENIALS:
            yield from ((pair, pair[1]) for pair in decode_denials(batch))
        elif entity.startswith(paths.STREAMS + "/"):
            yield from (((entity, one.session_time, one.info is None), one) for one in batches.decode_streams(batch))
        elif entity.startswith((paths.CLOUDS + "/", paths.PICTURES + "/")):
            frames = batches.decode_frame_times(batch)
            yield from (((entity, one.seq, one.capture_ns), one) for one in frames)
        elif entity in _DECODE_ASSETS:
            rows = batch.column(batches.ROW_ID).to_pylist()
            yield from (((entity, row), one) for row, one in zip(rows, _DECODE_ASSETS[entity](batch), strict=True))
        else:
            yield (entity, batch.column(batches.ROW_ID)[0].as_py()), batches.decode_row_times(batch)

    return decode
