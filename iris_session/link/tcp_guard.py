"""Limits of the TCP connections to one listening socket: how many, how long silent, how many unread bytes.

Every open connection costs a descriptor and buffers, before a message is sent over it. `TcpGuard` closes connections
that stay silent, that are too many, and of which much more was received than was read. The front has one for each of
its sockets (control, state, media, media ingest, assets), the web gateway one for its own. What follows when one was
closed (counters, reports, bans) is decided by those that use it.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple, Protocol

import zmq

from iris_session.link.config import MEBIBYTE, MILLISECOND, SECOND
from iris_session.link.sockets import close_tcp, next_tcp_event, pace_tcp, peer_of, readable, tcp_counts
from iris_session.protocol.limits import TokenBucket, find_network

#: Drop reason of a connection that could not be closed.
CLOSE_FAILED: Final = "close_failed"
#: ZMTP 3: flags and length before a frame, the length in one byte or eight.
_SHORT: Final = 255
_SHORT_HEADER: Final = 2
_LONG_HEADER: Final = 9
#: CurveZMQ: name of the command, nonce, authenticator and flags around every frame.
_CURVE: Final = 8 + 8 + 16 + 1


class TcpBounds(NamedTuple):
    """Bounds of the connections to one listening socket. 0 is no bound.

    Attributes:
        unauthenticated: Connections that are not established.
        unauthenticated_per_owner: The same of one owner.
        established: Connections that are established.
        find_share: Returns how many established connections one owner may have; `None`: as many as there may be.
        silence_ns: Longest time until a connection is established [ns].
        idle_ns: Longest time without a request of an established connection [ns].
        unread_bytes: Bytes of one connection that were received and not read.
        unread_bytes_per_s: So many more for every second of its life: what libzmq handles itself is never read.
        owner_bytes: Unread bytes of all connections of one owner.
        total_bytes: Unread bytes of all connections.
        counted_messages: Messages of one connection that count towards a flood.
        discards_unread: What a closed connection has sent, and libzmq has not read yet, is discarded.
        examined: Connections whose bytes are examined in one tick, in turn; 0: all of them.
        check_period_ns, bytes_period_ns: How often connections are counted, and their bytes [ns]. A peer on this
            machine sends 100 MB in 20 ms.
        max_floods: Floods that are remembered until `pop_floods`.
    """

    unauthenticated: int = 1024
    unauthenticated_per_owner: int = 0
    established: int = 512
    find_share: Callable[[str], int] | None = None
    silence_ns: int = 10 * SECOND
    idle_ns: int = 0
    unread_bytes: int = 65_536
    unread_bytes_per_s: int = 0
    owner_bytes: int = 0
    total_bytes: int = 0
    counted_messages: int = 1024
    discards_unread: bool = True
    examined: int = 0
    check_period_ns: int = 250 * MILLISECOND
    bytes_period_ns: int = 20 * MILLISECOND
    max_floods: int = 256


class TcpReasons(NamedTuple):
    """Name of a channel, and the drop reasons of its connections, by the bound that they exceeded."""

    channel: str
    unauthenticated: str
    established: str
    silent: str
    flood: str
    per_owner: str = ""


def make_reasons(channel: str) -> TcpReasons:
    """Return the usual drop reasons of a channel, which begin with its name."""
    too_many = f"{channel}_too_many"
    return TcpReasons(channel, too_many, too_many, f"{channel}_silent", f"{channel}_flood")


@dataclass(slots=True, eq=False)
class TcpConnection:
    """One TCP connection to a listening socket.

    Attributes:
        address: Host and port of the peer.
        owner: What the connection counts for: its key once that is known, before the network of its peer.
        opened_ns: When it was accepted.
        quiet_ns: Since when it is silent, or idle.
        is_established: Its peer has said, subscribed or requested something that is allowed.
        requests: Requests under way, while which it is not idle.
        counted_messages: Messages that count towards a flood.
        unread: Bytes that were received and not read, when they were examined last.
        is_closed: It was closed for a flood, and messages that had arrived before may still come.
        rejections: Token bucket of rejected messages, made with the first of them.
    """

    address: tuple[str, int]
    opened_ns: int
    owner: str = ""
    quiet_ns: int = 0
    is_established: bool = False
    requests: int = 0
    counted_messages: int = 0
    unread: int = 0
    is_closed: bool = False
    rejections: TokenBucket | None = None

    def __post_init__(self) -> None:
        self.owner, self.quiet_ns = find_network(self.address[0]), self.opened_ns

    @property
    def key_id(self) -> str:
        """Key of the peer, empty while it is not known."""
        return "" if self.owner == find_network(self.address[0]) else self.owner


class TcpEvent(NamedTuple):
    """A connection that was accepted, or one that has ended. `ended`: the one that had the descriptor before."""

    descriptor: int
    accepted: TcpConnection | None
    ended: TcpConnection | None


class TcpFlood(NamedTuple):
    """A connection that was closed because it sent too much.

    Attributes:
        address: Host of the peer.
        key_id: Its key, empty before its first whole message and without encryption.
        opened_ns: When it was accepted.
        unread: Its unread bytes.
    """

    address: str
    key_id: str
    opened_ns: int
    unread: int


class PendingConnection(NamedTuple):
    """One connection, or several that are closed together, and the bytes pending in it.

    Attributes:
        owner: Key, or address where the key is not known.
        bytes: Pending in both directions.
        label: Name for the status.
        close: Closes it, or them. Returns the number of connections closed, 0 when they have ended already.
    """

    owner: str
    bytes: int
    label: str
    close: Callable[[], int]


class TrafficCounter:
    """Count the bytes that are pending in libzmq for and from each TCP connection, which libzmq does not report.

    What was handed to libzmq, less what the peer has acknowledged to the system, waits to be sent. What the system has
    received, less what was read, waits to be read. Both are off by the handshake, which does not matter when megabytes
    are looked for. `curve`: whether the socket is encrypted.
    """

    def __init__(self, *, curve: bool = False) -> None:
        self._overhead = _CURVE if curve else 0
        self._sent: dict[int, int] = {}
        self._received: dict[int, int] = {}

    def reset(self, descriptor: int) -> None:
        """Start anew for a descriptor: a TCP connection was accepted or has ended."""
        self._sent.pop(descriptor, None)
        self._received.pop(descriptor, None)

    def count_sent(self, descriptor: int, frames: Iterable[bytes]) -> None:
        """Count a message that was handed to libzmq for a connection."""
        self._sent[descriptor] = self._sent.get(descriptor, 0) + sum(self._wire_length(len(one)) for one in frames)

    def count_received(self, descriptor: int, length: int) -> None:
        """Count a frame that was read from a connection."""
        self._received[descriptor] = self._received.get(descriptor, 0) + self._wire_length(length)

    def pending_bytes(self, descriptor: int) -> int:
        """Return the bytes pending in both directions, 0 where the system does not count them."""
        counts = tcp_counts(descriptor)
        if counts is None:
            return 0
        to_send = self._sent.get(descriptor, 0) - counts.acknowledged
        to_read = counts.received - self._received.get(descriptor, 0)
        return max(0, to_send) + max(0, to_read)

    def _wire_length(self, length: int) -> int:
        length += self._overhead
        return length + (_SHORT_HEADER if length <= _SHORT else _LONG_HEADER)


class CloseTcp(Protocol):
    """Closes a connection, as `close_tcp` does. Returns whether it was open."""

    def __call__(self, descriptor: int, peer: tuple[str, int], *, discard: bool = False) -> bool: ...


class TcpGuard:
    """Limit the TCP connections of one listening socket. Belongs to the thread that reads the socket.

    `list_pending` and `pop_floods` are for other threads. Methods that close connections return a drop reason for
    each, empty for one that has ended already, and `close_failed` for one that could not be closed: that one stays in
    the table and is tried again.

    Args:
        bounds: Bounds of the connections.
        reasons: Drop reasons.
        monitor: Monitor of a ZeroMQ socket, for `read_events`; closed by `close`.
        traffic: Counter of the bytes that were read and sent.
        close: Closes a connection where libzmq does not own it; `None`: `close_tcp`.
    """

    def __init__(
        self,
        bounds: TcpBounds,
        reasons: TcpReasons,
        monitor: zmq.Socket[bytes] | None = None,
        *,
        traffic: TrafficCounter | None = None,
        close: CloseTcp | None = None,
    ) -> None:
        self.bounds = bounds
        self.traffic = TrafficCounter() if traffic is None else traffic
        self._reasons = reasons
        self._monitor = monitor
        self._close = close
        self._table: dict[int, TcpConnection] = {}  # in the order in which they were accepted
        self._unread: tuple[tuple[int, TcpConnection], ...] = ()
        self._floods: deque[TcpFlood] = deque(maxlen=bounds.max_floods)
        self._examined = 0  # descriptor that was examined last
        self._next_ns = self._next_bytes_ns = 0

    @property
    def table(self) -> Mapping[int, TcpConnection]:
        """The connections by descriptor, in the order in which they were accepted."""
        return self._table

    @property
    def has_unread(self) -> bool:
        """True while much of what was received is unread: `tick` should be called often."""
        return sum(connection.unread for _, connection in self._unread) > MEBIBYTE

    def __len__(self) -> int:
        return len(self._table)

    # --- events ------------------------------------------------------------------------------------------------------

    def find(self, descriptor: int) -> TcpConnection | None:
        """Return an open connection."""
        return self._table.get(descriptor)

    def add(self, descriptor: int, now_ns: int, address: tuple[str, int] | None = None) -> TcpConnection:
        """Add a connection that was accepted, in place of an earlier one with the same descriptor.

        Args:
            descriptor: File descriptor of the connection.
            now_ns: Present time [ns].
            address: Host and port of the peer; `None`: ask the system.

        Returns:
            The connection, not established.
        """
        self.remove(descriptor)
        connection = self._table[descriptor] = TcpConnection(address or peer_of(descriptor), now_ns)
        return connection

    def remove(self, descriptor: int) -> TcpConnection | None:
        """Remove and return a connection that has ended."""
        self.traffic.reset(descriptor)
        return self._table.pop(descriptor, None)

    def read_events(self, now_ns: int) -> list[TcpEvent]:
        """Read which connections were accepted and closed.

        Call it after a message was received and before `record_message`: libzmq reports the connection first.
        """
        events: list[TcpEvent] = []
        while self._monitor is not None and readable(self._monitor):
            event, descriptor = next_tcp_event(self._monitor)
            ended = self.remove(descriptor)
            accepted = self.add(descriptor, now_ns) if event == zmq.EVENT_ACCEPTED else None
            events.append(TcpEvent(descriptor, accepted, ended))
        return events

    def establish(self, descriptor: int, key_id: str = "") -> None:
        """Note that a connection is established, and its key."""
        connection = self._table.get(descriptor)
        if connection is not None:
            connection.is_established, connection.owner = True, key_id or connection.owner

    def record_message(self, descriptor: int, lengths: Iterable[int], counts: int) -> str:
        """Record a message with frames of these lengths. Return the drop reason if its connection was closed.

        `counts`: as how many it counts towards a flood.
        """
        connection = self._table.get(descriptor)
        if connection is None:
            return ""
        for length in lengths:
            self.traffic.count_received(descriptor, length)
        connection.counted_messages += counts
        if connection.counted_messages <= self.bounds.counted_messages:
            return ""
        reason = self.evict(descriptor, self._reasons.flood)
        return "" if reason == CLOSE_FAILED else reason  # it is tried again with its next message

    # --- periodic ----------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> list[str]:
        """Close connections that flood, that are too many, silent or idle. Return a drop reason for each."""
        bounds = self.bounds
        reasons: list[str] = []
        if bounds.unread_bytes and now_ns >= self._next_bytes_ns:
            self._next_bytes_ns = now_ns + bounds.bytes_period_ns
            reasons += self._evict_for_bytes(now_ns)
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + bounds.check_period_ns
            reasons += self.evict_excess()
            reasons += self._evict_silent(now_ns)
        return [reason for reason in reasons if reason]

    def evict_excess(self) -> list[str]:
        """Close connections that are too many: of those that are not established the oldest, of others the newest, so
        that existing ones stay. Return a drop reason for each."""
        bounds, reasons = self.bounds, self._reasons
        waiting = [one for one in self._table.items() if not one[1].is_established]
        chosen: dict[int, str] = {}
        if bounds.unauthenticated_per_owner:
            for descriptor in select_share_evictions(waiting, lambda _owner: bounds.unauthenticated_per_owner):
                chosen[descriptor] = reasons.per_owner
        if bounds.unauthenticated:
            waiting = [one for one in waiting if one[0] not in chosen]
            chosen |= dict.fromkeys(select_evictions(waiting, bounds.unauthenticated), reasons.unauthenticated)
        established = [one for one in self._table.items() if one[1].is_established]
        if bounds.find_share is not None:
            too_many = select_share_evictions(reversed(established), bounds.find_share)
            chosen |= dict.fromkeys(too_many, reasons.established)
        if bounds.established:
            idle = [one for one in established if one[0] not in chosen and not one[1].requests]
            busy = len([one for one in established if one[1].requests])
            too_many = select_evictions(reversed(idle), bounds.established - busy)
            chosen |= dict.fromkeys(too_many, reasons.established)
        return [reason for descriptor, why in chosen.items() if (reason := self.evict(descriptor, why))]

    def _evict_silent(self, now_ns: int) -> list[str]:
        bounds = self.bounds
        late: list[int] = []
        for descriptor, one in self._table.items():
            if one.requests:
                one.quiet_ns = now_ns
            longest_ns = bounds.idle_ns if one.is_established else bounds.silence_ns
            if longest_ns and now_ns - one.quiet_ns > longest_ns:
                late.append(descriptor)
        return [self.evict(descriptor, self._reasons.silent) for descriptor in late]

    def _evict_for_bytes(self, now_ns: int) -> list[str]:
        """Close connections with too many unread bytes, then the largest of the owner with most of them, until owners
        and total are in bounds. Return a drop reason for each."""
        bounds = self.bounds
        self._examine_bytes()
        left = {descriptor: one for descriptor, one in self._table.items() if one.unread}
        reasons: list[str] = []
        for descriptor, one in list(left.items()):
            if one.unread > bounds.unread_bytes + bounds.unread_bytes_per_s * (now_ns - one.opened_ns) // SECOND:
                reasons.append(self.evict(descriptor, self._reasons.flood))
                del left[descriptor]
        while bounds.owner_bytes or bounds.total_bytes:
            sums: dict[str, int] = {}
            for one in left.values():
                sums[one.owner] = sums.get(one.owner, 0) + one.unread
            owner = max(sums, key=sums.__getitem__, default="")
            is_owner_over = 0 < bounds.owner_bytes < sums.get(owner, 0)
            if not is_owner_over and not 0 < bounds.total_bytes < sum(sums.values()):
                break
            largest = max((fd for fd, one in left.items() if one.owner == owner), key=lambda fd: left[fd].unread)
            reasons.append(self.evict(largest, self._reasons.flood))
            del left[largest]
        self._unread = tuple(left.items())
        return reasons

    def _examine_bytes(self) -> None:
        descriptors = list(self._table)
        if self.bounds.examined and descriptors:
            descriptors.sort(key=lambda descriptor: (descriptor <= self._examined, descriptor))
            descriptors = descriptors[: self.bounds.examined]
            self._examined = descriptors[-1]
        for descriptor in descriptors:
            self._table[descriptor].unread = self.traffic.pending_bytes(descriptor)

    # --- one connection ----------------------------------------------------------------------------------------------

    def evict(self, descriptor: int, reason: str) -> str:
        """Close a connection. Return the drop reason."""
        connection = self._table.get(descriptor)
        if connection is None:
            return ""
        close = self._close or close_tcp
        closed = close(descriptor, connection.address, discard=self.bounds.discards_unread)
        if not closed and peer_of(descriptor) == connection.address:
            return CLOSE_FAILED
        self._table.pop(descriptor, None)
        if reason == self._reasons.flood:
            flood = TcpFlood(connection.address[0], connection.key_id, connection.opened_ns, connection.unread)
            self._floods.append(flood)
        return reason if closed else ""

    def pace(self, descriptor: int, bytes_per_s: float) -> None:
        """Limit the rate at which the system sends to a connection, 0 for no limit."""
        connection = self._table.get(descriptor)
        if connection is not None:
            pace_tcp(descriptor, connection.address, bytes_per_s)

    def pop_floods(self) -> list[TcpFlood]:
        """Return and forget the connections that were closed for a flood since the last call."""
        return [self._floods.popleft() for _ in range(len(self._floods))]

    def list_pending(self) -> list[PendingConnection]:
        """Return the connections and what is unread of them, as of the last tick."""
        return [
            PendingConnection(
                connection.owner,
                connection.unread,
                f"a connection to {self._reasons.channel} from {connection.address[0]}",
                partial(self._close or close_tcp, descriptor, connection.address),
            )
            for descriptor, connection in self._unread
        ]

    def close(self) -> None:
        """Close the monitor. Connections are those of the socket, which its owner closes."""
        if self._monitor is not None:
            self._monitor.close(linger=0)


def select_evictions(connections: Iterable[tuple[int, TcpConnection]], limit: int) -> list[int]:
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


def select_share_evictions(
    connections: Iterable[tuple[int, TcpConnection]], find_share: Callable[[str], int]
) -> list[int]:
    """Return the first connections of every owner that has more than `find_share(owner)`."""
    owned: dict[str, list[int]] = {}
    for descriptor, connection in connections:
        owned.setdefault(connection.owner, []).append(descriptor)
    evicted: list[int] = []
    for owner, descriptors in owned.items():
        evicted += descriptors[: max(0, len(descriptors) - find_share(owner))]
    return evicted
