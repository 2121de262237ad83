"""Limits on TCP connections, on hellos and on memory: who is rate limited, banned, or closed to make room.

Every open connection costs a descriptor and buffers in libzmq, before a message is sent over it. So a connection that
stays silent is closed after a while, the oldest silent ones make room when there are many, and a peer that sends far
more than its limits is disconnected, banned for a moment and reported. Clients within their limits notice none of it.

`ConnectionGuard` covers the control socket and, through `SubscriberGuard`, the state socket. `ChannelGuard` covers one
socket of media or assets and belongs to the thread of that channel. `HelloRateLimiter` shares hellos between keys, and
`MemoryGuard` bounds the memory of the process. What a connection may ask for is decided in `admission` and `intake`.
"""

from __future__ import annotations

import ctypes
import heapq
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Final, Protocol

import psutil
import zmq

from iris_session.front.audit import AuditTrail
from iris_session.front.connections import ConnectionTable, FrontConnection, Peer, TrafficCounter
from iris_session.link.config import MEBIBYTE, MILLISECOND, SECOND, FrontLimits
from iris_session.link.sockets import close_tcp, next_tcp_event, peer_of, readable, tcp_counts
from iris_session.protocol.limits import Drops, TokenBucket
from iris_session.protocol.names import AuditKind

CHECK_PERIOD_NS: Final = 250 * MILLISECOND
#: A peer that was disconnected for a flood may say hello again after this.
BAN_NS: Final = 3 * SECOND
#: More new TCP connections of one address within a second are a flood.
FLOOD_CONNECTIONS_PER_S: Final = 100
#: Limit of rejected messages before hello, as a share of the limit of an admitted client.
SILENT_SHARE: Final = 0.25
#: A connection that was disconnected as silent may still stop the session for so long. Then its TCP connection is
#: closed, too: a sleeping headset, or a network in between, can keep it open for ever.
KEPT_NS: Final = 60 * SECOND
#: A flood is listed in the status for so long.
WARNING_NS: Final = 60 * SECOND
MAX_REMEMBERED: Final = 256
MAX_WARNINGS: Final = 8
#: Pending bytes of one client from which it is evicted when memory is short: more than an honest client leaves pending.
MIN_EVICT_BYTES: Final = MEBIBYTE // 4
#: Buffers and queues of libzmq for a connection that has said nothing.
SILENT_CONNECTION_BYTES: Final = 16 * 1024
BEFORE_HELLO: Final = "before hello"

#: A subscriber sends its handshake and a few topics, no more.
STATE_BYTES: Final = 65_536
STATE_BYTES_PER_S: Final = 1024
#: Subscribers examined in one tick, besides those that sent something.
EXAMINED_PER_TICK: Final = 8
#: Subscriptions read in one tick: about half a millisecond.
SUBSCRIPTIONS_PER_TICK: Final = 128
_SUBSCRIBE: Final = b"\x01"

#: Counted messages of one connection to a channel before it is closed: repeated subscriptions, as many as a client can
#: have over and over, or frames of a source without permission.
MAX_COUNTED_MESSAGES: Final = 1024

#: Reason of a connection that could not be closed.
CLOSE_FAILED: Final = "close_failed"

#: Sources of hellos that have a token bucket of their own.
MAX_SOURCES: Final = 256

MEMORY_PERIOD_NS: Final = 100 * MILLISECOND
#: Pause after an eviction: libzmq frees what a closed connection held in its own thread.
EVICTION_PAUSE_NS: Final = 500 * MILLISECOND


