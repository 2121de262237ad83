"""Size and rate limits of every message, the token bucket that applies rates, and the counters of dropped messages.

`codec` checks sizes when it decodes. Rates are per connection and message type; the front applies them with a
`RateLimiter` and counts drops in `Drops`. What one key may send and cause over all its connections is in `KeyLimits`;
`weigh_request` and `count_events` state what a message costs. A limit is generous for an honest client: it bounds
memory and work, not use. Pure: time is an argument, in nanoseconds.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Hashable, Mapping
from types import MappingProxyType
from typing import Final

import msgspec

from iris_session.protocol.client_messages import (
    Acquire,
    Align,
    Assign,
    Bye,
    ClearEStop,
    ClockPing,
    Consent,
    Control,
    Disconnected,
    Episode,
    EStop,
    GetSnapshot,
    Grasp,
    Heartbeat,
    Hello,
    Marker,
    MoveAnchor,
    Observation,
    Pair,
    PlaceAlignment,
    Release,
    RemoveParticipant,
    Rename,
    Sample,
    Samples,
    SetMode,
    SetRole,
    SetScale,
    TrackingEpoch,
    Withdraw,
)
from iris_session.protocol.common import Message
from iris_session.protocol.server_messages import (
    ClockPong,
    Event,
    Feedback,
    Paired,
    ProtocolFault,
    Refused,
    Reply,
    Snapshot,
    Welcome,
)
from iris_session.protocol.status import ClientReport, DeliveryBudget, GetStatus, StatusReport

_TOKEN: Final = 1_000_000_000  # nano-tokens


class Limit(msgspec.Struct, frozen=True):
    """`max_bytes`: whole encoded envelope. `per_second`, `burst`: token bucket per connection; 0: no rate limit."""

    max_bytes: int
    per_second: float = 0.0
    burst: int = 0


#: Requests of a person or program: clicks and commands, not a stream. A list of 32 names of 64 characters (4 bytes
#: each in the worst case) fits.
_REQUEST: Final = Limit(max_bytes=20_000, per_second=20, burst=40)

#: From clients. A sample: five devices at 90 Hz with reserve; its size holds 26 hand joints and 64 + 64 joint values.
LIMITS: Final[Mapping[type[Message], Limit]] = MappingProxyType(
    {
        Hello: Limit(40_000, 2, 10),
        Bye: Limit(4_000, 2, 4),
        Disconnected: Limit(512, 2, 4),
        Heartbeat: Limit(512, 20, 40),
        ClockPing: Limit(512, 20, 40),
        GetSnapshot: Limit(512, 2, 10),
        Sample: Limit(8_000, 600, 200),
        Samples: Limit(48_000, 200, 100),
        Acquire: _REQUEST,
        Release: _REQUEST,
        Withdraw: Limit(512, 20, 40),
        Consent: _REQUEST,
        Assign: _REQUEST,
        SetMode: _REQUEST,
        SetScale: _REQUEST,
        Grasp: _REQUEST,
        Observation: Limit(10_000, 60, 120),
        PlaceAlignment: _REQUEST,
        Align: _REQUEST,
        MoveAnchor: _REQUEST,
        TrackingEpoch: Limit(512, 5, 10),
        Episode: Limit(4_000, 5, 10),
        EStop: Limit(4_000, 20, 40),
        ClearEStop: Limit(512, 5, 10),
        Control: Limit(1_000, 20, 40),
        Marker: Limit(4_000, 20, 40),
        Pair: Limit(1_000, 1, 5),
        RemoveParticipant: _REQUEST,
        Rename: _REQUEST,
        SetRole: _REQUEST,
        GetStatus: Limit(512, 4, 8),
        ClientReport: Limit(1_000, 4, 8),
    }
)
#: Largest message of any type from a client, without the name that a gateway puts into it.
MAX_CLIENT_BYTES: Final = max(limit.max_bytes for limit in LIMITS.values())
#: Bytes of that name: `on_behalf_of` in MessagePack.
MAX_ON_BEHALF_BYTES: Final = 64
#: Largest message on the wire of the control channel (`ZMQ_MAXMSGSIZE`, beyond which libzmq closes the connection, of a
#: gateway with all clients behind it): 33 bytes of CURVE, rounded up.
MAX_CONTROL_BYTES: Final = MAX_CLIENT_BYTES + MAX_ON_BEHALF_BYTES + 64

#: From the server, checked by clients. A snapshot names every body: 65,535 of them.
SERVER_LIMITS: Final[Mapping[type[Message], Limit]] = MappingProxyType(
    {
        Welcome: Limit(16_000),
        Refused: Limit(8_000),
        ProtocolFault: Limit(4_000),
        ClockPong: Limit(512),
        Reply: Limit(1_000_000),
        Feedback: Limit(64_000),
        Event: Limit(64_000),
        Snapshot: Limit(32_000_000),
        Paired: Limit(8_000),
        StatusReport: Limit(4_000_000),
        DeliveryBudget: Limit(64_000),
    }
)
MAX_SERVER_BYTES: Final = max(limit.max_bytes for limit in SERVER_LIMITS.values())
MAX_STATE_HEADER_BYTES: Final = 128_000
MAX_PRESENCE_BYTES: Final = 256_000
MAX_ROBOT_STATES_BYTES: Final = 128_000
MAX_MEDIA_HEADER_BYTES: Final = 2_000
#: First frame of a source's message: two texts of 512 characters are the most of it.
MAX_MEDIA_PUSH_BYTES: Final = 8_000
#: One frame of media, of one class: a 1080p depth image without compression has half of it.
MAX_MEDIA_FRAME_BYTES: Final = 8 * 1024 * 1024
#: A request for a chunk of an asset, and the first frame of its answer.
MAX_ASSET_REQUEST_BYTES: Final = 512
MAX_ASSET_HEADER_BYTES: Final = 4_000
#: One UDP datagram without fragmentation on Ethernet.
MAX_BEACON_BYTES: Final = 1_400
#: The introduction of a session over TCP, without its length prefix.
MAX_INTRODUCTION_BYTES: Final = 4_000


class KeyLimits(msgspec.Struct, frozen=True):
    """Budgets of one key, over all its connections: each allows a burst at once and a rate per second on average.

    A key that may be a gateway has `gateway_factor` times as much, and each participant behind it the budgets of a key
    of its own besides.

    Attributes:
        connections: Connections to the control channel at most; twice as many to each other channel.
        messages, message_burst: Messages; each sample of `Samples` is one.
        bytes, byte_burst: Bytes of these messages.
        requests, request_burst: Work that requests cause, as stated by `weigh_request`.
        events, event_burst: Events that messages may cause, as stated by `count_events`: everyone gets each of them.
        handshakes, handshake_burst: TCP connections that finish a handshake, for each channel without subscriptions.
        subscriber_handshakes, subscriber_handshake_burst: The same for state, and for media.
        estops, estop_burst: E-stops that reach the authority; those above are merged into the next one.
        gateway_factor: Share of a gateway's key in everything but connections.
    """

    connections: int = 8
    messages: float = 2400.0
    message_burst: int = 2400
    bytes: float = 4.0 * 1024 * 1024
    byte_burst: int = 8 * 1024 * 1024
    requests: float = 200.0
    request_burst: int = 800
    events: float = 20.0
    event_burst: int = 80
    handshakes: float = 4.0
    handshake_burst: int = 24
    subscriber_handshakes: float = 1.0
    subscriber_handshake_burst: int = 8
    estops: float = 2.0
    estop_burst: int = 4
    gateway_factor: int = 8


#: Units of work of a request: a status report and a hello cost several times as much as another request, a snapshot
#: grows with the scene (`BODIES_PER_UNIT`).
_REQUEST_UNITS: Final[Mapping[type[Message], int]] = MappingProxyType(
    {Hello: 20, GetSnapshot: 20, GetStatus: 10, Observation: 2, Heartbeat: 0, ClockPing: 0, ClientReport: 1}
)
_UNITS: Final = 5
BODIES_PER_UNIT: Final = 50
#: Half of the burst, so that a scene of any size can be joined.
_MAX_UNITS: Final = 400
#: Events of a message that causes more than one, those of its end included: a participant joins and leaves, a lease is
#: acquired and released. So nothing that ends something is ever above the budget of its key.
_EVENTS: Final[Mapping[type[Message], int]] = MappingProxyType(
    {Hello: 4, Acquire: 2, Grasp: 2, Align: 2, Consent: 2, Episode: 2}
)
#: Messages that cause no further event. `Heartbeat` and samples do at the edges that `front.intake` looks for.
_WITHOUT_EVENT: Final = (
    Bye,
    Disconnected,
    Release,
    Heartbeat,
    ClockPing,
    GetSnapshot,
    GetStatus,
    ClientReport,
    Sample,
    Samples,
    Observation,
)
#: An event that carries several leases counts as one more for every two of them.
_LEASES_PER_EVENT: Final = 2


def weigh_request(message: Message, n_bodies: int = 0) -> int:
    """Return the units of work that a message causes. `n_bodies`: of the scene, listed in every snapshot."""
    if isinstance(message, (Sample, Samples, EStop)):
        return 0
    units = _REQUEST_UNITS.get(type(message), _UNITS)
    if isinstance(message, GetSnapshot):
        units += n_bodies // BODIES_PER_UNIT
    return min(units, _MAX_UNITS)


def count_events(message: Message, n_robots: int = 0) -> int:
    """Return the number of events that a message may cause, those of the release after an `Acquire` included.

    `n_robots`: of the scene; a request for any of them may wait for all.
    """
    if isinstance(message, _WITHOUT_EVENT):
        return 0
    n = _EVENTS.get(type(message), 1)
    if isinstance(message, Acquire):
        named = len(message.robots) + len(message.objects)
        n += (named or (n_robots if message.wait else 1)) // _LEASES_PER_EVENT
    elif isinstance(message, Assign):
        n += len(message.robots) // _LEASES_PER_EVENT
    return n


class TokenBucket:
    """A token bucket: allows `burst` at once and `rate` per second on average.

    Counts in integer nano-tokens, so it is exact: it gains `rate` nano-tokens per nanosecond.
    """

    __slots__ = ("_full", "_last_ns", "_rate", "_tokens")

    def __init__(self, rate: float, burst: int, now_ns: int = 0) -> None:
        self._rate = rate
        self._full = burst * _TOKEN
        self._tokens = self._full
        self._last_ns = now_ns

    def take(self, now_ns: int, n: int = 1) -> bool:
        """Use `n` tokens; return false, and use none, when there are fewer. A time before the last one adds nothing."""
        if now_ns > self._last_ns:
            self._tokens = min(self._full, self._tokens + int((now_ns - self._last_ns) * self._rate))
            self._last_ns = now_ns
        if self._tokens < n * _TOKEN:
            return False
        self._tokens -= n * _TOKEN
        return True


class KeyedBuckets:
    """Token buckets by key: of an address, a client's key. Bounded: the key that was not used for longest is forgotten.

    Args:
        rate, burst: Of one key.
        max_keys: Most keys that are remembered.
    """

    def __init__(self, rate: float, burst: int, max_keys: int) -> None:
        self._rate = rate
        self._burst = burst
        self._max_keys = max_keys
        self._buckets: dict[Hashable, TokenBucket] = {}  # the most recently used comes last

    def take(self, key: Hashable, now_ns: int, n: int = 1, *, factor: int = 1) -> bool:
        """Use `n` tokens of a key; return false, and use none, when there are fewer.

        `factor`: how many times the rate and burst a key has that is not remembered.
        """
        bucket = self._buckets.pop(key, None)
        if bucket is None:
            while len(self._buckets) >= self._max_keys:
                del self._buckets[next(iter(self._buckets))]
            bucket = TokenBucket(self._rate * factor, self._burst * factor, now_ns)
        self._buckets[key] = bucket
        return bucket.take(now_ns, n)


def find_network(address: str) -> str:
    """Return the network that counts as one address: with IPv6, a household or lab has 2**64 addresses."""
    try:
        ip = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(ip, ipaddress.IPv6Address):
        mapped = ip.ipv4_mapped
        return str(mapped) if mapped else str(ipaddress.ip_network((ip, 64), strict=False))
    return address


class RateLimiter:
    """The token buckets of one connection, one per message type. Pure: time is an argument."""

    __slots__ = ("_buckets", "_limits")

    def __init__(self, limits: Mapping[type[Message], Limit] = LIMITS) -> None:
        self._limits = limits
        self._buckets: dict[type[Message], TokenBucket] = {}

    def allow(self, kind: type[Message], now_ns: int) -> bool:
        """Use one token of the type's bucket; return false when there is none. Types without a burst always pass.

        Raises `KeyError` for a type without a limit.
        """
        limit = self._limits[kind]
        if not limit.burst:
            return True
        bucket = self._buckets.get(kind)
        if bucket is None:
            bucket = self._buckets[kind] = TokenBucket(limit.per_second, limit.burst, now_ns)
        return bucket.take(now_ns)


class Drops(msgspec.Struct):
    """Counters of dropped messages, by reason and by connection. `version` grows with every drop.

    The connection map keeps open connections only: `remove` takes one out when it is closed.
    """

    by_reason: dict[str, int] = {}
    by_connection: dict[int, int] = {}
    version: int = 0

    def count(self, reason: str, connection: int = 0, n: int = 1) -> None:
        """Add `n` drops for `reason`, and for `connection` unless it is 0."""
        self.by_reason[reason] = self.by_reason.get(reason, 0) + n
        if connection:
            self.by_connection[connection] = self.by_connection.get(connection, 0) + n
        self.version += 1

    def remove(self, connection: int) -> None:
        """Forget the counter of one connection."""
        self.by_connection.pop(connection, None)
