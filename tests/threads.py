"""Threads that do their work when a test lets them, for code that starts one and looks after it later."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any


class Threads:
    """In place of the module `threading`.

    Attributes:
        are_stuck: Who waits for a thread waits in vain.
    """

    def __init__(self) -> None:
        self._started: list[Callable[[], None]] = []
        self.are_stuck = False

    def run_started(self) -> None:
        """Let every thread that was started do its work."""
        while self._started:
            self._started[0]()
            self._started.pop(0)

    def Thread(self, target: Callable[[], None], **_: object) -> Any:
        return SimpleNamespace(
            start=lambda: self._started.append(target), is_alive=lambda: target in self._started, join=self._join
        )

    def _join(self, _: float | None = None) -> None:
        if not self.are_stuck:
            self.run_started()

    def __getattr__(self, name: str) -> Any:
        return getattr(threading, name)
