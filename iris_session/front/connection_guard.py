"""Limits of clients before and beside their messages: who is rate limited, reported as flooding, and banned.

`TcpGuard` limits the connections of every socket. `ConnectionGuard` is on top of that of the control socket, where it
counts rejected messages, and reports floods of all channels; `StateGuard` reads what subscribers send on the state
socket. What a connection may ask for is decided in `admission` and `intake`, what one key may in `key_budgets`, and
what is closed when memory is short in `memory_guard`. Clients within their limits notice none of it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

import zmq

from iris_session.front.audit import AuditTrail
from iris_session.front.connections import ConnectionTable, FrontConnection, Peer
from iris_session.front.key_budgets import remember
from iris_session.link.config import SECOND, FrontLimits
from iris_session.link.sockets import close_tcp, read_peer, readable
from iris_session.link.tcp_guard import (
    PendingConnection,
    TcpBounds,
    TcpConnection,
    TcpGuard,
    TcpReasons,
    TrafficCounter,
)
from iris_session.protocol.common import MAX_TEXT
from iris_session.protocol.limits import Drops, KeyedBuckets, TokenBucket
from iris_session.protocol.names import AuditKind
from iris_session.protocol.server_messages import TOPIC_PRESENCE, TOPIC_RIGID, TOPIC_ROBOTS

log = logging.getLogger(__name__)

BEFORE_HELLO: Final = "before hello"
#: What may be subscribed to: these, and every beginning of them (the empty one is everything).
STATE_TOPICS: Final = (TOPIC_RIGID, TOPIC_PRESENCE, TOPIC_ROBOTS)
_CONTROL_REASONS: Final = TcpReasons("control", "strangers_too_many", "", "no_hello", "flood_cut")
_STATE_REASONS: Final = TcpReasons(
    "state", "strangers_too_many", "subscribers_too_many", "no_subscription", "flood_cut"
)
_SUBSCRIBE: Final = b"\x01"
_UNSUBSCRIBE: Final = b"\x00"
#: A peer that was disconnected for a flood may say hello again after this [ns].
BAN_NS: Final = 3 * SECOND
#: More new TCP connections of one address in a second are a flood.
CONNECTIONS_PER_S: Final = 100
#: Limit of rejected messages before hello, as a share of the limit of an admitted client. A peer that was disconnected
#: for a flood a moment ago has the same share of that.
EARLY_SHARE: Final = 0.25
#: A connection that was disconnected as silent may still stop the session for so long [ns]. Then its TCP connection is
#: closed, too: a sleeping headset, or a network in between, can keep it open for ever.
KEPT_NS: Final = 60 * SECOND
#: So many floods are listed in the status, each for so long [ns]. One that goes on is logged again after `LOG_NS`
#: without a report, so once.
MAX_WARNINGS: Final = 8
WARNING_NS: Final = 60 * SECOND
LOG_NS: Final = 10 * SECOND
#: Buffers and queues of libzmq for a connection that has said nothing.
SILENT_BYTES: Final = 16 * 1024
#: A topic that is longer exists on no socket, so its sender is closed with the first one.
MAX_TOPIC_BYTES: Final = 32
#: A topic that does not exist counts as so many messages towards a flood: libzmq keeps it as long as its connection
#: lives, at some 50 bytes for every byte. Sixteen are no flood yet.
UNKNOWN_TOPIC_WEIGHT: Final = 62
#: Messages of subscribers read in one tick: about half a millisecond.
MESSAGES_PER_TICK: Final = 128


def max_connections_per_key(limit: int) -> int:
    """Return how many of `limit` connections one key, or one gateway, may have: a quarter stays for others."""
    return limit - limit // 4


class StateGuard:
    """Limit the TCP connections of the state socket, an XPUB socket.

    libzmq reports a finished handshake without its connection. A subscription comes after it and carries descriptor
    and key of its subscriber. So a connection counts as established once it has subscribed.

    libzmq keeps every subscription, whether or not anything is ever published under it, byte for byte in one tree, and
    looks through the whole tree whenever a connection ends: 40 connections with 70 topics of 900 bytes each took 3.5 s,
    in which no subscriber gets state. So a connection that subscribes to topics that do not exist is closed before the
    next message is read, what it has sent besides is discarded, and a key can open few connections at once
    (`HandshakeLimiter`).

    Args:
        state: The socket; closed by its owner.
        monitor: Monitor of the socket, closed by `close`.
        bounds: Bounds of the connections.
        drops: Drop counters.
        on_flood: Called with the host and key of a peer that floods, and session time.
        on_accept: Called with the host of every new connection, and session time.
    """

    def __init__(
        self,
        state: zmq.Socket[bytes],
        monitor: zmq.Socket[bytes],
        bounds: TcpBounds,
        drops: Drops,
        on_flood: Callable[[str, str, int], None],
        on_accept: Callable[[str, int], None],
    ) -> None:
        self._socket = state
        self._drops = drops
        self._on_flood = on_flood
        self._on_accept = on_accept
        self._encrypted = bool(state.get(zmq.CURVE_SERVER))
        self._tcp = TcpGuard(bounds, _STATE_REASONS, monitor, traffic=TrafficCounter(curve=self._encrypted))

    def close(self) -> None:
        """Close the monitor."""
        self._tcp.close()

    def tick(self, now_ns: int) -> None:
        """Read subscriptions, and close connections that do not subscribe, that are too many, or that flood."""
        if self._socket.closed:
            return
        self._read_subscriptions(now_ns)
        self._read_events(now_ns)
        for reason in self._tcp.tick(now_ns):
            self._drops.count(reason)
        for flood in self._tcp.pop_floods():
            self._on_flood(flood.address, flood.key_id, now_ns)

    def _read_events(self, now_ns: int) -> None:
        for event in self._tcp.read_events(now_ns):
            if event.accepted is not None:
                self._on_accept(event.accepted.address[0], now_ns)

    def _read_subscriptions(self, now_ns: int) -> None:
        """Read what subscribers sent, and close those that may not."""
        if not readable(self._socket):  # once: it lets libzmq take in more subscriptions, every time
            return
        for _ in range(MESSAGES_PER_TICK):
            try:
                frame = self._socket.recv(zmq.DONTWAIT, copy=False)
            except zmq.Again:
                return
            descriptor, user = read_peer(frame, encrypted=self._encrypted)
            self._read_events(now_ns)  # after the message: by now libzmq has reported its connection
            if self._tcp.find(descriptor) is not None:
                self._record_subscription(descriptor, user, frame.bytes)

    def _record_subscription(self, descriptor: int, user: str, data: bytes) -> None:
        topic, counts = data[1:], 1
        if data[:1] == _SUBSCRIBE and any(one.startswith(topic) for one in STATE_TOPICS):
            self._tcp.establish(descriptor, user)
        elif data[:1] != _UNSUBSCRIBE:
            self._drops.count("state_topic_unknown")
            is_long = len(topic) > MAX_TOPIC_BYTES
            counts = 1 + self._tcp.bounds.counted_messages if is_long else UNKNOWN_TOPIC_WEIGHT
        reason = self._tcp.record_message(descriptor, (len(data),), counts)
        if reason:
            self._drops.count(reason)


class ConnectionGuard:
    """Limit TCP connections and rejected messages of the control socket; report floods, and ban their keys.

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
        bounds = TcpBounds(
            unauthenticated=limits.unauthenticated,
            established=0,  # they are limited as connections
            silence_ns=limits.hello_timeout_ns,
            unread_bytes=0,  # they are limited as messages
            discards_unread=False,
        )
        self._tcp = TcpGuard(bounds, _CONTROL_REASONS, traffic=traffic)
        self._state: StateGuard | None = None
        self._state_bounds = TcpBounds(
            unauthenticated=limits.unauthenticated,
            established=limits.subscribers,
            find_share=find_share,
            silence_ns=limits.hello_timeout_ns,
            unread_bytes_per_s=1024,
            examined=8,
            bytes_period_ns=0,
        )
        self._banned: dict[str, int] = {}  # key id -> session time until which it may not say hello
        self._flooded: dict[str, int] = {}  # address -> until when connections without hello have a lower limit
        self._warnings: dict[str, tuple[int, str]] = {}  # participant id or address -> when, text
        self._logged = TokenBucket(MAX_WARNINGS * SECOND / LOG_NS, MAX_WARNINGS)
        self._accepted = KeyedBuckets(CONNECTIONS_PER_S, CONNECTIONS_PER_S, 256)
        self._next_ns = 0

    # --- events ------------------------------------------------------------------------------------------------------

    def add(self, descriptor: int, now_ns: int) -> None:
        """Add a TCP connection that the control socket accepted."""
        self._count_accepted(self._tcp.add(descriptor, now_ns).address[0], now_ns)

    def remove(self, descriptor: int) -> None:
        """Remove a TCP connection of the control socket that has ended."""
        self._tcp.remove(descriptor)

    def watch_state_socket(self, state: zmq.Socket[bytes], monitor: zmq.Socket[bytes]) -> None:
        """Guard the subscribers of a state socket from now on, instead of those of the one before."""
        self.close()
        on_flood, on_accept = self._report_subscriber_flood, self._count_accepted
        self._state = StateGuard(state, monitor, self._state_bounds, self._drops, on_flood, on_accept)

    def touch(self, descriptor: int, now_ns: int) -> None:
        """Restart the handshake timeout of a connection that pairs, which it may do without hello."""
        connection = self._tcp.find(descriptor)
        if connection is not None:
            connection.quiet_ns = now_ns

    def rate_limit(self, peer: Peer, connection: FrontConnection | None, detail: str, now_ns: int) -> bool:
        """Count a rejected message, with those of the same key.

        Returns:
            Whether there were too many, so that the TCP connection was closed. That of a gateway stays open for the
            others behind it; then only the connection ends. Too many before hello, of others behind it, are only
            reported.
        """
        tcp = self._tcp.find(peer.descriptor) or self._tcp.add(peer.descriptor, now_ns)
        is_gateway = connection is not None and bool(connection.gateway)
        if self._find_rejections(tcp, connection, now_ns).take(now_ns):
            return False
        if tcp.is_closed or (is_gateway and connection is not None and self.is_banned(connection.key_id, now_ns)):
            return True  # it is about to be disconnected
        self.report_flood(tcp.address[0], detail, now_ns, connection)
        if connection is not None and detail == BEFORE_HELLO and self._connections.list_behind(connection):
            return False  # it would end those who have joined
        if not is_gateway:
            if not close_tcp(peer.descriptor, tcp.address):
                return False
            tcp.is_closed = True
            remember(self._flooded, tcp.address[0], now_ns + BAN_NS)
        self._drops.count("flood_cut")
        if connection is not None:
            self._ban(connection.key_id, now_ns)
        return True

    def _find_rejections(self, tcp: TcpConnection, connection: FrontConnection | None, now_ns: int) -> TokenBucket:
        """Return the bucket of rejected messages: of the key, before hello of the TCP connection."""
        if connection is not None:
            return connection.budget.rejections
        if tcp.rejections is None:
            share = EARLY_SHARE
            if now_ns < self._flooded.get(tcp.address[0], 0):
                share *= share  # connected again, and again without hello
            limits = self._limits
            tcp.rejections = TokenBucket(limits.excess_per_s * share, int(limits.excess_burst * share), now_ns)
        return tcp.rejections

    # --- floods ------------------------------------------------------------------------------------------------------

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
        flooder = subject or address
        is_new = now_ns - self._warnings.pop(flooder, (-LOG_NS, ""))[0] >= LOG_NS
        if is_new and self._logged.take(now_ns):
            log.warning("%s", text)
        self._audit.record(AuditKind.FLOOD, now_ns, subject=subject, name=name, address=address, detail=detail)
        while len(self._warnings) >= MAX_WARNINGS:
            del self._warnings[next(iter(self._warnings))]
        self._warnings[flooder] = (now_ns, text)

    def _report_subscriber_flood(self, address: str, key_id: str, now_ns: int) -> None:
        self.report_flood(address, "subscriptions", now_ns)
        if key_id:
            self._ban(key_id, now_ns)

    def _count_accepted(self, address: str, now_ns: int) -> None:
        if not self._accepted.take(address, now_ns):
            self.report_flood(address, "connections", now_ns)

    def _ban(self, key_id: str, now_ns: int) -> None:
        remember(self._banned, key_id, now_ns + BAN_NS)

    def is_banned(self, key_id: str, now_ns: int) -> bool:
        """Return whether this key was disconnected for a flood a moment ago."""
        return now_ns < self._banned.get(key_id, 0)

    def list_warnings(self, now_ns: int) -> tuple[str, ...]:
        """Return the floods of the last minute, for the status."""
        return tuple(text for since_ns, text in self._warnings.values() if now_ns - since_ns <= WARNING_NS)

    # --- periodic ----------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> None:
        """Close connections that are silent for too long or too many, and subscribers that send too much."""
        if self._state is not None:
            self._state.tick(now_ns)
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + self._tcp.bounds.check_period_ns
        self._connections.expire_kept(now_ns - KEPT_NS)
        owners = self._find_owners()
        for descriptor, connection in self._tcp.table.items():
            connection.is_established = descriptor in owners
            if connection.is_established:
                connection.quiet_ns = now_ns
        for reason in self._tcp.tick(now_ns):
            self._drops.count(reason)

    def close(self) -> None:
        if self._state is not None:
            self._state.close()

    def _find_owners(self) -> dict[int, FrontConnection]:
        """Return the connections that said hello by descriptor; of many behind one gateway the gateway's own."""
        owners: dict[int, FrontConnection] = {}
        for one in (*self._connections.by_number.values(), *self._connections.kept):
            owners.setdefault(one.peer.descriptor, one)
        return owners

    # --- memory ------------------------------------------------------------------------------------------------------

    def list_pending(self) -> list[PendingConnection]:
        """Return the connections of the control socket and what is pending in them, for `MemoryGuard`.

        Those without hello are one, of which a quarter is closed at a time, the largest first and of equal ones the
        newest; of many participants behind one gateway it is the gateway's own.
        """
        owners, traffic = self._find_owners(), self._tcp.traffic
        pending = [
            PendingConnection(
                one.key_id,
                traffic.pending_bytes(descriptor),
                f"{one.hello.name} from {one.address[0]}",
                partial(self._close_for_memory, one),
            )
            for descriptor, one in sorted(owners.items(), key=lambda item: item[1].number)
        ]
        silent = {fd: traffic.pending_bytes(fd) for fd in self._tcp.table if fd not in owners}
        if silent:
            n_bytes = sum(silent.values()) + SILENT_BYTES * len(silent)
            close = partial(self._close_silent_for_memory, silent)
            pending.append(PendingConnection(BEFORE_HELLO, n_bytes, "connections without hello", close))
        return pending

    def _close_for_memory(self, connection: FrontConnection) -> int:
        if not close_tcp(connection.peer.descriptor, connection.address):
            return 0
        self._ban(connection.key_id, connection.last_heard_ns)
        return 1

    def _close_silent_for_memory(self, silent: Mapping[int, int]) -> int:
        newest_first = list(reversed(silent))
        newest_first.sort(key=silent.__getitem__, reverse=True)
        chosen = newest_first[: max(1, len(newest_first) // 4)]
        return sum(self._tcp.evict(descriptor, "memory") == "memory" for descriptor in chosen)
