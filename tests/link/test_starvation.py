"""A hanging process is distinguished from one without processor time, with real processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from iris_session.link.front_process import StarvationDetector

pytestmark = pytest.mark.skipif(not hasattr(os, "SCHED_IDLE"), reason="the scheduler's idle class is Linux's")
BUSY = "print('up', flush=True)\nwhile True: pass"
#: Runs when nobody else wants to.
IDLE = f"import os; os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))\n{BUSY}"


@contextmanager
def running(code: str, cpu: int) -> Iterator[int]:
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    try:
        os.sched_setaffinity(process.pid, {cpu})
        assert process.stdout is not None
        process.stdout.readline()
        yield process.pid
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def looks(starvation: StarvationDetector, pid: int, seconds: float = 1.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        starvation.sample(pid, time.monotonic_ns())
        time.sleep(0.05)
    return starvation.sample(pid, time.monotonic_ns())


def test_process_without_processor_time_is_starved() -> None:
    cpu = min(os.sched_getaffinity(0))
    with running(IDLE, cpu) as starved, running(BUSY, cpu):  # which the system may stop for a while
        assert any(looks(StarvationDetector(), starved) for _ in range(20))


def test_stopped_or_waiting_process_is_not_starved() -> None:
    cpu = min(os.sched_getaffinity(0))
    with running("print('up', flush=True); import time; time.sleep(60)", cpu) as waiting:
        assert not looks(StarvationDetector(), waiting)
    with running(BUSY, cpu) as stopped:
        os.kill(stopped, signal.SIGSTOP)
        while "T" not in Path(f"/proc/{stopped}/stat").read_text().rpartition(")")[2]:
            time.sleep(0.001)
        assert not looks(StarvationDetector(), stopped)


def test_ended_process_is_not_starved() -> None:
    with running("print('up', flush=True)", min(os.sched_getaffinity(0))) as pid:
        pass
    assert not StarvationDetector().sample(pid, 0)
