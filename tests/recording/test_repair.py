"""Repaired files: every whole message before a fault is in them, and what is lost is stated."""

from __future__ import annotations

import random
import shutil
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest

from iris_session.journal.errors import RecorderError
from iris_session.recording import NotARecordingError, Recording, summarise, verify
from iris_session.recording.lock import RecordingLock
from iris_session.recording.repair import RepairReport, repair
from iris_session.rrd import paths
from iris_session.rrd.file import KIND_END, KIND_STORE_INFO, RrdMessage, read_message, scan_file
from iris_session.rrd.paths import part_path
from iris_session.rrd.rerun_tool import INDEX, rewrite
from iris_session.rrd.salvage import salvage
from tests.recording.support import SmallCore, has_index, journal, write

HEAD_BYTES = 16  # of a message
STEPS = 60


class Original(NamedTuple):
    """A whole file. `unmarked`: messages without the recorder's checksums. `n_header`: messages up to its header."""

    path: Path
    messages: list[RrdMessage]
    unmarked: frozenset[bytes]
    n_header: int

    @property
    def begin(self) -> int:
        """Offset of the first message behind the file's own head, and those that say what is stored in it."""
        return next(m.offset for m in self.messages if m.kind != KIND_STORE_INFO)


def make_original(folder: Path) -> Original:
    """Write the file into `folder`."""
    path = write(folder / "session.rrd", *journal(STEPS), rows_per_chunk=6)
    with open(folder / "unmarked.rrd", "wb") as file:
        rewrite(INDEX, [str(path)], file, options=("--drop-entity", paths.MARKS))
    unmarked = frozenset(list_messages(folder / "unmarked.rrd"))
    return Original(path, scan_file(path).messages, unmarked, _count_header_messages(path, folder))


def _count_header_messages(path: Path, folder: Path) -> int:
    cut = folder / "cut.rrd"
    for n, message in enumerate(scan_file(path).messages):
        cut.write_bytes(path.read_bytes()[: message.offset])
        with suppress(NotARecordingError), Recording.open(cut):
            return n
    raise AssertionError("no header")


def list_messages(path: Path) -> list[bytes]:
    """Return the messages of a file but the last, which ends it."""
    with open(path, "rb") as file:
        return [read_message(file, m) for m in scan_file(path).messages if m.kind != KIND_END]


def check_repair(original: Original, damaged: bytes, fault: int, folder: Path) -> str:
    """Repair a file with a fault in byte `fault`; return what became of it: `whole`, `damaged` or `none`."""
    path, output = folder / "damaged.rrd", folder / "repaired.rrd"
    path.write_bytes(damaged)
    n_before = sum(m.offset + HEAD_BYTES + m.length <= fault and m.kind != KIND_END for m in original.messages)
    expected = list_messages(original.path)[:n_before]
    is_cut = len(damaged) == fault
    if n_before < original.n_header if is_cut else fault < original.begin:
        with suppress(NotARecordingError):  # without a header it is no recording
            repair(path, output, overwrite=True)
        return "none"
    report = repair(path, output, overwrite=True)
    assert path.read_bytes() == damaged
    assert scan_file(output).indexed
    # A changed name of a component decodes, and is kept and reported, though Rerun does not know it.
    assert has_index(output) or report.damage, f"byte {fault}"
    kept = list_messages(output)
    if report.damage:
        expected = [data for data in expected if data in original.unmarked]
        kept = [data for data in kept if data in set(expected)]
    assert kept[: len(expected)] == expected, f"byte {fault}"
    with Recording.open(path, warn=False) as recording:
        summary = summarise(recording)
    assert summary.ok == report.ok, f"byte {fault}"
    assert set(report.damage) == set(summary.damage)
    return "whole" if report.ok else "damaged"


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Original:
    return make_original(tmp_path_factory.mktemp("original"))


