"""The front process: every socket for clients, one loop, no thread of ours. `python -m iris_session.transport.front`.

The loop drains the link to the authority first (state goes out before anything else), then the control socket in
small rounds with a look at the link in between. It never waits for a client, nor for the authority.
"""

from __future__ import annotations

import gc
import signal
import sys
import time
from types import FrameType

import msgspec
import zmq
from zmq.utils.monitor import parse_monitor_message

from iris_session.protocol.entries import Entry, Lost, encode_entries
from iris_session.protocol.server_messages import ProtocolFault, Snapshot
from iris_session.transport import link_messages as link
from iris_session.transport.admission import Admission
from iris_session.transport.clients import ClientTable, Connection, Outbox, Peer, encode_message
from iris_session.transport.coalescer import Coalescer
from iris_session.transport.config import MILLISECOND, FrontError, FrontStart, Ports
from iris_session.transport.intake import Intake, RawFeed
from iris_session.transport.limiter import Drops
from iris_session.transport.parent import die_with_parent, parent_is
from iris_session.transport.resume_tokens import ResumeTokens
from iris_session.transport.sockets import (
    bound_port,
    close_tcp,
    open_control,
    open_state,
    raise_descriptor_limit,
    readable,
    server_key,
    watch_disconnects,
)
from iris_session.transport.state_publisher import StatePublisher
from iris_session.transport.zap import Authenticator, KeyList

#: Messages of clients handled before the link is looked at again: about 0.3 ms.
ROUND = 16
ROUNDS = 8
LINK_BOUND = 64
IDLE_MS = 10
HOUSEKEEPING_NS = 10 * MILLISECOND
#: How long what a closed connection has sent may wait behind the messages of others.
LAST_WORDS_NS = 100 * MILLISECOND
STATUS_NS = 500 * MILLISECOND
#: Cyclic garbage is rare here (exceptions of strangers' bytes); it is collected when nothing waits.
COLLECT_NS = 10_000 * MILLISECOND
#: A restarted front numbers its state frames above those of its predecessor: state is sent at less than 1 kHz.
SEQ_PER_NS = MILLISECOND