class TcpConnection:
    """One TCP connection to a listening socket.

    Attributes:
        address: Host and port of the peer.
        owner: What the connection counts for in `select_evictions`: its key once that is known, else its host.
        opened_ns: Session time at which it was accepted.
        quiet_ns: Session time at which it last belonged to an admitted client, at first that of `opened_ns`.
        rejections: Token bucket of rejected messages, made with the first of them.
        is_established: A message came through after the handshake.
        counted_messages: Messages that count towards a flood.
    """

    __slots__ = ("address", "counted_messages", "is_established", "opened_ns", "owner", "quiet_ns", "rejections")

    def __init__(self, address: tuple[str, int], now_ns: int) -> None:
        self.address = address
        self.owner = address[0]
        self.opened_ns = self.quiet_ns = now_ns
        self.rejections: TokenBucket | None = None
        self.is_established = False
        self.counted_messages = 0


class TcpConnections:
    """TCP connections of one listening socket by descriptor, in the order in which they were accepted."""

    def __init__(self) -> None:
        self._table: dict[int, TcpConnection] = {}

    def __len__(self) -> int:
        return len(self._table)

    def __iter__(self) -> Iterator[int]:
        return iter(self._table)

    def items(self) -> Iterable[tuple[int, TcpConnection]]:
        return self._table.items()

    def find(self, descriptor: int) -> TcpConnection | None:
        return self._table.get(descriptor)

    def add(self, descriptor: int, now_ns: int) -> TcpConnection:
        """Add a connection that was accepted, in place of an earlier one with the same descriptor."""
        self._table.pop(descriptor, None)
        connection = self._table[descriptor] = TcpConnection(peer_of(descriptor), now_ns)
        return connection

    def remove(self, descriptor: int) -> None:
        """Remove a connection that has ended."""
        self._table.pop(descriptor, None)

    def clear(self) -> None:
        """Remove all connections: their listening socket was closed."""
        self._table.clear()

    def read_events(self, monitor: zmq.Socket[bytes], now_ns: int) -> list[tuple[int, TcpConnection | None]]:
        """Read the socket's monitor. Return, per event, the descriptor and the connection that was accepted with it,
        `None` for a connection that has ended."""
        events: list[tuple[int, TcpConnection | None]] = []
        while readable(monitor):
            event, descriptor = next_tcp_event(monitor)
            self.remove(descriptor)
            accepted = self.add(descriptor, now_ns) if event == zmq.EVENT_ACCEPTED else None
            events.append((descriptor, accepted))
        return events

    def evict(self, descriptor: int, reason: str) -> str:
        """Close a connection and return the reason to count.

        The reason is empty for a connection that has ended already, and `close_failed` for one that could not be
        closed; that one stays in the table and is tried again with the next check.
        """
        connection = self._table.get(descriptor)
        if connection is None:
            return ""
        closed = close_tcp(descriptor, connection.address)
        if not closed and peer_of(descriptor) == connection.address:
            return CLOSE_FAILED
        del self._table[descriptor]
        return reason if closed else ""


class _Owned(Protocol):
    owner: str


def select_evictions(connections: Iterable[tuple[int, _Owned]], limit: int) -> list[int]:
    """Return the connections to close so that at most `limit` remain.

    One after the other is taken from the owner that has most of them, in the given order.
    """
    queues: dict[str, deque[tuple[int, int]]] = {}
    n = 0
    for descriptor, connection in connections:
        queues.setdefault(connection.owner, deque()).append((n, descriptor))
        n += 1
    fullest = [(-len(queue), queue[0], owner) for owner, queue in queues.items()]
    heapq.heapify(fullest)
    evicted: list[int] = []
    while n - len(evicted) > max(0, limit):
        owner = fullest[0][2]
        queue = queues[owner]
        evicted.append(queue.popleft()[1])
        if queue:
            heapq.heapreplace(fullest, (-len(queue), queue[0], owner))
        else:
            heapq.heappop(fullest)
    return evicted


def max_connections_per_key(limit: int) -> int:
    """Return how many of `limit` connections one key, or one gateway, may have: a quarter stays for others."""
    return limit - limit // 4


