"""The one loop of the front process, all sockets wired. Threads: of media, of assets, and of `FileWorker`.

It drains the link to the authority first (state goes out before anything else), then the control socket in small
rounds with a look at the link in between. It never waits for a client, nor for the authority.
"""

from __future__ import annotations

import gc
import time

import zmq

from iris_session.alignment.service import AlignmentService
from iris_session.front.admission import Admission
from iris_session.front.announce import SessionFacts, make_discovery_services
from iris_session.front.asset_server import REQUEST_BYTES, AssetServer
from iris_session.front.asset_service import AssetService
from iris_session.front.audit import AuditTrail
from iris_session.front.coalescer import Coalescer
from iris_session.front.connection_guard import ChannelGuard, ConnectionGuard, MemoryGuard
from iris_session.front.connections import ConnectionTable, Outbox, Peer, TrafficCounter
from iris_session.front.disconnects import DisconnectHandler
from iris_session.front.downlink import Downlink
from iris_session.front.front_sockets import FrontSockets
from iris_session.front.intake import Intake, RawFeed
from iris_session.front.media.proxy import MediaProxy
from iris_session.front.media.service import MediaService
from iris_session.front.pairing import PairingService
from iris_session.front.revocation import RevocationService
from iris_session.front.service import Service
from iris_session.front.session_note import SessionNoteService
from iris_session.front.state_publisher import StatePublisher
from iris_session.front.status import StatusService, Telling
from iris_session.front.uplink import Uplink
from iris_session.link import messages as link
from iris_session.link.config import MILLISECOND, FrontStart
from iris_session.link.sockets import readable
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import AuditKind, FaultCode
from iris_session.protocol.server_messages import ProtocolFault
from iris_session.security.resume_tokens import ResumeTokens
from iris_session.system.process import is_parent

#: Messages of clients handled before the link is looked at again: about 0.2 ms.
ROUND = 8
ROUNDS = 16
IDLE_MS = 10
HOUSEKEEPING_NS = 10 * MILLISECOND
#: Cyclic garbage is rare here; it is collected when nothing waits.
COLLECT_NS = 10_000 * MILLISECOND
#: A restarted front numbers its state frames above those of its predecessor: state is sent at less than 1 kHz.
SEQ_NS = MILLISECOND
#: Between the last message and the end of the connections: libzmq throws away what a client (with `IMMEDIATE`) has
#: not read when its connection closes.
FAREWELL_S = 0.1
#: Of one subscriber to media, that wait to be read: far more than all its topics have.
SUBSCRIBER_BYTES = 65_536
ENDED = "closed by its owner"
ORPHANED = "its process is gone"


