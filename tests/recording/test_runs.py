"""Runs of quiet rows: lossless, every changed byte is found and named, and nothing hostile gets in."""

from __future__ import annotations

import struct
import tracemalloc
import warnings
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iris_session.journal import runs
from iris_session.journal.messages import Batch
from iris_session.journal.rows import (
    HASH_BYTES,
    NO_ENTRIES,
    QUIET_DIGEST_BYTES,
    check_row,
    compute_chain,
    is_quiet,
    is_result,
    make_row,
    seal_keyframe,
)
from iris_session.journal.runs import MAX_RUN_ROWS, pack_run, read_run_times, split_runs, unpack_run
from iris_session.protocol.client_messages import Marker
from iris_session.protocol.entries import HOST, Entry
from iris_session.recording import JournalRow, Recording, SessionHeader, header_root, summarise, verify
from iris_session.recording import writer as writer_module
from tests.recording.support import TICK_NS, SmallCore, make_header, write
from tests.recording.test_optimized import optimize

ROOT = b"r" * HASH_BYTES
INT64 = st.integers(-(2**63), 2**63 - 1)


def quiet_rows(times: Sequence[int], first: int = 0, n_ticks: int = 1, chain: bytes = ROOT) -> list[JournalRow]:
    rows: list[JournalRow] = []
    for i, now_ns in enumerate(times):
        rows.append(make_row(chain, first + i, now_ns, n_ticks, [], struct.pack("<qq", i, now_ns)))
        chain = rows[-1].chain
    return rows


def quiet_journal(steps: int, entries_at: Callable[[int], bool] = lambda _: False) -> tuple[SessionHeader, Batch]:
    """A session at rest, with a keyframe every 100 steps."""
    core, header = SmallCore(), make_header()
    chain = header_root(header)
    batch = Batch(keyframes=[seal_keyframe(core.keyframe(-1), chain)])
    for step in range(steps):
        now_ns = (step + 1) * TICK_NS + step * step % 7919
        entries = [Entry(HOST, HOST, now_ns, Marker(step, "m"))] if entries_at(step) else []
        batch.rows.append(make_row(chain, step, now_ns, 1, entries, core.step(now_ns, entries, 1)))
        chain = batch.rows[-1].chain
        if step % 100 == 99:
            batch.keyframes.append(seal_keyframe(core.keyframe(step), chain))
    return header, batch


@given(st.lists(INT64, min_size=1, max_size=MAX_RUN_ROWS), st.integers(0, 2**62 - 250), st.integers(0, 2**63 - 1))
def test_runs_are_lossless_whatever_the_times(times: list[int], first: int, n_ticks: int) -> None:
    rows = quiet_rows(times, first, n_ticks)
    run = pack_run(rows)
    assert unpack_run(run) == rows
    steps, found = read_run_times(run)
    assert (steps.tolist(), found.tolist()) == ([row.step for row in rows], times)


def test_a_row_is_small() -> None:
    assert len(pack_run(quiet_rows([i * TICK_NS + i * i * 7919 % 50_000 for i in range(250)]))) < 6.5 * 250


def test_only_quiet_rows_that_follow_each_other_make_a_run() -> None:
    rows = quiet_rows(range(600))
    rows[20] = make_row(rows[19].chain, 20, 20, 1, [Entry(HOST, HOST, 20, Marker(1, "m"))], b"d" * HASH_BYTES)
    rows[30] = make_row(rows[29].chain, 30, 30, 1, [], b"d" * HASH_BYTES, b"plant")
    rows[40] = make_row(rows[39].chain, 40, 40, 1, [], b"")  # crashed
    rows[50] = make_row(rows[49].chain, 50, 50, 2, [], b"d" * HASH_BYTES)
    del rows[60]
    lengths = [len(some) for some in split_runs(rows)]
    assert lengths == [20, 1, 9, 1, 9, 1, 9, 1, 9, 250, 250, 39]
    assert [bool(pack_run(some)) for some in split_runs(rows)] == [n > 1 or i == 7 for i, n in enumerate(lengths)]
    assert not pack_run([rows[0], rows[2]]), "what does not come out as it was is not packed"


def test_rows_keep_whole_digests_unless_they_are_quiet() -> None:
    whole, other = b"abc" + b"d" * 13, b"abd" + b"d" * 13
    quiet = make_row(ROOT, 1, 1, 1, [], whole)
    assert (quiet.digest, is_quiet(quiet), is_result(quiet, whole), is_result(quiet, other)) == (
        b"abc",
        True,
        True,
        False,
    )
    for entries, plant in (([Entry(HOST, HOST, 1, Marker(1, "m"))], b""), ([], b"plant")):
        row = make_row(ROOT, 1, 1, 1, entries, whole, plant)
        assert (row.digest, is_result(row, whole), is_result(row, whole[:-1] + b"e")) == (whole, True, False)
        assert not is_result(msgspec.structs.replace(row, digest=b"abc"), whole), "a shorter one is none"
    of_format_4 = msgspec.structs.replace(quiet, digest=whole)
    assert is_result(of_format_4, whole)
    assert not is_result(of_format_4, whole[:-1] + b"e")
    for short in (b"", b"a", b"abcd"):
        assert not is_result(msgspec.structs.replace(quiet, digest=short), whole)


