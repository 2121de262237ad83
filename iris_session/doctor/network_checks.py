"""The way to a session: beacon, address, network, TCP, introduction. Nothing here needs a key."""

from __future__ import annotations

import errno
import ipaddress
import socket
import time
from typing import Final

import psutil

from iris_session.client.address import Address
from iris_session.client.discovery import BeaconListener, FoundSession, ask_introduction
from iris_session.client.errors import ClientError
from iris_session.doctor.findings import Finding, failed, ok, warning
from iris_session.protocol.discovery import DISCOVERY_PORT, Introduction
from iris_session.protocol.errors import ProtocolError, ProtocolVersionError
from iris_session.protocol.names import PROTOCOL_VERSION

#: The system takes 3 s to find that a network has no machine of an address; a firewall is silent for longer.
CONNECT_S: Final = 4.0
LISTEN_S: Final = 1.2
#: For what a port that takes connections says at once, if it is the base of a block.
PORT_BASE_TIMEOUT_S: Final = 1.0
_UNREACHABLE: Final = frozenset({errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN, errno.EHOSTDOWN})


def check_beacon(session: str, address: Address | None) -> tuple[Finding, list[FoundSession]]:
    """Whether sessions are heard on the network, and the wanted one among them."""
    try:
        with BeaconListener() as listener:
            until = time.monotonic() + LISTEN_S
            while (left := until - time.monotonic()) > 0.0:
                listener.wait(left)
                if str(address) in {one.address for one in listener.sessions()}:
                    break  # what is looked for tells of itself; by name there may be two
            found, ignored = listener.sessions(), dict(listener.ignored)
    except ClientError as error:
        return warning("beacon", str(error)), []
    heard = ", ".join(f"{one.name} ({one.address})" for one in found) or "none"
    if session:
        named = [one for one in found if one.name == session]
        if len(named) == 1:
            return ok("beacon", f"session {session!r} is heard at {named[0].address}"), found
        if named:
            where = ", ".join(one.address for one in named)
            return failed(
                "beacon", f"{len(named)} sessions are called {session!r}: {where}", "", "give the address"
            ), found
        return failed(
            "beacon",
            f"no session {session!r} is heard; heard: {heard}",
            f"no beacon on UDP port {DISCOVERY_PORT}: none runs, it is in another network, or broadcasts are blocked",
            "give its address, which `iris-session serve` prints, or scan the code of `iris-session pair`",
        ), found
    if found:
        return ok("beacon", f"sessions heard: {heard}"), found
    others = f"; ignored: {ignored}" if ignored else ""
    if "other_version" in ignored:
        return warning(
            "beacon",
            "sessions are heard that speak another protocol version",
            f"this is version {PROTOCOL_VERSION}",
            "update the older of the two",
        ), found
    return warning(
        "beacon",
        f"no session is heard on UDP port {DISCOVERY_PORT}{others}",
        "none runs in this network, or the access point blocks broadcasts" if address is not None else "",
        "no harm while you type or scan the address",
    ), found


def mention_heard_sessions(finding: Finding, target: Address, found: list[FoundSession]) -> Finding:
    """A failed `finding` about `target`, with the sessions that are heard at other addresses: one may be meant."""
    others = ", ".join(f"{one.name} ({one.address})" for one in found if one.address != str(target))
    if not finding.failed or not others:
        return finding
    return failed(finding.check, finding.text, finding.why, f"heard on this network: {others}; else {finding.advice}")


def check_address(address: Address) -> tuple[Finding, str]:
    """The address, and the IP address it stands for (empty when there is none)."""
    try:
        ip = str(socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)[0][4][0])
    except (OSError, UnicodeError) as error:  # UnicodeError: what cannot be a name, such as `a..b`
        why = error.strerror or error if isinstance(error, OSError) else "it cannot be a name"
        text = f"{address.host!r} is the name of no machine that is known here ({why})"
        return failed("address", text, "", "type the numbers that `iris-session serve` prints"), ""
    return ok("address", f"{address}" + ("" if ip == address.host else f" is {ip}")), ip


def check_subnet(ip: str) -> Finding:
    """Whether a network of this machine holds the address."""
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
            probe.connect((ip, 9))  # sends nothing: asks the system for a way
        except OSError as error:
            return failed("subnet", f"{text}, and there is no way to it ({error.strerror})", "", advice)
    return warning("subnet", text, "what you send goes through a router, which may not let it pass", advice)


