"""The budget of a recording: what is left out as it ends, and that the session goes on."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from iris_session.recording import Recording, summarise, verify
from iris_session.recording import process as process_module
from iris_session.recording.budget import END_BYTES, LOW_SHARE, MIN_BUDGET_BYTES, RecordingBudget
from iris_session.rrd.paths import part_path
from tests.recording.support import SmallCore, SmallSession, loop_recorder

BUDGET = 1_500_000


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


def test_recorder_closes_its_file_and_the_session_goes_on() -> None:
    with loop_recorder(budget_bytes=BUDGET) as one:
        session = SmallSession(one.feed)
        while not one.loop._is_used_up:
            session.take(50)
            one.pump(lambda: True)
        one.loop._close_file()
        one.loop._send_status(one.loop._received)
        assert one.feed._socket.poll(20_000)
        session.take(500)
        assert one.feed.stats.dropped_rows == one.feed.stats.window_bytes == 0
        assert one.feed.close()
        one.kill()
        report = verify(one.path, SmallCore)
        assert report.ok, report.line()
        assert report.finished
        assert 0 < report.steps < session.step_count - 500
        with Recording.open(one.path) as recording:
            summary = summarise(recording)
        assert summary.ok
        assert "budget" in summary.ending
        assert one.path.stat().st_size <= BUDGET


def test_recorder_that_was_killed_at_the_end_gets_no_further_part() -> None:
    with loop_recorder(budget_bytes=BUDGET) as one:
        session = SmallSession(one.feed)
        session.take(10)
        one.pump()
        one.kill()
        with open(one.path, "ab") as file:
            file.truncate(BUDGET)
        assert RecordingBudget(BUDGET, str(one.path), 2).is_used_up(0)
        assert process_module.report_used_budget(msgspec.structs.replace(one.loop._config, part=2)) == 0
        assert one.feed._socket.poll(20_000)
        session.take(500)
        assert one.feed.stats.recorder is not None
        assert one.feed.stats.recorder.ended
        assert one.feed.close()
        assert [path.name for path in one.folder.glob("*.rrd")] == ["session.rrd"]
