"""TCP connections to a socket of media, or of assets: who says nothing for a while is closed, and so are too many, and
who hands in more than is taken: of a message libzmq collects all frames, however many, before it shows the first."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import zmq

from iris_session.front.traffic import Traffic
from iris_session.front.visitors import crowd
from iris_session.link.config import MILLISECOND, FrontLimits
from iris_session.link.sockets import close_tcp, next_tcp_event, peer_of, readable

LOOK_NS: Final = 250 * MILLISECOND
#: Messages of one connection that count, beyond which it is cut off: as many subscriptions as a client has, over and
#: over; frames of a source that nobody lets in.
MAX_SAID: Final = 1024


class _Guest:
    """One TCP connection. `who`: whom it counts for. `inside`: something of it came through. `said`: messages of it
    that count."""

    __slots__ = ("address", "inside", "opened_ns", "said", "who")

    def __init__(self, address: tuple[str, int], now_ns: int) -> None:
        self.address = address
        self.who = address[0]
        self.opened_ns = now_ns
        self.inside = False
        self.said = 0


class MediaDoors:
    """Belongs to the thread of the media proxy, or of the assets. `monitor`: of the socket. What it closes, it gives
    the reason of, which begins with `name`.

    At most `most` connections that have said something, and as many that have not; at most `waiting` bytes that came by
    one of them and were not taken. `curve`: whether it is encrypted.
    """

    def __init__(
        self,
        monitor: zmq.Socket[bytes],
        limits: FrontLimits,
        most: int,
        waiting: int,
        *,
        curve: bool,
        name: str = "media",
    ) -> None:
        self._monitor = monitor
        self._name = name
        self._limits = limits
        self._most = most
        self._waiting = waiting
        self._traffic = Traffic(curve=curve)
        self._guests: dict[int, _Guest] = {}
        self._next_ns = 0

    def read(self, now_ns: int) -> list[int]:
        """Looks who came and went: the descriptors that are nobody's, or another's, from now on. To be called after a
        message was received and before `heard`: libzmq told of its connection before."""
        changed = []
        while readable(self._monitor):
            event, descriptor = next_tcp_event(self._monitor)
            self._guests.pop(descriptor, None)
            self._traffic.begin(descriptor)
            if event == zmq.EVENT_ACCEPTED:
                self._guests[descriptor] = _Guest(peer_of(descriptor), now_ns)
            changed.append(descriptor)
        return changed

    def heard(self, descriptor: int, user: str, lengths: Iterable[int], *, counts: bool) -> str:
        """A message with frames of these lengths came by a connection. Not empty: it was cut off, and why."""
        guest = self._guests.get(descriptor)
        if guest is None:
            return ""
        for length in lengths:
            self._traffic.taken(descriptor, length)
        guest.inside, guest.who = True, user or guest.who
        guest.said += counts
        return self.close_one(descriptor, f"{self._name}_flood") if guest.said > MAX_SAID else ""

    def turn(self, now_ns: int) -> list[str]:
        """The reasons of those that were closed now."""
        if now_ns < self._next_ns:
            return []
        self._next_ns = now_ns + LOOK_NS
        inside = [one for one in self._guests.items() if one[1].inside]
        silent = [one for one in self._guests.items() if not one[1].inside]
        oldest_ns = now_ns - self._limits.hello_timeout_ns
        flooding = [fd for fd in self._guests if self._traffic.held(fd) > self._waiting]
        closed = [self.close_one(fd, f"{self._name}_flood") for fd in flooding]
        closed += [self.close_one(fd, f"{self._name}_silent") for fd, guest in silent if guest.opened_ns < oldest_ns]
        many = (*crowd(silent, self._most), *crowd(reversed(inside), self._most))
        closed += [self.close_one(fd, f"{self._name}_too_many") for fd in many]
        return [reason for reason in closed if reason]

    def close_one(self, descriptor: int, reason: str) -> str:
        """Closes a connection. The reason; empty when it is gone already."""
        guest = self._guests.pop(descriptor, None)
        return reason if guest is not None and close_tcp(descriptor, guest.address) else ""

    def close(self) -> None:
        self._monitor.close(linger=0)
