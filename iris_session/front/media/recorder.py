"""Point clouds and pictures on their way to the recorder: of each stream the newest frame at a rate, bounded in bytes.

The recorder has a socket for them alone, with room for one frame, and a send never waits: media cost the journal
nothing. A frame that is due stays due, and is replaced by newer ones, until there is room for it; what is missing at
the chosen rate is counted by reason (`MediaScheduler.drops`) and logged once.
"""

from __future__ import annotations

import logging
from typing import Final

import zmq

from iris_session.front.media.scheduler import MediaScheduler, NewestFrame
from iris_session.link.sockets import MEDIA_THREAD, next_tcp_event, readable, watch_tcp
from iris_session.protocol.codec import encode_media_header
from iris_session.protocol.limits import MAX_MEDIA_FRAME_BYTES, TokenBucket
from iris_session.protocol.media import MediaHeader
from iris_session.protocol.names import BudgetClass, MediaEncoding

log = logging.getLogger(__name__)

#: Bytes of the file per byte of a frame, by the encodings that are recorded: the file has float32 and whole bytes for
#: points, which `encode_cloud` puts into 8 bytes.
FILE_SHARE: Final = {MediaEncoding.CLOUD: 2, MediaEncoding.JPEG: 1}
#: Bytes per second of the file for all streams: 120,000 points at 2 Hz.
BYTES_PER_S: Final = 4_000_000
#: The largest frame passes after a pause.
BURST_BYTES: Final = max(FILE_SHARE.values()) * MAX_MEDIA_FRAME_BYTES
SECOND: Final = 1_000_000_000
#: Drop reasons: above `BYTES_PER_S`; the recorder has not taken the frame before.
BYTES_SHARE: Final = "media_record_share"
NOT_READ: Final = "media_record_queue_full"
_ADVICE: Final = {
    BYTES_SHARE: "above 4 MB/s of all streams; record fewer points, or at a lower rate (--record-clouds)",
    NOT_READ: "the recorder, or its disk, has no time for them",
}


class _Stream:
    """Progress of one stream.

    `seq`: of the newest frame that was sent, -1 for none. `due_ns`: time of the next one. `missing_ns`: time at which a
    frame that waits for room counts as missing; 0 while none waits.
    """

    __slots__ = ("due_ns", "missing_ns", "seq")

    def __init__(self, now_ns: int) -> None:
        self.seq = -1
        self.due_ns = now_ns
        self.missing_ns = 0


class MediaRecorder:
    """Send the recorder the newest frames. Belongs to the thread of the proxy.

    Args:
        context: Of the front.
        endpoint: Where the recorder listens for media.
        hz: Frames per second of each stream.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, hz: float) -> None:
        self._period_ns = round(SECOND / hz)
        self._bucket = TokenBucket(BYTES_PER_S, BURST_BYTES)
        self._streams: dict[str, _Stream] = {}
        self._logged: set[str] = set()
        self._connected = False
        self._socket = context.socket(zmq.PUSH)
        self._socket.setsockopt(zmq.AFFINITY, MEDIA_THREAD)
        self._socket.setsockopt(zmq.SNDHWM, 1)
        self._socket.setsockopt(zmq.LINGER, 200)
        self._socket.setsockopt(zmq.IMMEDIATE, 1)  # nothing is queued for a recorder that has ended
        self._socket.setsockopt(zmq.RECONNECT_IVL, 50)
        events = zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED
        self._monitor = watch_tcp(self._socket, "recorder", events)
        self._socket.connect(endpoint)

    def tick(self, scheduler: MediaScheduler, now_ns: int) -> None:
        """Send the frames that are due, as far as there is room, the one that waits for longest first."""
        self._read_connection_events()
        newest = scheduler.list_newest(FILE_SHARE)
        self._streams = {one.stream: self._streams.get(one.stream) or _Stream(now_ns) for one in newest}
        due = [one for one in newest if self._is_due(one, now_ns)]
        due.sort(key=lambda one: self._streams[one.stream].due_ns)
        for place, one in enumerate(due):
            reason = self._send(one, now_ns)
            if reason:
                self._count_missing(scheduler, due[place:], reason, now_ns)
                return
            stream = self._streams[one.stream]
            stream.seq, stream.missing_ns = one.seq, 0
            # A frame that is a little late does not delay those after it.
            stream.due_ns = max(stream.due_ns, now_ns - self._period_ns // 4) + self._period_ns

    def close(self) -> None:
        """Close the socket; a frame under way leaves within its linger time."""
        self._socket.disable_monitor()
        self._monitor.close(linger=0)
        self._socket.close()

    def _read_connection_events(self) -> None:
        """Notice a recorder that begins a part of the file: it needs the newest frame of streams at rest, too."""
        while readable(self._monitor):
            self._connected = next_tcp_event(self._monitor)[0] == zmq.EVENT_HANDSHAKE_SUCCEEDED
            if self._connected:
                self._streams.clear()

    def _is_due(self, one: NewestFrame, now_ns: int) -> bool:
        stream = self._streams[one.stream]
        return one.seq != stream.seq and now_ns >= stream.due_ns

    def _send(self, one: NewestFrame, now_ns: int) -> str:
        """Send a frame. Return the drop reason if there is no room for it, else an empty string."""
        if not self._connected or not int(self._socket.get(zmq.EVENTS)) & zmq.POLLOUT:
            return NOT_READ
        push = one.push
        if not self._bucket.take(now_ns, FILE_SHARE[push.encoding] * len(one.frame)):
            return BYTES_SHARE
        header = MediaHeader(
            one.stream,
            BudgetClass.FULL,
            push.scene_epoch,
            one.seq,
            push.capture_ns,
            now_ns,
            push.encoding,
            sent_ns=push.sent_ns,
            received_ns=one.received_ns,
        )
        try:
            self._socket.send_multipart((encode_media_header(header), one.frame), zmq.DONTWAIT, copy=False)
        except zmq.Again:
            return NOT_READ
        return ""

    def _count_missing(self, scheduler: MediaScheduler, waiting: list[NewestFrame], reason: str, now_ns: int) -> None:
        """Count the frames that the recording lacks at its rate: one for every period that a stream waits for room."""
        for one in waiting:
            stream = self._streams[one.stream]
            stream.missing_ns = stream.missing_ns or now_ns + self._period_ns
            while now_ns >= stream.missing_ns:
                stream.missing_ns += self._period_ns
                scheduler.count_drop(reason)
                if reason not in self._logged:
                    self._logged.add(reason)
                    log.warning("frames of %r are missing in the recording: %s", one.stream, _ADVICE[reason])
