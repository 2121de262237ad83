"""Copies of sessions for the Rerun viewer: all files of a session as one recording, in few large chunks, with an index.

The copy lies beside the recording (`session.view.rrd`) and is made anew when a file of the session has changed: its own
time of change is that of the newest file that it was made from. It is no evidence, and nothing reads it as a recording.
Where it cannot be written, it is made in a temporary folder.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO, Final

import msgspec
import psutil

from iris_session.journal.errors import NotARecordingError, RecorderError
from iris_session.recording.folders import list_session_files, split_file_name
from iris_session.recording.reader import Recording
from iris_session.rrd import file as rrd_file
from iris_session.rrd import paths
from iris_session.rrd.rerun_tool import INDEX, OPTIMIZE, rewrite
from iris_session.system.files import Replacement

#: Memory that `rerun rrd optimize` takes for each byte, and the share of the free memory that it may take. A session
#: that needs more gets an index, and stays in small chunks.
OPTIMIZE_FACTOR: Final = 3.5
MEMORY_SHARE: Final = 0.7
#: A single file with an index opens as quickly as a copy of it if it is not larger.
DIRECT_BYTES: Final = 16 << 20


class ViewFile(msgspec.Struct, frozen=True):
    """A file for the viewer.

    `path`: the file. `session`: first file of the session. `files`: those that it shows, in order. `made`: it is new.
    `kept`: it stays when the viewer has ended. `damage`: one line per place of the originals that is damaged or
    missing; empty if the file is not new. `notes`: what else is unusual.
    """

    path: Path
    session: Path
    files: tuple[Path, ...]
    made: bool = False
    kept: bool = True
    damage: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@contextmanager
def open_view_file(path: Path, progress: Callable[[int, int], None] | None = None) -> Iterator[ViewFile]:
    """Yield a file that the viewer opens at once: the copy beside the session, a temporary one, or the file itself.

    Args:
        path: Any file of a session.
        progress: Called as `progress(done, total)` with bytes of the originals, while a copy is made.

    Raises:
        NotARecordingError: `path` does not exist, or nothing of the session can be read.
        RecorderError: No copy can be written, not even a temporary one.
        RerunToolError: Rerun cannot make the copy.
        ImportError: Rerun is not installed.
    """
    if not path.is_file():
        raise NotARecordingError(f"there is no recording {path}")
    try:
        files = list_session_files(path)
    except OSError as error:
        raise NotARecordingError(f"{path.parent} cannot be read: {error.strerror or error}") from error
    if not files:
        raise NotARecordingError(f"{path} is no recording: give a session{paths.SUFFIX}")
    session = path.with_name(split_file_name(path.name)[0])
    copy = Path(paths.view_path(str(session)))
    newest_ns = max(file.stat().st_mtime_ns for file in files)
    if _opens_at_once(files):
        yield ViewFile(files[0], session, tuple(files))
        return
    if copy.is_file() and copy.stat().st_mtime_ns == newest_ns:
        yield ViewFile(copy, session, tuple(files))
        return
    with ExitStack() as temporary:
        with ExitStack() as opened:
            recordings, damage, notes = _open_recordings(files, opened)
            sources = [part for recording in recordings for part in recording.readable_files]
            read = tuple(Path(file) for recording in recordings for file in recording.files)
            kept = True
            try:
                # One of a damaged session is made again next time: who looks then is to hear of the damage, too.
                _write_copy(copy, sources, 0 if damage else newest_ns, progress)
            except OSError as error:
                notes.append(f"{copy} cannot be written ({error.strerror or error}): the copy is temporary")
                try:
                    folder = temporary.enter_context(tempfile.TemporaryDirectory(prefix="iris-view-"))
                    copy, kept = Path(folder, copy.name), False
                    _write_copy(copy, sources, newest_ns, progress)
                except OSError as second:
                    raise RecorderError(f"{notes[-1]}, but cannot be written: {second.strerror or second}") from second
        yield ViewFile(copy, session, read, made=True, kept=kept, damage=tuple(damage), notes=tuple(notes))


def _opens_at_once(files: Sequence[Path]) -> bool:
    """Return whether a session is a single whole file with an index, and not too large for the viewer as it is."""
    if len(files) > 1 or files[0].stat().st_size > DIRECT_BYTES:
        return False
    found = rrd_file.scan_file(files[0])
    return found.indexed and found.good_bytes == found.size and not found.holes


def _open_recordings(files: Sequence[Path], stack: ExitStack) -> tuple[list[Recording], list[str], list[str]]:
    """Open the recordings of a session. Return those that can be read, what is damaged, and what is unusual."""
    first: dict[int, Path] = {}
    for file in files:
        first.setdefault(split_file_name(file.name)[1], file)
    recordings: list[Recording] = []
    damage: list[str] = []
    notes: list[str] = []
    for file in first.values():
        try:
            recording = stack.enter_context(Recording.open(file, warn=False))
        except NotARecordingError as error:
            damage.append(str(error))
            continue
        recordings.append(recording)
        damage += recording.missing + recording.damage
        notes += recording.notes + recording.cuts
        if recording.is_being_written:
            notes.append(f"{file.name} is still being written: the copy shows it as it is now")
    if not recordings:
        raise NotARecordingError(damage[0])
    return recordings, damage, notes


def _write_copy(
    copy: Path, sources: Sequence[str], newest_ns: int, progress: Callable[[int, int], None] | None
) -> None:
    """Write the copy as a whole. Raises `OSError` if it cannot be written."""
    size = sum(os.path.getsize(source) for source in sources)
    fits = size * OPTIMIZE_FACTOR < MEMORY_SHARE * psutil.virtual_memory().available
    with Replacement(copy, permissions=None) as replacement:
        _check_room(replacement.file, size)
        rewrite(OPTIMIZE if fits else INDEX, sources, replacement.file, progress=progress)
        os.utime(replacement.file.fileno(), ns=(newest_ns, newest_ns))


def _check_room(file: BinaryIO, n_bytes: int) -> None:
    """Raise `OSError` if the disk of a file has no room: Rerun would only say that its output ended."""
    disk = os.fstatvfs(file.fileno())
    if disk.f_bavail * disk.f_frsize < n_bytes + (n_bytes >> 3):
        raise OSError(f"the disk has no room for {n_bytes / 1e6:.0f} MB")
