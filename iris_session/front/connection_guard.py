"""Limits on TCP connections and on hellos: who is rate limited, banned, or closed to make room.

Every open connection costs a descriptor and buffers in libzmq, before a message is sent over it. So a connection that
stays silent is closed after a while, the oldest silent ones make room when there are many, and a peer that sends far
more than its limits is disconnected, banned for a moment and reported. Clients within their limits notice none of it.

`ConnectionGuard` covers the control socket and, through `SubscriberGuard`, the state socket; `channel_guard` those of
media and assets. `HelloRateLimiter` shares hellos between keys.
What a connection may ask for is decided in `admission` and `intake`, what one key may in `key_budgets`, and what is
closed when memory is short in `memory_guard`.
"""

from __future__ import annotations

import heapq
import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Final, Protocol

import zmq

from iris_session.front.audit import AuditTrail
from iris_session.front.connections import ConnectionTable, FrontConnection, Peer, TrafficCounter
from iris_session.front.key_budgets import remember
from iris_session.front.memory_guard import PendingConnection
from iris_session.link.config import MILLISECOND, SECOND, FrontLimits
from iris_session.link.sockets import close_tcp, next_tcp_event, peer_of, readable, tcp_counts
from iris_session.protocol.common import MAX_TEXT
from iris_session.protocol.limits import Drops, TokenBucket
from iris_session.protocol.names import AuditKind
from iris_session.protocol.server_messages import TOPIC_PRESENCE, TOPIC_RIGID

log = logging.getLogger(__name__)

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
#: A flood that goes on is logged again after so long without a report, so once.
LOG_NS: Final = 10 * SECOND
MAX_REMEMBERED: Final = 256
MAX_WARNINGS: Final = 8
#: Buffers and queues of libzmq for a connection that has said nothing.
SILENT_CONNECTION_BYTES: Final = 16 * 1024
BEFORE_HELLO: Final = "before hello"

#: A subscriber sends its handshake and a few topics, no more.
STATE_BYTES: Final = 65_536
STATE_BYTES_PER_S: Final = 1024
#: Subscriptions of one connection to the state socket. libzmq keeps each, at some 50 bytes for every byte of a topic.
MAX_TOPICS: Final = 16
#: A topic as long as this exists on no socket, so its sender is closed with the first one.
MAX_TOPIC_BYTES: Final = 32
#: Connections that end before they subscribed to anything, beyond which they are a flood.
EARLY_PER_S: Final = 2.0
EARLY_BURST: Final = 8
#: What may be subscribed to: these, and every beginning of them (the empty one is everything).
STATE_TOPICS: Final = (TOPIC_RIGID, TOPIC_PRESENCE)
#: Subscribers examined in one tick, besides those that sent something.
EXAMINED_PER_TICK: Final = 8
#: Subscriptions read in one tick: about half a millisecond.
SUBSCRIPTIONS_PER_TICK: Final = 128
_SUBSCRIBE: Final = b"\x01"
_UNSUBSCRIBE: Final = b"\x00"

#: Reason of a connection that could not be closed.
CLOSE_FAILED: Final = "close_failed"

#: Sources of hellos that have a token bucket of their own.
MAX_SOURCES: Final = 256


class TcpConnection:
    """One TCP connection to a listening socket.

    Attributes:
        address: Host and port of the peer.
        owner: What the connection counts for in `select_evictions`: its key once that is known, else its host.
        opened_ns: Session time at which it was accepted.
        quiet_ns: Session time at which it last belonged to an admitted client, at first that of `opened_ns`.
        rejections: Token bucket of rejected messages, made with the first of them.
        is_established: A message came through after the handshake.
        is_closed: It was closed for a flood, and messages that had arrived before may still come.
        counted_messages: Messages that count towards a flood.
        topics: Topics that it is subscribed to.
    """

    __slots__ = (
        "address",
        "counted_messages",
        "is_closed",
        "is_established",
        "opened_ns",
        "owner",
        "quiet_ns",
        "rejections",
        "topics",
    )

    def __init__(self, address: tuple[str, int], now_ns: int) -> None:
        self.address = address
        self.owner = address[0]
        self.opened_ns = self.quiet_ns = now_ns
        self.rejections: TokenBucket | None = None
        self.is_closed = self.is_established = False
        self.counted_messages = 0
        self.topics: set[bytes] = set()


