"""Checks of the route to a session: beacon, address, network, TCP, introduction. Nothing here needs a key."""

from __future__ import annotations

import errno
import ipaddress
import socket
import time
from typing import Final

import psutil

from iris_session.client.discovery import Address, request_introduction
from iris_session.doctor.findings import Finding, failed, ok, warning
from iris_session.link.discovery import BeaconListener, DiscoveryError, FoundSession
from iris_session.protocol.discovery import DISCOVERY_PORT, Introduction
from iris_session.protocol.errors import ProtocolError, ProtocolVersionError
from iris_session.protocol.names import PROTOCOL_VERSION

#: The system needs 3 s to find that no machine of the network has an address; a firewall is silent for longer.
CONNECT_S: Final = 4.0
LISTEN_S: Final = 1.2
#: Timeout of the introduction one port above, which shows whether a port is the base of a block.
PORT_BASE_TIMEOUT_S: Final = 1.0
_UNREACHABLE: Final = frozenset({errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN, errno.EHOSTDOWN})


def check_beacon(session: str, address: Address | None) -> tuple[Finding, list[FoundSession]]:
    """Listen for beacons: is any session, or the wanted one, heard on the network?

    Args:
        session: Name of the wanted session; empty if it is given by address.
        address: Address of the wanted session, if it is known.

    Returns:
        The finding, and the sessions that were heard.
    """
    try:
        with BeaconListener() as listener:
            until = time.monotonic() + LISTEN_S
            while (left := until - time.monotonic()) > 0.0:
                listener.wait(left)
                if str(address) in {one.address for one in listener.poll_sessions()}:
                    break  # the wanted session is heard; a search by name goes on, as two may have the name
            found, ignored = listener.poll_sessions(), dict(listener.ignored)
    except DiscoveryError as error:
        return (failed if session else warning)("beacon", str(error)), []
    heard = ", ".join(f"{one.name} ({one.address})" for one in found) or "none"
    named = [one for one in found if one.name == session]
    if session and len(named) == 1:
        finding = ok("beacon", f"session {session!r} is heard at {named[0].address}")
    elif session and named:
        where = ", ".join(one.address for one in named)
        finding = failed("beacon", f"{len(named)} sessions are called {session!r}: {where}", "", "give the address")
    elif session:
        finding = failed(
            "beacon",
            f"no session {session!r} is heard; heard: {heard}",
            f"no beacon on UDP port {DISCOVERY_PORT}: none runs, it is in another network, or broadcasts are blocked",
            "give its address as `iris-session serve` prints it, or scan the code of `iris-session pair`",
        )
    elif found:
        finding = ok("beacon", f"sessions heard: {heard}")
    elif "other_version" in ignored:
        text = "the sessions that are heard speak another protocol version"
        finding = warning("beacon", text, f"this is version {PROTOCOL_VERSION}", "update the older side")
    else:
        finding = warning(
            "beacon",
            f"no session is heard on UDP port {DISCOVERY_PORT}{f'; ignored: {ignored}' if ignored else ''}",
            "none runs in this network, or the access point blocks broadcasts" if address is not None else "",
            "not needed if you type or scan the address",
        )
    return finding, found


def mention_heard_sessions(finding: Finding, target: Address, found: list[FoundSession]) -> Finding:
    """Add the sessions heard at other addresses to the advice of a failed finding: one of them may be meant."""
    others = ", ".join(f"{one.name} ({one.address})" for one in found if one.address != str(target))
    if not finding.failed or not others:
        return finding
    return failed(finding.check, finding.text, finding.why, f"heard on this network: {others}; else {finding.advice}")


def check_address(address: Address) -> tuple[Finding, str]:
    """Resolve the address. Return the finding and the IP address, which is empty if there is none."""
    try:
        ip = str(socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)[0][4][0])
    except (OSError, UnicodeError) as error:  # UnicodeError: not a host name, such as `a..b`
        why = error.strerror or error if isinstance(error, OSError) else "not a host name"
        text = f"the host name {address.host!r} cannot be resolved ({why})"
        return failed("address", text, "", "type the IP address that `iris-session serve` prints"), ""
    return ok("address", f"{address}" + ("" if ip == address.host else f" is {ip}")), ip


