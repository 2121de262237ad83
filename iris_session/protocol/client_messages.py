"""Messages from a client to the session, version 1. One `msgspec` struct each; the tag field is `type`.

On the control channel every one of them travels inside a `ClientEnvelope`. Units are SI, poses of samples and
observations are in the sender's own tracking frame (the authority applies the alignment). Times are session time
in integer nanoseconds unless a field says otherwise.
"""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

from iris_session.protocol.common import Count, Message, Name, Names, Nanoseconds, Pose, Proof, Target, Text
from iris_session.protocol.names import PROTOCOL_VERSION
from iris_session.protocol.status import ClientReport, GetStatus

Joints = Annotated[tuple[float, ...], msgspec.Meta(max_length=64)]
Targets = Annotated[tuple[Target, ...], msgspec.Meta(max_length=8)]
#: Poses of an observation `tip`: some seconds of turning, thinned out.
MAX_TIP_POSES: Final = 100
TipPoses = Annotated[tuple[Pose, ...], msgspec.Meta(max_length=MAX_TIP_POSES)]


class Hello(Message, frozen=True, tag="hello"):
    """First message of a connection.

    `secret`: client-made 128-bit secret that stands for the key on plain loopback; behind a gateway the 32 bytes of a
    web identity. `resume_token`: from the last `Welcome`, single use. `alignment`: `measured`, or `not_needed` for
    policies, leaders, desktop and remote VR. `certificate_hash`: of a gateway, SHA-256 of the SubjectPublicKeyInfo of
    the certificate that it shows to those behind it.
    """

    role: Name
    name: Name
    software: Name = ""
    devices: Names = ()
    capabilities: Names = ()
    alignment: Name = "measured"
    secret: Annotated[bytes, msgspec.Meta(max_length=64)] = b""
    resume_token: Annotated[bytes, msgspec.Meta(max_length=64)] = b""
    join_code: Name = ""
    certificate_hash: Annotated[bytes, msgspec.Meta(max_length=64)] = b""


class Bye(Message, frozen=True, tag="bye"):
    """Leave the session at once: leases are released without grace."""

    reason: Text = ""


class Disconnected(Message, frozen=True, tag="disconnected"):
    """Report of a gateway that one behind it lost its connection: the grace period begins at once."""

    reason: Name = "closed"


class Heartbeat(Message, frozen=True, tag="heartbeat"):
    """Sign of life, sent at least every `Welcome.heartbeat_ns`. `worn` false: the headset is not worn."""

    worn: bool = True


class ClockPing(Message, frozen=True, tag="clock_ping"):
    """Clock measurement. `t0_ns`: the client's own monotonic clock at sending. Answered by `ClockPong` from the
    front.
    """

    t0_ns: Nanoseconds


class GetSnapshot(Message, frozen=True, tag="get_snapshot"):
    """Request for a `Snapshot`. `request_id` is repeated in it."""

    request_id: Count = 0


class Sample(Message, frozen=True, tag="sample"):
    """One input message of one device.

    `capture_ns`: when it was sampled (session time by the client's clock estimate), not when it will be displayed.
    `pose`: `T_tracking_device`. `twist`: (vx, vy, vz [m/s], wx, wy, wz [rad/s]) in the tracking frame.
    `clutch`: true while the person wants the target to follow. `gripper`: 0 open to 1 closed.
    `buttons`: bit mask (section 6). `hand_joints`: up to 26 poses `T_tracking_joint` flattened (x, y, z, qw, qx, qy,
    qz): 25 in the order of WebXR (the wrist first), 26 in that of OpenXR (the palm first); not in every sample. `q`,
    `qd`: a leader's joint positions [rad or m] and velocities. `emulated`: the position of `pose` is an estimate, not
    a measurement (WebXR `emulatedPosition`; OpenXR: valid, but not tracked): it drives nothing.
    """

    device: Name
    kind: Name
    seq: Count
    capture_ns: Nanoseconds
    scene_epoch: Count
    tracking_epoch: Count
    alignment_version: Count
    targets: Targets = ()
    tracked: bool = True
    worn: bool = True
    clutch: bool = False
    gripper: float | None = None
    buttons: Count = 0
    pose: Pose | None = None
    twist: tuple[float, float, float, float, float, float] | None = None
    hand_joints: Annotated[tuple[float, ...], msgspec.Meta(max_length=182)] = ()
    q: Joints = ()
    qd: Joints = ()
    emulated: bool = False


