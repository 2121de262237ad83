"""Messages from the session to a client, version 1. The tag field is `type`; events carry their kind in `event`.

On the control channel each is inside a `ServerEnvelope`. The state channel has two messages of its own, `StateHeader`
and `Presence`, of which only the latest counts. World frame: right-handed, Z up, metres, `[w, x, y, z]`.
"""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

from iris_session.protocol.common import (
    Alignment,
    Applied,
    Count,
    Denial,
    EventBody,
    Lease,
    Message,
    Name,
    Names,
    Nanoseconds,
    Pose,
    Proof,
    Text,
    Vec3,
    cut_texts,
)
from iris_session.protocol.names import PROTOCOL_VERSION
from iris_session.protocol.specs import ARM
from iris_session.protocol.status import DeliveryBudget, StatusReport

#: Marks of one anchor.
MAX_MARKS: Final = 16


class Endpoints(msgspec.Struct, frozen=True):
    """Ports of the other channels on the host of the control channel. `media_ingest`: for media sources."""

    state: Count = 0
    media: Count = 0
    assets: Count = 0
    web: Count = 0
    media_ingest: Count = 0


class Welcome(Message, frozen=True, tag="welcome"):
    """Answer to an accepted `hello`. `resume_token` is bound to the key and may be used once.

    `tick_period_ns`: of the present scene; another scene may have another (`SceneChanged`). `task_robots`: robots of
    the task, whose holders start its episodes; empty: any robot.
    """

    session_id: Name
    session_name: Name
    kind: Name
    participant_id: Name
    connection_epoch: Count
    role: Name
    resume_token: bytes
    resumed: bool
    session_time: Nanoseconds
    heartbeat_ns: Nanoseconds
    tick_period_ns: Nanoseconds
    state_period_ns: Nanoseconds
    endpoints: Endpoints
    key_fingerprint: Name = ""
    task_robots: Names = ()


class Refused(Message, frozen=True, tag="refused"):
    """A `hello` that the front refused (`RefusalCode`), or that the authority denied (`DenialReason`)."""

    code: Name
    message: Text
    advice: Text = ""
    supported_versions: tuple[int, ...] = (PROTOCOL_VERSION,)

    def __post_init__(self) -> None:
        cut_texts(self, "message", "advice")  # they name what a client has sent


class ProtocolFault(Message, frozen=True, tag="protocol_fault"):
    """A message that was rejected, or a change in the state of the session. `code`: `FaultCode`.

    `reason`: with `dropped` and `revoked`, why the session closed this connection: `replaced` (another connection
    resumed this participant: joining again would take it back), `removed`, `revoked`, `expired`, ...
    """

    code: Name
    message: Text
    reason: Name = ""


class ClockPong(Message, frozen=True, tag="clock_pong"):
    """`t0_ns` echoed; `t1_ns`, `t2_ns`: session time of receipt and of sending."""

    t0_ns: Nanoseconds
    t1_ns: Nanoseconds
    t2_ns: Nanoseconds


class Reply(Message, frozen=True, tag="reply"):
    """Answer to a request: leases as they are now, or a denial (then nothing has changed)."""

    request_id: Count
    ok: bool
    denial: Denial | None = None
    leases: tuple[Lease, ...] = ()


class Feedback(Message, frozen=True, tag="feedback"):
    """Feedback to the holder of a robot, for haptics and hints. Sent on change and at most at 20 Hz per robot.

    `state`: the command kind in force, `hold_reason` when it is `hold`. `limits`: joints or bounds that are active.
    `rejected`: counts by `RejectReason` for this participant since it joined. `contact_n`: force on the gripper [N].
    """

    robot: Name
    state: Name
    hold_reason: Name = ""
    contact_n: float = 0.0
    limits: tuple[Name, ...] = ()
    rejected: dict[str, int] = msgspec.field(default_factory=dict)


class ParticipantInfo(msgspec.Struct, frozen=True):
    """One row of the roster."""

    id: Name
    name: Name
    role: Name
    connected: bool
    devices: tuple[Name, ...] = ()
    worn: bool = True
    tracking_epoch: Count = 0
    alignment: Alignment | None = None


