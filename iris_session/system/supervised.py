"""A child process and its successors: started in a thread, watched, and started again after growing delays.

Every process of a session is one of these: front, recorder, web gateway, cameras. The caller keeps the time and polls;
nothing here waits for a process or a disk.
"""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final, Generic, Protocol, TypeVar

import msgspec

from iris_session.system.backoff import Backoff
from iris_session.system.process import ChildProcess

SECOND: Final = 1_000_000_000
#: The last one repeats: what a start takes, a second of processor time or two, is then a few percent.
RESTART_DELAYS_NS: Final = (0, SECOND // 2, SECOND, 2 * SECOND, 5 * SECOND, 30 * SECOND)
#: For a process without which everybody waits.
SHORT_RESTART_DELAYS_NS: Final = RESTART_DELAYS_NS[:-1]
#: A process that lived this long counts as healthy again.
HEALTHY_NS: Final = 30 * SECOND
#: A process that starts is given so long for each report: it imports, and compiles what it needs in one go, without a
#: chance to report. The filter of clouds takes 5 s of processor time, of which a busy machine gives a tenth.
START_NS: Final = 120 * SECOND
log = logging.getLogger(__name__)


class ProcessReport(Protocol):
    """Report of a process: what it has refused or dropped by reason, and why it ends, empty while all is well.

    One with `starting` says that the process still starts; by default it has started with its first report.
    """

    @property
    def drops(self) -> dict[str, int]: ...

    @property
    def fault(self) -> str: ...


class NoReport(msgspec.Struct, frozen=True):
    """Report of a process that writes none on its standard output."""

    drops: dict[str, int] = {}
    fault: str = ""


Report = TypeVar("Report", bound=ProcessReport)


def describe_exit(status: int) -> str:
    """Return how a process ended, by its exit status."""
    text = f"ended with status {status}"
    with suppress(ValueError):  # no signal
        text += f" ({signal.Signals(-status).name})"
    return text


class SupervisedProcess(Generic[Report]):
    """A process and its successors. `pid` and `is_running` may be used from any thread.

    Args:
        title: Name for people, as `the web gateway`.
        spawn: Starts the process. Called in a thread; what it raises is announced.
        report_type: Type of the reports that the process writes on its standard output, a line of JSON each; without
            arguments it is that of a process that has not reported.
        delays_ns: Before successive restarts.
        prepare: Called before each `spawn`, in the caller's thread.
        find_fault: Returns at a time why a process that runs is to be replaced, empty while it works; by default it is
            replaced when it does not report for `hang_ns`.
        describe_exit: Returns how a process ended, by its exit status.
        hang_ns: A process that has started and then does not report for this long is ended; 0: none ever is.

    Attributes:
        title: As given.
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
        delays_ns: Sequence[int] = RESTART_DELAYS_NS,
        prepare: Callable[[], None] = lambda: None,
        find_fault: Callable[[int], str] | None = None,
        describe_exit: Callable[[int], str] = describe_exit,
        hang_ns: int = 0,
    ) -> None:
        self.title = title
        self._spawn = spawn
        self._type = report_type
        self._prepare = prepare
        self._find_fault = find_fault or self._find_silence
        self._describe_exit = describe_exit
        self._hang_ns = hang_ns
        self._process: ChildProcess | None = None
        self._thread: threading.Thread | None = None
        self._backoff = Backoff(delays_ns)
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
        process = self._process
        return process.pid if process is not None and process.is_running else 0

    @property
    def is_started(self) -> bool:
        """True from `start` on."""
        return self._was_started

    @property
    def process(self) -> ChildProcess | None:
        """The process, `None` before the first and while the next one is waited for."""
        return self._process

    @property
    def fails_repeatedly(self) -> bool:
        """True when one process after the other has ended, or could not be started."""
        return self._backoff.failures > 1

    @property
    def failure(self) -> str:
        """One line for people about why there is no process, or why one after the other has ended; else empty."""
        return self._announced if not self.pid or self.fails_repeatedly else ""

    @property
    def last_ns(self) -> int:
        """Time of the last report, or of the start."""
        return self._started_ns if self.heard_ns is None else self.heard_ns

    @property
    def is_starting(self) -> bool:
        """True until a report says that the process has started."""
        return self.heard_ns is None or getattr(self.report, "starting", False)

    @property
    def limit_ns(self) -> int:
        """The process is ended when it does not report for so long."""
        return START_NS if self.is_starting else self._hang_ns

    @property
    def drops(self) -> dict[str, int]:
        """Counters of what this process and those before it have refused or dropped, by reason."""
        reasons = {**self._earlier_drops, **self.report.drops}
        return {one: self._earlier_drops.get(one, 0) + self.report.drops.get(one, 0) for one in reasons}

    def start_now(self) -> ChildProcess:
        """Start the first process in this thread, and return it. Raises what `prepare` and `spawn` do."""
        self._was_started = True
        self._prepare()
        self._process = self._spawn()
        return self._process

    def start(self, now_ns: int) -> None:
        """Start the process, in a thread. `now_ns`: a monotonic time."""
        self._was_started, self._has_warned = True, False
        self._started_ns, self._due_ns, self.heard_ns = now_ns, 0, None
        try:
            self._prepare()
        except Exception as error:
            self._note_failure(error)
            return
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
            failure, self._failure = self._failure, ""
            return self._announce(f"{self.title} does not start: {failure}", now_ns)
        if self._process is None:
            if self._due_ns and now_ns >= self._due_ns:
                self.start(now_ns)
            return []
        self._read_reports(self._process, now_ns)
        # One that reports all the time has to have done so: it may have hung since it was started.
        if (self.last_ns if self._hang_ns else now_ns) - self._started_ns > HEALTHY_NS:
            self._backoff.reset()
            self._announced = ""
        status = self._process.exit_status
        if status is None:
            self._hang = self._find_fault(now_ns)
            if self._hang:
                self._process.send_signal(signal.SIGKILL)
            return []
        self.fault = self.report.fault
        how = f"ended: {self.fault}" if self.fault else self._hang or self._describe_exit(status)
        self._process.close()
        self._process, self._hang = None, ""
        self._earlier_drops, self.report = self.drops, self._type()
        return self._announce(f"{self.title} {how}; it is started again", now_ns)

    def stop_restarts(self, timeout_s: float) -> None:
        """Start no successor from here on; wait so long for one that is being started.

        One that a disk keeps from starting for longer is ended as soon as it starts: nothing would supervise it.
        """
        if self._thread is not None:
            self._thread.join(timeout_s)
            self._thread = None
        self._closed = True

    def terminate(self) -> None:
        """Ask the process to end: several end at the same time before each is closed."""
        self._closed = True
        if self._process is not None:
            self._process.send_signal(signal.SIGTERM)

    def close(self, timeout_s: float, *, exit_s: float = 0.0, finish: int = 0) -> int:
        """End the process: in order, after `timeout_s` by SIGKILL. May be called twice.

        Args:
            timeout_s: Time after SIGTERM, and for a process that is being started.
            exit_s: Time to end by itself before SIGTERM.
            finish: Signal that asks it to.

        Returns:
            Its exit status, 0 if there is none.
        """
        self.stop_restarts(timeout_s + exit_s)
        process, self._process = self._process, None
        if process is None:
            return 0
        if finish:
            process.send_signal(finish)
        return process.close(exit_s=exit_s, terminate_s=timeout_s)

    def _announce(self, text: str, now_ns: int) -> list[str]:
        """Start again now or later. Return the line, unless it is the last one again."""
        delay_ns = self._backoff.next_delay()
        self.restarts += 1
        if delay_ns:
            self._due_ns = now_ns + delay_ns
        else:
            self.start(now_ns)
        if text == self._announced:
            return []
        self._announced = text
        return [text]

    def _run_spawn(self) -> None:
        try:
            process = self._spawn()
        except Exception as error:  # no process, no memory, no certificate: the session goes on without it
            self._note_failure(error)
            return
        if self._closed:
            process.close()
        else:
            self._process = process

    def _note_failure(self, error: Exception) -> None:
        self._failure = " ".join(str(error).split()) or type(error).__name__

    def _find_silence(self, now_ns: int) -> str:
        if self._hang_ns and now_ns - self.last_ns > self.limit_ns:
            return f"did not report for {self.limit_ns / SECOND:g} s and was ended"
        return ""

    def _read_reports(self, process: ChildProcess, now_ns: int) -> None:
        if self._type is NoReport:
            return
        try:
            lines = process.read_available_lines()
        except OSError:
            return
        for line in lines:
            try:
                self.report = msgspec.json.decode(line, type=self._type)
            except msgspec.MsgspecError:
                if not self._has_warned:  # there may be one for every frame of a camera
                    log.warning("%s wrote a line that is no report: %.80r", self.title, line)
                self._has_warned = True
                continue
            self.heard_ns = now_ns
