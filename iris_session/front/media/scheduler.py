"""The media scheduler: streams, subscriptions, levels, and which frames are due. Pure: no sockets, time is given.

Of every stream only the newest frame is kept, and the newest info of its source. A subscriber whose connection is full
gets the newest frame as soon as there is room again; frames that were due in between are dropped and counted. No
subscriber waits for another.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import msgspec

from iris_session.front.media.budget import LEVELS, MILLISECOND, NONE_LEVEL, SECOND
from iris_session.protocol.codec import encode_media_header
from iris_session.protocol.limits import TokenBucket
from iris_session.protocol.media import (
    CLASSES,
    MAX_STREAMS,
    MediaHeader,
    MediaPush,
    StreamInfo,
    find_info_problem,
    is_stream_name,
    make_topic,
)
from iris_session.protocol.names import MediaEncoding

#: A stream may be taken over by another source when nothing came for `TAKEOVER_NS`; it is removed after `EXPIRE_NS`.
TAKEOVER_NS: Final = 3 * SECOND
EXPIRE_NS: Final = 60 * SECOND
#: A reader without room for frames of this size holds much: closing it frees memory. One of smaller frames is slow.
STUCK_BYTES: Final = 1 << 20
#: Rates are computed from so many samples: two seconds, with four samples in each.
RATE_SAMPLES: Final = 9
#: Newest frames that new subscriptions of one connection get: as many as it may have at once, then so many a second.
#: Else subscribing anew, over and over, would have the largest frame sent as often as a link takes it.
NEWEST_PER_S: Final = 2.0
#: Characters of the texts of a `StreamInfo` that are kept: every client gets those of every stream in one message.
MAX_TITLE: Final = 64
MAX_DETAIL: Final = 256
#: A stream of `StreamInfo.hz` without a frame for so long is stale: the longer of a time, and of a number of frames.
#: One at rest is while it has none, for the first time.
STALE_NS: Final = SECOND
STALE_FRAMES: Final = 3.0
#: The connection of this machine's session itself; others are descriptors of TCP connections.
LOCAL: Final = -1
#: Participants that have left, whose last frames may still be under way. More do not leave within their time.
MAX_LEFT: Final = 256
#: `send(topic, header, frame)`: returns false if that connection has no room.
Send = Callable[[bytes, bytes, Any], bool]


class MediaSubscriber(NamedTuple):
    """A connection that may subscribe.

    Attributes:
        user_id: Key that its subscriptions must come with.
        levels: Index into `LEVELS` by stream.
        default_level: Level of other streams.
        bytes_per_s: Rate at which frames are to be sent, 0 for as fast as the connection takes them.
    """

    user_id: str
    levels: Mapping[str, int]
    default_level: int = 0
    bytes_per_s: float = 0.0


class DeliveryCounters(NamedTuple):
    """Frames of one connection since it was admitted: delivered, due, and bytes delivered."""

    delivered: int = 0
    due: int = 0
    bytes: int = 0


class StreamStats(NamedTuple):
    """Measurements of a stream. `rates`: bytes per second by level. `hz`: frames per second. `encoding`:
    of the newest frame, which was received at `received_ns`. `info`: as of its source, with texts cut to length.
    `frame_bytes`: of the newest frame, class `full`; `None` before the first one, and when it had to be released.
    `sender`: connection number of its source, `LOCAL` for the session itself, 0 where it is not known."""

    rates: tuple[float, ...]
    hz: float
    source: str
    subscribers: int
    encoding: str
    received_ns: int
    info: StreamInfo = StreamInfo()
    frame_bytes: int | None = None
    sender: int = 0

    def is_stale(self, now_ns: int) -> bool:
        """Return whether the newest frame is too old for the rate that the source means to hold, or missing."""
        hz = self.info.hz
        if hz > 0.0:
            return now_ns - self.received_ns > max(STALE_NS, STALE_FRAMES / hz * SECOND)
        return self.frame_bytes is None and now_ns - self.received_ns > STALE_NS


class NewestFrame(NamedTuple):
    """The newest frame of a stream, class `full`. `received_ns`: when it came. `info`: of the stream."""

    stream: str
    seq: int
    push: MediaPush
    frame: Any
    received_ns: int
    info: StreamInfo


class _Subscription:
    """One connection's subscription to one stream. `seq`: of the frame that its readers got last, -1 for none."""

    def __init__(self) -> None:
        self.pending = False
        self.seq = -1
        self.readers: set[int] = set()  # descriptors
        self.dropped = 0