class HelloRateLimiter:
    """Limit hellos per source and in total.

    A source is an allowed key, or an address in a session without keys. Each source has a few hellos of its own, so a
    new client is admitted independently of other clients. Beyond them it uses those that all sources share.
    """

    def __init__(self, limits: FrontLimits) -> None:
        self._limits = limits
        self._shared = TokenBucket(limits.hellos_per_second, limits.hello_burst)
        self._own: dict[str, TokenBucket] = {}  # the most recently used comes last

    def allow(self, source: str, now_ns: int) -> bool:
        """Return whether one more hello of this source may be handled, and use its token."""
        own = self._own.pop(source, None)
        if own is None:
            own = TokenBucket(self._limits.hellos_per_source, self._limits.hello_source_burst, now_ns)
            while len(self._own) >= MAX_SOURCES:
                del self._own[next(iter(self._own))]
        self._own[source] = own
        return own.take(now_ns) or self._shared.take(now_ns)


class SubscriberGuard:
    """Limit TCP connections of the state socket, an XPUB socket.

    libzmq reports a finished handshake without its connection. A subscription comes after it and carries descriptor
    and key of its subscriber. So a connection counts as established once it has subscribed, and as silent before.

    `on_flood(address, detail, now_ns)` reports a flood, `on_accept(address, now_ns)` counts a new connection.
    """

    def __init__(
        self,
        drops: Drops,
        limits: FrontLimits,
        on_flood: Callable[[str, str, int], None],
        on_accept: Callable[[str, int], None],
    ) -> None:
        self._drops = drops
        self._limits = limits
        self._on_flood = on_flood
        self._on_accept = on_accept
        self._tcp = TcpConnections()
        self._socket: zmq.Socket[bytes] | None = None
        self._monitor: zmq.Socket[bytes] | None = None
        self._examined = 0  # descriptor that was examined last
        self._next_ns = 0

    def __len__(self) -> int:
        return len(self._tcp)

    def watch(self, state: zmq.Socket[bytes], monitor: zmq.Socket[bytes]) -> None:
        """Guard this socket from now on, instead of the one before."""
        self.close()
        self._socket, self._monitor = state, monitor

    def close(self) -> None:
        """Forget the socket and its connections, and close its monitor. The socket is closed by its owner."""
        if self._monitor is not None:
            self._monitor.close(linger=0)
        self._socket = self._monitor = None
        self._tcp.clear()

    def tick(self, now_ns: int) -> None:
        """Close connections that do not subscribe, that are too many, or that send too much."""
        if self._socket is None or self._monitor is None:
            return
        if self._socket.closed:
            self.close()
            return
        senders = self._read_subscriptions(self._socket)
        # After the subscriptions: by now libzmq has reported their connections.
        for _, accepted in self._tcp.read_events(self._monitor, now_ns):
            if accepted is not None:
                self._on_accept(accepted.address[0], now_ns)
        for descriptor, user in senders.items():
            connection = self._tcp.find(descriptor)
            if connection is not None and user is not None:
                connection.is_established, connection.owner = True, user or connection.owner
        others = sorted(self._tcp, key=lambda descriptor: (descriptor <= self._examined, descriptor))
        others = others[:EXAMINED_PER_TICK]
        if others:
            self._examined = others[-1]
        for descriptor in {*senders, *others}:
            self._evict_if_flooding(descriptor, now_ns)
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + CHECK_PERIOD_NS
            self._evict_excess(now_ns)

    def _read_subscriptions(self, state: zmq.Socket[bytes]) -> dict[int, str | None]:
        """Return who sent something: user id (empty without keys) by descriptor, `None` if it was no subscription."""
        senders: dict[int, str | None] = {}
        for _ in range(SUBSCRIPTIONS_PER_TICK):
            if not readable(state):
                break
            frame = state.recv(zmq.DONTWAIT, copy=False)
            try:
                descriptor = int(frame.get(zmq.SRCFD))
            except zmq.ZMQError:  # a ZeroMQ of before 2013: without its connection
                continue
            if frame.bytes[:1] == _SUBSCRIBE:
                senders[descriptor] = _read_user_id(frame)
            else:
                senders.setdefault(descriptor, None)
        return senders

    def _evict(self, descriptor: int, reason: str) -> None:
        counted = self._tcp.evict(descriptor, reason)
        if counted:
            self._drops.count(counted)

    def _evict_if_flooding(self, descriptor: int, now_ns: int) -> None:
        connection = self._tcp.find(descriptor)
        counts = tcp_counts(descriptor)
        if connection is None or counts is None:
            return
        if counts.received > STATE_BYTES + STATE_BYTES_PER_S * (now_ns - connection.opened_ns) // SECOND:
            self._on_flood(connection.address[0], "subscriptions", now_ns)
            self._evict(descriptor, "flood_cut")

    def _evict_excess(self, now_ns: int) -> None:
        limits = self._limits
        established: list[tuple[int, TcpConnection]] = []
        silent: list[tuple[int, TcpConnection]] = []
        for one in self._tcp.items():
            (established if one[1].is_established else silent).append(one)
        for descriptor in select_evictions(silent, limits.strangers):
            self._evict(descriptor, "strangers_too_many")
        for descriptor in select_evictions(reversed(established), limits.subscribers):
            self._evict(descriptor, "subscribers_too_many")
        for descriptor, connection in silent:
            late = now_ns - connection.opened_ns > limits.hello_timeout_ns
            if late and self._tcp.find(descriptor) is connection:
                self._evict(descriptor, "no_subscription")


