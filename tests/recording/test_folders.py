"""Recordings in folders."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from iris_session.journal.errors import NotARecordingError, RecorderError
from iris_session.recording.folders import check_new_recording, find_recordings, find_session_in, group_by_session


def make_files(folder: Path, *names: str) -> list[Path]:
    """Make files, the first the newest."""
    made = []
    for age, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        os.utime(path, (1e9 - age, 1e9 - age))
        made.append(path)
    return made


def test_sessions_are_grouped_with_what_resumes_them_and_the_newest_is_first(tmp_path: Path) -> None:
    make_files(
        tmp_path, "b/session.resume2.rrd", "a/x.rrd", "b/session.rrd", "b/session.part2.rrd", "a/x.view.rrd", "c"
    )
    found = find_recordings(tmp_path, lambda error: pytest.fail(str(error)))
    groups = [[str(file.relative_to(tmp_path)) for file in group] for group in group_by_session(found)]
    assert groups == [["b/session.rrd", "b/session.resume2.rrd"], ["a/x.rrd"]]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("session.rrd", "other.rrd"), "session.rrd"),
        (("lab.resume2.rrd", "lab.rrd", "lab.part2.rrd", "lab.view.rrd", "below/lab.rrd"), "lab.rrd"),
        (("lab.part2.rrd",), "lab.part2.rrd"),
    ],
)
def test_a_folder_stands_for_its_only_session(tmp_path: Path, names: tuple[str, ...], expected: str) -> None:
    make_files(tmp_path, *names)
    assert find_session_in(tmp_path) == tmp_path / expected


@pytest.mark.parametrize("names", [("b.rrd", "a.rrd"), ("2/session.rrd", "1/session.rrd"), ("1/session.rrd",)])
def test_other_folders_name_what_to_give(tmp_path: Path, names: tuple[str, ...]) -> None:
    made = make_files(tmp_path, *names)
    with pytest.raises(NotARecordingError) as refused:
        find_session_in(tmp_path)
    assert str(refused.value).endswith(", ".join(map(str, made)))
    with pytest.raises(NotARecordingError, match="cannot be read"):
        find_session_in(tmp_path / "missing")


@pytest.mark.parametrize(
    ("name", "there"),
    [
        ("pour.view.rrd", ()),
        ("pour.part1.rrd", ()),
        ("pour.resume2.rrd", ()),
        ("pour.rrd", ("pour.part2.rrd",)),
        ("pour.rrd", ("pour.resume2.rrd",)),
    ],
)
def test_no_session_begins_under_a_name_that_belongs_to_another(
    tmp_path: Path, name: str, there: tuple[str, ...]
) -> None:
    make_files(tmp_path, "other.rrd", "pour2.part2.rrd", *there)
    with pytest.raises(RecorderError, match="choose another name"):
        check_new_recording(tmp_path / name)
    check_new_recording(tmp_path / "pour3.rrd")
    check_new_recording(tmp_path / "missing" / "pour.rrd")
