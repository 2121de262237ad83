"""What is known of media: streams, who wants them, at which level, and what is due. Pure: no sockets, time comes in.

Of every stream only the newest frame is kept. A subscriber whose connection is full gets the newest there is as soon
as it takes something again; what was due to it in between is dropped and counted. Nobody waits for anybody.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from iris_session.front.media.budget import MILLISECOND, NOTHING, SECOND
from iris_session.protocol.codec import encode_media_header
from iris_session.protocol.media import CLASSES, MAX_STREAMS, MediaHeader, MediaPush, is_stream_name, make_topic

#: A stream of which nothing came for so long may be taken over by another source, and is forgotten after the other.
TAKEOVER_NS: Final = 3 * SECOND
EXPIRE_NS: Final = 60 * SECOND
#: Rates are those of so many looks: two seconds, with four looks in each.
RATE_SAMPLES: Final = 9
#: `send(topic, header, frame)`: false when that connection takes nothing now.
Send = Callable[[bytes, bytes, Any], bool]


class MediaSubscriber(NamedTuple):
    """One connection that may subscribe. `user_id`: the key by which its subscriptions must come. `levels`: index into
    `CLASSES` by stream; `first`: of streams that are not in there."""

    user_id: str
    levels: Mapping[str, int]
    default_level: int = 0


class DeliveryCounters(NamedTuple):
    """What became of one connection's frames, since it came."""

    taken: int = 0
    due: int = 0
    bytes: int = 0

    def combine(self, other: DeliveryCounters) -> DeliveryCounters:
        return DeliveryCounters(*(a + b for a, b in zip(self, other, strict=True)))


class StreamStats(NamedTuple):
    """`rates`: bytes per second at full, half, quarter. `hz`: frames that its source hands in."""

    rates: tuple[float, float, float]
    hz: float
    source: str
    subscribers: int


class _Subscription:
    """One connection's subscription to one stream."""

    __slots__ = ("bytes", "dropped", "due", "pending", "readers", "taken")

    def __init__(self) -> None:
        self.pending = False
        self.readers: set[int] = set()  # descriptors
        self.due = self.taken = self.dropped = self.bytes = 0

    @property
    def counters(self) -> DeliveryCounters:
        return DeliveryCounters(self.taken, self.due, self.bytes)


class _Stream:
    """One stream and its newest frame. `offered`: bytes that each level would have had so far."""

    def __init__(self, source: str, seq: int) -> None:
        self.source = source
        self.seq = seq
        self.came_ns = 0
        self.push: MediaPush | None = None
        self.frames: dict[int, Any] = {}
        self.count = 0
        self.offered = [0, 0, 0]
        self.rate_samples: deque[tuple[int, int, tuple[int, ...]]] = deque(maxlen=RATE_SAMPLES)

    def select_frame(self, level: int) -> tuple[Any, bool]:
        """The frame for a level, and whether it is due at this `seq`."""
        offered = max(have for have in self.frames if have <= level)
        return self.frames[offered], self.seq % (1 << (level - offered)) == 0

    def compute_rates(self) -> tuple[tuple[float, float, float], float]:
        """Bytes per second by level, and frames per second."""
        if len(self.rate_samples) < 2 or self.rate_samples[-1][0] == self.rate_samples[0][0]:
            return (0.0, 0.0, 0.0), 0.0
        (since_ns, count, before), (now_ns, count_now, now) = self.rate_samples[0], self.rate_samples[-1]
        seconds = (now_ns - since_ns) * 1e-9
        full, half, quarter = ((b - a) / seconds for a, b in zip(before, now, strict=True))
        return (full, half, quarter), (count_now - count) / seconds


