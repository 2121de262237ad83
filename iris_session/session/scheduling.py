"""What the tick loop wants of the operating system: to run before other work as far as allowed, and signals in order.

On a busy machine the scheduler, not our code, decides whether a 2 ms tick is met. Linux: `SCHED_RR` needs root,
`CAP_SYS_NICE` or an `rtprio` line in /etc/security/limits.d; without it nothing is changed. What was reached
is shown in the session's status, so that late ticks can be explained.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
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
        try:
            os.sched_setscheduler(0, *before)
        except PermissionError:  # ordinary users may give back the priority, but not that children never inherit it
            with suppress(PermissionError):
                os.sched_setscheduler(0, before[0] | os.SCHED_RESET_ON_FORK, before[1])


@contextmanager
def quiet_collector() -> Iterator[None]:
    """What exists when the loop begins lives as long as the loop: later garbage collections need not look at it."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def stop_signals(stop: threading.Event) -> Iterator[None]:
    """Inside, SIGINT and SIGTERM set `stop`; a SIGINT after that raises `KeyboardInterrupt`. Main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def on_signal(number: int, _: FrameType | None) -> None:
        if stop.is_set() and number == signal.SIGINT:
            raise KeyboardInterrupt  # the second Ctrl-C does not wait
        stop.set()

    previous = {s: signal.signal(s, on_signal) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for s, handler in previous.items():
            signal.signal(s, handler)
