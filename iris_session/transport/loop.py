"""The one loop of the front process, all sockets wired. No thread of ours.

It drains the link to the authority first (state goes out before anything else), then the control socket in small
rounds with a look at the link in between. It never waits for a client, nor for the authority.
"""

from __future__ import annotations

import gc
import time

import zmq
from zmq.utils.monitor import parse_monitor_message

from iris_session.protocol.entries import Entry, Lost, encode_entries
from iris_session.protocol.names import FaultCode
from iris_session.protocol.server_messages import ProtocolFault
from iris_session.transport import link_messages as link
from iris_session.transport.admission import Admission
from iris_session.transport.clients import ClientTable, Connection, Outbox, Peer
from iris_session.transport.coalescer import Coalescer
from iris_session.transport.config import MILLISECOND, FrontError, FrontStart, Ports
from iris_session.transport.downlink import Downlink
from iris_session.transport.intake import Intake, RawFeed
from iris_session.transport.limiter import Drops
from iris_session.transport.parent import parent_is
from iris_session.transport.resume_tokens import ResumeTokens
from iris_session.transport.sockets import (
    bound_port,
    close_tcp,
    host_in_address,
    open_control,
    open_state,
    readable,
    server_key,
    watch_disconnects,
)
from iris_session.transport.state_publisher import StatePublisher
from iris_session.transport.zap import Authenticator, KeyList

#: Messages of clients handled before the link is looked at again: about 0.2 ms.
ROUND = 8
ROUNDS = 16
IDLE_MS = 10
HOUSEKEEPING_NS = 10 * MILLISECOND
#: How long what a closed connection has sent may wait behind the messages of others.
LAST_WORDS_NS = 100 * MILLISECOND
STATUS_NS = 500 * MILLISECOND
#: Cyclic garbage is rare here; it is collected when nothing waits.
COLLECT_NS = 10_000 * MILLISECOND
#: A restarted front numbers its state frames above those of its predecessor: state is sent at less than 1 kHz.
SEQ_NS = MILLISECOND
#: Between the last message and the end of the connections: libzmq throws away what a client (with `IMMEDIATE`) has
#: not read when its connection closes.
FAREWELL_S = 0.1
ENDED = "closed by its owner"
ORPHANED = "its process is gone"


