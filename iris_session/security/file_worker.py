"""One thread that changes files of the home of keys, so that a slow disk keeps nobody waiting but who asked for it.

What was done is told in the loop's own turns: nothing else of the front runs in this thread.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import Final, TypeVar

from iris_session.security import KeysError

#: Jobs that wait; those who ask have one or two under way each.
CAPACITY: Final = 8
#: How long a job waits for another process that changes the same files.
PATIENCE_S: Final = 1.0
#: How long the end of the front waits for what was asked for: less than the front has to end.
CLOSE_S: Final = 1.0
T = TypeVar("T")
Told = Callable[[int], None]


class FileWorker:
    """A `Service`. Jobs run one after the other, in the order in which they were given."""

    def __init__(self) -> None:
        self._jobs: queue.Queue[Callable[[], Told] | None] = queue.Queue(CAPACITY)
        self._told: queue.SimpleQueue[Told] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def submit(self, job: Callable[[], T], done: Callable[[T | KeysError, int], None]) -> bool:
        """Has `job` run. Then a turn calls `done` with its result, or what it raised, and the session time.

        False: too much waits; ask again later.
        """

        def work() -> Told:
            outcome: T | KeysError
            try:
                outcome = job()
            except KeysError as error:
                outcome = error
            except Exception as error:  # a fault of ours: it ends the front, as it would without the thread
                return _raiser(error)
            return lambda now_ns: done(outcome, now_ns)

        try:
            self._jobs.put_nowait(work)
        except queue.Full:
            return False
        if self._thread is None:  # a daemon: a disk that hangs does not keep the process
            self._thread = threading.Thread(target=self._run, name="key-files", daemon=True)
            self._thread.start()
        return True

    def turn(self, now_ns: int) -> None:
        """Tells what was done since the last turn."""
        while not self._told.empty():
            self._told.get_nowait()(now_ns)

    def close(self) -> None:
        """Waits a moment for what was asked for; nobody is told any more."""
        if self._thread is None:
            return
        until_s = time.monotonic() + CLOSE_S
        try:
            self._jobs.put(None, timeout=CLOSE_S)
        except queue.Full:
            return
        self._thread.join(max(0.0, until_s - time.monotonic()))

    def _run(self) -> None:
        while True:
            job = self._jobs.get()
            if job is None:
                return
            self._told.put(job())


def _raiser(error: Exception) -> Told:
    def fail(_now_ns: int) -> None:
        raise error

    return fail
