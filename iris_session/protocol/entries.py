"""Input of the authority: one `Entry` per input of a step, exactly as it is journaled.

Entries are made by the front (after schema and limit checks), or by the process that owns the session (`HOST`). They
hold no key, secret or token. A step is `(now_ns, entries, n_ticks)`; see docs/architecture.md, "One step".
"""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

from iris_session.protocol.client_messages import (
    Acquire,
    Align,
    Assign,
    Bye,
    ClearEStop,
    Consent,
    Control,
    Episode,
    EStop,
    GetSnapshot,
    Grasp,
    Heartbeat,
    Marker,
    MoveAnchor,
    Observation,
    PlaceAlignment,
    Release,
    RemoveParticipant,
    Rename,
    Sample,
    SetMode,
    SetRole,
    SetScale,
    TrackingEpoch,
    Withdraw,
)
from iris_session.protocol.codec import make_decoder
from iris_session.protocol.common import Count, Message, Name, Names, Nanoseconds, Pose, Text, Vec3
from iris_session.protocol.scene import MAX_OPS, PatchOp
from iris_session.protocol.specs import ObjectSpec, RobotSpec

#: Connection number of the process that owns the session (its Python API). It acts with the rights of a director.
HOST: Final = 0


class Join(Message, frozen=True, tag="join"):
    """A connection whose `hello` the front accepted. `key_id`: fingerprint of the authenticated key.

    `resume_of`: participant id whose resume token the front has verified, else empty. `gateway`: connection of the
    gateway in front of this one, else 0. `roles`: those that the key may join as; empty: any role.
    """

    key_id: Name
    role: Name
    name: Name
    software: Name = ""
    devices: tuple[Name, ...] = ()
    capabilities: tuple[Name, ...] = ()
    alignment: Name = "measured"
    resume_of: Name = ""
    gateway: Count = 0
    roles: Names = ()


class Lost(Message, frozen=True, tag="lost"):
    """A disconnect (socket closed, heartbeats missing). The grace period begins."""

    reason: Name = ""


class AnchorLooks(msgspec.Struct, frozen=True):
    """Session times of the first and the last look at an anchor that an estimate rests on."""

    anchor_id: Name
    first_ns: Nanoseconds
    last_ns: Nanoseconds


class AlignmentProposal(Message, frozen=True, tag="alignment_proposal"):
    """Result of the estimator in the front, for the participant of this entry's connection.

    Covariance: 6x6 row-major at the anchor, order (x, y, z, rx, ry, rz), world frame. `advice` is set when the
    estimator refuses (`refused` true): "step closer", "add a sheet near the robot".
    `pivot_world`: the point that the covariance is stated at (the anchor). `kind`: the `AlignmentKind` that it makes.
    `tilt_noise_rad`: what noise alone explains of the tilt. `look_s`: so many seconds of looking mend much; 0: they do
    not. `looks`: of the anchors that it rests on. `moved`: anchors that others outvote. `looked_ns`: session time when
    the newest look or touch was received that it agrees with; 0: the time of this entry.
    """

    T_world_tracking: Pose
    tracking_epoch: Count
    covariance: tuple[float, ...]
    pivot_world: tuple[float, float, float]
    error_at_anchor_m: float
    residual_tilt_rad: float = 0.0
    n_observations: Count = 0
    n_viewpoints: Count = 0
    refused: bool = False
    advice: Text = ""
    kind: Name = "measured"
    tilt_noise_rad: float = 0.0
    look_s: float = 0.0
    looks: tuple[AnchorLooks, ...] = ()
    moved: Names = ()
    looked_ns: Nanoseconds = 0


class TipSolved(Message, frozen=True, tag="tip_solved"):
    """Result of the calibration of a tip in the front, for the participant of this entry's connection. Fields as in
    `TipCalibrated`.
    """

    device: Name
    p_grip_tip: Vec3 = (0.0, 0.0, 0.0)
    covariance: tuple[float, ...] = ()
    error_m: float = 0.0
    residual_m: float = 0.0
    n_poses: Count = 0
    refused: bool = False
    advice: Text = ""


class AlignmentAlarm(Message, frozen=True, tag="alignment_alarm"):
    """An alarm of the front's drift monitor: the alignment of this entry's connection is wrong (`AlarmKind`) by
    `size_m`.

    `anchor_id`: where it was observed, empty for the head's own motion. `beside`: anchors that stayed in place
    meanwhile: then `anchor_id` was moved, not the headset. `shift_m`: from its place to where it is seen now, in the
    world by the alignment in force; empty: not known.
    """

    kind: Name
    tracking_epoch: Count
    anchor_id: Name = ""
    size_m: float = 0.0
    capture_ns: Nanoseconds = 0
    beside: Names = ()
    shift_m: tuple[float, ...] = ()


class CrossChecked(Message, frozen=True, tag="cross_checked"):
    """A cross-check of two headsets: this entry's connection and `other`. Fields as in `HeadsetsCompared`."""

    other: Count
    anchor_id: Name
    error_m: float
    error_rad: float
    expected_p95_m: float
    p_world: Vec3
    n: Count
    touched: bool = False


class ExternalReset(Message, frozen=True, tag="external_reset"):
    """The owner's loop went back in time or replaced the state (host only)."""