class _Subscriber:
    """State of a connection that may subscribe, and counters of its frames: delivered, due, bytes delivered."""

    def __init__(self, settings: MediaSubscriber, now_ns: int) -> None:
        self.settings = settings
        self.streams: set[str] = set()  # that it is subscribed to
        self.delivered = self.due = self.bytes = 0
        self.newest = TokenBucket(NEWEST_PER_S, MAX_STREAMS, now_ns)


class _Stream:
    """One stream and its newest frame, received at `received_ns`; before the first one, when the stream began.
    `source`, `connection`: key and connection that it belongs to; `None` when that has ended. `sender`: as in
    `StreamStats`. `heard_ns`: of the newest message. `level_bytes`: bytes that each level would have had so far.
    """

    def __init__(self, source: str, connection: int | None, seq: int, now_ns: int) -> None:
        self.source = source
        self.connection = connection
        self.sender = 0
        self.seq = seq
        self.received_ns = self.heard_ns = now_ns
        self.info = StreamInfo()
        self.encoding: str = MediaEncoding.BYTES
        self.push: MediaPush | None = None
        self.frames: dict[int, Any] = {}
        self.count = 0
        self.level_bytes = [0] * NONE_LEVEL
        self.rate_samples: deque[tuple[int, int, tuple[int, ...]]] = deque(maxlen=RATE_SAMPLES)

    def select_frame(self, level: int) -> tuple[Any, bool]:
        """Return the frame for a level, and whether it is due at this `seq`."""
        offered = max(have for have in self.frames if have <= level)
        return self.frames[offered], self.seq % (1 << (level - offered)) == 0

    def compute_rates(self) -> tuple[tuple[float, ...], float]:
        """Return bytes per second by level, and frames per second."""
        if len(self.rate_samples) < 2 or self.rate_samples[-1][0] == self.rate_samples[0][0]:
            return (0.0,) * NONE_LEVEL, 0.0
        (since_ns, count, before), (now_ns, count_now, now) = self.rate_samples[0], self.rate_samples[-1]
        seconds = (now_ns - since_ns) * 1e-9
        rates = tuple((b - a) / seconds for a, b in zip(before, now, strict=True))
        return rates, (count_now - count) / seconds


