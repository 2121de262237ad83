"""Impaired links in user space: forward the ports of a session from other loopback addresses, later and slower.

A client that joins at a link's address (127.0.0.2) has that link between itself and the session, which listens on the
same ports of another address (127.0.0.1). Connections over one link share its rate and its stalls. TCP: bytes are
never lost and keep their order; a sender is blocked when `window_kib` are in flight. UDP: datagrams are lost,
duplicated and reordered. `process` runs the links.
"""

from __future__ import annotations

import asyncio
import contextlib
import heapq
import itertools
import socket
import struct
import time
from collections import deque
from collections.abc import Sequence
from typing import Any, Final

from iris_session.netsim.profiles import DIRECTIONS, DOWN, UP, LinkConditions, Profile

CHUNK: Final = 16_384
#: Kernel buffers of the proxy's sockets; they add to the bytes in flight that the profile allows.
BUFFER_BYTES: Final = 32_768
#: `select` takes 1024 files, a connection needs two. Its timeouts are exact to 50 us, those of `epoll` to 1 ms.
MAX_CONNECTIONS: Final = 300
OWN_DELAYS_KEPT: Final = 20_000
MAX_DATAGRAM: Final = 65_507
#: Clients of one UDP port, and datagrams in flight per client and direction; more are dropped and counted.
MAX_FLOWS: Final = 64
MAX_QUEUED: Final = 512
Address = tuple[str, int]
_RESET: Final = struct.pack("ii", 1, 0)  # SO_LINGER 0: close sends RST


