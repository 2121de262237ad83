"""Waiting for several clients in one loop, without threads."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import zmq

from iris_session.client.core.status import ConnectionPhase

if TYPE_CHECKING:
    from iris_session.client.client import Client


def to_milliseconds(nanoseconds: int) -> int:
    """Rounded up: rounded down, the last millisecond of a wait would be a busy loop."""
    return max(0, -(-nanoseconds // 1_000_000))


#: Looks at the state sockets of all before the rest is seen to, when state came for any.
_ROUNDS: Final = 3


class ClientGroup:
    """Several clients that one loop polls; those that were closed are passed over.

    Keeps its poller from wait to wait: making one anew costs more than waiting.

    group = ClientGroup(clients)
    while running:
        group.poll(0.1)
    """

    def __init__(self, clients: Sequence[Client]) -> None:
        self.clients = tuple(clients)
        self._poller = zmq.Poller()
        self._owners: dict[int, tuple[Client, bool]] = {}  # by socket; whether only state comes by it
        self._registered: list[tuple[int, bool]] = []

    def wait(self, timeout_s: float) -> list[Client]:
        """Waits until one of them has something to do, at most `timeout_s`. Polls none of them.

        Returns those to be polled: something came for them, or their own timer is due.
        """
        state, rest = self._wait(timeout_s)
        return [c for c in self.clients if c in state or c in rest]

    def poll(self, timeout_s: float) -> None:
        """Waits like `wait`, then polls: first the state of all for whom state came, then the rest of those who have
        anything else to do. So nobody's picture waits for the chores of others."""
        state, rest = self._wait(timeout_s)
        for _ in range(_ROUNDS):
            for client in state:
                client.poll_state()
            # Pictures come to all within a millisecond: asking each socket costs a tenth of waiting anew.
            state = [client for client in self.clients if client.state_waits] if state else []
        for client in rest:
            client.poll(0.0)

    def _wait(self, timeout_s: float) -> tuple[list[Client], list[Client]]:
        """Clients for whom state came, and those for whom anything else came or whose timer is due."""
        now = time.monotonic_ns()
        clients = [client for client in self.clients if client.connection.phase is not ConnectionPhase.CLOSED]
        due = [client.connection.next_deadline_ns(now) for client in clients]
        deadline = min((now + int(timeout_s * 1e9), *due))
        registered = [client.registration for client in self.clients]
        if registered != self._registered:
            self._register(registered)
        woken = [self._owners[_poller_key(sock)] for sock, _ in self._poller.poll(to_milliseconds(deadline - now))]
        now = time.monotonic_ns()
        rest = [c for c, due_ns in zip(clients, due, strict=True) if due_ns <= now]
        rest += [c for c, only_state in woken if not only_state and c not in rest]
        return [c for c, only_state in woken if only_state], rest

    def _register(self, registered: list[tuple[int, bool]]) -> None:
        self._registered = registered
        self._poller = zmq.Poller()
        self._owners = {}
        for client in self.clients:
            first = len(self._poller.sockets)
            state = client.register(self._poller)
            for sock, _ in self._poller.sockets[first:]:
                self._owners[_poller_key(sock)] = client, sock is state


def _poller_key(sock: zmq.Socket[bytes] | int) -> int:
    """What a poller calls a socket: itself one of ZeroMQ, by its descriptor any other."""
    return sock if isinstance(sock, int) else id(sock)


def wait_any(clients: Sequence[Client], timeout_s: float) -> list[Client]:
    """One `ClientGroup.wait` for these clients."""
    return ClientGroup(clients).wait(timeout_s)


def poll_all(clients: Sequence[Client], timeout_s: float = 0.0) -> None:
    """Polls several clients that have no thread, after `wait_any`."""
    for client in wait_any(clients, timeout_s):
        client.poll(0.0)