class Front:
    """`run` returns when the session ends; `close` frees the sockets.

    Raises `FrontError` when a socket cannot be opened; the authority has been told why then.
    """

    def __init__(self, start: FrontStart) -> None:
        self._start = start
        config = self._config = start.config
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._link = self._context.socket(zmq.PAIR)
        self._link.setsockopt(zmq.LINGER, 1000)
        self._link_monitor = watch_disconnects(self._link, "link")
        self._link.connect(start.link_endpoint)
        self._drops = Drops()
        try:
            self._open_sockets()
        except FrontError as error:
            self._link.send_multipart((link.FAILED, str(error).encode()))
            self.close()
            raise
        self._clients = ClientTable()
        self._outbox = Outbox(self._control, config.limits, self._drops)
        self._tokens = ResumeTokens(config.limits.resume_tokens, start.handback)
        admission = self._admission = Admission(
            config, self._ports, self._clients, self._outbox, self._drops, self._tokens
        )
        self._coalescer = Coalescer(config.limits, self._drops)
        raw = RawFeed(self._context, config.recorder_endpoint, self._drops)
        self._intake = Intake(
            config, self._clients, self._outbox, admission, self._coalescer, raw, self._drops, self._session_ns
        )
        first_seq = 1 + (self._session_ns() // SEQ_NS if start.handback else 0)
        self._publisher = StatePublisher(self._state, start.scene, self._session_ns, first_seq)
        self._downlink = Downlink(
            self._link,
            self._clients,
            self._outbox,
            admission,
            self._publisher,
            self._drops,
            self._session_ns,
            self._forget,
        )
        self.ended = ""
        #: The link closed without a word: its process ends, or has ended already.
        self.cut_off = False
        self._closed: list[tuple[Connection, int]] = []
        self._batches = 0
        self._entries = 0
        self._stalls = 0
        self._stalled = False
        self._reported = (-1, -1, -1)
        self._next_status_ns = self._next_housekeeping_ns = self._next_collect_ns = 0

    def _open_sockets(self) -> None:
        config = self._config
        key = server_key(config)
        self._authenticator = (
            Authenticator(self._context, KeyList(config.curve_clients_dir), self._drops) if key is not None else None
        )
        self._control = open_control(self._context, config, key)
        self._state = open_state(self._context, config, key)
        self._monitor = watch_disconnects(self._control, "control")
        self._ports = Ports(
            host_in_address(config.host),
            bound_port(self._control),
            bound_port(self._state),
            key.fingerprint if key else "",
        )

    def _session_ns(self) -> int:
        return time.monotonic_ns() - self._config.origin_ns

    def end(self, reason: str) -> None:
        """Lets `run` return after the clients were told."""
        self.ended = self.ended or reason

    def run(self) -> None:
        """Serves until the authority or a signal ends it, or the parent is gone."""
        self._link.send_multipart((link.READY, link.encoder.encode(self._ports)))
        poller = zmq.Poller()
        watched = [self._link, self._link_monitor, self._control, self._monitor]
        if self._authenticator is not None:
            watched.append(self._authenticator.socket)
        for one in watched:
            poller.register(one, zmq.POLLIN)
        busy = False
        while not self.ended:
            poller.poll(0 if busy else IDLE_MS)
            busy = self._pass()
        self._downlink.broadcast(ProtocolFault(FaultCode.SESSION_ENDED, f"the session has ended: {self.ended}"))
        if len(self._clients):
            time.sleep(FAREWELL_S)

    def _pass(self) -> bool:
        """One pass of the loop. True when clients still have something to say."""
        self._downlink.drain()
        if self._authenticator is not None:
            self._authenticator.answer()
        more = True
        for _ in range(ROUNDS):
            self._drain_monitor()
            more = self._drain_control()
            self._flush()
            self._downlink.drain()
            if not more:
                break
        self._take_leave(drained=not more)
        self._housekeeping(idle=not more)
        self._flush()
        return more

    def close(self) -> None:
        """Closes every socket; what was sent leaves within its linger time."""
        self._context.destroy()

    # --- from clients ------------------------------------------------------------------------------------------------

    def _drain_control(self) -> bool:
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
            peer = Peer(int(frame.get(zmq.SRCFD)), str(frame.get("User-Id")) if with_user else "")
            self._intake.take(routing_id, peer, frame.buffer, extra)
        return True

    def _drain_monitor(self) -> None:
        """Notes the connections whose TCP connection was closed."""
        while readable(self._monitor):
            descriptor = parse_monitor_message(self._monitor.recv_multipart())["value"]
            self._admission.forget_peer(descriptor)
            deadline_ns = self._session_ns() + LAST_WORDS_NS
            self._closed += [
                (c, deadline_ns) for c in self._clients.by_number.values() if c.peer.descriptor == descriptor
            ]

    def _take_leave(self, drained: bool) -> None:
        """Of connections that are closed (after their last words: an e-stop may still wait in the socket), were
        replaced by another hello on their route, or did not take what was sent."""
        if self._closed:
            now_ns = self._session_ns()
            gone = [c for c, deadline_ns in self._closed if drained or now_ns > deadline_ns]
            self._closed = [] if drained else [item for item in self._closed if item[1] >= now_ns]
            for connection in gone:
                if self._clients.by_number.get(connection.number) is connection:
                    self._lose(connection, "closed")
        replaced, self._intake.replaced = self._intake.replaced, []
        for connection in replaced:
            self._lose(connection, "replaced")
        failed, self._outbox.failed = self._outbox.failed, {}
        for number, reason in failed.items():
            slow = self._clients.by_number.get(number)
            if slow is not None:
                self._lose(slow, reason)
                close_tcp(slow.peer.descriptor, slow.address)

    def _lose(self, connection: Connection, reason: str) -> None:
        """Tells the authority that a connection, and those behind it, are gone."""
        for one in (connection, *self._clients.behind(connection)):
            self._clients.remove(one)
            self._intake.desks.pop(one.number, None)
            self._drops.forget(one.number)
            self._coalescer.offer(Entry(one.number, one.number, self._session_ns(), Lost(reason)))

    def _forget(self, connection: Connection) -> None:
        """The authority is done with a connection: it need not hear of it again."""
        self._clients.remove(connection)
        self._intake.desks.pop(connection.number, None)
        self._drops.forget(connection.number)
        self._coalescer.forget(connection.number)

    # --- to the authority --------------------------------------------------------------------------------------------

    def _flush(self) -> None:
        """Sends what waits, as far as credit goes; urgent entries have credits of their own."""
        limit = self._config.limits.unacknowledged
        used = self._batches - self._downlink.acknowledged
        batch: list[Entry] = []
        if used < limit:
            batch = self._coalescer.take() if self._coalescer else []
        elif self._coalescer.urgent and used < 2 * limit:
            batch = self._coalescer.take(urgent_only=True)
        listens = self._downlink.heard_ns > 0 and not self._stalled
        if self._tokens.changed and (batch or listens):
            self._link.send_multipart((link.HANDBACK, self._tokens.blob()), zmq.DONTWAIT)
        if batch:
            self._link.send_multipart((link.ENTRIES, encode_entries(batch)), zmq.DONTWAIT)
            self._batches += 1
            self._entries += len(batch)

    # --- now and then ------------------------------------------------------------------------------------------------

    def _housekeeping(self, idle: bool) -> None:
        now_ns = self._session_ns()
        self._watch_end()
        if now_ns < self._next_housekeeping_ns:
            return
        self._next_housekeeping_ns = now_ns + HOUSEKEEPING_NS
        silent = [c for c in self._clients.by_number.values() if now_ns - c.last_heard_ns > self._config.silence_ns]
        for connection in silent:
            self._lose(connection, "silent")
        self._propose(now_ns)
        self._watch_stall(now_ns)
        if now_ns >= self._next_status_ns:
            self._next_status_ns = now_ns + STATUS_NS
            self._report()
        if idle and now_ns >= self._next_collect_ns:
            self._next_collect_ns = now_ns + COLLECT_NS
            gc.collect()

    def _propose(self, now_ns: int) -> None:
        """At most one estimate a pass: it takes up to milliseconds, and state waits meanwhile."""
        for number, desk in self._intake.desks.items():
            if desk.due(now_ns):
                proposal = desk.propose(now_ns)
                if proposal is not None:
                    self._coalescer.offer(Entry(number, number, now_ns, proposal))
                return

    def _watch_end(self) -> None:
        """The link closes with the session's process, however that ended, or with the session."""
        if self._downlink.ended:
            self.end(ENDED)
        elif readable(self._link_monitor):
            self.cut_off = True
            self.end(ENDED if parent_is(self._start.parent_pid) else ORPHANED)

    def _watch_stall(self, now_ns: int) -> None:
        """Called after the link was drained, so a front that was kept from running does not blame the authority."""
        heard_ns = self._downlink.heard_ns
        stalled = heard_ns > 0 and now_ns - heard_ns > self._config.stall_ns
        if stalled and not self._stalled:
            self._stalls += 1
            self._downlink.broadcast(ProtocolFault(FaultCode.STALLED, "the session does not step: robots hold"))
        elif self._stalled and not stalled:
            self._downlink.broadcast(ProtocolFault(FaultCode.RECOVERED, "the session steps again"))
        self._stalled = stalled
        if not parent_is(self._start.parent_pid):
            self.end(ORPHANED)

    def _report(self) -> None:
        """Counters to the authority, while it listens."""
        drops = self._drops
        now = (drops.version, len(self._clients), self._entries)
        if now == self._reported or self._stalled:
            return
        self._reported = now
        status = link.FrontStatus(
            len(self._clients),
            drops.by_reason,
            drops.by_connection,
            self._stalls,
            self._publisher.frames,
            self._entries,
        )
        self._link.send_multipart((link.STATUS, link.encoder.encode(status)), zmq.DONTWAIT)
