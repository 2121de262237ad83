"""What the front process is told at its start: endpoints, limits, anchors, the scene. Plain data, no behaviour.

`FrontStart` travels as MessagePack on the standard input of the front, never in its arguments.
"""

from __future__ import annotations

import ipaddress
from typing import Final

import msgspec

from iris_session.protocol.common import Pose
from iris_session.protocol.server_messages import BodyInfo, RobotInfo

MILLISECOND: Final = 1_000_000
SECOND: Final = 1_000_000_000
MEBIBYTE: Final = 1 << 20


class FrontLimits(msgspec.Struct, frozen=True):
    """Bounds of everything that a client can make the front hold or do. Sizes and rates per message type:
    `protocol.limits`.

    `hellos_per_second`, `hello_burst`: of everybody together, beside `hellos_per_source`, `hello_source_burst` that
    every key has for itself. `pending_messages`, `pending_urgent`, `pending_devices`, `pending_samples`: waiting for
    the authority, per connection (samples: per device). `unacknowledged`: batches on the way to the authority; urgent
    ones may use as many again. `slow_drops`: messages in a row that a client's socket did not take before it counts as
    lost. `receive_queue`, `send_queue`: messages in libzmq, per TCP connection. `excess_per_s`, `excess_burst`:
    messages of one TCP connection that are not taken, before it is cut off. An honest client with a fault in its loop
    is named by its rate limits long before. `strangers`: TCP connections that have not said hello, for at most
    `hello_timeout_ns` each; as many again to the state socket that have not subscribed. `subscribers`: TCP connections
    to the state socket that have, and to the media socket; `sources`: to the socket that takes media, of
    each of which `source_bytes` may wait.
    `memory_bytes`: what all queues together may hold (see `MemoryGuard`).
    """

    connections: int = 64
    hellos_per_second: float = 40.0
    hello_burst: int = 80
    hellos_per_source: float = 1.0
    hello_source_burst: int = 4
    pending_messages: int = 64
    pending_urgent: int = 8
    pending_devices: int = 16
    pending_samples: int = 16
    batch_entries: int = 512
    unacknowledged: int = 8
    send_queue: int = 256
    receive_queue: int = 64
    slow_drops: int = 64
    resume_tokens: int = 256
    excess_per_s: float = 2000.0
    excess_burst: int = 4000
    strangers: int = 1024
    hello_timeout_ns: int = 10 * SECOND
    subscribers: int = 512
    sources: int = 64
    source_bytes: int = 64 * MEBIBYTE
    memory_bytes: int = 256 * MEBIBYTE


class SceneInfo(msgspec.Struct, frozen=True):
    """What the front adds to every `Snapshot`. `poses`: float64 (n_bodies, 7) `x y z qw qx qy qz`, little-endian,
    used until the first state frame. `tick_period_ns`: simulated time of one tick. `patches`: how often it was drawn
    otherwise since it was loaded; its bodies stay where they are then.

    `asset_root`: folder of a store (`ROOT/ab/abcd...`) that holds the `assets`, by address, which clients may fetch as
    long as this scene or the next one is the present one, and the specification for moments more; empty for none.
    """

    scene_hash: str
    robots: tuple[RobotInfo, ...] = ()
    bodies: tuple[BodyInfo, ...] = ()
    poses: bytes = b""
    asset_root: str = ""
    assets: tuple[str, ...] = ()
    tick_period_ns: int = 2 * MILLISECOND
    patches: int = 0


class FrontConfig(msgspec.Struct, frozen=True):
    """Configuration of the front. Port 0: any free one.

    `host`: address to listen on; `listen`: several instead. `advertise`: the address that others are told, when it is
    not ours. `beacon_port`: UDP port of the beacons, 0 for none. Any address but loopback is encrypted with CURVE,
    loopback with `curve`. `key_home`: folder of the server's key and the allow-list, empty for that of the user;
    `curve_secret_file`: another ZeroMQ certificate of the server (`*.key_secret`); `curve_clients_dir`: folder of
    public certificates (`*.key`) instead of the allow-list. `origin_ns`: `time.monotonic_ns()` at session time 0.
    `media_endpoint`: where processes of this session hand in media, empty for nowhere; `media_port`,
    `media_ingest_port`, `assets_port`: taken when they are free, else any other. `adapt_media`: slow links get less.
    `recorder_endpoint`: a PULL socket that takes raw samples, empty when nothing is recorded. `forward_observations`:
    raw observations reach the authority too.
    """

    host: str = "127.0.0.1"
    listen: tuple[str, ...] = ()
    advertise: str = ""
    beacon_port: int = 0
    control_port: int = 7721
    state_port: int = 7722
    media_port: int = 0
    media_ingest_port: int = 0
    media_endpoint: str = ""
    adapt_media: bool = True
    assets_port: int = 0
    web_port: int = 0
    session_id: str = ""
    session_name: str = "session"
    session_kind: str = "live"
    origin_ns: int = 0
    heartbeat_ns: int = 500 * MILLISECOND
    silence_ns: int = 2 * SECOND
    stall_ns: int = 100 * MILLISECOND
    presence_period_ns: int = SECOND // 60
    proposal_period_ns: int = SECOND // 5
    state_period_ns: int = SECOND // 60
    limits: FrontLimits = FrontLimits()
    curve: bool = False
    key_home: str = ""
    curve_secret_file: str = ""
    curve_clients_dir: str = ""
    anchors: dict[str, Pose] = {}
    anchor_sizes: dict[str, float] = {}
    forward_observations: bool = False
    recorder_endpoint: str = ""

    @property
    def hosts(self) -> tuple[str, ...]:
        """Every address to listen on."""
        return self.listen or (self.host,)

    @property
    def loopback(self) -> bool:
        """True when only this machine can reach the sockets."""
        return all(is_loopback(host) for host in self.hosts)


def is_loopback(host: str) -> bool:
    """Whether an address (or `localhost`) reaches no further than this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Ports(msgspec.Struct, frozen=True):
    """Where the front listens. `host`: as in an address, IPv6 in brackets. `key_fingerprint`: of the server CURVE key,
    empty without one. `reachable`: addresses under which others reach it, best first, without brackets."""

    host: str
    control: int
    state: int
    key_fingerprint: str = ""
    reachable: tuple[str, ...] = ()
    media: int = 0
    media_ingest: int = 0
    assets: int = 0

    @property
    def for_clients(self) -> tuple[int, ...]:
        """The ports whose traffic a bad link impairs: control, state and media."""
        return (self.control, self.state, self.media)


class FrontStart(msgspec.Struct, frozen=True):
    """Standard input of the front process. `handback`: opaque memory of a front that this one replaces."""

    config: FrontConfig
    scene: SceneInfo
    link_endpoint: str
    parent_pid: int
    handback: bytes = b""


class FrontError(Exception):
    """The front cannot run. The text is one line that says what to do."""


class PortInUseError(FrontError):
    """Another process listens on a port of the session."""

    def __init__(self, port: int, name: str) -> None:
        super().__init__(
            f"port {port} ({name}) is in use (by another session?): take another block of ports, for example control "
            "7731 and state 7732, or 0 for any free ones"
        )
