"""The whole memory of the authority between steps, as plain mutable structs. `AuthorityState` is the snapshot.

Nothing else in this room keeps state; caches elsewhere are derived from these structs and can be rebuilt at any time.
"""

from __future__ import annotations

from typing import Final

import msgspec

from iris_session.authority.tracking import Track
from iris_session.protocol.common import IDENTITY, Alignment, Pose, Vec3
from iris_session.protocol.entries import AnchorLooks, SceneLoaded
from iris_session.protocol.names import HoldReason
from iris_session.protocol.scene import PatchOp
from iris_session.protocol.server_messages import EpisodeChanged, Feedback
from iris_session.protocol.steps import CommandSource

#: Participant id of the process that owns the session. It is not part of the roster.
HOST_ID: Final = "host"
#: `Pending.request_id` of a place in the queue that outlived its connection: no reply is sent.
NO_REPLY: Final = -1
#: Fields of `Participant` that say how its alignment ages.
AGEING_FIELDS: Final = ("aged", "age_due_ns", "confirmed_walked_m", "walked_m", "stride_from")
#: Fields of `Participant` that snapshots of the first recordings of this format do not have.
ADDED_FIELDS: Final = frozenset(
    {"roles", "hello_name", "hello_role", "doubt", "confirmed_ns", "looks", "pairs_due_ns", "shift", *AGEING_FIELDS}
)
#: `Participant.connection` while the connection is lost.
NO_CONNECTION: Final = -1


class JointReading(msgspec.Struct, array_like=True):
    """Newest joint positions of one device, and when they were sampled."""

    capture_ns: int
    q: tuple[float, ...]


class DeviceState(msgspec.Struct):
    """Newest usable payloads of one device, which the next ones are compared with, regardless of samples in between.

    `pose`: in the tracking frame, sampled at `pose_ns`. `joints`: by their number. `track`: of a device that measures.
    """

    seq: int = -1
    pose_ns: int = 0
    pose: Pose | None = None
    joints: dict[int, JointReading] = {}
    track: Track | None = None
    buttons: int = 0


class Rejections(msgspec.Struct):
    """Rejected samples of one device for one reason."""

    count: int = 0
    reported_ns: int | None = None


class WarningState(msgspec.Struct):
    """Warnings of one kind to one participant: the one in force and when it was sent, the newest condition, and how
    many were left out since.
    """

    said: str = ""
    said_ns: int = 0
    seen: str = ""
    left_out: int = 0


class Correction(msgspec.Struct):
    """A measured alignment (without the director's offset) that is not wholly in force yet.

    `T_told`: its pose when it was announced to the wearer; it may change afterwards. `slides_ns`: when its next part
    may come into force. `looked_ns`, `walked_m`: of the last look that agreed with it, as in `Participant`.
    """

    T_world_tracking: Pose
    covariance: tuple[float, ...]
    pivot_world: Vec3
    error_at_anchor_m: float
    slides_ns: int
    T_told: Pose | None = None
    looked_ns: int = 0
    walked_m: float = 0.0


class Placement(msgspec.Struct):
    """A director's placement that waits until the clutch of its wearer opens."""

    T_world_tracking: Pose
    offset: bool


class AlarmState(msgspec.Struct):
    """The last unresolved alarm about an alignment (`AlarmKind`)."""

    kind: str
    anchor_id: str
    size_m: float
    beside: tuple[str, ...]
    raised_ns: int


class SheetShift(msgspec.Struct):
    """The newest shift of an anchor that a headset has seen, in the world, by the alignment that was in force.

    `p95_m`: of the stated error of that alignment at the anchor. `seen_ns`: session time. `is_said`: as a shift of the
    anchor. `text`: the warning that the headset itself is aligned wrongly, which waits until `due_ns` for others that
    see the same; empty: none waits.
    """

    anchor_id: str
    shift_m: Vec3
    p95_m: float
    seen_ns: int
    is_said: bool = False
    text: str = ""
    due_ns: int = 0


