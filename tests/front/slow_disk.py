"""A disk that takes long to make a file durable, and ticks of a loop that must not wait for it."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

DEADLINE_S = 30.0


def turns(turn: Callable[[int], None], until: Callable[[], bool], now_ns: int = 0) -> None:
    """Call `turn` until the condition holds."""
    deadline = time.monotonic() + DEADLINE_S
    while not until():
        assert time.monotonic() < deadline
        turn(now_ns)
        time.sleep(0.001)


class SlowDisk:
    """`fsync` that sets `waits` and returns after `go_on`."""

    def __init__(self) -> None:
        self.waits = threading.Event()
        self._goes_on = threading.Event()

    def fsync(self, _descriptor: int) -> None:
        assert threading.current_thread() is not threading.main_thread(), "the loop waits for the disk"
        self.waits.set()
        assert self._goes_on.wait(DEADLINE_S)

    def go_on(self) -> None:
        self._goes_on.set()


@contextmanager
def slow_disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[SlowDisk]:
    """Replace `os.fsync`."""
    disk = SlowDisk()
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", disk.fsync)
        try:
            yield disk
        finally:
            disk.go_on()