class ImpairedLink:
    """One impaired link: its conditions, rate and connections. All times are CLOCK_MONOTONIC in nanoseconds."""

    def __init__(self, address: str, target: str, profile: Profile, seed: int) -> None:
        self.address, self.target, self.seed = address, target, seed
        self.profile = profile
        self.stalled_by_command = False
        self.source = ""  # address from which the session is reached; empty: the system's choice
        self.abandoned: deque[socket.socket] = deque()
        self.pipes: set[_Pipe] = set()
        self.connections: set[_Connection] = set()
        self.ports: list[DatagramPort] = []
        self.accepted = self.refused = 0
        self.bytes = dict.fromkeys(DIRECTIONS, 0)
        self.own_ns: deque[int] = deque(maxlen=OWN_DELAYS_KEPT)
        self._loop = asyncio.get_running_loop()
        self._change: asyncio.TimerHandle | None = None
        self._was_stalled: dict[str, bool] = {}
        self._listening: list[socket.socket] = []
        self.start_profile(profile)

    @property
    def window(self) -> int:
        """Bytes that may be in flight per connection and direction."""
        return self.profile.window_kib * 1024

    def listen(self, ports: Sequence[int], udp_ports: Sequence[int]) -> None:
        """Open the ports. Raises `OSError`."""
        for port in ports:
            listening = socket.create_server((self.address, port), backlog=512)
            listening.setblocking(False)
            self._listening.append(listening)
            self._loop.add_reader(listening.fileno(), self._accept, listening, port)
        self.ports += [DatagramPort(self, port) for port in udp_ports]

    def start_profile(self, profile: Profile) -> None:
        """Start a profile now."""
        self.profile = profile
        self.conditions = LinkConditions(profile, self.seed)
        self._start_ns = time.monotonic_ns()
        self._free_ns = dict.fromkeys(DIRECTIONS, 0)
        self.update_stalls()

    def update_stalls(self) -> None:
        """Apply stalls that began or ended, and schedule the next update."""
        now_ns = time.monotonic_ns()
        t_ns = now_ns - self._start_ns
        self.conditions.advance(t_ns, lambda how: self.close_connections(reset=how == "reset"))
        for direction in DIRECTIONS:
            stalled = self.is_stalled(direction, now_ns)
            if self._was_stalled.get(direction) and not stalled:
                self._free_ns[direction] = now_ns
                for lane in [lane for lane in self.pipes if lane.direction == direction]:
                    lane.reschedule(now_ns)
            self._was_stalled[direction] = stalled
        if self._change is not None:
            self._change.cancel()
        wait_ns = min(self.conditions.find_next_change_ns(t_ns) - t_ns, 3_600_000_000_000)
        self._change = self._loop.call_later(wait_ns * 1e-9 + 1e-4, self.update_stalls)

    def is_stalled(self, direction: str, now_ns: int) -> bool:
        return self.stalled_by_command or self.conditions.is_stalled(direction, now_ns - self._start_ns)

    def schedule_arrival_ns(self, direction: str, size: int, now_ns: int) -> int:
        """Return when `size` bytes sent now arrive, and reserve the link's rate for them."""
        rate = self.conditions.phase.get_direction(direction).rate_mbit
        sent_ns = max(now_ns, self._free_ns[direction])
        if rate:
            sent_ns += round(size * 8e3 / rate)
            self._free_ns[direction] = sent_ns
        return sent_ns + self.conditions.compute_delay_ns(direction, now_ns - self._start_ns)

    def close_connections(self, *, reset: bool) -> None:
        """Close every connection, in order or by RST."""
        for pair in list(self.connections):
            pair.close(reset=reset)

    def roam(self, source: str) -> None:
        """Change the clients' network: their connections end without the session being notified, and new ones come from
        address `source`."""
        self.source = source or self.source
        for pair in list(self.connections):
            self.abandoned.append(pair.abandon())
            if len(self.abandoned) > MAX_CONNECTIONS:
                self.abandoned.popleft().close()

    def collect_stats(self) -> dict[str, Any]:
        """Return counters, and by how much the proxy itself delayed deliveries [ms]."""
        own = sorted(self.own_ns)
        p50, p99 = (own[int(q * (len(own) - 1))] / 1e6 if own else 0.0 for q in (0.5, 0.99))
        lost, dropped = (sum(getattr(port, name) for port in self.ports) for name in ("lost", "dropped"))
        return {
            "link": self.address,
            "connections": len(self.connections),
            "accepted": self.accepted,
            "refused": self.refused,
            "bytes_up": self.bytes[UP],
            "bytes_down": self.bytes[DOWN],
            "held_bytes": sum(lane.size for lane in self.pipes),
            "own_delay_ms_p50": round(p50, 3),
            "own_delay_ms_p99": round(p99, 3),
            "datagrams_lost": lost,
            "datagrams_dropped": dropped,
        }

    def _accept(self, listening: socket.socket, port: int) -> None:
        with contextlib.suppress(OSError):
            near, _ = listening.accept()
            if len(self.connections) >= MAX_CONNECTIONS:
                self.refused += 1
                _close(near, reset=True)
                return
            self.accepted += 1
            self._loop.create_task(_Connection(self, near).connect(port))


class _Connection:
    """One TCP connection: the client's end (`near`), the session's (`far`), a pipe in each direction."""

    def __init__(self, link: ImpairedLink, near: socket.socket) -> None:
        self.link, self._near = link, near
        self._far = socket.socket(socket.AF_INET6 if ":" in link.target else socket.AF_INET)
        self._pipes: list[_Pipe] = []
        link.connections.add(self)
        for end in (self._near, self._far):
            end.setblocking(False)
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)

    async def connect(self, port: int) -> None:
        """Connect to the session. A port that it does not listen on is refused to the client by RST."""
        try:
            if self.link.source:
                self._far.bind((self.link.source, 0))
            await asyncio.get_running_loop().sock_connect(self._far, (self.link.target, port))
        except OSError:
            self.close(reset=True)
            return
        if self in self.link.connections:
            self._pipes = [_Pipe(self, UP, self._near, self._far), _Pipe(self, DOWN, self._far, self._near)]

    def close(self, *, reset: bool = False) -> None:
        """Close both ends at once and drop the bytes in flight."""
        self.link.connections.discard(self)
        for lane in self._pipes:
            lane.stop()
        for end in (self._near, self._far):
            _close(end, reset=reset)

    def abandon(self) -> socket.socket:
        """Close the client's end only. Returns the other, which the session still considers connected."""
        self.link.connections.discard(self)
        for lane in self._pipes:
            lane.stop()
        _close(self._near, reset=True)
        return self._far

    def on_pipe_ended(self) -> None:
        """Close the connection when both directions have ended in order."""
        if all(lane.ended for lane in self._pipes):
            self.close()


