"""Media of a client: the newest frame of every stream that it asked for, and handing in frames of its own."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from iris_session.client.connection import Connection
from iris_session.client.errors import InvalidMessageError, NotConnectedError
from iris_session.client.reporting import PERIOD_NS
from iris_session.client.sockets import ClientSockets
from iris_session.protocol.codec import decode_media_header, encode_media_frames
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.media import MediaHeader, describe_bad_stream_name, is_stream_name, make_topic
from iris_session.protocol.names import BudgetClass, MediaEncoding
from iris_session.protocol.status import ClientReport, DeliveryBudget, compute_quantiles

#: Ages of frames that are remembered between two reports: more than come in a second.
MAX_AGES: Final = 256


@dataclass(frozen=True, slots=True)
class MediaFrame:
    """One frame. `age_ns`: from its capture until it was handed to the application."""

    header: MediaHeader
    data: bytes
    age_ns: int


@dataclass(slots=True)
class MediaFeed:
    """One stream. `newest`: the newest frame, None before the first. `budget_class`: what the session gives us of it.

    Frames are `received`; of those, `superseded` were there together with a newer one. `dropped`: those that the
    session had for us and our link did not take in time, since this connection began.
    """

    stream: str
    newest: MediaFrame | None = None
    budget_class: str = BudgetClass.FULL
    received: int = 0
    superseded: int = 0
    dropped: int = 0
    _taken: MediaFrame | None = field(default=None, repr=False)

    def take(self) -> MediaFrame | None:
        """The newest frame, once: None until there is another."""
        if self.newest is self._taken:
            return None
        self._taken = self.newest
        return self.newest


class Media:
    """Part of `Client`."""

    connection: Connection
    _sockets: ClientSockets
    _lock: threading.RLock
    #: We want no more media than this, 0 for no limit of our own.
    media_limit_mbit_per_s: float = 0.0

    @abstractmethod
    def session_now_ns(self) -> int: ...

    @property
    @abstractmethod
    def _polls_here(self) -> bool: ...

    def _init_media(self) -> None:
        self._feeds: dict[str, MediaFeed] = {}
        self._media_generation = -1
        self._subscribed: set[str] = set()
        self._media_bytes = 0
        self._media_ages: list[int] = []
        self._media_since_ns = 0
        #: Media messages that do not fit the protocol; and frames of a stream that was dropped before they came.
        self.media_malformed = 0
        self.media_late = 0

    def media(self, stream: str) -> MediaFeed:
        """Subscribes to a media stream; one that is not there yet comes when it is. The same feed for the same name.

        Raises `InvalidMessageError` for what cannot be the name of a stream.
        """
        _check_name(stream)
        with self._lock:
            if stream not in self._feeds:
                self._feeds[stream] = MediaFeed(stream)
                self._subscribe_soon()
            return self._feeds[stream]

    def drop_media(self, stream: str) -> None:
        """Ends a subscription."""
        with self._lock:
            if self._feeds.pop(stream, None) is not None:
                self._subscribe_soon()

    @property
    def delivery(self) -> DeliveryBudget | None:
        """What the session gives us of every stream that there is, and why; None until it has told."""
        told = self.connection.latest.get(DeliveryBudget)
        return told if isinstance(told, DeliveryBudget) else None

    def publish_media(
        self,
        stream: str,
        frames: bytes | Mapping[str, bytes],
        *,
        capture_ns: int | None = None,
        encoding: str = MediaEncoding.BYTES,
    ) -> bool:
        """Hands in a frame of a stream, in role `camera` or `source`; see `Session.publish_media`.

        `capture_ns`: session time. False: the link takes nothing now, the frame is dropped.
        """
        welcome = self.connection.welcome
        if welcome is None or not self.connection.joined:
            raise NotConnectedError(self.connection.describe())
        now_ns = self.session_now_ns() if capture_ns is None else capture_ns
        try:
            message = encode_media_frames(stream, frames, now_ns, self.connection.mirror.scene_epoch, encoding)
        except ValueError as error:
            raise InvalidMessageError(str(error)) from None
        with self._lock:
            return self._sockets.send_media(welcome.endpoints.media_ingest, message)

    # --- inside -------------------------------------------------------------------------------------------------------

    def _tend_media(self) -> bool:
        """Subscribes anew with every connection, once the session has told what we get. True when something came."""
        if self._media_generation != self.connection.generation:
            self._media_generation = self.connection.generation
            self._sockets.close_media()
            self._subscribed.clear()
            self.connection.latest.pop(DeliveryBudget, None)
        told = self.delivery
        if told is None or not self.connection.joined:
            return False
        classes = {budget.stream: budget.budget_class for budget in told.streams}
        for feed in self._feeds.values():
            feed.budget_class = classes.get(feed.stream, told.budget_class)
        self._subscribe()
        return self._drain_media()

    def _subscribe_soon(self) -> None:
        """Here, or in the thread that polls: no two may use a socket."""
        if self._polls_here:
            self._subscribe()
        else:
            self._sockets.wake()

    def _subscribe(self) -> None:
        """To what is asked for, and to nothing else. The session has to tell first what we get: only then it knows
        whose subscription it is."""
        welcome = self.connection.welcome
        if self.delivery is None or welcome is None or self._media_generation != self.connection.generation:
            return
        if not self._sockets.has_media:
            self._subscribed.clear()
        for stream in self._subscribed - self._feeds.keys():
            self._sockets.unsubscribe_media(make_topic(self.connection.connection_epoch, stream))
        new = [stream for stream in self._feeds if stream not in self._subscribed]
        if new:
            topics = [make_topic(self.connection.connection_epoch, stream) for stream in new]
            self._sockets.subscribe_media(welcome.endpoints.media, topics)
        self._subscribed = set(self._feeds)

    def _drain_media(self) -> bool:
        messages = self._sockets.drain_media()
        seen: set[str] = set()
        for frames in messages:
            try:
                _, head, data = frames
                header = decode_media_header(head)
            except (ProtocolError, ValueError):
                self.media_malformed += 1
                continue
            feed = self._feeds.get(header.stream)
            if feed is None:  # it was under way when we let go of the stream
                self.media_late += 1
                continue
            feed.superseded += feed.stream in seen
            seen.add(feed.stream)
            feed.received += 1
            feed.dropped = header.dropped
            feed.newest = MediaFrame(header, data, self.session_now_ns() - header.capture_ns)
            self._media_bytes += sum(map(len, frames))
            if len(self._media_ages) < MAX_AGES:
                self._media_ages.append(feed.newest.age_ns)
        return bool(messages)

    def _with_media(self, report: ClientReport, now_ns: int) -> ClientReport:
        """`report` with what came over the media channel since the one before."""
        ages = compute_quantiles(self._media_ages)
        elapsed_ns, self._media_since_ns = max(PERIOD_NS, now_ns - self._media_since_ns), now_ns
        received, self._media_bytes = self._media_bytes, 0
        self._media_ages.clear()
        return ClientReport(
            report.age_ms_p50,
            report.age_ms_p99,
            report.delivered,
            report.missed,
            report.rtt_ms,
            report.bytes_per_s,
            received / elapsed_ns * 1e9,
            0.0 if ages is None else ages.p50,
            report.display_hz,
            self.media_limit_mbit_per_s,
        )


def _check_name(stream: str) -> None:
    if not is_stream_name(stream):
        raise InvalidMessageError(describe_bad_stream_name(stream))
