"""The introduction: whoever connects to the TCP port below the control port is told what the session is, once.

Nothing is read, nothing is kept: a connection is accepted, written to and closed in one go, so none can hold anything.
"""

from __future__ import annotations

import contextlib
import errno
import socket
from collections.abc import Callable, Sequence
from typing import Final, TypeVar

from iris_session.link.config import FrontError, PortInUseError
from iris_session.protocol.codec import encode_introduction
from iris_session.protocol.discovery import INTRODUCTION_OFFSET, Introduction

#: Connections answered in one turn of the loop (every 10 ms): the rest waits in the system's queue, which is bounded.
ANSWERS_PER_TICK: Final = 24
BACKLOG: Final = 256
#: Attempts at finding two free neighbouring ports.
MAX_PORT_ATTEMPTS: Final = 50
#: Larger than any introduction: what the system does not take at once is not sent.
SEND_BUFFER_BYTES: Final = 16_384
T = TypeVar("T")
Listeners = Sequence[socket.socket]


class IntroductionServer:
    """A service of the front. `introduction` gives what is said now."""

    def __init__(self, listeners: Listeners, introduction: Callable[[], Introduction]) -> None:
        self._listeners = listeners
        self._introduction = introduction

    def tick(self, now_ns: int) -> None:
        """Answers up to `ROUND` of those who wait."""
        left = ANSWERS_PER_TICK
        said = b""
        for listener in self._listeners:
            while left:
                try:
                    visitor, _ = listener.accept()
                except OSError:  # nobody waits, they hung up already, or we have no descriptor left for them
                    break
                left -= 1
                with visitor, contextlib.suppress(OSError):
                    visitor.setblocking(False)
                    said = said or encode_introduction(self._introduction())
                    visitor.send(said)

    def close(self) -> None:
        for listener in self._listeners:
            listener.close()


def open_listeners(hosts: Sequence[str], port: int) -> list[socket.socket]:
    """Listening sockets on every host, the same port; 0: any free one. Raises `FrontError`."""
    opened: list[socket.socket] = []
    try:
        for host in hosts:
            opened.append(_open_listener(host, port or (opened[0].getsockname()[1] if opened else 0)))
    except OSError as error:
        for listener in opened:
            listener.close()
        if error.errno == errno.EADDRINUSE:
            raise PortInUseError(port, "introduction") from error
        raise FrontError(f"cannot listen on {host} port {port} (introduction): {error.strerror or error}") from error
    return opened


def open_with_introduction(
    hosts: Sequence[str], control_port: int, open_control: Callable[[int], T]
) -> tuple[T, list[socket.socket]]:
    """The control socket, and the listeners of the introduction on the port below it.

    With port 0, two free neighbours are looked for. Raises `FrontError`: a port in use, an address that is not ours.
    """
    for attempt in range(MAX_PORT_ATTEMPTS):
        listeners = open_listeners(hosts, control_port + INTRODUCTION_OFFSET if control_port else 0)
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


def _open_listener(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        listener.bind((host, port))
        listener.listen(BACKLOG)
        listener.setblocking(False)
    except BaseException:
        listener.close()
        raise
    return listener
