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


def wait_any(clients: Sequence[Client], timeout_s: float) -> list[Client]:
    """Waits until one of several clients has something to do, at most `timeout_s`. Polls none of them.

    Returns those to be polled: something came for them, or their own timer is due.
    """
    now = time.monotonic_ns()
    deadline = now + int(timeout_s * 1e9)
    poller = zmq.Poller()
    owners: dict[int, Client] = {}
    due: list[tuple[int, Client]] = []
    for client in clients:
        due_ns = client.connection.next_deadline_ns(now)
        due.append((due_ns, client))
        deadline = min(deadline, due_ns)
        first = len(poller.sockets)
        client.register(poller)
        for sock, _ in poller.sockets[first:]:
            owners[id(sock)] = client
    ready = {id(owners[id(sock)]) for sock, _ in poller.poll(milliseconds(deadline - now))}
    now = time.monotonic_ns()
    return [client for due_ns, client in due if due_ns <= now or id(client) in ready]


def poll_all(clients: Sequence[Client], timeout_s: float = 0.0) -> None:
    """Polls several clients that have no thread, after `wait_any`."""
    for client in wait_any(clients, timeout_s):
        client.poll(0.0)
