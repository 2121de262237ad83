"""The file written together with Rerun: bounded memory, and disks that fill up."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import psutil
import pytest

from iris_session.journal.errors import WriteError
from iris_session.journal.messages import Batch, MetricRecord
from iris_session.recording import Recording
from iris_session.recording.writer import RrdWriter
from iris_session.rrd.file import scan_file
from tests.recording.support import journal


def metrics(i: int) -> Batch:
    return Batch(metrics=[MetricRecord(i, i, f"m{k}", 1.0) for k in range(40)])


def test_memory_does_not_grow_with_chunks(tmp_path: Path) -> None:
    """Rerun's own file sink would keep some 3 KB of every one of these 5,000 chunks."""
    writer = RrdWriter(tmp_path / "w.rrd", "id")
    writer.write_header(journal(0)[0])
    process, after = psutil.Process(), 0
    for i in range(175):
        writer.add(metrics(i))
        writer.flush()
        if i == 50:
            after = process.memory_info().rss
    grown = process.memory_info().rss - after
    writer.close()
    assert grown < 3 << 20, f"{grown >> 10} KiB for 5,000 chunks"


def test_failed_write_leaves_no_partial_message(tmp_path: Path) -> None:
    path = tmp_path / "w.rrd"
    writer = RrdWriter(path, "id")
    header, batch = journal(50)
    writer.write_header(header)
    writer.add(batch)
    writer.flush()
    size = path.stat().st_size
    writer.stream._file = _FullDisk(writer.stream._file)
    writer.add(metrics(1))
    with pytest.raises(WriteError, match=r"w\.rrd.*No space left"):
        writer.flush()
    assert path.stat().st_size == size
    assert not scan_file(path).cut
    with Recording.open(path) as recording:
        assert (len(list(recording.rows())), recording.finished, recording.damage) == (50, False, [])


class _FullDisk:
    """Takes ten bytes more."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self._left = 10

    def write(self, data: memoryview) -> int:
        if not self._left:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        took = int(self._file.write(data[: self._left]))
        self._left -= took
        return took

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)
