"""Rerun's command line tool, which lies in the package of the SDK: find it, and rewrite recordings with `rerun rrd`.

The tool reads messages from its standard input, so damaged and several files need no temporary copy that joins them,
and progress can be shown. It is a process of its own: Rerun's decoder may abort on damaged bytes.
"""

from __future__ import annotations

import errno
import importlib.util
import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, BinaryIO, Final

from iris_session.recording.errors import RecordingError
from iris_session.recording.rrd_file import (
    END_MESSAGE,
    FILE_HEAD,
    ID_BYTES,
    KIND_END,
    KIND_STORE_INFO,
    RECORDING,
    RrdMessage,
    find_store_id,
    read_message,
    scan_file,
)
from iris_session.system.extras import require_package

#: What `rerun rrd` does with the messages: write them as they are with an index; merge them into few large ones too.
INDEX: Final = "filter"
OPTIMIZE: Final = "optimize"
#: The tail of a stream without an index: offset, length and XXH32 (seed 7850921) of nothing, and how many indexes.
_TAIL: Final = struct.pack("<QQI8sI", 0, 0, 0x2A973671, b"RRF2FOOT", 1)
_BUFFER_BYTES: Final = 1 << 20
_PROGRESS_MESSAGES: Final = 64


class RerunToolError(RecordingError):
    """Rerun's command line tool failed; the message is one line with its own words."""


def find_rerun() -> str:
    """Return the path of Rerun's command line tool. Raises `MissingExtraError`."""
    require_package("rerun_cli", "showing recordings")
    found = importlib.util.find_spec("rerun_cli")
    assert found is not None
    assert found.origin is not None
    folder = Path(found.origin).parent
    inside = folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    bare = folder / ("rerun.exe" if sys.platform == "win32" else "rerun")
    # The variable is that of the package's own script.
    return os.environ.get("RERUN_CLI_PATH") or str(inside if inside.exists() else bare)


def make_environment() -> dict[str, str]:
    """Return the environment for the tool: errors are its only words."""
    return {**os.environ, "RUST_LOG": "error", "NO_COLOR": "1"}


def rewrite(
    verb: str,
    files: Sequence[str],
    output: IO[bytes],
    *,
    options: Sequence[str] = (),
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write the messages of files through `rerun rrd`, as one recording with an index.

    Args:
        verb: `INDEX` or `OPTIMIZE`.
        files: Readable files of one session, in order. The id of the first recording becomes that of all, if the ids
            are equally long, as those of a session are.
        output: Open file.
        options: Further options of `rerun rrd`.
        progress: Called as `progress(done, total)` with bytes that the tool has taken; it goes on after that.

    Raises:
        RerunToolError: The tool failed.
        NotARecordingError, OSError: A file cannot be read, or there is no room for `output`.
        MissingExtraError: Rerun is not installed.
    """
    total = sum(os.path.getsize(file) for file in files)
    with tempfile.TemporaryFile() as words:
        process = subprocess.Popen(
            [find_rerun(), "rrd", verb, *options],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=words,
            env=make_environment(),
            bufsize=_BUFFER_BYTES,
        )
        try:
            assert process.stdin is not None
            with suppress(BrokenPipeError), process.stdin as pipe:  # a tool that ended says why
                _send_files(files, pipe, lambda done: progress(done, total) if progress else None)
            status = process.wait()
        except BaseException:
            process.kill()
            process.wait()
            raise
        if status:
            said = _read_words(words, status)
            if os.strerror(errno.ENOSPC) in said:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            raise RerunToolError(f"`rerun rrd {verb}` failed: {said}")


def _send_files(files: Sequence[str], pipe: IO[bytes], progress: Callable[[int], None]) -> None:
    """Write the messages of each file as a stream with a head of its own: other versions of Rerun have another."""
    first_id, done = b"", 0
    for path in files:
        messages = [m for m in scan_file(path).messages if m.kind != KIND_END]
        with open(path, "rb") as file:
            pipe.write(file.read(FILE_HEAD))
            own_id = _find_recording_id(file, messages)
            first_id = first_id or own_id
            is_other = own_id != first_id and len(own_id) == len(first_id)
            for i, message in enumerate(messages):
                data = read_message(file, message)
                if is_other:
                    data = data[:ID_BYTES].replace(own_id, first_id) + data[ID_BYTES:]
                pipe.write(data)
                done += len(data)
                if i % _PROGRESS_MESSAGES == 0:
                    progress(done)
            pipe.write(END_MESSAGE + _TAIL)
    progress(done)


def read_recording_id(path: str | Path) -> str:
    """Return the id of the recording in a file; empty if it cannot be found."""
    messages = scan_file(path).messages
    with open(path, "rb") as file:
        return _find_recording_id(file, messages).decode(errors="replace")


def _find_recording_id(file: BinaryIO, messages: Sequence[RrdMessage]) -> bytes:
    """Return the id of the recording in a file; empty if it cannot be found."""
    infos = (read_message(file, message) for message in messages if message.kind == KIND_STORE_INFO)
    return next(filter(None, (find_store_id(info, RECORDING) for info in infos)), b"")


def _read_words(words: IO[bytes], status: int) -> str:
    words.seek(0)
    lines = words.read(1 << 20).decode(errors="replace").strip().splitlines()
    said = next((line for line in reversed(lines) if "rror" in line), lines[-1] if lines else "no message")
    return f"{' '.join(said.split())[:300]} (exit status {status})"