class ActuatorInfo(msgspec.Struct, frozen=True, array_like=True):
    """An actuator of a robot. `low`, `high`: limits of its `ctrl`.

    `scale`, `offset`: `ctrl = scale * x + offset` asks for the position x: of the joint [rad or m], or of the gripper,
    0 open to 1 closed. `scale` 0: it is not controlled by position.
    """

    name: Name
    low: float
    high: float
    scale: float = 0.0
    offset: float = 0.0


class RobotInfo(msgspec.Struct, frozen=True):
    """A robot as clients need it. `site_body`: id of the body that carries the end-effector site; `T_body_site`.

    `actuators`: in the order of `RobotState.ctrl`, one for each of the joints (none for a robot that only its owner's
    program moves), then those of the gripper. `kind`: `arm`, or `hand`: it follows joints only, no poses.
    """

    name: Name
    joints: tuple[Name, ...]
    base_body: Count
    site_body: Count
    T_body_site: Pose
    gripper: bool
    actuators: tuple[ActuatorInfo, ...] = ()
    kind: Name = ARM


class BodyInfo(msgspec.Struct, frozen=True, array_like=True):
    """One streamed rigid body: its index in state frames is its position in `Snapshot.bodies`."""

    id: Count
    name: Name
    moving: bool
    object: bool = False


class AnchorMark(msgspec.Struct, frozen=True):
    """A mark of an anchor that can be touched, such as a printed cross. `p_anchor`: its position in the anchor frame
    [m].
    """

    id: Name
    p_anchor: Vec3


class AnchorInfo(msgspec.Struct, frozen=True):
    """An anchor of the session. `size_m`: edge of its sheet, `error_m`: stated p95 of its position; 0: unknown.
    `marks`: in the order in which they are best touched.
    """

    id: Name
    T_world_anchor: Pose
    size_m: float = 0.0
    error_m: float = 0.0
    marks: Annotated[tuple[AnchorMark, ...], msgspec.Meta(max_length=MAX_MARKS)] = ()


# --- events: the shared history, numbered without gaps by `event_seq` -----------------------------------------------


class ParticipantJoined(EventBody, frozen=True, tag="participant_joined"):
    """A participant joined, or resumed after a disconnect."""

    participant: ParticipantInfo
    resumed: bool = False


class ParticipantChanged(EventBody, frozen=True, tag="participant_changed"):
    """The row of a participant in the roster changed."""

    participant: ParticipantInfo


class ParticipantLeft(EventBody, frozen=True, tag="participant_left"):
    """A participant left. `grace` true: it is disconnected, leases are kept until `Lease.expires_ns`."""

    participant: Name
    reason: Name
    grace: bool = False


class LeaseChanged(EventBody, frozen=True, tag="lease_changed"):
    """`cause`: acquired, released, expired, takeover, assigned, resumed, consent, priority, left, mode, queue, role (a
    director gave the holder another one), scene_changed (another scene was loaded that has no such robot or object)."""

    lease: Lease
    cause: Name
    previous_holder: Name = ""


#: Leases of one `LeasesChanged`: as many as one request can name.
MAX_LEASES = 64


class LeasesChanged(EventBody, frozen=True, tag="leases_changed"):
    """Several leases changed in one step for the same `cause`, as `LeaseChanged` for each, in this order.

    `previous_holders` has the length of `leases`.
    """

    leases: Annotated[tuple[Lease, ...], msgspec.Meta(max_length=MAX_LEASES)]
    cause: Name
    previous_holders: Annotated[tuple[Name, ...], msgspec.Meta(max_length=MAX_LEASES)]

    def to_single_changes(self) -> tuple[LeaseChanged, ...]:
        """Return the same as one `LeaseChanged` per lease."""
        pairs = zip(self.leases, self.previous_holders, strict=True)
        return tuple(LeaseChanged(lease, self.cause, previous) for lease, previous in pairs)


class ConsentRequested(EventBody, frozen=True, tag="consent_requested"):
    """`requester` asks `holder` for a robot (mode `request`); answered by `Consent` with this `consent_id`."""

    consent_id: Count
    target: Name
    requester: Name
    holder: Name


class Intervention(EventBody, frozen=True, tag="intervention"):
    """Mode `priority`: a human overrides an agent (`active`), or the agent has the robot again."""

    robot: Name
    human: Name
    agent: Name
    active: bool


