"""Waiting for several clients: only those with something to do are returned, and state comes first."""

from __future__ import annotations

import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import zmq

from iris_session.client import ClientGroup, poll_all, wait_any
from iris_session.client.core.status import ConnectionPhase


class OneClient:
    """The parts of a client that a group uses, on two sockets: what was polled is in `log`."""

    def __init__(self, context: zmq.Context[Any], name: str, log: list[str]) -> None:
        self.name, self._log = name, log
        self.due_ns = time.monotonic_ns() + 60_000_000_000
        self.connection = SimpleNamespace(phase=ConnectionPhase.READY, next_deadline_ns=lambda _: self.due_ns)
        self._loop = self
        self.ends = {}
        self.state, self.control = (self._open(context, kind) for kind in ("state", "control"))

    def _open(self, context: zmq.Context[Any], kind: str) -> Any:
        near, far = context.socket(zmq.PAIR), context.socket(zmq.PAIR)
        near.bind(f"inproc://{kind}-{self.name}")
        far.connect(f"inproc://{kind}-{self.name}")
        self.ends[kind] = far
        return near

    def register(self, poller: zmq.Poller) -> Any:
        if self.connection.phase is ConnectionPhase.CLOSED:
            return None
        poller.register(self.control, zmq.POLLIN)
        poller.register(self.state, zmq.POLLIN)
        return self.state

    @property
    def has_state(self) -> bool:
        return self.connection.phase is not ConnectionPhase.CLOSED and bool(self.state.poll(0))

    def poll_state(self) -> None:
        self.state.recv()
        self._log.append(f"state of {self.name}")

    def poll(self, timeout_s: float) -> None:
        self._log.append(f"rest of {self.name}")


@pytest.fixture
def log() -> list[str]:
    return []


@pytest.fixture
def clients(log: list[str]) -> Iterator[list[Any]]:
    context: zmq.Context[Any] = zmq.Context()
    yield [OneClient(context, name, log) for name in ("ann", "bob", "carl")]
    context.destroy(linger=0)


def test_only_clients_with_something_to_do_are_returned(clients: list[Any], log: list[str]) -> None:
    ann, bob, _ = clients
    assert wait_any(clients, 0.0) == []
    ann.ends["control"].send(b"")
    assert wait_any(clients, 30.0) == [ann]
    bob.due_ns = 0
    assert wait_any(clients, 30.0) == [ann, bob], "its own timer is due"
    poll_all(clients, 30.0)
    assert sorted(log) == ["rest of ann", "rest of bob"]


def test_state_of_all_comes_before_the_rest(clients: list[Any], log: list[str]) -> None:
    ann, bob, carl = clients
    group = ClientGroup(clients)
    for client in (ann, carl):
        client.ends["state"].send(b"")
    bob.ends["control"].send(b"")
    group.poll(30.0)
    assert log == ["state of ann", "state of carl", "rest of bob"]


def test_closed_clients_are_skipped(clients: list[Any], log: list[str]) -> None:
    ann, closed, _ = clients
    group = ClientGroup(clients)
    group.poll(0.0)
    closed.connection.phase, closed.due_ns = ConnectionPhase.CLOSED, 0
    closed.ends["state"].send(b"")
    ann.ends["state"].send(b"")
    group.poll(30.0)
    assert log == ["state of ann"]
