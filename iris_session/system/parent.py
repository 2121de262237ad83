"""Ending with the parent process, however it ended."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def parent_is(pid: int) -> bool:
    """Whether the process that started this one is still there."""
    return os.getppid() == pid


def parent_ends(pid: int, patience_s: float = 0.5) -> bool:
    """Whether it is gone within `patience_s`: a process that is killed closes its sockets before it has ended."""
    until = time.monotonic() + patience_s
    while parent_is(pid) and time.monotonic() < until:
        time.sleep(0.01)
    return not parent_is(pid)


def die_with_parent(number: signal.Signals) -> None:
    """Asks the kernel (Linux) to send this process signal `number` when its parent dies.

    The kernel means the *thread* that started us, so the handler has to check `parent_is`. Elsewhere the parent is
    only polled.
    """
    if sys.platform != "linux":
        return
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_PDEATHSIG, int(number), 0, 0, 0)