def check_subnet(ip: str) -> Finding:
    """Check whether the IP address is in a network of this machine."""
    target = ipaddress.ip_address(ip)
    networks = list_own_networks()
    listed = ", ".join(f"{network} ({name})" for name, network in networks) or "none"
    if target.is_loopback:
        return ok("subnet", f"{ip} is this machine")
    holding = [f"{name} ({network})" for name, network in networks if target in network]
    if holding:
        return ok("subnet", f"{ip} is in the network of {holding[0]}")
    text = f"{ip} is in none of this machine's networks: {listed}"
    advice = "connect both machines to the same network, or use the address that the server has in this one"
    with socket.socket(socket.AF_INET6 if target.version == 6 else socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((ip, 9))  # sends nothing: asks the system for a route
        except OSError as error:
            return failed("subnet", f"{text}, and there is no route to it ({error.strerror})", "", advice)
    return warning("subnet", text, "packets go through a router, which may block them", advice)


def list_own_networks() -> list[tuple[str, ipaddress.IPv4Network | ipaddress.IPv6Network]]:
    """Return names and networks of the interfaces that are up, without loopback and IPv6 link-local ones."""
    up = psutil.net_if_stats()
    found = []
    for name, addresses in sorted(psutil.net_if_addrs().items()):
        if name in up and not up[name].isup:
            continue
        for one in addresses:
            if one.family not in (socket.AF_INET, socket.AF_INET6) or not one.netmask:
                continue
            mask = one.netmask
            if one.family == socket.AF_INET6:
                mask = str(bin(int(ipaddress.IPv6Address(mask))).count("1"))
            network = ipaddress.ip_network(f"{one.address.split('%')[0]}/{mask}", strict=False)
            if not network.is_loopback and not (network.version == 6 and network.is_link_local):
                found.append((name, network))
    return found


def check_tcp(address: Address, ip: str, port: int = 0, check: str = "tcp", port_name: str = "control") -> Finding:
    """Check whether a TCP port accepts connections, and distinguish a closed port from a firewall.

    Args:
        address: Address of the session.
        ip: From `check_address`.
        port: Port to try; 0: that of `address`.
        check: Id of the finding.
        port_name: Name of the port in the texts.
    """
    port = port or address.port
    try:
        ipaddress.ip_address(ip)
    except ValueError:  # the system takes an empty address for this machine's own
        return failed(check, f"{address.host!r} has no address to connect to", "", "type the IP address instead")
    began = time.monotonic()
    try:
        probe_tcp(ip, port, CONNECT_S)
    except TimeoutError:
        return failed(
            check,
            f"no answer from {ip} port {port} ({port_name}) within {CONNECT_S:g} s",
            "packets are dropped: a firewall, the wrong machine, or a network that isolates its clients",
            f"on the server's machine allow TCP {port} (docs/network.md), and try from that machine itself",
        )
    except OSError as error:
        if error.errno == errno.ECONNREFUSED:
            return failed(
                check,
                f"nothing listens at {ip} port {port} ({port_name})",
                "the machine answers, but no program has this port: no session runs, it has another port, "
                "or it listens on another address (127.0.0.1 is for its own machine only)",
                "compare with the address that `iris-session serve` prints; for other machines it needs --interface",
            )
        if error.errno in _UNREACHABLE:
            text = f"{ip} cannot be reached ({error.strerror})"
            why = "no machine of this network has that address, it is switched off, or it is disconnected"
            advice = "compare with the address that `iris-session serve` prints, and check cable or Wi-Fi"
            return failed(check, text, why, advice)
        return failed(check, f"no connection to {ip} port {port} ({port_name}): {error.strerror or error}")
    return ok(check, f"{ip} port {port} ({port_name}) accepts connections ({(time.monotonic() - began) * 1e3:.1f} ms)")


def probe_tcp(ip: str, port: int, timeout_s: float) -> None:
    """Open a TCP connection and close it. Raises `OSError`: refused, unreachable, or no answer in time."""
    with socket.socket(socket.AF_INET6 if ":" in ip else socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.settimeout(timeout_s)
        probe.connect((ip, port))


def check_introduction(address: Address) -> tuple[Finding, Finding, Introduction | None]:
    """Request the introduction of the session: checks `introduction` and `version`, and the introduction itself."""
    unknown = Finding("version", "skipped", "not known: there was no introduction")
    try:
        said = _request_introduction(address, CONNECT_S)
    except ProtocolVersionError as error:
        return ok("introduction", f"a session of protocol version {error.version}"), check_version(error.version), None
    except ProtocolError as error:
        text = f"the program at port {address.port - 1} is not a session: {error}"
        return failed("introduction", text, "", "check the port"), unknown, None
    except OSError as error:
        text = f"no introduction on TCP port {address.port - 1} ({error.strerror or error})"
        why = "a firewall allows only the control port, or the program there is not of this version"
        return warning("introduction", text, why, "allow that port too: it announces keys"), unknown, None
    one = said.beacon
    here = f"{said.participants} participants" + (", a join code is open" if said.pairing else "")
    text = f"session {one.session_name!r} ({one.kind}), {here}"
    return ok("introduction", text), check_version(one.protocol), said


def check_port_base(address: Address) -> Finding | None:
    """Return a failed finding if the port is the base of a session's block of ports and not its control port."""
    joined = Address(address.host, address.port + 1)
    try:
        said = _request_introduction(joined, PORT_BASE_TIMEOUT_S)
    except (OSError, ProtocolError):
        return None
    if said.beacon.control != joined.port:
        return None
    name = f"session {said.beacon.session_name!r}"
    text = f"port {address.port} is the base of the ports of {name}, whose control port is {joined}"
    return failed("introduction", text, "the control port of `serve --port-base N` is N + 1", f"use {joined}")


def _request_introduction(address: Address, patience_s: float) -> Introduction:
    """Request the introduction, blocking. Raises what `request_introduction` raises."""
    steps = request_introduction(address.host, address.port, patience_s)
    while True:
        try:
            next(steps)
        except StopIteration as done:
            said: Introduction = done.value
            return said
        time.sleep(0.005)


def check_version(theirs: int) -> Finding:
    """Compare the protocol version of the session, `theirs`, with ours."""
    if theirs == PROTOCOL_VERSION:
        return ok("version", f"both speak protocol version {PROTOCOL_VERSION}")
    older = "the session" if theirs < PROTOCOL_VERSION else "this machine"
    return failed(
        "version",
        f"the session speaks protocol version {theirs}, this machine version {PROTOCOL_VERSION}",
        "",
        f"update {older}: pip install --upgrade iris-session",
    )
