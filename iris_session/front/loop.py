"""The loop of the front process: it wires all parts and runs them. Media, assets and file changes have own threads.

The loop drains the link to the authority first, because state goes out before anything else, then the control socket
in small rounds, and drains the link in between. It never waits for a client, nor for the authority.
"""

from __future__ import annotations

import gc
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Final

import zmq

from iris_session.alignment.service import AlignmentService, Worker
from iris_session.front.admission import Admission
from iris_session.front.asset_server import AssetServer
from iris_session.front.asset_service import AssetService
from iris_session.front.connections import Peer
from iris_session.front.context import FrontContext, FrontSockets, Service, find_channel_share, open_front
from iris_session.front.disconnects import DisconnectHandler
from iris_session.front.discovery import (
    BeaconSender,
    IntroductionServer,
    SessionRegistration,
    make_discovery_services,
)
from iris_session.front.downlink import Downlink
from iris_session.front.intake import Intake
from iris_session.front.key_budgets import HandshakeLimiter
from iris_session.front.media.proxy import MediaProxy
from iris_session.front.media.recorder import MediaRecorder
from iris_session.front.media.service import MediaService
from iris_session.front.memory_guard import MemoryGuard
from iris_session.front.pairing import PairingService
from iris_session.front.raw_feed import RawFeed
from iris_session.front.revocation import RevocationService
from iris_session.front.status import StatusService
from iris_session.front.uplink import Uplink
from iris_session.link import messages as link
from iris_session.link.config import MILLISECOND, FrontStart
from iris_session.link.sockets import MEDIA_THREAD_NAME, read_peer, readable
from iris_session.link.tcp_guard import TcpBounds, TcpGuard, TrafficCounter, make_reasons
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.names import FaultCode
from iris_session.protocol.server_messages import ProtocolFault
from iris_session.system.priority import lower_named_thread_priority
from iris_session.system.process import is_parent

#: Messages of clients handled before the link is drained again: about 0.2 ms.
ROUND: Final = 8
ROUNDS: Final = 16
IDLE_MS: Final = 10
SERVICES_PERIOD_NS: Final = 10 * MILLISECOND
#: Cyclic garbage is rare here; it is collected when no message is pending.
COLLECT_NS: Final = 10_000 * MILLISECOND
#: Between the last message and the end of the connections: libzmq drops what a client (with `IMMEDIATE`) has not read
#: when its connection closes.
FAREWELL_S: Final = 0.1
#: Unread bytes of one connection for media or assets at most: far more than all its subscriptions or requests.
READER_BYTES: Final = 65_536
ENDED: Final = "closed by its owner"
ORPHANED: Final = "its process is gone"


