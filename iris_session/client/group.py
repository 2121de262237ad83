"""Groups of clients in one loop, without threads."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

import zmq

from iris_session.client.client import Client
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.sockets import to_milliseconds

#: Passes over the state sockets of all clients before anything else, when state came for any.
_ROUNDS: Final = 3


class ClientGroup:
    """Several clients polled by one loop; closed ones are skipped.

        group = ClientGroup(clients)
        while running:
            group.poll(0.1)

    Args:
        clients: Clients without a thread of their own.
    """

    def __init__(self, clients: Sequence[Client]) -> None:
        self.clients = tuple(clients)

    def wait(self, timeout_s: float) -> list[Client]:
        """Wait until a client has something to do, without polling any.

        Args:
            timeout_s: Seconds to wait at most.

        Returns:
            Clients to be polled: something came for them, or their own timer is due.
        """
        state, rest = self._wait(timeout_s)
        return [c for c in self.clients if c in state or c in rest]

    def poll(self, timeout_s: float) -> None:
        """Wait like `wait`, then poll: first the state of all clients that have some, then the rest of the work.

        So no client's state waits for the other work of others.

        Args:
            timeout_s: Seconds to wait at most.
        """
        state, rest = self._wait(timeout_s)
        for _ in range(_ROUNDS):
            for client in state:
                client._loop.poll_state()
            # State comes to all within a millisecond: asking each socket costs a tenth of waiting anew.
            state = [client for client in self.clients if client._loop.has_state] if state else []
        for client in rest:
            client.poll(0.0)

    def _wait(self, timeout_s: float) -> tuple[list[Client], list[Client]]:
        """Return the clients for which state came, and those for which anything else came or a timer is due."""
        now = time.monotonic_ns()
        deadline = now + int(timeout_s * 1e9)
        poller = zmq.Poller()
        owners: dict[int, tuple[Client, bool]] = {}  # by socket; whether only state comes by it
        due: list[tuple[Client, int]] = []
        for client in self.clients:
            if client.connection.phase is ConnectionPhase.CLOSED:
                continue
            due.append((client, client.connection.next_deadline_ns(now)))
            first = len(poller.sockets)
            state = client._loop.register(poller)
            owners |= {_poller_key(sock): (client, sock is state) for sock, _ in poller.sockets[first:]}
        deadline = min((deadline, *(due_ns for _, due_ns in due)))
        woken = [owners[_poller_key(sock)] for sock, _ in poller.poll(to_milliseconds(deadline - now))]
        now = time.monotonic_ns()
        rest = [client for client, due_ns in due if due_ns <= now]
        rest += [client for client, only_state in woken if not only_state and client not in rest]
        return [client for client, only_state in woken if only_state], rest


def _poller_key(sock: zmq.Socket[bytes] | int) -> int:
    """Return the key of a socket in a poller: its id for one of ZeroMQ, its descriptor for any other."""
    return sock if isinstance(sock, int) else id(sock)


def wait_any(clients: Sequence[Client], timeout_s: float) -> list[Client]:
    """Wait once for any of several clients, as `ClientGroup.wait`.

    Args:
        clients: The clients.
        timeout_s: Seconds to wait at most.

    Returns:
        Clients to be polled.
    """
    return ClientGroup(clients).wait(timeout_s)


def poll_all(clients: Sequence[Client], timeout_s: float = 0.0) -> None:
    """Wait once for any of several clients that have no thread, and poll those that have something to do.

    Args:
        clients: The clients.
        timeout_s: Seconds to wait at most.
    """
    for client in wait_any(clients, timeout_s):
        client.poll(0.0)
