"""Restarting front and recorder: when a dead process may be started again, and the supervision of the recorder.

Supervision waits for no disk and no process. What can take longer than a tick (reading the recorder's log, starting its
successor) is done by a thread, one at a time; the tick loop only polls for its result.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final, Protocol

from iris_session.journal.messages import RecorderStatus
from iris_session.protocol.common import MAX_TEXT
from iris_session.protocol.status import RecorderReport
from iris_session.recording import RecorderFeed, RecorderProcess, RecordingError
from iris_session.recording.budget import LOW_SHARE, describe_used_budget
from iris_session.system.backoff import Backoff

RESTART_DELAYS_NS: Final = (0, 500_000_000, 1_000_000_000, 2_000_000_000, 5_000_000_000)
#: A process that lived this long counts as healthy again.
HEALTHY_NS: Final = 30_000_000_000
#: A recorder reports twice a second. It is not ended when it hangs: a slow disk would delay its successor too.
HANGING_NS: Final = 5_000_000_000
#: Time at the end for a successor that is just being started: a process more, unless the disk hangs.
CLOSING_S: Final = 5.0
#: Why a recording that goes on has no picture.
NO_PICTURE: Final = "the picture is not recorded: an error in drawing has ended the recorder before"


class RestartTimer:
    """Spaces the restarts of a process that dies again and again. `restarts`: so far."""

    def __init__(self) -> None:
        self.restarts = 0
        self._backoff = Backoff(RESTART_DELAYS_NS)
        self._last_ns = 0
        self._due_ns = 0

    def is_due(self, now_ns: int) -> bool:
        """Return whether the process, which is dead, is to be restarted now; counts the restart."""
        if not self._due_ns:
            if now_ns - self._last_ns > HEALTHY_NS:
                self._backoff.reset()
            self._due_ns = now_ns + self._backoff.next_delay()
        if now_ns < self._due_ns:
            return False
        self._due_ns = 0
        self._last_ns = now_ns
        self.restarts += 1
        return True


class Recorder(Protocol):
    """The part of `RecorderProcess` that supervision uses."""

    @property
    def alive(self) -> bool: ...

    @property
    def failure(self) -> str: ...

    def restart(self) -> None: ...

    def close(self, timeout_s: float) -> bool: ...


class BudgetWatch:
    """Announces that the budget of a recording comes to its end, and that it is used up, once each.

    Attributes:
        is_used_up: The file is closed, and nothing more is recorded.
        text: One line for people once it comes to its end; empty before, and without a budget.
    """

    def __init__(self) -> None:
        self.is_used_up = False
        self.text = ""

    def poll(self, status: RecorderStatus | None) -> list[str]:
        """Return what is to be announced after a report of the recorder, a line each."""
        if status is None or not status.budget or self.is_used_up:
            return []
        if status.ended:
            self.is_used_up = True
            self.text = describe_used_budget(status.budget)
            return [f"{self.text}; the session goes on without it"]
        if status.budget_left >= LOW_SHARE * status.budget:
            return []
        is_new = not self.text
        self.text = (
            f"{status.budget_left / 1e6:,.1f} of {status.budget / 1e6:,.0f} MB are left of the recording's budget"
        )
        return (
            [f"{self.text}: what the journal does not need is left out first, then the recording ends"]
            if is_new
            else []
        )

    def list_warnings(self) -> list[str]:
        """Return the warning for status reports, if there is one."""
        return [self.text] if self.text else []


class RecorderSupervisor:
    """Restarts one recorder. All but the thread's work belongs to the tick loop, which never waits here.

    Attributes:
        alive: As of the last `poll`.
        hangs: The recorder has not reported for `HANGING_NS` though it has something to write.
        failure: Why it ended, until its successor has written for a while.
        budget: What is left of the budget of the recording.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._timer = RestartTimer()
        self._thread: threading.Thread | None = None
        self._is_closed = threading.Event()
        self._result: tuple[str, str] | None = None  # why it ended, and the outcome of the restart
        self._failed_ns = 0
        self.alive = True
        self.hangs = False
        self.failure = ""
        self.budget = BudgetWatch()

    @property
    def restarts(self) -> int:
        return self._timer.restarts

    def poll(self, now_ns: int, silence_ns: int, status: RecorderStatus | None = None) -> list[str]:
        """Restart the recorder when it is dead and it is time to; return what is to be announced, a line each.

        Args:
            now_ns: Session time.
            silence_ns: How long it has not reported though it has something to write.
            status: Its last report. One that has used up the budget is not restarted.
        """
        announcements = self.budget.poll(status)
        if self.budget.is_used_up:
            self.failure, self.hangs = "", False
            return announcements
        if self._thread is not None and not self._thread.is_alive():
            self._thread = None
            if self._result is not None:
                self.failure, outcome = self._result
                self._failed_ns = now_ns
                announcements.append(f"{self.failure}; it {outcome}")
        if self._thread is None:  # while the thread works, the process is the thread's
            self.alive = self._recorder.alive
            if not self.alive and self._timer.is_due(now_ns):
                self._result = None
                self._thread = threading.Thread(target=self._restart, name="iris-recorder", daemon=True)
                self._thread.start()
        hangs = silence_ns > HANGING_NS
        if hangs and not self.hangs:
            announcements.append("the recorder hangs: its rows wait in memory")
        self.hangs = hangs
        if self.failure and self.alive and now_ns - self._failed_ns > HANGING_NS and not hangs:
            self.failure = ""  # its successor writes
        return announcements

    def close(self, timeout_s: float = CLOSING_S) -> None:
        """Wait for the thread: the process is the caller's from here on.

        A thread that is kept by a disk is left alone, and ends the successor that it may still start, which nothing
        else would supervise.
        """
        if self._thread is not None:
            self._thread.join(timeout_s)
            self._is_closed.set()
            self._thread = None

    def _restart(self) -> None:
        failure = self._recorder.failure or "the recorder ended"
        self._result = failure, try_restart(self._recorder.restart)
        if self._is_closed.is_set():
            self._recorder.close(0.0)


def try_restart(restart: Callable[[], None], error_type: type[Exception] = RecordingError) -> str:
    """Restart a process and return the outcome for people: no memory or a full disk must not end a session."""
    try:
        restart()
    except error_type as error:
        return f"is not replaced: {error}"
    return "was replaced"


def make_recorder_report(
    feed: RecorderFeed | None, recorder: RecorderProcess | None, supervisor: RecorderSupervisor | None
) -> RecorderReport:
    """Return how the recording does, from the recorder's last report and its supervisor; `off` without a recorder."""
    if feed is None or recorder is None or supervisor is None:
        return RecorderReport()
    stats = feed.stats
    last = stats.recorder
    fault = supervisor.failure or ("" if last is None else last.fault)
    state = "running"
    if supervisor.budget.is_used_up:
        state, fault = "ended", supervisor.budget.text
    elif fault:
        state = "failed"
    elif not supervisor.alive:
        state = "dead"
    elif supervisor.hangs:
        state = "hangs"
    fault = fault or stats.drop_reason or (NO_PICTURE if recorder.journal_only else "")
    return RecorderReport(
        state,
        recorder.path[-MAX_TEXT:],
        0 if last is None else last.bytes,
        0 if last is None else last.disk_free,
        stats.dropped_rows,
        stats.waiting_bytes,
        fault[:MAX_TEXT],
    )
