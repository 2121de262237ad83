"""Handing in media from a process of this machine: the authority, a camera. Never waits."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Final

import zmq

from iris_session.protocol.codec import encode_media_frames
from iris_session.protocol.media import MAX_STREAMS

#: Frames on their way to the front, one of every stream; while it does not take them, new ones are dropped and counted.
WAITING: Final = MAX_STREAMS
#: And bytes, of all streams: one of the largest frames in all its classes (24 MiB), and some smaller ones.
WAITING_BYTES: Final = 32 * 1024 * 1024


class MediaSource:
    """May be used by several threads, also while it is closed by one of them. `endpoint`: of
    `FrontProcess.media_endpoint`; fronts may come and go. Opens nothing before the first frame.

    Large frames are not copied, which would take a tick loop milliseconds: libzmq's thread reads them, and says when
    it has done so.
    """

    def __init__(self, endpoint: str) -> None:
        self._endpoint = endpoint
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._socket: zmq.Socket[bytes] | None = None
        self._lock = threading.Lock()
        self._closed = False
        self._under_way: list[tuple[zmq.MessageTracker, int]] = []  # what libzmq still reads, and how long it is
        self.dropped = 0

    @property
    def waiting(self) -> int:
        """Bytes that libzmq has not handed on yet, of frames that were too large to be copied."""
        with self._lock:
            return self._waiting()

    def publish(
        self, stream: str, frames: bytes | Mapping[str, bytes], capture_ns: int, scene_epoch: int, encoding: str
    ) -> bool:
        """False: dropped, the front takes nothing now, or it is closed. Raises `ValueError` for what no front would
        take."""
        message = encode_media_frames(stream, frames, capture_ns, scene_epoch, encoding)
        with self._lock:
            try:
                if self._send(message):
                    return True
            except zmq.Again:
                pass
            self.dropped += 1
            return False

    def _send(self, message: list[bytes]) -> bool:
        socket, waiting = self._open(), self._waiting()
        if socket is None or (waiting and waiting + sum(map(len, message)) > WAITING_BYTES):
            return False
        # What could be changed while it is read (a bytearray) is copied.
        parts = [zmq.Frame(bytes(part), track=True, copy=None) for part in message]
        socket.send_multipart(parts, zmq.DONTWAIT, copy=False)
        self._under_way += [(part.tracker, len(part)) for part in parts if part.tracker is not None]
        return True

    def _waiting(self) -> int:
        self._under_way = [(tracker, size) for tracker, size in self._under_way if not tracker.done]
        return sum(size for _, size in self._under_way)

    def _open(self) -> zmq.Socket[bytes] | None:
        if self._socket is None and not self._closed:
            self._context = zmq.Context()
            self._socket = self._context.socket(zmq.PUSH)
            self._socket.setsockopt(zmq.SNDHWM, WAITING)
            self._socket.setsockopt(zmq.RECONNECT_IVL, 50)
            self._socket.connect(self._endpoint)
        return self._socket

    def close(self) -> None:
        """May be called twice."""
        with self._lock:
            self._closed = True
            context, socket, self._context, self._socket = self._context, self._socket, None, None
        if socket is not None and context is not None:
            socket.close(linger=0)
            context.term()