def test_truncated_file_is_repaired_up_to_its_last_whole_message(original: Original, tmp_path: Path) -> None:
    """It is cut around the beginning of messages, in their heads and bodies."""
    data, rng = original.path.read_bytes(), random.Random(3)
    for message in rng.sample(original.messages, 6):
        at = message.offset + rng.choice((0, 1, 8, 15, 16, 17, 16 + message.length // 2))
        assert check_repair(original, data[:at], at, tmp_path) != "damaged", "a cut is no damage"


def test_flipped_bits_cost_one_message(original: Original, tmp_path: Path) -> None:
    data, rng = original.path.read_bytes(), random.Random(1)
    found = []
    for _ in range(5):
        at = rng.randrange(len(data))
        damaged = bytearray(data)
        damaged[at] ^= 1 << rng.randrange(8)
        found.append(check_repair(original, bytes(damaged), at, tmp_path))
    assert found.count("damaged") > 2


def test_message_that_claims_a_terabyte_is_left_out(tmp_path: Path) -> None:
    """Rerun's decoder aborts at it."""
    path = Path(__file__).with_name("claims_a_terabyte.rrd")
    assert salvage(path, tmp_path / "copy.rrd") == ["message of 1283 bytes at byte 93 is damaged and left out"]


def test_cut_file_keeps_its_checksums(original: Original, tmp_path: Path) -> None:
    path, output = tmp_path / "session.rrd", tmp_path / "repaired.rrd"
    path.write_bytes(original.path.read_bytes()[: scan_file(original.path).messages[-4].offset + 20])
    report = repair(path, output)
    assert (report.ok, report.finished, report.damage, report.lost_steps) == (True, False, (), 0)
    assert report.lost_bytes == 20
    assert len(report.cuts) == 1
    found = verify(output, SmallCore)
    assert found.ok, found.line()
    assert (found.steps, found.finished) == (report.steps, False)
    data = bytearray(output.read_bytes())
    data[scan_file(output).messages[5].offset + 100] ^= 1
    output.write_bytes(data)
    with Recording.open(output, warn=False) as recording:
        assert recording.damage or recording.changed_spans()


def test_header_is_read_from_its_copy(original: Original, tmp_path: Path) -> None:
    """The model is only in the header, so that the rest is not simulated."""
    victim = original.messages[original.n_header - 1]
    data = bytearray(original.path.read_bytes())
    data[victim.offset + 300 : victim.offset + victim.length] = bytes(victim.length - 300)
    assert check_repair(original, bytes(data), victim.offset + 300, tmp_path) == "damaged"
    with Recording.open(original.path) as whole, Recording.open(tmp_path / "repaired.rrd", warn=False) as repaired:
        assert repaired.header == msgspec.structs.replace(whole.header, model=b"")
        assert repaired.root == whole.root
        assert list(repaired.rows()) == list(whole.rows())
        assert repaired.damage == [
            "header: damaged, and read from its copy, which has no model: the session cannot be simulated again"
        ]
    report = verify(tmp_path / "repaired.rrd", None)
    assert report.steps == STEPS
    assert [problem.field for problem in report.problems] == ["file"]


def destroy_rows(original: Path, path: Path, first: int) -> None:
    """Destroy the message with the six rows from step `first` on."""
    with Recording.open(original) as recording:
        chain = next(row.chain for row in recording.rows() if row.step == first)
    data = bytearray(original.read_bytes())
    at = data.find(chain)
    (victim,) = (m for m in scan_file(original).messages if m.offset < at < m.offset + m.length)
    data[victim.offset + 100 : victim.offset + victim.length] = bytes(victim.length - 100)
    path.write_bytes(data)


@pytest.mark.parametrize(("first", "lost_s"), [(30, 0.014), (54, 0.0)])
def test_lost_rows_are_counted(original: Original, tmp_path: Path, first: int, lost_s: float) -> None:
    """The time of those at the end is not known."""
    path, output = tmp_path / "session.rrd", tmp_path / "repaired.rrd"
    destroy_rows(original.path, path, first)
    report = repair(path, output)
    assert not report.ok
    assert (report.steps, report.lost_steps, report.lost_s) == (STEPS - 6, 6, lost_s)
    assert report.lost_bytes > 500
    assert any(f"steps {first} to {first + 5} are missing (6)" in line for line in report.damage)
    with Recording.open(output, warn=False) as recording:
        assert recording.damage == recording.changed_spans() == [], "checksums of other bytes are not in it"
        assert [row.step for row in recording.rows()] == [*range(first), *range(first + 6, STEPS)]


def test_parts_become_one_file(tmp_path: Path) -> None:
    header, batch = journal(STEPS)
    first = tmp_path / "session.rrd"
    rows, keyframes = batch.rows, batch.keyframes
    batch.rows, batch.keyframes = rows[:30], keyframes[:1]
    write(first, header, batch)
    batch.rows, batch.keyframes = rows[25:], keyframes[1:]
    write(Path(part_path(str(first), 2)), header, batch)
    Path(part_path(str(first), 3)).write_bytes(b"RRF2 and nothing that is a message")
    report = repair(tmp_path, tmp_path / "repaired.rrd")
    assert (report.files, report.steps, report.lost_steps) == (("session.rrd", "session.part2.rrd"), STEPS, 0)
    assert report.finished
    found = verify(tmp_path / "repaired.rrd", SmallCore)
    assert found.ok, found.line()
    assert (found.steps, found.finished) == (STEPS, True)


def test_nothing_is_overwritten_without_a_word(original: Original, tmp_path: Path) -> None:
    path, output = Path(shutil.copy(original.path, tmp_path)), tmp_path / "repaired.rrd"
    output.write_bytes(b"mine")
    link = tmp_path / "link.rrd"
    link.symlink_to(path)
    for target, overwrite, why in (
        (output, False, "--force"),
        (path, True, "the recording itself"),
        (link, True, "the recording itself"),
        (tmp_path, True, "a folder"),
        (tmp_path / "no" / "folder.rrd", True, "No such file"),
    ):
        with pytest.raises(RecorderError, match=why):
            repair(path, target, overwrite=overwrite)
    assert output.read_bytes() == b"mine"
    assert path.read_bytes() == original.path.read_bytes()
    report = repair(path, output, overwrite=True)
    assert isinstance(report, RepairReport)
    assert (report.ok, report.lost_bytes) == (True, 0)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["link.rrd", "repaired.rrd", "session.rrd"]


def test_running_session_is_not_repaired(original: Original, tmp_path: Path) -> None:
    path = Path(shutil.copy(original.path, tmp_path))
    lock = RecordingLock(path, shared=True)
    try:
        with pytest.raises(RecorderError, match="is being written"):
            repair(path, tmp_path / "repaired.rrd")
    finally:
        lock.release()
