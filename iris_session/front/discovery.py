"""Discovery of the session by clients: beacons, introductions, and its entry in this machine's session registry.

The beacon announces where the session is, five times a second, to every network that it listens on. The introduction
answers a connection to the TCP port below the control port with a description of the session, once: nothing is read
and nothing kept, the connection is accepted, written to and closed at once, so that none can hold anything. The
registry entry lets `iris-session pair` find an encrypted session. Resolving endpoints is the client's part.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import socket
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, TypeVar

import msgspec

from iris_session.link.config import MILLISECOND, SECOND, FrontConfig, FrontError, PortInUseError, Ports
from iris_session.link.interfaces import (
    LOOPBACK_BROADCAST,
    WILDCARDS,
    Interface,
    interfaces,
    public_host,
    reachable,
)
from iris_session.link.sockets import host_in_address, open_listeners
from iris_session.protocol.codec import encode_beacon, encode_introduction
from iris_session.protocol.discovery import INTRODUCTION_OFFSET, Beacon, Introduction
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import PROTOCOL_VERSION
from iris_session.security import KeyHome, KeysBusyError, KeysError, RegisteredSession
from iris_session.system.file_worker import LOCK_TIMEOUT_S, FileWorker

log = logging.getLogger(__name__)

BEACON_PERIOD_NS: Final = 200 * MILLISECOND
#: Networks come and go: a laptop changes its Wi-Fi, a DHCP lease gives another address.
INTERFACES_PERIOD_NS: Final = 2 * SECOND
#: The queue of the interface is full: the next beacon is 0.2 s away.
_TRANSIENT_ERRORS: Final = frozenset({errno.EAGAIN, errno.EWOULDBLOCK, errno.ENOBUFS})
#: Introductions sent in one tick of 10 ms: the rest waits in the system's queue, which is bounded.
ANSWERS_PER_TICK: Final = 24
BACKLOG: Final = 256
#: Attempts at finding two free neighbouring ports.
MAX_PORT_ATTEMPTS: Final = 50
#: Larger than any introduction: what the system does not take at once is not sent.
SEND_BUFFER_BYTES: Final = 16_384
T = TypeVar("T")
Listeners = Sequence[socket.socket]


# --- addresses -------------------------------------------------------------------------------------------------------


def choose_address_host(config: FrontConfig) -> str:
    """Return the host part of the session's address: an address of this machine, IPv6 in brackets."""
    host = config.hosts[0]
    return host_in_address(public_host(config.hosts, interfaces()) if host in WILDCARDS else host)


def list_reachable_hosts(config: FrontConfig) -> tuple[str, ...]:
    """Return the addresses under which others reach the session, best first; `advertise` before all others."""
    have = interfaces()
    covered = [one.address for one in reachable(config.hosts, have) if config.loopback or not one.loopback]
    hosts = [config.advertise, *covered] if config.advertise else covered
    return tuple(dict.fromkeys(hosts)) or config.hosts


# --- beacon ----------------------------------------------------------------------------------------------------------


class BeaconSender:
    """Send the beacon to every network. A `Service`.

    A network that cannot be sent to is logged and counted once (`beacon_unsent`), until it works again.

    Attributes:
        problems: What is wrong now, by broadcast address.

    Args:
        beacon: Sent with the session's address on each network as its host, or with `advertise`.
        hosts: Addresses that the session listens on.
        port: UDP port.
        drops: Drop counters.
        advertise: Host to send instead of the session's own address.
        list_interfaces: Returns the network interfaces.
    """

    def __init__(
        self,
        beacon: Beacon,
        hosts: Sequence[str],
        port: int,
        drops: Drops,
        advertise: str = "",
        list_interfaces: Callable[[], list[Interface]] = interfaces,
    ) -> None:
        self.problems: dict[str, str] = {}
        self._beacon = beacon
        self._hosts = hosts
        self._port = port
        self._drops = drops
        self._advertise = advertise
        self._list_interfaces = list_interfaces
        self._targets: list[tuple[str, bytes]] = []
        self._next_ns = self._next_interfaces_ns = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._socket.setblocking(False)

    def tick(self, now_ns: int) -> None:
        """Send the beacons that are due at session time `now_ns`, without waiting."""
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + BEACON_PERIOD_NS
        if now_ns >= self._next_interfaces_ns:
            self._next_interfaces_ns = now_ns + INTERFACES_PERIOD_NS
            self._targets = self._find_targets()
        for broadcast, datagram in self._targets:
            self._send(broadcast, datagram)

    def close(self) -> None:
        self._socket.close()

    def _find_targets(self) -> list[tuple[str, bytes]]:
        """Return broadcast address and datagram per network, and those of this machine, to which its own address is
        sent."""
        have = self._list_interfaces()
        targets = {LOOPBACK_BROADCAST: self._encode(public_host(self._hosts, have))}
        for one in reachable(self._hosts, have):
            if one.broadcast and not one.loopback:
                targets[one.broadcast] = self._encode(self._advertise or one.address)
        return list(targets.items())

    def _encode(self, host: str) -> bytes:
        return encode_beacon(msgspec.structs.replace(self._beacon, host=host))

    def _send(self, broadcast: str, datagram: bytes) -> None:
        try:
            self._socket.sendto(datagram, (broadcast, self._port))
        except OSError as error:
            if error.errno not in _TRANSIENT_ERRORS and broadcast not in self.problems:
                self.problems[broadcast] = error.strerror or str(error)
                self._drops.count("beacon_unsent")
                log.warning(
                    "cannot send beacons to %s (%s): join by address there", broadcast, self.problems[broadcast]
                )
        else:
            self.problems.pop(broadcast, None)


