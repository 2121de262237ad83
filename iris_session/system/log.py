"""Logging of the package's commands and child processes. A program with a session configures `logging` itself."""

from __future__ import annotations

import logging
import os
import sys
from typing import Final

ROOTS: Final = ("iris_session", "anchors")
LEVEL_VARIABLE: Final = "IRIS_LOG"
_FORMAT: Final = "%(levelname)s %(name)s: %(message)s"


class _StandardErrorHandler(logging.Handler):
    """Handler that looks up `sys.stderr` for each record, so that a later redirection has effect."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            print(self.format(record), file=sys.stderr, flush=True)
        except Exception:
            self.handleError(record)


class RepetitionFilter(logging.Filter):
    """Filter that lets one message through at most `BURST` times in `PERIOD_S`, whatever its arguments are."""

    BURST: Final = 5
    PERIOD_S: Final = 10.0
    _MAX_MESSAGES: Final = 64

    def __init__(self) -> None:
        super().__init__()
        self._seen: dict[str, tuple[float, int]] = {}  # since when [s], how often

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a record is written."""
        key = str(record.msg)
        since, n = self._seen.pop(key, (record.created, 0))
        if not 0.0 <= record.created - since < self.PERIOD_S:
            since, n = record.created, 0
        while len(self._seen) >= self._MAX_MESSAGES:
            del self._seen[next(iter(self._seen))]
        self._seen[key] = since, n + 1
        return n < self.BURST


def configure_logging() -> None:
    """Write the log of this package to standard error, one line `LEVEL name: text` a record.

    For the package's processes and commands, never on import. The level comes from the environment variable `IRIS_LOG`
    (`DEBUG`, `INFO`, `WARNING`, `ERROR`), default `WARNING`; child processes inherit it. May be called twice.
    """
    name = os.environ.get(LEVEL_VARIABLE, "").strip().upper()
    level = logging.getLevelNamesMapping().get(name, logging.WARNING)
    for root in ROOTS:
        logger = logging.getLogger(root)
        logger.setLevel(level)
        if not any(isinstance(handler, _StandardErrorHandler) for handler in logger.handlers):
            handler = _StandardErrorHandler()
            handler.setFormatter(logging.Formatter(_FORMAT))
            logger.addHandler(handler)


def describe_error(error: BaseException) -> str:
    """Return an unexpected error on one line: its type and text."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
