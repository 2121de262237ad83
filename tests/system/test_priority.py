"""Priority of threads: low-priority work stays in its thread, the tick priority is temporary and optional."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from iris_session.system import priority
from iris_session.system.priority import (
    LOW_PRIORITY_NICE,
    lower_named_thread_priority,
    run_at_low_priority,
    tick_priority,
)

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="threads have a priority on Linux only")


def test_low_priority_call_returns_and_raises() -> None:
    assert run_at_low_priority(threading.get_ident) != threading.get_ident()
    with pytest.raises(ZeroDivisionError):
        run_at_low_priority(lambda: 1 // 0)
    assert run_at_low_priority(lambda: None) is None


def test_named_thread_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has its name a moment after it was started."""
    seen: list[int] = []
    has_looked, is_named, is_lowered = threading.Event(), threading.Event(), threading.Event()

    def sleep(_: float) -> None:
        has_looked.set()
        assert is_named.wait(30.0)

    monkeypatch.setattr(priority, "time", SimpleNamespace(monotonic=lambda: 0.0, sleep=sleep))

    def take_name() -> None:
        has_looked.wait(30.0)
        Path(f"/proc/self/task/{threading.get_native_id()}/comm").write_text("named late")
        is_named.set()
        is_lowered.wait(30.0)
        seen.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    thread = threading.Thread(target=take_name)
    thread.start()
    lower_named_thread_priority("named late")
    is_lowered.set()
    thread.join()
    assert seen == [min(19, os.getpriority(os.PRIO_PROCESS, 0) + LOW_PRIORITY_NICE)]


def test_threads_started_at_low_priority_inherit_it() -> None:
    ours = os.getpriority(os.PRIO_PROCESS, 0)
    seen: list[int] = []

    def record_nice() -> None:
        seen.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    def start() -> None:
        record_nice()
        thread = threading.Thread(target=record_nice)
        thread.start()
        thread.join()

    run_at_low_priority(start)
    assert seen == [min(19, ours + LOW_PRIORITY_NICE)] * 2
    record_nice()
    assert seen[-1] == ours


def test_tick_priority_is_restored() -> None:
    before = os.sched_getscheduler(0)
    with tick_priority() as reached:
        inside = os.sched_getscheduler(0)
    assert reached in ("realtime", "normal")
    assert (inside & ~os.SCHED_RESET_ON_FORK == os.SCHED_RR) == (reached == "realtime")
    assert os.sched_getscheduler(0) == before


#: Root has `CAP_SYS_NICE` until it changes its user; a user with an `rtprio` limit never had it.
WITHOUT_CAPABILITY = """
import os
from iris_session.system.priority import tick_priority
with tick_priority() as reached:
    if os.getuid() == 0:
        os.setuid(65534)
    inside = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
print(reached, inside == os.SCHED_RR, os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER)
"""


@pytest.mark.e2e
def test_tick_priority_is_restored_without_the_capability() -> None:
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_CAPABILITY], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.split() in (["realtime", "True", "True"], ["normal", "False", "True"])


def test_tick_priority_without_permission_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError("no")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with tick_priority() as reached:
        assert reached == "normal"


def test_disabled_tick_priority_makes_no_system_call(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise AssertionError("asked")

    monkeypatch.setattr(os, "sched_setscheduler", fail)
    with tick_priority(False) as reached:
        assert reached == "normal"


def test_tick_priority_is_not_raised_on_a_single_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    before = os.sched_getscheduler(0)
    with tick_priority() as reached:
        assert reached == "normal"
        assert os.sched_getscheduler(0) == before
