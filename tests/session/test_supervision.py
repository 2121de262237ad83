"""Restarts of child processes, for which the tick loop does not wait."""

from __future__ import annotations

from itertools import pairwise

import pytest

from iris_session.journal.messages import RecorderStatus
from iris_session.recording import RecordingError
from iris_session.session import supervision
from iris_session.session.supervision import (
    HANGING_NS,
    HEALTHY_NS,
    RESTART_DELAYS_NS,
    BudgetWatch,
    RecorderSupervisor,
    RestartTimer,
)
from tests.threads import Threads

MS = 1_000_000
SECOND = 1_000 * MS


def _restarts(timer: RestartTimer, start_ns: int, until_ns: int) -> list[int]:
    """Return the times of restarts of a process that dies at once."""
    return [now for now in range(start_ns, until_ns, 50 * MS) if timer.is_due(now)]


def test_first_restart_is_immediate_and_later_ones_back_off() -> None:
    timer = RestartTimer()
    times = _restarts(timer, 60_000 * MS, 90_000 * MS)
    waits = [b - a for a, b in pairwise(times)]
    assert times[0] == 60_000 * MS
    for wait, least in zip(waits, (*RESTART_DELAYS_NS[1:], *[RESTART_DELAYS_NS[-1]] * 10), strict=False):
        assert least <= wait <= least + 100 * MS
    assert timer.restarts == len(times)


def test_long_lived_process_is_restarted_at_once() -> None:
    timer = RestartTimer()
    now_ns = 60_000 * MS
    for _ in range(3):
        while not timer.is_due(now_ns):
            now_ns += 50 * MS
    assert not timer.is_due(now_ns)  # the process died again: restarts wait by now
    while not timer.is_due(now_ns):
        now_ns += 50 * MS
    now_ns += HEALTHY_NS + 50 * MS
    assert timer.is_due(now_ns)
    assert not timer.is_due(now_ns + 50 * MS)
    assert timer.is_due(now_ns + 50 * MS + RESTART_DELAYS_NS[1])


class Recorder:
    """A recorder by the test. Its disk is asked only in threads."""

    def __init__(self) -> None:
        self.alive = True
        self.refused = False

    @property
    def failure(self) -> str:
        return "the recorder ended (exit status 1): no space left"

    def restart(self) -> None:
        if self.refused:
            raise RecordingError("no room for its log")
        self.alive = True

    def close(self, timeout_s: float) -> bool:
        self.alive = False
        return True


@pytest.fixture(autouse=True)
def threads(monkeypatch: pytest.MonkeyPatch) -> Threads:
    threads = Threads()
    monkeypatch.setattr(supervision, "threading", threads)
    return threads


def test_dead_recorder_is_replaced_while_the_loop_continues(threads: Threads) -> None:
    recorder = Recorder()
    supervisor = RecorderSupervisor(recorder)
    assert supervisor.poll(SECOND, 0) == []
    recorder.alive = False
    for i in range(100):  # its log cannot be read now: no look waits
        assert supervisor.poll(2 * SECOND + i * 50 * MS, 0) == []
    assert not supervisor.alive
    assert supervisor.restarts == 1
    threads.run_started()
    (told,) = supervisor.poll(8 * SECOND, 0)
    assert recorder.failure in told
    assert supervisor.alive
    assert supervisor.failure == recorder.failure
    assert supervisor.poll(8 * SECOND + HANGING_NS + MS, 0) == []
    assert supervisor.failure == ""  # its successor writes


def test_failed_start_of_a_recorder_is_retried_and_stays_reported(threads: Threads) -> None:
    recorder = Recorder()
    recorder.alive, recorder.refused = False, True
    supervisor = RecorderSupervisor(recorder)

    def poll(now_ns: int) -> str:
        """Return what is announced when the thread that starts now has ended."""
        assert supervisor.poll(now_ns, 0) == []
        threads.run_started()
        (told,) = supervisor.poll(now_ns, 0)
        return told

    assert "no room for its log" in poll(SECOND)
    assert supervisor.poll(SECOND + 100 * MS, 0) == []
    assert "not replaced" in poll(SECOND + 3 * HANGING_NS)
    assert supervisor.failure
    assert not supervisor.alive
    recorder.refused = False
    assert "was replaced" in poll(SECOND + 9 * HANGING_NS)
    assert supervisor.alive


def test_hanging_recorder_is_reported_once_and_close_waits_for_the_thread() -> None:
    recorder = Recorder()
    supervisor = RecorderSupervisor(recorder)
    (told,) = supervisor.poll(SECOND, HANGING_NS + 1)
    assert "hangs" in told
    assert supervisor.hangs
    assert supervisor.poll(2 * SECOND, HANGING_NS + 1) == []
    recorder.alive = False
    supervisor.poll(3 * SECOND, 0)
    assert not supervisor.hangs
    supervisor.close()
    assert recorder.alive, "it writes what is left"


def test_close_does_not_wait_for_a_hanging_disk(threads: Threads) -> None:
    recorder = Recorder()
    supervisor = RecorderSupervisor(recorder)
    recorder.alive = False
    supervisor.poll(SECOND, 0)
    threads.are_stuck = True
    supervisor.close(0.05)
    threads.run_started()
    assert not recorder.alive, "nobody would look after the successor that is started now"


def _left(n_bytes: int, *, ended: bool = False) -> RecorderStatus:
    return RecorderStatus(1, 5, 4, budget=100_000_000, budget_left=n_bytes, ended=ended)


def test_end_of_a_budget_is_announced_before_and_when_it_comes() -> None:
    watch = BudgetWatch()
    assert watch.poll(None) == watch.poll(RecorderStatus(1, 5, 4)) == watch.poll(_left(20_000_000)) == []
    assert watch.list_warnings() == []
    (told,) = watch.poll(_left(19_900_000))
    assert told.startswith("19.9 of 100 MB are left of the recording's budget")
    assert watch.poll(_left(12_300_000)) == [], "once"
    assert watch.list_warnings() == ["12.3 of 100 MB are left of the recording's budget"]
    assert not watch.is_used_up
    (told,) = watch.poll(_left(0, ended=True))
    assert told.startswith("recording ended: budget of 100 MB is used up")
    assert watch.poll(_left(0, ended=True)) == []
    assert watch.is_used_up


def test_recorder_that_has_used_its_budget_is_not_restarted() -> None:
    recorder = Recorder()
    supervisor = RecorderSupervisor(recorder)
    assert len(supervisor.poll(SECOND, 0, _left(0, ended=True))) == 1
    recorder.alive = False
    for i in range(2 * HANGING_NS // (50 * MS)):
        assert supervisor.poll(2 * SECOND + i * 50 * MS, HANGING_NS + 1) == []
    assert supervisor.restarts == 0
    assert not recorder.alive
    assert (supervisor.failure, supervisor.hangs) == ("", False)
