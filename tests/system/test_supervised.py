"""Supervision of a child process: when it is started, started again and ended, and what is announced."""

from __future__ import annotations

import signal
from typing import Any

import msgspec
import pytest

from iris_session.system import supervised
from iris_session.system.process import ChildProcess
from iris_session.system.supervised import HEALTHY_NS, SECOND, START_NS, SupervisedProcess
from tests.threads import Threads


class Report(msgspec.Struct, frozen=True):
    drops: dict[str, int] = {}
    fault: str = ""
    starting: bool = False
    n: int = 0


class Child:
    """A process by the test."""

    pid = 4711

    def __init__(self) -> None:
        self.lines: list[bytes] = []
        self.exit_status: int | None = None
        self.signals: list[int] = []
        self.closed = False

    @property
    def is_running(self) -> bool:
        return self.exit_status is None

    def read_available_lines(self) -> list[bytes]:
        lines, self.lines = self.lines, []
        return lines

    def report(self, **fields: object) -> None:
        self.lines.append(msgspec.json.encode(fields))

    def send_signal(self, number: int) -> None:
        self.signals.append(number)
        if number == signal.SIGKILL:
            self.exit_status = -9

    def close(self, *, terminate_s: float = 0.0) -> int:
        self.closed = True
        return 0


@pytest.fixture(autouse=True)
def threads(monkeypatch: pytest.MonkeyPatch) -> Threads:
    threads = Threads()
    monkeypatch.setattr(supervised, "threading", threads)
    return threads


class Lab:
    """A supervised process and the children that were started for it."""

    def __init__(self, **options: Any) -> None:
        self.children: list[Child] = []
        self.error: Exception | None = None
        self.process = SupervisedProcess("the helper", self._spawn, Report, **options)
        self.now_ns = 0

    def _spawn(self) -> ChildProcess:
        if self.error is not None:
            raise self.error
        self.children.append(Child())
        return self.children[-1]  # type: ignore[return-value]

    def poll(self, seconds: float = 0.0) -> list[str]:
        """Poll after a while, with whatever thread has started by then at its end."""
        self.now_ns += round(seconds * SECOND)
        found = self.process.poll(self.now_ns)
        supervised.threading.run_started()  # type: ignore[attr-defined]
        return found + self.process.poll(self.now_ns)


def start(**options: Any) -> Lab:
    lab = Lab(**options)
    assert not lab.process.is_started
    lab.process.start(0)
    assert lab.process.is_started
    assert lab.poll() == []
    assert len(lab.children) == 1
    return lab


def test_reports_are_read() -> None:
    lab = start()
    assert (lab.process.pid, lab.process.report, lab.process.heard_ns) == (4711, Report(), None)
    lab.children[0].report(n=1)
    lab.children[0].report(n=2, drops={"a": 3})
    lab.children[0].lines.append(b"no report")
    assert lab.poll(1.0) == []
    assert lab.process.report.n == 2
    assert lab.process.heard_ns == SECOND
    assert lab.process.failure == ""


def test_lines_that_are_no_reports_are_a_warning_once(caplog: pytest.LogCaptureFixture) -> None:
    lab = start()
    for _ in range(3):
        lab.children[0].lines += [b"Frameset dropped " + b"." * 200] * 100
        lab.poll(1.0)
    (record,) = caplog.records
    assert "the helper wrote a line that is no report: b'Frameset dropped" in record.getMessage()
    assert len(record.getMessage()) < 200


def test_a_process_that_ends_is_started_again_and_announced() -> None:
    lab = start()
    lab.children[0].report(drops={"a": 3})
    lab.children[0].exit_status = -9
    assert lab.poll(1.0) == ["the helper ended with status -9 (SIGKILL); it is started again"]
    assert lab.children[0].closed
    assert len(lab.children) == 2
    assert lab.process.failure == ""
    lab.children[1].report(drops={"a": 4, "b": 1})
    lab.poll(1.0)
    assert lab.process.drops == {"a": 7, "b": 1}
    assert lab.process.restarts == 1


def test_its_own_account_of_why_it_ends_comes_first() -> None:
    lab = start()
    lab.children[0].report(fault="is not admitted")
    lab.children[0].exit_status = 1
    assert lab.poll(1.0) == ["the helper ended: is not admitted; it is started again"]
    assert lab.process.fault == "is not admitted"


def test_what_happens_again_and_again_is_announced_once_after_growing_delays() -> None:
    lab = start()
    announced, times = [], []
    while len(lab.children) < 5:
        n = len(lab.children)
        lab.children[-1].exit_status = 1
        announced += lab.poll()
        while len(lab.children) == n:
            lab.poll(0.05)
        times.append(lab.now_ns)
    assert announced == ["the helper ended with status 1; it is started again"]
    assert lab.process.failure == announced[0], "also while the next one tries"
    delays = [round((b - a) / SECOND, 1) for a, b in zip([0, *times], times, strict=False)]
    assert delays[0] < 0.2
    assert delays == sorted(delays)
    assert delays[-1] >= 1.0
    lab.poll(HEALTHY_NS / SECOND + 1.0)
    assert lab.process.failure == ""
    lab.children[-1].exit_status = 1
    assert len(lab.poll()) == 1, "it was healthy for a while"
    lab.poll(0.001)
    assert len(lab.children) == 6, "so it is started at once"


def test_a_process_that_cannot_be_started_is_tried_again() -> None:
    lab = Lab()
    lab.error = OSError("no memory")
    lab.process.start(0)
    assert lab.poll() == ["the helper does not start: no memory"]
    assert lab.process.failure == "the helper does not start: no memory"
    lab.error = None
    lab.poll(1.0)
    assert len(lab.children) == 1
    assert lab.process.failure == ""


def test_a_process_that_hangs_is_ended_but_not_while_it_starts() -> None:
    lab = start(hang_ns=5 * SECOND)
    assert lab.poll(START_NS / SECOND) == []
    lab.children[0].report()
    assert lab.poll() == []
    assert lab.poll(4.9) == []
    announced = lab.poll(0.2)
    assert lab.children[0].signals == [signal.SIGKILL]
    assert announced == ["the helper did not report for 5 s and was ended; it is started again"]


def test_each_part_of_a_slow_start_may_take_long() -> None:
    lab = start(hang_ns=5 * SECOND)
    for _ in range(3):
        assert lab.process.is_starting
        assert lab.poll(START_NS / SECOND - 1.0) == []
        lab.children[0].report(starting=True)
        assert lab.poll() == []
    assert lab.process.limit_ns == START_NS
    lab.children[0].report()
    assert lab.poll() == []
    assert (lab.process.is_starting, lab.process.limit_ns) == (False, 5 * SECOND)
    assert len(lab.poll(5.1)) == 1, "it has started, and hangs"


def test_a_process_that_starts_while_all_ends_is_closed(threads: Threads) -> None:
    threads.are_stuck = True
    lab = Lab()
    lab.process.start(0)
    lab.process.close(0.0)
    threads.run_started()
    assert [child.closed for child in lab.children] == [True]
    assert lab.process.pid == 0
