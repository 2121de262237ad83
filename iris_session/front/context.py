"""The front's context, shared by its parts: configuration, sockets, connections, queues, keys and the clock.

`FrontSockets` opens all sockets, together or not at all. `FrontContext` holds the state that every part reads and
changes; a part takes the context and the few other parts whose methods it calls. `loop` wires them. Nothing here
decides anything.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import msgspec
import zmq

from iris_session.front.asset_server import AssetSockets, open_asset_sockets
from iris_session.front.audit import AuditTrail
from iris_session.front.coalescer import Coalescer
from iris_session.front.connection_guard import ConnectionGuard, max_connections_per_key
from iris_session.front.connections import ConnectionTable, ControlSender, FrontConnection
from iris_session.front.discovery import Listeners, choose_address_host, list_reachable_hosts, open_with_introduction
from iris_session.front.key_budgets import KeyBudgets
from iris_session.front.state_publisher import StatePublisher
from iris_session.link import messages as link
from iris_session.link.config import MILLISECOND, FrontConfig, FrontError, FrontLimits, FrontStart, Ports
from iris_session.link.sockets import (
    IO_THREADS,
    bound_port,
    open_control,
    open_ingest,
    open_local_ingest,
    open_media,
    open_state,
    watch_tcp,
)
from iris_session.link.tcp_guard import TrafficCounter
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import AuditKind
from iris_session.security import KeysError
from iris_session.security.keyring import Keyring, open_keyring
from iris_session.security.resume_tokens import ResumeTokens
from iris_session.security.zap import Authenticator

#: A restarted front numbers its state frames above those of its predecessor: state is sent at less than 1 kHz.
SEQ_NS = MILLISECOND


class Service(Protocol):
    """A part of the front with periodic work. `tick` never waits. A part that opens something has a `close`, too."""

    def tick(self, now_ns: int) -> None:
        """Do what is due at session time `now_ns`. Called about every 10 ms, after the link was drained."""
        ...


class WatchedSocket(NamedTuple):
    """A socket and the monitor of its TCP connections."""

    socket: zmq.Socket[bytes]
    monitor: zmq.Socket[bytes]


class FrontSockets:
    """The sockets of the front.

    Attributes:
        link: To the authority.
        control, state, media: For clients.
        ingest, local_ingest: For media sources on other machines and of this session.
        assets: For assets, with a ZeroMQ context of their own.
        listeners: TCP listeners of the introduction.

    Args:
        start: Configuration and the endpoint of the link.
        drops: Drop counters.
        on_key_refused: Called with the fingerprint, the address and the channel of every key that was not admitted.

    Raises:
        FrontError: A socket cannot be opened. The authority was notified, and all sockets are closed.
    """

    def __init__(self, start: FrontStart, drops: Drops, on_key_refused: Callable[[str, str, str], None]) -> None:
        self._config = start.config
        self._drops = drops
        self._state_sockets = 0
        self.assets: AssetSockets
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context(IO_THREADS)
        self.link = self.context.socket(zmq.PAIR)
        self.link.setsockopt(zmq.LINGER, 1000)
        self.link_monitor = watch_tcp(self.link, "link", zmq.EVENT_DISCONNECTED)
        self.link.connect(start.link_endpoint)
        try:
            self._open(on_key_refused)
        except FrontError as error:
            self.link.send_multipart((link.FAILED, str(error).encode()))
            self.close()
            raise

    def _open(self, on_key_refused: Callable[[str, str, str], None]) -> None:
        config = self._config
        self.keyring = self._open_keyring()
        key = self.keyring.key
        self.authenticator = Authenticator(self.context, self.keyring, self._drops, on_key_refused) if key else None
        self.listeners: Listeners
        control, self.listeners = open_with_introduction(
            config.hosts, config.control_port, lambda port: open_control(self.context, config, key, port)
        )
        try:
            self.state = self.open_state(config.state_port)
            media = open_media(self.context, config, key)
            ingest = open_ingest(self.context, config, key)
            self.assets = open_asset_sockets(config, key)
        except FrontError:
            for listener in self.listeners:
                listener.close()
            raise
        self.media = WatchedSocket(media, watch_tcp(media, "media"))
        self.ingest = WatchedSocket(ingest, watch_tcp(ingest, "ingest"))
        endpoint = config.media_endpoint
        self.local_ingest = open_local_ingest(self.context, endpoint) if endpoint else None
        self.control = WatchedSocket(control, watch_tcp(control, "control"))
        self.ports = Ports(
            choose_address_host(config),
            bound_port(control),
            bound_port(self.state.socket),
            key.fingerprint if key else "",
            list_reachable_hosts(config),
            bound_port(media),
            bound_port(ingest),
            bound_port(self.assets.socket),
        )

    def _open_keyring(self) -> Keyring:
        """Return the session's keyring, an empty one on plain loopback. Raises `FrontError`."""
        config = self._config
        if config.loopback and not (config.curve or config.curve_secret_file):
            return Keyring(drops=self._drops)
        try:
            return open_keyring(
                config.key_home,
                config.curve_secret_file,
                config.curve_clients_dir,
                self._drops,
                config.gateway_key,
                config.camera_keys,
            )
        except KeysError as error:
            raise FrontError(str(error)) from error

    def open_state(self, port: int) -> WatchedSocket:
        """Open a state socket; the one before must be closed. Raises `FrontError` while its port is not free yet."""
        state = open_state(self.context, msgspec.structs.replace(self._config, state_port=port), self.keyring.key)
        self._state_sockets += 1
        return WatchedSocket(state, watch_tcp(state, f"state-{self._state_sockets}"))

    def close(self) -> None:
        """Close every socket; sent messages leave within its linger time."""
        self.context.destroy()


