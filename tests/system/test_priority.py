"""Threads that give way: what they make, what they raise, and that nobody else has a lower priority for it."""

from __future__ import annotations

import os
import sys
import threading

import pytest

from iris_session.system.priority import NICER, made_below


def test_what_is_made_is_handed_over_and_what_is_raised_too() -> None:
    assert made_below(threading.get_ident) != threading.get_ident()
    with pytest.raises(ZeroDivisionError):
        made_below(lambda: 1 // 0)
    assert made_below(lambda: None) is None


@pytest.mark.skipif(sys.platform != "linux", reason="threads have a priority on Linux only")
def test_threads_that_are_started_there_inherit_its_priority_and_nobody_else_has_it() -> None:
    ours = os.getpriority(os.PRIO_PROCESS, 0)
    found: list[int] = []

    def look() -> None:
        found.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    def start() -> None:
        look()
        thread = threading.Thread(target=look)
        thread.start()
        thread.join()

    made_below(start)
    assert found == [min(19, ours + NICER)] * 2
    look()
    assert found[-1] == ours
