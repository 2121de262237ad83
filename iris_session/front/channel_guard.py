"""Limits of TCP connections to media, media ingest and assets: silent ones, too many, and floods."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Final, NamedTuple

import zmq

from iris_session.front.connection_guard import (
    CHECK_PERIOD_NS,
    CLOSE_FAILED,
    MAX_REMEMBERED,
    TcpConnection,
    TcpConnections,
    select_evictions,
    select_share_evictions,
)
from iris_session.front.connections import TrafficCounter
from iris_session.front.memory_guard import PendingConnection
from iris_session.link.config import MEBIBYTE, MILLISECOND, FrontLimits
from iris_session.link.sockets import close_tcp, pace_tcp
from iris_session.protocol.limits import MAX_MEDIA_FRAME_BYTES

#: Counted messages of one connection to a channel before it is closed: repeated subscriptions, as many as a client can
#: have over and over, or frames of a source without permission.
MAX_COUNTED_MESSAGES: Final = 1024
#: Unread bytes are looked at more often than connections: a peer on this machine sends 100 MB in that time.
BYTES_PERIOD_NS: Final = 20 * MILLISECOND
#: More than this is unread only of a peer whose key was accepted: before, libzmq takes one command of a frame's size.
STRANGER_BYTES: Final = 2 * MAX_MEDIA_FRAME_BYTES


class ChannelBounds(NamedTuple):
    """Bounds of the connections to one socket of media or assets.

    Attributes:
        connections: Established connections at most, and silent connections at most.
        pending_bytes: Received but unread bytes of one connection at most.
        owner_bytes: The same of all connections of one owner, 0 for no bound.
        total_bytes: The same of all connections, 0 for no bound.
        find_share: Returns how many established connections one owner may have; `None`: as many as there may be.
    """

    connections: int
    pending_bytes: int
    owner_bytes: int = 0
    total_bytes: int = 0
    find_share: Callable[[str], int] | None = None


class ChannelFlood(NamedTuple):
    """A connection that was closed because more was received than read.

    Attributes:
        address, key_id: Host of the peer, and its key: empty before its first whole message and without encryption.
        opened_ns: Session time at which it was accepted.
        has_key: It has a key, known or not: more was unread than libzmq takes before the handshake.
    """

    address: str
    key_id: str
    opened_ns: int
    has_key: bool


class ChannelGuard:
    """Limit TCP connections of one socket of media or assets. Belongs to the thread of that channel.

    Closes connections that stay silent, that are too many, and that send more than is read: libzmq collects all frames
    of a message, however many, before it delivers the first. Drop reasons begin with `name`. `list_pending` and
    `pop_floods` are for other threads.

    Args:
        monitor: Monitor of the socket.
        limits: Handshake timeout.
        bounds: Of connections and unread bytes.
        curve: Whether the socket is encrypted.
        name: Prefix of the drop reasons.
    """

    def __init__(
        self,
        monitor: zmq.Socket[bytes],
        limits: FrontLimits,
        bounds: ChannelBounds,
        *,
        curve: bool,
        name: str = "media",
    ) -> None:
        self._monitor = monitor
        self._name = name
        self._limits = limits
        self._bounds = bounds
        self._pending: tuple[tuple[int, TcpConnection, int], ...] = ()
        self._traffic = TrafficCounter(curve=curve)
        self._tcp = TcpConnections(discards_unread=True)
        self._floods: deque[ChannelFlood] = deque(maxlen=MAX_REMEMBERED)
        self._next_ns = self._next_bytes_ns = 0

    @property
    def has_pending(self) -> bool:
        """True while much of what was received is unread: `tick` should be called often."""
        return sum(n_bytes for _, _, n_bytes in self._pending) > MEBIBYTE

    def read_events(self, now_ns: int) -> list[int]:
        """Read accepted and closed connections. Return descriptors that belong to no or to another connection now.

        Call it after a message was received and before `record_message`: libzmq reports the connection first.
        """
        changed = [descriptor for descriptor, _ in self._tcp.read_events(self._monitor, now_ns)]
        for descriptor in changed:
            self._traffic.reset(descriptor)
        return changed

    def has_connection(self, descriptor: int) -> bool:
        """Return whether a connection is open, as far as `read_events` has read."""
        return self._tcp.find(descriptor) is not None

    def record_message(self, descriptor: int, user: str, lengths: Iterable[int], *, counts: int) -> str:
        """Record a message with frames of these lengths. `counts`: as how many it counts towards a flood.

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
        reasons: list[str] = []
        if now_ns >= self._next_bytes_ns:
            self._next_bytes_ns = now_ns + BYTES_PERIOD_NS
            reasons += self._evict_for_bytes()
        if now_ns < self._next_ns:
            return reasons
        self._next_ns = now_ns + CHECK_PERIOD_NS
        established = [one for one in self._tcp.items() if one[1].is_established]
        silent = [one for one in self._tcp.items() if not one[1].is_established]
        oldest_ns = now_ns - self._limits.hello_timeout_ns
        reasons += [self.evict(fd, f"{self._name}_silent") for fd, one in silent if one.opened_ns < oldest_ns]
        excess = select_evictions(silent, self._bounds.connections)
        if self._bounds.find_share is not None:
            excess += select_share_evictions(reversed(established), self._bounds.find_share)
        excess += select_evictions(reversed(established), self._bounds.connections)
        reasons += [self.evict(fd, f"{self._name}_too_many") for fd in excess]
        return [reason for reason in reasons if reason]

    def list_pending(self) -> list[PendingConnection]:
        """Return the connections and what is unread of them, as of the last tick, for `MemoryGuard`."""
        return [
            PendingConnection(
                connection.owner,
                n_bytes,
                f"a connection to {self._name} from {connection.address[0]}",
                partial(close_tcp, descriptor, connection.address),
            )
            for descriptor, connection, n_bytes in self._pending
        ]

    def _evict_for_bytes(self) -> list[str]:
        """Close connections with too many unread bytes, then the largest of the owner with most of them, until owners
        and total are in bounds. Return a drop reason for each."""
        bounds = self._bounds
        pending = {fd: self._traffic.pending_bytes(fd) for fd in self._tcp}
        chosen = [fd for fd, n_bytes in pending.items() if n_bytes > bounds.pending_bytes]
        reasons = [self.evict(fd, f"{self._name}_flood", pending[fd]) for fd in chosen]
        left = {fd: (one, pending[fd]) for fd, one in self._tcp.items() if fd not in chosen}
        while left and (bounds.owner_bytes or bounds.total_bytes):
            sums: dict[str, int] = {}
            for connection, n_bytes in left.values():
                sums[connection.owner] = sums.get(connection.owner, 0) + n_bytes
            owner = max(sums, key=sums.__getitem__)
            if sums[owner] <= (bounds.owner_bytes or sums[owner]) and sum(sums.values()) <= (
                bounds.total_bytes or sum(sums.values())
            ):
                break
            largest = max((fd for fd, (one, _) in left.items() if one.owner == owner), key=lambda fd: left[fd][1])
            reasons.append(self.evict(largest, f"{self._name}_flood", pending[largest]))
            del left[largest]
        self._pending = tuple((fd, connection, n_bytes) for fd, (connection, n_bytes) in left.items() if n_bytes)
        return reasons

    def evict(self, descriptor: int, reason: str, unread: int = 0) -> str:
        """Close a connection with `unread` bytes. Return the drop reason, empty if it has ended already."""
        connection = self._tcp.find(descriptor)
        counted = self._tcp.evict(descriptor, reason)
        if connection is not None and counted == f"{self._name}_flood":
            address, owner = connection.address[0], connection.owner
            key_id = "" if owner == address else owner
            has_key = bool(key_id) or unread > STRANGER_BYTES
            self._floods.append(ChannelFlood(address, key_id, connection.opened_ns, has_key))
        return counted

    def pace(self, descriptor: int, bytes_per_s: float) -> None:
        """Limit the rate at which the system sends to a connection, 0 for no limit."""
        connection = self._tcp.find(descriptor)
        if connection is not None:
            pace_tcp(descriptor, connection.address, bytes_per_s)

    def pop_floods(self) -> list[ChannelFlood]:
        """Return and forget the connections that were closed for a flood since the last call."""
        return [self._floods.popleft() for _ in range(len(self._floods))]

    def close(self) -> None:
        self._monitor.close(linger=0)