# --- introduction ----------------------------------------------------------------------------------------------------


class IntroductionServer:
    """Send the introduction to every connection, then close it. A `Service`.

    `make_introduction` returns the introduction as it is now.
    """

    def __init__(self, listeners: Listeners, make_introduction: Callable[[], Introduction]) -> None:
        self._listeners = listeners
        self._make_introduction = make_introduction

    def tick(self, now_ns: int) -> None:
        """Answer up to `ANSWERS_PER_TICK` connections."""
        left = ANSWERS_PER_TICK
        data = b""
        for listener in self._listeners:
            while left:
                try:
                    peer, _ = listener.accept()
                except OSError:  # no connection waits, it was closed already, or no descriptor is left for it
                    break
                left -= 1
                with peer, contextlib.suppress(OSError):
                    peer.setblocking(False)
                    data = data or encode_introduction(self._make_introduction())
                    peer.send(data)

    def close(self) -> None:
        for listener in self._listeners:
            listener.close()


def open_introduction_listeners(hosts: Sequence[str], port: int) -> list[socket.socket]:
    """Open listening sockets on every host with the same port; 0: any free one. Raises `FrontError`."""
    try:
        return open_listeners(hosts, port, BACKLOG, SEND_BUFFER_BYTES)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise PortInUseError(port, "introduction") from error
        text = f"cannot listen on {error.filename} port {port} (introduction): {error.strerror or error}"
        raise FrontError(text) from error


def open_with_introduction(
    hosts: Sequence[str], control_port: int, open_control: Callable[[int], T]
) -> tuple[T, list[socket.socket]]:
    """Open the control socket, and the listeners of the introduction on the port below it.

    With port 0, two free neighbouring ports are searched for.

    Raises:
        FrontError: A port is in use, or an address is not one of this machine.
    """
    for attempt in range(MAX_PORT_ATTEMPTS):
        listeners = open_introduction_listeners(hosts, control_port + INTRODUCTION_OFFSET if control_port else 0)
        port = listeners[0].getsockname()[1] - INTRODUCTION_OFFSET
        try:
            return open_control(port), listeners
        except FrontError as error:
            for listener in listeners:
                listener.close()
            in_use = isinstance(error, PortInUseError)
            if control_port or not in_use or attempt == MAX_PORT_ATTEMPTS - 1:
                raise
    raise AssertionError("unreachable")


# --- registry --------------------------------------------------------------------------------------------------------


class SessionRegistration:
    """Register a running encrypted session in the home of keys, for `iris-session pair`. A `Service`.

    The entry is written with the first tick and removed by `close`.
    """

    def __init__(self, home: KeyHome, files: FileWorker[KeysError], config: FrontConfig, ports: Ports) -> None:
        self._notes = home.sessions
        self._files = files
        self._note = RegisteredSession(
            config.session_id,
            config.session_name,
            os.getpid(),
            ports.reachable,
            ports.control,
            ports.key_fingerprint,
            config.web_port,
        )
        self._submitted = False

    def tick(self, now_ns: int) -> None:
        """Write the entry; try again while another process changes the file."""
        if not self._submitted:
            self._submitted = self._files.submit(partial(self._notes.add, self._note, LOCK_TIMEOUT_S), self._on_written)

    def close(self) -> None:
        """Remove the entry. The front's loop has ended, so this may wait."""
        if not self._submitted:
            return
        with contextlib.suppress(KeysError):
            self._notes.remove(self._note.session_id, self._note.pid, timeout_s=0.2)

    def _on_written(self, outcome: KeysError | None, _now_ns: int) -> None:
        if isinstance(outcome, KeysBusyError):
            self._submitted = False
        elif outcome is not None:
            log.warning("cannot register this session, so `iris-session pair` will not find it: %s", outcome)


# --- all of it -------------------------------------------------------------------------------------------------------


def make_discovery_services(
    config: FrontConfig,
    ports: Ports,
    listeners: Listeners,
    drops: Drops,
    make_introduction: Callable[[Beacon], Introduction],
) -> list[IntroductionServer | BeaconSender]:
    """Make the services that announce a session: the introduction and, where it has a port, the beacon."""
    beacon = Beacon(
        protocol=PROTOCOL_VERSION,
        session_id=config.session_id,
        session_name=config.session_name,
        kind=config.session_kind,
        host=ports.reachable[0],
        control=ports.control,
        state=ports.state,
        media=ports.media,
        assets=ports.assets,
        web=config.web_port,
        key_fingerprint=ports.key_fingerprint,
    )
    services: list[IntroductionServer | BeaconSender] = [
        IntroductionServer(listeners, partial(make_introduction, beacon))
    ]
    if config.beacon_port:
        services.append(BeaconSender(beacon, config.hosts, config.beacon_port, drops, config.advertise))
    return services