class EngagementChanged(EventBody, frozen=True, tag="engagement_changed"):
    """A participant's clutch engaged a robot, or the engagement ended for `reason` (`HoldReason`)."""

    robot: Name
    participant: Name
    engaged: bool
    reason: Name = ""


class ScaleChanged(EventBody, frozen=True, tag="scale_changed"):
    """`participant` set the motion scaling of a robot for its holder. When a holder leaves, `LeaseChanged` has the
    scale.
    """

    robot: Name
    scale: float
    participant: Name


class AlignmentChanged(EventBody, frozen=True, tag="alignment_changed"):
    """Another alignment of a participant is in force."""

    participant: Name
    alignment: Alignment


class AlignmentRun(EventBody, frozen=True, tag="alignment_run"):
    """The alignment run of a participant was started (`running`), or stopped. `run` counts the starts."""

    participant: Name
    running: bool
    run: Count
    by: Name = ""


class AlignmentAlarmed(EventBody, frozen=True, tag="alignment_alarmed"):
    """The alignment of a participant was found wrong by `size_m` (`AlarmKind`); a `jump` has voided it. `beside`:
    anchors that stayed in place meanwhile: then the anchor was moved, not the headset. `witnesses`: other participants
    whose headsets see the same shift of the anchor: then it was moved too.
    """

    participant: Name
    kind: Name
    anchor_id: Name
    size_m: float
    beside: Names = ()
    witnesses: Names = ()


class AnchorMoved(EventBody, frozen=True, tag="anchor_moved"):
    """A director moved an anchor: alignments to it follow."""

    anchor_id: Name
    T_world_anchor: Pose
    by: Name = ""


class TipCalibrated(EventBody, frozen=True, tag="tip_calibrated"):
    """Answer to an observation of kind `tip`: the tip of a controller of a participant, or why it is unknown
    (`refused`, `advice`).

    `p_grip_tip`: position of the tip in the grip frame of `device` [m]. `covariance`: of it, 3x3 row-major [m^2].
    `error_m`: its stated p95. `residual_m`: scatter of the poses about the hole. `n_poses`: those that were used.
    """

    participant: Name
    device: Name
    p_grip_tip: Vec3 = (0.0, 0.0, 0.0)
    covariance: Annotated[tuple[float, ...], msgspec.Meta(max_length=9)] = ()
    error_m: float = 0.0
    residual_m: float = 0.0
    n_poses: Count = 0
    refused: bool = False
    advice: Text = ""


class HeadsetsCompared(EventBody, frozen=True, tag="headsets_compared"):
    """Cross-check: participants `a` and `b` observe one anchor (`anchor_id`, at `p_world`) `error_m` and `error_rad`
    apart.

    `expected_p95_m`: 95 % of such pairs stay below it by their stated errors and the noise of these `n` observations.
    `touched`: `anchor_id` is the name of a point that both have touched.
    """

    a: Name
    b: Name
    anchor_id: Name
    error_m: float
    error_rad: float
    expected_p95_m: float
    p_world: Vec3
    n: Count
    touched: bool = False


class SceneChanged(EventBody, frozen=True, tag="scene_changed"):
    """`cause`: reset, new_scene, patch, external (the user's loop went back in time).

    `scene_hash`: after a patch, the address of the scene's specification as it is now; fetch that. Else empty.
    `tick_period_ns`: of the new scene; 0: as it was.
    """

    scene_epoch: Count
    scene_revision: Count
    cause: Name
    scene_hash: Name = ""
    tick_period_ns: Nanoseconds = 0


class EStopChanged(EventBody, frozen=True, tag="estop_changed"):
    """The session was stopped (`active`), also when it was stopped already, or the e-stop was cleared by `participant`.

    `stop_seq` counts the stops from 1; of a clear: the newest stop that it ended. `participant`: empty for a stop of a
    connection that has not joined.
    """

    active: bool
    participant: Name
    reason: Text = ""
    stop_seq: Count = 0


class PauseChanged(EventBody, frozen=True, tag="pause_changed"):
    """The session was paused or resumed by `participant`. `reason`: of a pause that only a reset ends (physics that
    diverged).
    """

    paused: bool
    participant: Name = ""
    reason: Text = ""


