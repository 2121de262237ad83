"""Who has a recording in use: authority and recorder share a lock on its first file, who continues it has it alone.

The locks are those of the system (`flock`): they end with the process that holds them, however it ends. Readers take
none. A file system without locks refuses nobody.
"""

from __future__ import annotations

import errno
import fcntl
import os
import time
from contextlib import suppress
from typing import Final

from iris_session.recording.errors import RecorderError

#: A recorder whose session was killed writes what it has and ends: it gets this long.
PATIENCE_S: Final = 15.0
_BUSY: Final = (errno.EAGAIN, errno.EACCES)


class RecordingInUseError(RecorderError):
    """Another process writes this recording, or continues it."""


class RecordingLock:
    """A lock on the file at `path`, until `release` or the end of the process. The file must exist.

    Alone (`shared` false) it waits up to `patience_s` for others to be done. Raises `RecordingInUseError`, `OSError`.
    """

    def __init__(self, path: str | os.PathLike[str], *, shared: bool, patience_s: float = PATIENCE_S) -> None:
        self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            taken = self._take(fcntl.LOCK_SH if shared else fcntl.LOCK_EX, patience_s)
        except BaseException:
            self.release()
            raise
        if not taken:
            self.release()
            text = "the session that it is of still runs, or is being resumed"
            raise RecordingInUseError(f"{os.fspath(path)} is in use: {text}")

    def _take(self, kind: int, patience_s: float) -> bool:
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
        """Gives the lock back. May be called twice."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            with suppress(OSError):
                os.close(fd)
