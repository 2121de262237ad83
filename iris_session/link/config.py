"""Start configuration of the front process: endpoints, limits, anchors, the scene. Plain data, no behaviour.

The front reads `FrontStart` as MessagePack from its standard input, never from its arguments.
"""

from __future__ import annotations

import ipaddress
from typing import Final

import msgspec

from iris_session.protocol.common import Name, Pose, Vec3
from iris_session.protocol.errors import IrisError
from iris_session.protocol.limits import KeyLimits
from iris_session.protocol.server_messages import BodyInfo, RobotInfo

MILLISECOND: Final = 1_000_000
SECOND: Final = 1_000_000_000
MEBIBYTE: Final = 1 << 20


class FrontLimits(msgspec.Struct, frozen=True):
    """Bounds of the memory and work that clients can cause in the front.

    Sizes and rates per message type are in `protocol.limits`.

    Attributes:
        connections: Participants' connections at most.
        hellos_per_second, hello_burst: Rate limit of `hello`, all peers together.
        hellos_per_source, hello_source_burst: Rate limit of `hello` for each key, behind a gateway for each secret.
        pending_messages, pending_urgent, pending_devices: Entries queued for the authority, per connection.
        pending_samples: Samples queued for the authority, per device.
        batch_entries: Entries of one batch to the authority.
        unacknowledged: Batches that the authority has not acknowledged; urgent batches may use as many again.
        send_queue, receive_queue: Messages queued in libzmq, per TCP connection.
        slow_drops: Messages in a row that find the send queue of a client full before it counts as disconnected.
        resume_tokens: Resume tokens that are remembered.
        excess_per_s, excess_burst: Rate limit of rejected messages of one TCP connection, which is closed above it. An
            honest client with a fault in its loop is reported by its rate limits long before.
        unauthenticated: TCP connections that have not sent `hello`, and as many again to the state socket that have not
            subscribed.
        hello_timeout_ns: Longest time in that state [ns].
        subscribers: TCP connections to the state socket that have subscribed; also connections to the media socket, and
            to the assets socket.
        sources: TCP connections to the media ingest socket.
        source_bytes: Unread bytes of all media ingest connections of one key, or of one address before a connection
            has handed in its first frame.
        ingest_bytes: Unread bytes of all media ingest connections together.
        memory_bytes: Bytes of all queues together (see `MemoryGuard`).
        key: What one key may send and cause, over all its connections.
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
    unauthenticated: int = 1024
    hello_timeout_ns: int = 10 * SECOND
    subscribers: int = 512
    sources: int = 64
    source_bytes: int = 64 * MEBIBYTE
    ingest_bytes: int = 128 * MEBIBYTE
    memory_bytes: int = 256 * MEBIBYTE
    key: KeyLimits = KeyLimits()


class SceneInfo(msgspec.Struct, frozen=True):
    """Scene data that the front adds to every `Snapshot`.

    Attributes:
        scene_hash: Address of the specification; the hash of the model when the session shares no specification.
        robots, bodies: Of the scene, in the order of the state.
        poses: T_world_body, float64 (n_bodies, 7) `x y z qw qx qy qz` [m], little-endian; used until the first state
            frame.
        asset_root: Folder of an asset store (`ROOT/ab/abcd...`); empty for none.
        assets: Addresses of the assets that clients may fetch while this scene or the next one is present; the
            specification for some moments longer.
        tick_period_ns: Simulated time of one tick [ns].
        patches: Number of visual patches since the scene was loaded. A patch leaves the bodies where they are.
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
    """Configuration of the front. Port 0 means any free one.

    Connections are encrypted with CURVE on any address but loopback, and on loopback with `curve`.

    Attributes:
        host: Address to listen on.
        listen: Several addresses to listen on, instead of `host`.
        advertise: Address that beacons announce, when clients reach the front by an address of another machine.
        beacon_port: UDP port of the beacons, 0 for none.
        control_port, state_port: TCP ports, which must be free.
        media_port, media_ingest_port, assets_port: TCP ports; the front uses another when one is in use.
        media_endpoint: ZeroMQ endpoint to which processes of this session publish media, empty for none.
        adapt_media: Send fewer media over slow links.
        origin_ns: `time.monotonic_ns()` at session time 0.
        heartbeat_ns, silence_ns, stall_ns, presence_period_ns, proposal_period_ns, state_period_ns: Periods and
            timeouts [ns].
        curve: Encrypt on loopback too.
        key_home: Folder of the server's key and the allow-list, empty for that of the user.
        curve_secret_file: ZeroMQ certificate of the server (`*.key_secret`), instead of the key in `key_home`.
        curve_clients_dir: Folder of public certificates (`*.key`), instead of the allow-list.
        anchors: `T_world_anchor` by anchor id.
        anchor_sizes: Edge of the printed code by anchor id [m].
        anchor_errors: Stated p95 of the position error by anchor id [m], where it is known.
        anchor_marks: Positions of marks by anchor id and id of the mark, in the anchor frame [m].
        forward_observations: Send raw observations to the authority too.
        recorder_endpoint: Endpoint of a PULL socket for raw samples, empty when nothing is recorded.
        recorder_media_endpoint: Endpoint of a PULL socket for point clouds and pictures, empty for none.
        record_clouds_hz: Frames per second of each stream that go there; 0: none.
        gateway_key: Public key (Z85) of the session's own gateway, which is admitted without the list; empty for none.
        camera_keys: Public keys (Z85) of the session's own camera processes, which are admitted without the list, as
            cameras only.
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
    task_robots: tuple[str, ...] = ()
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
    gateway_key: str = ""
    anchor_errors: dict[str, float] = {}
    anchor_marks: dict[str, dict[Name, Vec3]] = {}
    camera_keys: tuple[str, ...] = ()
    recorder_media_endpoint: str = ""
    record_clouds_hz: float = 0.0

    @property
    def hosts(self) -> tuple[str, ...]:
        """Every address to listen on."""
        return self.listen or (self.host,)

    @property
    def loopback(self) -> bool:
        """True when only this machine can reach the sockets."""
        return all(is_loopback(host) for host in self.hosts)


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach an address (or `localhost`)."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Ports(msgspec.Struct, frozen=True):
    """Host and ports on which the front listens.

    Attributes:
        host: As in `HOST:PORT`, IPv6 in brackets.
        control, state, media, media_ingest, assets: TCP ports, 0 for none.
        key_fingerprint: Of the server's CURVE key, empty without encryption.
        reachable: Addresses under which other machines reach the front, best first, without brackets.
    """

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
    """Standard input of the front process. `handback`: opaque state of the front that this one replaces."""

    config: FrontConfig
    scene: SceneInfo
    link_endpoint: str
    parent_pid: int
    handback: bytes = b""


class FrontError(IrisError):
    """The front cannot run. The message is one line that says what to do."""


class PortInUseError(FrontError):
    """Another program listens on a port of the session."""

    def __init__(self, port: int, name: str) -> None:
        super().__init__(
            f"port {port} ({name}) is in use (by another session?): take another block of ports, for example control "
            "7731 and state 7732, or 0 for any free ones"
        )
