"""`sessions.json`: the encrypted sessions that this user serves now. `iris-session pair` shows their addresses."""

from __future__ import annotations

import os
from typing import Final

import msgspec

from iris_session.security.private_folder import LOCK_TIMEOUT_S, PrivateFolder

FILE: Final = "sessions.json"


class RegisteredSession(msgspec.Struct, frozen=True):
    """One running session. `hosts`: addresses at which it can be reached, best first. `server`: fingerprint of its key.
    `pid`: of the process that holds the sockets. `web`: port of the page, 0 for none."""

    session_id: str
    name: str
    pid: int
    hosts: tuple[str, ...]
    control: int
    server: str
    web: int = 0


class SessionRegistry:
    """Reads and changes the registry. Entries of ended processes are skipped, and removed with the next change."""

    def __init__(self, folder: PrivateFolder) -> None:
        self._folder = folder

    def read(self) -> list[RegisteredSession]:
        """Return the sessions that run now."""
        return [one for one in self._folder.read_json(FILE, list[RegisteredSession]) or [] if _is_running(one.pid)]

    def add(self, session: RegisteredSession, timeout_s: float = LOCK_TIMEOUT_S) -> None:
        """Add a session, replacing an older entry of it."""
        with self._folder.lock(timeout_s):
            others = [one for one in self.read() if one.session_id != session.session_id]
            self._folder.write_json(FILE, [*others, session], durable=False)

    def remove(self, session_id: str, pid: int, timeout_s: float = LOCK_TIMEOUT_S) -> None:
        """Remove a session, unless another process has taken it over."""
        with self._folder.lock(timeout_s):
            others = [one for one in self.read() if (one.session_id, one.pid) != (session_id, pid)]
            self._folder.write_json(FILE, others, durable=False)


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):  # OverflowError: a number that no process can have
        return False
    except OSError:
        return True
    return True
