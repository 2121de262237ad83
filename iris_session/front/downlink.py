"""From the authority to clients: state to the state socket first, then welcomes, replies and events."""

from __future__ import annotations

from typing import Final

import msgspec
import zmq

from iris_session.alignment.service import AlignmentService
from iris_session.front.admission import Admission
from iris_session.front.asset_service import AssetService
from iris_session.front.context import FrontContext
from iris_session.front.disconnects import DisconnectHandler
from iris_session.front.media.service import MediaService
from iris_session.front.revocation import RevocationService
from iris_session.link import messages as link
from iris_session.link.sockets import readable
from iris_session.protocol.names import FaultCode
from iris_session.protocol.server_messages import (
    AnchorInfo,
    AnchorMark,
    Event,
    ParticipantChanged,
    ParticipantInfo,
    ParticipantLeft,
    ProtocolFault,
    Refused,
    ServerMessage,
    Snapshot,
)
from iris_session.protocol.status import RecorderReport
from iris_session.protocol.steps import OutgoingMessage

_MAX_MESSAGES: Final = 64  # read at once
#: Reasons by which a director ends a participation: the client does not join again by itself after them.
REMOVALS: Final = ("removed", "revoked")


class _ReportPart(msgspec.Struct):
    """The part of a `StatusReport` that the front acts on."""

    recorder: RecorderReport | None = None


_decode_part = msgspec.msgpack.Decoder(_ReportPart).decode