class StalledGap(Message, frozen=True, tag="stalled_gap"):
    """No step was taken for `duration_ns` (host only): robots hold until clutched again."""

    duration_ns: Nanoseconds


class PhysicsDiverged(Message, frozen=True, tag="physics_diverged"):
    """Physics of this scene epoch has numbers that are not finite and stands still until a reset (host only). `text`:
    the reason, for people.
    """

    scene_epoch: Count
    text: Text = ""


class FrontRestarted(Message, frozen=True, tag="front_restarted"):
    """The front process was replaced (host only): every connection is closed."""


class RecordingGap(Message, frozen=True, tag="recording_gap"):
    """The recorder's feed lost rows (host only)."""

    rows: Count


class Audit(Message, frozen=True, tag="audit"):
    """An event that concerns security, reported by the front (host only); fields as in `Audited`."""

    kind: Name
    subject: Name = ""
    name: Name = ""
    address: Name = ""
    detail: Text = ""
    count: Count = 1


class SessionResumed(Message, frozen=True, tag="session_resumed"):
    """The session continues from a keyframe of an earlier recording, after `gap_ns` (host only). `anchors`: all of
    them, when they were given anew; empty: as they were. `is_gap_known`: false after a reboot of the host, when session
    time continues as if there had been no gap.
    """

    gap_ns: Nanoseconds
    anchors: dict[Name, Pose] = msgspec.field(default_factory=dict)
    is_gap_known: bool = True


class SceneLoaded(Message, frozen=True, tag="scene_loaded"):
    """Another scene replaces the present one before the ticks of this step (host only).

    `model_hash`: BLAKE2b of the MuJoCo model's binary form, which the recording holds beside the journal. `robots`,
    `objects`: those of the scene. `initial_state`: `mjSTATE_INTEGRATION` to begin with and to reset to; empty: the
    model's own.
    """

    model_hash: Name
    robots: tuple[RobotSpec, ...] = ()
    objects: tuple[ObjectSpec, ...] = ()
    initial_state: bytes = b""


class ScenePatched(Message, frozen=True, tag="scene_patched"):
    """A visual change of the scene in this step (host only). `scene_hash`: of the specification after `ops`."""

    ops: Annotated[tuple[PatchOp, ...], msgspec.Meta(max_length=MAX_OPS)]
    scene_hash: Name


class ObjectsPlaced(Message, frozen=True, tag="objects_placed"):
    """The scene is reset with the objects of the task at other places (host only).

    `objects`, `poses`: `T_world_object`, in the same order. `number`: of the episode that they are for. `seed`: from
    which, with the number, they were drawn. Not while an episode is recorded: then it does nothing.
    """

    objects: Names
    poses: Annotated[tuple[Pose, ...], msgspec.Meta(max_length=64)]
    number: Count = 0
    seed: Count = 0


class OwnerListens(Message, frozen=True, tag="owner_listens"):
    """The owner's loop takes requests of directors from here on: to reset, to record an episode again (host only)."""


EntryMessage = (
    Join
    | Lost
    | Bye
    | Heartbeat
    | GetSnapshot
    | Sample
    | Acquire
    | Release
    | Withdraw
    | Consent
    | Assign
    | SetMode
    | SetScale
    | Grasp
    | Observation
    | AlignmentProposal
    | PlaceAlignment
    | Align
    | MoveAnchor
    | AlignmentAlarm
    | TipSolved
    | CrossChecked
    | TrackingEpoch
    | Episode
    | EStop
    | ClearEStop
    | Control
    | Marker
    | ExternalReset
    | StalledGap
    | PhysicsDiverged
    | FrontRestarted
    | RecordingGap
    | RemoveParticipant
    | Rename
    | SetRole
    | Audit
    | SessionResumed
    | SceneLoaded
    | ScenePatched
    | ObjectsPlaced
    | OwnerListens
)


class Entry(msgspec.Struct, frozen=True, array_like=True):
    """One input. `connection`: number of its connection, unique in the session, growing, `HOST` for the owner's.

    `connection_epoch`: the epoch that the sender claimed in its envelope (equal to `connection` when honest; the
    authority rejects a mismatch). `receive_ns`: session time stamped by the front.
    """

    connection: Count
    connection_epoch: Count
    receive_ns: Nanoseconds
    message: EntryMessage


#: Messages of the urgent lane: handled before everything else in a step.
URGENT: Final = (EStop, Release, Lost, Bye)

_encoder = msgspec.msgpack.Encoder()
_decode = make_decoder(Entry)
_decode_list = make_decoder(list[Entry])


def encode_entry(entry: Entry) -> bytes:
    """Return the MessagePack bytes of one entry; `decode_entry(encode_entry(e)) == e`, floats exactly."""
    return _encoder.encode(entry)


def decode_entry(data: bytes) -> Entry:
    """Decode one entry. Raises `msgspec.DecodeError` (or its subclass `ValidationError`)."""
    return _decode(data)


def encode_entries(entries: list[Entry]) -> bytes:
    """Return the MessagePack array of entries."""
    return _encoder.encode(entries)


def decode_entries(data: bytes) -> list[Entry]:
    """Decode an array of entries. Raises `msgspec.DecodeError`."""
    return _decode_list(data)
