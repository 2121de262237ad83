"""ZeroMQ sockets in an asyncio loop, and counts of TCP connections: bytes that wait, bytes that were acknowledged."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import sys
from collections.abc import Callable, Sequence
from typing import Final

import zmq

from iris_session.link.sockets import readable, tcp_counts

if sys.platform == "linux":
    import fcntl
    import termios

#: Messages handled before other tasks of the loop run.
ROUND: Final = 64
_NOBLOCK: Final = int(zmq.NOBLOCK)
_EVENTS, _POLLIN, _POLLOUT = int(zmq.EVENTS), int(zmq.POLLIN), int(zmq.POLLOUT)
#: Bytes of a connection that are read before others have their turn: 4 ms of the handshake messages of TLS.
READ_BYTES: Final = 16_384
#: Unsent bytes that the system takes of one connection; more stays with us, where the newest value replaces the last.
NOT_SENT_BYTES: Final = 16_384
_TCP_NOTSENT_LOWAT: Final = 25  # linux/tcp.h


class SocketReader:
    """Read a ZeroMQ socket in the running asyncio loop, and write to it without waiting.

    Args:
        sock: The socket; closed by `close`.
        on_message: Called with the frames of each message, in order.
        on_drained: Called after a round of messages.
        batch: Messages at a time; with 1, `pause` in `on_message` leaves the next one unread.
        on_room: Called when there is room to send.
    """

    def __init__(
        self,
        sock: zmq.Socket[bytes],
        on_message: Callable[[list[zmq.Frame]], None],
        on_drained: Callable[[], None] | None = None,
        batch: int = ROUND,
        on_room: Callable[[], None] | None = None,
    ) -> None:
        self.socket = sock
        self._on_message = on_message
        self._on_drained = on_drained
        self._batch = batch
        self._on_room = on_room
        self._paused = False
        self._scheduled = False
        self._loop = asyncio.get_running_loop()
        self._descriptor = int(sock.getsockopt(zmq.FD))
        self._loop.add_reader(self._descriptor, self._read)
        self._schedule()

    def send(self, frames: Sequence[bytes]) -> bool:
        """Send a message. False: there is no room."""
        try:
            self.socket.send_multipart(frames, _NOBLOCK, copy=True)
        except zmq.ZMQError:
            return False
        finally:
            self._schedule()  # sending may use up the signal that a message has come
        return True

    def pause(self) -> None:
        """Leave messages in the socket."""
        self._paused = True

    def resume(self) -> None:
        """Read on."""
        self._paused = False
        self._schedule()

    def close(self) -> None:
        """Close the socket. May be called twice."""
        if not self.socket.closed:
            self._loop.remove_reader(self._descriptor)
            self.socket.close(linger=0)

    def _schedule(self) -> None:
        if not self._scheduled:
            self._scheduled = True
            self._loop.call_soon(self._read_scheduled)

    def _read_scheduled(self) -> None:
        self._scheduled = False
        self._read()

    def _read(self) -> None:
        n = 0
        while not self._paused and not self.socket.closed and readable(self.socket):
            if n >= self._batch:
                self._schedule()
                break
            n += 1
            self._on_message(self.socket.recv_multipart(_NOBLOCK, copy=False))
        if n and self._on_drained is not None and not self.socket.closed:
            self._on_drained()
        if self._on_room is not None and not self.socket.closed:
            events = int(self.socket.get(_EVENTS))  # which uses up the signal that a message has come, too
            if events & _POLLIN:
                self._schedule()
            if events & _POLLOUT:
                self._on_room()


class MeteredSocket(socket.socket):
    """A TCP connection that reports how much asyncio receives on it, before TLS and HTTP read it.

    Args:
        sock: The connection, whose descriptor is taken over.

    Attributes:
        take: Returns whether so many bytes may come; else the connection ends.
    """

    def __init__(self, sock: socket.socket) -> None:
        super().__init__(sock.family, sock.type, sock.proto, sock.detach())
        self.take: Callable[[int], bool] = bool

    def recv(self, bufsize: int, flags: int = 0, /) -> bytes:
        data = super().recv(min(bufsize, READ_BYTES), flags)
        if not flags & socket.MSG_PEEK:
            self._count(len(data))
        return data

    def recv_into(self, buffer: bytearray | memoryview, nbytes: int = 0, flags: int = 0, /) -> int:  # type: ignore[override]
        n_bytes = super().recv_into(memoryview(buffer)[:READ_BYTES], nbytes, flags)
        self._count(n_bytes)
        return n_bytes

    def _count(self, n_bytes: int) -> None:
        if n_bytes and not self.take(n_bytes):
            raise ConnectionAbortedError


def limit_unsent(sock: socket.socket) -> None:
    """Let the system take few unsent bytes of a connection, so that newer values replace what is not sent yet."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.IPPROTO_TCP, _TCP_NOTSENT_LOWAT, NOT_SENT_BYTES)


def count_unacknowledged(descriptor: int) -> int:
    """Return the bytes of a connection that the peer has not acknowledged; 0 where the system does not report them."""
    if sys.platform != "linux" or descriptor < 0:
        return 0
    try:
        answer = fcntl.ioctl(descriptor, termios.TIOCOUTQ, b"\0\0\0\0")
    except OSError:
        return 0
    return int(struct.unpack("i", answer)[0])


def count_acknowledged(descriptor: int) -> int:
    """Return the bytes that the peer has acknowledged so far; -1 where the system does not count them."""
    counts = tcp_counts(descriptor) if descriptor >= 0 else None
    return -1 if counts is None else counts.acknowledged