class Front:
    """The front of one session. `run` returns when the session ends; `close` frees the sockets.

    Attributes:
        ended: Why the session ended, empty while it runs.
        cut_off: The link closed without a message: its process ends, or has ended already.

    Raises:
        FrontError: A socket cannot be opened. The authority was notified.
    """

    def __init__(self, start: FrontStart) -> None:
        self._start = start
        self.ended = ""
        self.cut_off = False
        context, sockets = self._context, self._sockets = open_front(start)
        config, drops, authority = context.config, context.drops, context.authority
        self._link, self._control = sockets.link, sockets.control.socket
        self._authenticator = sockets.authenticator
        # Media are encrypted and decrypted as fast as they come: on a busy machine state, control and clients go first.
        lower_named_thread_priority(MEDIA_THREAD_NAME)
        handshakes = HandshakeLimiter(config.limits.key, drops, context.keyring.may_be_gateway, context.guard.is_banned)
        proxy, server = _make_media_proxy(context, sockets), _make_asset_server(context, sockets)
        media, assets = MediaService(context, proxy, handshakes), AssetService(context, server)
        alignment = _make_alignment_service(context)
        status = StatusService(context, media, assets, alignment)
        admission, pairing = Admission(context, (media, assets)), PairingService(context)
        raw = RawFeed(sockets.context, config.recorder_endpoint, drops, lambda: authority.is_recorded)
        self._intake = Intake(context, admission, pairing, status, alignment, raw)
        self._disconnects = DisconnectHandler(context, sockets.control.monitor, admission, status, alignment)
        revocation = RevocationService(context, self._disconnects, self._reopen_state)
        self._downlink = Downlink(
            context, sockets.link, admission, self._disconnects, revocation, alignment, assets, media
        )
        self._uplink = Uplink(context, sockets.link)
        if self._authenticator is not None:
            self._authenticator.is_revoked = context.tokens.is_revoked
            self._authenticator.is_rate_limited = lambda domain, mark, address: (
                not handshakes.allow(domain, mark, address, context.now_ns())
            )
        pending = (context.guard.list_pending, proxy.list_pending, server.list_pending)
        memory = MemoryGuard(config.limits.memory_bytes, pending, proxy.release_memory, self._report_eviction, drops)
        announcements = self._make_announcements(pairing)
        #: In the order of their ticks.
        self._services: list[Service] = [context.keyring, status, media, context.guard, context.budgets, memory]
        self._services += [pairing, revocation, context.audit, assets, *announcements, alignment, raw]
        self._opened = (context.keyring, media, context.guard, revocation, assets, *announcements, alignment, raw)
        self._next_services_ns = self._next_collect_ns = 0

    def _make_announcements(
        self, pairing: PairingService
    ) -> list[IntroductionServer | BeaconSender | SessionRegistration]:
        """Make the services by which clients find the session: on the network, and on this machine."""
        context, keyring = self._context, self._context.keyring

        def make_introduction(beacon: Beacon) -> Introduction:
            key = keyring.key.public if keyring.key else ""
            return Introduction(beacon, key, pairing.has_open_code, len(context.connections))

        services: list[IntroductionServer | BeaconSender | SessionRegistration] = []
        if keyring.home is not None:
            services.append(SessionRegistration(keyring.home, keyring.files, context.config, context.ports))
        listeners = self._sockets.listeners
        services += make_discovery_services(context.config, context.ports, listeners, context.drops, make_introduction)
        return services

    def _reopen_state(self) -> zmq.Socket[bytes]:
        state = self._sockets.open_state(self._context.ports.state)
        self._context.guard.watch_state_socket(*state)
        return state.socket

    def _report_eviction(self, evicted: str, now_ns: int) -> None:
        warning = f"memory ran short: closed {evicted}"
        self._context.guard.report_flood("", f"memory: closed {evicted}", now_ns, warning=warning)

    def end(self, reason: str) -> None:
        """Let `run` return after the clients were notified."""
        self.ended = self.ended or reason

    def run(self) -> None:
        """Serve until the authority or a signal ends the session, or the parent process is gone."""
        self._link.send_multipart((link.READY, link.encoder.encode(self._context.ports)))
        poller = zmq.Poller()
        watched = [self._link, self._sockets.link_monitor, self._control, self._sockets.control.monitor]
        if self._authenticator is not None:
            watched.append(self._authenticator.socket)
        for one in watched:
            poller.register(one, zmq.POLLIN)
        busy = False
        while not self.ended:
            poller.poll(0 if busy else IDLE_MS)
            busy = self._run_once()
        self._downlink.broadcast(ProtocolFault(FaultCode.SESSION_ENDED, f"the session has ended: {self.ended}"))
        if len(self._context.connections):
            time.sleep(FAREWELL_S)

    def _run_once(self) -> bool:
        """Run one pass of the loop. Return whether messages of clients are still pending."""
        self._downlink.drain()
        if self._authenticator is not None:
            self._authenticator.answer_requests()
        more = True
        for _ in range(ROUNDS):
            self._disconnects.drain_monitor()
            more = self._receive_messages()
            self._uplink.flush()
            self._downlink.drain()
            if not more:
                break
        ended, self._intake.ended = self._intake.ended, {}
        self._disconnects.process_disconnects(ended.values(), drained=not more)
        self._run_services(idle=not more)
        self._uplink.flush()
        return more

    def close(self) -> None:
        """Close every socket; sent messages leave within its linger time."""
        for service in self._opened:
            service.close()
        self._sockets.close()

    def _receive_messages(self) -> bool:
        """Handle up to `ROUND` messages of clients. Return whether there may be more."""
        control = self._control
        with_user = self._authenticator is not None
        for _ in range(ROUND):
            if not readable(control):
                return False
            routing_id = control.recv(zmq.DONTWAIT)
            frame = control.recv(zmq.DONTWAIT, copy=False)
            extra = 0
            more = frame.more
            while more:
                more = control.recv(zmq.DONTWAIT, copy=False).more
                extra += 1
            peer = Peer(*read_peer(frame, encrypted=with_user))
            if peer.descriptor < 0:
                self._context.drops.count("unversioned_peer")
                continue
            self._context.traffic.count_received(peer.descriptor, len(frame.buffer))
            self._intake.handle_message(routing_id, peer, frame.buffer, extra)
        return True

    def _run_services(self, idle: bool) -> None:
        now_ns = self._context.now_ns()
        self._check_end()
        if now_ns < self._next_services_ns:
            return
        self._next_services_ns = now_ns + SERVICES_PERIOD_NS
        self._disconnects.disconnect_silent(now_ns, self._context.config.silence_ns)
        for service in self._services:
            service.tick(now_ns)
        self._context.publisher.poll()
        self._check_stall(now_ns)
        self._uplink.tick(now_ns)
        if idle and now_ns >= self._next_collect_ns:
            self._next_collect_ns = now_ns + COLLECT_NS
            gc.collect()

    def _check_end(self) -> None:
        """End if the link has closed: it does with the session's process, however that ended, or with the session."""
        if self._context.authority.ended:
            self.end(ENDED)
        elif readable(self._sockets.link_monitor):
            self.cut_off = True
            self.end(ENDED if is_parent(self._start.parent_pid) else ORPHANED)

    def _check_stall(self, now_ns: int) -> None:
        """Notify the clients when the authority stalls or recovers. Called after the link was drained, so that a front
        that was kept from running does not blame the authority."""
        authority = self._context.authority
        stalled = authority.heard_ns > 0 and now_ns - authority.heard_ns > self._context.config.stall_ns
        if stalled and not authority.stalled:
            authority.stalls += 1
            self._downlink.broadcast(ProtocolFault(FaultCode.STALLED, "the session does not step: robots hold"))
        elif authority.stalled and not stalled:
            self._downlink.broadcast(ProtocolFault(FaultCode.RECOVERED, "the session steps again"))
        authority.stalled = stalled
        if not is_parent(self._start.parent_pid):
            self.end(ORPHANED)


