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
#: In a file or pipe, time between two lines [s].
LINE_PERIOD_S: Final = 10.0


class ProgressLine:
    """A line on standard error that says how far the work on a file is: in place in a terminal, else now and then.

    Args:
        path: The file.
        after_s: Time before the first line [s].
    """

    def __init__(self, path: Path, after_s: float = 0.0) -> None:
        self._path = to_printable(str(path))
        self._is_terminal = sys.stderr.isatty()
        self._shown = False
        self._due_s = time.monotonic() + (after_s if self._is_terminal else LINE_PERIOD_S)

    def show(self, text: str, *, at_once: bool = False) -> None:
        """Show a text in place of the last one; other than `at_once` not more often than a terminal needs."""
        now_s = time.monotonic()
        if not self._is_terminal:
            if now_s >= self._due_s:
                self._due_s = now_s + LINE_PERIOD_S
                print(f"{self._path}: {text}", file=sys.stderr, flush=True)
        elif at_once or now_s >= self._due_s:
            self._due_s = now_s + 0.2
            self._shown = True
            print(f"\r\x1b[K{self._path}: {text}", end="", file=sys.stderr, flush=True)

    def end(self) -> None:
        """End the line. May be called twice."""
        if self._shown:
            self._shown = False
            print(file=sys.stderr)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()


class ReadingProgress(ProgressLine):
    """A progress line while a file takes more than `PROGRESS_AFTER_S` to be read."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, PROGRESS_AFTER_S)
        self._opening = Timer(PROGRESS_AFTER_S, self.show, ["opening"])  # takes about as long as reading
        self._opening.daemon = True

    def show_steps(self, done: int, total: int) -> None:
        """Show how many steps were read; `total` 0 if unknown."""
        self._opening.cancel()
        self.show(f"step {done} of {total}" if total else f"step {done}")

    def show_bytes(self, done: int, total: int) -> None:
        """Show how many bytes were read for a copy; after all of them, Rerun still has to write it."""
        self._opening.cancel()
        read = f"read {done / 1e6:.0f} of {total / 1e6:.0f} MB"
        self.show(read if done < total else f"{read}, writing the copy", at_once=done >= total)

    def end(self) -> None:
        """End the line. May be called twice."""
        self._opening.cancel()
        super().end()

    def __enter__(self) -> Self:
        self._opening.start()
        return self
