"""Subscribed media streams: the newest frame, and the newest point cloud with the times of its way to here.

room = client.media.cloud("room")
while True:
    client.poll(0.01)
    cloud = room.poll()
    if cloud is not None:
        draw(cloud.positions, cloud.colors)  # p_world (n, 3) [m]; (n, 4)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from iris_session.protocol.media import MediaHeader
from iris_session.protocol.names import BudgetClass, MediaEncoding
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