class MediaScheduler:
    """Schedule frames of all streams for all subscribers. Not thread-safe: hold a lock around every call.

    Attributes:
        drops: Dropped frames and subscriptions by reason since `pop_drops`.
        superseded: Superseded frames by connection since `pop_drops`.
    """

    def __init__(self) -> None:
        self._streams: dict[str, _Stream] = {}
        self._subscribers: dict[int, _Subscriber] = {}  # by connection number
        self._subscriptions: dict[str, dict[int, _Subscription]] = {}  # by stream and connection number
        self._pending: deque[tuple[int, str]] = deque()
        self._delayed: dict[tuple[int, str], None] = {}  # whose newest frame waits for the bucket of the connection
        self._paused_until_ns = 0
        #: By sender and stream: since when, and when last. Of a sender that is not known the number is 0.
        self._refused: dict[tuple[int, str], tuple[int, int]] = {}
        self._left: deque[int] = deque(maxlen=MAX_LEFT)
        self._stuck: set[int] = set()
        self._paces: dict[int, float] = {}  # bytes per second by descriptor, where there is a limit
        self.drops: dict[str, int] = {}
        self.superseded: dict[int, int] = {}

    # --- subscriptions -----------------------------------------------------------------------------------------------

    def set_subscribers(self, listeners: Mapping[int, MediaSubscriber], now_ns: int) -> None:
        """Set the connections that may subscribe, and their levels from now on. Who gets more gets the newest frame: it
        may be the last one, and have been left out."""
        before = [(key, self._find_level(*key)) for key in self._list_keys()]
        for number in [number for number in self._subscribers if number not in listeners]:
            for stream in self.list_subscriptions(number):
                self._end_subscription(number, stream)
            del self._subscribers[number]
        for number, settings in listeners.items():
            self._subscribers.setdefault(number, _Subscriber(settings, now_ns)).settings = settings
        self._refused = {
            (sender, name): at
            for (sender, name), at in self._refused.items()
            if name in self._streams and (sender <= 0 or sender in self._subscribers)
        }
        for key, level in before:
            if self._find_level(*key) < level:
                self._offer_newest(key, now_ns)

    def subscribe(self, number: int, stream: str, user_id: str, reader: int, now_ns: int) -> bool:
        """Subscribe a connection to a stream, and mark the newest frame due: the next one of a stream at rest may come
        late, or never. `reader`: descriptor of the TCP connection that the request came by.

        Returns:
            False if the key is not that of the connection, or it has too many subscriptions.
        """
        subscriber = self._subscribers.get(number)
        if subscriber is None or subscriber.settings.user_id != user_id:
            self.count_drop("media_refused")
            return False
        subscription = self._find_subscription(number, stream)
        if subscription is None:
            if len(subscriber.streams) >= MAX_STREAMS:
                self.count_drop("media_subscriptions_full")
                return False
            subscriber.streams.add(stream)
            subscription = self._subscriptions.setdefault(stream, {})[number] = _Subscription()
        if reader not in subscription.readers:
            subscription.readers.add(reader)
            subscription.seq = -1  # a client that has connected again may have lost what it had
        self._offer_newest((number, stream), now_ns)
        return True

    def unsubscribe(self, number: int, stream: str, reader: int) -> None:
        """Remove a reader of a subscription, which ends with its last one: a reconnecting client may have two."""
        subscription = self._find_subscription(number, stream)
        if subscription is None or reader not in subscription.readers:
            return
        subscription.readers.remove(reader)
        if not subscription.readers:
            self._end_subscription(number, stream)

    def remove_reader(self, reader: int) -> None:
        """Remove a TCP connection that has ended, with its subscriptions."""
        self._paces.pop(reader, None)  # the next connection may have its descriptor
        for number, stream in self._list_keys():
            self.unsubscribe(number, stream, reader)

    def list_subscriptions(self, number: int) -> list[str]:
        """Return the streams that a connection subscribed to."""
        subscriber = self._subscribers.get(number)
        return [] if subscriber is None else sorted(subscriber.streams)

    def list_readers(self, number: int) -> set[int]:
        """Return the descriptors by which a connection gets media."""
        streams = self.list_subscriptions(number)
        return {reader for stream in streams for reader in self._subscriptions[stream][number].readers}

    def read_counters(self, number: int) -> DeliveryCounters:
        """Return the counters of all subscriptions of a connection."""
        one = self._subscribers.get(number)
        return DeliveryCounters() if one is None else DeliveryCounters(one.delivered, one.due, one.bytes)

    def pop_paces(self) -> dict[int, float]:
        """Return the readers whose rate has changed since the last call, with bytes per second, 0 for no limit."""
        wanted: dict[int, float] = {}
        for number, one in self._subscribers.items():
            if one.settings.bytes_per_s:
                wanted |= dict.fromkeys(self.list_readers(number), one.settings.bytes_per_s)
        ended = self._paces.keys() - wanted.keys()
        changed = {reader: pace for reader, pace in wanted.items() if self._paces.get(reader) != pace}
        self._paces = wanted
        return changed | dict.fromkeys(ended, 0.0)

    def _end_subscription(self, number: int, stream: str) -> None:
        self._subscribers[number].streams.remove(stream)
        del self._subscriptions[stream][number]
        if not self._subscriptions[stream]:
            del self._subscriptions[stream]

    def _find_subscription(self, number: int, stream: str) -> _Subscription | None:
        return self._subscriptions.get(stream, {}).get(number)

    def _list_keys(self) -> list[tuple[int, str]]:
        return [(number, stream) for stream, numbers in self._subscriptions.items() for number in numbers]

    # --- frames ------------------------------------------------------------------------------------------------------

    def push(
        self, push: MediaPush, frames: Sequence[Any], source: str, now_ns: int, connection: int | None = LOCAL
    ) -> bool:
        """Store a frame of a source as the newest of its stream, and its info. Return false if it was dropped and
        counted. `source`, `connection`: its key, and its connection, `None` for one that has ended meanwhile.
        """
        levels = [CLASSES.index(name) for name in push.classes if name in CLASSES[:-1]]
        fits = len(frames) == len(levels) == len(push.classes) == len(set(levels))
        fits = fits and (0 in levels or (not levels and push.info is not None))
        if not fits or not is_stream_name(push.stream):
            self.count_drop("media_malformed")
            return False
        if now_ns < self._paused_until_ns:
            self.count_drop("media_memory")
            return False
        if push.connection_epoch in self._left:
            self.count_drop("media_source_left")
            return False
        sender = LOCAL if connection == LOCAL else self._find_sender(push.connection_epoch, source)
        stream = self._find_stream(push.stream, source, connection, sender, now_ns)
        if stream is None:
            return False
        stream.heard_ns, stream.encoding = now_ns, push.encoding
        if push.info is not None:
            self._take_info(stream, push.info)
        if not frames:
            return True
        stream.received_ns, stream.push = now_ns, push
        stream.frames = dict(zip(levels, frames, strict=True))
        stream.seq += 1
        stream.count += 1
        for level in range(NONE_LEVEL):
            frame, due = stream.select_frame(level)
            stream.level_bytes[level] += len(frame) if due else 0
        for number, subscription in self._subscriptions.get(push.stream, {}).items():
            level = self._find_level(number, push.stream)
            if level < NONE_LEVEL and stream.select_frame(level)[1]:
                self._mark_due((number, push.stream), subscription)
        return True

    def flush(self, send: Send, now_ns: int) -> bool:
        """Send due frames to connections with room. Return whether some are still pending."""
        self._offer_delayed(now_ns)
        for _ in range(len(self._pending)):
            key = self._pending.popleft()
            subscription = self._find_subscription(*key)
            if subscription is None or not subscription.pending:
                continue
            if self._send(key, subscription, send, now_ns):
                subscription.pending = False
            else:
                self._pending.append(key)
        return bool(self._pending)

    # --- periodic ---------------------------------------------------------------------------------------------------

    def sample_rates(self, now_ns: int) -> None:
        """Sample the counters for the rates, and remove streams that have ended."""
        for name, stream in list(self._streams.items()):
            if now_ns - stream.heard_ns > EXPIRE_NS:
                del self._streams[name]
            else:
                stream.rate_samples.append((now_ns, stream.count, tuple(stream.level_bytes)))

    def read_streams(self) -> dict[str, StreamStats]:
        """Return all streams by name, in the order of their names."""
        found = {}
        for name in sorted(self._streams):
            stream = self._streams[name]
            rates, hz = stream.compute_rates()
            subscribers = len(self._subscriptions.get(name, ()))
            found[name] = StreamStats(
                rates,
                hz,
                stream.source,
                subscribers,
                stream.encoding,
                stream.received_ns,
                stream.info,
                len(stream.frames[0]) if stream.frames else None,
                stream.sender,
            )
        return found

    def list_refused(self, now_ns: int) -> set[tuple[int, str]]:
        """Return the senders whose frames are refused now (0: not known), each with the stream that another source has.

        Only where that one has sent something since: a source that has just ended is waited for.
        """
        return {
            (number, name)
            for (number, name), (since_ns, last_ns) in self._refused.items()
            if name in self._streams and self._streams[name].heard_ns > since_ns and now_ns - last_ns < TAKEOVER_NS
        }

    def list_newest(self, encodings: Container[str]) -> list[NewestFrame]:
        """Return the newest frame of every stream that has one in one of `encodings`."""
        return [
            NewestFrame(name, stream.seq, stream.push, stream.frames[0], stream.received_ns, stream.info)
            for name, stream in self._streams.items()
            if stream.push is not None and stream.push.encoding in encodings
        ]

    def has_stream(self, name: str, encoding: str) -> bool:
        """Return whether a stream is there whose newest frame, if it has one, has this encoding."""
        stream = self._streams.get(name)
        return stream is not None and (stream.push is None or stream.push.encoding == encoding)

    def release_frames(self, until_ns: int) -> bool:
        """Release every frame, and drop frames until then. Return whether there were any."""
        held = {name: max(map(len, one.frames.values())) for name, one in self._streams.items() if one.frames}
        for key in self._pending:
            subscription = self._find_subscription(*key)
            if subscription is not None and subscription.pending:
                if held.get(key[1], 0) >= STUCK_BYTES:
                    self._stuck |= subscription.readers
                self.count_drop("media_memory")
        self.reset()
        if held:
            self._paused_until_ns = until_ns
        return bool(held)

    def reset(self) -> None:
        """Release every frame, and what is due, which may be inconsistent after a fault. Subscriptions stay."""
        for stream in self._streams.values():
            stream.push, stream.frames = None, {}
        for numbers in self._subscriptions.values():
            for subscription in numbers.values():
                subscription.pending = False
        self._pending.clear()

    def pop_stuck(self) -> set[int]:
        """Return and clear the connections that had no room for large frames when frames were released: some are
        pending in them."""
        stuck, self._stuck = self._stuck, set()
        return stuck

    def pop_drops(self) -> tuple[dict[str, int], dict[int, int]]:
        """Return and clear `drops` and `superseded`."""
        taken = self.drops, self.superseded
        self.drops, self.superseded = {}, {}
        return taken

    def count_drop(self, reason: str) -> None:
        """Count a frame or subscription that was dropped."""
        self.drops[reason] = self.drops.get(reason, 0) + 1

    def release_streams(self, connection: int) -> None:
        """Let the streams of a connection that has ended be taken over by the next one of the same key."""
        for stream in self._streams.values():
            if stream.connection == connection:
                stream.connection = None

    def end_sender(self, number: int) -> None:
        """Remove the streams of a participant that has left, by its connection number, and drop what still comes."""
        self._left.append(number)
        for name in [name for name, stream in self._streams.items() if stream.sender == number]:
            del self._streams[name]

    def stop_sources(self, gone: Iterable[str]) -> None:
        """Remove the streams of sources that may not hand in frames any more."""
        ended = set(gone)
        for name in [name for name, stream in self._streams.items() if stream.source in ended]:
            del self._streams[name]

    # --- helpers -----------------------------------------------------------------------------------------------------

    def _find_sender(self, number: int, source: str) -> int:
        """Return the connection number that a source states, 0 if that connection has another key."""
        subscriber = self._subscribers.get(number)
        return number if subscriber is not None and subscriber.settings.user_id == source else 0

    def _find_stream(self, name: str, source: str, connection: int | None, sender: int, now_ns: int) -> _Stream | None:
        stream = self._streams.get(name)
        if stream is None:
            if len(self._streams) >= MAX_STREAMS:
                self.count_drop("media_streams_full")
                return None
            # A restarted front numbers above its predecessor: no stream has a thousand frames a second.
            stream = self._streams[name] = _Stream(source, connection, now_ns // MILLISECOND, now_ns)
        elif (stream.source, stream.connection) != (source, connection):
            has_ended = stream.source == source and stream.connection is None
            if not has_ended and now_ns - stream.heard_ns < TAKEOVER_NS:
                self.count_drop("media_stream_taken")
                since_ns, last_ns = self._refused.get((sender, name), (now_ns, now_ns))
                self._refused[sender, name] = since_ns if now_ns - last_ns < TAKEOVER_NS else now_ns, now_ns
                return None
            if stream.source != source:
                stream.source, stream.info, stream.received_ns = source, StreamInfo(), now_ns
                stream.push, stream.frames = None, {}
            stream.connection = connection
        stream.sender = sender
        self._refused.pop((sender, name), None)
        return stream

    def _take_info(self, stream: _Stream, info: StreamInfo) -> None:
        if find_info_problem(info):
            self.count_drop("media_info_malformed")
            return
        title, detail = _cut_text(info.title, MAX_TITLE), _cut_text(info.detail, MAX_DETAIL)
        stream.info = msgspec.structs.replace(info, title=title, detail=detail)

    def _find_level(self, number: int, stream: str) -> int:
        subscriber = self._subscribers.get(number)
        if subscriber is None:
            return NONE_LEVEL
        return subscriber.settings.levels.get(stream, subscriber.settings.default_level)

    def _find_missing_newest(self, key: tuple[int, str]) -> _Subscription | None:
        """Return a subscription that has not had the newest frame of its stream, and is not about to get it."""
        subscription, stream = self._find_subscription(*key), self._streams.get(key[1])
        if subscription is None or stream is None or not stream.frames or subscription.pending:
            return None
        return subscription if subscription.seq != stream.seq and self._find_level(*key) < NONE_LEVEL else None

    def _offer_newest(self, key: tuple[int, str], now_ns: int) -> None:
        """Mark the newest frame of a stream due for a subscription that has not had it: now, or when its connection may
        have another."""
        subscription = self._find_missing_newest(key)
        if subscription is None:
            return
        if self._subscribers[key[0]].newest.take(now_ns):
            self._mark_due(key, subscription)
        else:
            self._delayed[key] = None
            self.count_drop("media_newest_rate")

    def _offer_delayed(self, now_ns: int) -> None:
        for key in list(self._delayed):
            subscription = self._find_missing_newest(key)
            if subscription is None or self._subscribers[key[0]].newest.take(now_ns):
                del self._delayed[key]
                if subscription is not None:
                    self._mark_due(key, subscription)

    def _mark_due(self, key: tuple[int, str], subscription: _Subscription) -> None:
        self._subscribers[key[0]].due += 1
        if subscription.pending:
            subscription.dropped += 1
            self.superseded[key[0]] = self.superseded.get(key[0], 0) + 1
        else:
            subscription.pending = True
            self._pending.append(key)

    def _send(self, key: tuple[int, str], subscription: _Subscription, send: Send, now_ns: int) -> bool:
        """Send a due frame. Return whether it is done: sent, or not due any more."""
        number, name = key
        stream, level = self._streams.get(name), self._find_level(number, name)
        if stream is None or stream.push is None or level >= NONE_LEVEL:
            return True
        frame = stream.select_frame(level)[0]
        push = stream.push
        header = MediaHeader(
            name,
            LEVELS[level],
            push.scene_epoch,
            stream.seq,
            push.capture_ns,
            now_ns,
            push.encoding,
            subscription.dropped,
            push.sent_ns,
            stream.received_ns,
        )
        topic = make_topic(number, name) + LEVELS[level].encode()
        if not send(topic, encode_media_header(header), frame):
            return False
        subscription.seq = stream.seq
        subscriber = self._subscribers[number]
        subscriber.delivered += 1
        subscriber.bytes += len(topic) + len(frame)
        return True


def _cut_text(text: str, length: int) -> str:
    """Return the beginning of a text without control characters: people see it in terminals and pages."""
    return "".join(letter if letter.isprintable() else " " for letter in text[:length])
