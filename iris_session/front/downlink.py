"""What comes from the authority: state to the PUB socket first, then welcomes, answers and events to clients."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import zmq

from iris_session.alignment.service import AlignmentService
from iris_session.front.admission import Admission
from iris_session.front.connections import ConnectionTable, FrontConnection, Outbox, encode_message
from iris_session.front.revocation import RevocationService
from iris_session.front.state_publisher import StatePublisher
from iris_session.link import messages as link
from iris_session.link.sockets import readable
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import FaultCode
from iris_session.protocol.server_messages import (
    Event,
    ParticipantLeft,
    ProtocolFault,
    Refused,
    ServerMessage,
    Snapshot,
)
from iris_session.protocol.steps import OutgoingMessage

_MAX_MESSAGES = 64  # messages taken at once
#: Why a director ends a participation: nobody joins again by itself after that.
REMOVALS = ("removed", "revoked")


class Downlink:
    """Drains the link. `forget` is called with connections that the authority is done with, and why.

    `heard_ns`: session time of the last word of the authority, 0 before its first. `acknowledged`: batches taken by
    it since the start. `report`: the newest status report of the authority, encoded. `ended`: the session is over.
    `on_scene`: called with another scene before anybody hears of it.
    """

    def __init__(
        self,
        socket: zmq.Socket[bytes],
        clients: ConnectionTable,
        outbox: Outbox,
        admission: Admission,
        publisher: StatePublisher,
        drops: Drops,
        session_ns: Callable[[], int],
        forget: Callable[[FrontConnection, str], None],
        revocation: RevocationService,
        alignment: AlignmentService,
        on_scene: Callable[[], None],
    ) -> None:
        self._socket = socket
        self._clients = clients
        self._outbox = outbox
        self._admission = admission
        self._publisher = publisher
        self._drops = drops
        self._session_ns = session_ns
        self._forget = forget
        self._revocation = revocation
        self._alignment = alignment
        self._on_scene = on_scene
        self.heard_ns = 0
        self.acknowledged = 0
        self.report = b""
        self.ended = False

    def drain(self) -> None:
        """Takes what waits. Of several states only the newest is sent: they would fill the subscribers' queues."""
        if not readable(self._socket):
            return
        waiting = [self._socket.recv_multipart()]
        while len(waiting) < _MAX_MESSAGES and readable(self._socket):
            waiting.append(self._socket.recv_multipart())
        self.heard_ns = self._session_ns()
        states = [i for i, frames in enumerate(waiting) if frames[0] == link.STATE]
        if states:
            # First of all, unless the scene changes before it.
            newest = states[-1]
            first = 0 if all(frames[0] != link.SCENE for frames in waiting[:newest]) else newest
            state = waiting.pop(newest)
            waiting.insert(first, state)
            if len(states) > 1:
                self._drops.count("state_superseded", n=len(states) - 1)
                waiting = [frames for frames in waiting if frames[0] != link.STATE or frames is state]
        for frames in waiting:
            self._handle(frames)

    def _handle(self, frames: list[bytes]) -> None:
        kind = frames[0]
        if kind == link.STATE:
            if not self._publisher.publish(frames[1], frames[2]):
                self._drops.count("state_of_other_scene")
        elif kind == link.ACK:
            self.acknowledged += frames[1][0]
        elif kind == link.DECIDED:
            try:
                decided = link.decode_decided(frames[1])
            except msgspec.ValidationError:  # beyond a limit of the protocol: no client would have taken it either
                self._drops.count("decision_invalid")
                return
            self._handle_decision(decided)
        elif kind == link.PRESENCE:
            self._publisher.publish_presence(self.heard_ns, frames[1])
        elif kind == link.SCENE:
            self._publisher.set_scene(link.decode_scene(frames[1]))
            self._on_scene()
        elif kind == link.REPORT:
            self.report = frames[1]
        elif kind == link.END:
            self.ended = True

    def _handle_decision(self, decided: link.Decided) -> None:
        """Welcomes, answers, events, then snapshots: those are of the end of the step, with its events. Who takes part
        already gets the events first, because a client passes over those that its snapshot contains."""
        for admitted in decided.admitted:
            self._admission.send_welcome(admitted, self._session_ns(), self._publisher.scene.tick_period_ns)
        snapshots = [outgoing for outgoing in decided.outgoing if isinstance(outgoing.message, Snapshot)]
        for outgoing in decided.outgoing:
            if not isinstance(outgoing.message, Snapshot):
                self._send_outgoing(outgoing)
        for event in decided.events:
            self.broadcast(event)
            self._alignment.process_event(event.body)
            if isinstance(event.body, ParticipantLeft) and not event.body.grace:
                self._admission.expire_tokens(event.body.participant)
        for outgoing in snapshots:
            self._send_outgoing(outgoing)
        for dropped in decided.dropped:
            connection = self._clients.by_number.get(dropped.connection)
            if dropped.reason in REMOVALS and connection is not None:
                text = f"a director {dropped.reason} this participant"
                self._revocation.disconnect(connection, text, self.heard_ns, dropped.reason)
                self._forget(connection, dropped.reason)
            elif connection is not None:
                text = f"the session let this connection go: {dropped.reason}"
                self._outbox.send(connection, ProtocolFault(FaultCode.DROPPED, text, dropped.reason))
                self._forget(connection, dropped.reason)
            if dropped.key_id:
                self._revocation.revoke(dropped.key_id, self.heard_ns)

    def _send_outgoing(self, outgoing: OutgoingMessage) -> None:
        message: ServerMessage = outgoing.message
        connection = self._clients.by_number.get(outgoing.connection)
        if connection is None:
            return
        if isinstance(message, Snapshot):
            # What only the front knows: the scene, and the poses of the newest state frame.
            self._alignment.process_snapshot(message.participants)
            state_seq, poses = self._publisher.read_keyframe()
            scene = self._publisher.scene
            filled = msgspec.structs.replace(
                message, scene_hash=scene.scene_hash, robots=scene.robots, bodies=scene.bodies, state_seq=state_seq
            )
            self._outbox.send(connection, filled, poses)
            return
        self._outbox.send(connection, message)
        if isinstance(message, Refused):
            self._forget(connection, "refused")

    def broadcast(self, message: Event | ProtocolFault) -> None:
        """To every admitted connection; encoded once."""
        encoded = encode_message(message)
        for connection in self._clients.by_number.values():
            if connection.admitted:
                self._outbox.send_encoded(connection, encoded)
