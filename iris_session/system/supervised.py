"""A child process that writes reports, and its successors: started in a thread, restarted after growing delays.

The caller keeps the time and polls; nothing here waits for the process.
"""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Final, Generic, Protocol, TypeVar

import msgspec

from iris_session.system.backoff import Backoff
from iris_session.system.process import ChildProcess

SECOND: Final = 1_000_000_000
#: The last one repeats: what a start takes, a second of processor time or two, is then a few percent.
RESTART_DELAYS_NS: Final = (0, SECOND // 2, SECOND, 2 * SECOND, 5 * SECOND, 30 * SECOND)
#: A process that lived this long counts as healthy again.
HEALTHY_NS: Final = 30 * SECOND
#: A process that starts is given so long for each report: it imports, and compiles what it needs in one go, without a
#: chance to report. The filter of clouds takes 5 s of processor time, of which a busy machine gives a tenth.
START_NS: Final = 120 * SECOND
log = logging.getLogger(__name__)


class ProcessReport(Protocol):
    """Report of a process: what it has refused or dropped by reason, and why it ends, empty while all is well."""

    @property
    def drops(self) -> dict[str, int]: ...

    @property
    def fault(self) -> str: ...


Report = TypeVar("Report", bound=ProcessReport)


class SupervisedProcess(Generic[Report]):
    """A process whose standard output are reports, a line of JSON each, and its successors.

    Args:
        title: Name for people, as `the web gateway`.
        spawn: Starts the process. Called in a thread; what it raises is announced.
        report_type: Type of the reports; without arguments it is that of a process that has not reported.
        hang_ns: A process that has started and then does not report for this long is ended; 0: none ever is.
        is_starting: Whether a process still starts, by a report of it; by default it has started with the first one.

    Attributes:
        report: The newest report of the process.
        heard_ns: Time of `poll` at which it came, `None` before the first.
        fault: Why the process before this one ended, as it said; empty where it said nothing, or there was none.
        restarts: How often it was restarted.
    """

    def __init__(
        self,
        title: str,
        spawn: Callable[[], ChildProcess],
        report_type: type[Report],
        *,
        hang_ns: int = 0,
        is_starting: Callable[[Report], bool] = lambda _: False,
    ) -> None:
        self._title = title
        self._spawn = spawn
        self._type = report_type
        self._hang_ns = hang_ns
        self._is_starting = is_starting
        self._process: ChildProcess | None = None
        self._thread: threading.Thread | None = None
        self._backoff = Backoff(RESTART_DELAYS_NS)
        self._started_ns = self._due_ns = 0
        self.fault = ""
        self._failure = self._hang = self._announced = ""
        self._was_started = self._closed = self._has_warned = False
        self._earlier_drops: dict[str, int] = {}
        self.report = report_type()
        self.heard_ns: int | None = None
        self.restarts = 0

    @property
    def pid(self) -> int:
        """Process id, 0 while there is none."""
        return self._process.pid if self._process is not None and self._process.is_running else 0

    @property
    def is_started(self) -> bool:
        """True from `start` on."""
        return self._was_started

    @property
    def failure(self) -> str:
        """One line for people about why there is no process, or why one after the other has ended; else empty."""
        return self._announced if not self.pid or self._backoff.failures > 1 else ""

    @property
    def last_ns(self) -> int:
        """Time of the last report, or of the start."""
        return self._started_ns if self.heard_ns is None else self.heard_ns

    @property
    def is_starting(self) -> bool:
        """True until a report says that the process has started."""
        return self.heard_ns is None or self._is_starting(self.report)

    @property
    def limit_ns(self) -> int:
        """The process is ended when it does not report for so long."""
        return START_NS if self.is_starting else self._hang_ns

    @property
    def drops(self) -> dict[str, int]:
        """Counters of what this process and those before it have refused or dropped, by reason."""
        reasons = {**self._earlier_drops, **self.report.drops}
        return {one: self._earlier_drops.get(one, 0) + self.report.drops.get(one, 0) for one in reasons}

    def start(self, now_ns: int) -> None:
        """Start the process, in a thread. `now_ns`: a monotonic time."""
        self._was_started, self._has_warned = True, False
        self._started_ns, self._due_ns, self.heard_ns = now_ns, 0, None
        self._thread = threading.Thread(target=self._run_spawn, name="iris-spawn", daemon=True)
        self._thread.start()

    def poll(self, now_ns: int) -> list[str]:
        """Read reports, and start the process again when it has ended. Never waits.

        Args:
            now_ns: A monotonic time.

        Returns:
            What is to be announced, one line each.
        """
        if self._thread is not None:
            if self._thread.is_alive():
                return []
            self._thread = None
            if self._failure:
                return self._announce(f"{self._title} does not start: {self._failure}", now_ns)
        if self._process is None:
            if self._due_ns and now_ns >= self._due_ns:
                self.start(now_ns)
            return []
        self._read_reports(self._process, now_ns)
        # One that reports all the time has to have done so: it may have hung since it was started.
        if (self.last_ns if self._hang_ns else now_ns) - self._started_ns > HEALTHY_NS:
            self._backoff.reset()
            self._announced = ""
        if self._process.is_running:
            if self._hang_ns and now_ns - self.last_ns > self.limit_ns:
                self._hang = f"did not report for {self.limit_ns / SECOND:g} s and was ended"
                self._process.send_signal(signal.SIGKILL)
            return []
        self.fault = self.report.fault
        how = f"ended: {self.fault}" if self.fault else self._hang or _describe_exit(self._process.exit_status)
        self._process.close()
        self._process, self._hang = None, ""
        self._earlier_drops, self.report = self.drops, self._type()
        return self._announce(f"{self._title} {how}; it is started again", now_ns)

    def terminate(self) -> None:
        """Ask the process to end: several end at the same time before each is closed."""
        self._closed = True
        if self._process is not None:
            self._process.send_signal(signal.SIGTERM)

    def close(self, timeout_s: float) -> None:
        """End the process by SIGTERM, after `timeout_s` by SIGKILL. May be called twice."""
        self._closed = True
        if self._thread is not None:
            self._thread.join(timeout_s)
            self._thread = None
        if self._process is not None:
            self._process.close(terminate_s=timeout_s)
            self._process = None

    def _announce(self, text: str, now_ns: int) -> list[str]:
        """Set when to try again. Return the line, unless it is the last one again."""
        self._due_ns = now_ns + max(1, self._backoff.next_delay())
        self.restarts += 1
        if text == self._announced:
            return []
        self._announced = text
        return [text]

    def _run_spawn(self) -> None:
        self._failure = ""
        try:
            process = self._spawn()
        except Exception as error:  # no process, no memory, no certificate: the session goes on without it
            self._failure = " ".join(str(error).split()) or type(error).__name__
            return
        if self._closed:
            process.close()
        else:
            self._process = process

    def _read_reports(self, process: ChildProcess, now_ns: int) -> None:
        try:
            lines = process.read_available_lines()
        except OSError:
            return
        for line in lines:
            try:
                self.report = msgspec.json.decode(line, type=self._type)
            except msgspec.MsgspecError:
                if not self._has_warned:  # there may be one for every frame of a camera
                    log.warning("%s wrote a line that is no report: %.80r", self._title, line)
                self._has_warned = True
                continue
            self.heard_ns = now_ns


def _describe_exit(status: int | None) -> str:
    text = f"ended with status {status}"
    with suppress(ValueError):  # no signal
        text += f" ({signal.Signals(-(status or 0)).name})"
    return text
