"""Copies for the viewer: whole sessions, made anew when the recording changes, and never taken for a recording."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import msgspec
import pytest

from iris_session.journal.rows import Continues
from iris_session.recording import NotARecordingError, Recording, viewer_export
from iris_session.recording.folders import find_recordings
from iris_session.recording.lock import RecordingLock
from iris_session.recording.viewer_export import open_view_file
from iris_session.recording.writer import RrdWriter
from iris_session.rrd.file import scan_file
from iris_session.rrd.index import add_index
from iris_session.system.files import Replacement
from tests.recording.support import column, has_index, journal, read, write

STEPS = 60


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("closed") / "session.rrd", *journal(STEPS))


@pytest.fixture
def path(closed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(closed, tmp_path))


def steps_of(path: Path) -> list[int]:
    return sorted(set(column(read(path)["/journal/rows"], "step")))


def write_session(folder: Path) -> None:
    """Write a session whose recorder was killed once, and that was resumed: rows 0-19, 20-39, 40-59."""
    header, batch = journal(STEPS)
    resumed = msgspec.structs.replace(header, continues=Continues("session.rrd", 39, batch.rows[39].chain))
    for name, id_, head, rows in (
        ("session.rrd", "a" * 32, header, batch.rows[:20]),
        ("session.part2.rrd", "a" * 32, header, batch.rows[20:40]),
        ("session.resume2.rrd", "b" * 32, resumed, batch.rows[40:]),
    ):
        writer = RrdWriter(folder / name, id_)
        writer.write_header(head)
        writer.add(type(batch)(rows=rows))
        writer.close()


def test_copy_is_kept_and_made_anew_when_the_recording_changes(path: Path) -> None:
    data, seen = path.read_bytes(), []
    before = path.stat()
    with open_view_file(path, lambda done, total: seen.append((done, total))) as view:
        assert (view.path, view.made, view.kept, view.damage, view.notes) == (
            *(path.with_name("session.view.rrd"), True, True),
            *((), ()),
        )
        assert view.files == (path,)
    assert seen[-1][1] == len(data)
    assert has_index(view.path)
    assert steps_of(view.path) == list(range(STEPS))
    made = view.path.stat()
    with open_view_file(path) as again:
        assert (again.path, again.made) == (view.path, False)
    assert view.path.stat().st_ino == made.st_ino
    assert (path.read_bytes(), path.stat().st_mtime_ns) == (data, before.st_mtime_ns)

    path.write_bytes(data[: scan_file(path).messages[-3].offset + 5])
    with open_view_file(path) as cut:
        assert (cut.made, cut.damage) == (True, ())
        assert "ends in the middle of a write" in cut.notes[0]
    assert has_index(cut.path)
    header, batch = journal(STEPS)
    batch.rows = batch.rows[-5:]
    write(path.with_name("session.part2.rrd"), header, batch)
    with open_view_file(path) as longer:
        assert (longer.made, len(longer.files)) == (True, 2)
    assert sorted(one.name for one in path.parent.iterdir()) == ["session.part2.rrd", "session.rrd", "session.view.rrd"]


def test_parts_and_resumed_recordings_are_one_recording(tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    write_session(tmp_path)
    with open_view_file(tmp_path / "session.resume2.rrd") as view:
        assert view.path == tmp_path / "session.view.rrd"
        assert [file.name for file in view.files] == ["session.rrd", "session.part2.rrd", "session.resume2.rrd"]
    assert steps_of(view.path) == list(range(STEPS))
    assert len(RrdReader(str(view.path)).recordings()) == 1


def test_copy_is_no_recording(path: Path) -> None:
    with open_view_file(path) as view:
        pass
    assert find_recordings(path.parent, lambda error: pytest.fail(str(error))) == [path]
    with Recording.open(path.parent) as recording:
        assert recording.files == [str(path)]
    with pytest.raises(NotARecordingError, match=r"copy for the viewer.*give .*session\.rrd"):
        Recording.open(view.path)
    with pytest.raises(NotARecordingError, match="is no recording"), open_view_file(view.path):
        pass


def test_folder_that_cannot_be_written_gets_no_copy(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests may run as root, who can write everywhere."""

    class Refusing(Replacement):
        def __init__(self, target: Path, **options: object) -> None:
            if target.parent == path.parent:
                raise PermissionError(errno.EACCES, "Permission denied")
            super().__init__(target, permissions=None)

    monkeypatch.setattr(viewer_export, "Replacement", Refusing)
    with open_view_file(path) as view:
        assert (view.made, view.kept) == (True, False)
        assert "Permission denied" in view.notes[0]
        assert has_index(view.path)
    assert not view.path.parent.exists()
    assert list(path.parent.iterdir()) == [path]


def test_small_file_with_an_index_needs_no_copy(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert add_index(path)
    with open_view_file(path) as view:
        assert (view.path, view.made) == (path, False)
    monkeypatch.setattr(viewer_export, "DIRECT_BYTES", 1000)
    with open_view_file(path) as view:
        assert view.path != path


def test_running_session_is_shown_as_it_is(path: Path) -> None:
    lock = RecordingLock(path, shared=True)
    try:
        with open_view_file(path) as view:
            assert "is still being written" in view.notes[0]
            assert steps_of(view.path) == list(range(STEPS))
    finally:
        lock.release()