def list_own_networks() -> list[tuple[str, ipaddress.IPv4Network | ipaddress.IPv6Network]]:
    """Interface names and networks of this machine that are up, without loopback and IPv6 link-local ones."""
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
    """Whether somebody takes a connection there. Tells a closed port from a firewall. `ip`: from `resolved`."""
    port = port or address.port
    try:
        ipaddress.ip_address(ip)
    except ValueError:  # to the system, an empty address would be this machine's own
        return failed(check, f"{address.host!r} stands for no address to connect to", "", "type the numbers instead")
    family = socket.AF_INET6 if ":" in ip else socket.AF_INET
    began = time.monotonic()
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.settimeout(CONNECT_S)
        try:
            probe.connect((ip, port))
        except TimeoutError:
            return failed(
                check,
                f"no answer from {ip} port {port} ({port_name}) within {CONNECT_S:g} s",
                "packets are thrown away: a firewall, the wrong machine, or a network that keeps its guests apart",
                f"on the server's machine let TCP {port} in (docs/network.md), and try from that machine itself",
            )
        except OSError as error:
            if error.errno == errno.ECONNREFUSED:
                return failed(
                    check,
                    f"nothing listens at {ip} port {port} ({port_name})",
                    "the machine answers, but no program has this port: no session runs, it has another port, "
                    "or it listens on another address (127.0.0.1 is for its own machine only)",
                    "look at the address that `iris-session serve` prints; for other machines it needs --interface",
                )
            if error.errno in _UNREACHABLE:
                text = f"{ip} cannot be reached ({error.strerror})"
                why = "no machine of this network has that address, it is switched off, or its cable or Wi-Fi is"
                return failed(check, text, why, "look at the address that `iris-session serve` prints, and the cable")
            return failed(check, f"no connection to {ip} port {port} ({port_name}): {error.strerror or error}")
    return ok(check, f"{ip} port {port} ({port_name}) takes connections ({(time.monotonic() - began) * 1e3:.1f} ms)")


def check_introduction(address: Address) -> tuple[Finding, Finding, Introduction | None]:
    """What the session says of itself, and whether it speaks our version: checks `introduction` and `version`."""
    unknown = Finding("version", "skipped", "not known: there was no introduction")
    try:
        said = _request_introduction(address, CONNECT_S)
    except ProtocolVersionError as error:
        return ok("introduction", f"a session of protocol version {error.version}"), check_version(error.version), None
    except ProtocolError as error:
        text = f"what introduces itself at port {address.port - 1} is no session: {error}"
        return failed("introduction", text, "", "look at the port"), unknown, None
    except OSError as error:
        text = f"no introduction on TCP port {address.port - 1} ({error.strerror or error})"
        why = "a firewall lets only the control port pass, or what listens there is not of this version"
        return warning("introduction", text, why, "let that port in too: keys are told by it"), unknown, None
    one = said.beacon
    here = f"{said.participants} participants" + (", a join code is open" if said.pairing else "")
    text = f"session {one.session_name!r} ({one.kind}), {here}"
    return ok("introduction", text), check_version(one.protocol), said


def check_port_base(address: Address) -> Finding | None:
    """That `address` is the first of a session's block of ports, where it introduces itself, not the one to join."""
    joined = Address(address.host, address.port + 1)
    said = _try_introduction(joined, PORT_BASE_TIMEOUT_S)
    if said is None or said.beacon.control != joined.port:
        return None
    name = f"session {said.beacon.session_name!r}"
    text = f"port {address.port} is the base of the ports of {name}, which is joined at {joined}"
    return failed("introduction", text, "`serve --port-base N` is joined at port N + 1", f"use {joined}")


def _try_introduction(address: Address, patience_s: float) -> Introduction | None:
    try:
        return _request_introduction(address, patience_s)
    except (OSError, ProtocolError):
        return None


def _request_introduction(address: Address, patience_s: float) -> Introduction:
    """Raises what `ask_introduction` raises."""
    steps = ask_introduction(address.host, address.port, patience_s)
    while True:
        try:
            next(steps)
        except StopIteration as done:
            said: Introduction = done.value
            return said
        time.sleep(0.005)


def check_version(theirs: int) -> Finding:
    """Whether a session of protocol version `theirs` can be talked to."""
    if theirs == PROTOCOL_VERSION:
        return ok("version", f"both speak protocol version {PROTOCOL_VERSION}")
    older = "the session" if theirs < PROTOCOL_VERSION else "this machine"
    return failed(
        "version",
        f"the session speaks protocol version {theirs}, this machine version {PROTOCOL_VERSION}",
        "",
        f"update {older}: pip install --upgrade iris-session",
    )