class Downlink:
    """Read the link and pass on what it carries."""

    def __init__(
        self,
        context: FrontContext,
        socket: zmq.Socket[bytes],
        admission: Admission,
        disconnects: DisconnectHandler,
        revocation: RevocationService,
        alignment: AlignmentService,
        assets: AssetService,
        media: MediaService,
    ) -> None:
        self._context = context
        self._socket = socket
        self._admission = admission
        self._disconnects = disconnects
        self._revocation = revocation
        self._alignment = alignment
        self._assets = assets
        self._media = media

    def drain(self) -> None:
        """Handle pending messages. Of several states only the newest is published: more would fill the subscribers'
        queues."""
        if not readable(self._socket):
            return
        pending = [self._socket.recv_multipart()]
        while len(pending) < _MAX_MESSAGES and readable(self._socket):
            pending.append(self._socket.recv_multipart())
        self._context.authority.heard_ns = self._context.now_ns()
        states = [i for i, frames in enumerate(pending) if frames[0] == link.STATE]
        if states:
            # State goes first, unless the scene changes before it.
            newest = states[-1]
            first = 0 if all(frames[0] != link.SCENE for frames in pending[:newest]) else newest
            state = pending.pop(newest)
            pending.insert(first, state)
            if len(states) > 1:
                self._context.drops.count("state_superseded", n=len(states) - 1)
                pending = [frames for frames in pending if frames[0] != link.STATE or frames is state]
        for frames in pending:
            self._handle(frames)

    def _handle(self, frames: list[bytes]) -> None:
        kind = frames[0]
        if kind == link.STATE:
            if not self._context.publisher.publish(frames[1], frames[2]):
                self._context.drops.count("state_of_other_scene")
            elif len(frames) > 3:
                self._context.publisher.publish_robots(frames[1], frames[3])
        elif kind == link.ACK:
            self._context.authority.acknowledged += frames[1][0]
        elif kind == link.DECIDED:
            try:
                decided = link.decode_decided(frames[1])
            except msgspec.ValidationError:  # exceeds a limit of the protocol: a client would not accept it either
                self._context.drops.count("decision_invalid")
                return
            self._handle_decision(decided)
            self._context.authority.step = decided.step
        elif kind == link.PRESENCE:
            self._context.publisher.publish_presence(self._context.authority.heard_ns, frames[1])
        elif kind == link.SCENE:
            self._context.publisher.set_scene(link.decode_scene(frames[1]))
            self._assets.sync_clients()  # before a client hears of the scene
        elif kind == link.REPORT:
            self._context.authority.report = frames[1]
            recorder = _decode_part(frames[1]).recorder
            self._context.authority.is_recorded = recorder is None or recorder.state != "ended"
        elif kind == link.END:
            self._context.authority.ended = True

    def _handle_decision(self, decided: link.Decided) -> None:
        """Send welcomes, replies, events, then snapshots: those are of the end of the step, with its events.
        Participants get the events first, because a client skips those that its snapshot contains."""
        for admitted in decided.admitted:
            self._admission.send_welcome(admitted, self._context.now_ns(), self._context.publisher.scene.tick_period_ns)
        snapshots = [outgoing for outgoing in decided.outgoing if isinstance(outgoing.message, Snapshot)]
        for outgoing in decided.outgoing:
            if not isinstance(outgoing.message, Snapshot):
                self._send_outgoing(outgoing)
        for event in decided.events:
            self.broadcast(event)
            self._alignment.process_event(event.body)
            if isinstance(event.body, ParticipantLeft) and not event.body.grace:
                self._admission.expire_tokens(event.body.participant)
                self._media.end_sources(event.body.participant)
            elif isinstance(event.body, ParticipantChanged):
                self._update_role(event.body.participant)
        for outgoing in snapshots:
            self._send_outgoing(outgoing)
        heard_ns = self._context.authority.heard_ns
        for dropped in decided.dropped:
            connection = self._context.connections.by_number.get(dropped.connection)
            if dropped.reason in REMOVALS and connection is not None:
                text = f"a director {dropped.reason} this participant"
                self._revocation.disconnect(connection, text, heard_ns, dropped.reason)
                self._disconnects.remove(connection, dropped.reason)
            elif connection is not None:
                text = f"the session closed this connection: {dropped.reason}"
                self._context.outbox.send(connection, ProtocolFault(FaultCode.DROPPED, text, dropped.reason))
                self._disconnects.remove(connection, dropped.reason)
            if dropped.key_id:
                self._revocation.revoke(dropped.key_id, heard_ns)

    def _update_role(self, info: ParticipantInfo) -> None:
        """Take over the role that a director gave to a participant."""
        for connection in tuple(self._context.connections.by_number.values()):
            if connection.participant_id == info.id and connection.role != info.role:
                connection.role = info.role
                self._revocation.check_role(connection, self._context.authority.heard_ns)

    def _send_outgoing(self, outgoing: OutgoingMessage) -> None:
        message: ServerMessage = outgoing.message
        connection = self._context.connections.by_number.get(outgoing.connection)
        if connection is None:
            return
        if isinstance(message, Snapshot):
            # The front adds what only it knows: the scene, the poses of the newest state frame, the sizes of anchors.
            self._alignment.process_snapshot(message.participants, message.anchors)
            state_seq, poses = self._context.publisher.read_keyframe()
            scene = self._context.publisher.scene
            filled = msgspec.structs.replace(
                message,
                scene_hash=scene.scene_hash,
                robots=scene.robots,
                bodies=scene.bodies,
                state_seq=state_seq,
                anchors=tuple(self._describe_anchor(anchor) for anchor in message.anchors),
            )
            self._context.outbox.send(connection, filled, poses)
            return
        self._context.outbox.send(connection, message)
        if isinstance(message, Refused):
            self._disconnects.remove(connection, "refused")

    def _describe_anchor(self, anchor: AnchorInfo) -> AnchorInfo:
        """Return an anchor with its size, stated error and marks, where they are known."""
        size, error = (
            self._context.config.anchor_sizes.get(anchor.id, 0.0),
            self._context.config.anchor_errors.get(anchor.id, 0.0),
        )
        marks = tuple(AnchorMark(*mark) for mark in self._context.config.anchor_marks.get(anchor.id, {}).items())
        return msgspec.structs.replace(anchor, size_m=size, error_m=error, marks=marks)

    def broadcast(self, message: Event | ProtocolFault) -> None:
        """Send a message to every admitted connection, encoded once."""
        encoded = link.encoder.encode(message)
        for connection in self._context.connections.by_number.values():
            if connection.admitted:
                self._context.outbox.send_encoded(connection, encoded)
