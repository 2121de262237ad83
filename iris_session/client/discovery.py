"""Finding sessions: listening for beacons on UDP, and asking one address for its introduction over TCP.

Both are said in public by anybody: what is trusted of them is decided in `meeting`.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import selectors
import socket
import time
from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import Final, Self

from iris_session.client.address import host_port, is_host
from iris_session.client.errors import ClientError
from iris_session.client.host_lookup import resolve_host
from iris_session.protocol.codec import INTRODUCTION_PREFIX, decode_beacon, decode_introduction
from iris_session.protocol.discovery import DISCOVERY_PORT, INTRODUCTION_OFFSET, Beacon, Introduction
from iris_session.protocol.errors import ProtocolError, ProtocolVersionError
from iris_session.protocol.limits import MAX_BEACON_BYTES, MAX_INTRODUCTION_BYTES

#: Sessions kept, and addresses of one session: beacons are made by anybody.
MAX_SESSIONS: Final = 128
MAX_ADDRESSES: Final = 4
MAX_DRAIN: Final = 256
#: More than two periods of a beacon: one may be lost.
LISTEN_S: Final = 1.0
MAX_HOST: Final = 64
#: A connection that is not there yet, as different systems say it.
_NOT_YET: Final = frozenset({errno.EAGAIN, errno.EWOULDBLOCK, errno.EINPROGRESS, errno.ENOTCONN})


@dataclass(frozen=True, slots=True)
class FoundSession:
    """A session that was heard. `address`: `HOST:PORT` of its control channel; `addresses`: all it was heard with.

    `kind`: `live` or `replay`. `key_fingerprint`: of its key, as it says itself; empty: not encrypted.
    """

    name: str
    address: str
    session_id: str
    kind: str
    key_fingerprint: str
    addresses: tuple[str, ...]


class BeaconListener:
    """Hears beacons from when it is made; several listeners on one machine all hear them. Never waits.

    `ignored`: datagrams that were no beacons, by reason. Raises `ClientError` when it cannot listen.
    """

    def __init__(self, port: int = DISCOVERY_PORT) -> None:
        self.ignored: dict[str, int] = {}
        self._found: dict[str, FoundSession] = {}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with contextlib.suppress(AttributeError, OSError):  # where it is needed it is there
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
            self._socket.setblocking(False)
            self._socket.bind(("", port))
        except OSError as error:
            self._socket.close()
            raise ClientError(
                f"cannot listen for sessions on UDP port {port} ({error.strerror}): type the session's address instead"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._socket.close()

    def poll_sessions(self) -> list[FoundSession]:
        """Those heard so far, by name."""
        for _ in range(MAX_DRAIN):
            try:
                data, sender = self._socket.recvfrom(MAX_BEACON_BYTES + 1)
            except OSError:
                break
            self._process_datagram(data, str(sender[0]))
        return sorted(self._found.values(), key=lambda found: (found.name, found.session_id))

    def wait(self, timeout_s: float) -> None:
        """Until something comes, at most `timeout_s`."""
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
            self._count_ignored("foreign_loopback")  # somebody else must not send us to a port of our own
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
        """By another network, or once more."""
        known, address = self._found[beacon.session_id], host_port(beacon.host, beacon.control)
        if address not in known.addresses and len(known.addresses) < MAX_ADDRESSES:
            self._found[beacon.session_id] = replace(known, addresses=(*known.addresses, address))

    def _count_ignored(self, reason: str) -> None:
        self.ignored[reason] = self.ignored.get(reason, 0) + 1


def find_sessions(timeout_s: float = LISTEN_S, *, port: int = DISCOVERY_PORT) -> list[FoundSession]:
    """The sessions that tell of themselves on the networks of this machine, by name. Listens for `timeout_s`.

    Empty where an access point blocks broadcasts: type the address then, or scan the code of `iris-session pair`.
    """
    end = time.monotonic() + timeout_s
    with BeaconListener(port) as listener:
        while (left := end - time.monotonic()) > 0.0:
            listener.wait(left)
            listener.poll_sessions()
        return listener.poll_sessions()


def request_introduction(host: str, control_port: int, timeout_s: float) -> Generator[None, None, Introduction]:
    """Steps towards the introduction of the session at an address; yields wherever it would wait.

    Raises `OSError` (nobody there, no answer) or `ProtocolError` (no introduction, or another protocol version).
    """
    until = time.monotonic() + timeout_s
    target = yield from resolve_host(host, until)
    family = socket.AF_INET6 if ":" in target else socket.AF_INET
    data = b""
    with socket.socket(family, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            asking.connect((target, control_port + INTRODUCTION_OFFSET))
        while (introduction := decode_introduction(data)) is None:
            try:
                more = asking.recv(INTRODUCTION_PREFIX + MAX_INTRODUCTION_BYTES + 1 - len(data))
            except OSError as error:
                if error.errno not in _NOT_YET:
                    raise
                if time.monotonic() > until:
                    raise TimeoutError(errno.ETIMEDOUT, "no answer") from None
                yield
                continue
            if not more:
                raise ConnectionError(errno.ECONNRESET, "closed before the end")
            data += more
    return introduction


def is_plausible(beacon: Beacon) -> bool:
    """Whether its texts may be shown in a terminal, and its address can be one. They come from anybody."""
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
