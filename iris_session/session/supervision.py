"""When a dead process is started again, and the recorder's own supervision, which waits for no disk and no process.

What can take longer than a tick (reading the recorder's log, starting its successor) is done by a thread, one at a
time. The tick loop only looks whether there is something new.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final, Protocol

from iris_session.recording import RecordingError

RESTART_BACKOFF_NS: Final = (0, 500_000_000, 1_000_000_000, 2_000_000_000, 5_000_000_000)
#: A process that lived this long is taken as healthy again.
HEALTHY_NS: Final = 30_000_000_000
#: A recorder says something twice a second. It is not ended when it hangs: a slow disk would delay its successor too.
HANGING_NS: Final = 5_000_000_000
#: What a successor that is just being started gets at the end: a process more, unless the disk hangs.
CLOSING_S: Final = 5.0


class Backoff:
    """When a dead process may be started again."""

    def __init__(self) -> None:
        self.failures = 0
        self.restarts = 0
        self._last_ns = 0
        self._due_ns = 0

    def dead(self, now_ns: int) -> bool:
        """True when it is time to start it again; counts the restart."""
        if not self._due_ns:
            if now_ns - self._last_ns > HEALTHY_NS:
                self.failures = 0
            self._due_ns = now_ns + RESTART_BACKOFF_NS[min(self.failures, len(RESTART_BACKOFF_NS) - 1)]
        if now_ns < self._due_ns:
            return False
        self._due_ns = 0
        self._last_ns = now_ns
        self.failures += 1
        self.restarts += 1
        return True


class Recorder(Protocol):
    """What is needed of a `RecorderProcess`."""

    @property
    def alive(self) -> bool: ...

    @property
    def failure(self) -> str: ...

    def restart(self) -> None: ...

    def close(self, timeout_s: float) -> bool: ...


class RecorderSupervisor:
    """Watches one recorder. All but the thread's work belongs to the tick loop, which never waits here.

    `alive`, `hangs`, `failure`: as last looked at; `failure` says why it ended until its successor has written for a
    while.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._backoff = Backoff()
        self._thread: threading.Thread | None = None
        self._given_up = threading.Event()
        self._news: tuple[str, str] | None = None  # why it ended, and what became of it
        self._failed_ns = 0
        self.alive = True
        self.hangs = False
        self.failure = ""

    @property
    def restarts(self) -> int:
        return self._backoff.restarts

    def look(self, now_ns: int, silence_ns: int) -> list[str]:
        """What is to be told. `silence_ns`: how long it has said nothing though it has something to write."""
        told = []
        if self._thread is not None and not self._thread.is_alive():
            self._thread = None
            if self._news is not None:
                self.failure, what = self._news
                self._failed_ns = now_ns
                told.append(f"{self.failure}; it {what}")
        if self._thread is None:  # while the thread works, the process is the thread's
            self.alive = self._recorder.alive
            if not self.alive and self._backoff.dead(now_ns):
                self._news = None
                self._thread = threading.Thread(target=self._replace, name="iris-recorder", daemon=True)
                self._thread.start()
        hangs = silence_ns > HANGING_NS
        if hangs and not self.hangs:
            told.append("the recorder hangs: what it does not take waits on the disk")
        self.hangs = hangs
        if self.failure and self.alive and now_ns - self._failed_ns > HANGING_NS and not hangs:
            self.failure = ""  # its successor writes
        return told

    def close(self, patience_s: float = CLOSING_S) -> None:
        """Waits for the thread: the process is the caller's from here on. One that a disk keeps is left to itself, and
        ends the successor that it may still start: nobody would look after that one."""
        if self._thread is not None:
            self._thread.join(patience_s)
            self._given_up.set()
            self._thread = None

    def _replace(self) -> None:
        failure = self._recorder.failure or "the recorder ended"
        self._news = failure, replaced(self._recorder.restart)
        if self._given_up.is_set():
            self._recorder.close(0.0)


def replaced(restart: Callable[[], None], error_type: type[Exception] = RecordingError) -> str:
    """Starts a process anew. One that cannot be started now (no memory, a full disk) ends no session."""
    try:
        restart()
    except error_type as error:
        return f"is not replaced: {error}"
    return "was replaced"
