"""Asks the operating system to run the tick loop before other work, as far as it is allowed.

On a busy machine the scheduler, not our code, decides whether a 2 ms tick is met. Linux: `SCHED_RR` needs root,
`CAP_SYS_NICE` or an `rtprio` line in /etc/security/limits.d; without it nothing is changed. What was reached
is shown in the session's status, so that late ticks can be explained.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final

#: Any real-time priority runs before all ordinary threads; a low one stays below the kernel's own threads.
PRIORITY: Final = 5


@contextmanager
def tick_priority(wanted: bool = True) -> Iterator[str]:
    """The calling thread runs at raised priority inside. Gives `realtime`, or `normal` where that is not permitted.

    Processes and threads started inside do not inherit it.
    """
    # On a single processor an overloaded loop at raised priority would starve the front, and with it the e-stop.
    if not wanted or sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2:
        yield "normal"
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except PermissionError:
        yield "normal"
        return
    try:
        yield "realtime"
    finally:
        with suppress(PermissionError):
            os.sched_setscheduler(0, before[0] & ~os.SCHED_RESET_ON_FORK, before[1])


@contextmanager
def quiet_collector() -> Iterator[None]:
    """What exists when the loop begins lives as long as the loop: later garbage collections need not look at it."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