def _read_user_id(frame: zmq.Frame) -> str:
    try:
        return str(frame.get("User-Id"))
    except zmq.ZMQError:  # without keys
        return ""


class ChannelGuard:
    """Limit TCP connections of one socket of media or assets. Belongs to the thread of that channel.

    Closes connections that stay silent, that are too many, and that send more than is read: libzmq collects all frames
    of a message, however many, before it delivers the first. Drop reasons begin with `name`.

    Args:
        monitor: Monitor of the socket.
        limits: Handshake timeout.
        max_connections: Established connections at most, and silent connections at most.
        max_pending_bytes: Received but unread bytes of one connection at most.
        curve: Whether the socket is encrypted.
        name: Prefix of the drop reasons.
    """

    def __init__(
        self,
        monitor: zmq.Socket[bytes],
        limits: FrontLimits,
        max_connections: int,
        max_pending_bytes: int,
        *,
        curve: bool,
        name: str = "media",
    ) -> None:
        self._monitor = monitor
        self._name = name
        self._limits = limits
        self._max_connections = max_connections
        self._max_pending_bytes = max_pending_bytes
        self._traffic = TrafficCounter(curve=curve)
        self._tcp = TcpConnections()
        self._next_ns = 0

    def read_events(self, now_ns: int) -> list[int]:
        """Read accepted and closed connections. Return descriptors that belong to no or to another connection now.

        Call it after a message was received and before `record_message`: libzmq reports the connection first.
        """
        changed = [descriptor for descriptor, _ in self._tcp.read_events(self._monitor, now_ns)]
        for descriptor in changed:
            self._traffic.reset(descriptor)
        return changed

    def record_message(self, descriptor: int, user: str, lengths: Iterable[int], *, counts: bool) -> str:
        """Record a message with frames of these lengths. `counts`: it counts towards a flood.

        Returns:
            The drop reason if the connection was closed, else an empty string.
        """
        connection = self._tcp.find(descriptor)
        if connection is None:
            return ""
        for length in lengths:
            self._traffic.count_received(descriptor, length)
        connection.is_established, connection.owner = True, user or connection.owner
        connection.counted_messages += counts
        if connection.counted_messages <= MAX_COUNTED_MESSAGES:
            return ""
        reason = self.evict(descriptor, f"{self._name}_flood")
        return "" if reason == CLOSE_FAILED else reason  # it is open still, and tried again with its next message

    def tick(self, now_ns: int) -> list[str]:
        """Close flooding, silent and too many connections. Return a drop reason for each."""
        if now_ns < self._next_ns:
            return []
        self._next_ns = now_ns + CHECK_PERIOD_NS
        established = [one for one in self._tcp.items() if one[1].is_established]
        silent = [one for one in self._tcp.items() if not one[1].is_established]
        oldest_ns = now_ns - self._limits.hello_timeout_ns
        flooding = [fd for fd in self._tcp if self._traffic.pending_bytes(fd) > self._max_pending_bytes]
        reasons = [self.evict(fd, f"{self._name}_flood") for fd in flooding]
        reasons += [self.evict(fd, f"{self._name}_silent") for fd, one in silent if one.opened_ns < oldest_ns]
        excess = select_evictions(silent, self._max_connections)
        excess += select_evictions(reversed(established), self._max_connections)
        reasons += [self.evict(fd, f"{self._name}_too_many") for fd in excess]
        return [reason for reason in reasons if reason]

    def evict(self, descriptor: int, reason: str) -> str:
        """Close a connection. Return the drop reason, empty if it has ended already."""
        return self._tcp.evict(descriptor, reason)

    def close(self) -> None:
        self._monitor.close(linger=0)


