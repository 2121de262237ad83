"""TCP connections of the front, before and beside what is said over them: the silent, the many, the floods.

Everything that is opened costs a descriptor and room in libzmq, whoever opened it. So whoever says no `hello` for a
while is closed, the oldest silent ones make room when there are many, and who sends far more than its limits is cut
off and named. People who behave see none of it.
"""

from __future__ import annotations

import socket
import struct
from collections import deque
from typing import Final

import zmq

from iris_session.protocol.names import AuditKind
from iris_session.transport.audit import AuditTrail
from iris_session.transport.clients import ClientTable, Connection, Peer
from iris_session.transport.config import MILLISECOND, SECOND, FrontLimits
from iris_session.transport.limiter import Drops, TokenBucket
from iris_session.transport.sockets import close_tcp, next_tcp_event, peer_of, readable

LOOK_NS: Final = 250 * MILLISECOND
#: Who was cut off may say hello again after it.
BARRED_NS: Final = 3 * SECOND
#: TCP connections of one address within a second that are called a flood.
OPENED_PER_S: Final = 100
#: A subscriber of state has no more to say than its handshake and a few topics.
STATE_BYTES: Final = 65_536
STATE_BYTES_PER_S: Final = 1024
#: Subscribers that are looked at in one turn.
EXAMINED: Final = 8
#: What is borne of somebody before hello, as a share of what is of a client.
STRANGERS_SHARE: Final = 0.25
#: A flood is shown in the status for so long.
SHOWN_NS: Final = 60 * SECOND
MAX_REMEMBERED: Final = 256
MAX_SHOWN: Final = 8
#: Linux, `struct tcp_info`: `tcpi_bytes_received`.
_RECEIVED_AT: Final = 128
BEFORE_HELLO: Final = "before hello"


class _Visitor:
    """One TCP connection. `quiet_ns`: when it was last somebody's who said hello (or when it was opened)."""

    __slots__ = ("address", "excess", "opened_ns", "quiet_ns")

    def __init__(self, address: tuple[str, int], now_ns: int) -> None:
        self.address = address
        self.opened_ns = self.quiet_ns = now_ns
        self.excess: TokenBucket | None = None


