"""The networks of this machine: which addresses to listen on, where beacons go, what to call ourselves."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Sequence
from typing import Final, NamedTuple

import psutil

from iris_session.link.config import FrontError

#: Networks inside this machine (containers, virtual machines): others do not reach us by them.
VIRTUAL: Final = ("br-", "cni", "docker", "lxc", "podman", "veth", "virbr", "vmnet")
#: For a look at the routing table; nothing is sent. TEST-NET-3: nobody has it.
_ELSEWHERE: Final = ("203.0.113.1", 9)
WILDCARDS: Final = ("0.0.0.0", "::")
LOOPBACK_BROADCAST: Final = "127.255.255.255"


class Interface(NamedTuple):
    """One address of one network interface that is up. `broadcast`: empty where there is none (IPv6, /32).

    `default`: the way to other networks begins here.
    """

    name: str
    address: str
    broadcast: str
    default: bool = False

    @property
    def loopback(self) -> bool:
        return ipaddress.ip_address(self.address).is_loopback


def interfaces() -> list[Interface]:
    """Every IPv4 and IPv6 address of the interfaces that are up, but link-local IPv6: those need a scope to be used."""
    up, source = psutil.net_if_stats(), _source()
    found = []
    for name, addresses in sorted(psutil.net_if_addrs().items()):
        if name in up and not up[name].isup:
            continue
        for item in addresses:
            if item.family == socket.AF_INET:
                found.append(
                    Interface(name, item.address, _broadcast(item.address, item.netmask), item.address == source)
                )
            elif item.family == socket.AF_INET6 and not item.address.lower().startswith("fe80"):
                found.append(Interface(name, item.address, ""))
    return found


def addresses_of(wanted: Sequence[str], have: Sequence[Interface] | None = None) -> tuple[str, ...]:
    """The addresses to listen on for `--interface` options: names like `eth0`, or addresses of this machine.

    Raises `FrontError` that lists the interfaces for one that is not here.
    """
    have = interfaces() if have is None else have
    found: list[str] = []
    for text in wanted:
        mine = [one.address for one in have if text in (one.name, one.address)]
        if not mine:
            known = ", ".join(f"{one.name} ({one.address})" for one in have)
            raise FrontError(f"no interface {text!r} on this machine, which has {known or 'none that is up'}")
        found += mine
    return tuple(dict.fromkeys(found))


def reachable(hosts: Sequence[str], have: Sequence[Interface]) -> list[Interface]:
    """The interfaces that listening on `hosts` covers, best first: networks of people before those of containers,
    IPv4 before IPv6, the one with the default route before others; loopback last."""
    everything = any(host in WILDCARDS for host in hosts)
    named = {"127.0.0.1" if host == "localhost" else host for host in hosts}
    covered = [one for one in have if everything or one.address in named]
    return sorted(
        covered, key=lambda one: (one.loopback, one.name.startswith(VIRTUAL), ":" in one.address, not one.default)
    )


def public_host(hosts: Sequence[str], have: Sequence[Interface]) -> str:
    """The address that others are told when none is advertised: the first that they can reach."""
    covered = reachable(hosts, have)
    return covered[0].address if covered else hosts[0]


def _broadcast(address: str, netmask: str | None) -> str:
    """By the network mask: the system's own entry is missing or wrong on some interfaces."""
    if netmask is None:
        return ""
    network = ipaddress.ip_network(f"{address}/{netmask}", strict=False)
    return "" if network.prefixlen >= 31 else str(network.broadcast_address)


def _source() -> str:
    """Our address towards other networks, empty where no route leads there."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(_ELSEWHERE)
        except OSError:
            return ""
        return str(probe.getsockname()[0])
