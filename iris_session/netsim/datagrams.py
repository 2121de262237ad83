"""UDP over an impaired link: datagrams are lost, duplicated and reordered."""

from __future__ import annotations

import asyncio
import contextlib
import heapq
import itertools
import socket
import time
from typing import Final, Protocol

from iris_session.netsim.profiles import DOWN, UP, LinkConditions

MAX_DATAGRAM: Final = 65_507
#: Clients of one port, and datagrams in flight per client and direction; more are dropped and counted.
MAX_FLOWS: Final = 64
MAX_QUEUED: Final = 512
Address = tuple[str, int]


class DatagramLink(Protocol):
    """The part of a link that datagrams use."""

    address: str
    target: str
    conditions: LinkConditions

    def is_stalled(self, direction: str, now_ns: int) -> bool: ...

    def schedule_arrival_ns(self, direction: str, size: int, now_ns: int) -> int: ...


class DatagramPort:
    """A forwarded UDP port. Each client gets its own socket towards the session."""

    def __init__(self, link: DatagramLink, port: int) -> None:
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
        self, port: DatagramPort, link: DatagramLink, near: socket.socket, client: Address, number: int
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