def _make_alignment_service(context: FrontContext) -> AlignmentService:
    config = context.config
    return AlignmentService(
        context.coalescer.offer,
        context.drops,
        anchors=config.anchors,
        anchor_sizes=config.anchor_sizes,
        anchor_marks=config.anchor_marks,
        proposal_period_ns=config.proposal_period_ns,
        max_connections=config.limits.connections,
        worker=Worker(ThreadPoolExecutor(1, "estimates")),
    )


def _make_media_proxy(context: FrontContext, sockets: FrontSockets) -> MediaProxy:
    config, limits, recorder = context.config, context.config.limits, None
    if config.recorder_media_endpoint and config.record_clouds_hz:
        recorder = MediaRecorder(sockets.context, config.recorder_media_endpoint, config.record_clouds_hz)
    sources = _make_bounds(context, limits.sources, limits.source_bytes)
    sources = sources._replace(owner_bytes=limits.source_bytes, total_bytes=limits.ingest_bytes)
    return MediaProxy(
        sockets.media.socket,
        _make_guard(context, "media", sockets.media.monitor, _make_bounds(context, limits.subscribers)),
        _make_guard(context, "media", sockets.ingest.monitor, sources),
        sockets.local_ingest,
        sockets.ingest.socket,
        context.now_ns,
        encrypted=context.keyring.key is not None,
        recorder=recorder,
    )


def _make_asset_server(context: FrontContext, sockets: FrontSockets) -> AssetServer:
    bounds = _make_bounds(context, context.config.limits.subscribers)
    guard = _make_guard(context, "assets", sockets.assets.monitor, bounds)
    return AssetServer(sockets.assets, guard, context.now_ns)


def _make_bounds(context: FrontContext, connections: int, unread_bytes: int = READER_BYTES) -> TcpBounds:
    """Return the bounds of a channel with at most so many connections, and as many that have said nothing."""
    limits = context.config.limits
    return TcpBounds(
        unauthenticated=connections,
        established=connections,
        find_share=partial(find_channel_share, context.keyring, limits),
        silence_ns=limits.hello_timeout_ns,
        unread_bytes=unread_bytes,
    )


def _make_guard(context: FrontContext, channel: str, monitor: zmq.Socket[bytes], bounds: TcpBounds) -> TcpGuard:
    traffic = TrafficCounter(curve=context.keyring.key is not None)
    return TcpGuard(bounds, make_reasons(channel), monitor, traffic=traffic)
