"""Errors of the recording room. Every text is one line for the person who reads it.

RecordingError
 +-- RecorderError        the recorder process cannot start
 |    +-- RecordingInUseError   (lock.py) another process writes or continues it
 +-- WriteError           a file that was begun can no longer be written
 +-- NotARecordingError   the file cannot be read as a recording
"""

from __future__ import annotations


class RecordingError(Exception):
    """Base of all errors of recordings."""


class RecorderError(RecordingError):
    """The recorder cannot write where it was told to, or did not start."""


class WriteError(RecordingError):
    """The disk is full, or the file system refuses: the file is good up to an earlier write."""


class NotARecordingError(RecordingError):
    """No such file, no Rerun file, or no session in it."""
