"""Addresses that a session listens on, and its public address."""

from __future__ import annotations

import pytest

from iris_session.link.config import FrontConfig, FrontError
from iris_session.link.interfaces import Interface, addresses_of, interfaces, public_host, reachable

LO = Interface("lo", "127.0.0.1", "127.255.255.255")
LO6 = Interface("lo", "::1", "")
ETH = Interface("eth0", "10.1.2.3", "10.1.2.255")
ETH6 = Interface("eth0", "fd00::3", "")
WLAN = Interface("wlan0", "192.168.0.9", "192.168.0.255")
HAVE = [LO, LO6, ETH6, ETH, WLAN]


def test_this_machine_has_loopback() -> None:
    have = interfaces()
    assert LO in have
    assert sum(one.default for one in have) <= 1
    assert not [one for one in have if one.address.startswith("fe80")]


@pytest.mark.parametrize(
    ("wanted", "addresses"),
    [
        (["eth0"], ("fd00::3", "10.1.2.3")),
        (["192.168.0.9"], ("192.168.0.9",)),
        (["wlan0", "eth0"], ("192.168.0.9", "fd00::3", "10.1.2.3")),
        (["eth0", "10.1.2.3"], ("fd00::3", "10.1.2.3")),
    ],
)
def test_interfaces_are_named_or_given_by_address(wanted: list[str], addresses: tuple[str, ...]) -> None:
    assert addresses_of(wanted, HAVE) == addresses


def test_unknown_interface_error_lists_the_interfaces() -> None:
    with pytest.raises(FrontError, match=r"'eth7'.* lo \(127\.0\.0\.1\).* wlan0 \(192\.168\.0\.9\)"):
        addresses_of(["eth7"], HAVE)


def test_public_address_is_one_that_others_can_reach() -> None:
    assert [one.address for one in reachable(["0.0.0.0"], HAVE)] == [
        "10.1.2.3", "192.168.0.9", "fd00::3", "127.0.0.1", "::1"
    ]  # fmt: skip
    assert public_host(["0.0.0.0"], HAVE) == "10.1.2.3"
    assert public_host(["localhost"], HAVE) == "127.0.0.1"
    assert public_host(["203.0.113.9"], HAVE) == "203.0.113.9"


def test_default_route_comes_first_and_container_networks_last() -> None:
    docker = Interface("docker0", "172.17.0.1", "172.17.255.255")
    wifi = Interface("wlan1", "10.0.0.4", "10.0.0.255", default=True)
    assert [one.name for one in reachable(["0.0.0.0"], [docker, LO, ETH, wifi, ETH6])] == [
        "wlan1", "eth0", "eth0", "docker0", "lo"
    ]  # fmt: skip


def test_front_is_on_loopback_when_all_its_addresses_are() -> None:
    assert FrontConfig(host="10.1.2.3", listen=("127.0.0.1", "::1")).loopback
    assert not FrontConfig(listen=("127.0.0.1", "10.1.2.3")).loopback
    assert FrontConfig(host="localhost").loopback
