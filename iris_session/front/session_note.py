"""Notes a running encrypted session in the home of keys, so that `iris-session pair` knows where to send people."""

from __future__ import annotations

import contextlib
import os
import sys
from functools import partial

from iris_session.link.config import FrontConfig, Ports
from iris_session.security import KeyHome, KeysBusyError, KeysError, RegisteredSession
from iris_session.system.file_worker import LOCK_TIMEOUT_S, FileWorker


class SessionNoteService:
    """A `Service`: has the note written in its first turn, removes it in the end."""

    def __init__(self, home: KeyHome, files: FileWorker[KeysError], config: FrontConfig, ports: Ports) -> None:
        self._notes = home.sessions
        self._files = files
        self._note = RegisteredSession(
            config.session_id, config.session_name, os.getpid(), ports.reachable, ports.control, ports.key_fingerprint
        )
        self._asked = False

    def tick(self, now_ns: int) -> None:
        """Tries until nobody else changes the file."""
        if not self._asked:
            self._asked = self._files.submit(partial(self._notes.add, self._note, LOCK_TIMEOUT_S), self._on_written)

    def close(self) -> None:
        """The front's loop has ended: nobody waits for it any more."""
        if not self._asked:
            return
        with contextlib.suppress(KeysError):
            self._notes.remove(self._note.session_id, self._note.pid, timeout_s=0.2)

    def _on_written(self, outcome: KeysError | None, _now_ns: int) -> None:
        if isinstance(outcome, KeysBusyError):
            self._asked = False
        elif outcome is not None:
            text = f"iris-session: `iris-session pair` will not find this session: {outcome}"
            print(text, file=sys.stderr, flush=True)
