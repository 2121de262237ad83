"""What the front's loop serves beside control and state: beacon, introduction, allow-list, status, media."""

from __future__ import annotations

from typing import Protocol


class Service(Protocol):
    """One of them. It never waits; what it opened, `close` frees."""

    def tick(self, now_ns: int) -> None:
        """Does what is due at session time `now_ns`. Called about every 10 ms, after the link was drained."""
        ...

    def close(self) -> None: ...
