"""`FrontLink`: the authority's side of the link to the front. Entries in, decisions and state out; it never waits."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec
import numpy as np
import numpy.typing as npt
import zmq

from iris_session.link import messages
from iris_session.link.config import FrontConfig, Ports, SceneInfo
from iris_session.link.sockets import readable
from iris_session.protocol.entries import HOST, Entry, FrontRestarted, decode_entries
from iris_session.protocol.server_messages import ParticipantLeft, PresenceItem, RobotState, StateHeader
from iris_session.protocol.status import StatusReport
from iris_session.protocol.steps import Decision, Dropped

#: Messages read from the front in one `poll`; its credits bound how many can be queued.
_POLL_BOUND: Final = 64
_SEND_QUEUE: Final = 256
#: Decisions queued while the front does not read; when the queue is full the front is replaced.
_BACKLOG: Final = 4096
#: Presence is sent right after a state frame, so that clients wake up once for both; without one after this time.
PRESENCE_ALONE_NS: Final = 50_000_000
#: Longest time between two polls of the link that counts as silence of the front.
LOOKED_NS: Final = 100_000_000
#: State frames are sent at tick times, so their distance varies by a tick.
PRESENCE_SLACK_NS: Final = 4_000_000
#: Maximum number of revoked keys of which the front has not said that it knows them.
_REVOCATIONS: Final = 4096


class FrontLink:
    """Link to one front process at a time; `open` begins again for a new one.

    Attributes:
        ports: Ports of the front, `None` until it is ready.
        failure: Reason why the front could not start, empty when it could.
        status: Counters of the front, added to those of the fronts before it.
        handback: Opaque state of the front, for its successor.
        state_drops: State frames dropped because the front was not reading.
        overrun: True when the queue of decisions is full: the front no longer reads.
    """

    def __init__(self, config: FrontConfig, monotonic_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._config = config
        self._monotonic_ns = monotonic_ns
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context(io_threads=1)
        self._socket: zmq.Socket[bytes] | None = None
        self._entries: list[Entry] = []
        self._presence: dict[tuple[str, str], PresenceItem] = {}
        self._presence_ns = 0
        self._sent_ns = 0
        self._backlog: deque[tuple[bytes, bytes]] = deque()
        self.ports: Ports | None = None
        self.failure = ""
        self.status = self._status_before = messages.FrontStatus(0, {}, {})
        self._silence_ns = 0
        self._received_ns = 0
        self._scene: bytes | None = None
        self.handback = b""
        self._revocations: dict[str, int] = {}  # keys that the front may not know yet, and the steps that revoked them
        self.state_drops = 0
        self.overrun = False
        # Half of the front's credits are acknowledged at once: fewer wake-ups, and the front never runs out of credit.
        self._acknowledge_at = max(1, config.limits.unacknowledged // 2)
        self._taken = 0

    def open(self, path: Path) -> str:
        """Listen for the next front on a new ipc socket at `path`. Return the endpoint."""
        if self._socket is not None:
            self.receive()  # the last messages of a front that died: an e-stop, the resume tokens it issued
            self._socket.close(linger=0)
            if self.ports is not None:
                self._entries.append(Entry(HOST, HOST, self.now_ns, FrontRestarted()))
        self.ports, self.failure, self.overrun = None, "", False
        self._status_before = msgspec.structs.replace(self.status, connections=0, dropped_by={})
        self._scene = None  # the next front starts with it
        self._silence_ns = 0
        self._backlog.clear()
        self._taken = 0
        endpoint = f"ipc://{path}"
        self._socket = self._listen(endpoint)
        return endpoint

    def _listen(self, endpoint: str) -> zmq.Socket[bytes]:
        socket = self._context.socket(zmq.PAIR)
        socket.setsockopt(zmq.SNDHWM, _SEND_QUEUE)
        socket.setsockopt(zmq.RCVHWM, 0)  # bounded by the front's credits
        socket.bind(endpoint)
        return socket

    @property
    def silence_ns(self) -> int:
        """Time for which a front that was ready has sent nothing although the link was polled [ns]."""
        return self._silence_ns if self.ports is not None else 0

    @property
    def now_ns(self) -> int:
        """Session time [ns]."""
        return self._monotonic_ns() - self._config.origin_ns

    def poll(self) -> list[Entry]:
        """Return the entries since the last call, in the order for the authority. Never waits."""
        self.receive()
        entries, self._entries = self._entries, []
        return entries

    def receive(self) -> None:
        """Read the queued messages; `poll` returns the entries. Bounded by the front's credits. Never waits."""
        socket = self._socket
        now_ns = self._monotonic_ns()
        # Only time between polls counts: a pause of the authority itself is not silence of the front.
        self._silence_ns += min(now_ns - self._received_ns, LOOKED_NS)
        self._received_ns = now_ns
        if socket is None or not readable(socket):
            return
        self._silence_ns = 0
        batches = 0
        for _ in range(_POLL_BOUND):
            kind, payload = socket.recv_multipart(zmq.DONTWAIT)
            if kind == messages.ENTRIES:
                self._entries += decode_entries(payload)
                batches += 1
            elif kind == messages.HANDBACK:
                self._take_token_state(messages.decode_token_state(payload))
            elif kind == messages.STATUS:
                self.status = messages.add_status(self._status_before, messages.decode_status(payload))
            elif kind == messages.READY:
                self.ports = messages.decode_ports(payload)
                if self._scene is not None:
                    self._send(messages.SCENE, self._scene)
                self._repeat_revocations()
            elif kind == messages.FAILED:
                self.failure = payload.decode()
            if not readable(socket):
                break
        self._taken += batches
        if self._taken >= self._acknowledge_at:
            self._send(messages.ACK, bytes((self._taken,)))
            self._taken = 0

    def _take_token_state(self, state: messages.TokenState) -> None:
        self.handback = state.state
        self._revocations = {key: step for key, step in self._revocations.items() if step > state.step}

    def _repeat_revocations(self) -> None:
        """Revoke keys again at a front that is ready: the one before may have ended before it read that."""
        if self._revocations:
            dropped = tuple(Dropped(HOST, "revoked", key) for key in self._revocations)
            decided = messages.Decided(max(self._revocations.values()), dropped=dropped)
            self._send(messages.DECIDED, messages.encoder.encode(decided))

    def send_decision(self, step: int, decision: Decision) -> None:
        """Send the part of a decision that leaves the process. Call it in every step: it also keeps the link alive."""
        for item in decision.presence:
            self._presence[(item.participant, item.device)] = item
        for event in decision.events:
            if isinstance(event.body, ParticipantLeft):
                for key in [key for key in self._presence if key[0] == event.body.participant]:
                    del self._presence[key]
        for dropped in decision.dropped:
            if dropped.key_id:
                self._revocations[dropped.key_id] = step
                if len(self._revocations) > _REVOCATIONS:
                    del self._revocations[next(iter(self._revocations))]
        if decision.outgoing or decision.events or decision.admitted or decision.dropped:
            decided = messages.Decided(step, decision.admitted, decision.outgoing, decision.events, decision.dropped)
            self._send(messages.DECIDED, messages.encoder.encode(decided))
        now_ns = self._monotonic_ns()
        if self._presence and now_ns - self._presence_ns >= PRESENCE_ALONE_NS:
            self._send_presence(now_ns)
        elif now_ns - self._sent_ns > messages.KEEPALIVE_NS:
            self._send(messages.ALIVE, b"")

    def _send_presence(self, now_ns: int) -> None:
        self._presence_ns = now_ns
        items = tuple(self._presence.values())
        self._presence.clear()
        self._send(messages.PRESENCE, messages.encoder.encode(items))

    def send_state(
        self, header: StateHeader, poses: npt.NDArray[np.float64], robots: tuple[RobotState, ...] = ()
    ) -> None:
        """Send the state after a tick. Frames that the front has no room for are dropped and counted in `state_drops`.

        Args:
            header: Header of the frame; the front fills `published_ns`, `state_seq` and `base_seq`.
            poses: T_world_body, float64 (n_bodies, 7) `x y z qw qx qy qz` [m], C-contiguous, in the order of the
                scene's bodies.
            robots: States of the robots after the same tick, if they are to be published.
        """
        if self._socket is None or self.ports is None:
            return
        frames: list[bytes | memoryview] = [
            messages.STATE,
            messages.encoder.encode(header),
            np.ascontiguousarray(poses).data,
        ]
        if robots:
            frames.append(messages.encoder.encode(robots))
        try:
            self._socket.send_multipart(frames, zmq.DONTWAIT)
            self._sent_ns = self._monotonic_ns()
        except zmq.Again:
            self.state_drops += 1
        if self._presence and self._sent_ns - self._presence_ns >= self._config.presence_period_ns - PRESENCE_SLACK_NS:
            self._send_presence(self._sent_ns)

    def send_report(self, report: StatusReport) -> None:
        """Send the authority's half of the status. Only the newest counts: a front that is not reading gets none."""
        if not self._backlog:
            self._send(messages.REPORT, messages.encoder.encode(report))

    def send_scene(self, scene: SceneInfo) -> None:
        """Send another scene: later snapshots and states are of its bodies. A front that starts gets it when ready."""
        self._scene = messages.encoder.encode(scene)
        self._send(messages.SCENE, self._scene)

    def send_end(self) -> None:
        """Ask the front to notify its clients that the session ends, and to exit."""
        self._send(messages.END, b"")

    def _send(self, kind: bytes, payload: bytes) -> None:
        """Send in order; queue a bounded number of messages while the front is not reading."""
        if self._socket is None or self.ports is None:
            return
        self._backlog.append((kind, payload))
        try:
            while self._backlog:
                self._socket.send_multipart(self._backlog[0], zmq.DONTWAIT)
                self._backlog.popleft()
        except zmq.Again:
            self.overrun = self.overrun or len(self._backlog) > _BACKLOG
            if self.overrun:
                self._backlog.clear()
            return
        self._sent_ns = self._monotonic_ns()

    def close(self) -> None:
        """Close the socket. The front notices it by `send_end`, or by the end of its parent."""
        if self._socket is not None:
            self._socket.close(linger=200)
            self._socket = None
        self._context.term()
