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


class MediaSource:
    """May be used by several threads. `endpoint`: of `FrontProcess.media_endpoint`; fronts may come and go."""

    def __init__(self, endpoint: str) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.PUSH)
        self._socket.setsockopt(zmq.SNDHWM, WAITING)
        self._socket.setsockopt(zmq.RECONNECT_IVL, 50)
        self._socket.connect(endpoint)
        self._lock = threading.Lock()
        self.dropped = 0

    def publish(
        self, stream: str, frames: bytes | Mapping[str, bytes], capture_ns: int, scene_epoch: int, encoding: str
    ) -> bool:
        """False: dropped, the front takes nothing now. Raises `ValueError` for what no front would take."""
        message = encode_media_frames(stream, frames, capture_ns, scene_epoch, encoding)
        with self._lock:
            try:
                self._socket.send_multipart(message, zmq.DONTWAIT)
            except zmq.Again:
                self.dropped += 1
                return False
        return True

    def close(self) -> None:
        with self._lock:
            self._socket.close(linger=0)
            self._context.term()