class _Pipe:
    """One direction of a connection: bytes with their arrival times, in order."""

    def __init__(self, pair: _Connection, direction: str, source: socket.socket, sink: socket.socket) -> None:
        self.direction, self.size, self.ended = direction, 0, False
        self._connection, self._link, self._source, self._sink = pair, pair.link, source, sink
        self._loop = asyncio.get_running_loop()
        self._items: deque[tuple[int, bytes]] = deque()  # empty bytes: the end
        self._last_ns = 0
        self._timer: asyncio.TimerHandle | None = None
        self._reading = self._writing = False
        self._ending = False
        self._link.pipes.add(self)
        self._resume_reading()

    def reschedule(self, now_ns: int) -> None:
        """Send the pending bytes now, at the link's rate, after a stall has ended."""
        self._last_ns = 0
        waiting, self._items = self._items, deque()
        for _, data in waiting:
            self._last_ns = max(self._last_ns, self._link.schedule_arrival_ns(self.direction, len(data), now_ns))
            self._items.append((self._last_ns, data))
        self._deliver_due()

    def stop(self) -> None:
        """Stop reading and writing both sockets."""
        self._link.pipes.discard(self)
        self._pause_reading()
        self._stop_writing()
        if self._timer is not None:
            self._timer.cancel()

    def _on_readable(self) -> None:
        room = self._link.window - self.size
        if room <= 0:  # a new profile has a smaller window
            self._pause_reading()
            return
        try:
            data = self._source.recv(min(CHUNK, room))
        except BlockingIOError:
            return
        except OSError:
            self._connection.close(reset=True)
            return
        now_ns = time.monotonic_ns()
        self._last_ns = max(self._last_ns, self._link.schedule_arrival_ns(self.direction, len(data), now_ns))
        self._items.append((self._last_ns, data))
        self.size += len(data)
        self._link.bytes[self.direction] += len(data)
        self._ending = not data
        if self._ending or self.size >= self._link.window:
            self._pause_reading()
        if len(self._items) == 1:  # otherwise a timer for the first item is running
            self._deliver_due()

    def _deliver_due(self, *, held_up: bool = False) -> None:
        """Send what has arrived and set the timer for the rest. `held_up`: the sink was full before."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        now_ns = time.monotonic_ns()
        if self._writing or self._link.is_stalled(self.direction, now_ns):
            return  # continued when the sink is writable, or by `reschedule`
        while self._items and self._items[0][0] <= now_ns:
            arrived_ns, data = self._items.popleft()
            if not data:
                self._shut_down()
                return
            if not held_up:
                self._link.own_ns.append(now_ns - arrived_ns)
            if not self._send(arrived_ns, data):
                return
        if self._items:
            self._timer = self._loop.call_at(self._items[0][0] * 1e-9, self._deliver_due)
        if not self._reading and not self._ending and self.size < self._link.window:
            self._resume_reading()

    def _send(self, arrived_ns: int, data: bytes) -> bool:
        """Send to the sink. Returns False when it took only a part: the rest follows when it is writable."""
        try:
            taken = self._sink.send(data)
        except BlockingIOError:
            taken = 0
        except OSError:
            self._connection.close(reset=True)
            return False
        self.size -= taken
        if taken == len(data):
            return True
        self._items.appendleft((arrived_ns, data[taken:]))
        self._writing = True
        self._loop.add_writer(self._sink.fileno(), self._on_writable)
        return False

    def _on_writable(self) -> None:
        self._stop_writing()
        self._deliver_due(held_up=True)

    def _shut_down(self) -> None:
        self.ended = True
        with contextlib.suppress(OSError):
            self._sink.shutdown(socket.SHUT_WR)
        self._connection.on_pipe_ended()

    def _resume_reading(self) -> None:
        self._reading = True
        self._loop.add_reader(self._source.fileno(), self._on_readable)

    def _pause_reading(self) -> None:
        if self._reading:
            self._reading = False
            self._loop.remove_reader(self._source.fileno())

    def _stop_writing(self) -> None:
        if self._writing:
            self._writing = False
            self._loop.remove_writer(self._sink.fileno())


def _close(end: socket.socket, *, reset: bool) -> None:
    with contextlib.suppress(OSError):
        if reset:
            end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        end.close()


# --- datagrams --------------------------------------------------------------------------------------------------------


class DatagramPort:
    """A forwarded UDP port. Each client gets its own socket towards the session."""

    def __init__(self, link: ImpairedLink, port: int) -> None:
        self.lost = self.duplicated = self.reordered = self.dropped = 0
        self._link, self._port = link, port
        self._loop = asyncio.get_running_loop()
        self._near = _open_socket(link.address)
        self._near.bind((link.address, port))
        self._flows: dict[Address, _Flow] = {}
        self._loop.add_reader(self._near.fileno(), self._receive_from_client)

    def _receive_from_client(self) -> None:
        with contextlib.suppress(BlockingIOError, ConnectionError):
            data, client = self._near.recvfrom(MAX_DATAGRAM)
            flow = self._flows.pop(client, None)
            if flow is None:
                if len(self._flows) >= MAX_FLOWS:
                    self._flows.pop(next(iter(self._flows))).close()  # the one that has been silent for longest
                flow = _Flow(self, self._link, self._near, client, self._port)
            self._flows[client] = flow
            flow.queue(UP, data)


class _Flow:
    """The datagrams of one client, in both directions."""

    def __init__(
        self, port: DatagramPort, link: ImpairedLink, near: socket.socket, client: Address, number: int
    ) -> None:
        self._port, self._link, self._near, self._client = port, link, near, client
        self._far = _open_socket(link.target)
        self._far.connect((link.target, number))
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._far.fileno(), self._receive_from_session)
        self._queued: list[tuple[int, int, str, bytes]] = []
        self._order = itertools.count()
        self._number = {UP: 0, DOWN: 0}
        self._timer: asyncio.TimerHandle | None = None

    def queue(self, direction: str, data: bytes) -> None:
        """Queue one datagram. Loss, order and copies depend on seed and number alone."""
        link, port = self._link, self._port
        part, weather = link.conditions.phase.get_direction(direction), link.conditions
        number = self._number[direction]
        self._number[direction] += 1
        now_ns = time.monotonic_ns()
        if link.is_stalled(direction, now_ns) or weather.draw(direction, number, 0) < part.loss:
            port.lost += 1
            return
        arrival_ns = link.schedule_arrival_ns(direction, len(data), now_ns)
        if weather.draw(direction, number, 1) < part.reorder:
            port.reordered += 1
            arrival_ns += round(part.reorder_ms * 1e6)
        copies = 1
        if weather.draw(direction, number, 2) < part.duplicate:
            port.duplicated += 1
            copies = 2
        for _ in range(copies):
            if len(self._queued) >= MAX_QUEUED:
                port.dropped += 1
                return
            heapq.heappush(self._queued, (arrival_ns, next(self._order), direction, data))
        self._deliver()

    def close(self) -> None:
        """Drop the datagrams in flight and close the socket."""
        if self._timer is not None:
            self._timer.cancel()
        self._loop.remove_reader(self._far.fileno())
        self._far.close()

    def _receive_from_session(self) -> None:
        with contextlib.suppress(BlockingIOError, ConnectionError):  # refused: the session does not listen on that port
            self.queue(DOWN, self._far.recv(MAX_DATAGRAM))

    def _deliver(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        now_ns = time.monotonic_ns()
        while self._queued and self._queued[0][0] <= now_ns:
            _, _, direction, data = heapq.heappop(self._queued)
            with contextlib.suppress(OSError):  # a datagram that the socket rejects is lost
                if direction == UP:
                    self._far.send(data)
                else:
                    self._near.sendto(data, self._client)
        if self._queued:
            self._timer = self._loop.call_at(self._queued[0][0] * 1e-9, self._deliver)


def _open_socket(address: str) -> socket.socket:
    made = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM)
    made.setblocking(False)
    return made