class Front:
    """All sockets, wired. `run` returns when the session ends; `close` frees the sockets."""

    def __init__(self, start: FrontStart) -> None:
        config = self._config = start.config
        self._start = start
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._link = self._context.socket(zmq.PAIR)
        self._link.setsockopt(zmq.LINGER, 1000)
        self._link.connect(start.link_endpoint)
        self.ended = ""
        self._drops = Drops()
        try:
            self._open_sockets()
        except FrontError as error:
            self._link.send_multipart((link.FAILED, str(error).encode()))
            raise
        self._clients = ClientTable()
        self._outbox = Outbox(self._control, config.limits, self._drops)
        self._tokens = ResumeTokens(config.limits.resume_tokens, start.handback)
        self._admission = Admission(
            config, self._ports, self._clients, self._outbox, self._drops, self._tokens, self._hand_back
        )
        self._coalescer = Coalescer(config.limits, self._drops)
        self._intake = Intake(
            config,
            self._clients,
            self._outbox,
            self._admission,
            self._coalescer,
            RawFeed(self._context, config.recorder_endpoint, self._drops),
            self._drops,
            self._session_ns,
        )
        first_seq = 1 + (self._session_ns() // SEQ_PER_NS if start.handback else 0)
        self._publisher = StatePublisher(self._state, start.scene, self._session_ns, first_seq)
        self._closed: list[tuple[Connection, int]] = []
        self._unacknowledged = 0
        self._entries = 0
        self._stalls = 0
        self._stalled = False
        self._link_heard_ns = 0
        self._reported = (-1, -1)
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
            config.host, bound_port(self._control), bound_port(self._state), key.fingerprint if key else ""
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
        watched = [self._link, self._control, self._monitor]
        if self._authenticator is not None:
            watched.append(self._authenticator.socket)
        for one in watched:
            poller.register(one, zmq.POLLIN)
        busy = False
        while not self.ended:
            poller.poll(0 if busy else IDLE_MS)
            busy = self._pass()
        self._broadcast(ProtocolFault("session_ended", f"the session has ended: {self.ended}"), joining=True)

    def _pass(self) -> bool:
        """One pass of the loop. True when clients still have something to say."""
        self._drain_link()
        if self._authenticator is not None:
            self._authenticator.answer()
        more = True
        for _ in range(ROUNDS):
            self._drain_monitor()
            more = self._drain_control()
            self._flush()
            self._drain_link()
            if not more:
                break
        self._take_leave(drained=not more)
        self._housekeeping(idle=not more)
        self._flush()
        return more

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
            connection_or_none = self._clients.by_number.get(number)
            if connection_or_none is not None:
                self._lose(connection_or_none, reason)
                close_tcp(connection_or_none.peer.descriptor, connection_or_none.address)

    def _lose(self, connection: Connection, reason: str) -> None:
        """Tells the authority that a connection, and those behind it, are gone."""
        for one in (connection, *self._clients.behind(connection)):
            self._forget(one)
            self._coalescer.offer(Entry(one.number, one.number, self._session_ns(), Lost(reason)))

    def _forget(self, connection: Connection) -> None:
        self._clients.remove(connection)
        self._intake.desks.pop(connection.number, None)
        self._drops.forget(connection.number)

    # --- to the authority --------------------------------------------------------------------------------------------

    def _flush(self) -> None:
        """Sends what waits, as far as credit goes; urgent entries have credits of their own."""
        limit = self._config.limits.unacknowledged
        if self._coalescer and self._unacknowledged < limit:
            self._send_batch(self._coalescer.take())
        elif self._coalescer.urgent and self._unacknowledged < 2 * limit:
            self._send_batch(self._coalescer.take(urgent_only=True))

    def _send_batch(self, batch: list[Entry]) -> None:
        if not batch:
            return
        self._link.send_multipart((link.ENTRIES, encode_entries(batch)), zmq.DONTWAIT)
        self._unacknowledged += 1
        self._entries += len(batch)

    def _hand_back(self, blob: bytes) -> None:
        self._link.send_multipart((link.HANDBACK, blob), zmq.DONTWAIT)

    # --- from the authority ------------------------------------------------------------------------------------------

    def _drain_link(self) -> None:
        for _ in range(LINK_BOUND):
            if not readable(self._link):
                return
            frames = self._link.recv_multipart()
            self._link_heard_ns = self._session_ns()
            kind = frames[0]
            if kind == link.STATE:
                if not self._publisher.publish(frames[1], frames[2]):
                    self._drops.count("state_of_other_scene")
            elif kind == link.ACK:
                self._unacknowledged -= frames[1][0]
            elif kind == link.DECIDED:
                self._decided(link.decode_decided(frames[1]))
            elif kind == link.PRESENCE:
                self._publisher.publish_presence(self._link_heard_ns, link.decode_presence(frames[1]))
            elif kind == link.SCENE:
                self._publisher.set_scene(link.decode_scene(frames[1]))
            elif kind == link.END:
                self.end("closed by its owner")

    def _decided(self, decided: link.Decided) -> None:
        """Welcomes, then answers, then events: a snapshot may be older than the events of its step, never newer."""
        now_ns = self._session_ns()
        for admitted in decided.admitted:
            self._admission.welcome(admitted, now_ns)
        for outgoing in decided.outgoing:
            connection = self._clients.by_number.get(outgoing.connection)
            if connection is None:
                continue
            if isinstance(outgoing.message, Snapshot):
                self._send_snapshot(connection, outgoing.message)
            else:
                self._outbox.send(connection, outgoing.message)
            if outgoing.message.__struct_config__.tag == "refused":
                self._forget(connection)
        for event in decided.events:
            encoded = encode_message(event)
            for connection in self._clients.by_number.values():
                if connection.admitted:
                    self._outbox.send_encoded(connection, encoded)
        for dropped in decided.dropped:
            connection = self._clients.by_number.get(dropped.connection)
            if connection is not None:
                self._outbox.send(
                    connection, ProtocolFault("dropped", f"the session let this connection go: {dropped.reason}")
                )
                self._forget(connection)
                self._coalescer.forget(connection.number)

    def _send_snapshot(self, connection: Connection, snapshot: Snapshot) -> None:
        """Adds what only the front knows: the scene, and the poses of the newest state frame."""
        state_seq, poses = self._publisher.keyframe()
        scene = self._publisher.scene
        filled = msgspec.structs.replace(
            snapshot, scene_hash=scene.scene_hash, robots=scene.robots, bodies=scene.bodies, state_seq=state_seq
        )
        self._outbox.send(connection, filled, poses)

    # --- now and then ------------------------------------------------------------------------------------------------

    def _housekeeping(self, idle: bool) -> None:
        now_ns = self._session_ns()
        if now_ns < self._next_housekeeping_ns:
            return
        self._next_housekeeping_ns = now_ns + HOUSEKEEPING_NS
        silent = [c for c in self._clients.by_number.values() if now_ns - c.last_heard_ns > self._config.silence_ns]
        for connection in silent:
            self._lose(connection, "silent")
        self._propose(now_ns)
        self._watch_authority(now_ns)
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

    def _watch_authority(self, now_ns: int) -> None:
        silence_ns = now_ns - self._link_heard_ns if self._link_heard_ns else 0  # 0: it has not begun to step
        stalled = silence_ns > self._config.stall_ns
        if stalled and not self._stalled:
            self._stalls += 1
            self._broadcast(ProtocolFault("stalled", "the session does not step: robots hold"))
        elif self._stalled and not stalled:
            self._broadcast(ProtocolFault("recovered", "the session steps again"))
        self._stalled = stalled
        if not parent_is(self._start.parent_pid):
            self.end("its process is gone")

    def _broadcast(self, message: ProtocolFault, joining: bool = False) -> None:
        encoded = encode_message(message)
        for connection in self._clients.by_number.values():
            if connection.admitted or joining:
                self._outbox.send_encoded(connection, encoded)

    def _report(self) -> None:
        drops = self._drops
        now = (drops.version, len(self._clients))
        if now == self._reported:
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

    def close(self) -> None:
        """Closes every socket; what was sent leaves within its linger time."""
        self._context.destroy()


def main() -> int:
    """Reads `FrontStart` from standard input and serves. Exit status 1 when the front could not start."""
    start = msgspec.msgpack.decode(sys.stdin.buffer.read(), type=FrontStart)
    raise_descriptor_limit()
    try:
        front = Front(start)
    except FrontError:
        return 1  # the link has told why

    def on_signal(number: int, _frame: FrameType | None) -> None:
        if number != signal.SIGHUP or not parent_is(start.parent_pid):
            front.end("its process is gone" if number == signal.SIGHUP else "closed by its owner")

    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, on_signal)
    die_with_parent(signal.SIGHUP)
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        front.run()
    except zmq.Again:
        # The link is full: the authority has taken nothing for longer than its credit allows.
        print("front: the authority does not read its link, giving up", file=sys.stderr)
        return 1
    finally:
        front.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
