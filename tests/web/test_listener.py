"""Limits of TCP connections: strangers, eviction, idle connections."""

from __future__ import annotations

import socket

import pytest

from iris_session.protocol.limits import Drops
from iris_session.web import listener
from iris_session.web.listener import Connection, ConnectionLimiter, open_listening_sockets


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
    trusted.trusted = True
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
    for one in people:
        one.trusted = True
    for _ in range(1000):
        connect(limiter, "10.0.0.1")
    late = connect(limiter, "10.0.0.1")
    left = limiter.list_all()
    assert set(people) <= set(left)
    assert late in left, "and a new one is accepted"
    assert len(left) <= len(people) + listener.MAX_STRANGERS_PER_ADDRESS


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