class MediaScheduler:
    """Not safe by itself: whoever shares one between threads holds a lock around every call."""

    def __init__(self) -> None:
        self._streams: dict[str, _Stream] = {}
        self._subscribers: dict[int, MediaSubscriber] = {}
        self._subscriptions: dict[tuple[int, str], _Subscription] = {}
        self._readings: dict[int, set[tuple[int, str]]] = {}  # by descriptor
        self._ended: dict[int, DeliveryCounters] = {}  # of subscriptions that were taken back
        self._pending: deque[tuple[int, str]] = deque()
        self._closed_until_ns = 0
        self._stuck: set[int] = set()
        #: What was thrown away since somebody emptied it, by reason; and of whose frames, by connection.
        self.drops: dict[str, int] = {}
        self.superseded: dict[int, int] = {}

    # --- who wants what ----------------------------------------------------------------------------------------------

    def set_subscribers(self, listeners: Mapping[int, MediaSubscriber]) -> None:
        """The connections there are, and what they get from now on."""
        self._subscribers = dict(listeners)
        for key in [key for key in self._subscriptions if key[0] not in self._subscribers]:
            del self._subscriptions[key]
        for number in [number for number in self._ended if number not in self._subscribers]:
            del self._ended[number]

    def subscribe(self, number: int, stream: str, user_id: str, reader: int) -> bool:
        """False: this key may not have what is sent to that connection, or it wants too much. `reader`: descriptor of
        the TCP connection that asked."""
        listener = self._subscribers.get(number)
        if listener is None or listener.user_id != user_id:
            self._count_drop("media_refused")
            return False
        if (number, stream) not in self._subscriptions and len(self.list_subscriptions(number)) >= MAX_STREAMS:
            self._count_drop("media_subscriptions_full")
            return False
        self._subscriptions.setdefault((number, stream), _Subscription()).readers.add(reader)
        self._readings.setdefault(reader, set()).add((number, stream))
        return True

    def unsubscribe(self, number: int, stream: str, reader: int) -> None:
        """One reader less: a client that connects again may have two for a while. Of others it takes nothing."""
        self._readings.get(reader, set()).discard((number, stream))
        wish = self._subscriptions.get((number, stream))
        if wish is None or reader not in wish.readers:
            return
        wish.readers.remove(reader)
        if not wish.readers:
            del self._subscriptions[number, stream]
            self._ended[number] = self._ended.get(number, DeliveryCounters()).combine(wish.counters)

    def remove_reader(self, reader: int) -> None:
        """A TCP connection has ended, and its subscriptions with it."""
        for number, stream in sorted(self._readings.pop(reader, ())):
            self.unsubscribe(number, stream, reader)

    def list_subscriptions(self, number: int) -> list[str]:
        """The streams that a connection subscribed to."""
        return sorted(stream for owner, stream in self._subscriptions if owner == number)

    def read_counters(self, number: int) -> DeliveryCounters:
        """Of all its subscriptions."""
        total = self._ended.get(number, DeliveryCounters())
        for (owner, _), wish in self._subscriptions.items():
            if owner == number:
                total = total.combine(wish.counters)
        return total

    # --- frames ------------------------------------------------------------------------------------------------------

    def push(self, push: MediaPush, frames: Sequence[Any], source: str, now_ns: int) -> bool:
        """Takes a frame of a source. False: it does not fit, which is counted."""
        levels = [CLASSES.index(name) for name in push.classes if name in CLASSES[:NOTHING]]
        fits = len(frames) == len(levels) == len(push.classes) == len(set(levels)) and 0 in levels
        if not fits or not is_stream_name(push.stream):
            self._count_drop("media_malformed")
            return False
        if now_ns < self._closed_until_ns:
            self._count_drop("media_memory")
            return False
        stream = self._find_stream(push.stream, source, now_ns)
        if stream is None:
            return False
        stream.came_ns, stream.push = now_ns, push
        stream.frames = dict(zip(levels, frames, strict=True))
        stream.seq += 1
        stream.count += 1
        for level in range(NOTHING):
            frame, due = stream.select_frame(level)
            stream.offered[level] += len(frame) if due else 0
        for key, wish in self._subscriptions.items():
            if key[1] == push.stream:
                self._mark_due(key, wish, stream)
        return True

    def flush(self, send: Send, now_ns: int) -> bool:
        """Sends what is due to connections that take it. True when something has to wait."""
        for _ in range(len(self._pending)):
            key = self._pending.popleft()
            wish = self._subscriptions.get(key)
            if wish is None or not wish.pending:
                continue
            if self._send(key, wish, send, now_ns):
                wish.pending = False
            else:
                self._pending.append(key)
        return bool(self._pending)

    # --- now and then ------------------------------------------------------------------------------------------------

    def sample_rates(self, now_ns: int) -> None:
        """Notes how much came, for the rates; forgets streams that have ended."""
        for name, stream in list(self._streams.items()):
            if now_ns - stream.came_ns > EXPIRE_NS:
                del self._streams[name]
            else:
                stream.rate_samples.append((now_ns, stream.count, tuple(stream.offered)))

    def read_streams(self) -> dict[str, StreamStats]:
        """All streams by name, in the order of their names."""
        found = {}
        for name in sorted(self._streams):
            stream = self._streams[name]
            rates, hz = stream.compute_rates()
            wishes = sum(wanted == name for _, wanted in self._subscriptions)
            found[name] = StreamStats(rates, hz, stream.source, wishes)
        return found

    def release_frames(self, until_ns: int) -> bool:
        """Lets go of every frame, and takes none until then. False: there is none."""
        held = [stream for stream in self._streams.values() if stream.frames]
        for stream in held:
            stream.push, stream.frames = None, {}
        for key in self._pending:
            wish = self._subscriptions.get(key)
            if wish is not None and wish.pending:
                wish.pending = False
                self._stuck |= wish.readers
                self._count_drop("media_memory")
        self._pending.clear()
        if held:
            self._closed_until_ns = until_ns
        return bool(held)

    def reset(self) -> None:
        """After a fault: lets go of every frame and of what is due, which may be half noted. Who subscribed stays."""
        for stream in self._streams.values():
            stream.push, stream.frames = None, {}
        for wish in self._subscriptions.values():
            wish.pending = False
        self._pending.clear()

    def pop_stuck(self) -> set[int]:
        """Descriptors of connections that did not take what was due when media gave way: frames wait in them."""
        stuck, self._stuck = self._stuck, set()
        return stuck

    def pop_drops(self) -> tuple[dict[str, int], dict[int, int]]:
        """`drops` and `superseded`, which are empty then."""
        taken = self.drops, self.superseded
        self.drops, self.superseded = {}, {}
        return taken

    def count_drop(self, reason: str) -> None:
        """Something was thrown away before it came here."""
        self._count_drop(reason)

    def stop_sources(self, gone: Iterable[str]) -> None:
        """These sources may hand in no more: their newest frames are sent to nobody."""
        ended = set(gone)
        for name in [name for name, stream in self._streams.items() if stream.source in ended]:
            del self._streams[name]

    # --- inside ------------------------------------------------------------------------------------------------------

    def _find_stream(self, name: str, source: str, now_ns: int) -> _Stream | None:
        stream = self._streams.get(name)
        if stream is None:
            if len(self._streams) >= MAX_STREAMS:
                self._count_drop("media_streams_full")
                return None
            # A restarted front numbers above its predecessor: no stream has a thousand frames a second.
            stream = self._streams[name] = _Stream(source, now_ns // MILLISECOND)
        elif stream.source != source:
            if now_ns - stream.came_ns < TAKEOVER_NS:
                self._count_drop("media_stream_taken")
                return None
            stream.source = source
        return stream

    def _find_level(self, number: int, stream: str) -> int:
        listener = self._subscribers.get(number)
        return NOTHING if listener is None else listener.levels.get(stream, listener.default_level)

    def _mark_due(self, key: tuple[int, str], wish: _Subscription, stream: _Stream) -> None:
        level = self._find_level(*key)
        if level >= NOTHING or not stream.select_frame(level)[1]:
            return
        wish.due += 1
        if wish.pending:
            wish.dropped += 1
            self.superseded[key[0]] = self.superseded.get(key[0], 0) + 1
        else:
            wish.pending = True
            self._pending.append(key)

    def _send(self, key: tuple[int, str], wish: _Subscription, send: Send, now_ns: int) -> bool:
        """True: done with, sent or not wanted any more."""
        number, name = key
        stream, level = self._streams.get(name), self._find_level(number, name)
        if stream is None or stream.push is None or level >= NOTHING:
            return True
        frame = stream.select_frame(level)[0]
        push = stream.push
        header = MediaHeader(
            name, CLASSES[level], push.scene_epoch, stream.seq, push.capture_ns, now_ns, push.encoding, wish.dropped
        )
        topic = make_topic(number, name) + CLASSES[level].encode()
        if not send(topic, encode_media_header(header), frame):
            return False
        wish.taken += 1
        wish.bytes += len(topic) + len(frame)
        return True

    def _count_drop(self, reason: str) -> None:
        self.drops[reason] = self.drops.get(reason, 0) + 1
