"""The budget of a recording: what is left out as it ends, and that the session goes on, with a real recorder too."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from iris_session.journal.feed import RecorderFeed
from iris_session.journal.messages import RecorderConfig
from iris_session.recording import Recording, summarise, verify
from iris_session.recording import process as process_module
from iris_session.recording.budget import END_BYTES, LOW_SHARE, MIN_BUDGET_BYTES, RecordingBudget
from iris_session.recording.supervise import RecorderProcess
from iris_session.rrd.paths import part_path
from tests.recording.support import SmallCore, SmallSession, make_header, wait_until

BUDGET = 1_500_000


def test_no_budget_is_never_short() -> None:
    budget = RecordingBudget(0, "/nowhere/session.rrd", 3)
    assert not budget.is_short(1 << 60)
    assert not budget.is_used_up(1 << 60)
    assert budget.assets_bytes is None


@pytest.mark.parametrize("total", [MIN_BUDGET_BYTES, 20 * 10**9, 10**12])
def test_journal_goes_on_after_the_rest_and_both_end_before_the_budget(total: int) -> None:
    budget = RecordingBudget(total, "/nowhere/session.rrd", 1)
    end = total - round(max(END_BYTES, 0.02 * total))
    assert LOW_SHARE * total < budget.count_left(int(0.7 * total)), "announced before anything is left out"
    assert not budget.is_short(int(0.85 * total))
    assert budget.is_short(end - 1)
    assert not budget.is_used_up(end - 1)
    assert budget.is_used_up(end)
    assert budget.count_left(2 * total) == 0


def test_earlier_parts_count(tmp_path: Path) -> None:
    path = str(tmp_path / "session.rrd")
    for part, n_bytes in ((1, 6_000_000), (3, 3_000_000)):  # a part may be missing
        with open(part_path(path, part), "wb") as file:
            file.truncate(n_bytes)
    assert RecordingBudget(11_000_000, path, 4).max_bytes == 2_000_000
    assert RecordingBudget(11_000_000, path, 4).count_left(50) == 999_950
    assert RecordingBudget(10_000_000, path, 4).is_used_up(0)
    assert RecordingBudget(10_000_000, path, 3).count_left(50) == 2_999_950


def test_raw_samples_are_left_out_first(tmp_path: Path) -> None:
    config = RecorderConfig(
        *(str(tmp_path / "session.rrd"), 1, "r", f"ipc://{tmp_path}/f", f"ipc://{tmp_path}/s", 0, os.getpid()),
        budget_bytes=MIN_BUDGET_BYTES,
    )
    loop = process_module.RecorderLoop(config)
    batch = msgspec.msgpack.encode([(1, 5, b"x")] * 3)
    loop._process_samples(batch)
    loop._budget = RecordingBudget(loop._writer.size_with_index + END_BYTES + 1000, "", 1)
    assert not loop._budget.is_used_up(loop._writer.size_with_index)
    loop._process_samples(batch)
    assert (loop._samples_left_out, len(loop._writer._samples)) == (3, 3)
    loop._writer.write_header(make_header())
    loop._close_file()
    loop._syncer.stop()
    loop._context.destroy(linger=0)
    with Recording.open(tmp_path / "session.rrd") as recording:
        assert recording.samples_left_out == summarise(recording).drops.samples_left_out == 3


def is_ended(feed: RecorderFeed) -> bool:
    feed.flush()
    return feed.stats.recorder is not None and feed.stats.recorder.ended


def get_written(session: SmallSession) -> int:
    """Take some steps. Return the newest batch that is in the file."""
    session.take(10)
    status = session.feed.stats.recorder
    return -1 if status is None else status.written


@contextmanager
def record_small_session(path: Path) -> Iterator[tuple[SmallSession, RecorderProcess]]:
    """Start a recorder with the budget, and a session that it records."""
    process = RecorderProcess(path, time.monotonic_ns(), budget_bytes=BUDGET)
    process.start()
    feed = RecorderFeed(process.feed_endpoint)
    try:
        yield SmallSession(feed), process
    finally:
        feed.close(0.0)
        process.close()


@pytest.mark.e2e
def test_recorder_closes_its_file_and_the_session_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    with record_small_session(path) as (session, process):
        feed = session.feed
        wait_until(lambda: get_written(session) and not process.alive, 60.0)
        assert process.failure == "", "it has ended in order"
        session.take(500)
        wait_until(lambda: is_ended(feed))
        session.take(500)
        assert feed.stats.dropped_rows == feed.stats.window_bytes == 0
        assert feed.close()
    report = verify(path, SmallCore)
    assert report.ok, report.line()
    assert report.finished
    assert 0 < report.steps < session.step_count - 1000
    with Recording.open(path) as recording:
        assert len(recording.files) == 1
        summary = summarise(recording)
    assert summary.ok
    assert summary.ending.startswith("recording ended: budget of 2 MB is used up")
    assert path.stat().st_size <= BUDGET


@pytest.mark.e2e
def test_recorder_that_was_killed_at_the_end_gets_no_further_part(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    with record_small_session(path) as (session, process):
        feed = session.feed
        wait_until(lambda: get_written(session) > 5)
        os.kill(process.pid, signal.SIGKILL)
        wait_until(lambda: not process.alive)
        with open(path, "ab") as file:
            file.truncate(BUDGET)
        process.restart()
        wait_until(lambda: get_written(session) < 0 and is_ended(feed))
        wait_until(lambda: not process.alive)
        assert process.failure == ""
    assert sorted(one.name for one in tmp_path.iterdir()) == ["session.rrd"]
