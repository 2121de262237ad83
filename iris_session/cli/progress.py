"""Progress of work on a recording, as a line in a terminal."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from threading import Timer
from typing import Final, Self

from iris_session.cli.common import to_printable

#: A file that takes longer shows how far it was read [s].
PROGRESS_AFTER_S: Final = 1.0
PROGRESS_PERIOD_S: Final = 0.2


class ReadingProgress:
    """A line on standard error, where that is a terminal, while a file takes more than `PROGRESS_AFTER_S`."""

    def __init__(self, path: Path) -> None:
        self._path = to_printable(str(path))
        self._due_s = time.monotonic() + PROGRESS_AFTER_S
        self._shows = sys.stderr.isatty()
        self._shown = False
        self._opening = Timer(PROGRESS_AFTER_S, self._print, ["opening"])  # takes about as long as reading
        self._opening.daemon = True

    def show(self, done: int, total: int) -> None:
        """Show how many steps were read; `total` 0 if unknown."""
        self._opening.cancel()
        if self._shows and time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + PROGRESS_PERIOD_S
            self._print(f"step {done} of {total}" if total else f"step {done}")

    def show_bytes(self, done: int, total: int) -> None:
        """Show how many bytes were read for a copy; after all of them, Rerun still has to write it."""
        self._opening.cancel()
        if self._shows and (time.monotonic() >= self._due_s or done >= total):
            self._due_s = time.monotonic() + PROGRESS_PERIOD_S
            read = f"read {done / 1e6:.0f} of {total / 1e6:.0f} MB"
            self._print(read if done < total else f"{read}, writing the copy")

    def end(self) -> None:
        """End the line. May be called twice."""
        self._opening.cancel()
        if self._shown:
            self._shown = False
            print(file=sys.stderr)

    def _print(self, text: str) -> None:
        self._shown = True
        print(f"\r{self._path}: {text}", end="", file=sys.stderr, flush=True)

    def __enter__(self) -> Self:
        if self._shows:
            self._opening.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()


class ProgressLine:
    """A line on standard error, where that is a terminal, that says how far the work on a file is."""

    def __init__(self, path: Path) -> None:
        self._path = to_printable(str(path))
        self._shows = sys.stderr.isatty()
        self._shown = False
        self._due_s = 0.0

    def show(self, text: str) -> None:
        """Show a text in place of the last one."""
        if self._shows and time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + PROGRESS_PERIOD_S
            self._shown = True
            print(f"\r\x1b[K{self._path}: {text}", end="", file=sys.stderr, flush=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            print(file=sys.stderr)
