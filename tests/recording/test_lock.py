"""Locks of recordings: shared by a session's processes, exclusive for a resume. Locks belong to open files."""

from __future__ import annotations

from pathlib import Path

import pytest

from iris_session.journal.errors import RecorderError
from iris_session.recording.lock import RecordingInUseError, RecordingLock, is_being_written


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "session.rrd"
    path.write_bytes(b"recording")
    return path


@pytest.mark.parametrize(
    ("held", "wanted", "is_free"), [(True, True, True), (True, False, False), (False, True, False)]
)
def test_lock_is_shared_by_a_session_and_refused_to_others(path: Path, held: bool, wanted: bool, is_free: bool) -> None:
    lock = RecordingLock(path, shared=held)
    if is_free:
        RecordingLock(path, shared=wanted, patience_s=0.0).release()
    else:
        with pytest.raises(RecordingInUseError, match=str(path)):
            RecordingLock(path, shared=wanted, patience_s=0.0)
    lock.release()
    lock.release()
    RecordingLock(path, shared=wanted, patience_s=0.0).release()


def test_recording_is_being_written_while_its_lock_is_shared(path: Path) -> None:
    assert not is_being_written(path)
    for shared in (True, False):
        lock = RecordingLock(path, shared=shared)
        assert is_being_written(path) == shared  # a session that resumes it reads it alone
        lock.release()
    assert not is_being_written(path.with_name("nothing.rrd"))


def test_lock_of_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecorderError, match=r"nothing\.rrd"):
        RecordingLock(tmp_path / "nothing.rrd", shared=False)