def test_every_changed_byte_of_a_run_is_found() -> None:
    run = pack_run(quiet_rows([i * TICK_NS + i * 7919 % 5000 for i in range(100)]))
    for at in range(len(run)):
        with pytest.raises(ValueError, match="a run of"):
            unpack_run(run[:at] + bytes((run[at] ^ 1 << at % 8,)) + run[at + 1 :])
    for n in range(len(run)):
        with pytest.raises(ValueError, match="a run of"):
            unpack_run(run[:n])


def seal(body: bytes) -> bytes:
    return zlib.crc32(body).to_bytes(4, "little") + body


@pytest.mark.parametrize(
    ("fields", "tail"),
    [
        ((0, 0, 0, 1, 0), zlib.compress(b"")),
        ((0, 0, 0, 1, MAX_RUN_ROWS + 1), zlib.compress(bytes(8 * MAX_RUN_ROWS))),
        ((2**62 + 1, 0, 0, 1, 2), zlib.compress(bytes(8))),
        ((-1, 0, 0, 1, 2), zlib.compress(bytes(8))),
        ((0, 0, 0, 1, 2), zlib.compress(bytes(1 << 20))),  # unpacked only as far as two rows need
        ((0, 0, 0, 1, 2), zlib.compress(bytes(7))),
        ((0, 0, 0, 1, 2), zlib.compress(bytes(8)) + b"more"),
        ((0, 0, 0, 1, 2), zlib.compress(bytes(8))[:-1]),
        ((0, 0, 0, 1, 2), b"no zlib at all"),
        ((0, 0, 0, 1, 2), zlib.compress(bytes(8))),  # the last chain
    ],
)
def test_hostile_runs_with_right_checksums_are_refused(fields: tuple[int, ...], tail: bytes) -> None:
    digests = b"d" * QUIET_DIGEST_BYTES * min(fields[-1], MAX_RUN_ROWS)
    with pytest.raises(ValueError, match="a run of"):
        unpack_run(seal(runs._HEAD.pack(*fields, ROOT, ROOT) + digests + tail))


@pytest.mark.parametrize("change", [lambda times: times + b"more", lambda times: times[:-4], lambda times: times[:-1]])
def test_times_end_where_they_say(change: Callable[[bytes], bytes]) -> None:
    run = pack_run(quiet_rows([1, 2, 3]))
    at = runs._DIGESTS_AT + 3 * QUIET_DIGEST_BYTES
    assert unpack_run(seal(run[4:at] + run[at:]))
    with pytest.raises(ValueError, match="a run of"):
        unpack_run(seal(run[4:at] + change(run[at:])))


def test_little_memory_is_taken_by_hostile_times() -> None:
    times = zlib.compress(bytes(2 << 20), 9)
    run = seal(runs._HEAD.pack(0, 0, 0, 1, MAX_RUN_ROWS, ROOT, ROOT) + b"d" * 3 * MAX_RUN_ROWS + times)
    assert len(run) <= runs._MAX_BYTES
    tracemalloc.start()
    with pytest.raises(ValueError, match="bytes of times"):
        unpack_run(run)
    assert tracemalloc.get_traced_memory()[1] < 100_000
    tracemalloc.stop()


def test_steps_that_do_not_fit_are_not_packed() -> None:
    assert not pack_run(quiet_rows([1, 2], first=2**62 + 1))


@given(st.binary(max_size=200))
def test_bytes_that_are_no_run_are_refused(data: bytes) -> None:
    for run in (data, seal(data), seal(runs._HEAD.pack(0, 0, 0, 0, 9, ROOT, ROOT) + data)):
        with pytest.raises(ValueError, match="a run of"):
            unpack_run(run)


@pytest.mark.parametrize("entries_at", [lambda _: False, lambda step: step % 40 == 7])
def test_a_session_at_rest_verifies_and_reads(tmp_path: Path, entries_at: Callable[[int], bool]) -> None:
    header, batch = quiet_journal(700, entries_at)
    path = write(tmp_path / "session.rrd", header, batch, rows_per_chunk=300)
    copy = optimize(tmp_path / "copy.rrd", path)
    for one in (path, copy):
        report = verify(one, SmallCore)
        assert report.ok, report.line()
        assert (report.steps, report.keyframes) == (700, 8)
        with Recording.open(one) as recording:
            assert list(recording.rows()) == batch.rows
            assert [row.step for row in recording.rows(after=333)] == list(range(334, 700))
            assert recording.count_rows() == 700
            summary = summarise(recording)
            assert (summary.steps, summary.ok) == (700, True)