class Doors:
    """A `Service`. The control socket's events are passed on to it, the state socket's it reads itself."""

    def __init__(self, clients: ClientTable, drops: Drops, audit: AuditTrail, limits: FrontLimits) -> None:
        self._clients = clients
        self._drops = drops
        self._audit = audit
        self._limits = limits
        self._visitors: dict[int, _Visitor] = {}  # of the control socket, by descriptor, in the order they came
        self._subscribers: dict[int, _Visitor] = {}
        self._state_monitors: list[zmq.Socket[bytes]] = []
        self._barred: dict[str, int] = {}  # key id -> session time until which it may not say hello
        self._cut: dict[str, int] = {}  # address -> until when less is borne of its strangers
        self._examined = 0  # descriptor of the subscriber that was looked at last
        self._shown: dict[tuple[str, str], tuple[int, str]] = {}
        self._opened: dict[str, int] = {}  # address -> connections since `_opened_ns`
        self._opened_ns = 0
        self._next_ns = 0

    # --- what happens ------------------------------------------------------------------------------------------------

    def opened(self, descriptor: int, now_ns: int) -> None:
        """A TCP connection to the control socket was accepted."""
        self._visitors.pop(descriptor, None)
        visitor = self._visitors[descriptor] = _Visitor(peer_of(descriptor), now_ns)
        self._count(visitor.address[0], now_ns)

    def closed(self, descriptor: int) -> None:
        """A TCP connection to the control socket has ended."""
        self._visitors.pop(descriptor, None)

    def watch_state(self, monitor: zmq.Socket[bytes]) -> None:
        """Reads events of a state socket from now on, until that socket is closed."""
        self._state_monitors.append(monitor)

    def busy(self, descriptor: int, now_ns: int) -> None:
        """A connection without `hello` does what it may: it pairs."""
        visitor = self._visitors.get(descriptor)
        if visitor is not None:
            visitor.quiet_ns = now_ns

    def excess(self, peer: Peer, connection: Connection | None, what: str, now_ns: int) -> bool:
        """One message that was not taken. With too many of them the TCP connection is cut off: true."""
        visitor = self._visitors.get(peer.descriptor)
        if visitor is None:
            visitor = self._visitors[peer.descriptor] = _Visitor(peer_of(peer.descriptor), now_ns)
        if visitor.excess is None:
            share = 1.0 if connection is not None else STRANGERS_SHARE
            if connection is None and now_ns < self._cut.get(visitor.address[0], 0):
                share *= STRANGERS_SHARE  # back again, and again without hello
            limits = self._limits
            visitor.excess = TokenBucket(limits.excess_per_s * share, int(limits.excess_burst * share), now_ns)
        if visitor.excess.take(now_ns):
            return False
        self.flood(visitor.address[0], what, now_ns, connection)
        if not close_tcp(peer.descriptor, visitor.address):
            return False
        self._drops.count("flood_cut")
        _remember(self._cut, visitor.address[0], now_ns + BARRED_NS)
        if connection is not None:
            _remember(self._barred, connection.key_id, now_ns + BARRED_NS)
        return True

    def flood(self, address: str, what: str, now_ns: int, connection: Connection | None = None) -> None:
        """Names somebody who sends more than its limits."""
        name = subject = ""
        if connection is not None:
            name, subject = connection.hello.name, connection.participant_id
        self._drops.count("flood")
        self._audit.note(AuditKind.FLOOD, now_ns, subject=subject, name=name, address=address, detail=what)
        self._shown.pop((address, what), None)
        while len(self._shown) >= MAX_SHOWN:
            del self._shown[next(iter(self._shown))]
        who = " ".join(part for part in (address, f"({name})" if name else "") if part) or "an address that is gone"
        self._shown[address, what] = (now_ns, f"flood from {who}: {what}")

    def barred(self, key_id: str, now_ns: int) -> bool:
        """Whether this key was cut off a moment ago."""
        return now_ns < self._barred.get(key_id, 0)

    def warnings(self, now_ns: int) -> tuple[str, ...]:
        """The floods of the last minute, for the status."""
        return tuple(text for since_ns, text in self._shown.values() if now_ns - since_ns <= SHOWN_NS)

    # --- now and then ------------------------------------------------------------------------------------------------

    def turn(self, now_ns: int) -> None:
        """Closes who has been silent for too long, who is too many, and subscribers that talk."""
        for monitor in list(self._state_monitors):
            self._read(monitor, now_ns)
        self._talkative(now_ns)
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + LOOK_NS
        self._silent(now_ns)

    def shed(self) -> str:
        """Makes room in memory: the newest of those who said no hello are closed, a quarter of them; when there are
        none, the newest who did. Says who it was, empty when nobody is there."""
        strangers = [descriptor for descriptor in self._visitors if descriptor not in self._owners()]
        for descriptor in strangers[-max(1, len(strangers) // 4) :]:
            self._close(self._visitors, descriptor, "memory")
        if strangers:
            return "connections without hello"
        newest = max(self._clients.by_number.values(), key=lambda one: one.number, default=None)
        if newest is None or not close_tcp(newest.peer.descriptor, newest.address):
            return ""
        _remember(self._barred, newest.key_id, newest.last_heard_ns + BARRED_NS)
        self._drops.count("memory")
        return f"{newest.hello.name} from {newest.address[0]}"

    def close(self) -> None:
        for monitor in self._state_monitors:
            monitor.close(linger=0)

    def _owners(self) -> set[int]:
        return {one.peer.descriptor for one in (*self._clients.by_number.values(), *self._clients.lost_lately)}

    def _silent(self, now_ns: int) -> None:
        owners = self._owners()
        quiet: deque[int] = deque()
        for descriptor, visitor in self._visitors.items():
            if descriptor in owners:
                visitor.quiet_ns = now_ns
            else:
                quiet.append(descriptor)
        limits = self._limits
        while len(quiet) > limits.strangers:
            self._close(self._visitors, quiet.popleft(), "strangers_too_many")
        for descriptor in quiet:
            if now_ns - self._visitors[descriptor].quiet_ns > limits.hello_timeout_ns:
                self._close(self._visitors, descriptor, "no_hello")

    def _read(self, monitor: zmq.Socket[bytes], now_ns: int) -> None:
        while readable(monitor):
            event, descriptor = next_tcp_event(monitor)
            if event == zmq.EVENT_MONITOR_STOPPED:
                self._state_monitors.remove(monitor)
                monitor.close(linger=0)
                return
            self._subscribers.pop(descriptor, None)
            if event == zmq.EVENT_ACCEPTED:
                visitor = self._subscribers[descriptor] = _Visitor(peer_of(descriptor), now_ns)
                self._count(visitor.address[0], now_ns)
                if len(self._subscribers) > self._limits.subscribers:
                    self._close(self._subscribers, descriptor, "subscribers_too_many")

    def _talkative(self, now_ns: int) -> None:
        """Looks at some subscribers, each in turn."""
        later = sorted(self._subscribers, key=lambda descriptor: (descriptor <= self._examined, descriptor))
        for descriptor in later[:EXAMINED]:
            self._examined = descriptor
            visitor = self._subscribers[descriptor]
            allowed = STATE_BYTES + STATE_BYTES_PER_S * (now_ns - visitor.opened_ns) // SECOND
            if bytes_received(descriptor) > allowed:
                self.flood(visitor.address[0], "subscriptions", now_ns)
                self._close(self._subscribers, descriptor, "flood_cut")

    def _close(self, table: dict[int, _Visitor], descriptor: int, reason: str) -> None:
        if close_tcp(descriptor, table[descriptor].address):
            self._drops.count(reason)
        table.pop(descriptor)

    def _count(self, address: str, now_ns: int) -> None:
        if now_ns - self._opened_ns > SECOND:
            self._opened_ns = now_ns
            self._opened.clear()
        if address in self._opened or len(self._opened) < MAX_REMEMBERED:
            self._opened[address] = self._opened.get(address, 0) + 1
            if self._opened[address] > OPENED_PER_S:
                self.flood(address, "connections", now_ns)


def _remember(table: dict[str, int], who: str, until_ns: int) -> None:
    table.pop(who, None)
    while len(table) >= MAX_REMEMBERED:
        del table[next(iter(table))]
    table[who] = until_ns


def bytes_received(descriptor: int) -> int:
    """What came over a TCP connection so far, as the system counts it; 0 where it does not tell."""
    try:
        with socket.fromfd(descriptor, socket.AF_INET, socket.SOCK_STREAM) as twin:
            info = twin.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _RECEIVED_AT + 8)
    except (OSError, AttributeError):
        return 0
    return int(struct.unpack_from("=Q", info, _RECEIVED_AT)[0]) if len(info) >= _RECEIVED_AT + 8 else 0
