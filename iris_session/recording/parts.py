"""Files of a recording, opened for reading: parts in order, temporary copies of damaged ones, and their rows.

Nothing here knows what a row means: `reader.py` gives the decoders. The header is read here, because it tells which
files belong together.
"""

from __future__ import annotations

import os
import tempfile
import zlib
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise
from typing import Any, Final, TypeVar

import msgspec

from iris_session.journal.errors import NotARecordingError
from iris_session.journal.messages import decode_header, decode_header_copy
from iris_session.journal.rows import READ_FORMATS, VERIFIERS, SessionHeader, blob_root, open_blob, unpack_model
from iris_session.recording.lock import is_being_written
from iris_session.rrd import batches, paths
from iris_session.rrd import file as rrd_file
from iris_session.rrd.batches import UNREADABLE, get_entity, group_spans, join_pieces
from iris_session.rrd.rerun_tool import is_readable
from iris_session.rrd.salvage import salvage

_T = TypeVar("_T")
Entities = str | Sequence[str]
#: Maximum number of lines in `damage`: a file may be damaged in any number of places.
MOST_DAMAGE: Final = 200
MORE_DAMAGE: Final = "and more of it is damaged than is listed here"
#: Upper bound of the items that a new part repeats: the content of the feed's window, minutes of rows.
REPEATED_ITEMS: Final = 200_000


