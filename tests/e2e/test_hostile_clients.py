"""Connections over real sockets that send nothing, or half of a greeting. Floods are in `tests/rig`."""

from __future__ import annotations

import os
import socket

import pytest

from tests.e2e.scenario import Scenario

pytestmark = pytest.mark.e2e

GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)


def is_closed(peer: socket.socket) -> bool:
    peer.setblocking(False)
    try:
        while peer.recv(65536):
            pass
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


def test_silent_and_half_open_connections_are_closed_and_disturb_no_client(scenario: Scenario) -> None:
    """A thousand say nothing; on every port some send half of a greeting, garbage, or a byte now and then."""
    hand = scenario.drive("ann", "left", (0.0, 0.005, 0.0))
    welcome = hand.client.connection.welcome
    assert welcome is not None
    host, _, port = scenario.server.address.rpartition(":")
    ports = (int(port), welcome.endpoints.state, int(port) - 1)
    silent = [socket.create_connection((host, int(port))) for _ in range(1000)]
    slow = [socket.create_connection((host, one)) for one in ports]
    others = []
    for data in (GREETING[:32], GREETING + os.urandom(200), b"GET / HTTP/1.1\r\n\r\n", os.urandom(4096)):
        for one in ports:
            others.append(socket.create_connection((host, one)))
            others[-1].sendall(data)
    scenario.join("late", "observer")
    waiting, at = [*silent, *others, *slow], 0

    def are_closed() -> bool:
        nonlocal at
        waiting[:] = [one for one in waiting if not is_closed(one)]
        for one in {*slow} & {*waiting} if at < len(GREETING) else ():
            try:
                one.send(GREETING[at : at + 1])
            except OSError:
                waiting.remove(one)
        at += 1
        scenario.run_for(0.5)
        return not waiting

    scenario.run_until(are_closed, "all of them are closed", 120.0)
    scenario.engage(hand)
    for one in (*silent, *others, *slow):
        one.close()
    scenario.server.finish()
