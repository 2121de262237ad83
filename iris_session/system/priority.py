"""Priority of threads: the tick loop runs before other work, and what can wait runs after it.

On a busy machine the scheduler, not this code, decides whether a 2 ms tick is met. Linux: `SCHED_RR` needs root,
`CAP_SYS_NICE` or an `rtprio` line in /etc/security/limits.d; without it nothing is changed. The result is shown in the
session's status, so that late ticks can be explained.
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, TypeVar

#: Any real-time priority runs before all ordinary threads; a low one stays below the kernel's own threads.
TICK_PRIORITY: Final = 5
#: Added to the nice value of a thread at low priority: a tenth of the weight. Not less, as threads of Python hold its
#: lock for moments, and every other thread then waits for them.
LOW_PRIORITY_NICE: Final = 10
LAST_NICE: Final = 19
#: A thread that was started has its name within this time, on a busy machine, too [s].
NAMED_WITHIN_S: Final = 1.0

T = TypeVar("T")


def lower_thread_priority() -> None:
    """Lower the priority of the calling thread, where threads have one (Linux). It cannot be raised again."""
    with contextlib.suppress(OSError, AttributeError):
        _lower_priority(threading.get_native_id())


def lower_named_thread_priority(name: str) -> None:
    """Lower the priority of a thread of this process, by the name that it has in the system (Linux): of one that a
    library has started. It is waited for, because threads name themselves; where there is none, nothing changes."""
    deadline = time.monotonic() + NAMED_WITHIN_S
    while sys.platform == "linux" and time.monotonic() < deadline:
        for task in Path("/proc/self/task").glob("*"):
            with contextlib.suppress(OSError):
                if (task / "comm").read_text().strip() == name:
                    _lower_priority(int(task.name))
                    return
        time.sleep(0.001)


def _lower_priority(native_id: int) -> None:
    nice = min(LAST_NICE, os.getpriority(os.PRIO_PROCESS, native_id) + LOW_PRIORITY_NICE)
    os.setpriority(os.PRIO_PROCESS, native_id, nice)


def run_at_low_priority(function: Callable[[], T]) -> T:
    """Call `function` in a temporary thread at low priority; return its result, or raise its error.

    Threads that are started meanwhile inherit the priority, such as those that libzmq starts with the first socket of a
    context.
    """
    results: list[T] = []
    errors: list[BaseException] = []

    def run() -> None:
        lower_thread_priority()
        try:
            results.append(function())
        except BaseException as error:  # raised in the calling thread
            errors.append(error)

    thread = threading.Thread(target=run, name="iris-low-priority")
    thread.start()
    thread.join()
    if errors:
        raise errors[0]
    return results[0]


@contextlib.contextmanager
def tick_priority(enabled: bool = True) -> Iterator[str]:
    """Run the calling thread at real-time priority. Yields `realtime`, or `normal` where that is not permitted.

    Processes and threads started inside do not inherit it.
    """
    # On a single processor an overloaded loop at raised priority would starve the front, and with it the e-stop.
    if not enabled or sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2:
        yield "normal"
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(TICK_PRIORITY))
    except PermissionError:
        yield "normal"
        return
    try:
        yield "realtime"
    finally:
        try:
            os.sched_setscheduler(0, *before)
        except PermissionError:  # ordinary users may give back the priority, but not that children never inherit it
            with contextlib.suppress(PermissionError):
                os.sched_setscheduler(0, before[0] | os.SCHED_RESET_ON_FORK, before[1])


@contextlib.contextmanager
def freeze_garbage_collector() -> Iterator[None]:
    """Exempt all present objects from garbage collection inside: they live as long as the loop."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
