"""One thread that changes files, so that a slow disk delays nothing but the jobs that need it.

Results are reported by `tick`, in the thread that calls it: nothing of the caller runs in the worker's thread.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import Final, Generic, TypeVar

#: Queued jobs; each caller has one or two under way.
CAPACITY: Final = 8
#: How long a job should wait for another process that changes the same files.
LOCK_TIMEOUT_S: Final = 1.0
#: How long `close` waits for queued jobs: less than the front has to shut down.
CLOSE_TIMEOUT_S: Final = 1.0
T = TypeVar("T")
E = TypeVar("E", bound=Exception)
Report = Callable[[int], None]


class FileWorker(Generic[E]):
    """A thread that runs jobs one after the other, in the order in which they were submitted.

    `expected`: exceptions of a job that are handed to its callback. Any other is raised by `tick`.
    """

    def __init__(self, expected: type[E]) -> None:
        self._expected = expected
        self._jobs: queue.Queue[Callable[[], Report] | None] = queue.Queue(CAPACITY)
        self._reports: queue.SimpleQueue[Report] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def submit(self, job: Callable[[], T], on_done: Callable[[T | E, int], None]) -> bool:
        """Queue `job`. A later `tick` calls `on_done` with its result or expected exception, and the session time.

        Returns False when the queue is full: try again later.
        """

        def work() -> Report:
            outcome: T | E
            try:
                outcome = job()
            except self._expected as error:
                outcome = error
            except Exception as error:  # a bug: it ends the front, as it would without the thread
                return _raise_later(error)
            return lambda now_ns: on_done(outcome, now_ns)

        try:
            self._jobs.put_nowait(work)
        except queue.Full:
            return False
        if self._thread is None:  # a daemon: a disk that hangs does not keep the process alive
            self._thread = threading.Thread(target=self._run, name="key-files", daemon=True)
            self._thread.start()
        return True

    def tick(self, now_ns: int) -> None:
        """Call the callbacks of the jobs that finished since the last call."""
        while not self._reports.empty():
            self._reports.get_nowait()(now_ns)

    def close(self) -> None:
        """Wait up to `CLOSE_TIMEOUT_S` for queued jobs. Their callbacks are not called any more."""
        if self._thread is None:
            return
        deadline_s = time.monotonic() + CLOSE_TIMEOUT_S
        try:
            self._jobs.put(None, timeout=CLOSE_TIMEOUT_S)
        except queue.Full:
            return
        self._thread.join(max(0.0, deadline_s - time.monotonic()))

    def _run(self) -> None:
        while True:
            job = self._jobs.get()
            if job is None:
                return
            self._reports.put(job())


def _raise_later(error: Exception) -> Report:
    def fail(_now_ns: int) -> None:
        raise error

    return fail