class EpisodeChanged(EventBody, frozen=True, tag="episode_changed"):
    """An episode is in another `EpisodeState`, by `participant`.

    `number` counts from 1, in a task also those of earlier sessions. `label`: free text that was given with it. `task`,
    `instruction`, `wanted`: of the task, empty and 0 without one; `successes`: so many there are by now.
    `started_by`, `started_by_name`: who started it; `led_by`: who leads it now. `started_ns`: session time from which
    it is recorded, 0 before. `until_ns`: end of the countdown, of the question, or of the time to take it over or to
    give the verdict; 0: none. `verdict`: while closing, empty until it is given. `robots`: that belong to it.
    """

    number: Count
    state: Name
    label: Text = ""
    participant: Name = ""
    task: Name = ""
    instruction: Text = ""
    wanted: Count = 0
    successes: Count = 0
    started_by: Name = ""
    started_by_name: Name = ""
    led_by: Name = ""
    started_ns: Nanoseconds = 0
    until_ns: Nanoseconds = 0
    verdict: Name = ""
    robots: Names = ()


class ObjectGrasped(EventBody, frozen=True, tag="object_grasped"):
    """A hand took a free object (`grasped`), or released it."""

    object: Name
    participant: Name
    device: Name
    grasped: bool


class Handover(EventBody, frozen=True, tag="handover"):
    """An object passed from one robot to another through contact alone. `duration_ns`: both grippers touched it."""

    object: Name
    giver: Name
    receiver: Name
    giver_participant: Name
    receiver_participant: Name
    duration_ns: Nanoseconds


class MarkerAdded(EventBody, frozen=True, tag="marker_added"):
    """A note of a participant in the recording."""

    participant: Name
    text: Text


class SamplesRejected(EventBody, frozen=True, tag="samples_rejected"):
    """First rejection of a kind, then at most one per second and (participant, device, reason)."""

    participant: Name
    device: Name
    reason: Name
    count: Count


class Gap(EventBody, frozen=True, tag="gap"):
    """`kind`: `stalled` (no step for so long), `recording` (`rows` are lost), `resumed` (from an earlier recording)."""

    kind: Name
    duration_ns: Nanoseconds
    rows: Count = 0


class Notice(EventBody, frozen=True, tag="notice"):
    """A text for an operator. `level`: info, warning, error. `participant`: whom it concerns. `reason`: the
    `DenialReason` of a refusal that answers no request (of an alignment, or of a button).
    """

    level: Name
    text: Text
    participant: Name = ""
    reason: Name = ""


class Audited(EventBody, frozen=True, tag="audited"):
    """An event that concerns security. `kind`: `AuditKind`. `subject`: fingerprint of a key, or a participant id.

    Repeated ones (wrong codes, unknown keys) come at most once a second and address, with their `count`.
    """

    kind: Name
    subject: Name = ""
    name: Name = ""
    address: Name = ""
    detail: Text = ""
    count: Count = 1


EventKind = (
    ParticipantJoined
    | ParticipantChanged
    | ParticipantLeft
    | LeaseChanged
    | LeasesChanged
    | ConsentRequested
    | Intervention
    | EngagementChanged
    | ScaleChanged
    | AlignmentChanged
    | AlignmentRun
    | AlignmentAlarmed
    | AnchorMoved
    | TipCalibrated
    | HeadsetsCompared
    | SceneChanged
    | EStopChanged
    | PauseChanged
    | EpisodeChanged
    | ObjectGrasped
    | Handover
    | MarkerAdded
    | SamplesRejected
    | Gap
    | Notice
    | Audited
)


class Event(Message, frozen=True, tag="event"):
    """One entry of the shared history. A gap in `event_seq`: request a new snapshot."""

    event_seq: Count
    step: Count
    session_time: Nanoseconds
    body: EventKind


class Snapshot(Message, frozen=True, tag="snapshot"):
    """Everything a late joiner needs; events with `event_seq` at or below its own are to be discarded.

    In the step of a reset `tick` and `sim_time` are still those before it. `tick_period_ns`: of this scene; 0: that of
    `Welcome`. `stop_seq`: of the newest stop (`EStopChanged`). `consent_timeout_ns`: time that a holder has to answer
    `ConsentRequested`. `anchors`: as they are after its events. Bulk frame 1 (added by the front): float64 (n_bodies,
    7) world poses `x y z qw qx qy qz` of `bodies` at `state_seq`.
    """

    request_id: Count
    event_seq: Count
    scene_epoch: Count
    scene_revision: Count
    scene_hash: Name
    tick: Count
    sim_time: float
    session_time: Nanoseconds
    participants: tuple[ParticipantInfo, ...]
    leases: tuple[Lease, ...]
    robots: tuple[RobotInfo, ...] = ()
    bodies: tuple[BodyInfo, ...] = ()
    paused: bool = False
    estop: bool = False
    episode: EpisodeChanged | None = None
    state_seq: Count = 0
    tick_period_ns: Nanoseconds = 0
    stop_seq: Count = 0
    consent_timeout_ns: Nanoseconds = 0
    anchors: tuple[AnchorInfo, ...] = ()


