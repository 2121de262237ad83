"""Repair a recording: everything that can be read of it, in one file with an index, and what is lost.

All whole messages are kept as they were written, those after a fault too. The original is not changed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

import msgspec

from iris_session.journal.errors import RecorderError
from iris_session.recording.reader import Recording
from iris_session.recording.summary import build_summary
from iris_session.rrd import file as rrd_file
from iris_session.rrd import paths
from iris_session.rrd.rerun_tool import INDEX, rewrite
from iris_session.system.files import Replacement

#: Checksums over the bytes of a file are wrong in a copy that leaves out some of them, or has several files.
_WITHOUT_MARKS: Final = ("--drop-entity", paths.MARKS)


class RepairReport(msgspec.Struct, frozen=True):
    """Result of a repair.

    `path`: the original. `ok`: nothing inside is damaged or missing; `finished`: its recorder had closed it, so nothing
    is missing at the end either. `output`: the repaired file; `files`: the parts that are in it; `bytes`: its size.
    `steps`: rows in it; `duration_s`: session time from the first step to the last step or event.
    `lost_bytes`: bytes of the original that cannot be decoded, and are left out. `lost_steps`: rows that are missing
    before the last one, or before the end if the recording was closed; `lost_s`: session time that they span.
    `damage`: one line per place that is damaged, changed or missing. `cuts`: one line per part that ends in the middle
    of a message. `notes`: what else is unusual.
    """

    path: str
    ok: bool
    output: str
    files: tuple[str, ...]
    bytes: int
    steps: int
    duration_s: float
    finished: bool
    lost_bytes: int
    lost_steps: int
    lost_s: float
    damage: tuple[str, ...]
    cuts: tuple[str, ...]
    notes: tuple[str, ...]


def repair(
    path: str | Path,
    output: str | Path,
    *,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> RepairReport:
    """Write everything that can be read of a recording, its parts included, into one file with an index.

    Args:
        path: First file of the recording, or its folder.
        output: The file to write; it appears when it is complete.
        overwrite: Replace `output` if it exists.
        progress: Called as `progress(done, total)` with bytes of the original.

    Returns:
        What is in the file, and what is lost.

    Raises:
        NotARecordingError: Nothing of it can be read.
        RecorderError: `output` exists, is one of the files of the recording, or cannot be written, or the recording
            is being written.
        RerunToolError: Rerun cannot write what it can read.
        ImportError: Rerun is not installed.
    """
    with Recording.open(path, warn=False) as recording:
        if recording.is_being_written:
            raise RecorderError(f"{recording.files[0]} is being written: repair it afterwards")
        target = Path(output)
        _check_output(target, [*recording.files, *recording.unreadable_files], overwrite=overwrite)
        is_prefix = not recording.damage and len(recording.files) == 1
        try:
            with Replacement(target, permissions=None) as replacement:
                options = () if is_prefix else _WITHOUT_MARKS
                rewrite(INDEX, recording.readable_files, replacement.file, options=options, progress=progress)
        except OSError as error:
            raise RecorderError(f"{target} cannot be written: {error.strerror or error}") from error
        builder, damage = build_summary(recording)
        lost_bytes = sum(map(_count_lost_bytes, recording.files, recording.readable_files))
        lost_bytes += sum(map(os.path.getsize, recording.unreadable_files))
        lost_steps, lost_s = builder.count_lost_steps(recording.end)
        return RepairReport(
            path=str(path),
            ok=not damage,
            output=str(target),
            files=tuple(os.path.basename(file) for file in recording.files),
            bytes=target.stat().st_size,
            steps=builder.steps,
            duration_s=round((builder.end_ns - builder.begin_ns) * 1e-9, 3),
            finished=recording.finished,
            lost_bytes=lost_bytes,
            lost_steps=lost_steps,
            lost_s=round(lost_s, 3),
            damage=damage,
            cuts=tuple(recording.cuts),
            notes=tuple(recording.notes),
        )


def _check_output(target: Path, files: Iterable[str], *, overwrite: bool) -> None:
    """Raise `RecorderError` if `target` may not be written: a recording is never replaced by its repaired copy."""
    if any(target.exists() and os.path.samefile(target, file) for file in files):
        raise RecorderError(f"{target} is the recording itself, which is never changed: give another file")
    if target.is_dir():
        raise RecorderError(f"{target} is a folder: give a file")
    if target.exists() and not overwrite:
        raise RecorderError(f"{target} exists: give another file, or --force to replace it")


def _count_lost_bytes(path: str, readable: str) -> int:
    """Return the bytes of messages of a part that are not in the file it is read from."""
    if path == readable:
        return 0
    found, kept = rrd_file.scan_file(path), rrd_file.scan_file(readable)
    end = found.messages[-1] if found.messages and found.messages[-1].kind == rrd_file.KIND_END else None
    # The end message, an index and its tail hold nothing that was recorded.
    size = found.size if end is None else end.offset + found.size - found.good_bytes
    return size - kept.size
