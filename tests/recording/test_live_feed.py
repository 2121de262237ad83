"""Recordings that are being written reach a viewer: every message once, in order, over parts, and nothing waits."""

from __future__ import annotations

import signal
import socket
import subprocess
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import pytest

from iris_session.recording import NotARecordingError
from iris_session.recording.live_feed import LiveFeed, MessageTail
from iris_session.rrd.file import KIND_END, read_message, scan_file
from iris_session.rrd.rerun_tool import find_rerun, make_environment
from tests.loopback import make_loopback_address
from tests.recording.support import column, journal, read, wait_until, write

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


@contextmanager
def receiver(path: Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """Start Rerun's server, which writes what it gets to `path`; yield it and its address."""
    host = make_loopback_address()  # no other test takes the port meanwhile
    with socket.socket() as listener:
        listener.bind((host, 0))
        port = listener.getsockname()[1]
    command = [find_rerun(), "--bind", host, "--port", str(port), "--save", path]
    server = subprocess.Popen(command, env=make_environment(), stderr=subprocess.DEVNULL)
    try:
        yield server, f"rerun+http://{host}:{port}/proxy"
    finally:
        server.send_signal(signal.SIGCONT)
        server.kill()
        server.wait()


def steps_received(path: Path) -> list[int]:
    try:
        return sorted(set(column(read(path)["/journal/rows"], "step")))
    except (OSError, LookupError, ValueError, RuntimeError):  # not there yet, or cut
        return []


def play_states(path: Path) -> list[tuple[bytes, list[int]]]:
    """Return row ids and play states of the blueprint in a file that is being written."""
    from rerun.chunk import RrdReader

    with warnings.catch_warnings(), suppress(OSError, ValueError, RuntimeError):
        warnings.simplefilter("ignore")  # there is no index
        reader = RrdReader(str(path))
        (blueprint,) = reader.blueprints()
        assert len(reader.recordings()) == 1
        batches = [chunk.to_record_batch() for chunk in reader.stream(store=blueprint)]
        found = [batch for batch in batches if "TimePanelBlueprint:play_state" in batch.schema.names]
        ids = column(found, "rerun.controls.RowId")
        return [*zip(ids, column(found, "TimePanelBlueprint:play_state"), strict=True)]
    return []


@pytest.mark.e2e
@pytest.mark.long
def test_viewer_gets_everything_and_follows(closed: Path, tmp_path: Path) -> None:
    got = tmp_path / "got.rrd"
    with receiver(got) as (_, url):
        feed = LiveFeed(str(closed), url)
        while feed.poll():
            pass
        feed.close()
        wait_until(lambda: steps_received(got) == list(range(STEPS)) and len(play_states(got)) == 2)
    assert max(play_states(got))[1] == [3], "following, in place of paused"