class Front:
    """`run` returns when the session ends; `close` frees the sockets.

    Raises `FrontError` when a socket cannot be opened; the authority has been told why then.
    """

    def __init__(self, start: FrontStart) -> None:
        self._start = start
        config = self._config = start.config
        self._services: list[Service] = []  # in the order of their turns
        self._drops = Drops()
        self._clients = ConnectionTable()
        sockets = self._sockets = FrontSockets(start, self._drops, self._key_refused)
        self._link, self._control = sockets.link, sockets.control.socket
        self._keyring = sockets.keyring
        self._traffic = TrafficCounter(curve=self._keyring.key is not None)
        self._outbox = Outbox(self._control, config.limits, self._drops, self._traffic)
        self._tokens = ResumeTokens(config.limits.resume_tokens, start.handback)
        self._coalescer = Coalescer(config.limits, self._drops)
        self._audit = AuditTrail(self._coalescer.offer)
        guard = self._guard = ConnectionGuard(self._clients, self._drops, self._audit, config.limits, self._traffic)
        guard.watch_state_socket(*sockets.state)
        admission = self._admission = Admission(
            config,
            sockets.ports,
            self._clients,
            self._outbox,
            self._drops,
            self._tokens,
            self._keyring,
            self._audit,
            guard,
        )
        self._pairing = PairingService(self._keyring, self._outbox, self._audit, self._drops)
        raw = RawFeed(sockets.context, config.recorder_endpoint, self._drops)
        self._status = StatusService(config, self._clients, self._outbox, self._drops, self._telling)
        self._media = self._make_media()
        self._status.media_row = self._media.report_participant
        alignment = AlignmentService(
            self._coalescer.offer,
            self._drops,
            anchors=config.anchors,
            anchor_sizes=config.anchor_sizes,
            proposal_period_ns=config.proposal_period_ns,
            max_connections=config.limits.connections,
        )
        self._status.alignment_report = alignment.complete_report
        memory = MemoryGuard(config.limits.memory_bytes, lambda: guard.evict_for_memory(self._give_way), self._shed)
        self._services += [self._keyring, self._status, self._media, guard, memory]
        self._intake = Intake(
            config,
            self._clients,
            self._outbox,
            admission,
            self._coalescer,
            raw,
            self._drops,
            self.now_ns,
            self._status,
            self._pairing,
            self._audit,
            guard,
            alignment,
        )
        departures = self._departures = DisconnectHandler(
            sockets.control.monitor,
            self._clients,
            self._outbox,
            admission,
            self._coalescer,
            self._drops,
            self._status,
            alignment,
            self.now_ns,
            guard,
        )
        first_seq = 1 + (self.now_ns() // SEQ_NS if start.handback else 0)
        self._publisher = StatePublisher(sockets.state.socket, start.scene, self.now_ns, first_seq)
        revocation = RevocationService(
            self._keyring,
            self._clients,
            self._outbox,
            self._tokens,
            self._audit,
            self._publisher,
            self._coalescer.offer,
            departures.report_lost,
            self._open_state_again,
        )
        self._assets = self._make_assets()
        admission.lets_in += [self._media.sync_clients, self._assets.sync_clients]
        self._services += [self._pairing, revocation, self._audit, self._assets]
        self._downlink = Downlink(
            self._link,
            self._clients,
            self._outbox,
            admission,
            self._publisher,
            self._drops,
            self.now_ns,
            departures.remove,
            revocation,
            alignment,
            self._assets.sync_clients,
        )
        self.ended = ""
        #: The link closed without a word: its process ends, or has ended already.
        self.cut_off = False
        self._authenticator = sockets.authenticator
        if self._authenticator is not None:
            self._authenticator.is_revoked = self._tokens.is_revoked
        self._uplink = Uplink(
            self._link,
            config.limits.unacknowledged,
            self._coalescer,
            self._downlink,
            self._tokens,
            self._clients,
            self._drops,
            self._publisher,
        )
        self._services += [*self._announced(), alignment]
        self._next_housekeeping_ns = self._next_collect_ns = 0

    def _announced(self) -> list[Service]:
        """What makes the session known, on the network and in the home of keys."""
        sockets, config, key = self._sockets, self._config, self._keyring.key
        facts = SessionFacts(key.public if key else "", lambda: self._pairing.has_open_code, lambda: len(self._clients))
        services: list[Service] = []
        if self._keyring.home is not None:
            services.append(SessionNoteService(self._keyring.home, self._keyring.files, config, sockets.ports))
        return services + make_discovery_services(config, sockets.ports, sockets.listeners, self._drops, facts)

    def _make_media(self) -> MediaService:
        sockets, encrypted = self._sockets, self._keyring.key is not None
        limits = self._config.limits
        proxy = MediaProxy(
            sockets.media.socket,
            ChannelGuard(sockets.media.monitor, limits, limits.subscribers, SUBSCRIBER_BYTES, curve=encrypted),
            ChannelGuard(sockets.ingest.monitor, limits, limits.sources, limits.source_bytes, curve=encrypted),
            sockets.local_ingest,
            sockets.ingest.socket,
            self.now_ns,
            encrypted=encrypted,
        )
        self._give_way = proxy.release_memory
        return MediaService(
            proxy,
            self._clients,
            self._outbox,
            self._keyring,
            self._drops,
            self._status.find_report,
            self._tokens.is_revoked,
            lambda: self._publisher.frames,
            adapt=self._config.adapt_media,
        )

    def _make_assets(self) -> AssetService:
        sockets, encrypted, limits = self._sockets.assets, self._keyring.key is not None, self._config.limits
        guard = ChannelGuard(sockets.monitor, limits, limits.subscribers, REQUEST_BYTES, curve=encrypted, name="assets")
        server = AssetServer(sockets, guard, self.now_ns)
        return AssetService(server, self._clients, self._keyring, self._drops, self._publisher, self._tokens.is_revoked)

    def _open_state_again(self) -> zmq.Socket[bytes]:
        state = self._sockets.open_state(self._sockets.ports.state)
        self._guard.watch_state_socket(*state)
        return state.socket

    def _shed(self, whom: str, now_ns: int) -> None:
        self._guard.report_flood("", f"memory: closed {whom}", now_ns, warning=f"memory ran short: closed {whom}")

    def now_ns(self) -> int:
        return time.monotonic_ns() - self._config.origin_ns

    def _key_refused(self, mark: str, address: str) -> None:
        self._audit.record(AuditKind.KEY_REFUSED, self.now_ns(), subject=mark, address=address, detail="state")

    def end(self, reason: str) -> None:
        """Lets `run` return after the clients were told."""
        self.ended = self.ended or reason

    def run(self) -> None:
        """Serves until the authority or a signal ends it, or the parent is gone."""
        self._link.send_multipart((link.READY, link.encoder.encode(self._sockets.ports)))
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
        if len(self._clients):
            time.sleep(FAREWELL_S)

    def _run_once(self) -> bool:
        """One pass of the loop. True when clients still have something to say."""
        self._downlink.drain()
        if self._authenticator is not None:
            self._authenticator.answer_requests()
        more = True
        for _ in range(ROUNDS):
            self._departures.drain_monitor()
            more = self._receive_messages()
            self._uplink.flush()
            self._downlink.drain()
            if not more:
                break
        replaced, self._intake.replaced = self._intake.replaced, []
        self._departures.process_disconnects(replaced, drained=not more)
        self._run_services(idle=not more)
        self._uplink.flush()
        return more

    def close(self) -> None:
        """Closes every socket; what was sent leaves within its linger time."""
        for service in self._services:
            service.close()
        self._sockets.close()

    # --- from clients ------------------------------------------------------------------------------------------------

    def _receive_messages(self) -> bool:
        """Takes up to `ROUND` messages. True when there may be more."""
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
            try:
                peer = Peer(int(frame.get(zmq.SRCFD)), str(frame.get("User-Id")) if with_user else "")
            except zmq.ZMQError:  # a browser, or a ZeroMQ of before 2013: libzmq does not tell by which connection
                self._drops.count("unversioned_peer")
                continue
            self._traffic.count_received(peer.descriptor, len(frame.buffer))
            self._intake.handle_message(routing_id, peer, frame.buffer, extra)
        return True

    # --- now and then ------------------------------------------------------------------------------------------------

    def _run_services(self, idle: bool) -> None:
        now_ns = self.now_ns()
        self._check_end()
        if now_ns < self._next_housekeeping_ns:
            return
        self._next_housekeeping_ns = now_ns + HOUSEKEEPING_NS
        self._departures.disconnect_silent(now_ns, self._config.silence_ns)
        for service in self._services:
            service.tick(now_ns)
        self._publisher.poll()
        self._check_stall(now_ns)
        self._uplink.tick(now_ns)
        if idle and now_ns >= self._next_collect_ns:
            self._next_collect_ns = now_ns + COLLECT_NS
            gc.collect()

    def _check_end(self) -> None:
        """The link closes with the session's process, however that ended, or with the session."""
        if self._downlink.ended:
            self.end(ENDED)
        elif readable(self._sockets.link_monitor):
            self.cut_off = True
            self.end(ENDED if is_parent(self._start.parent_pid) else ORPHANED)

    def _check_stall(self, now_ns: int) -> None:
        """Called after the link was drained, so a front that was kept from running does not blame the authority."""
        heard_ns = self._downlink.heard_ns
        stalled = heard_ns > 0 and now_ns - heard_ns > self._config.stall_ns
        if stalled and not self._uplink.stalled:
            self._uplink.stalls += 1
            self._downlink.broadcast(ProtocolFault(FaultCode.STALLED, "the session does not step: robots hold"))
        elif self._uplink.stalled and not stalled:
            self._downlink.broadcast(ProtocolFault(FaultCode.RECOVERED, "the session steps again"))
        self._uplink.stalled = stalled
        if not is_parent(self._start.parent_pid):
            self.end(ORPHANED)

    def _telling(self) -> Telling:
        return Telling(
            self._publisher.read_recent_delays_ns(),
            self._downlink.heard_ns,
            self._downlink.report,
            self._uplink.stalled,
            self._uplink.entries,
            self._guard.list_warnings(self.now_ns()),
            self._media.report_streams(),
            self._assets.report(),
        )
