"""Lock on the first file of a recording: shared by authority and recorder, exclusive for a process that continues it.

The locks are those of the system (`flock`): they end with the process that holds them, however it ends. Readers take
none. On a file system without locks every process gets the lock.
"""

from __future__ import annotations

import errno
import fcntl
import os
import time
from contextlib import suppress
from typing import Final

from iris_session.recording.errors import RecorderError
from iris_session.recording.paths import SUFFIX

#: Time in which a recorder whose session was killed can write its data and end.
PATIENCE_S: Final = 15.0
_BUSY: Final = (errno.EAGAIN, errno.EACCES)


class RecordingInUseError(RecorderError):
    """Another process writes or continues this recording."""


class RecordingLock:
    """Lock on the file at `path`, until `release` or the end of the process. The file must exist.

    Waits up to `patience_s` [s] for other processes to release theirs. Raises `RecordingInUseError`, which names these
    processes, and `RecorderError` if the file cannot be opened.
    """

    def __init__(self, path: str | os.PathLike[str], *, shared: bool, patience_s: float = PATIENCE_S) -> None:
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except (OSError, ValueError) as error:
            raise RecorderError(f"{os.fspath(path)} cannot be opened: {_format_error(error)}") from error
        try:
            taken = self._acquire(fcntl.LOCK_SH if shared else fcntl.LOCK_EX, patience_s)
        except BaseException:
            self.release()
            raise
        if not taken:
            text = _describe_holders(self._fd)
            self.release()
            raise RecordingInUseError(f"{os.fspath(path)} is in use: {text}")

    def _acquire(self, kind: int, patience_s: float) -> bool:
        until = time.monotonic() + patience_s
        while True:
            try:
                fcntl.flock(self._fd, kind | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno in _BUSY:
                    if time.monotonic() >= until:
                        return False
                    time.sleep(0.02)
                    continue
            return True

    def release(self) -> None:
        """Release the lock. May be called twice."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            with suppress(OSError):
                os.close(fd)


def find_writers(path: str | os.PathLike[str]) -> list[int]:
    """Return the processes that write the recording whose first file is `path`.

    Takes no lock. Only what the system lists: on Linux, processes of the same user. Empty without such a file.
    """
    try:
        file = os.stat(path)
    except OSError:
        return []
    return [pid for pid, kind in _list_holders(file) if kind == "READ"]


def list_written() -> list[str]:
    """Return the first files of recordings that are being written, newest first. Only those that the system lists."""
    found: dict[str, float] = {}
    for pid, _, inode in (lock for lock in _read_locks() if lock[1] == "READ"):
        for number in _list_open(pid):
            with suppress(OSError):
                file, path = os.stat(f"/proc/{pid}/fd/{number}"), os.readlink(f"/proc/{pid}/fd/{number}")
                if file.st_ino == inode and path.endswith(SUFFIX):
                    found[path] = file.st_mtime
    return sorted(found, key=lambda path: found[path], reverse=True)


def describe_writers(pids: list[int]) -> str:
    """Return a phrase such as `is being written by process 12`."""
    return f"is being written by {_format_processes(pids)}"


def _describe_holders(fd: int) -> str:
    """Describe the holders of the lock as far as the system lists them: on Linux, processes of the same user."""
    holders = _list_holders(os.fstat(fd))
    alone = [pid for pid, kind in holders if kind == "WRITE"]
    if alone:
        return f"it is being resumed by {_format_processes(alone)}"
    if holders:
        return f"the session that it is of still runs: {_format_processes([pid for pid, _ in holders])}"
    return "the session that it is of still runs, or is being resumed"


def _list_holders(file: os.stat_result) -> list[tuple[int, str]]:
    """Return process and kind (`READ`, `WRITE`) of each lock on `file`.

    The device in `/proc/locks` is not always that of `stat`, so a process counts if it has the file open.
    """
    found = {(pid, kind) for pid, kind, inode in _read_locks() if inode == file.st_ino}
    return sorted((pid, kind) for pid, kind in found if _has_open(pid, file))


def _read_locks() -> list[tuple[int, str, int]]:
    """Return process, kind (`READ`, `WRITE`) and inode of each lock of this kind that the system lists."""
    try:
        with open("/proc/locks", encoding="ascii", errors="replace") as locks:
            lines = [line.split() for line in locks]
    except OSError:
        return []
    found = [(int(words[4]), words[3], int(words[5].rpartition(":")[2])) for words in lines if words[1] == "FLOCK"]
    return [(pid, kind, inode) for pid, kind, inode in found if pid > 0]


def _has_open(pid: int, file: os.stat_result) -> bool:
    for number in _list_open(pid):
        with suppress(OSError):
            if os.path.samestat(os.stat(f"/proc/{pid}/fd/{number}"), file):
                return True
    return False


def _list_open(pid: int) -> list[str]:
    try:
        return os.listdir(f"/proc/{pid}/fd")
    except OSError:
        return []


def _format_processes(pids: list[int]) -> str:
    return f"process{'es' if len(pids) > 1 else ''} {', '.join(map(str, pids))}"


def _format_error(error: Exception) -> str:
    return (isinstance(error, OSError) and error.strerror) or str(error)