class Participant(msgspec.Struct):
    """One member of the session. `expires_ns` is 0 while connected, else the end of the grace period.

    `spared`: a gap has put off its expiry, and the gaps that follow that one at once do not put it off again. `run`:
    value of the capability `run:<id>`; a resumed connection with the same one continues the same tracking frame.
    `T_world_tracking_measured`: of the alignment in force, the measured part, without the director's `offset`; None for
    one that was placed. `pivot_world`: the point at which its covariance is stated. `aligning`: its alignment run is
    active, `alignment_run` counts the starts. `placed`: a director's placement is in force, so measurements do not
    count. `in_use`: it has engaged in this run and tracking frame, first aligned in it at `aligned_ns`. Proposals that
    were made at `proposals_from_ns` or before do not count. `told_ns`: when a correction was last announced to its
    wearer. `roles`: those that its key may join as; empty: any. `hello_name`, `hello_role`: what it said when it
    joined, empty unless a director changed it since. `refusal`: of a measurement, reported as progress since
    `refusal_from_ns`; empty: none, or it was reported as a warning. `doubt`: why the alignment begins no engagement
    (`AlignmentDoubt`), empty for none. `confirmed_ns`, `confirmed_walked_m`: time of the last look that agreed with it,
    and the distance walked until then. `walked_m`: by the head, in strides of which the last ended at `stride_from`
    (tracking frame). `aged`: the alignment with the error that was last stated for its age; None: as it was measured.
    `age_due_ns`: when its age is looked at again. `looks`: of the anchors that the alignment rests on, by id, without a
    contradiction from the first to the last. `pairs_due_ns`: when it is compared with everybody else's again. `shift`:
    of an anchor that contradicted the alignment. `devices` empty: none declared, all known ones are accepted.
    """

    id: str
    name: str
    role: str
    key_id: str
    connection: int
    needs_alignment: bool
    heard_ns: int
    gateway: int = 0
    run: str = ""
    devices: tuple[str, ...] = ()
    expires_ns: int = 0
    spared: bool = False
    worn: bool = True
    tracking_epoch: int = 0
    alignment_version: int = 0
    alignment: Alignment | None = None
    T_world_tracking_measured: Pose | None = None
    offset: Pose | None = None
    pivot_world: Vec3 = (0.0, 0.0, 0.0)
    alignment_run: int = 0
    aligning: bool = True
    placed: bool = False
    in_use: bool = False
    aligned_ns: int | None = None
    proposals_from_ns: int = -1
    correction: Correction | None = None
    placing: Placement | None = None
    told_ns: int | None = None
    alarm: AlarmState | None = None
    refused_ns: int | None = None
    refusal: str = ""
    refusal_from_ns: int = 0
    doubt: str = ""
    confirmed_ns: int = 0
    confirmed_walked_m: float = 0.0
    walked_m: float = 0.0
    stride_from: Vec3 | None = None
    aged: Alignment | None = None
    age_due_ns: int = 0
    looks: dict[str, AnchorLooks] = {}
    pairs_due_ns: int = 0
    shift: SheetShift | None = None
    warnings: dict[str, WarningState] = {}
    seen: dict[str, DeviceState] = {}
    rejected: dict[str, int] = {}
    rejections: dict[str, Rejections] = {}
    roles: tuple[str, ...] = ()
    hello_name: str = ""
    hello_role: str = ""

    @property
    def published_alignment(self) -> Alignment | None:
        """The alignment as clients receive it: as it has aged, and with the pivot of its covariance, which the state
        has beside it.
        """
        alignment = self.aged or self.alignment
        if alignment is None or not alignment.covariance:
            return alignment
        return msgspec.structs.replace(alignment, pivot_world=self.pivot_world)


class LeaseGrant(msgspec.Struct):
    """The right of one participant on one target, its clutch latches and its engagement.

    `version`: fencing token; tokens from it up to the lease's own are valid, so a second sharer does not fence the
    first. `hand`: the only device that may use it (objects taken with `grasp`). `scale`: motion scaling (robots).
    `armed`: devices whose clutch was seen open since the last rearm. `engagement` 0: not engaged, `hold` is the reason.
    `open_from_ns` to `open_ns`: first and newest sample of the time in which the clutch of `device` is open; `open_ns`
    0: not open, or not known. `request_id`: of the `acquire` of the present connection that granted it, else
    `NO_REPLY`.
    """

    participant: str
    version: int
    weight: float = 1.0
    hand: str = ""
    scale: float = 1.0
    armed: list[str] = []
    hold: str = HoldReason.NO_SAMPLE
    engagement: int = 0
    device: str = ""
    kind: str = ""
    alignment_version: int = 0
    T_world_tracking: Pose = IDENTITY
    counted_ns: int = 0
    counted_step: int = 0
    open_from_ns: int = 0
    open_ns: int = 0
    source: CommandSource | None = None
    gripper: float | None = None
    request_id: int = NO_REPLY


class LeaseState(msgspec.Struct):
    """One robot or object. `override`: the human who has preempted the agent (mode `priority`), also while it is
    disconnected.

    Robots that go home when they are released: `home`, joint positions at the beginning of the scene; `freed_ns`, since
    when it may move there, 0: it holds; `homing`, the engagement of that motion.

    Objects: `lead` is the engagement of the leading hand, `T_hand_object` its latched offset, `T_world_object` the
    last commanded pose.
    """

    target: str
    kind: str
    mode: str
    version: int = 0
    grants: list[LeaseGrant] = []
    override: str = ""
    lead: int = 0
    T_hand_object: Pose = IDENTITY
    T_world_object: Pose = IDENTITY
    home: tuple[float, ...] = ()
    freed_ns: int = 0
    homing: int = 0


class Pending(msgspec.Struct):
    """An `acquire` without an answer yet: it is queued, or waits for consents.

    `consents`: consent id -> robot whose holder has not answered; `granted`: robot -> holder who gave it. `expires_ns`
    0: never.
    """

    participant: str
    request_id: int
    robots: tuple[str, ...]
    objects: tuple[str, ...]
    weight: float
    any_robot: bool = False
    consents: dict[int, str] = {}
    granted: dict[str, str] = {}
    expires_ns: int = 0


