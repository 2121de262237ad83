"""`client.media`: the newest frame of every subscribed stream, and frames published in role `camera` or `source`.

room = client.media.cloud("room")
while True:
    client.poll(0.01)
    cloud = room.poll()
    if cloud is not None:
        draw(cloud.positions, cloud.colors)  # p_world (n, 3) [m]; (n, 4)
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from iris_session.client.core.arrival_meter import ArrivalMeter
from iris_session.client.core.connection import ClientConnection
from iris_session.client.errors import InvalidMessageError, NotConnectedError
from iris_session.client.sockets import ClientSockets
from iris_session.protocol.codec import decode_media_header, encode_media_frames
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.media import MediaHeader, StreamInfo, describe_bad_stream_name, is_stream_name, make_topic
from iris_session.protocol.names import BudgetClass, MediaEncoding
from iris_session.protocol.status import DeliveryBudget
from iris_session.streams.cloud import Bytes, CloudFrame, Floats, decode_cloud
from iris_session.streams.errors import StreamError


@dataclass(frozen=True, slots=True)
class MediaFrame:
    """One frame. `age_ns`: from its capture until it was passed to the application [ns], by the estimated clock."""

    header: MediaHeader
    data: bytes
    age_ns: int


@dataclass(slots=True)
class MediaFeed:
    """One subscribed stream.

    Attributes:
        stream: Its name.
        newest: The newest frame, `None` before the first.
        budget_class: The class in which the session delivers it to us.
        received: Frames that came.
        superseded: Of those, frames that came together with a newer one.
        dropped: Frames that the session had for us and our link did not take in time, since this connection began.
    """

    stream: str
    newest: MediaFrame | None = None
    budget_class: str = BudgetClass.FULL
    received: int = 0
    superseded: int = 0
    dropped: int = 0
    _popped: MediaFrame | None = field(default=None, repr=False)

    def pop_newest(self) -> MediaFrame | None:
        """Return the newest frame once: `None` until there is another."""
        if self.newest is self._popped:
            return None
        self._popped = self.newest
        return self.newest


class CloudTimes(NamedTuple):
    """Times of one cloud, session time [ns]: as every process on its way knows it, by its own estimate of that clock.

    Attributes:
        capture_ns: The camera measured it, as its source says.
        sent_ns: Its source passed it to a socket, as it says; 0: not known.
        received_ns: The session received it; 0: not known.
        published_ns: The session passed it to the socket of this client.
        arrived_ns: This client received it.
        decoded_ns: Its points were decoded.
    """

    capture_ns: int
    sent_ns: int
    received_ns: int
    published_ns: int
    arrived_ns: int
    decoded_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class ReceivedCloud:
    """One decoded cloud.

    Attributes:
        positions: (n, 3) [m], world frame.
        colors: (n, 4) red, green, blue, and 255.
        error_m: Where a point is stated to be within, 95 % of the time [m]; infinite where that is not known.
        voxel_m: Edge of the cell that a point stands for [m]; 0 where it stands for itself.
        header: Number, class and scene epoch of its frame.
        times: When it was where.
    """

    positions: Floats
    colors: Bytes
    error_m: float
    voxel_m: float
    header: MediaHeader
    times: CloudTimes

    @property
    def age_ns(self) -> int:
        """Time from its capture until it was decoded [ns]."""
        return self.times.decoded_ns - self.times.capture_ns


class CloudFeed:
    """Newest cloud of one stream. Frames are decoded when you ask for them, in your thread; use it from one thread.

    Attributes:
        feed: The subscription: its class, and the frames that came and that were dropped on the way.
        decoded: Number of clouds that were decoded.
        undecodable: Number of frames that are no cloud.
        fault: Why the newest frame is no cloud; empty if it is one.
    """

    def __init__(self, feed: MediaFeed, session_now_ns: Callable[[], int]) -> None:
        self.feed = feed
        self.decoded = 0
        self.undecodable = 0
        self.fault = ""
        self._session_now_ns = session_now_ns
        self._looked_at: MediaFrame | None = None
        self._newest: ReceivedCloud | None = None
        self._polled: ReceivedCloud | None = None

    @property
    def newest(self) -> ReceivedCloud | None:
        """The newest cloud, `None` before the first. A frame that is no cloud leaves the one before."""
        frame = self.feed.newest
        if frame is not None and frame is not self._looked_at:
            self._looked_at = frame
            self._decode(frame)
        return self._newest

    @property
    def skipped(self) -> int:
        """Number of frames that came and were replaced by newer ones before they were decoded."""
        pending = self.feed.newest is not self._looked_at
        return max(0, self.feed.received - self.decoded - self.undecodable - pending)

    @property
    def age_ns(self) -> int | None:
        """Time since the capture of the newest cloud [ns], `None` before the first."""
        newest = self.newest
        return None if newest is None else self._session_now_ns() - newest.times.capture_ns

    def poll(self) -> ReceivedCloud | None:
        """Return the newest cloud once: `None` until there is another."""
        newest = self.newest
        if newest is self._polled:
            return None
        self._polled = newest
        return newest

    def _decode(self, frame: MediaFrame) -> None:
        header = frame.header
        try:
            cloud = _decode_frame(frame)
        except StreamError as error:
            self.undecodable += 1
            self.fault = str(error)
            return
        self.decoded += 1
        self.fault = ""
        times = CloudTimes(
            header.capture_ns,
            header.sent_ns,
            header.received_ns,
            header.published_ns,
            header.capture_ns + frame.age_ns,
            self._session_now_ns(),
        )
        self._newest = ReceivedCloud(*cloud, header, times)


def _decode_frame(frame: MediaFrame) -> CloudFrame:
    """Return the points of a frame. Raises `StreamError`."""
    header = frame.header
    if header.encoding != MediaEncoding.CLOUD:
        raise StreamError(f"stream {header.stream!r} has encoding {header.encoding!r}: 'cloud' is expected")
    return decode_cloud(frame.data)


# --- the media of a client --------------------------------------------------------------------------------------------


class ClientMedia:
    """Media streams of a client.

    Attributes:
        limit_mbit_per_s: Largest rate of media that this client accepts [Mbit/s], 0 for no limit of its own.
        malformed: Media messages that do not fit the protocol.
        late: Frames of a stream that came after its subscription ended.
    """

    def __init__(
        self,
        connection: ClientConnection,
        sockets: ClientSockets,
        lock: threading.RLock,
        may_use_sockets: Callable[[], bool],
        arrivals: ArrivalMeter,
    ) -> None:
        self.limit_mbit_per_s = 0.0
        self.malformed = 0
        self.late = 0
        self._connection = connection
        self._sockets = sockets
        self._lock = lock
        self._may_use_sockets = may_use_sockets
        self._arrivals = arrivals
        self._feeds: dict[str, MediaFeed] = {}
        self._clouds: dict[str, CloudFeed] = {}
        self._generation = -1
        self._subscribed: set[str] = set()

    def subscribe(self, stream: str) -> MediaFeed:
        """Subscribe to a media stream; one that does not exist yet comes when it does.

        Args:
            stream: Name of the stream.

        Returns:
            The feed; the same one for the same name.

        Raises:
            InvalidMessageError: `stream` cannot be the name of a stream.
        """
        _check_name(stream)
        with self._lock:
            if stream not in self._feeds:
                self._feeds[stream] = MediaFeed(stream)
                self._subscribe_soon()
            return self._feeds[stream]

    def cloud(self, stream: str) -> CloudFeed:
        """Subscribe to a media stream of point clouds, and decode them.

        Args:
            stream: Name of the stream; one that does not exist yet comes when it does.

        Returns:
            The newest cloud with its age, and counters; the same object for the same name. It ends with `unsubscribe`.

        Raises:
            InvalidMessageError: `stream` cannot be the name of a stream.
        """
        with self._lock:
            feed = self.subscribe(stream)
            if stream not in self._clouds:
                self._clouds[stream] = CloudFeed(feed, self._session_now_ns)
            return self._clouds[stream]

    def unsubscribe(self, stream: str) -> None:
        """End a subscription.

        Args:
            stream: Name of the stream; one that is not subscribed to is ignored.
        """
        with self._lock:
            self._clouds.pop(stream, None)
            if self._feeds.pop(stream, None) is not None:
                self._subscribe_soon()

    @property
    def delivery(self) -> DeliveryBudget | None:
        """Class in which the session delivers each stream to us, and the reason; `None` until it has reported."""
        budget = self._connection.latest.get(DeliveryBudget)
        return budget if isinstance(budget, DeliveryBudget) else None

    def publish(
        self,
        stream: str,
        frames: bytes | Mapping[str, bytes],
        *,
        capture_ns: int | None = None,
        encoding: str = MediaEncoding.BYTES,
        info: StreamInfo | None = None,
    ) -> bool:
        """Publish a frame of a stream, in role `camera` or `source`.

        Publish that of a stream at rest again at least every 10 s: a session may have lost it. A stream has one source:
        what you publish under the name of another one's is refused, and `taken_by` of it in `delivery` names that one.

        Args:
            stream: Name of the stream.
            frames: Bytes of the frame, or of each of its levels by name; see `Session.publish_media`.
            capture_ns: Session time of capture [ns], default now.
            encoding: A `MediaEncoding`.
            info: Description of the stream; see `Session.publish_media`.

        Returns:
            False: the link takes nothing now, the frame is dropped.

        Raises:
            InvalidMessageError: A value does not fit the protocol.
            NotConnectedError: There is no connection.
        """
        welcome = self._connection.welcome
        if welcome is None or not self._connection.is_joined:
            raise NotConnectedError(self._connection.describe())
        now_ns = self._session_now_ns()
        capture_ns, epoch = now_ns if capture_ns is None else capture_ns, self._connection.mirror.scene_epoch
        number = welcome.connection_epoch
        try:
            message = encode_media_frames(
                stream, frames, capture_ns, epoch, encoding, info=info, sent_ns=now_ns, connection_epoch=number
            )
        except ValueError as error:
            raise InvalidMessageError(str(error)) from None
        with self._lock:
            return self._sockets.send_media(welcome.endpoints.media_ingest, stream, message)

    # --- for the client, which holds the lock ----------------------------------------------------------------------

    def poll(self) -> bool:
        """Subscribe anew with every connection, once the session has reported our budget, and take what has come.

        Returns:
            True when frames came.
        """
        if self._generation != self._connection.generation:
            self._generation = self._connection.generation
            self._sockets.close_media()
            self._connection.latest.pop(DeliveryBudget, None)
        budget = self.delivery
        if budget is None or not self._connection.is_joined:
            return False
        classes = {one.stream: one.budget_class for one in budget.streams}
        for feed in self._feeds.values():
            feed.budget_class = classes.get(feed.stream, budget.budget_class)
        self._subscribe()
        return self._drain()

    def _session_now_ns(self) -> int:
        return self._connection.clock.session_ns(time.monotonic_ns())

    def _subscribe_soon(self) -> None:
        """Subscribe here, or wake the thread that polls: no two threads may use a socket."""
        if self._may_use_sockets():
            self._subscribe()
        else:
            self._sockets.wake()

    def _subscribe(self) -> None:
        """Subscribe to the feeds, and to nothing else.

        The session has to report our budget first: only then it knows whose subscription it is.
        """
        welcome = self._connection.welcome
        if self.delivery is None or welcome is None or self._generation != self._connection.generation:
            return
        if not self._sockets.has_media:
            self._subscribed.clear()
        for stream in self._subscribed - self._feeds.keys():
            self._sockets.unsubscribe_media(make_topic(self._connection.connection_epoch, stream))
        new = [stream for stream in self._feeds if stream not in self._subscribed]
        if new:
            topics = [make_topic(self._connection.connection_epoch, stream) for stream in new]
            self._sockets.subscribe_media(welcome.endpoints.media, topics)
        self._subscribed = set(self._feeds)

    def _drain(self) -> bool:
        messages = self._sockets.drain_media()
        seen: set[str] = set()
        for frames in messages:
            try:
                _, head, data = frames
                header = decode_media_header(head)
            except (ProtocolError, ValueError):
                self.malformed += 1
                continue
            feed = self._feeds.get(header.stream)
            if feed is None:  # it was on its way when the subscription ended
                self.late += 1
                continue
            feed.superseded += feed.stream in seen
            seen.add(feed.stream)
            feed.received += 1
            feed.dropped = header.dropped
            feed.newest = MediaFrame(header, data, self._session_now_ns() - header.capture_ns)
            self._arrivals.record_media(sum(map(len, frames)), feed.newest.age_ns)
        return bool(messages)


def _check_name(stream: str) -> None:
    if not is_stream_name(stream):
        raise InvalidMessageError(describe_bad_stream_name(stream))
