"""Add Rerun's index, the footer, to a closed file: `python -m iris_session.rrd.index FILE MAX_BYTES`.

With an index, Rerun's viewer loads what it shows; without, it reads all of a file first, and says meanwhile that
loading has failed. The recorder writes none, because it would have to keep some 4 KB of every chunk. The chunks stay
small and many: of a long session the copy of `recording/viewer_export.py` opens several times faster.

`rerun rrd filter` writes the messages of a file as they are, with an index behind them. That output is compared with
the file byte by byte, and only then is the empty end message replaced by one with the index: everything before it stays
as it was written. A process that is killed leaves the file as it was, or, in the moment of the write, one that is cut
after all data, which readers take as finished.

The recorder starts this as a process that outlives the session. For a large file it runs only while the processor is
idle: neither the end of this session nor the next one waits for it. It takes about 60 ms for each MB.
"""

from __future__ import annotations

import fcntl
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import IO, BinaryIO, Final

import psutil

from iris_session.journal.errors import RecordingError
from iris_session.rrd.file import END_MESSAGE, FILE_TAIL, FOOT, KIND_END, read_message_head, scan_file
from iris_session.rrd.rerun_tool import INDEX, start_rrd
from iris_session.system.priority import LAST_NICE, LOW_PRIORITY_NICE
from iris_session.system.process import DEVNULL, PIPE, ChildProcess

#: Memory that `rerun rrd filter` takes for each message, and the share of the free memory that it may take.
MESSAGE_BYTES: Final = 20_000
MEMORY_SHARE: Final = 0.25
#: Bytes by which an index grows with each message, at most; it begins with 0.1 to 0.7 MB, by the number of entities.
INDEX_BYTES: Final = 400
#: Free bytes of the disk that are left to the next session.
RESERVE_BYTES: Final = 512 << 20
#: A file up to this size takes half a second. On a busy machine an idle process would never get to it.
SHORT_BYTES: Final = 8 << 20
_READ_BYTES: Final = 1 << 20


def start_indexing(path: str, max_bytes: int = 0) -> ChildProcess:
    """Start the process that adds an index to a closed file. It outlives this one. Raises `OSError`.

    `max_bytes`: bytes that the file may have with it; 0: any number.
    """
    return ChildProcess(
        "iris_session.rrd.index",
        [path, str(max_bytes)],
        config=b"",
        stdout=DEVNULL,
        stderr=DEVNULL,
        own_session=True,
    )


def add_index(path: str | Path, max_bytes: int = 0) -> bool:
    """Add an index to a file that its recorder has closed.

    Args:
        path: The file. It is left as it is if it was not closed or is damaged, or if memory or disk are short.
        max_bytes: Bytes that it may have with the index; 0: any number.

    Returns:
        Whether the file has an index now.

    Raises:
        NotARecordingError: It is no Rerun file.
        OSError: It cannot be read.
        MissingExtraError: Rerun is not installed.
    """
    found = scan_file(path)
    if found.indexed:
        return True
    is_closed = bool(found.messages) and found.messages[-1].kind == KIND_END and found.good_bytes == found.size
    if not is_closed or found.holes:
        return False
    if len(found.messages) * MESSAGE_BYTES > MEMORY_SHARE * psutil.virtual_memory().available:
        return False
    with open(path, "r+b", buffering=0) as file:
        index = _make_index(path, file, found.size - len(END_MESSAGE))
        fits = not max_bytes or found.size + len(index) <= max_bytes
        return bool(index) and fits and _append(file, found.size, index)


def _make_index(path: str | Path, file: BinaryIO, end: int) -> bytes:
    """Return the end message with an index and its tail; empty if Rerun writes other messages than the file has.

    `end`: offset of the file's end message.
    """
    with start_rrd(INDEX, str(Path(path).absolute()), stdout=PIPE) as tool:
        try:
            assert tool.stdout is not None
            if not _is_same(file, tool.stdout, end):
                return b""
            index = tool.stdout.read()
            if tool.wait() or not _is_index(index):
                return b""
            return index
        finally:
            tool.kill()


def _is_same(file: BinaryIO, output: IO[bytes], n_bytes: int) -> bool:
    """Return whether the first bytes of both are the same; `output` is then read so far."""
    file.seek(0)
    while n_bytes:
        written = output.read(min(n_bytes, _READ_BYTES))
        if not written or written != file.read(len(written)):
            return False
        n_bytes -= len(written)
    return True


def _is_index(data: bytes) -> bool:
    """Return whether `data` is an end message with a body and the tail after it."""
    if len(data) <= len(END_MESSAGE) + FILE_TAIL:
        return False
    kind, length = read_message_head(data)
    return kind == KIND_END and length == len(data) - len(END_MESSAGE) - FILE_TAIL and FOOT in data[-FILE_TAIL:]


def _append(file: BinaryIO, size: int, index: bytes) -> bool:
    """Replace the end message of a file of `size` bytes, unless it was changed or removed, or the disk is full."""
    descriptor, end = file.fileno(), size - len(END_MESSAGE)
    with suppress(OSError):  # a file system without locks
        fcntl.lockf(file, fcntl.LOCK_EX)  # readers wait (`wait_for_index`)
    now, disk = os.fstat(descriptor), os.fstatvfs(descriptor)
    if now.st_size != size or not now.st_nlink or disk.f_bavail * disk.f_frsize < len(index) + RESERVE_BYTES:
        return False
    if os.pread(descriptor, len(END_MESSAGE), end) != END_MESSAGE:
        return False
    try:
        # One call: a kill hardly ever finds a part of it.
        is_whole = os.pwrite(descriptor, index, end) == len(index)
        os.utime(descriptor, ns=(now.st_atime_ns, now.st_mtime_ns))  # what was recorded is as old as before
        os.fsync(descriptor)
    except OSError:
        is_whole = False
    if not is_whole:
        os.pwrite(descriptor, END_MESSAGE, end)
        os.ftruncate(descriptor, size)
    return is_whole


def main() -> int:
    """Add an index to the file of the command line, a large one when the processor has nothing else to do."""
    path, max_bytes = sys.argv[1], int(sys.argv[2])
    try:
        os.nice(LOW_PRIORITY_NICE)
        with suppress(OSError):  # Linux may share the processor among sessions first, and this one is of its own
            Path("/proc/self/autogroup").write_text(str(LAST_NICE), encoding="ascii")
        if hasattr(os, "SCHED_IDLE") and os.path.getsize(path) > SHORT_BYTES:
            with suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        return 0 if add_index(path, max_bytes) else 1
    except (OSError, ImportError, RecordingError):
        return 1


if __name__ == "__main__":
    sys.exit(main())
