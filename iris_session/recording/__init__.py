"""Recordings of sessions: the recorder process that writes them, reading, verifying, summaries, copies and repair.

A recording is one file or several parts; here they are found, locked, written (`process.py`, `writer.py`) and read
(`reader.py`). Records are defined in `journal`, the container in `rrd`, what the viewer shows in `viewer`.

Rerun is imported only where files are written or read, so that the authority stays light.
"""

from iris_session.journal.errors import NotARecordingError, RecorderError, RecordingError
from iris_session.journal.feed import RecorderFeed
from iris_session.journal.rows import (
    CLOSED,
    OPEN,
    Continues,
    JournalRow,
    Keyframe,
    SessionHeader,
    Settings,
    check_row,
    header_root,
    make_row,
    pack_model,
    unpack_model,
)
from iris_session.journal.verification import Problem, VerifyReport
from iris_session.recording.lock import RecordingInUseError, RecordingLock
from iris_session.recording.observations import (
    AlignmentHistory,
    AlignmentPeriod,
    RecordedObservation,
    RecordedParticipant,
    TrackingFrame,
    read_alignment_history,
)
from iris_session.recording.reader import Recording
from iris_session.recording.summary import RecordingSummary, summarise
from iris_session.recording.supervise import RecorderProcess
from iris_session.recording.verify import verify
from iris_session.rrd.batches import RecordedImage, RecordedState, RecordedStream

__all__ = [
    # write a recording
    "SessionHeader",
    "Settings",
    "Continues",
    "JournalRow",
    "Keyframe",
    "CLOSED",
    "OPEN",
    "make_row",
    "check_row",
    "header_root",
    "pack_model",
    "unpack_model",
    "RecorderProcess",
    "RecorderFeed",
    # read a recording
    "Recording",
    "RecordedState",
    "RecordedStream",
    "RecordedImage",
    "read_alignment_history",
    "AlignmentHistory",
    "RecordedObservation",
    "TrackingFrame",
    "AlignmentPeriod",
    "RecordedParticipant",
    "summarise",
    "RecordingSummary",
    "verify",
    "VerifyReport",
    "Problem",
    # errors
    "RecordingError",
    "RecorderError",
    "NotARecordingError",
    # locks
    "RecordingLock",
    "RecordingInUseError",
]