class Samples(Message, frozen=True, tag="samples"):
    """Samples of several devices that were taken together, such as head and both controllers at a display frame.

    Each counts as if it had arrived alone; together they cost one message, one packet and one wake-up.
    """

    samples: Annotated[tuple[Sample, ...], msgspec.Meta(max_length=8)]


class Acquire(Message, frozen=True, tag="acquire"):
    """Request for leases, all or none. No names: the assignment policy chooses one robot. `wait`: queue when held."""

    request_id: Count
    robots: Names = ()
    objects: Names = ()
    wait: bool = False
    weight: float = 1.0


class Release(Message, frozen=True, tag="release"):
    """Return leases. No targets: all of them and every place in a queue."""

    request_id: Count = 0
    targets: Targets = ()


class Withdraw(Message, frozen=True, tag="withdraw"):
    """Take back the `acquire` with this request id. It is denied (`withdrawn`, with its place in the queue and the
    holder); if it was granted before, what it has granted is released.
    """

    request_id: Count
    acquire_request_id: Count


class Consent(Message, frozen=True, tag="consent"):
    """Answer of a holder or director to a `ConsentRequested` event (mode `request`)."""

    request_id: Count
    consent_id: Count
    grant: bool


class Assign(Message, frozen=True, tag="assign"):
    """Assign robots to a participant (empty: free them), even if another one holds them. Directors only."""

    request_id: Count
    robots: Names
    participant: Name = ""


class SetMode(Message, frozen=True, tag="set_mode"):
    """Change the lease mode of a robot. Directors only. Blending weights (mode `shared`) come with each `Acquire`."""

    request_id: Count
    robot: Name
    mode: Name


class SetScale(Message, frozen=True, tag="set_scale"):
    """Set how far robots move as the hand moves: 1 as far, 0.1 a tenth. No names: all robots of the sender.

    For holders and directors. Translation is scaled (that of twists too); rotation, joints and device `target` are not.
    The scale belongs to the present holder: the next one begins at 1. Changing it while engaged moves nothing by
    itself.
    """

    request_id: Count
    robots: Names = ()
    scale: float = 1.0


class Grasp(Message, frozen=True, tag="grasp"):
    """Take a free object with a hand, without a robot. The lease on the object comes back in the `Reply`."""

    request_id: Count
    object: Name
    device: Name


class Observation(Message, frozen=True, tag="observation"):
    """Observation of an anchor by a headset or camera: `T_tracking_anchor`.

    `kind`: `AnchorKind`. `size_m`: edge of the sheet as detected. `viewpoint_id`: observations with the same number
    share their systematic error. `covariance`: 6x6 row-major (position, rotation), tracking axes, of kind `persistent`
    those of the anchor, or empty. `quality`: 0 to 1.
    `source`: `ObservationSource`, empty for that of `kind`: `qr_camera`, `holder` or `touch`.
    `mark`: touched mark of the anchor (`AnchorInfo.marks`), empty for the origin of the anchor. `grip_poses`: of kind
    `tip`, `T_tracking_grip` of `device` (section 5). `alternative`: of a flat sheet, the other `T_tracking_anchor` that
    explains the picture. `residuals_px`: rms of both, in this order, or empty.
    """

    anchor_id: Name
    kind: Name
    T_tracking_anchor: Pose
    capture_ns: Nanoseconds
    tracking_epoch: Count
    viewpoint_id: Count = 0
    size_m: float = 0.0
    quality: float = 1.0
    device: Name = "head"
    covariance: Annotated[tuple[float, ...], msgspec.Meta(max_length=36)] = ()
    mark: Name = ""
    grip_poses: TipPoses = ()
    source: Name = ""
    alternative: Pose | None = None
    residuals_px: Annotated[tuple[float, ...], msgspec.Meta(max_length=2)] = ()


class PlaceAlignment(Message, frozen=True, tag="place_alignment"):
    """Align a participant by hand, or add an offset to a measured alignment (`offset` true). Directors only."""

    request_id: Count
    participant: Name
    T_world_tracking: Pose
    offset: bool = False


class Align(Message, frozen=True, tag="align"):
    """Start or stop the alignment run of a participant (`AlignAction`); `participant` empty: the sender's own.

    A director may do so for everyone, others for themselves. The alignment in force stays until there is a better one.
    """

    request_id: Count
    action: Name
    participant: Name = ""


