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


def wait_any(clients: Sequence[Client], timeout_s: float) -> None:
    """Waits until one of several clients has something to do, at most `timeout_s`. Polls none of them."""
    now = time.monotonic_ns()
    deadline = now + int(timeout_s * 1e9)
    poller = zmq.Poller()
    for client in clients:
        deadline = min(deadline, client.connection.next_deadline_ns(now))
        client.register(poller)
    poller.poll(milliseconds(deadline - now))


def poll_all(clients: Sequence[Client], timeout_s: float = 0.0) -> None:
    """Polls several clients that have no thread, after `wait_any`."""
    wait_any(clients, timeout_s)
    for client in clients:
        client.poll(0.0)
