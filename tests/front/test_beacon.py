"""The beacon: where it goes, how often, and what happens when a network does not take it."""

from __future__ import annotations

import contextlib
import socket

import pytest

from iris_session.front.beacon import BEACON_PERIOD_NS, INTERFACES_PERIOD_NS, BeaconSender
from iris_session.link.interfaces import Interface
from iris_session.protocol.codec import decode_beacon
from iris_session.protocol.discovery import Beacon
from iris_session.protocol.limits import Drops

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


def test_every_network_hears_its_own_address_and_this_machine_that_of_the_first() -> None:
    beacon, wire, _ = sender(["0.0.0.0"], LO, ETH, WLAN, TUNNEL)
    beacon.tick(1)
    assert wire.hosts() == {
        "127.255.255.255": "10.1.2.3",
        "10.1.2.255": "10.1.2.3",
        "192.168.0.255": "192.168.0.9",
    }
    assert {msg.session_id for _, msg in wire.sent} == {"s1"}


def test_only_the_chosen_interface_and_only_loopback_for_loopback() -> None:
    beacon, wire, _ = sender(["192.168.0.9"], LO, ETH, WLAN)
    beacon.tick(1)
    assert wire.hosts() == {"127.255.255.255": "192.168.0.9", "192.168.0.255": "192.168.0.9"}
    beacon, wire, _ = sender(["127.0.0.1"], LO, ETH, WLAN)
    beacon.tick(1)
    assert wire.hosts() == {"127.255.255.255": "127.0.0.1"}


def test_an_advertised_address_is_told_to_others() -> None:
    beacon, wire, _ = sender(["0.0.0.0"], LO, ETH, advertise="lab.example.org")
    beacon.tick(1)
    assert wire.hosts() == {"127.255.255.255": "10.1.2.3", "10.1.2.255": "lab.example.org"}


def test_five_times_a_second_and_networks_that_come_later() -> None:
    have = [LO, ETH]
    beacon = BeaconSender(BEACON, ["0.0.0.0"], 7720, Drops(), "", lambda: list(have))
    wire = Wire(beacon)
    for now_ns in range(0, 10 * BEACON_PERIOD_NS, BEACON_PERIOD_NS // 20):
        beacon.tick(now_ns)
    assert len(wire.sent) == 2 * 10
    have.append(WLAN)
    beacon.tick(INTERFACES_PERIOD_NS + BEACON_PERIOD_NS)
    assert "192.168.0.255" in wire.hosts()


def test_a_network_that_fails_is_told_once_and_harms_no_other(capsys: pytest.CaptureFixture[str]) -> None:
    beacon, wire, drops = sender(["0.0.0.0"], LO, ETH, WLAN)
    wire.fails["10.1.2.255"] = OSError(101, "Network is unreachable")
    for turn in range(1, 6):
        beacon.tick(turn * BEACON_PERIOD_NS)
    assert drops.by_reason == {"beacon_unsent": 1}
    assert capsys.readouterr().err.count("no beacons to 10.1.2.255 (Network is unreachable)") == 1
    assert beacon.problems == {"10.1.2.255": "Network is unreachable"}
    assert [where for where, _ in wire.sent].count("192.168.0.255") == 5
    del wire.fails["10.1.2.255"]
    beacon.tick(6 * BEACON_PERIOD_NS)
    assert not beacon.problems
    wire.fails["10.1.2.255"] = BlockingIOError(11, "full")
    beacon.tick(7 * BEACON_PERIOD_NS)
    assert drops.by_reason == {"beacon_unsent": 1}


def test_every_listener_on_this_machine_hears_it() -> None:
    listeners = []
    for _ in range(2):
        listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.settimeout(5.0)
        listeners.append(listener)
    with contextlib.closing(listeners[0]), contextlib.closing(listeners[1]):
        listeners[0].bind(("", 0))
        listeners[1].bind(("", listeners[0].getsockname()[1]))
        real = BeaconSender(BEACON, ["127.0.0.1"], listeners[0].getsockname()[1], Drops())
        real.tick(1)
        real.close()
        assert [decode_beacon(one.recv(2000)).session_name for one in listeners] == ["lab-1", "lab-1"]