def test_a_changed_run_costs_its_rows_and_no_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def damage(rows: Sequence[JournalRow]) -> bytes:
        run = pack_run(rows)
        return run[:-1] + bytes((run[-1] ^ 1,)) if rows[0].step == 250 else run

    header, batch = quiet_journal(1000)
    monkeypatch.setattr(writer_module, "pack_run", damage)
    path = write(tmp_path / "session.rrd", header, batch, rows_per_chunk=1000)
    report = verify(path, SmallCore)
    assert not report.ok
    assert report.gaps == [(250, 499)]
    assert (report.steps, report.unverified_steps) == (750, 0), "it goes on at the keyframe after step 499"
    assert "rows up to step 499: a run of rows was changed (checksum)" in report.damage[0]
    assert report.problems[0].text == "250 rows are missing, steps 250 to 499"
    with Recording.open(path, warn=False) as recording, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert [row.step for row in recording.rows()] == [*range(250), *range(500, 1000)]
        assert not summarise(recording).ok


def test_a_run_at_another_step_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An index of the file is outside the checksum of a run: it must agree with it."""
    monkeypatch.setattr(writer_module, "sequence_index", lambda name, steps: sequence(name, [s + 1 for s in steps]))
    header, batch = quiet_journal(100)
    report = verify(write(tmp_path / "session.rrd", header, batch, rows_per_chunk=100), SmallCore)
    assert not report.ok
    assert "rows up to step 99: step or time of a run were changed" in report.damage[0]


sequence = writer_module.sequence_index


def test_a_quiet_step_with_another_result_is_named(tmp_path: Path) -> None:
    header, batch = quiet_journal(300)
    chain = batch.rows[122].chain
    for step in range(123, 300):  # as a session with another result of this step alone would have recorded it
        row = batch.rows[step]
        digest = b"xyz" if step == 123 else row.digest
        batch.rows[step] = make_row(chain, step, row.now_ns, 1, [], digest)
        chain = batch.rows[step].chain
    batch.keyframes = [k for k in batch.keyframes if k.step < 123]
    report = verify(write(tmp_path / "session.rrd", header, batch, rows_per_chunk=300), SmallCore)
    (problem,) = report.problems
    assert (problem.step, problem.kind, problem.field) == (123, "divergence", "digest")


@pytest.mark.parametrize("at", [100, 101, 349, 350])
def test_a_quiet_row_that_is_left_out_is_found(tmp_path: Path, at: int) -> None:
    header, batch = quiet_journal(500)
    del batch.rows[at]
    report = verify(write(tmp_path / "session.rrd", header, batch, rows_per_chunk=500), SmallCore)
    assert (report.ok, report.gaps) == (False, [(at, at)])


@pytest.mark.parametrize("at", [0, 100, 250])
def test_a_chain_that_does_not_follow_is_found(tmp_path: Path, at: int) -> None:
    """Rows of another session in the place of those that were recorded, each run whole."""
    header, batch = quiet_journal(300)
    other = quiet_rows([row.now_ns for row in batch.rows[at:]], at, chain=b"o" * HASH_BYTES)
    batch.rows[at:] = other
    problem = check_row(batch.rows[at - 1].chain if at else header_root(header), other[0])
    assert problem is not None
    report = verify(write(tmp_path / "session.rrd", header, batch, rows_per_chunk=300), None)
    assert not report.ok
    assert (report.problems[0].step, report.problems[0].field) == (at, "chain")


def test_rows_of_format_4_are_stored_as_they_are(tmp_path: Path) -> None:
    """Such a session may get a new recorder of this version; and its recordings have no runs."""
    header, batch = quiet_journal(150)
    header = msgspec.structs.replace(header, format=4)
    core, chain = SmallCore(), header_root(header)
    batch.keyframes = [seal_keyframe(core.keyframe(-1), chain)]
    for i, row in enumerate(batch.rows):
        whole = core.step(row.now_ns, [], 1)
        made = make_row(chain, row.step, row.now_ns, 1, [], whole, b"plant")  # which keeps the whole digest
        made = msgspec.structs.replace(made, plant=b"", field_crcs=(*made.field_crcs[:4], 0, made.field_crcs[5]))
        batch.rows[i] = msgspec.structs.replace(made, chain=compute_chain(chain, made))
        chain = batch.rows[i].chain
        if i == 99:
            batch.keyframes.append(seal_keyframe(core.keyframe(i), chain))
    path = write(tmp_path / "session.rrd", header, batch)
    report = verify(path, SmallCore)
    assert report.ok, report.line()
    assert report.steps == 150
    with Recording.open(path) as recording:
        assert list(recording.rows()) == batch.rows
        assert all(len(row.digest) == HASH_BYTES and row.entries == NO_ENTRIES for row in recording.rows())
