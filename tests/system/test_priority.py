"""Priority of threads: low-priority work stays in its thread, the tick priority is temporary and optional."""

from __future__ import annotations

import os
import sys
import threading

import pytest

from iris_session.system.priority import LOW_PRIORITY_NICE, run_at_low_priority, tick_priority

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="threads have a priority on Linux only")


def test_low_priority_call_returns_and_raises() -> None:
    assert run_at_low_priority(threading.get_ident) != threading.get_ident()
    with pytest.raises(ZeroDivisionError):
        run_at_low_priority(lambda: 1 // 0)
    assert run_at_low_priority(lambda: None) is None


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


def test_tick_priority_without_permission_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError("no")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with tick_priority() as reached:
        assert reached == "normal"


def test_tick_priority_is_not_raised_on_a_single_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    before = os.sched_getscheduler(0)
    with tick_priority() as reached:
        assert reached == "normal"
        assert os.sched_getscheduler(0) == before
