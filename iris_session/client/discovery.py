"""Addresses of sessions, and how to find them: beacons on UDP, host names, introductions of one address over TCP.

An address is `HOST:PORT` as typed, or the URI of a pairing QR code, which also carries key and join code.

Beacons and introductions are public and unauthenticated: `server_trust` decides what to trust of them.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import errno
import ipaddress
import socket
import threading
import time
from collections.abc import Generator
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Final
from urllib.parse import parse_qs, quote, urlsplit

from iris_session.client.errors import ClientError
from iris_session.link.discovery import BeaconListener, DiscoveryError, FoundSession, host_port, is_host
from iris_session.protocol.codec import INTRODUCTION_PREFIX, decode_introduction
from iris_session.protocol.discovery import DISCOVERY_PORT, INTRODUCTION_OFFSET, Introduction
from iris_session.protocol.limits import MAX_INTRODUCTION_BYTES
from iris_session.protocol.pairing import KEY_BYTES, normalise_code
from iris_session.security import KeysError, decode_key

DEFAULT_CONTROL_PORT: Final = 7721
SCHEME: Final = "iris"
_EXAMPLE: Final = f"127.0.0.1:{DEFAULT_CONTROL_PORT}"


@dataclass(frozen=True, slots=True)
class Address:
    """Control channel of a session.

    `host`: without brackets. `server_key`: Z85; like `join_code` and `session` only from a URI, else empty.
    """

    host: str
    port: int
    server_key: str = ""
    join_code: str = ""
    session: str = ""

    def __str__(self) -> str:
        return host_port(self.host, self.port)

    @classmethod
    def parse(cls, address: object) -> Address:
        """Parse `host`, `host:port`, `[ipv6]:port`, the same after `tcp://`, or `iris://host:port/?k=...&c=...&n=...`.

        Raises `ClientError` with examples of valid addresses.
        """
        if not isinstance(address, str):
            raise ClientError(f"address {address!r} is a {type(address).__name__}, not text like {_EXAMPLE!r}")
        if address.lower().startswith(f"{SCHEME}://"):
            return _from_uri(address.strip())
        return _from_text(address)


def pairing_uri(host: str, port: int, server_key: str, join_code: str = "", session: str = "") -> str:
    """Return `iris://HOST:CONTROL/?k=KEY&c=CODE&n=NAME`, the content of a pairing QR code.

    `server_key`: Z85; in the URI its 32 raw bytes in base64url without padding.
    """
    key = base64.urlsafe_b64encode(decode_key(server_key)).decode().rstrip("=")
    fields = {"k": key, "c": join_code, "n": session}
    query = "&".join(f"{name}={quote(value, safe='')}" for name, value in fields.items() if value)
    return f"{SCHEME}://{host_port(host, port)}/?{query}"


def _from_text(address: str) -> Address:
    text = address.removeprefix("tcp://").rstrip("/")
    host, separator, port = text.rpartition(":")
    if not separator or (text.count(":") > 1 and not text.startswith("[")) or text.endswith("]"):
        host, port = text, str(DEFAULT_CONTROL_PORT)
    if not is_host(host.strip("[]")) or not _is_port(port):
        raise ClientError(f"address {address!r} is not HOST:PORT, for example {_EXAMPLE}")
    return Address(host.strip("[]"), int(port))


def _is_port(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= 5 and 0 < int(text) < 65536


def _from_uri(address: str) -> Address:
    try:
        parts = urlsplit(address)
        fields = {name: values[-1] for name, values in parse_qs(parts.query).items()}
        where = _from_text(parts.netloc)
        code = fields.get("c", "")
        return replace(
            where,
            server_key=_key_from_uri(fields["k"]) if "k" in fields else "",
            join_code=normalise_code(code) if code else "",
            session=fields.get("n", ""),
        )
    except (ValueError, ClientError, KeysError) as error:
        raise ClientError(
            f"address {address!r} is not the URI of a session, iris://HOST:PORT/?k=KEY&c=CODE: {error}"
        ) from None


def _key_from_uri(text: str) -> str:
    from zmq.utils import z85

    try:
        key = base64.b64decode(text + "=" * (-len(text) % 4), altchars=b"-_", validate=True)
    except binascii.Error as error:
        raise ValueError(f"k={text} is not base64url ({error})") from None
    if len(key) != KEY_BYTES:
        raise ValueError(f"k={text} has {len(key)} bytes, a key has {KEY_BYTES}")
    return z85.encode(key).decode()


# --- sessions on the network ------------------------------------------------------------------------------------------


#: More than two periods of the beacon: one may be lost.
LISTEN_S: Final = 1.0
#: Error numbers by which different systems report a connection that is not established yet.
_NOT_YET: Final = frozenset({errno.EAGAIN, errno.EWOULDBLOCK, errno.EINPROGRESS, errno.ENOTCONN})
#: Names that the system is being asked for: it may take many seconds, and all who ask meanwhile share the answer.
_lookups: dict[str, tuple[Future[str], float]] = {}  # with the time at which the system was asked
_lookups_lock = threading.Lock()
#: An answer that came too late for its question serves the next attempt within so long of the question [s].
KEPT_S: Final = 30.0


def open_listener(port: int = DISCOVERY_PORT) -> BeaconListener:
    """Return a listener for beacons. Raises `ClientError` when the port cannot be used."""
    try:
        return BeaconListener(port)
    except DiscoveryError as error:
        raise ClientError(str(error)) from error


def find_sessions(timeout_s: float = LISTEN_S, *, port: int = DISCOVERY_PORT) -> list[FoundSession]:
    """Listen for sessions that announce themselves on the networks of this machine.

    Where an access point blocks broadcasts the list is empty: use the address of the session, or the QR code of
    `iris-session pair`.

    Args:
        timeout_s: Seconds to listen.
        port: UDP port of the beacons.

    Returns:
        The sessions, sorted by name.

    Raises:
        ClientError: The port cannot be used.
    """
    end = time.monotonic() + timeout_s
    with open_listener(port) as listener:
        while (left := end - time.monotonic()) > 0.0:
            listener.wait(left)
            listener.poll_sessions()
        return listener.poll_sessions()


def request_introduction(host: str, control_port: int, timeout_s: float) -> Generator[None, None, Introduction]:
    """Request the introduction of the session at an address; yields wherever it would wait.

    Args:
        host: Name or address of the machine.
        control_port: Port of the session's control channel.
        timeout_s: Seconds to wait at most.

    Returns:
        The introduction.

    Raises:
        OSError: No such host, or no answer.
        ProtocolError: The answer is no introduction, or has another protocol version.
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


