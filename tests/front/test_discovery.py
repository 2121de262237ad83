"""Beacons and introductions: where they go, how often, and what happens when a network or a peer misbehaves."""

from __future__ import annotations

import select
import socket
import threading
from collections.abc import Iterator

import pytest

from iris_session.front.discovery import (
    ANSWERS_PER_TICK,
    BEACON_PERIOD_NS,
    INTERFACES_PERIOD_NS,
    BeaconSender,
    IntroductionServer,
    open_introduction_listeners,
    open_with_introduction,
)
from iris_session.link.config import FrontError, PortInUseError
from iris_session.link.interfaces import Interface
from iris_session.protocol.codec import decode_beacon, decode_introduction
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.limits import Drops
from tests.loopback import make_loopback_address

BEACON = Beacon(1, "s1", "lab-1", "live", "", 7721, 7722, 0, 0, 0, "mark")
LO = Interface("lo", "127.0.0.1", "127.255.255.255")
ETH = Interface("eth0", "10.1.2.3", "10.1.2.255")
WLAN = Interface("wlan0", "192.168.0.9", "192.168.0.255")
TUNNEL = Interface("tun0", "10.9.9.9", "")


class Wire:
    """Takes the place of the socket: what was sent, as (broadcast address, beacon)."""

    def __init__(self, sender: BeaconSender) -> None:
        self.sent: list[tuple[str, Beacon]] = []
        self.fails: dict[str, OSError] = {}
        sender._socket.close()
        sender._socket = self  # type: ignore[assignment]

    def sendto(self, data: bytes, where: tuple[str, int]) -> None:
        if where[0] in self.fails:
            raise self.fails[where[0]]
        self.sent.append((where[0], decode_beacon(data)))

    def close(self) -> None:
        pass

    def hosts(self) -> dict[str, str]:
        return {where: beacon.host for where, beacon in self.sent}


def sender(hosts: list[str], *have: Interface, advertise: str = "") -> tuple[BeaconSender, Wire, Drops]:
    drops = Drops()
    made = BeaconSender(BEACON, hosts, 7720, drops, advertise, lambda: list(have))
    return made, Wire(made), drops


def test_beacons_carry_the_address_of_each_network() -> None:
    beacon, wire, _ = sender(["0.0.0.0"], LO, ETH, WLAN, TUNNEL)
    beacon.tick(1)
    assert wire.hosts() == {
        "127.255.255.255": "10.1.2.3",
        "10.1.2.255": "10.1.2.3",
        "192.168.0.255": "192.168.0.9",
    }
    assert {msg.session_id for _, msg in wire.sent} == {"s1"}


def test_beacons_five_times_a_second_also_on_new_networks() -> None:
    have = [LO, ETH]
    beacon = BeaconSender(BEACON, ["0.0.0.0"], 7720, Drops(), "", lambda: list(have))
    wire = Wire(beacon)
    for now_ns in range(0, 10 * BEACON_PERIOD_NS, BEACON_PERIOD_NS // 20):
        beacon.tick(now_ns)
    assert len(wire.sent) == 2 * 10
    have.append(WLAN)
    beacon.tick(INTERFACES_PERIOD_NS + BEACON_PERIOD_NS)
    assert "192.168.0.255" in wire.hosts()


def test_failing_network_is_logged_once_and_others_get_beacons(caplog: pytest.LogCaptureFixture) -> None:
    beacon, wire, drops = sender(["0.0.0.0"], LO, ETH, WLAN)
    wire.fails["10.1.2.255"] = OSError(101, "Network is unreachable")
    for turn in range(1, 6):
        beacon.tick(turn * BEACON_PERIOD_NS)
    assert drops.by_reason == {"beacon_unsent": 1}
    assert caplog.text.count("10.1.2.255") == 1
    assert beacon.problems == {"10.1.2.255": "Network is unreachable"}
    assert [where for where, _ in wire.sent].count("192.168.0.255") == 5
    del wire.fails["10.1.2.255"]
    beacon.tick(6 * BEACON_PERIOD_NS)
    assert not beacon.problems
    wire.fails["10.1.2.255"] = BlockingIOError(11, "full")
    beacon.tick(7 * BEACON_PERIOD_NS)
    assert drops.by_reason == {"beacon_unsent": 1}


# --- introduction ----------------------------------------------------------------------------------------------------

INTRODUCED = Beacon(1, "s1", "lab-1", "live", "10.1.2.3", 7721, 7722, 0, 0, 0, "mark")


@pytest.fixture
def introducer() -> Iterator[tuple[IntroductionServer, int]]:
    listeners = open_introduction_listeners(["127.0.0.1"], 0)
    made = IntroductionServer(listeners, lambda: Introduction(INTRODUCED, "k" * 40, True, 3))
    yield made, listeners[0].getsockname()[1]
    made.close()


def read(visitor: socket.socket) -> bytes:
    visitor.settimeout(30.0)
    data = b""
    while more := visitor.recv(4096):
        data += more
    return data


def test_introduction_is_sent_at_once_and_the_connection_closed(introducer: tuple[IntroductionServer, int]) -> None:
    service, port = introducer
    with socket.create_connection(("127.0.0.1", port)) as visitor:
        service.tick(0)
        data = read(visitor)
    introduction = decode_introduction(data)
    assert introduction == Introduction(INTRODUCED, "k" * 40, True, 3)
    for length in range(len(data)):
        assert decode_introduction(data[:length]) is None


def test_introductions_per_tick_are_bounded_and_peers_hold_nothing(
    introducer: tuple[IntroductionServer, int],
) -> None:
    service, port = introducer
    visitors = [socket.create_connection(("127.0.0.1", port)) for _ in range(3 * ANSWERS_PER_TICK)]
    visitors[0].close()
    visitors[1].sendall(b"GET / HTTP/1.1\r\n" * 100)
    before = threading.active_count()
    service.tick(0)
    assert len(select.select(visitors[2:], [], [], 1.0)[0]) == ANSWERS_PER_TICK - 2
    service.tick(1)
    service.tick(2)
    assert all(decode_introduction(read(v)) is not None for v in visitors[2:])
    assert threading.active_count() == before
    for visitor in visitors:
        visitor.close()


def test_two_adjacent_free_ports_are_found() -> None:
    taken: list[int] = []

    def open_control(port: int) -> int:
        taken.append(port)
        if len(taken) < 4:
            raise PortInUseError(port, "control")
        return port

    control, listeners = open_with_introduction(["127.0.0.1"], 0, open_control)
    assert control == taken[3] == listeners[0].getsockname()[1] + 1
    for listener in listeners:
        listener.close()


def test_port_in_use_is_an_error_that_closes_opened_sockets() -> None:
    host = make_loopback_address()  # no other test takes the port meanwhile
    with socket.create_server((host, 0)) as occupied:
        port = occupied.getsockname()[1]
        with pytest.raises(PortInUseError, match=rf"port {port} \(introduction\)"):
            open_with_introduction([host], port + 1, lambda _: 0)
    with pytest.raises(PortInUseError):
        open_with_introduction([host], port + 1, _in_use)
    for listener in open_introduction_listeners([host], port):  # it was closed again
        listener.close()
    with pytest.raises(FrontError, match=r"203\.0\.113\.9"):
        open_introduction_listeners(["203.0.113.9"], 0)


def _in_use(port: int) -> int:
    raise PortInUseError(port, "control")
