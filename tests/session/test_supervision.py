"""Restarts of child processes, for which the tick loop does not wait."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from itertools import pairwise

from iris_session.journal.messages import RecorderStatus
from iris_session.recording import RecordingError
from iris_session.session.supervision import (
    HANGING_NS,
    HEALTHY_NS,
    RESTART_DELAYS_NS,
    BudgetWatch,
    RecorderSupervisor,
    RestartTimer,
)

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
    """A recorder whose disk answers only when `disk` is set."""

    def __init__(self) -> None:
        self.alive = True
        self.disk = threading.Event()
        self.refused = False
        self.readers: list[threading.Thread] = []
        self.closed = threading.Event()

    @property
    def failure(self) -> str:
        self.readers.append(threading.current_thread())
        assert self.disk.wait(30.0)
        return "the recorder ended (exit status 1): no space left"

    def restart(self) -> None:
        if self.refused:
            raise RecordingError("no room for its log")
        self.alive = True

    def close(self, timeout_s: float) -> bool:
        self.alive = False
        self.closed.set()
        return True


def _until(look: Callable[[], list[str]]) -> list[str]:
    """Wait for the first report."""
    until = time.monotonic() + 30.0
    while time.monotonic() < until:
        if told := look():
            return told
        time.sleep(0.001)
    raise AssertionError("nothing was told")


def test_dead_recorder_is_replaced_while_the_loop_continues() -> None:
    recorder = Recorder()
    supervisor = RecorderSupervisor(recorder)
    assert supervisor.poll(SECOND, 0) == []
    recorder.alive = False
    for i in range(100):  # its log cannot be read now: no look waits
        assert supervisor.poll(2 * SECOND + i * 50 * MS, 0) == []
    assert not supervisor.alive
    assert supervisor.restarts == 1
    recorder.disk.set()
    (told,) = _until(lambda: supervisor.poll(8 * SECOND, 0))
    assert "exit status 1" in told
    assert "no space left" in told
    assert threading.main_thread() not in recorder.readers
    assert supervisor.alive
    assert "no space left" in supervisor.failure
    assert supervisor.poll(8 * SECOND + HANGING_NS + MS, 0) == []
    assert supervisor.failure == ""  # its successor writes


def test_failed_start_of_a_recorder_is_retried_and_stays_reported() -> None:
    recorder = Recorder()
    recorder.disk.set()
    recorder.alive, recorder.refused = False, True
    supervisor = RecorderSupervisor(recorder)
    (told,) = _until(lambda: supervisor.poll(SECOND, 0))
    assert "no room for its log" in told
    assert supervisor.poll(SECOND + 100 * MS, 0) == []
    (told,) = _until(lambda: supervisor.poll(SECOND + 3 * HANGING_NS, 0))
    assert "not replaced" in told
    assert supervisor.failure
    assert not supervisor.alive
    recorder.refused = False
    (told,) = _until(lambda: supervisor.poll(SECOND + 9 * HANGING_NS, 0))
    assert told.endswith("it was replaced")


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
    recorder.disk.set()
    supervisor.close()
    assert recorder.alive
    assert not recorder.closed.is_set(), "it writes what is left"


def test_close_does_not_wait_for_a_hanging_disk() -> None:
    recorder = Recorder()
    supervisor = RecorderSupervisor(recorder)
    recorder.alive = False
    supervisor.poll(SECOND, 0)
    supervisor.close(0.05)
    assert not recorder.alive, "and its disk has not answered yet"
    recorder.disk.set()
    assert recorder.closed.wait(30.0), "nobody would look after the successor that is started now"
    assert not recorder.alive


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
    recorder.disk.set()
    supervisor = RecorderSupervisor(recorder)
    assert len(supervisor.poll(SECOND, 0, _left(0, ended=True))) == 1
    recorder.alive = False
    for i in range(2 * HANGING_NS // (50 * MS)):
        assert supervisor.poll(2 * SECOND + i * 50 * MS, HANGING_NS + 1) == []
    assert supervisor.restarts == 0
    assert not recorder.alive
    assert (supervisor.failure, supervisor.hangs) == ("", False)
