"""Recording room: journal, feed to the recorder process, reading back, verification. See docs/architecture.md.

Rerun is imported only where files are written or read, so that the authority stays light.
"""

from iris_session.recording.errors import NotARecordingError, RecorderError, RecordingError
from iris_session.recording.feed import FeedStats, RecorderFeed
from iris_session.recording.journal import (
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
from iris_session.recording.record_batches import RawSample, RecordedCloud, RecordedImage, RecordedState, RecordedStream
from iris_session.recording.recorded_assets import RecordedScene
from iris_session.recording.summary import RecordingSummary, summarise
from iris_session.recording.supervise import RecorderProcess
from iris_session.recording.verify import Core, Problem, VerifyReport, verify

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
    "FeedStats",
    # read a recording
    "Recording",
    "RecordedState",
    "RecordedStream",
    "RawSample",
    "RecordedCloud",
    "RecordedImage",
    "RecordedScene",
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
    "Core",
    # errors
    "RecordingError",
    "RecorderError",
    "NotARecordingError",
    # locks
    "RecordingLock",
    "RecordingInUseError",
]
