"""Reading damaged files: valid content is read, damage is reported."""

from __future__ import annotations

import random
from pathlib import Path

import msgspec
import pytest

from iris_session.journal.rows import VERIFIERS
from iris_session.recording import NotARecordingError, Recording, verify
from iris_session.recording.writer import RrdWriter
from iris_session.rrd import file as rrd_file
from iris_session.rrd import paths
from iris_session.rrd.index import add_index
from iris_session.rrd.paths import part_path
from iris_session.rrd.stream import bytes_column, duration_index, sequence_index
from tests.recording.support import SmallCore, journal, write


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write(tmp_path / "session.rrd", *journal(200))


@pytest.mark.parametrize("indexed", [False, True])
def test_flipped_bit_after_the_last_checksum_is_found(path: Path, indexed: bool) -> None:
    assert not indexed or add_index(path)
    *_, mark, _, end_again, end = rrd_file.scan_file(path).messages
    rng = random.Random(5)
    places = [(rng.randrange(mark.offset, end.offset), rng.randrange(8)) for _ in range(2)]
    data = path.read_bytes()
    for at, bit in [*places, (end_again.offset, 0), (end_again.offset + 8, 4), (end.offset, 1), (end.offset + 8, 3)]:
        damaged = bytearray(data)
        damaged[at] ^= 1 << bit
        path.write_bytes(damaged)
        try:  # the header itself may be gone
            report = verify(path, None)
        except NotARecordingError:
            continue
        assert not report.ok, f"bit {bit} of byte {at}"
    path.write_bytes(data)
    assert verify(path, None).ok


def test_damaged_message_is_skipped(path: Path) -> None:
    data = bytearray(path.read_bytes())
    messages = [m for m in rrd_file.scan_file(path).messages if m.kind == rrd_file.KIND_ARROW]
    victim = messages[-8]
    for i in range(victim.offset + 60, victim.offset + victim.length, 7):
        data[i] ^= 0xFF
    path.write_bytes(data)
    with pytest.warns(UserWarning, match="damaged"):
        recording = Recording.open(path)
    with recording:
        steps = [row.step for row in recording.rows()]
        assert steps[0] == 0
        assert steps[-1] == 199
        assert len(recording.damage) == 1
        assert f"byte {victim.offset}" in recording.damage[0]
    report = verify(path, SmallCore)
    assert not report.ok
    assert any(p.kind == "unreadable" for p in report.problems)


def test_part_of_another_session_is_reported_and_skipped(path: Path) -> None:
    header, batch = journal(100)
    write(Path(part_path(str(path), 2)), msgspec.structs.replace(header, session_name="another"), batch)
    with Recording.open(path, warn=False) as recording:
        (line,) = recording.damage
        assert line.startswith("session.part2.rrd")
        assert [row.step for row in recording.rows()] == list(range(200))
        assert recording.finished


def test_missing_part_is_found(tmp_path: Path) -> None:
    header, batch = journal(200)
    rows, keyframes = batch.rows, batch.keyframes
    files = [tmp_path / name for name in ("session.rrd", "session.part2.rrd", "session.part3.rrd")]
    for i, file in enumerate(files):
        batch.rows, batch.keyframes = rows[i * 70 : i * 70 + 70], keyframes[i * 2 : i * 2 + 2]
        write(file, header, batch)
    report = verify(files[0], SmallCore)
    assert report.ok, report.line()
    assert report.finished
    assert "session.part3.rrd" in report.line()
    files[1].unlink()
    with pytest.warns(UserWarning, match="part2"):
        recording = Recording.open(files[0])
    with recording:
        assert [row.step for row in recording.rows()][-1] == 199
    report = verify(files[0], SmallCore)
    assert report.gaps == [(70, 139)]
    assert (report.ok, report.missing) == (False, ["session.part2.rrd is missing"])


def test_bytes_after_the_end_are_reported(path: Path) -> None:
    size = path.stat().st_size
    path.write_bytes(path.read_bytes() + b"x")
    report = verify(path, SmallCore)
    assert (report.ok, report.finished, report.steps) == (False, True, 200)
    assert f"byte {size} of {size + 1}" in report.problems[0].text


PLACES = {paths.END: "end", paths.KEYFRAMES: "keyframe", paths.MARKS: "mark", paths.ROWS: "n_ticks"}


def test_undecodable_content_is_one_line_with_its_place(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    header, batch = journal(60)
    writer = RrdWriter(path, "id")
    writer.write_header(header)
    writer.add(batch)
    writer.flush()
    times = [sequence_index(paths.STEP, [59]), duration_index(paths.SESSION_TIME, [0])]
    for entity, column in PLACES.items():
        writer._send_columns(entity, times, [bytes_column(column, [b"\xc1 nothing"])])
    writer.flush()
    writer.stream.close(10.0)
    report = verify(path, SmallCore)
    assert (report.ok, report.steps) == (False, 60)
    for entity in PLACES:
        start = f"session.rrd: {entity} "
        (line,) = [problem.text for problem in report.problems if problem.text.startswith(start)]
        assert "\n" not in line


def test_recording_of_another_format_is_rejected_in_one_line(tmp_path: Path) -> None:
    header, batch = journal(5)
    old = msgspec.structs.replace(header, format=3, created_utc="2026-11-20T10:00:00.000+00:00")
    path = write(tmp_path / "old.rrd", old, batch)
    with pytest.raises(NotARecordingError, match=r"format 3 on 2026-11-20.*formats 4 and 5") as refused:
        Recording.open(path)
    assert VERIFIERS[3] in str(refused.value)
    assert "\n" not in str(refused.value)
