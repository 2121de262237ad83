"""Limits of TCP connections: strangers, eviction, idle connections."""

from __future__ import annotations

import asyncio
import socket

import pytest

from iris_session.protocol.limits import Drops
from iris_session.web import listener
from iris_session.web.listener import Connection, ConnectionLimiter, Listener, open_listening_sockets


def connect(limiter: ConnectionLimiter, address: str, now: float = 0.0) -> Connection:
    def close() -> None:
        limiter.remove(connection)

    connection = Connection(address, now, close)
    for evicted in limiter.add(connection):
        evicted.close()
    return connection


def test_one_address_evicts_its_own_oldest() -> None:
    drops = Drops()
    limiter = ConnectionLimiter(drops)
    other = connect(limiter, "10.0.0.2")
    trusted = connect(limiter, "10.0.0.1")
    limiter.trust(trusted, "web-1")
    flood = [connect(limiter, "10.0.0.1") for _ in range(listener.MAX_STRANGERS_PER_ADDRESS + 3)]
    left = limiter.list_all()
    assert other in left
    assert trusted in left
    assert [one for one in flood if one not in left] == flood[:3]
    assert drops.by_reason == {"web_connections_per_address": 3}


def test_many_addresses_evict_those_with_the_most() -> None:
    limiter = ConnectionLimiter(Drops())
    lone = connect(limiter, "10.0.0.9")
    for n in range(6):
        for _ in range(60):
            connect(limiter, f"10.0.0.{n}")
    assert len(limiter) == listener.MAX_STRANGERS
    assert lone in limiter.list_all()


def test_a_thousand_sockets_leave_those_that_were_let_in() -> None:
    limiter = ConnectionLimiter(Drops())
    people = [connect(limiter, "10.0.0.1") for _ in range(64)]
    for n, one in enumerate(people):
        limiter.trust(one, f"web-{n}")
    for _ in range(1000):
        connect(limiter, "10.0.0.1")
    late = connect(limiter, "10.0.0.1")
    left = limiter.list_all()
    assert set(people) <= set(left)
    assert late in left, "and a new one is accepted"
    assert len(left) <= len(people) + listener.MAX_STRANGERS_PER_ADDRESS


def test_addresses_of_one_network_count_as_one() -> None:
    drops = Drops()
    limiter = ConnectionLimiter(drops)
    flood = [connect(limiter, f"2001:db8::{n:x}") for n in range(listener.MAX_STRANGERS_PER_ADDRESS + 3)]
    assert [one for one in flood if one not in limiter.list_all()] == flood[:3]
    assert drops.by_reason == {"web_connections_per_address": 3}

    async def use_up_rates() -> None:
        serving = Listener(asyncio.Protocol, None, drops)
        for take, burst in (
            (serving.allow_handshake, listener.HANDSHAKE_BURST),
            (lambda address: serving.allow_request(Connection(address, 0.0, list)), listener.REQUEST_BURST),
        ):
            refused = [not take(f"2001:db8::{n:x}") for n in range(2 * burst)]
            assert sum(refused) > burst // 2
            assert take("2001:db8:0:1::1")

    asyncio.run(use_up_rates())


def test_one_browser_does_not_keep_all_connections() -> None:
    drops = Drops()
    limiter = ConnectionLimiter(drops)
    hoard = []
    for _ in range(listener.MAX_CONNECTIONS):
        one = connect(limiter, "10.0.0.1")
        limiter.trust(one, "web-1")
        hoard.append(one)
    assert sum(bool(one.browser) for one in limiter.list_all()) == listener.MAX_TRUSTED_PER_BROWSER
    assert len(limiter) == listener.MAX_TRUSTED_PER_BROWSER + listener.MAX_STRANGERS_PER_ADDRESS
    assert hoard[0] in limiter.list_all()


def test_idle_connections_of_browsers_make_room_in_a_full_table() -> None:
    drops = Drops()
    limiter = ConnectionLimiter(drops)
    busy, honest = connect(limiter, "10.0.0.1"), connect(limiter, "10.0.0.2")
    limiter.trust(busy, "web-0")
    limiter.trust(honest, "web-honest")
    busy.requests = 1
    hoard = []
    while len(limiter) < listener.MAX_CONNECTIONS:
        hoard.append(connect(limiter, "10.0.0.3"))
        limiter.trust(hoard[-1], f"web-{len(hoard) // 10}")
    late = [connect(limiter, f"10.0.1.{n}") for n in range(20)]
    left = limiter.list_all()
    assert {busy, honest, *late} <= set(left)
    assert len(left) == listener.MAX_CONNECTIONS
    assert drops.by_reason == {"web_connections": 20}


def test_connections_without_a_request_are_idle() -> None:
    drops = Drops()
    limiter = ConnectionLimiter(drops)
    slow, busy, fresh = connect(limiter, "a"), connect(limiter, "a"), connect(limiter, "a", now=listener.IDLE_S)
    busy.requests = 1
    assert limiter.select_idle(listener.IDLE_S + 0.1) == [slow]
    assert fresh in limiter.list_all()
    assert drops.by_reason == {"web_idle": 1}


def test_listening_sockets_share_one_free_port() -> None:
    sockets = open_listening_sockets(["127.0.0.1", "localhost", "127.0.0.2"], 0)
    try:
        assert {one.getsockname()[1] for one in sockets} == {sockets[0].getsockname()[1]}
        with pytest.raises(OSError, match="in use"):
            open_listening_sockets(["127.0.0.3", "127.0.0.2"], sockets[0].getsockname()[1])
        socket.create_connection(sockets[-1].getsockname()).close()
    finally:
        for one in sockets:
            one.close()
