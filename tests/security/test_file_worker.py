"""The thread that writes key files: order, bounds, what it raises, and that nobody waits for it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from iris_session.security import KeysError, file_worker
from iris_session.security.file_worker import CAPACITY, CLOSE_S, FileWorker
from tests.front.slow_disk import turns


def test_jobs_run_in_order_and_are_told_in_the_loops_own_thread() -> None:
    files, told = FileWorker(), []

    def done(outcome: int | KeysError, now_ns: int) -> None:
        told.append((outcome, now_ns, threading.current_thread()))

    for n in range(3):
        assert files.submit(lambda n=n: n, done)
    turns(files.turn, lambda: len(told) == 3, now_ns=7)
    assert told == [(n, 7, threading.main_thread()) for n in range(3)]
    files.close()


def test_what_a_disk_raises_is_told_and_a_fault_of_ours_is_not_hidden() -> None:
    files, told = FileWorker(), []

    def fails(error: Exception) -> Callable[[], None]:
        def job() -> None:
            raise error

        return job

    files.submit(fails(KeysError("full")), lambda outcome, _now: told.append(outcome))
    turns(files.turn, lambda: bool(told))
    assert str(told[0]) == "full"
    files.submit(fails(ZeroDivisionError("ours")), lambda outcome, _now: told.append(outcome))
    with pytest.raises(ZeroDivisionError, match="ours"):
        turns(files.turn, lambda: False)
    files.close()


def test_a_job_that_hangs_keeps_nobody_and_no_more_than_a_few_wait() -> None:
    files, told, disk = FileWorker(), [], threading.Event()
    begun = threading.Event()

    def hangs() -> None:
        begun.set()
        assert disk.wait(30.0)

    files.submit(hangs, lambda _outcome, _now: told.append("slow"))
    assert begun.wait(30.0)
    taken = [files.submit(lambda: None, lambda _outcome, _now: told.append("then")) for _ in range(CAPACITY + 1)]
    assert taken == [True] * CAPACITY + [False]
    files.turn(0)
    assert told == []
    disk.set()
    turns(files.turn, lambda: len(told) == 1 + CAPACITY)
    assert told[0] == "slow"
    files.close()


def test_the_end_has_one_bound_for_all_that_it_waits_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Room in the queue first, then the thread."""
    files = FileWorker()
    files.submit(lambda: None, lambda _outcome, _now: None)
    now_s, waited = 100.0, []

    def put(_job: object, timeout: float) -> None:
        nonlocal now_s
        now_s += 0.7 * timeout

    thread = files._thread
    assert thread is not None
    monkeypatch.setattr(file_worker, "time", SimpleNamespace(monotonic=lambda: now_s))
    monkeypatch.setattr(files._jobs, "put", put)
    monkeypatch.setattr(thread, "join", waited.append)
    files.close()
    assert waited == [pytest.approx(0.3 * CLOSE_S)]
    monkeypatch.undo()
    files.close()


def test_the_end_waits_for_what_was_asked_for() -> None:
    files, written = FileWorker(), []
    for n in range(3):
        files.submit(lambda n=n: written.append(n), lambda _outcome, _now: None)
    files.close()
    assert written == [0, 1, 2]
    FileWorker().close()  # nothing was asked for: there is no thread