class MoveAnchor(Message, frozen=True, tag="move_anchor"):
    """Set where an anchor of the session is: the shared scene moves for everyone who is aligned to it. Directors only.

    `force`: also when it is further than 5 m from its old place, which is more often a wrong number than intended.
    """

    request_id: Count
    anchor_id: Name
    T_world_anchor: Pose
    force: bool = False


class TrackingEpoch(Message, frozen=True, tag="tracking_epoch"):
    """Report that the tracking frame jumped (recentre, lost tracking): every earlier alignment of this participant is
    void.
    """

    tracking_epoch: Count


class Episode(Message, frozen=True, tag="episode"):
    """Start, end or take over an episode (`EpisodeAction`). `countdown_ns`: of `start`, at most 60 s; None: that of the
    session.
    """

    request_id: Count
    action: Name
    label: Text = ""
    countdown_ns: Nanoseconds | None = None


class EStop(Message, frozen=True, tag="estop"):
    """Stop everything. Any participant may do so. Latched. Not a safety-rated stop."""

    reason: Text = ""


class ClearEStop(Message, frozen=True, tag="clear_estop"):
    """End the e-stop. Directors only. `stop_seq`: the newest stop that the sender has seen (`EStopChanged`); denied
    when there is a newer one.
    """

    request_id: Count
    stop_seq: Count = 0


class Control(Message, frozen=True, tag="control"):
    """Control the session, `ControlAction`: pause, resume, step (`ticks` physics ticks while paused), reset. Directors
    only. When physics has diverged, both reset and resume begin anew from the initial state.
    """

    request_id: Count
    action: Name
    ticks: Count = 1


class Marker(Message, frozen=True, tag="marker"):
    """Put a note into the recording, at the session time of its receipt."""

    request_id: Count
    text: Text


class Pair(Message, frozen=True, tag="pair"):
    """Request to put the key of this connection on the allow-list: the only message allowed from an unknown key.

    `proof`: shows that the sender knows a join code, without revealing it (`protocol.pairing`). `name`: under which the
    key is listed. `identity`: behind a gateway, the 32 bytes of the web identity that is to be listed.
    """

    name: Name
    proof: Proof
    software: Name = ""
    identity: Annotated[bytes, msgspec.Meta(max_length=64)] = b""


class RemoveParticipant(Message, frozen=True, tag="remove_participant"):
    """End the participation of a participant. Directors only. `revoke`: its key is taken off the allow-list too."""

    request_id: Count
    participant: Name
    revoke: bool = False
    reason: Text = ""


class Rename(Message, frozen=True, tag="rename"):
    """Give a participant another name: oneself, or as a director anyone. A name that another one has gets a number."""

    request_id: Count
    participant: Name
    name: Name


class SetRole(Message, frozen=True, tag="set_role"):
    """Give a participant another role, one that its key may join in. Directors only.

    It keeps what it holds when it may drive in both roles as a person, or in both as an agent.
    """

    request_id: Count
    participant: Name
    role: Name


ClientMessage = (
    Hello
    | Bye
    | Disconnected
    | Heartbeat
    | ClockPing
    | GetSnapshot
    | Sample
    | Samples
    | Acquire
    | Release
    | Withdraw
    | Consent
    | Assign
    | SetMode
    | SetScale
    | Grasp
    | Observation
    | PlaceAlignment
    | Align
    | MoveAnchor
    | TrackingEpoch
    | Episode
    | EStop
    | ClearEStop
    | Control
    | Marker
    | Pair
    | RemoveParticipant
    | Rename
    | SetRole
    | GetStatus
    | ClientReport
)


class ClientEnvelope(msgspec.Struct, frozen=True, array_like=True):
    """One control-channel message from a client: `[version, connection_epoch, on_behalf_of, message]`.

    `connection_epoch`: from `Welcome`; 0 in `hello`. `on_behalf_of`: only role `gateway` may set it.
    """

    version: int
    connection_epoch: Count
    on_behalf_of: Name
    message: ClientMessage


def wrap_message(message: ClientMessage, connection_epoch: int = 0, on_behalf_of: str = "") -> ClientEnvelope:
    """Return `message` in an envelope for the control channel of this protocol version."""
    return ClientEnvelope(PROTOCOL_VERSION, connection_epoch, on_behalf_of, message)
