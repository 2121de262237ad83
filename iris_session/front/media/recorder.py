"""Point clouds and pictures on their way to the recorder: of each stream the newest frame at a rate, bounded in bytes.

The recorder has a socket for them alone, with room for one frame, and a send never waits: media cost the journal
nothing. A frame that is due stays due, and is replaced by newer ones, until there is room for it; what is missing at
the chosen rate is counted by reason (`MediaScheduler.drops`) and logged once.

A message has three parts: a `MediaHeader`, the frame, and the `StreamInfo` as JSON, empty while it is as before. Class
`none` says that there is no frame; without an info, that the stream has ended, or goes on in another encoding.
"""

from __future__ import annotations

import logging
from typing import Any, Final

import msgspec
import zmq

from iris_session.front.media.scheduler import MediaScheduler, NewestFrame
from iris_session.link.sockets import MEDIA_THREAD, next_tcp_event, readable, watch_tcp
from iris_session.protocol.codec import encode_media_header
from iris_session.protocol.limits import MAX_MEDIA_FRAME_BYTES, TokenBucket
from iris_session.protocol.media import MediaHeader, StreamInfo
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

    `seq`, `info`: of the newest frame that was sent, -1 and `None` for none, in `encoding`. `due_ns`: time of the next
    one. `missing_ns`: time at which a frame that waits for room counts as missing; 0 while none waits.
    """

    __slots__ = ("due_ns", "encoding", "info", "missing_ns", "seq")

    def __init__(self, encoding: str, now_ns: int) -> None:
        self.encoding = encoding
        self.restart(now_ns)

    def restart(self, due_ns: int) -> None:
        """Begin anew: for another recorder, or after an end."""
        self.seq = -1
        self.info: StreamInfo | None = None
        self.due_ns = due_ns
        self.missing_ns = 0

    def is_new_info(self, info: StreamInfo) -> bool:
        """Return whether an info says something else, other than in its `detail`, which may count seconds."""
        known = self.info
        return known is None or (info is not known and msgspec.structs.replace(info, detail=known.detail) != known)


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
        self._read_connection_events(now_ns)
        self._end_streams(scheduler, now_ns)
        newest = scheduler.list_newest(FILE_SHARE)
        for one in newest:
            stream = self._streams.setdefault(one.stream, _Stream(one.push.encoding, now_ns))
            if stream.seq < 0:
                stream.encoding = one.push.encoding
        due = [one for one in newest if self._is_due(one, now_ns)]
        due.sort(key=lambda one: self._streams[one.stream].due_ns)
        for place, one in enumerate(due):
            reason = self._send_newest(one, now_ns)
            if reason:
                self._count_missing(scheduler, due[place:], reason, now_ns)
                return
            stream = self._streams[one.stream]
            stream.seq, stream.info, stream.missing_ns = one.seq, one.info, 0
            # A frame that is a little late does not delay those after it.
            stream.due_ns = max(stream.due_ns, now_ns - self._period_ns // 4) + self._period_ns

    def close(self) -> None:
        """Close the socket; a frame under way leaves within its linger time."""
        self._socket.disable_monitor()
        self._monitor.close(linger=0)
        self._socket.close()

    def _read_connection_events(self, now_ns: int) -> None:
        """Notice a recorder that begins a part of the file: it needs the newest frame of streams at rest, too."""
        while readable(self._monitor):
            self._connected = next_tcp_event(self._monitor)[0] == zmq.EVENT_HANDSHAKE_SUCCEEDED
            if self._connected:
                for stream in self._streams.values():
                    stream.restart(now_ns)

    def _end_streams(self, scheduler: MediaScheduler, now_ns: int) -> None:
        """Tell the recorder of ended streams as soon as there is room. One that comes again keeps the rate."""
        for name, stream in list(self._streams.items()):
            if scheduler.has_stream(name, stream.encoding):
                continue
            header = MediaHeader(name, BudgetClass.NONE, 0, 0, now_ns, now_ns, stream.encoding, received_ns=now_ns)
            if stream.seq >= 0 and self._send(header, b"", b""):
                stream.restart(stream.due_ns)
            if stream.seq < 0 and now_ns >= stream.due_ns:
                del self._streams[name]

    def _is_due(self, one: NewestFrame, now_ns: int) -> bool:
        stream = self._streams[one.stream]
        if one.push.encoding != stream.encoding:  # the recorder does not know of the end yet
            return False
        return now_ns >= stream.due_ns and (one.seq != stream.seq or stream.is_new_info(one.info))

    def _send_newest(self, one: NewestFrame, now_ns: int) -> str:
        """Send a frame, or the info alone. Return the drop reason if there is no room for it, else an empty string."""
        stream, push = self._streams[one.stream], one.push
        has_frame = one.seq != stream.seq
        if not self._has_room():
            return NOT_READ
        if has_frame and not self._bucket.take(now_ns, FILE_SHARE[push.encoding] * len(one.frame)):
            return BYTES_SHARE
        header = MediaHeader(
            one.stream,
            BudgetClass.FULL if has_frame else BudgetClass.NONE,
            push.scene_epoch,
            one.seq,
            push.capture_ns if has_frame else now_ns,
            now_ns,
            push.encoding,
            sent_ns=push.sent_ns,
            received_ns=one.received_ns if has_frame else now_ns,
        )
        info = msgspec.json.encode(one.info) if stream.is_new_info(one.info) else b""
        return "" if self._send(header, one.frame if has_frame else b"", info) else NOT_READ

    def _has_room(self) -> bool:
        return self._connected and bool(int(self._socket.get(zmq.EVENTS)) & zmq.POLLOUT)

    def _send(self, header: MediaHeader, frame: Any, info: bytes) -> bool:
        if not self._has_room():
            return False
        try:
            self._socket.send_multipart((encode_media_header(header), frame, info), zmq.DONTWAIT, copy=False)
        except zmq.Again:
            return False
        return True

    def _count_missing(self, scheduler: MediaScheduler, waiting: list[NewestFrame], reason: str, now_ns: int) -> None:
        """Count the frames that the recording lacks at its rate: one for every period that a stream waits for room."""
        for one in waiting:
            stream = self._streams[one.stream]
            if one.seq == stream.seq:  # only its info waits
                continue
            stream.missing_ns = stream.missing_ns or now_ns + self._period_ns
            while now_ns >= stream.missing_ns:
                stream.missing_ns += self._period_ns
                scheduler.count_drop(reason)
                if reason not in self._logged:
                    self._logged.add(reason)
                    log.warning("frames of %r are missing in the recording: %s", one.stream, _ADVICE[reason])
