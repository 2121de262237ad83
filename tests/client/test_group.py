"""Waiting for several clients: only those with events are returned."""

from __future__ import annotations

import time
from collections.abc import Callable

from iris_session.client import Client, ClientGroup, poll_all, wait_any
from tests.client.harness import LiveSession

Join = Callable[..., Client]


def test_only_clients_with_events_are_returned(session: LiveSession, join: Join) -> None:
    ann, idle = join(), Client(session.address)
    deadline = time.monotonic() + 30.0
    seen: list[Client] = []
    while ann not in seen:
        assert time.monotonic() < deadline
        seen += wait_any([ann, idle], 0.5)
    assert idle not in seen
    idle.close()
    assert idle not in wait_any([idle], 0.0)


def test_polling_all_keeps_all_alive(session: LiveSession, join: Join) -> None:
    clients = [join(f"c{i}") for i in range(3)]
    deadline = time.monotonic() + 30.0
    while min(client.counters()["state"]["delivered"] for client in clients) < 100:
        assert time.monotonic() < deadline
        poll_all(clients, 0.1)
    assert all(client.ready for client in clients)
    assert all(client.counters()["control"]["reconnects"] == 0 for client in clients)


def test_group_skips_closed_clients(session: LiveSession, join: Join) -> None:
    ann, closed = join(), join("gone")
    group = ClientGroup([closed, ann])
    group.poll(0.1)
    closed.close()
    deadline = time.monotonic() + 30.0
    before = ann.counters()["state"]["delivered"]
    while ann.counters()["state"]["delivered"] < before + 3:
        assert time.monotonic() < deadline
        group.poll(0.1)
