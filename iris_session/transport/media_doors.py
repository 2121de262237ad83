"""TCP connections to the media socket: who subscribes to nothing for a while is closed, and so are too many."""

from __future__ import annotations

from typing import Final

import zmq

from iris_session.transport.config import FrontLimits
from iris_session.transport.sockets import close_tcp, next_tcp_event, peer_of, readable

LOOK_NS: Final = 1_000_000_000
#: Subscriptions of one connection, beyond which it is cut off: as many as a client has, over and over.
MAX_SAID: Final = 1024


class _Guest:
    """One TCP connection. `said`: messages of it that came through."""

    __slots__ = ("address", "opened_ns", "said")

    def __init__(self, address: tuple[str, int], now_ns: int) -> None:
        self.address = address
        self.opened_ns = now_ns
        self.said = 0


class MediaDoors:
    """Belongs to the thread of the media proxy. `monitor`: of its socket. What it closes, it gives the reason of."""

    def __init__(self, monitor: zmq.Socket[bytes], limits: FrontLimits) -> None:
        self._monitor = monitor
        self._limits = limits
        self._guests: dict[int, _Guest] = {}
        self._next_ns = 0

    def heard(self, descriptor: int, now_ns: int) -> str:
        """A message came by a connection. Not empty: it was cut off, and why."""
        if descriptor < 0:
            return ""
        guest = self._guests.setdefault(descriptor, _Guest(peer_of(descriptor), now_ns))
        guest.said += 1
        return self._close(descriptor, "media_flood") if guest.said > MAX_SAID else ""

    def turn(self, now_ns: int) -> list[str]:
        """Looks who came and went; the reasons of those that were closed."""
        while readable(self._monitor):
            event, descriptor = next_tcp_event(self._monitor)
            if event == zmq.EVENT_ACCEPTED:
                self._guests[descriptor] = _Guest(peer_of(descriptor), now_ns)
            else:
                self._guests.pop(descriptor, None)
        if now_ns < self._next_ns:
            return []
        self._next_ns = now_ns + LOOK_NS
        silent = [fd for fd, guest in self._guests.items() if not guest.said]  # in the order in which they came
        late = [fd for fd in silent if now_ns - self._guests[fd].opened_ns > self._limits.hello_timeout_ns]
        many = silent[: max(0, len(self._guests) - self._limits.subscribers)]
        closed = [self._close(fd, "media_silent") for fd in late]
        return [reason for reason in (*closed, *(self._close(fd, "media_too_many") for fd in many)) if reason]

    def close(self) -> None:
        self._monitor.close(linger=0)

    def _close(self, descriptor: int, reason: str) -> str:
        guest = self._guests.pop(descriptor, None)
        return reason if guest is not None and close_tcp(descriptor, guest.address) else ""
