"""Waiting for several clients: those with something to do are named, and only those."""

from __future__ import annotations

import time
from collections.abc import Callable

from iris_session.client import Client, ClientGroup, poll_all, wait_any
from tests.client.harness import LiveSession

Join = Callable[..., Client]


def test_only_those_with_something_to_do_are_named(session: LiveSession, join: Join) -> None:
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


def test_a_group_passes_over_those_that_were_closed(session: LiveSession, join: Join) -> None:
    ann, gone = join(), join("gone")
    group = ClientGroup([gone, ann])
    group.poll(0.1)
    gone.close()
    deadline = time.monotonic() + 30.0
    before = ann.counters()["state"]["delivered"]
    while ann.counters()["state"]["delivered"] < before + 3:
        assert time.monotonic() < deadline
        group.poll(0.1)