class Paired(Message, frozen=True, tag="paired"):
    """The key is on the allow-list. Connect anew to send `hello`: this connection stays that of an unknown key.

    `proof`: shows that the session knows the join code too, so it is the one that issued it. `roles`: those that this
    key may join as; empty: any role.
    """

    proof: Proof
    roles: Names = ()


ServerMessage = (
    Welcome
    | Refused
    | ProtocolFault
    | ClockPong
    | Reply
    | Feedback
    | Event
    | Snapshot
    | Paired
    | StatusReport
    | DeliveryBudget
)


class ServerEnvelope(msgspec.Struct, frozen=True, array_like=True):
    """`[version, connection_epoch, message]`. `connection_epoch` is that of the connection it is meant for."""

    version: int
    connection_epoch: Count
    message: ServerMessage


# --- state channel ---


class StateHeader(msgspec.Struct, frozen=True, array_like=True):
    """First payload frame of a rigid-state message; topic frame before it, encoded poses after it.

    `session_time`: end of the tick that this state belongs to. `published_ns`: session time when handed to the socket.
    `base_seq`: a client that holds any frame >= `base_seq` of this `scene_epoch` has every body within the bound after
    this one; an older client asks for a snapshot. `ticks` are counted within the epoch.
    """

    scene_epoch: Count
    scene_revision: Count
    tick: Count
    sim_time: float
    session_time: Nanoseconds
    published_ns: Nanoseconds
    state_seq: Count
    base_seq: Count
    applied: tuple[Applied, ...] = ()


class PresenceItem(msgspec.Struct, frozen=True, array_like=True):
    """A device of a participant in the world. Only of participants that are aligned."""

    participant: Name
    device: Name
    pose: Pose
    capture_ns: Nanoseconds = 0


class Presence(msgspec.Struct, frozen=True, array_like=True):
    """Message on topic `presence`: heads and hands of everyone, latest value."""

    session_time: Nanoseconds
    published_ns: Nanoseconds
    items: tuple[PresenceItem, ...]


class RobotState(msgspec.Struct, frozen=True, array_like=True):
    """Measured and commanded values of one robot after a tick.

    Attributes:
        robot: Its name.
        q: Joint positions [rad or m], in the order of `RobotInfo.joints`.
        qd: Joint velocities [rad/s or m/s], in the same order.
        tip: Measured `T_world_tip` of the end effector.
        gripper: Measured opening, 0 open to 1 closed, as in samples; beyond these where it is pressed there. `None`
            without a gripper that is controlled by position.
        contact_n: Sum of the normal contact forces on the gripper [N].
        target: `T_world_tip` that the session moves the end effector to; `None` while the robot holds or is driven by
            joints.
        ctrl: `ctrl` of its actuators in the last tick, in the order of the joints, then those of the gripper, in the
            units of the model.
    """

    robot: Name
    q: tuple[float, ...]
    qd: tuple[float, ...]
    tip: Pose
    gripper: float | None = None
    contact_n: float = 0.0
    target: Pose | None = None
    ctrl: tuple[float, ...] = ()


class RobotStates(msgspec.Struct, frozen=True, array_like=True):
    """Message on topic `robots`: all robots, latest value. Sent from when a client names the capability
    `robot_states`. Times and ticks are as in `StateHeader`.
    """

    scene_epoch: Count
    tick: Count
    sim_time: float
    session_time: Nanoseconds
    published_ns: Nanoseconds
    robots: tuple[RobotState, ...]


TOPIC_RIGID = b"rigid"
TOPIC_PRESENCE = b"presence"
TOPIC_ROBOTS = b"robots"
#: Capability of a `Hello`: its sender reads the topic `robots`.
ROBOT_STATES = "robot_states"
