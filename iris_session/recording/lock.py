"""Lock on the first file of a recording: shared by authority and recorder, exclusive for a process that continues it.

The locks are those of the system (`flock`): they end with the process that holds them, however it ends. Readers
hold none. On a file system without locks every process gets the lock.
"""

from __future__ import annotations

import errno
import fcntl
import os
import time
from contextlib import suppress
from typing import Final

from iris_session.journal.errors import RecorderError

#: Time in which a recorder whose session was killed can write its data and end.
PATIENCE_S: Final = 15.0
#: Time in which a process that only tries the lock has released it: for a recorder, which gives up after that, and for
#: another process that tries it.
TRIED_S: Final = 1.0
OTHERS_TRY_S: Final = 0.05
_BUSY: Final = (errno.EAGAIN, errno.EACCES)


class RecordingInUseError(RecorderError):
    """Another process writes or continues this recording."""


class RecordingLock:
    """Lock on the file at `path`, until `release` or the end of the process. The file must exist.

    Waits up to `patience_s` [s] for other processes to release theirs. Raises `RecordingInUseError`, and
    `RecorderError` if the file cannot be opened.
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
            self.release()
            text = "its session still runs, or is being resumed"
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


def is_being_written(path: str | os.PathLike[str]) -> bool:
    """Return whether a process writes the recording whose first file is `path`.

    Writers share the lock; it is tried for a moment, alone and then shared. False where there is no such file, or the
    file system has no locks.
    """
    return not _is_free(path, shared=False) and _is_free(path, shared=True)


def _is_free(path: str | os.PathLike[str], *, shared: bool) -> bool:
    try:
        RecordingLock(path, shared=shared, patience_s=OTHERS_TRY_S).release()
    except RecordingInUseError:
        return False
    except RecorderError:
        return True
    return True


def _format_error(error: Exception) -> str:
    return (isinstance(error, OSError) and error.strerror) or str(error)