class ConnectionGuard:
    """Limit TCP connections of the control and state sockets: handshake timeout, caps, floods and bans.

    A `Service`. `DisconnectHandler` passes on the events of the control socket's monitor.
    """

    def __init__(
        self,
        connections: ConnectionTable,
        drops: Drops,
        audit: AuditTrail,
        limits: FrontLimits,
        traffic: TrafficCounter | None = None,
    ) -> None:
        self._connections = connections
        self._drops = drops
        self._audit = audit
        self._limits = limits
        self._traffic = traffic or TrafficCounter()  # of the control socket
        self._tcp = TcpConnections()  # of the control socket
        self._subscribers = SubscriberGuard(drops, limits, self.report_flood, self._count_accepted)
        self._banned: dict[str, int] = {}  # key id -> session time until which it may not say hello
        self._flooded: dict[str, int] = {}  # address -> until when connections without hello have a lower limit
        self._warnings: dict[tuple[str, str], tuple[int, str]] = {}
        self._accepted: dict[str, int] = {}  # address -> connections since `_accepted_ns`
        self._accepted_ns = 0
        self._next_ns = 0

    # --- events ------------------------------------------------------------------------------------------------------

    def add(self, descriptor: int, now_ns: int) -> None:
        """Add a TCP connection that the control socket accepted."""
        self._traffic.reset(descriptor)
        self._count_accepted(self._tcp.add(descriptor, now_ns).address[0], now_ns)

    def remove(self, descriptor: int) -> None:
        """Remove a TCP connection of the control socket that has ended."""
        self._traffic.reset(descriptor)
        self._tcp.remove(descriptor)

    def watch_state_socket(self, state: zmq.Socket[bytes], monitor: zmq.Socket[bytes]) -> None:
        """Guard the subscribers of a state socket from now on, instead of those of the one before."""
        self._subscribers.watch(state, monitor)

    def touch(self, descriptor: int, now_ns: int) -> None:
        """Restart the handshake timeout of a connection that pairs, which it may do without hello."""
        connection = self._tcp.find(descriptor)
        if connection is not None:
            connection.quiet_ns = now_ns

    def rate_limit(self, peer: Peer, connection: FrontConnection | None, detail: str, now_ns: int) -> bool:
        """Count a rejected message. Return whether there were too many, so that the TCP connection was closed."""
        tcp = self._tcp.find(peer.descriptor) or self._tcp.add(peer.descriptor, now_ns)
        if tcp.rejections is None:
            share = 1.0 if connection is not None else SILENT_SHARE
            if connection is None and now_ns < self._flooded.get(tcp.address[0], 0):
                share *= SILENT_SHARE  # connected again, and again without hello
            limits = self._limits
            tcp.rejections = TokenBucket(limits.excess_per_s * share, int(limits.excess_burst * share), now_ns)
        if tcp.rejections.take(now_ns):
            return False
        self.report_flood(tcp.address[0], detail, now_ns, connection)
        if not close_tcp(peer.descriptor, tcp.address):
            return False
        self._drops.count("flood_cut")
        _remember(self._flooded, tcp.address[0], now_ns + BAN_NS)
        if connection is not None:
            _remember(self._banned, connection.key_id, now_ns + BAN_NS)
        return True

    def report_flood(
        self, address: str, detail: str, now_ns: int, connection: FrontConnection | None = None, warning: str = ""
    ) -> None:
        """Report a peer that exceeds its limits to audit and status. `warning`: text of the status instead."""
        name = subject = ""
        if connection is not None:
            name, subject = connection.hello.name, connection.participant_id
        self._drops.count("flood")
        self._audit.record(AuditKind.FLOOD, now_ns, subject=subject, name=name, address=address, detail=detail)
        self._warnings.pop((address, detail), None)
        while len(self._warnings) >= MAX_WARNINGS:
            del self._warnings[next(iter(self._warnings))]
        peer = " ".join(part for part in (address, f"({name})" if name else "") if part) or "an unknown address"
        self._warnings[address, detail] = (now_ns, warning or f"flood from {peer}: {detail}")

    def is_banned(self, key_id: str, now_ns: int) -> bool:
        """Return whether this key was disconnected for a flood a moment ago."""
        return now_ns < self._banned.get(key_id, 0)

    def list_warnings(self, now_ns: int) -> tuple[str, ...]:
        """Return the floods of the last minute, for the status."""
        return tuple(text for since_ns, text in self._warnings.values() if now_ns - since_ns <= WARNING_NS)

    # --- periodic ----------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> None:
        """Close connections that are silent for too long or too many, and subscribers that send too much."""
        self._subscribers.tick(now_ns)
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + CHECK_PERIOD_NS
        self._evict_silent(now_ns)

    def evict_for_memory(self, release_media: Callable[[], str] = lambda: "") -> str:
        """Close connections to free memory.

        Closes the client with the most pending bytes in both directions, or a quarter of the connections without hello
        if those hold more together. If no connection holds much, `release_media` may free memory elsewhere and returns
        a text that names it. If that frees nothing either, the case is only counted: closing a connection would not
        help.

        Returns:
            What was evicted, for the status; empty if nothing was.
        """
        owners = self._owners()
        silent = [descriptor for descriptor in self._tcp if descriptor not in owners]
        pending = {descriptor: self._traffic.pending_bytes(descriptor) for descriptor in (*owners, *silent)}
        silent_bytes = sum(pending[descriptor] for descriptor in silent) + SILENT_CONNECTION_BYTES * len(silent)
        most = max((pending[descriptor] for descriptor in owners), default=0)
        if max(silent_bytes, most) < MIN_EVICT_BYTES:
            released = release_media()
            if not released:
                self._drops.count("memory_elsewhere")
            return released
        if silent and most < silent_bytes:
            silent.reverse()  # of equal ones the newest first
            silent.sort(key=pending.__getitem__, reverse=True)
            for descriptor in silent[: max(1, len(silent) // 4)]:
                self._evict(descriptor, "memory")
            return "connections without hello"
        largest = max(owners, key=lambda descriptor: (pending[descriptor], owners[descriptor].number), default=None)
        if largest is None or not close_tcp(largest, owners[largest].address):
            return ""
        client = owners[largest]
        _remember(self._banned, client.key_id, client.last_heard_ns + BAN_NS)
        self._drops.count("memory")
        return f"{client.hello.name} from {client.address[0]}"

    def close(self) -> None:
        self._subscribers.close()

    def _owners(self) -> dict[int, FrontConnection]:
        """Return the connections that said hello by descriptor; of many behind one gateway the gateway's own."""
        owners: dict[int, FrontConnection] = {}
        for one in (*self._connections.by_number.values(), *self._connections.kept):
            owners.setdefault(one.peer.descriptor, one)
        return owners

    def _evict(self, descriptor: int, reason: str) -> None:
        counted = self._tcp.evict(descriptor, reason)
        if counted:
            self._drops.count(counted)

    def _evict_silent(self, now_ns: int) -> None:
        self._connections.expire_kept(now_ns - KEPT_NS)
        owners = self._owners()
        silent: list[tuple[int, TcpConnection]] = []
        for descriptor, connection in self._tcp.items():
            if descriptor in owners:
                connection.quiet_ns = now_ns
            else:
                silent.append((descriptor, connection))
        limits = self._limits
        for descriptor in select_evictions(silent, limits.strangers):
            self._evict(descriptor, "strangers_too_many")
        for descriptor, connection in silent:
            late = now_ns - connection.quiet_ns > limits.hello_timeout_ns
            if late and self._tcp.find(descriptor) is connection:
                self._evict(descriptor, "no_hello")

    def _count_accepted(self, address: str, now_ns: int) -> None:
        if now_ns - self._accepted_ns > SECOND:
            self._accepted_ns = now_ns
            self._accepted.clear()
        if address in self._accepted or len(self._accepted) < MAX_REMEMBERED:
            self._accepted[address] = self._accepted.get(address, 0) + 1
            if self._accepted[address] > FLOOD_CONNECTIONS_PER_S:
                self.report_flood(address, "connections", now_ns)


def _remember(table: dict[str, int], key: str, until_ns: int) -> None:
    table.pop(key, None)
    while len(table) >= MAX_REMEMBERED:
        del table[next(iter(table))]
    table[key] = until_ns


class MemoryGuard:
    """Bound the memory of the front: queues of libzmq, our own, and those of subscriptions. A `Service`.

    libzmq does not report the size of its queues, and a sum of worst cases would admit no client. So the process is
    measured: when it holds more than `max_bytes` above what it held once its sockets were open, connections with the
    most pending bytes are evicted.
    """

    def __init__(
        self,
        max_bytes: int,
        evict: Callable[[], str],
        on_evicted: Callable[[str, int], None],
        read_resident: Callable[[], int] | None = None,
        trim: Callable[[], None] | None = None,
    ) -> None:
        self._max_bytes = max_bytes
        self._evict = evict
        self._on_evicted = on_evicted
        self._read_resident = read_resident or _make_resident_reader()
        self._trim = trim or _trim_heap
        self._base = -1
        self._next_ns = 0

    def tick(self, now_ns: int) -> None:
        """Measure, and evict a connection where memory is short."""
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + MEMORY_PERIOD_NS
        if self._base < 0:
            self._base = self._read_resident()
        if self._read_resident() - self._base <= self._max_bytes:
            return
        self._trim()  # freed memory counts until the system has it back
        if self._read_resident() - self._base <= self._max_bytes:
            return
        evicted = self._evict()
        if evicted:
            self._on_evicted(evicted, now_ns)
        self._next_ns = now_ns + EVICTION_PAUSE_NS

    def close(self) -> None:
        """Do nothing: nothing was opened."""


def _make_resident_reader() -> Callable[[], int]:
    """Return a function that reads resident bytes without mapped files: assets are mapped, and the system takes those
    pages back when it needs them."""
    process = psutil.Process()

    def read_resident() -> int:
        info = process.memory_info()
        return int(info.rss - getattr(info, "shared", 0))

    return read_resident


def _trim_heap() -> None:
    """Return free memory of the C library to the system, where it can (glibc)."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (OSError, AttributeError):
        return