class RecordingParts:
    """Parts of a recording, open for reading until `close`.

    Attributes that are not described here are those of `Recording`.

    Attributes:
        readable_files: Files that the parts are read from, in order: a temporary copy of a damaged part.
    """

    def __init__(self, files: Sequence[str]) -> None:
        """Open files.

        Raises:
            NotARecordingError: They hold no session header, or were recorded in another format.
        """
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.files: list[str] = []
        self.unreadable_files: list[str] = []
        self.readable_files: list[str] = []
        self.damage: list[str] = []
        self.missing: list[str] = []
        self.notes: list[str] = []
        self.cuts: list[str] = []
        self.is_being_written = is_being_written(paths.split_part(files[0])[0])
        try:
            for path in files:
                self._add_part(path)
            self.header, self.root = self._read_header(files[0])
        except BaseException:
            self.close()
            raise
        self._find_missing(files)

    def close(self) -> None:
        """Remove the temporary copies of damaged parts. May be called twice."""
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _iterate_unique(
        self, entities: Entities, decode: Callable[[Any], Iterator[_T]], key: Callable[[_T], Hashable]
    ) -> Iterator[_T]:
        """Yield the items of all parts, each once: a part repeats the end of the one before, and a file that Rerun's
        tools have written may hold several parts.
        """
        newest: deque[Hashable] = deque()
        seen: set[Hashable] = set()
        for _, item in self._iterate(entities, decode):
            name = key(item)
            if name in seen:
                continue
            if len(newest) == REPEATED_ITEMS:
                seen.discard(newest.popleft())
            seen.add(name)
            newest.append(name)
            yield item

    def _iterate(self, entities: Entities, decode: Callable[[Any], Iterator[_T]]) -> Iterator[tuple[int, _T]]:
        """Yield part number and item. Undecodable items are skipped with the rest of their chunk, see `damage`."""
        for i, pieces in self._iterate_spans(entities):
            try:
                yield from ((i, item) for item in decode(join_pieces(pieces)))
            except UNREADABLE as error:
                place = f"{os.path.basename(self.files[i])}: {get_entity(pieces[0])}"
                self._record_damage(f"{place} holds something damaged, which is left out: {_format_error(error)}")

    def _iterate_spans(self, entities: Entities) -> Iterator[tuple[int, list[Any]]]:
        """Yield part number (from 0) and the record batches of some rows of one entity, over all parts in order."""
        for i, path in enumerate(self.readable_files):
            for pieces in group_spans(chunk.to_record_batch() for chunk in rrd_file.read_chunks(path, entities)):
                yield i, pieces

    def _add_part(self, path: str) -> None:
        """Add a part, if readable. A part without content (its recorder ended before the first write) is only noted."""
        try:
            found = rrd_file.scan_file(path) if os.path.getsize(path) else None
            if found is None or not (found.messages or found.holes):
                self.notes.append(f"{os.path.basename(path)}: nothing was written into it")
                return
            if self.is_being_written:
                self.readable_files.append(self._copy_start(path, found.good_bytes))
                self.files.append(path)
                return
            if found.cut:
                self.cuts.append(f"{os.path.basename(path)}: ends in the middle of a write, at byte {found.good_bytes}")
            whole = found.good_bytes == found.size and not found.holes and _is_readable(path, found)
            readable = path if whole else self._salvage(path)
        except NotARecordingError as error:
            self._record_damage(str(error))
            self.unreadable_files.append(path)
            return
        except OSError as error:
            self._record_damage(f"{path} cannot be read: {error.strerror or error}")
            return
        self.readable_files.append(readable)
        self.files.append(path)

    def _copy_start(self, path: str, n_bytes: int) -> str:
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

    def _salvage(self, path: str) -> str:
        with self._copying(path) as copy:
            damage = salvage(path, copy)
        self._record_damage(*(f"{os.path.basename(path)}: {line}" for line in damage))
        return copy

    def _record_damage(self, *lines: str) -> None:
        """Add lines to `damage`, each once, up to `MOST_DAMAGE`."""
        for line in lines:
            if len(self.damage) <= MOST_DAMAGE and line not in self.damage:
                self.damage.append(line if len(self.damage) < MOST_DAMAGE else MORE_DAMAGE)

    def _find_missing(self, files: Sequence[str]) -> None:
        """Note gaps in the part numbers of `files` (in order). A name may hold any number, so a gap is one line."""
        base = os.path.basename(paths.split_part(files[0])[0])
        for before, after in pairwise(paths.split_part(path)[1] for path in files):
            if after > before + 1:
                more = f" to {paths.part_path(base, after - 1)}" if after > before + 2 else ""
                self.missing.append(f"{paths.part_path(base, before + 1)}{more} is missing")

    def _iterate_blobs(self, entity: str) -> Iterator[tuple[int, bytes, bool]]:
        """Yield part, header and whether its bytes are as written. It is near the beginning, so reading is short."""
        for i, path in enumerate(self.readable_files):
            chunk = next(rrd_file.read_chunks(path, entity), None)
            if chunk is not None:
                with suppress(*UNREADABLE):
                    yield i, *open_blob(batches.read_values(chunk.to_record_batch(), "blob")[0])

    def _read_header(self, path: str) -> tuple[SessionHeader, bytes]:
        """Return the header, and the chain value that it gives."""
        changed: tuple[SessionHeader, bytes] | None = None
        fault = ""
        for _, blob, intact in self._iterate_blobs(paths.HEADER):
            try:
                header = decode_header(blob)
            except UNREADABLE as error:
                fault = fault or _format_error(error)
                continue
            if not intact:
                changed = changed or (header, blob_root(blob))
                continue
            if header.format not in READ_FORMATS:
                had = f"{path} was recorded in format {header.format} on {header.created_utc[:10] or 'an unknown day'}"
                right = VERIFIERS.get(header.format, "the one that made it")
                known = " and ".join(map(str, READ_FORMATS))
                raise NotARecordingError(
                    f"{had}, this iris-session reads formats {known}: verify or resume it with {right}"
                )
            self._leave_out_others(blob_root(blob))
            return header, blob_root(blob)
        found = self._restore_header(changed)
        if found is not None:
            return found
        if fault:
            raise NotARecordingError(f"the header of {path} is damaged: {fault}")
        if self.is_being_written and not self.unreadable_files:
            raise NotARecordingError(f"{path} is being written, and holds nothing to read yet")
        said = self.damage + self.notes
        why = f" ({said[0]})" if said else " (nothing was recorded, or it is not ours)"
        raise NotARecordingError(f"{path} holds no session header{why}: give the .rrd file of a session")

    def _restore_header(self, changed: tuple[SessionHeader, bytes] | None) -> tuple[SessionHeader, bytes] | None:
        """Return the header from its copy, with the model of `changed`, the header whose bytes were changed, if that
        is whole. Without a copy, as in files of earlier versions, return `changed`.
        """
        for _, blob, intact in self._iterate_blobs(paths.HEADER_COPY):
            with suppress(*UNREADABLE):
                copy = decode_header_copy(blob)
                if not intact or copy.header.format not in READ_FORMATS:
                    continue
                model = b"" if changed is None else changed[0].model
                try:
                    unpack_model(model)
                    lost = ""
                except zlib.error:
                    model, lost = b"", ", which has no model: the session cannot be simulated again"
                self._record_damage(f"header: damaged, and read from its copy{lost}")
                self._leave_out_others(copy.root)
                return msgspec.structs.replace(copy.header, model=model), copy.root
        if changed is not None:
            self._record_damage("header: its bytes were changed (checksum)")
        return changed

    def _leave_out_others(self, root: bytes) -> None:
        """Leave out parts with another header: files of another session that were moved into this folder."""
        for i, blob, intact in reversed(list(self._iterate_blobs(paths.HEADER))):
            if intact and blob_root(blob) != root:
                self._record_damage(f"{os.path.basename(self.files[i])} is of another session, and left out")
                del self.files[i], self.readable_files[i]


def _is_readable(path: str, found: rrd_file.Scan) -> bool:
    """Return whether a file decodes. One that got its index while it was read is read again."""
    if not is_readable(path) and (rrd_file.get_size(path) == found.size or not is_readable(path)):
        return False
    try:
        next(rrd_file.read_chunks(path, paths.HEADER), None)  # checks the index
    except NotARecordingError:
        return False
    return True


def _format_error(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
