"""Errors of the recording room. Every message is one line.

RecordingError
 +-- RecorderError        the recorder process cannot start
 |    +-- RecordingInUseError   (lock.py) another process writes or continues it
 +-- WriteError           an open file can no longer be written
 +-- NotARecordingError   the file cannot be read as a recording
"""

from __future__ import annotations

from iris_session.protocol.errors import IrisError


class RecordingError(IrisError):
    """Base of all errors of recordings."""


class RecorderError(RecordingError):
    """The recorder cannot write to the given path, or did not start."""


class WriteError(RecordingError):
    """The disk is full or the file system reports an error: the file is valid up to an earlier write."""


class NotARecordingError(RecordingError):
    """No such file, no Rerun file, or no session in it."""
