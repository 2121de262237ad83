"""Find sessions: listen for beacons on UDP, and request the introduction of one address over TCP.

Beacons and introductions are public and unauthenticated: `server_trust` decides what to trust of them.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import time
from collections.abc import Generator
from typing import Final

from iris_session.client.errors import ClientError
from iris_session.client.host_lookup import resolve_host
from iris_session.link.discovery import BeaconListener, DiscoveryError, FoundSession
from iris_session.protocol.codec import INTRODUCTION_PREFIX, decode_introduction
from iris_session.protocol.discovery import DISCOVERY_PORT, INTRODUCTION_OFFSET, Introduction
from iris_session.protocol.limits import MAX_INTRODUCTION_BYTES

#: More than two periods of the beacon: one may be lost.
LISTEN_S: Final = 1.0
#: Error numbers by which different systems report a connection that is not established yet.
_NOT_YET: Final = frozenset({errno.EAGAIN, errno.EWOULDBLOCK, errno.EINPROGRESS, errno.ENOTCONN})


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
