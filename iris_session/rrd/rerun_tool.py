"""Rerun's command line tool, which lies in the package of the SDK: find it, and run `rerun rrd` on messages and files.

The tool is a process of its own: Rerun's decoder may abort on damaged bytes, and damaged messages may claim any size
when decompressed, so what it may take is bounded where a file is not known to be whole. It reads messages from its
standard input, so damaged and several files need no temporary copy that joins them, and progress can be shown.
"""

from __future__ import annotations

import errno
import importlib.util
import math
import os
import resource
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Final

from iris_session.journal.errors import RecordingError
from iris_session.rrd.file import (
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
#: Address space for reading a file that may be damaged: as much, and a multiple of the size of the file [bytes].
MEMORY_BYTES: Final = 2 << 30
MEMORY_TIMES: Final = 4
#: Processor time for it: as much [s], and the time at this speed, a twentieth of the usual one [bytes/s].
CPU_S: Final = 30.0
CPU_BYTES_PER_S: Final = 1e6
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


def start_rrd(
    *arguments: str,
    stdin: int = subprocess.DEVNULL,
    stdout: int | IO[bytes] = subprocess.DEVNULL,
    stderr: int | IO[bytes] = subprocess.DEVNULL,
    bound_bytes: int = 0,
) -> subprocess.Popen[bytes]:
    """Start `rerun rrd`.

    Args:
        arguments: Its verb, options and files.
        stdin: `PIPE` to write messages.
        stdout: `PIPE`, or an open file.
        stderr: As `stdout`.
        bound_bytes: Size of a file that may be damaged: memory and processor time are bounded by it; 0: no bounds.

    Raises:
        MissingExtraError: Rerun is not installed.
    """
    process = subprocess.Popen(
        [find_rerun(), "rrd", *arguments],
        stdin=stdin,
        stdout=stdout,
        stderr=stderr,
        env=make_environment(),
        bufsize=_BUFFER_BYTES,
    )
    if bound_bytes and hasattr(resource, "prlimit"):  # Linux
        memory = MEMORY_BYTES + MEMORY_TIMES * bound_bytes
        cpu_s = math.ceil(CPU_S + bound_bytes / CPU_BYTES_PER_S)
        with suppress(OSError, ValueError):  # it has ended, or stricter bounds are set already
            resource.prlimit(process.pid, resource.RLIMIT_AS, (memory, memory))
            resource.prlimit(process.pid, resource.RLIMIT_CPU, (cpu_s, cpu_s))
    return process


def is_readable(path: str | Path) -> bool:
    """Return whether every message of a file decodes; the index is not checked. Raises `MissingExtraError`."""
    arguments = ("--check-footers=false", str(Path(path).absolute()))
    with start_rrd("verify", *arguments, bound_bytes=os.path.getsize(path)) as tool:
        return tool.wait() == 0


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
        process = start_rrd(verb, *options, stdin=subprocess.PIPE, stdout=output, stderr=words)
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


def filter_readable(path: str | Path, messages: Sequence[RrdMessage], output: IO[bytes]) -> bool:
    """Write those messages of a file to `output` that Rerun decodes, until its decoder aborts.

    Args:
        path: The file.
        messages: Which of its messages; among them those that say what is stored in it.
        output: Open file. A message may be encoded in another way than in `path`.

    Returns:
        Whether it got to the end.
    """
    size = sum(message.length for message in messages)
    tool = start_rrd(INDEX, "--continue-on-error", stdin=subprocess.PIPE, stdout=output, bound_bytes=max(1, size))
    try:
        assert tool.stdin is not None
        with suppress(BrokenPipeError), tool.stdin as pipe, open(path, "rb") as file:
            pipe.write(file.read(FILE_HEAD))
            pipe.writelines(read_message(file, message) for message in messages)
            pipe.write(END_MESSAGE + _TAIL)
        return tool.wait() == 0
    finally:
        tool.kill()
        tool.wait()


def _send_files(files: Iterable[str], pipe: IO[bytes], progress: Callable[[int], None]) -> None:
    """Write the messages of each file as a stream with a head of its own: other versions of Rerun have another."""
    first_id, done = b"", 0
    for path in files:
        messages = [m for m in scan_file(path).messages if m.kind != KIND_END]
        with open(path, "rb") as file:
            pipe.write(file.read(FILE_HEAD))
            infos = (read_message(file, message) for message in messages if message.kind == KIND_STORE_INFO)
            own_id = next(filter(None, (find_store_id(info, RECORDING) for info in infos)), b"")
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


def _read_words(words: IO[bytes], status: int) -> str:
    words.seek(0)
    lines = words.read(1 << 20).decode(errors="replace").strip().splitlines()
    said = next((line for line in reversed(lines) if "rror" in line), lines[-1] if lines else "no message")
    return f"{' '.join(said.split())[:300]} (exit status {status})"
