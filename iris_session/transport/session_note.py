"""Notes a running encrypted session in the home of keys, so that `iris-session pair` knows where to send people."""

from __future__ import annotations

import contextlib
import os
import sys

from iris_session.keys import KeyHome, KeysBusyError, KeysError, SessionNote
from iris_session.transport.config import FrontConfig, Ports


class NoteKeeper:
    """A `Service`: writes the note in its first turn, removes it in the end."""

    def __init__(self, home: KeyHome, config: FrontConfig, ports: Ports) -> None:
        self._notes = home.sessions
        self._note = SessionNote(
            config.session_id, config.session_name, os.getpid(), ports.reachable, ports.control, ports.key_fingerprint
        )
        self._written = False

    def turn(self, now_ns: int) -> None:
        """Tries until nobody else changes the file."""
        if self._written:
            return
        try:
            self._notes.add(self._note, patience_s=0.0)
        except KeysBusyError:
            return
        except KeysError as error:
            print(f"iris-session: `iris-session pair` will not find this session: {error}", file=sys.stderr, flush=True)
        self._written = True

    def close(self) -> None:
        if not self._written:
            return
        with contextlib.suppress(KeysError):
            self._notes.remove(self._note.session_id, self._note.pid, patience_s=0.2)