class TcpConnections:
    """TCP connections of one listening socket by descriptor, in the order in which they were accepted.

    `discards_unread`: What a connection has sent, and libzmq has not read yet, is discarded when it is closed.
    """

    def __init__(self, *, discards_unread: bool = False) -> None:
        self._discards_unread = discards_unread
        self._table: dict[int, TcpConnection] = {}
        self._ended: deque[TcpConnection] = deque(maxlen=MAX_REMEMBERED)

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
        connection = self._table.pop(descriptor, None)
        if connection is not None:
            self._ended.append(connection)

    def pop_ended(self) -> list[TcpConnection]:
        """Return and forget connections that were removed since the last call, without those that were evicted."""
        ended = list(self._ended)
        self._ended.clear()
        return ended

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
        closed = close_tcp(descriptor, connection.address, discard=self._discards_unread)
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


def select_share_evictions(
    connections: Iterable[tuple[int, TcpConnection]], find_share: Callable[[str], int]
) -> list[int]:
    """Return the newest connections of every owner that has more than `find_share(owner)`.

    `connections`: the newest first.
    """
    counts: dict[str, list[int]] = {}
    for descriptor, connection in connections:
        counts.setdefault(connection.owner, []).append(descriptor)
    evicted: list[int] = []
    for owner, descriptors in counts.items():
        evicted += descriptors[: max(0, len(descriptors) - find_share(owner))]
    return evicted


