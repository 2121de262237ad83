"""The beacon: tells every network that the session listens on, five times a second, where it is."""

from __future__ import annotations

import errno
import socket
import sys
from collections.abc import Callable, Sequence
from typing import Final

import msgspec

from iris_session.link.config import MILLISECOND, SECOND
from iris_session.link.interfaces import LOOPBACK_BROADCAST, Interface, interfaces, public_host, reachable
from iris_session.protocol.codec import encode_beacon
from iris_session.protocol.discovery import Beacon
from iris_session.protocol.limits import Drops

BEACON_PERIOD_NS: Final = 200 * MILLISECOND
#: Networks come and go: a laptop changes its Wi-Fi, a lease gives another address.
INTERFACES_PERIOD_NS: Final = 2 * SECOND
#: The queue of the interface is full: the next beacon is 0.2 s away.
_TRANSIENT_ERRORS: Final = frozenset({errno.EAGAIN, errno.EWOULDBLOCK, errno.ENOBUFS})


class BeaconSender:
    """A service of the front. `beacon` is what is sent, but for its host: that is the address on each network, or
    `advertise` where one is given. `problems`: what goes wrong now, by network, for people.

    A network that cannot be sent to is said and counted once (`beacon_unsent`), until it works again.
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
        self._next_ns = self._next_look_ns = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._socket.setblocking(False)

    def tick(self, now_ns: int) -> None:
        """Sends what is due at session time `now_ns`; never waits."""
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + BEACON_PERIOD_NS
        if now_ns >= self._next_look_ns:
            self._next_look_ns = now_ns + INTERFACES_PERIOD_NS
            self._targets = self._find_targets()
        for broadcast, datagram in self._targets:
            self._send(broadcast, datagram)

    def close(self) -> None:
        self._socket.close()

    def _find_targets(self) -> list[tuple[str, bytes]]:
        """Broadcast address and datagram per network, and this machine itself, where our own address will do."""
        have = self._list_interfaces()
        targets = {LOOPBACK_BROADCAST: self._datagram(public_host(self._hosts, have))}
        for one in reachable(self._hosts, have):
            if one.broadcast and not one.loopback:
                targets[one.broadcast] = self._datagram(self._advertise or one.address)
        return list(targets.items())

    def _datagram(self, host: str) -> bytes:
        return encode_beacon(msgspec.structs.replace(self._beacon, host=host))

    def _send(self, broadcast: str, datagram: bytes) -> None:
        try:
            self._socket.sendto(datagram, (broadcast, self._port))
        except OSError as error:
            if error.errno not in _TRANSIENT_ERRORS and broadcast not in self.problems:
                self.problems[broadcast] = error.strerror or str(error)
                self._drops.count("beacon_unsent")
                text = f"no beacons to {broadcast} ({self.problems[broadcast]}): join by address there"
                print(f"iris-session: {text}", file=sys.stderr, flush=True)
        else:
            self.problems.pop(broadcast, None)
