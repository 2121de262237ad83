"""Waiting for several clients in one loop, without threads."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import zmq

if TYPE_CHECKING:
    from iris_session.client.client import Client


def milliseconds(nanoseconds: int) -> int:
    """Rounded up: rounded down, the last millisecond of a wait would be a busy loop."""
    return max(0, -(-nanoseconds // 1_000_000))


class ClientGroup:
    """Several clients that one loop polls. Keeps its poller from wait to wait: making one anew costs more than waiting.

    group = ClientGroup(clients)
    while running:
        for client in group.wait(0.1):
            client.poll(0.0)
    """

    def __init__(self, clients: Sequence[Client]) -> None:
        self.clients = tuple(clients)
        self._poller = zmq.Poller()
        self._owners: dict[int, Client] = {}
        self._registered: list[tuple[int, bool]] = []

    def wait(self, timeout_s: float) -> list[Client]:
        """Waits until one of them has something to do, at most `timeout_s`. Polls none of them.

        Returns those to be polled: something came for them, or their own timer is due.
        """
        now = time.monotonic_ns()
        due = [client.connection.next_deadline_ns(now) for client in self.clients]
        deadline = min(now + int(timeout_s * 1e9), *due)
        registered = [client.registration for client in self.clients]
        if registered != self._registered:
            self._register(registered)
        ready = {id(self._owners[id(sock)]) for sock, _ in self._poller.poll(milliseconds(deadline - now))}
        now = time.monotonic_ns()
        return [c for c, due_ns in zip(self.clients, due, strict=True) if due_ns <= now or id(c) in ready]

    def _register(self, registered: list[tuple[int, bool]]) -> None:
        self._registered = registered
        self._poller = zmq.Poller()
        self._owners = {}
        for client in self.clients:
            first = len(self._poller.sockets)
            client.register(self._poller)
            for sock, _ in self._poller.sockets[first:]:
                self._owners[id(sock)] = client


def wait_any(clients: Sequence[Client], timeout_s: float) -> list[Client]:
    """One `ClientGroup.wait` for these clients."""
    return ClientGroup(clients).wait(timeout_s)


def poll_all(clients: Sequence[Client], timeout_s: float = 0.0) -> None:
    """Polls several clients that have no thread, after `wait_any`."""
    for client in wait_any(clients, timeout_s):
        client.poll(0.0)
