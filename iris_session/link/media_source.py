"""`MediaSource`: publish media from a process of this machine, such as the authority or a camera. Never waits."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Final

import zmq

from iris_session.protocol.codec import encode_media_frames
from iris_session.protocol.media import MAX_STREAMS, StreamInfo

#: Frames queued for the front, one of every stream; when the queue is full new frames are dropped and counted.
WAITING: Final = MAX_STREAMS
#: Bytes queued, of all streams: one of the largest frames in all its classes (24 MiB), and some smaller ones.
WAITING_BYTES: Final = 32 * 1024 * 1024


class MediaSource:
    """Socket that publishes media frames to the front. Opens nothing before the first frame.

    Several threads may use it, also while one of them closes it. The front may be restarted meanwhile.

    Large frames are not copied, which would take a tick loop milliseconds: libzmq's thread reads them in place and
    reports when it is done.

    Args:
        endpoint: `FrontProcess.media_endpoint`.

    Attributes:
        dropped: Number of frames dropped.
    """

    def __init__(self, endpoint: str) -> None:
        self._endpoint = endpoint
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._socket: zmq.Socket[bytes] | None = None
        self._lock = threading.Lock()
        self._closed = False
        self._under_way: list[tuple[zmq.MessageTracker, int]] = []  # frames that libzmq still reads, with their length
        self.dropped = 0

    @property
    def waiting(self) -> int:
        """Bytes that libzmq has not sent yet, of frames that were too large to be copied."""
        with self._lock:
            return self._waiting()

    def publish(
        self,
        stream: str,
        frames: bytes | Mapping[str, bytes],
        capture_ns: int,
        scene_epoch: int,
        encoding: str,
        *,
        info: StreamInfo | None = None,
        sent_ns: int = 0,
    ) -> bool:
        """Send one frame to the front.

        Args:
            stream: Name of the stream.
            frames: Bytes of the frame, or bytes by class.
            capture_ns: Session time of the capture [ns].
            scene_epoch: Scene epoch to which the frame belongs.
            encoding: Format of the bytes.
            info: Description of the stream; `None`: as before.
            sent_ns: Session time of this call [ns], 0 for not known.

        Returns:
            False when the frame is dropped: the queue is full, or the source is closed.

        Raises:
            ValueError: The front would reject the frame: a wrong name or class, or too many bytes.
        """
        message = encode_media_frames(stream, frames, capture_ns, scene_epoch, encoding, info=info, sent_ns=sent_ns)
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
        # `bytes()` copies only mutable data (a bytearray), which could change while libzmq reads it.
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
        """Close the socket and drop queued frames. May be called twice."""
        with self._lock:
            self._closed = True
            context, socket, self._context, self._socket = self._context, self._socket, None, None
        if socket is not None and context is not None:
            socket.close(linger=0)
            context.term()
