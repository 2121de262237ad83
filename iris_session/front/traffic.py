"""How much waits in libzmq for and from each TCP connection: it cannot be asked for, but it can be counted.

What was handed to libzmq, less what the other end has acknowledged to the system, waits to be sent; what the system has
received, less what was taken, waits to be read. Both are a little off by handshakes, which is all the same to whoever
looks for megabytes.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from iris_session.link.sockets import tcp_counts

#: ZMTP 3: flags and length before a frame, the length in one byte or eight.
_SHORT: Final = 255
_SHORT_HEADER: Final = 2
_LONG_HEADER: Final = 9
#: CurveZMQ: name of the command, nonce, authenticator and flags around every frame.
_CURVE: Final = 8 + 8 + 16 + 1


class Traffic:
    """Of the control socket. `curve`: whether it is encrypted."""

    def __init__(self, *, curve: bool = False) -> None:
        self._around = _CURVE if curve else 0
        self._handed: dict[int, int] = {}
        self._taken: dict[int, int] = {}

    def begin(self, descriptor: int) -> None:
        """A TCP connection was opened, or closed: its descriptor is, or will be, another's."""
        self._handed.pop(descriptor, None)
        self._taken.pop(descriptor, None)

    def handed(self, descriptor: int, frames: Iterable[bytes]) -> None:
        """A message was given to libzmq for that connection."""
        self._handed[descriptor] = self._handed.get(descriptor, 0) + sum(self._on_wire(len(one)) for one in frames)

    def taken(self, descriptor: int, length: int) -> None:
        """A frame of that connection was received from libzmq."""
        self._taken[descriptor] = self._taken.get(descriptor, 0) + self._on_wire(length)

    def held(self, descriptor: int) -> int:
        """Bytes that wait, both ways; 0 where the system does not count."""
        counts = tcp_counts(descriptor)
        if counts is None:
            return 0
        to_send = self._handed.get(descriptor, 0) - counts.acknowledged
        to_read = counts.received - self._taken.get(descriptor, 0)
        return max(0, to_send) + max(0, to_read)

    def _on_wire(self, length: int) -> int:
        length += self._around
        return length + (_SHORT_HEADER if length <= _SHORT else _LONG_HEADER)
