"""Finding sessions: listening for beacons on UDP, and asking one address for its introduction over TCP.

Both are said in public by anybody: what is trusted of them is decided in `meeting`.
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

#: More than two periods of a beacon: one may be lost.
LISTEN_S: Final = 1.0
#: A connection that is not there yet, as different systems say it.
_NOT_YET: Final = frozenset({errno.EAGAIN, errno.EWOULDBLOCK, errno.EINPROGRESS, errno.ENOTCONN})


def open_listener(port: int = DISCOVERY_PORT) -> BeaconListener:
    """Return a listener for beacons. Raises `ClientError` when the port cannot be used."""
    try:
        return BeaconListener(port)
    except DiscoveryError as error:
        raise ClientError(str(error)) from error


def find_sessions(timeout_s: float = LISTEN_S, *, port: int = DISCOVERY_PORT) -> list[FoundSession]:
    """The sessions that tell of themselves on the networks of this machine, by name. Listens for `timeout_s`.

    Empty where an access point blocks broadcasts: type the address then, or scan the code of `iris-session pair`.
    """
    end = time.monotonic() + timeout_s
    with open_listener(port) as listener:
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