class HelloRateLimiter:
    """Limit hellos per source and in total.

    A source is an allowed key, an address in a session without keys, or behind a gateway a secret. Each source has a
    few hellos of its own, so a new client is admitted independently of other clients. Beyond them it uses those that
    all sources share.
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

    libzmq keeps every subscription, whether or not anything is ever published under it, byte for byte in one tree, and
    looks through the whole tree whenever a connection ends: 40 connections with 70 topics of 900 bytes each took 3.5 s,
    in which no subscriber gets state. So a connection that subscribes to topics that do not exist is closed before the
    next message is read, what it has sent besides is discarded, and a key can open few connections at once
    (`HandshakeLimiter`).

    `on_flood(address, detail, now_ns, key)` reports a flood, `on_accept(address, now_ns)` counts a new connection,
    `find_share(owner)` returns how many connections one key may have.
    """

    def __init__(
        self,
        drops: Drops,
        limits: FrontLimits,
        on_flood: Callable[[str, str, int, str], None],
        on_accept: Callable[[str, int], None],
        find_share: Callable[[str], int] | None = None,
    ) -> None:
        self._drops = drops
        self._limits = limits
        self._on_flood = on_flood
        self._on_accept = on_accept
        self._find_share = find_share or (lambda _owner: limits.subscribers)
        self._tcp = TcpConnections(discards_unread=True)
        self._socket: zmq.Socket[bytes] | None = None
        self._monitor: zmq.Socket[bytes] | None = None
        self._examined = 0  # descriptor that was examined last
        self._is_plain = False
        self._early = TokenBucket(EARLY_PER_S, EARLY_BURST)
        self._next_ns = 0

    def __len__(self) -> int:
        return len(self._tcp)

    def watch(self, state: zmq.Socket[bytes], monitor: zmq.Socket[bytes]) -> None:
        """Guard this socket from now on, instead of the one before."""
        self.close()
        self._socket, self._monitor = state, monitor
        self._is_plain = not state.get(zmq.CURVE_SERVER)

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
        senders = self._read_subscriptions(self._socket, self._monitor, now_ns)
        self._read_connections(self._monitor, now_ns)
        self._count_early_ends(now_ns)
        others = sorted(self._tcp, key=lambda descriptor: (descriptor <= self._examined, descriptor))
        others = others[:EXAMINED_PER_TICK]
        if others:
            self._examined = others[-1]
        for descriptor in {*senders, *others}:
            self._evict_if_flooding(descriptor, now_ns)
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + CHECK_PERIOD_NS
            self._evict_excess(now_ns)

    def _count_early_ends(self, now_ns: int) -> None:
        """Count connections that ended before they subscribed to anything, and report many of them: without encryption
        libzmq closes a connection itself when its first message is too large. With it, keys that are not admitted end
        like that, too, and are counted as such."""
        for connection in self._tcp.pop_ended():
            if self._is_plain and not connection.is_established:
                self._drops.count("state_closed_early")
                if not self._early.take(now_ns):
                    self._on_flood(connection.address[0], "subscriptions", now_ns, "")

    def _record_subscription(self, connection: TcpConnection, user: str, data: bytes) -> bool:
        """Record a message of a subscriber. Return whether the connection may stay."""
        topic = data[1:]
        if data[:1] == _SUBSCRIBE and any(one.startswith(topic) for one in STATE_TOPICS):
            connection.is_established, connection.owner = True, user or connection.owner
            connection.topics.add(topic)
            return len(connection.topics) <= MAX_TOPICS
        if data[:1] == _UNSUBSCRIBE:
            connection.topics.discard(topic)
            return True
        self._drops.count("state_topic_unknown")
        connection.counted_messages += 1
        return len(topic) <= MAX_TOPIC_BYTES and connection.counted_messages <= MAX_TOPICS

    def _read_subscriptions(self, state: zmq.Socket[bytes], monitor: zmq.Socket[bytes], now_ns: int) -> set[int]:
        """Read what subscribers sent, and close those that may not. Return the descriptors of the senders."""
        senders: set[int] = set()
        if not readable(state):  # once: it lets libzmq take in more subscriptions, every time
            return senders
        for _ in range(SUBSCRIPTIONS_PER_TICK):
            try:
                frame = state.recv(zmq.DONTWAIT, copy=False)
            except zmq.Again:
                break
            try:
                descriptor = int(frame.get(zmq.SRCFD))
            except zmq.ZMQError:  # a ZeroMQ of before 2013: without its connection
                continue
            senders.add(descriptor)
            self._read_connections(monitor, now_ns)  # after the message: by now libzmq has reported its connection
            connection, user = self._tcp.find(descriptor), _read_user_id(frame)
            if connection is not None and not self._record_subscription(connection, user, frame.bytes):
                self._on_flood(connection.address[0], "subscriptions", now_ns, user)
                self._evict(descriptor, "flood_cut")
        return senders

    def _read_connections(self, monitor: zmq.Socket[bytes], now_ns: int) -> None:
        for _, accepted in self._tcp.read_events(monitor, now_ns):
            if accepted is not None:
                self._on_accept(accepted.address[0], now_ns)

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
            self._on_flood(connection.address[0], "subscriptions", now_ns, connection.owner)
            self._evict(descriptor, "flood_cut")

    def _evict_excess(self, now_ns: int) -> None:
        limits = self._limits
        established: list[tuple[int, TcpConnection]] = []
        silent: list[tuple[int, TcpConnection]] = []
        for one in self._tcp.items():
            (established if one[1].is_established else silent).append(one)
        for descriptor in select_evictions(silent, limits.strangers):
            self._evict(descriptor, "strangers_too_many")
        excess = select_share_evictions(reversed(established), self._find_share)
        for descriptor in (*excess, *select_evictions(reversed(established), limits.subscribers)):
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
        find_share: Callable[[str], int] | None = None,
    ) -> None:
        self._connections = connections
        self._drops = drops
        self._audit = audit
        self._limits = limits
        self._traffic = traffic or TrafficCounter()  # of the control socket
        self._tcp = TcpConnections()  # of the control socket
        self._subscribers = SubscriberGuard(
            drops, limits, self._report_subscriber_flood, self._count_accepted, find_share
        )
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
        """Count a rejected message, with those of the same key.

        Returns:
            Whether there were too many, so that the TCP connection was closed. That of a gateway stays open for the
            others behind it; then only the connection ends. Too many of strangers behind it are only reported.
        """
        tcp = self._tcp.find(peer.descriptor) or self._tcp.add(peer.descriptor, now_ns)
        if connection is not None:
            rejections = connection.budget.rejections
        elif tcp.rejections is not None:
            rejections = tcp.rejections
        else:
            share = SILENT_SHARE
            if now_ns < self._flooded.get(tcp.address[0], 0):
                share *= SILENT_SHARE  # connected again, and again without hello
            limits = self._limits
            rejections = TokenBucket(limits.excess_per_s * share, int(limits.excess_burst * share), now_ns)
            tcp.rejections = rejections
        if rejections.take(now_ns):
            return False
        if tcp.is_closed or (
            connection is not None and connection.gateway and self.is_banned(connection.key_id, now_ns)
        ):
            return True  # it is about to be disconnected
        self.report_flood(tcp.address[0], detail, now_ns, connection)
        if connection is not None and detail == BEFORE_HELLO and self._connections.list_behind(connection):
            return False  # of strangers: it would end those who have joined
        if connection is not None and connection.gateway:
            self._drops.count("flood_cut")
            remember(self._banned, connection.key_id, now_ns + BAN_NS)
            return True
        if not close_tcp(peer.descriptor, tcp.address):
            return False
        tcp.is_closed = True
        self._drops.count("flood_cut")
        remember(self._flooded, tcp.address[0], now_ns + BAN_NS)
        if connection is not None:
            remember(self._banned, connection.key_id, now_ns + BAN_NS)
        return True

    def report_flood(
        self, address: str, detail: str, now_ns: int, connection: FrontConnection | None = None, warning: str = ""
    ) -> None:
        """Report a peer that exceeds its limits to audit and status. `warning`: text of the status instead."""
        name = subject = ""
        if connection is not None:
            name, subject = connection.hello.name, connection.participant_id
        self._drops.count("flood")
        peer = " ".join(part for part in (address, f"({name})" if name else "") if part) or "an unknown address"
        text = (warning or f"flood from {peer}: {detail}")[:MAX_TEXT]
        if now_ns - self._warnings.get((address, detail), (-LOG_NS, ""))[0] >= LOG_NS:
            log.warning("%s", text)
        self._audit.record(AuditKind.FLOOD, now_ns, subject=subject, name=name, address=address, detail=detail)
        self._warnings.pop((address, detail), None)
        while len(self._warnings) >= MAX_WARNINGS:
            del self._warnings[next(iter(self._warnings))]
        self._warnings[address, detail] = (now_ns, text)

    def _report_subscriber_flood(self, address: str, detail: str, now_ns: int, key: str) -> None:
        self.report_flood(address, detail, now_ns)
        if key:
            remember(self._banned, key, now_ns + BAN_NS)

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

    def list_pending(self) -> list[PendingConnection]:
        """Return the connections of the control socket and what is pending in them, for `MemoryGuard`.

        Those without hello are one, of which a quarter is closed at a time, the largest first and of equal ones the
        newest; of many participants behind one gateway it is the gateway's own.
        """
        owners = self._owners()
        pending = [
            PendingConnection(
                one.key_id,
                self._traffic.pending_bytes(descriptor),
                f"{one.hello.name} from {one.address[0]}",
                partial(self._close_for_memory, one),
            )
            for descriptor, one in sorted(owners.items(), key=lambda item: item[1].number)
        ]
        silent = {fd: self._traffic.pending_bytes(fd) for fd in self._tcp if fd not in owners}
        if silent:
            n_bytes = sum(silent.values()) + SILENT_CONNECTION_BYTES * len(silent)
            pending.append(
                PendingConnection(
                    BEFORE_HELLO, n_bytes, "connections without hello", partial(self._close_silent_for_memory, silent)
                )
            )
        return pending

    def _close_for_memory(self, connection: FrontConnection) -> int:
        if not close_tcp(connection.peer.descriptor, connection.address):
            return 0
        remember(self._banned, connection.key_id, connection.last_heard_ns + BAN_NS)
        return 1

    def _close_silent_for_memory(self, silent: Mapping[int, int]) -> int:
        newest_first = list(reversed(silent))
        newest_first.sort(key=silent.__getitem__, reverse=True)
        chosen = newest_first[: max(1, len(newest_first) // 4)]
        return sum(self._tcp.evict(descriptor, "memory") == "memory" for descriptor in chosen)

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
