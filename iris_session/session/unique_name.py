"""`NameFinder`: a session name that no other session on the network has."""

from __future__ import annotations

import time
from typing import Final

from iris_session.link.discovery import BeaconListener, DiscoveryError

#: Beacons come five times a second, so a session is heard twice in this time.
LISTEN_S: Final = 0.5
MAX_NAME: Final = 48  # as `SessionConfig.name`


class NameFinder:
    """Listener for beacons of other sessions while this one starts; it does nothing when `port` is 0.

    `notes`: messages for the user, one line each.
    """

    def __init__(self, port: int) -> None:
        self.notes: list[str] = []
        self._until = time.monotonic() + LISTEN_S
        self._listener: BeaconListener | None = None
        if port:
            try:
                self._listener = BeaconListener(port)
            except DiscoveryError as error:
                self.notes.append(f"other sessions cannot be found: {error}")

    def find_free_name(self, name: str, session_id: str = "") -> str:
        """Return `name`, with a number when a session other than `session_id` has it. Waits the rest of `LISTEN_S`."""
        if self._listener is None:
            return name
        while (left := self._until - time.monotonic()) > 0.0:
            self._listener.wait(left)
            self._listener.poll_sessions()
        heard = {
            session.name: session.address
            for session in self._listener.poll_sessions()
            if session.session_id != session_id
        }
        if name not in heard:
            return name
        numbered = (f"{name[: MAX_NAME - 4]}-{n}" for n in range(2, len(heard) + 3))
        free = next(one for one in numbered if one not in heard)
        self.notes.append(f"another session called {name!r} is at {heard[name]}: this one is called {free!r}")
        return free

    def close(self) -> None:
        if self._listener is not None:
            self._listener.close()
            self._listener = None
