"""Beacons of sessions on the network: `BeaconListener` receives and checks them, because any host can send one.

Clients use it, and a session that checks whether its name is unique. Not here: sending beacons (`front`), and trust in
the sessions found (`client`).
"""

from __future__ import annotations

import contextlib
import ipaddress
import re
import selectors
import socket
from dataclasses import dataclass, replace
from typing import Final, Self

from iris_session.protocol.codec import decode_beacon
from iris_session.protocol.discovery import DISCOVERY_PORT, Beacon
from iris_session.protocol.errors import IrisError, ProtocolError, ProtocolVersionError
from iris_session.protocol.limits import MAX_BEACON_BYTES

#: Sessions remembered, and addresses of one session: any host can send beacons.
MAX_SESSIONS: Final = 128
MAX_ADDRESSES: Final = 4
MAX_DRAIN: Final = 256
MAX_HOST: Final = 64
#: One part of a name between its dots. Some networks have underscores in theirs.
_LABEL: Final = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?")
_SCOPE: Final = re.compile(r"[A-Za-z0-9._-]{1,32}")
MAX_NAME: Final = 253


class DiscoveryError(IrisError):
    """Beacons cannot be received. The message is one line that says what to do."""


@dataclass(frozen=True, slots=True)
class FoundSession:
    """Session whose beacon was received.

    Attributes:
        name: Name of the session.
        address: `HOST:PORT` of its control channel.
        session_id: Id of the session.
        kind: `live` or `replay`.
        key_fingerprint: Fingerprint of its key, as the beacon claims; empty: not encrypted.
        addresses: All addresses from which its beacon was received.
    """

    name: str
    address: str
    session_id: str
    kind: str
    key_fingerprint: str
    addresses: tuple[str, ...]


class BeaconListener:
    """Receiver of beacons. Several listeners on one machine all receive them. Only `wait` blocks.

    Attributes:
        ignored: Number of datagrams that were no valid beacons, by reason.

    Raises:
        DiscoveryError: The port cannot be used.
    """

    def __init__(self, port: int = DISCOVERY_PORT) -> None:
        self.ignored: dict[str, int] = {}
        self._found: dict[str, FoundSession] = {}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with contextlib.suppress(AttributeError, OSError):  # only some systems have it, and only they need it
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
            self._socket.setblocking(False)
            self._socket.bind(("", port))
        except OSError as error:
            self._socket.close()
            raise DiscoveryError(
                f"cannot listen for sessions on UDP port {port} ({error.strerror}): type the session's address instead"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._socket.close()

    def poll_sessions(self) -> list[FoundSession]:
        """Return the sessions found so far, by name."""
        for _ in range(MAX_DRAIN):
            try:
                data, sender = self._socket.recvfrom(MAX_BEACON_BYTES + 1)
            except OSError:
                break
            self._process_datagram(data, str(sender[0]))
        return sorted(self._found.values(), key=lambda found: (found.name, found.session_id))

    def wait(self, timeout_s: float) -> None:
        """Wait until a datagram arrives, at most `timeout_s` seconds."""
        with selectors.DefaultSelector() as selector:  # `select` takes no descriptor above 1023
            selector.register(self._socket, selectors.EVENT_READ)
            selector.select(max(0.0, timeout_s))

    def _process_datagram(self, data: bytes, sender: str) -> None:
        try:
            beacon = decode_beacon(data)
        except ProtocolError as error:
            self._count_ignored("other_version" if isinstance(error, ProtocolVersionError) else "malformed")
            return
        if not is_plausible(beacon):
            self._count_ignored("malformed")
        elif _is_loopback(beacon.host) and not _is_loopback(sender):
            self._count_ignored("foreign_loopback")  # another machine must not direct us to a port of our own
        elif beacon.session_id in self._found:
            self._add_address(beacon)
        elif len(self._found) >= MAX_SESSIONS:
            self._count_ignored("too_many")
        else:
            address = host_port(beacon.host, beacon.control)
            self._found[beacon.session_id] = FoundSession(
                beacon.session_name, address, beacon.session_id, beacon.kind, beacon.key_fingerprint, (address,)
            )

    def _add_address(self, beacon: Beacon) -> None:
        """Add the address of another network, if it is new."""
        known, address = self._found[beacon.session_id], host_port(beacon.host, beacon.control)
        if address not in known.addresses and len(known.addresses) < MAX_ADDRESSES:
            self._found[beacon.session_id] = replace(known, addresses=(*known.addresses, address))

    def _count_ignored(self, reason: str) -> None:
        self.ignored[reason] = self.ignored.get(reason, 0) + 1


def host_port(host: str, port: int) -> str:
    """Return `HOST:PORT`, IPv6 in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def is_host(host: str) -> bool:
    """Return whether a text can be the name or address of a host.

    The system's resolver and libzmq raise errors of their own for other texts.
    """
    if ":" in host:
        address, _, scope = host.partition("%")
        try:
            ipaddress.IPv6Address(address)
        except ValueError:
            return False
        return not scope or _SCOPE.fullmatch(scope) is not None
    labels = host.removesuffix(".").split(".")
    return len(host) <= MAX_NAME and host[:1] != "_" and all(_LABEL.fullmatch(label) for label in labels)


def is_plausible(beacon: Beacon) -> bool:
    """Return whether the texts of a beacon are printable and its address can be one. Any host can send beacons."""
    texts = (beacon.session_id, beacon.session_name, beacon.kind, beacon.key_fingerprint)
    return (
        all(text.isprintable() for text in texts)
        and bool(beacon.session_id and beacon.session_name)
        and len(beacon.host) <= MAX_HOST
        and is_host(beacon.host)
        and 0 < beacon.control < 65536
    )


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
