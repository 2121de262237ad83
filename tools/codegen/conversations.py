"""Golden conversations: scripted exchanges of the client core with a session, for tests of other implementations.

Written to docs/protocol/conversations.json, whose format is in docs/protocol.md. `ConversationPlayer` takes steps and
returns what the core did; the generator records it, and the test compares it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import Any, Final

import msgspec
import numpy as np

from iris_session.client.core.asset_loader import AssetLoader, FailedAsset
from iris_session.client.core.connection import ClientConnection, InboxMessage
from iris_session.client.core.samples import SampleBuilder
from iris_session.client.core.scene_follower import SceneFollower
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.errors import RefusedError
from iris_session.client.identity import Identity
from iris_session.protocol.assets import AssetChunk, AssetRequest
from iris_session.protocol.client_messages import Acquire, EStop, Hello, Marker
from iris_session.protocol.codec import (
    decode_asset_chunk,
    encode_asset_header,
    encode_asset_request,
    encode_server,
    encode_state_header,
)
from iris_session.protocol.common import Alignment, Denial, Lease, Pose
from iris_session.protocol.names import PROTOCOL_VERSION, DenialReason, LeaseMode, RefusalCode, Role
from iris_session.protocol.server_messages import (
    TOPIC_RIGID,
    AnchorInfo,
    AnchorMoved,
    BodyInfo,
    ClockPong,
    Endpoints,
    EStopChanged,
    Event,
    LeaseChanged,
    Notice,
    ParticipantInfo,
    ParticipantJoined,
    ProtocolFault,
    Refused,
    Reply,
    RobotInfo,
    SceneChanged,
    ServerEnvelope,
    ServerMessage,
    Snapshot,
    StateHeader,
    Welcome,
)
from iris_session.protocol.session_mirror import MissedEvents
from iris_session.streams.rigid import RigidEncoder
from tools.codegen.vectors import render_vectors

Step = dict[str, Any]

MS: Final = 1_000_000
SECOND: Final = 1000 * MS
#: Session time minus time of the client [ns].
OFFSET_NS: Final = 5 * SECOND
SECRET: Final = bytes(range(16))
#: Requests that a step may make, by the name of the message.
REQUESTS: Final = {"acquire": Acquire, "marker": Marker}


class ConversationPlayer:
    """A client core that takes steps of a conversation. `do` returns the outcome of a step, as JSON."""

    def __init__(self, secret: str, resume_token: str) -> None:
        self._identity = Identity(bytes.fromhex(secret), bytes.fromhex(resume_token))
        hello = Hello(Role.OPERATOR, "ann", "conversation", devices=("right",), capabilities=("run:0011223344556677",))
        self._connection = ClientConnection(hello, self._identity)
        self._follower = SceneFollower(self._connection)
        self._samples = SampleBuilder(self._connection)

    def play_step(self, step: Step) -> Step:
        """Take one step and return `sent`, `inbox`, `replies` and `state` after it."""
        connection, now_ns = self._connection, step["at_ns"]
        replies: list[Any] = []
        match step["do"]:
            case "open":
                connection.open(now_ns)
            case "close":
                connection.close()
            case "tick":
                connection.tick(now_ns)
            case "disconnect":
                connection.handle_disconnect(now_ns)
            case "receive":
                connection.receive([bytes.fromhex(frame) for frame in step["frames"]], now_ns)
                if connection.is_joined:
                    self._follower.on_welcome()
            case "receive_state":
                messages = [[bytes.fromhex(frame) for frame in message] for message in step["messages"]]
                state = connection.stream.drain(messages, connection.clock.session_ns(now_ns), now_ns)
                if state is not None:
                    self._follower.on_state(state)
            case "request":
                fields = {name: tuple(v) if isinstance(v, list) else v for name, v in step["fields"].items()}
                connection.request(REQUESTS[step["message"]](0, **fields))
            case "reply":
                reply = connection.requests.pop_reply(step["request_id"])
                replies = [None if reply is None else msgspec.to_builtins(reply)]
            case "estop":
                connection.send(EStop(step["reason"]))
            case "sample":
                pose = Pose(tuple(step["p"]), tuple(step["q"]))
                sample = self._samples.make_sample(
                    step["device"], pose, capture_ns=step["capture_ns"], robots=step["robots"], clutch=step["clutch"]
                )
                connection.send(sample)
            case unknown:
                raise ValueError(f"step {unknown!r} is not of a conversation")
        outcome: Step = {"sent": self._take_sent(), "inbox": self._take_inbox(), "state": self._describe_core(now_ns)}
        return outcome | ({"replies": replies} if replies else {})

    def _take_sent(self) -> list[str]:
        sent = []
        while (item := self._connection.peek_outgoing()) is not None:
            self._connection.pop_outgoing(sent=True)
            sent.append(item[1].hex())
        return sent

    def _take_inbox(self) -> list[Any]:
        messages = [_describe_message(message) for message in self._connection.inbox]
        self._connection.inbox.clear()
        return messages

    def _describe_core(self, now_ns: int) -> Step:
        """Return what an implementation must agree on after a step."""
        connection, mirror = self._connection, self._connection.mirror
        failure, waiting = connection.failure, connection.retryable_refusal
        counters = connection.counters
        poses = {name: self._follower.body_pose(name) for name in mirror.body_index}
        return {
            "phase": connection.phase.value,
            "generation": connection.generation,
            "participant_id": connection.participant_id,
            "connection_epoch": connection.connection_epoch,
            "resume_token": self._identity.resume_token.hex(),
            "failure": failure.code if isinstance(failure, RefusedError) else "",
            "retryable_refusal": "" if waiting is None else waiting.code,
            "next_deadline_ns": connection.next_deadline_ns(now_ns) if _has_deadline(connection) else None,
            "session_ns": connection.clock.session_ns(now_ns) if connection.clock.synced else None,
            "rtt_ns": connection.clock.rtt_ns,
            "synced": mirror.synced,
            "event_seq": mirror.event_seq,
            "scene": [mirror.scene_epoch, mirror.scene_revision, mirror.scene_hash],
            "mirror_hash": mirror.mirror_hash() if mirror.synced else None,
            "leases": {name: connection.lease_version(name) for name in sorted(mirror.leases)},
            "body_poses": {
                name: None if pose is None else [round(v, 6) for v in (*pose[0], *pose[1])]
                for name, pose in sorted(poses.items())
            },
            "malformed": counters.malformed,
            "other_connection": counters.other_connection,
            "reconnects": counters.reconnects,
        }


def _has_deadline(connection: ClientConnection) -> bool:
    return connection.is_joined or connection.phase in (ConnectionPhase.JOINING, ConnectionPhase.WAITING)


def _describe_message(message: InboxMessage) -> Any:
    if isinstance(message, MissedEvents):
        return {"type": "missed", "first": message.first, "last": message.last}
    return msgspec.to_builtins(message)


class AssetPlayer:
    """An asset loader that takes steps of a conversation, with the assets in memory."""

    def __init__(self) -> None:
        self._loader = AssetLoader()
        self._bytes: dict[str, bytes] = {}

    def play_step(self, step: Step) -> Step:
        """Take one step and return its `outcome` and the requests that are `sent` after it."""
        loader, now_ns = self._loader, step["at_ns"]
        outcome = ""
        match step["do"]:
            case "want":
                loader.add(step["address"], step["size"])
                for address in list(loader.next_lookups()):
                    self._bytes[address] = b""
                    loader.on_missing(address, 0)
            case "receive":
                head, data = (bytes.fromhex(frame) for frame in step["frames"])
                outcome = self._process_chunk(head, data, now_ns)
            case "link_lost":
                loader.on_link_lost(now_ns)
            case "tick":
                pass
            case unknown:
                raise ValueError(f"step {unknown!r} is not of a conversation about assets")
        requests = [AssetRequest(PROTOCOL_VERSION, 1, *request) for request in loader.next_requests(now_ns)]
        sent = [encode_asset_request(request).hex() for request in requests]
        return {"outcome": outcome, "sent": sent, "idle": loader.idle}

    def _process_chunk(self, head: bytes, data: bytes, now_ns: int) -> str:
        chunk = decode_asset_chunk(head, len(data))
        accepted = self._loader.process_chunk(chunk, len(data), now_ns)
        if isinstance(accepted, FailedAsset):
            return f"failed: {accepted.reason}"
        if not accepted:
            return "ignored" if accepted is None else "unasked"
        self._bytes[chunk.address] += data
        self._loader.on_stored(len(data))
        if not self._loader.is_complete(chunk.address):
            return "stored"
        if hashlib.sha256(self._bytes[chunk.address]).hexdigest() == chunk.address:
            self._loader.remove(chunk.address)
            return "complete"
        self._bytes[chunk.address] = b""
        return "hash mismatch, again" if self._loader.restart_asset(chunk.address) else "failed: hash"


# --- scripts ----------------------------------------------------------------------------------------------------------

BODIES: Final = (BodyInfo(1, "left/hand", True), BodyInfo(2, "cup", True, True))
ROBOT: Final = RobotInfo("left", ("j1",), 1, 1, Pose((0.0, 0.0, 0.1), (1.0, 0.0, 0.0, 0.0)), True)
ALIGNMENT: Final = Alignment(3, "measured", Pose((1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
ANN: Final = ParticipantInfo("p1", "ann", Role.OPERATOR, True, ("right",), alignment=ALIGNMENT)
BOB: Final = ParticipantInfo("p2", "bob", Role.OPERATOR, True)


def _make_receive(at_ns: int, message: ServerMessage, *bulk: bytes, epoch: int = 1) -> Step:
    data = encode_server(ServerEnvelope(PROTOCOL_VERSION, epoch, message))
    return {"at_ns": at_ns, "do": "receive", "frames": [data.hex(), *(frame.hex() for frame in bulk)]}


def _make_step(at_ns: int, do: str, **more: Any) -> Step:
    return {"at_ns": at_ns, "do": do, **more}


def _make_welcome(at_ns: int, epoch: int = 1, token: bytes = b"token-1", *, resumed: bool = False) -> Step:
    endpoints = Endpoints(state=7722, media=7723, assets=7724)
    times = (at_ns + OFFSET_NS, SECOND, 2 * MS, 16 * MS)
    return _make_receive(
        at_ns, Welcome("s1", "lab", "live", "p1", epoch, Role.OPERATOR, token, resumed, *times, endpoints), epoch=epoch
    )


def _make_pongs(at_ns: int, epoch: int = 1, count: int = 4, one_way_ns: int = MS) -> list[Step]:
    """Return pongs of pings that were sent 5 ms apart; the last is received at `at_ns`."""
    steps = []
    for i in range(count):
        t3 = at_ns - (count - 1 - i) * 5 * MS
        t0, t1 = t3 - 2 * one_way_ns, t3 - one_way_ns + OFFSET_NS
        steps.append(_make_receive(t3, ClockPong(t0, t1, t1), epoch=epoch))
    return steps


def _make_lease(holder: str, version: int) -> Lease:
    return Lease("left", "robot", LeaseMode.EXCLUSIVE, holder, version)


def _make_poses(bodies: Sequence[BodyInfo], x: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    poses = np.zeros((len(bodies), 7))
    poses[:, 0] = x
    poses[:, 1] = [body.id for body in bodies]
    poses[:, 3] = 1.0
    return poses


def _make_snapshot(
    at_ns: int,
    event_seq: int = 3,
    *,
    scene_epoch: int = 1,
    scene_hash: str = "scene-a",
    bodies: Sequence[BodyInfo] = BODIES,
    participants: Sequence[ParticipantInfo] = (ANN,),
    lease: Lease | None = None,
    epoch: int = 1,
    state_seq: int = 10,
    anchors: Sequence[AnchorInfo] = (),
) -> Step:
    leases = (_make_lease("", 1) if lease is None else lease,)
    snapshot = Snapshot(
        0, event_seq, scene_epoch, 0, scene_hash, 100, 0.2, at_ns + OFFSET_NS, tuple(participants), leases, (ROBOT,),
        tuple(bodies), state_seq=state_seq, anchors=tuple(anchors),
    )  # fmt: skip
    return _make_receive(at_ns, snapshot, _make_poses(bodies, 0.0).astype("<f8").tobytes(), epoch=epoch)


def _make_event(at_ns: int, seq: int, body: Any, epoch: int = 1) -> Step:
    return _make_receive(at_ns, Event(seq, 100 + seq, at_ns + OFFSET_NS, body), epoch=epoch)


def _make_join(at_ns: int = 0) -> list[Step]:
    """Return the steps from nothing to READY; the last is at `at_ns` + 30 ms."""
    return [
        _make_step(at_ns, "open"),
        _make_welcome(at_ns + 10 * MS),
        *_make_pongs(at_ns + 29 * MS),
        _make_snapshot(at_ns + 30 * MS),
    ]


def _make_state(encoder: RigidEncoder, bodies: Sequence[BodyInfo], x: float, scene_epoch: int, at_ns: int) -> list[str]:
    frame = encoder.encode(_make_poses(bodies, x), scene_epoch)
    time_ns = at_ns + OFFSET_NS - 2 * MS
    header = StateHeader(scene_epoch, 0, 101, 0.202, time_ns, time_ns + MS, frame.state_seq, frame.base_seq)
    return [part.hex() for part in (TOPIC_RIGID, encode_state_header(header), frame.payload)]


def _joining() -> list[Step]:
    encoder = RigidEncoder(len(BODIES), first_seq=11)
    return [
        *_make_join(),
        _make_step(40 * MS, "receive_state", messages=[_make_state(encoder, BODIES, 0.125, 1, 40 * MS)]),
        _make_event(50 * MS, 4, ParticipantJoined(BOB)),
        _make_event(51 * MS, 5, LeaseChanged(_make_lease("p2", 2), "acquired")),
        _make_step(520 * MS, "tick"),
        _make_step(600 * MS, "close"),
    ]


def _event_gap() -> list[Step]:
    return [
        *_make_join(),
        _make_event(40 * MS, 4, ParticipantJoined(BOB)),
        _make_event(41 * MS, 7, Notice("info", "seven", "")),
        _make_step(400 * MS, "tick"),
        _make_step(550 * MS, "tick"),
        _make_snapshot(560 * MS, 6, participants=(ANN, BOB)),
        _make_event(570 * MS, 7, Notice("info", "seven", "")),
    ]


def _clock() -> list[Step]:
    slow = _make_pongs(60 * MS, count=1, one_way_ns=8 * MS)
    impossible = _make_receive(65 * MS, ClockPong(70 * MS, OFFSET_NS, OFFSET_NS))
    return [
        _make_step(0, "open"),
        _make_welcome(10 * MS),
        *(_make_step(at, "tick") for at in (15 * MS, 20 * MS, 25 * MS)),
        *_make_pongs(39 * MS, count=3),
        *slow,
        impossible,
        _make_step(2 * SECOND, "tick"),
    ]


def _reconnect() -> list[Step]:
    back = 3 * SECOND
    return [
        *_make_join(),
        _make_event(40 * MS, 4, LeaseChanged(_make_lease("p1", 2), "acquired")),
        _make_receive(1500 * MS, ProtocolFault("stalled", "")),
        _make_step(2 * SECOND, "disconnect"),
        _make_welcome(back, 2, b"token-2", resumed=True),
        _make_event(back + MS, 9, Notice("info", "of the connection before", ""), epoch=1),
        *_make_pongs(back + 25 * MS, 2),
        _make_snapshot(back + 30 * MS, 6, lease=_make_lease("p1", 3), epoch=2, state_seq=40),
    ]


def _denial() -> list[Step]:
    denial = Denial(DenialReason.HELD, "left is held", "ask for it", "left", "p2")
    return [
        *_make_join(),
        _make_step(40 * MS, "request", message="acquire", fields={"robots": ["left"]}),
        _make_receive(50 * MS, Reply(1, False, denial)),
        _make_step(51 * MS, "reply", request_id=1),
        _make_step(52 * MS, "reply", request_id=1),
        _make_receive(60 * MS, Reply(0, False, Denial(DenialReason.NOT_HOLDER, "not so"))),
        _make_receive(61 * MS, Reply(77, True)),
    ]


def _sampling() -> list[Step]:
    sample = {"device": "right", "p": [0.25, -0.5, 1.0], "q": [1.0, 0.0, 0.0, 0.0], "robots": ["left"]}
    return [
        *_make_join(),
        _make_step(40 * MS, "sample", capture_ns=OFFSET_NS + 40 * MS, clutch=False, **sample),
        _make_step(41 * MS, "request", message="acquire", fields={"robots": ["left"]}),
        _make_receive(50 * MS, Reply(1, True, leases=(_make_lease("p1", 2),))),
        _make_step(60 * MS, "sample", capture_ns=OFFSET_NS + 60 * MS, clutch=True, **sample),
        _make_event(61 * MS, 4, LeaseChanged(_make_lease("p1", 2), "acquired")),
        _make_event(62 * MS, 5, LeaseChanged(_make_lease("p2", 3), "assigned", "p1")),
        _make_step(70 * MS, "sample", capture_ns=OFFSET_NS + 70 * MS, clutch=True, **sample),
    ]


def _refused_version() -> list[Step]:
    refused = Refused(RefusalCode.VERSION, "this session speaks version 2", "update", (2,))
    return [_make_step(0, "open"), _make_receive(10 * MS, refused, epoch=0), _make_step(5 * SECOND, "tick")]


def _busy_then_joined() -> list[Step]:
    return [
        _make_step(0, "open"),
        _make_receive(10 * MS, Refused(RefusalCode.RATE, "too many at once", "wait"), epoch=0),
        _make_step(100 * MS, "tick"),
        _make_step(110 * MS, "tick"),
        _make_welcome(120 * MS),
    ]


def _full() -> list[Step]:
    return [
        *_make_join(),
        _make_step(2 * SECOND, "disconnect"),
        _make_receive(2010 * MS, Refused(RefusalCode.FULL, "no room", "wait"), epoch=0),
        _make_step(2110 * MS, "tick"),
        _make_welcome(2120 * MS, 2, b"token-2", resumed=True),
    ]


def _lost_welcome() -> list[Step]:
    return [
        _make_step(0, "open"),
        _make_step(999 * MS, "tick"),
        _make_step(1000 * MS, "tick"),
        _make_step(1100 * MS, "tick"),
        _make_step(3100 * MS, "tick"),
        _make_step(3300 * MS, "tick"),
        _make_welcome(3310 * MS),
    ]


def _used_token() -> list[Step]:
    return [
        _make_step(0, "open"),
        _make_receive(10 * MS, Refused(RefusalCode.RESUME_TOKEN, "used"), epoch=0),
        _make_welcome(20 * MS),
    ]


def _malformed() -> list[Step]:
    notice = encode_server(ServerEnvelope(PROTOCOL_VERSION, 1, Event(4, 1, 1, Notice("info", "x", ""))))
    short = _make_snapshot(40 * MS, 3)
    frames = [[], [""], ["c1"], [notice[:-1].hex()], [notice.hex() + "00"], ["ff" * 20]]
    return [
        *_make_join(),
        *(_make_step(40 * MS, "receive", frames=each) for each in frames),
        short | {"frames": [short["frames"][0], "00" * 8]},
        _make_receive(41 * MS, ProtocolFault("malformed", "acquire: robots is wrong")),
    ]


def _scene_change() -> list[Step]:
    other = (BODIES[1], BODIES[0], BodyInfo(3, "plate", True, True))
    encoder, new = RigidEncoder(2, first_seq=11), RigidEncoder(3, first_seq=20)
    return [
        *_make_join(),
        _make_step(40 * MS, "receive_state", messages=[_make_state(encoder, BODIES, 0.125, 1, 40 * MS)]),
        _make_event(50 * MS, 4, SceneChanged(1, 1, "patch", "scene-b")),
        _make_event(55 * MS, 5, SceneChanged(2, 0, "new_scene", "scene-c", MS)),
        _make_step(56 * MS, "receive_state", messages=[_make_state(new, other, 0.25, 2, 56 * MS)]),
        _make_step(531 * MS, "tick"),
        _make_snapshot(540 * MS, 5, scene_epoch=2, scene_hash="scene-c", bodies=other, state_seq=20),
        _make_step(550 * MS, "receive_state", messages=[_make_state(new, other, 0.5, 2, 550 * MS)]),
        _make_event(560 * MS, 6, SceneChanged(3, 0, "reset")),
        _make_step(570 * MS, "receive_state", messages=[_make_state(new, other, 0.0, 3, 570 * MS)]),
    ]


def _estop() -> list[Step]:
    return [
        *_make_join(),
        _make_step(40 * MS, "estop", reason="stop"),
        _make_step(2 * SECOND, "disconnect"),
        _make_welcome(2010 * MS, 2, b"token-2", resumed=True),
        _make_snapshot(2020 * MS, 3, epoch=2),
        _make_event(2030 * MS, 4, EStopChanged(True, "p1", "stop", 1), epoch=2),
        _make_step(5 * SECOND, "disconnect"),
    ]


def _anchors() -> list[Step]:
    moved = Pose((0.5, -0.25, 0.0), (0.0, 0.0, 0.0, 1.0))
    anchors = (AnchorInfo("wall", ROBOT.T_body_site), AnchorInfo("table", ALIGNMENT.T_world_tracking, 0.2, 0.004))
    return [
        *_make_join(),
        _make_event(40 * MS, 4, AnchorMoved("table", moved, "p1")),
        _make_event(50 * MS, 6, Notice("info", "six", "")),
        _make_step(540 * MS, "tick"),
        _make_snapshot(560 * MS, 6, anchors=anchors),
        _make_event(570 * MS, 7, AnchorMoved("wall", moved, "p1")),
    ]


#: Name of a conversation -> its purpose, and its steps.
CONVERSATIONS: Final[dict[str, tuple[str, Callable[[], list[Step]]]]] = {
    "join": ("hello, welcome, clock, snapshot, state, events, heartbeat, bye", _joining),
    "event gap": ("an event is missing: a new snapshot, and which events were missed", _event_gap),
    "clock": ("a burst of pings; a slow exchange, and one that cannot be", _clock),
    "reconnect": ("the link is lost: hello with the resume token, messages of the earlier connection", _reconnect),
    "denial": ("a request is denied; a denial and a reply that no request waits for", _denial),
    "samples": ("fencing numbers before, with and after a lease", _sampling),
    "refused version": ("the session speaks another version: no attempt follows", _refused_version),
    "busy": ("a refusal that passes: hello again after a pause", _busy_then_joined),
    "full": ("a client that was joined keeps trying while there is no room", _full),
    "lost welcome": ("no answer to hello: again on a fresh socket, at growing distances", _lost_welcome),
    "used token": ("the resume token is refused: hello as a new participant", _used_token),
    "malformed": ("bytes that do not fit the protocol are counted, and change nothing", _malformed),
    "scene change": ("a patch, another scene whose state comes first, a reset", _scene_change),
    "estop": ("an e-stop is sent again after a reconnect until the session has it", _estop),
    "anchors": ("an anchor is moved, a snapshot has two of them, not in the order of their ids", _anchors),
}


def _make_chunk(at_ns: int, request_id: int, address: str, offset: int, total: int, data: bytes) -> Step:
    head = encode_asset_header(AssetChunk(PROTOCOL_VERSION, request_id, address, offset, total))
    return _make_step(at_ns, "receive", frames=[head.hex(), data.hex()])


def _asset_steps() -> list[Step]:
    good, bad = b"bytes of an asset", b"bytes of another."
    address = hashlib.sha256(good).hexdigest()
    other = hashlib.sha256(b"never sent").hexdigest()
    return [
        _make_step(0, "want", address=address, size=-1),
        _make_chunk(10 * MS, 1, address, 0, len(good), good[:8]),
        _make_chunk(20 * MS, 2, address, 8, len(good), bad[8:]),
        _make_chunk(30 * MS, 3, address, 0, len(good), good),
        _make_step(40 * MS, "want", address=other, size=4),
        _make_step(50 * MS, "link_lost"),
        _make_step(110 * MS, "tick"),
        _make_chunk(120 * MS, 5, other, 0, 4, b"what"),
        _make_chunk(130 * MS, 6, other, 0, 4, b"what"),
        _make_chunk(140 * MS, 99, other, 0, 4, b"what"),
    ]


def render_conversations() -> str:
    """Return the text of conversations.json: every step with its outcome."""
    conversations: list[Step] = []
    for name, (about, make) in CONVERSATIONS.items():
        token = b"token-0".hex() if name == "used token" else ""
        player = ConversationPlayer(SECRET.hex(), token)
        head = {"name": name, "core": "connection", "about": about, "secret": SECRET.hex(), "resume_token": token}
        conversations.append({**head, "steps": [step | player.play_step(step) for step in make()]})
    loader = AssetPlayer()
    about = "chunks, bytes of another asset once and twice, a lost link"
    steps = [step | loader.play_step(step) for step in _asset_steps()]
    conversations.append({"name": "assets", "core": "asset loader", "about": about, "steps": steps})
    return render_vectors({"protocol_version": PROTOCOL_VERSION, "conversations": conversations}, "steps")
