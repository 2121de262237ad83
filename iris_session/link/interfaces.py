"""Network interfaces of this machine: addresses to listen on, to send beacons to, and to advertise."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Sequence
from typing import Final, NamedTuple

import psutil

from iris_session.link.config import FrontError

#: Networks inside this machine (containers, virtual machines): other machines cannot reach it by them.
VIRTUAL: Final = ("br-", "cni", "docker", "lxc", "podman", "veth", "virbr", "vmnet")
#: Address by which the routing table is read; nothing is sent. TEST-NET-3 (RFC 5737), which no host has.
_ELSEWHERE: Final = ("203.0.113.1", 9)
WILDCARDS: Final = ("0.0.0.0", "::")
LOOPBACK_BROADCAST: Final = "127.255.255.255"


class Interface(NamedTuple):
    """One address of a network interface that is up.

    Attributes:
        broadcast: Broadcast address, empty where there is none (IPv6, /32).
        default: True for the interface of the default route.
    """

    name: str
    address: str
    broadcast: str
    default: bool = False

    @property
    def loopback(self) -> bool:
        return ipaddress.ip_address(self.address).is_loopback


def interfaces() -> list[Interface]:
    """Return the IPv4 and IPv6 addresses of interfaces that are up, without link-local IPv6, which needs a scope."""
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
    """Return the addresses to listen on for `--interface` options.

    Args:
        wanted: Names such as `eth0`, or addresses of this machine.
        have: Interfaces of this machine; `None` reads them from the system.

    Raises:
        FrontError: This machine has no such interface; the message lists those that it has.
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
    """Return the interfaces that listening on `hosts` covers, best first.

    Physical networks come before those of containers, IPv4 before IPv6, the one with the default route before others;
    loopback comes last.
    """
    everything = any(host in WILDCARDS for host in hosts)
    named = {"127.0.0.1" if host == "localhost" else host for host in hosts}
    covered = [one for one in have if everything or one.address in named]
    return sorted(
        covered, key=lambda one: (one.loopback, one.name.startswith(VIRTUAL), ":" in one.address, not one.default)
    )


def public_host(hosts: Sequence[str], have: Sequence[Interface]) -> str:
    """Return the address to announce when none is advertised: the best one that other machines can reach."""
    covered = reachable(hosts, have)
    return covered[0].address if covered else hosts[0]


def _broadcast(address: str, netmask: str | None) -> str:
    """Compute the broadcast address from the netmask: the system's own entry is missing or wrong on some interfaces."""
    if netmask is None:
        return ""
    network = ipaddress.ip_network(f"{address}/{netmask}", strict=False)
    return "" if network.prefixlen >= 31 else str(network.broadcast_address)


def _source() -> str:
    """Return this machine's address towards other networks, empty when there is no route to them."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(_ELSEWHERE)
        except OSError:
            return ""
        return str(probe.getsockname()[0])