class HandoverTrack(msgspec.Struct):
    """Progress of one object from `giver` to `receiver`. Times: session time."""

    giver: str = ""
    alone_ns: int = 0
    receiver: str = ""
    both_from_ns: int | None = None
    both_until_ns: int = 0
    taken_ns: int | None = None
    seen_ns: int = 0


class FeedbackState(msgspec.Struct):
    """The last feedback sent to each holder of one robot, and when the next is due."""

    due_ns: int = 0
    sent: dict[str, Feedback] = {}


class CrossCheckState(msgspec.Struct):
    """The newest cross-check of two headsets; fields as in `HeadsetsCompared`. `T_world_trackings`: of both, then."""

    a: str
    b: str
    anchor_id: str
    error_m: float
    error_rad: float
    expected_p95_m: float
    n: int
    compared_ns: int
    touched: bool = False
    p_world: Vec3 = (0.0, 0.0, 0.0)
    T_world_trackings: tuple[Pose, ...] = ()


class StopState(msgspec.Struct, array_like=True):
    """One e-stop that is in force. `name`: of the participant, as it was then."""

    stop_seq: int
    participant: str
    name: str
    reason: str
    stopped_ns: int


class AuthorityState(msgspec.Struct):
    """The authority's whole memory. `name_owners`: assigned name -> key that has it (policy `config`).

    `scene`: None while it is the one that the session began with. `patches`: all of its patches, merged. `anchors`:
    `T_world_anchor` by id, as they are since `anchors_ns`. `cross_checks`: by both participants, "a b", and "a b
    touched". `handovers`: objects on their way between people; `regrasps`: between two robots, of one person too.
    `stop_seq` counts the e-stops, `stops` are those in force, oldest first. `diverged`: why physics stands still
    until a reset, which also ends the pause that came of it (`paused_by_divergence`). `owner_listens`: the owner of
    a user loop takes requests. `rerecording`: the episode whose number begins again when the scene is reset.
    `episode_ns`: when the episode came into its state, other than its countdown. `placed_epoch`: scene epoch that began
    with the objects of the task placed.
    """

    robots: dict[str, LeaseState]
    objects: dict[str, LeaseState]
    participants: dict[str, Participant]
    step: int = 0
    now_ns: int | None = None
    event_seq: int = 0
    scene_epoch: int = 1
    scene_revision: int = 0
    scene: SceneLoaded | None = None
    patches: tuple[PatchOp, ...] = ()
    next_participant: int = 1
    next_engagement: int = 1
    next_consent: int = 1
    last_connection: int = 0
    queue: list[Pending] = []
    consents: list[Pending] = []
    estop: bool = False
    stop_seq: int = 0
    stops: list[StopState] = []
    paused: bool = False
    diverged: str = ""
    paused_by_divergence: bool = False
    hold_expiry_until_ns: int = 0
    episode: EpisodeChanged | None = None
    owner_listens: bool = False
    rerecording: EpisodeChanged | None = None
    episode_ns: int = 0
    placed_epoch: int = 0
    handovers: dict[str, HandoverTrack] = {}
    regrasps: dict[str, HandoverTrack] = {}
    handover_tick: int = -1
    feedback: dict[str, FeedbackState] = {}
    unattributed: dict[str, Rejections] = {}
    name_owners: dict[str, str] = {}
    anchors: dict[str, Pose] = {}
    anchors_ns: int = -1
    cross_checks: dict[str, CrossCheckState] = {}


def is_same_snapshot(recorded: bytes, snapshot: bytes) -> bool:
    """Return whether two snapshots say the same. `recorded` may lack fields that participants got later, and their
    alignments.
    """
    if recorded == snapshot:
        return True
    earlier, present = msgspec.msgpack.decode(recorded), msgspec.msgpack.decode(snapshot)
    if not isinstance(earlier, dict) or not isinstance(present, dict):
        return False
    had = earlier.get("participants", {})
    for name, fields in present.get("participants", {}).items():
        if not isinstance(had, dict) or not isinstance(had.get(name), dict):
            return False
        for added in ADDED_FIELDS - had[name].keys():
            del fields[added]
        seen = had[name].get("seen")
        for device, state in fields["seen"].items():
            for added in ("track", "buttons"):
                if isinstance(seen, dict) and added not in seen.get(device, ()):
                    del state[added]
        alignment = had[name].get("alignment")
        if isinstance(alignment, dict) and "pivot_world" not in alignment and fields["alignment"] is not None:
            del fields["alignment"]["pivot_world"]
        correction = had[name].get("correction")
        if isinstance(correction, dict) and fields["correction"] is not None:
            for added in {"looked_ns", "walked_m"} - correction.keys():
                del fields["correction"][added]
    for added in ("episode_ns", "placed_epoch"):
        if added not in earlier:
            present.pop(added, None)
    for name in ("episode", "rerecording"):
        if isinstance(episode := earlier.get(name), dict) and isinstance(present.get(name), dict):
            present[name] = {key: value for key, value in present[name].items() if key in episode}
    return bool(earlier == present)
