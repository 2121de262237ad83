"""Threads that give way to others, so that what can wait does not delay state and control."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable
from typing import Final, TypeVar

#: Added to the nice value of a thread that gives way: a tenth of the weight. Not less, as those of Python hold its lock
#: for moments, and whoever needs it then waits for them.
NICER: Final = 10
_LAST: Final = 19

T = TypeVar("T")


def give_way() -> None:
    """Lowers the priority of the calling thread, where threads have one (Linux). It cannot be raised again."""
    with contextlib.suppress(OSError, AttributeError):
        nice = min(_LAST, os.getpriority(os.PRIO_PROCESS, 0) + NICER)
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), nice)


def made_below(make: Callable[[], T]) -> T:
    """What `make` gives, in a thread that gives way and then ends: threads that are started meanwhile inherit its
    priority, as those of libzmq are with the first socket of a context. Raises what `make` raises."""
    made: list[T] = []
    failed: list[BaseException] = []

    def work() -> None:
        give_way()
        try:
            made.append(make())
        except BaseException as error:  # raised where somebody waits
            failed.append(error)

    thread = threading.Thread(target=work, name="iris-made-below")
    thread.start()
    thread.join()
    if failed:
        raise failed[0]
    return made[0]
