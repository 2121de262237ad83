"""The index of a closed file: it changes no byte that was recorded, and nothing else is touched."""

from __future__ import annotations

import errno
import fcntl
import os
import random
import shutil
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import pytest

from iris_session.recording import NotARecordingError, Recording, verify
from iris_session.rrd.file import END_MESSAGE, FILE_TAIL, read_chunks, scan_file
from iris_session.rrd.index import add_index
from iris_session.rrd.rerun_tool import find_rerun
from tests.recording.support import SmallCore, has_index, journal, write

STEPS = 200


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("closed") / "session.rrd", *journal(STEPS))


@pytest.fixture(scope="module")
def indexed(closed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = Path(shutil.copy(closed, tmp_path_factory.mktemp("indexed")))
    assert add_index(path)
    return path


@pytest.fixture
def path(closed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(closed, tmp_path))


def test_index_follows_the_messages_as_they_were(closed: Path, indexed: Path) -> None:
    original, data = closed.read_bytes(), indexed.read_bytes()
    assert original.endswith(END_MESSAGE)
    assert data.startswith(original.removesuffix(END_MESSAGE))
    found = scan_file(indexed)
    assert (found.indexed, found.cut, found.holes, found.good_bytes) == (True, False, [], len(data))
    assert has_index(indexed)
    assert not has_index(closed)
    assert add_index(indexed), "once is enough"
    assert indexed.read_bytes() == data


def test_indexed_file_reads_and_verifies_like_before(closed: Path, indexed: Path) -> None:
    with Recording.open(closed) as before, Recording.open(indexed) as after:
        assert list(after.rows()) == list(before.rows())
        assert (after.finished, after.damage, after.notes) == (True, [], [])
    report = verify(indexed, SmallCore)
    assert report.ok, report.line()
    assert report.finished


def test_readers_wait_while_it_is_being_written(
    closed: Path, indexed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, locks = indexed.read_bytes(), []
    path = tmp_path / "session.rrd"
    path.write_bytes(whole[:-1000])

    def lock(file: BinaryIO, kind: int) -> None:
        """Finish the write when a reader waits for it."""
        locks.append(kind)
        if path.stat().st_size == len(whole) - 1000:
            path.write_bytes(whole)

    monkeypatch.setattr(fcntl, "lockf", lock)
    assert [chunk.id for chunk in read_chunks(path, "/**")] == [chunk.id for chunk in read_chunks(indexed, "/**")]
    assert add_index(shutil.copy(closed, path))
    assert locks[-1] == fcntl.LOCK_EX


def test_changed_bytes_of_an_indexed_file_are_found(indexed: Path, tmp_path: Path) -> None:
    """The recorder's checksums count, unlike in a copy by Rerun's tools."""
    path = tmp_path / "session.rrd"
    data = indexed.read_bytes()
    end = scan_file(indexed).messages[-1].offset
    rng = random.Random(7)
    found_by_checksum = 0
    while found_by_checksum < 1:
        at = rng.randrange(100, end)
        path.write_bytes(flip(data, at, rng))
        with suppress(NotARecordingError), Recording.open(path, warn=False) as recording:  # it may be the header
            if not recording.damage:  # the message decodes nevertheless
                assert recording.changed_spans(), f"byte {at} of {len(data)}"
                found_by_checksum += 1
    path.write_bytes(flip(data, rng.randrange(end + 16, len(data) - FILE_TAIL), rng))
    with Recording.open(path, warn=False) as recording:
        assert recording.damage == ["session.rrd: the footer is damaged: read without it"]


def flip(data: bytes, at: int, rng: random.Random) -> bytes:
    damaged = bytearray(data)
    damaged[at] ^= 1 << rng.randrange(8)
    return bytes(damaged)


def test_file_that_was_not_closed_or_is_damaged_stays_as_it_is(path: Path) -> None:
    whole = path.read_bytes()
    messages = scan_file(path).messages
    hole = bytearray(whole)
    hole[messages[-5].offset + 12] ^= 0x40
    for data in (whole[: messages[-1].offset], whole[: messages[-1].offset - 7], whole + b"x", bytes(hole)):
        path.write_bytes(data)
        assert not add_index(path)
        assert path.read_bytes() == data


def test_other_output_of_rerun_is_not_taken(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = path.read_bytes()
    other_messages = f'{find_rerun()} rrd filter "$3" | LC_ALL=C sed s/iris-session/iris-sessioN/'
    for program in ("exit 3", 'cat "$3"', 'cat "$3"; echo more', other_messages):
        tool = tmp_path / "tool"
        tool.write_text(f"#!/bin/sh\n{program}\n")
        tool.chmod(0o755)
        monkeypatch.setenv("RERUN_CLI_PATH", str(tool))
        assert not add_index(path), program
        assert path.read_bytes() == before


def test_full_disk_leaves_the_file_as_it_was(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = path.read_bytes()
    write_bytes = os.pwrite
    calls = []

    def refuse(descriptor: int, data: bytes, offset: int) -> int:
        calls.append(len(data))
        if len(calls) > 1:
            return write_bytes(descriptor, data, offset)
        write_bytes(descriptor, data[:1000], offset)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", refuse)
    assert not add_index(path)
    assert path.read_bytes() == before


def test_kill_during_the_write_leaves_a_finished_file(indexed: Path, tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    data = indexed.read_bytes()
    end = scan_file(indexed).messages[-1].offset
    for size in (end + 17, end + 5000, len(data) - FILE_TAIL - 1):
        path.write_bytes(data[:size])
        report = verify(path, SmallCore)
        assert report.ok, report.line()
        assert (report.finished, report.steps) == (True, STEPS)


def test_index_keeps_to_the_bytes_that_the_file_may_have(indexed: Path, path: Path) -> None:
    before, size = path.read_bytes(), indexed.stat().st_size
    assert not add_index(path, size - 5000)  # an index is not always equally long
    assert path.read_bytes() == before
    assert add_index(path, size + 5000)
    assert path.stat().st_size <= size + 5000
