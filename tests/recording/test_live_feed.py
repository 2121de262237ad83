"""Recordings that are being written reach a viewer: every message once, in order, over parts, and nothing waits."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest

from iris_session.recording import NotARecordingError
from iris_session.recording.live_feed import MessageTail
from iris_session.rrd.file import KIND_END, read_message, scan_file
from tests.recording.support import journal, write

STEPS = 60


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("closed") / "session.rrd", *journal(STEPS))


def messages_of(path: Path) -> list[bytes]:
    with open(path, "rb") as file:
        return [read_message(file, m) for m in scan_file(path).messages if m.kind != KIND_END]


def test_tail_reads_whole_messages_of_a_growing_file_and_its_parts(
    closed: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    path, data, expected = tmp_path / "session.rrd", closed.read_bytes(), messages_of(closed)
    tail, found = MessageTail(str(path)), []
    request.addfinalizer(tail.close)
    assert tail.read(1 << 20) == [], "there is no file yet"
    with open(path, "wb", buffering=0) as file:
        for i in range(0, len(data), 997):  # cuts heads and bodies
            file.write(data[i : i + 997])
            found += tail.read(1 << 20)
    assert found == expected
    assert tail.read(1 << 20) == [], "the end message is none"
    part = tmp_path / "session.part2.rrd"
    part.touch()
    assert tail.read(1 << 20) == tail.read(1 << 20) == []
    part.write_bytes(data)
    sizes = []
    while got := tail.read(5000):
        sizes.append(sum(map(len, got)))
        found += got
    assert found == expected * 2
    assert max(sizes) < 5000 + max(map(len, expected))


def test_other_files_are_not_followed(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    path.write_bytes(b"x" * 99)
    with closing(MessageTail(str(path))) as tail, pytest.raises(NotARecordingError):
        tail.read(1 << 20)
