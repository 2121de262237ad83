"""UDP over an impaired link: datagrams are lost, come twice, overtake each other. Part of `emulator.impairment`."""

from __future__ import annotations

import asyncio
import contextlib
import heapq
import itertools
import socket
import time
from typing import Final, Protocol

from iris_session.netsim.profiles import DOWN, UP, Weather

MAX_DATAGRAM: Final = 65_507
#: Clients of one port, and datagrams under way per client and direction; more are dropped and counted.
MAX_FLOWS: Final = 64
MAX_WAITING: Final = 512
Address = tuple[str, int]


class Radio(Protocol):
    """What a datagram needs of its link."""

    address: str
    target: str
    weather: Weather

    def stalled(self, direction: str, now_ns: int) -> bool: ...

    def arrival_ns(self, direction: str, size: int, now_ns: int) -> int: ...


class DatagramPort:
    """One forwarded UDP port. Each client gets a socket of its own towards the session."""

    def __init__(self, link: Radio, port: int) -> None:
        self.lost = self.duplicated = self.reordered = self.dropped = 0
        self._link, self._port = link, port
        self._loop = asyncio.get_running_loop()
        self._near = _socket(link.address)
        self._near.bind((link.address, port))
        self._flows: dict[Address, _Flow] = {}
        self._loop.add_reader(self._near.fileno(), self._from_client)

    def _from_client(self) -> None:
        with contextlib.suppress(BlockingIOError, ConnectionError):
            data, client = self._near.recvfrom(MAX_DATAGRAM)
            flow = self._flows.pop(client, None)
            if flow is None:
                if len(self._flows) >= MAX_FLOWS:
                    self._flows.pop(next(iter(self._flows))).close()  # the one that was silent for longest
                flow = _Flow(self, self._link, self._near, client, self._port)
            self._flows[client] = flow
            flow.take(UP, data)


class _Flow:
    """The datagrams of one client, both ways."""

    def __init__(self, port: DatagramPort, link: Radio, near: socket.socket, client: Address, number: int) -> None:
        self._port, self._link, self._near, self._client = port, link, near, client
        self._far = _socket(link.target)
        self._far.connect((link.target, number))
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._far.fileno(), self._from_session)
        self._waiting: list[tuple[int, int, str, bytes]] = []
        self._order = itertools.count()
        self._number = {UP: 0, DOWN: 0}
        self._timer: asyncio.TimerHandle | None = None

    def take(self, direction: str, data: bytes) -> None:
        """One datagram begins its way; its fate depends on seed and number alone."""
        link, port = self._link, self._port
        part, weather = link.weather.phase.direction(direction), link.weather
        number = self._number[direction]
        self._number[direction] += 1
        now_ns = time.monotonic_ns()
        if link.stalled(direction, now_ns) or weather.chance(direction, number, 0) < part.loss:
            port.lost += 1
            return
        arrival_ns = link.arrival_ns(direction, len(data), now_ns)
        if weather.chance(direction, number, 1) < part.reorder:
            port.reordered += 1
            arrival_ns += round(part.reorder_ms * 1e6)
        copies = 1
        if weather.chance(direction, number, 2) < part.duplicate:
            port.duplicated += 1
            copies = 2
        for _ in range(copies):
            if len(self._waiting) >= MAX_WAITING:
                port.dropped += 1
                return
            heapq.heappush(self._waiting, (arrival_ns, next(self._order), direction, data))
        self._deliver()

    def close(self) -> None:
        """Whatever is under way is gone."""
        if self._timer is not None:
            self._timer.cancel()
        self._loop.remove_reader(self._far.fileno())
        self._far.close()

    def _from_session(self) -> None:
        with contextlib.suppress(BlockingIOError, ConnectionError):  # refused: nobody listens there
            self.take(DOWN, self._far.recv(MAX_DATAGRAM))

    def _deliver(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        now_ns = time.monotonic_ns()
        while self._waiting and self._waiting[0][0] <= now_ns:
            _, _, direction, data = heapq.heappop(self._waiting)
            with contextlib.suppress(OSError):  # what a socket does not take is lost, as datagrams are
                if direction == UP:
                    self._far.send(data)
                else:
                    self._near.sendto(data, self._client)
        if self._waiting:
            self._timer = self._loop.call_at(self._waiting[0][0] * 1e-9, self._deliver)


def _socket(address: str) -> socket.socket:
    made = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM)
    made.setblocking(False)
    return made