def resolve_host(host: str, until_s: float) -> Generator[None, None, str]:
    """Resolve the network address of a host without blocking: a thread asks the system. Yields wherever it would wait.

    Names are resolved to IPv4 only, as on the sockets of the session. An answer that comes after the timeout serves the
    next attempt.

    Args:
        host: Name or address.
        until_s: When to give up, by `time.monotonic()` [s].

    Returns:
        The address.

    Raises:
        OSError: No such name, or no answer in time.
    """
    with contextlib.suppress(ValueError):
        return str(ipaddress.ip_address(host))
    with _lookups_lock:
        lookup, began_s = _lookups.get(host, (None, 0.0))
        if lookup is None or (lookup.done() and time.monotonic() - began_s > KEPT_S):
            lookup = Future()
            _lookups[host] = lookup, time.monotonic()
            threading.Thread(target=_look_up, args=(host, lookup), name=f"iris-resolve-{host}", daemon=True).start()
    while not lookup.done():
        if time.monotonic() > until_s:
            raise TimeoutError(errno.ETIMEDOUT, f"the name {host} is still looked up")
        yield
    with _lookups_lock:
        if _lookups.get(host, (None,))[0] is lookup:
            del _lookups[host]
    return lookup.result()


def _look_up(host: str, lookup: Future[str]) -> None:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        lookup.set_result(str(socket.getaddrinfo(host, None, family, socket.SOCK_STREAM)[0][4][0]))
    except OSError as error:
        lookup.set_exception(error)
    except ValueError as error:  # the system's resolver does not accept it as a name
        lookup.set_exception(OSError(errno.EINVAL, str(error)))
