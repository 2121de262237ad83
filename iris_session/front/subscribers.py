"""TCP connections of the state socket: those that got through the handshake, and those that stand before it.

libzmq tells of a handshake without saying whose it was. But a subscription comes after it, with descriptor and key of
its subscriber: so somebody is a subscriber once it has subscribed, and before that a stranger like any other.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import zmq

from iris_session.front.visitors import Visitor, Visitors, crowd
from iris_session.link.config import MILLISECOND, SECOND, FrontLimits
from iris_session.link.sockets import next_tcp_event, readable, tcp_counts
from iris_session.protocol.limits import Drops

LOOK_NS: Final = 250 * MILLISECOND
#: A subscriber has no more to say than its handshake and a few topics.
STATE_BYTES: Final = 65_536
STATE_BYTES_PER_S: Final = 1024
#: Subscribers that are looked at in one turn, beside those who have said something.
EXAMINED: Final = 8
#: Subscriptions that are read in one turn: about half a millisecond.
READ: Final = 128
_SUBSCRIBE: Final = b"\x01"


class Subscribers:
    """`flood(address, what, now_ns)` names somebody; `count(address, now_ns)` counts who was opened."""

    def __init__(
        self,
        drops: Drops,
        limits: FrontLimits,
        flood: Callable[[str, str, int], None],
        count: Callable[[str, int], None],
    ) -> None:
        self._limits = limits
        self._flood = flood
        self._count = count
        self._visitors = Visitors(drops)
        self._socket: zmq.Socket[bytes] | None = None
        self._monitor: zmq.Socket[bytes] | None = None
        self._examined = 0  # descriptor that was looked at last
        self._next_ns = 0

    def __len__(self) -> int:
        return len(self._visitors)

    def watch(self, state: zmq.Socket[bytes], monitor: zmq.Socket[bytes]) -> None:
        """From now on those of this socket. One that was watched before is closed, and nobody of it is left."""
        self.close()
        self._socket, self._monitor = state, monitor

    def close(self) -> None:
        """Forgets the socket and everybody on it. The socket is its owner's to close."""
        if self._monitor is not None:
            self._monitor.close(linger=0)
        self._socket = self._monitor = None
        self._visitors.clear()

    def turn(self, now_ns: int) -> None:
        """Closes who does not subscribe, who is too many, and who talks."""
        if self._socket is None or self._monitor is None:
            return
        if self._socket.closed:
            self.close()
            return
        said = self._subscriptions(self._socket)
        # After the subscriptions: what libzmq told of their connections before them is there now.
        self._read(self._monitor, now_ns)
        for descriptor, user in said.items():
            visitor = self._visitors.find(descriptor)
            if visitor is not None and user is not None:
                visitor.inside, visitor.who = True, user or visitor.who
        later = sorted(self._visitors, key=lambda descriptor: (descriptor <= self._examined, descriptor))[:EXAMINED]
        if later:
            self._examined = later[-1]
        for descriptor in {*said, *later}:
            self._talkative(descriptor, now_ns)
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + LOOK_NS
            self._too_many(now_ns)

    def _subscriptions(self, state: zmq.Socket[bytes]) -> dict[int, str | None]:
        """Who has said something: descriptor -> user id (empty without keys), `None` when it was no subscription."""
        said: dict[int, str | None] = {}
        for _ in range(READ):
            if not readable(state):
                break
            frame = state.recv(zmq.DONTWAIT, copy=False)
            try:
                descriptor = int(frame.get(zmq.SRCFD))
            except zmq.ZMQError:  # a ZeroMQ of before 2013: libzmq does not tell by which connection
                continue
            if frame.bytes[:1] == _SUBSCRIBE:
                said[descriptor] = _user(frame)
            else:
                said.setdefault(descriptor, None)
        return said

    def _read(self, monitor: zmq.Socket[bytes], now_ns: int) -> None:
        while readable(monitor):
            event, descriptor = next_tcp_event(monitor)
            if event == zmq.EVENT_ACCEPTED:
                visitor = self._visitors.opened(descriptor, now_ns)
                self._count(visitor.address[0], now_ns)
            elif event == zmq.EVENT_DISCONNECTED:
                self._visitors.closed(descriptor)

    def _talkative(self, descriptor: int, now_ns: int) -> None:
        visitor = self._visitors.find(descriptor)
        counts = tcp_counts(descriptor)
        if visitor is None or counts is None:
            return
        if counts.received > STATE_BYTES + STATE_BYTES_PER_S * (now_ns - visitor.opened_ns) // SECOND:
            self._flood(visitor.address[0], "subscriptions", now_ns)
            self._visitors.close(descriptor, "flood_cut")

    def _too_many(self, now_ns: int) -> None:
        limits = self._limits
        inside: list[tuple[int, Visitor]] = []
        bare: list[tuple[int, Visitor]] = []
        for one in self._visitors.items():
            (inside if one[1].inside else bare).append(one)
        for descriptor in crowd(bare, limits.strangers):
            self._visitors.close(descriptor, "strangers_too_many")
        for descriptor in crowd(reversed(inside), limits.subscribers):
            self._visitors.close(descriptor, "subscribers_too_many")
        for descriptor, visitor in bare:
            late = now_ns - visitor.opened_ns > limits.hello_timeout_ns
            if late and self._visitors.find(descriptor) is visitor:
                self._visitors.close(descriptor, "no_subscription")


def _user(frame: zmq.Frame) -> str:
    try:
        return str(frame.get("User-Id"))
    except zmq.ZMQError:  # without keys
        return ""
