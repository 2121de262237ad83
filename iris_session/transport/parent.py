"""Ending with the parent process, however it ended."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def parent_is(pid: int) -> bool:
    """Whether the process that started this one is still there."""
    return os.getppid() == pid


def die_with_parent(number: signal.Signals) -> None:
    """Asks the kernel (Linux) to send this process signal `number` when its parent dies.

    The kernel means the *thread* that started us, so the handler has to check `parent_is`. Elsewhere the parent is
    only polled.
    """
    if sys.platform != "linux":
        return
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_PDEATHSIG, int(number), 0, 0, 0)