@dataclass(slots=True)
class LinkState:
    """State of the link to the authority, written by `Downlink` (the first six), `Front` (stalls) and `Uplink`.

    Attributes:
        heard_ns: Session time of its last message, 0 before the first.
        step: Step of its newest decision, -1 before the first.
        acknowledged: Batches that it acknowledged since the start.
        report: Its newest half of the status report, encoded; empty before the first.
        is_recorded: The recording has not ended before the session.
        ended: The session has ended.
        stalled: It does not step.
        stalls: How often it stalled.
        entries: Entries sent to it since the start.
    """

    heard_ns: int = 0
    step: int = -1
    acknowledged: int = 0
    report: bytes = b""
    is_recorded: bool = True
    ended: bool = False
    stalled: bool = False
    stalls: int = 0
    entries: int = 0


@dataclass(kw_only=True, slots=True)
class FrontContext:
    """State that the parts of the front share.

    Attributes:
        now_ns: Returns session time [ns].
        budgets: What each key may send and cause, over all its connections.
        publisher: The state socket's sender; it knows the present scene.
    """

    config: FrontConfig
    ports: Ports
    keyring: Keyring
    now_ns: Callable[[], int]
    drops: Drops
    connections: ConnectionTable
    outbox: ControlSender
    coalescer: Coalescer
    audit: AuditTrail
    guard: ConnectionGuard
    budgets: KeyBudgets
    tokens: ResumeTokens
    publisher: StatePublisher
    traffic: TrafficCounter = field(default_factory=TrafficCounter)
    authority: LinkState = field(default_factory=LinkState)

    def find_channel_key(self, connection: FrontConnection) -> str:
        """Return the key of the TCP connections that may carry media and assets of a connection: behind a gateway the
        gateway's, and the empty string without encryption."""
        if self.keyring.key is None:
            return ""
        gateway = self.connections.by_number.get(connection.gateway)
        return connection.key_id if gateway is None else gateway.key_id


def find_channel_share(keyring: Keyring, limits: FrontLimits, owner: str) -> int:
    """Return how many connections to one channel beside control (state, media, assets) one owner may have.

    `owner`: a key, or without encryption an address, which many may share.
    """
    if keyring.key is None or keyring.may_be_gateway(owner):
        return max_connections_per_key(limits.subscribers)
    return 2 * limits.key.connections if keyring.find_key(owner) is not None else limits.subscribers


def open_front(start: FrontStart) -> tuple[FrontContext, FrontSockets]:
    """Open the sockets of a front and make its context.

    Raises:
        FrontError: A socket cannot be opened. The authority was notified.
    """
    config, limits = start.config, start.config.limits

    def now_ns() -> int:
        return time.monotonic_ns() - config.origin_ns

    def audit_refused_key(fingerprint: str, address: str, channel: str) -> None:
        audit.record(AuditKind.KEY_REFUSED, now_ns(), subject=fingerprint, address=address, detail=channel)

    drops, connections = Drops(), ConnectionTable()
    coalescer = Coalescer(limits, drops)
    audit = AuditTrail(coalescer.offer)
    sockets = FrontSockets(start, drops, audit_refused_key)
    traffic = TrafficCounter(curve=sockets.keyring.key is not None)
    guard = ConnectionGuard(
        connections, drops, audit, limits, traffic, lambda key: find_channel_share(sockets.keyring, limits, key)
    )
    guard.watch_state_socket(*sockets.state)
    first_seq = 1 + (now_ns() // SEQ_NS if start.handback else 0)
    context = FrontContext(
        config=config,
        ports=sockets.ports,
        keyring=sockets.keyring,
        now_ns=now_ns,
        drops=drops,
        connections=connections,
        outbox=ControlSender(sockets.control.socket, limits, drops, traffic),
        coalescer=coalescer,
        audit=audit,
        guard=guard,
        budgets=KeyBudgets(limits, coalescer.offer),
        tokens=ResumeTokens(limits.resume_tokens, start.handback),
        publisher=StatePublisher(sockets.state.socket, start.scene, now_ns, first_seq),
        traffic=traffic,
    )
    return context, sockets
