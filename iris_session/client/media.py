"""`client.media`: the newest frame of every subscribed stream, and frames published in role `camera` or `source`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping

from iris_session.client.core.arrival_meter import ArrivalMeter
from iris_session.client.core.connection import ClientConnection
from iris_session.client.errors import InvalidMessageError, NotConnectedError
from iris_session.client.feeds import CloudFeed, MediaFeed, MediaFrame
from iris_session.client.sockets import ClientSockets
from iris_session.protocol.codec import decode_media_header, encode_media_frames
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.media import StreamInfo, describe_bad_stream_name, is_stream_name, make_topic
from iris_session.protocol.names import MediaEncoding
from iris_session.protocol.status import DeliveryBudget


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
