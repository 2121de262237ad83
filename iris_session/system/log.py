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
