"""Messages of browsers that wait for the session: each browser has its turn, and what stops a robot goes ahead. Pure.

While the session reads all, nothing waits here. While it does not keep up, one browser that sends much delays itself.
"""

from __future__ import annotations

from collections import deque
from typing import Final

#: Messages that wait: of one browser, and of all.
MAX_PER_BROWSER: Final = 512
MAX_WAITING: Final = 2048
#: Ahead of all others, and of what its own browser has said before.
_ESTOP: Final = "estop"
#: Ahead of all others: it depends on nothing that its browser has said before.
_HEARTBEAT: Final = "heartbeat"
#: Ahead of what others wait for, after what its own browser has said before: it releases what that has acquired.
_RELEASE: Final = "release"


class TurnQueue:
    """Messages by browser; the browsers take turns."""

    def __init__(self) -> None:
        self.waiting: dict[str, deque[bytes]] = {}  # the next turn comes first
        self.n_waiting = 0

    def count(self, name: str) -> int:
        """Return the messages of one browser."""
        return len(self.waiting.get(name, ()))

    def append(self, name: str, message: bytes, *, first: bool = False) -> None:
        """Add a message of a browser after its others, or before them."""
        own = self.waiting.setdefault(name, deque())
        (own.appendleft if first else own.append)(message)
        self.n_waiting += 1

    def take_all(self, name: str) -> deque[bytes]:
        """Remove and return the messages of a browser."""
        own = self.waiting.pop(name, deque())
        self.n_waiting -= len(own)
        return own

    def peek(self) -> bytes | None:
        """Return the message whose turn it is."""
        return next(iter(self.waiting.values()))[0] if self.waiting else None

    def pop(self) -> None:
        """Remove that message, and end the turn of its browser."""
        name = next(iter(self.waiting))
        own = self.waiting.pop(name)
        own.popleft()
        self.n_waiting -= 1
        if own:
            self.waiting[name] = own


class BrowserUplink:
    """Messages of browsers that the session has not read."""

    def __init__(self) -> None:
        self._urgent = TurnQueue()
        self._others = TurnQueue()

    def __len__(self) -> int:
        return self._urgent.n_waiting + self._others.n_waiting

    def push(self, name: str, kind: str, message: bytes, *, admitted: bool) -> str:
        """Queue a message.

        Args:
            name: Its browser.
            kind: Its type.
            message: The envelope.
            admitted: The session has welcomed the browser: only then its message may go ahead.

        Returns:
            The browser of which too much waits, and whose messages were dropped but for the urgent ones; empty mostly.
        """
        if admitted and kind in (_ESTOP, _HEARTBEAT, _RELEASE):
            if kind == _RELEASE:
                for earlier in self._others.take_all(name):
                    self._urgent.append(name, earlier)
            self._urgent.append(name, message, first=kind == _ESTOP)
        else:
            self._others.append(name, message)
        if self._count(name) > MAX_PER_BROWSER:
            return self._drop(name)
        if len(self) > MAX_WAITING:
            return self._drop(max({*self._others.waiting, *self._urgent.waiting}, key=self._count))
        return ""

    def peek(self) -> bytes | None:
        """Return the message to send next."""
        return self._urgent.peek() or self._others.peek()

    def pop(self) -> None:
        """Remove that message."""
        (self._urgent if self._urgent.n_waiting else self._others).pop()

    def clear(self) -> None:
        """Drop everything: the session knows none of the browsers any more."""
        self._urgent, self._others = TurnQueue(), TurnQueue()

    def _count(self, name: str) -> int:
        return self._others.count(name) + self._urgent.count(name)

    def _drop(self, name: str) -> str:
        self._others.take_all(name)
        urgent = self._urgent.take_all(name)
        while len(urgent) > MAX_PER_BROWSER // 2:
            urgent.pop()  # an e-stop is at the beginning
        for message in urgent:
            self._urgent.append(name, message)
        return name
