"""Recordings in folders: the files of a session, and the recordings below a folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from iris_session.journal.errors import NotARecordingError, RecorderError
from iris_session.rrd import paths

#: Sessions that an error names.
MOST_NAMED: Final = 3


def split_file_name(name: str) -> tuple[str, int, int]:
    """Return the first file of a session, the number of a resumed recording, and that of the part of it."""
    recording, part = paths.split_part(name)
    return *paths.split_resume(recording), part


def list_session_files(path: Path) -> list[Path]:
    """Return the files of the session that a file belongs to: those of resumed recordings and all parts, in order."""
    first = split_file_name(path.name)[0]
    found = ((*split_file_name(one.name), one) for one in path.parent.iterdir() if one.name.endswith(paths.SUFFIX))
    ordered = sorted((number, part, one) for stem, number, part, one in found if stem == first)
    return [one for _, _, one in ordered if one.is_file() and not paths.is_view_copy(one.name)]


def check_new_recording(path: Path) -> None:
    """Check that a new session may be recorded to a file: that readers would take it and all others for what they are.

    Raises:
        RecorderError: Its name is that of a part, a resumed recording or a copy for the viewer, or files of another
            session have the same name.
    """
    if split_file_name(path.name) != (path.name, 1, 1) or paths.is_view_copy(path.name):
        text = "names with .part, .resume and .view are those of files that belong to a recording"
        raise RecorderError(f"cannot record to {path}: {text}: choose another name")
    with suppress(OSError):  # no such folder, or one that cannot be read: the recorder says so
        if others := [one.name for one in list_session_files(path) if one != path]:
            raise RecorderError(
                f"cannot record to {path}: {others[0]} of another session is there: choose another name"
            )


def find_recordings(folder: Path, on_error: Callable[[OSError], None]) -> list[Path]:
    """Return the first file of every recording in a folder and the folders below it, in the order of their names.

    `on_error`: called for every folder that cannot be read.
    """
    walk = os.walk(folder, onerror=on_error)
    found = [file for where, _, names in walk for file in _select_first_parts(Path(where), names)]
    return sorted(found, key=lambda file: paths.split_part(str(file))[0])


def _select_first_parts(folder: Path, names: Iterable[str]) -> list[Path]:
    """Return those files of a folder that are the first parts of recordings, or the first of those that are left."""
    first: dict[str, tuple[int, Path]] = {}
    for name in names:
        base, part = paths.split_part(name)
        is_recording = name.endswith(paths.SUFFIX) and not paths.is_view_copy(name)
        if is_recording and (base not in first or part < first[base][0]):
            first[base] = part, folder / name
    return [file for _, file in first.values()]


def group_by_session(files: Sequence[Path]) -> list[list[Path]]:
    """Return recordings in groups of one session each, in order; the newest session is first."""
    sessions: dict[Path, list[Path]] = {}
    for file in sorted(files, key=lambda file: split_file_name(file.name)):
        sessions.setdefault(file.with_name(split_file_name(file.name)[0]), []).append(file)
    return sorted(sessions.values(), key=find_newest_s, reverse=True)


def find_newest_s(files: Sequence[Path]) -> float:
    """Return when the newest of some files was changed last [s since 1970]."""
    return max(map(_read_time_s, files))


def _read_time_s(file: Path) -> float:
    with suppress(OSError):  # removed meanwhile, or a link to nothing
        return file.stat().st_mtime
    return 0.0


def find_session_in(folder: Path) -> Path:
    """Return the first recording of the session in a folder: `session.rrd`, or that of the only session there.

    Raises:
        NotARecordingError: There is none, or there are several; the message says which files to give.
    """
    first = folder / paths.FIRST_FILE
    if first.is_file():
        return first
    try:
        here = group_by_session(_select_first_parts(folder, os.listdir(folder)))
    except OSError as error:
        raise NotARecordingError(f"the folder {folder} cannot be read: {error.strerror or error}") from error
    if len(here) == 1:
        return here[0][0]
    several = here or group_by_session(find_recordings(folder, lambda _: None))
    if not several:
        raise NotARecordingError(f"there is no recording below the folder {folder}: give a .rrd that `serve` wrote")
    what = f"holds {len(here)} sessions" if here else "holds no recording itself, only folders below it do"
    names = ", ".join(str(files[0]) for files in several[:MOST_NAMED])
    more = f" (and {len(several) - MOST_NAMED} more)" if len(several) > MOST_NAMED else ""
    raise NotARecordingError(f"the folder {folder} {what}: give one, newest first: {names}{more}")
