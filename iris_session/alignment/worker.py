"""Workers that compute estimates: at once, or in a thread beside the loop of the front.

An estimate takes up to several milliseconds, in which the loop would send no state. One job runs at a time, and
the next is submitted after its result, so nothing queues.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Final, Protocol

Job = Callable[[], Callable[[], None]]
#: How long `close` waits for the job that runs.
CLOSE_TIMEOUT_S: Final = 1.0


class Worker(Protocol):
    """Runs one job at a time. A job returns what is to be done with its result, in the thread of the caller."""

    @property
    def is_busy(self) -> bool:
        """True from `submit` until `poll` has done what the job returned."""
        ...

    def submit(self, job: Job) -> None:
        """Begin a job. The worker must not be busy."""
        ...

    def poll(self) -> None:
        """Do what a finished job returned. Raises the exception of a job that failed."""
        ...

    def close(self) -> None:
        """End the worker; the result of a job that still runs is discarded."""
        ...


class InlineWorker:
    """Runs a job within `submit`."""

    is_busy = False

    def submit(self, job: Job) -> None:
        """Run a job, and do what it returns."""
        job()()

    def poll(self) -> None:
        """Do nothing: everything is done."""

    def close(self) -> None:
        """Do nothing: nothing was opened."""


class ThreadWorker:
    """Runs jobs in a thread of its own, which is started by the first."""

    def __init__(self) -> None:
        self.is_busy = False
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._results: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def submit(self, job: Job) -> None:
        """Begin a job."""
        assert not self.is_busy, "one job at a time"
        self.is_busy = True
        self._jobs.put(job)
        if self._thread is None:  # a daemon: an estimate does not keep the process alive
            self._thread = threading.Thread(target=self._run, name="estimates", daemon=True)
            self._thread.start()

    def poll(self) -> None:
        """Do what the finished job returned, if it has finished."""
        if self._results.empty():
            return
        finish = self._results.get_nowait()
        self.is_busy = False
        finish()

    def close(self) -> None:
        """Let the thread end after the job that runs."""
        if self._thread is not None:
            self._jobs.put(None)
            self._thread.join(CLOSE_TIMEOUT_S)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                self._results.put(job())
            except Exception as error:  # a bug: it ends the front, as it would without the thread
                self._results.put(_raise_later(error))


def _raise_later(error: Exception) -> Callable[[], None]:
    def fail() -> None:
        raise error

    return fail
