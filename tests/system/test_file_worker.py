"""The file worker thread: order, bounds, exceptions, and callers that never wait."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from iris_session.system.file_worker import CAPACITY, FileWorker
from tests.front.slow_disk import turns


class DiskError(Exception):
    """An error that jobs may raise."""


def test_jobs_run_in_order_and_report_in_the_polling_thread() -> None:
    files, reports = FileWorker(DiskError), []

    def on_done(outcome: int | DiskError, now_ns: int) -> None:
        reports.append((outcome, now_ns, threading.current_thread()))

    for n in range(3):
        assert files.submit(lambda n=n: n, on_done)
    turns(files.tick, lambda: len(reports) == 3, now_ns=7)
    assert reports == [(n, 7, threading.main_thread()) for n in range(3)]
    files.close()


def test_an_expected_exception_is_reported_and_any_other_is_raised() -> None:
    files, reports = FileWorker(DiskError), []

    def failing(error: Exception) -> Callable[[], None]:
        def job() -> None:
            raise error

        return job

    files.submit(failing(DiskError("full")), lambda outcome, _now: reports.append(outcome))
    turns(files.tick, lambda: bool(reports))
    assert isinstance(reports[0], DiskError)
    files.submit(failing(ZeroDivisionError()), lambda outcome, _now: reports.append(outcome))
    with pytest.raises(ZeroDivisionError):
        turns(files.tick, lambda: False)
    files.close()


def test_hanging_job_blocks_no_caller_and_the_queue_is_bounded() -> None:
    files, reports, disk = FileWorker(DiskError), [], threading.Event()
    begun = threading.Event()

    def hang() -> None:
        begun.set()
        assert disk.wait(30.0)

    files.submit(hang, lambda _outcome, _now: reports.append("slow"))
    assert begun.wait(30.0)
    accepted = [files.submit(lambda: None, lambda _outcome, _now: reports.append("next")) for _ in range(CAPACITY + 1)]
    assert accepted == [True] * CAPACITY + [False]
    files.tick(0)
    assert reports == []
    disk.set()
    turns(files.tick, lambda: len(reports) == 1 + CAPACITY)
    assert reports[0] == "slow"
    files.close()


def test_close_waits_for_queued_jobs() -> None:
    files, written = FileWorker(DiskError), []
    for n in range(3):
        files.submit(lambda n=n: written.append(n), lambda _outcome, _now: None)
    files.close()
    assert written == [0, 1, 2]
    FileWorker(DiskError).close()  # without a job there is no thread
