"""Bounds and policies of the session authority: every number of its rules, as a field with its default."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import msgspec

from anchors.ageing import AgeingLaw
from anchors.pose import is_rigid
from iris_session.protocol.common import Name, Pose
from iris_session.protocol.names import AssignmentPolicy, Device, LeaseMode, Role
from iris_session.protocol.specs import ObjectSpec, RobotSpec, TaskSpec

MS: Final = 1_000_000
SECOND: Final = 1_000_000_000


class SpeedLimit(msgspec.Struct, frozen=True):
    """Fastest motion of a device: [m/s] and [rad/s].

    `linear_acceleration` [m/s^2], `angular_acceleration` [rad/s^2]: of a device that measures, so that its poses are
    never twice the same and never jump (`tracking`); 0: it does not measure, only its speed counts. `noise_m`,
    `noise_rad`: by which a pose may miss the way of a device that moves evenly.
    """

    linear: float
    angular: float
    linear_acceleration: float = 0.0
    angular_acceleration: float = 0.0
    noise_m: float = 0.0
    noise_rad: float = 0.0


#: People throw controllers at about 10 m/s and accelerate them with 100 m/s^2 in table tennis; half as much again is no
#: stroke. Three poses of 0.5 mm (hands: 1 mm) noise per axis miss an even way by 10 mm (12 mm) less than once an hour.
_CONTROLLER: Final = SpeedLimit(10.0, 40.0, 150.0, 1500.0, 0.010, 0.10)
_HAND: Final = SpeedLimit(10.0, 40.0, 150.0, 1500.0, 0.012, 0.15)
#: Heads turn at up to 15 rad/s.
SPEED_LIMITS: Final[dict[str, SpeedLimit]] = {
    Device.HEAD: SpeedLimit(5.0, 20.0, 75.0, 750.0, 0.010, 0.10),
    Device.CONTROLLER_LEFT: _CONTROLLER,
    Device.CONTROLLER_RIGHT: _CONTROLLER,
    Device.HAND_LEFT: _HAND,
    Device.HAND_RIGHT: _HAND,
    Device.JOINTS: SpeedLimit(10.0, 20.0),
    Device.GAZE: SpeedLimit(50.0, 50.0),
    Device.DESKTOP: SpeedLimit(10.0, 40.0),
    Device.TARGET: SpeedLimit(5.0, 20.0),
}


#: Roles and devices that may drive without an alignment: what they send is in the world already, or relative to what
#: their user sees on a screen. A headset is worn in the room of the robots, and must be aligned to it.
UNALIGNED: Final = (Role.AGENT, Role.LEADER, Device.JOINTS, Device.TARGET, Device.DESKTOP)
#: Before a key's fingerprint (`Join.key_id`) in `AuthorityConfig.assignments` and `AuthorityConfig.unaligned`.
KEY_PREFIX: Final = "key:"

#: Settings without which nothing can work, or that something is divided by.
POSITIVE: Final = (
    "freshness_ns",
    "gap_ns",
    "frozen_ns",
    "heartbeat_timeout_ns",
    "reach_m",
    "quota",
    "max_participants",
    "max_sub_holders",
    "max_step_ticks",
    "contact_step_n",
    "max_anchor_move_m",
    "max_error_to_view_m",
    "min_change_share",
    "age_check_ns",
    "slide_ns",
    "slide_m_per_s",
    "slide_rad_per_s",
    "confirm_ns",
    "verdict_ns",
)


class AuthorityConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Configuration of `Authority`. Times in nanoseconds of session time, lengths in metres, angles in radians.

    `assignments`: participant name, or `key:<fingerprint>`, -> robots (policy `config`). `leader_apart`: `ramp`
    (control ramps) or `refuse`. `unaligned`: roles, devices and keys (`key:<fingerprint>`) that may drive without an
    alignment when they say that they need none. `doubts`: an alignment that later looks contradict, or that is too old,
    begins no engagement. `ageing`: how its stated error grows since the last look; None: not. `verify_pairs`: those who
    saw an anchor last before another participant aligned by it are to glance at it, and headsets that see the same
    shift of an anchor outvote it. `user_owned_loop`: the user drives physics, so pause, step and reset are denied.
    `episode_rules`: episodes have a countdown, a closing and people who may leave; False: as in earlier recordings.
    `strict_episodes`: who starts one holds a robot, objects are placed before it begins, a button counts a second after
    the state changed, and a refused one is reported; False: as in earlier recordings.
    `self_rename`: everyone may change their own name; False: as in earlier recordings.
    """

    # samples
    freshness_ns: int = 150 * MS  # oldest capture, longest wait without a counted sample
    future_ns: int = 5 * MS
    quaternion_tolerance: float = 1e-3
    reach_m: float = 1000.0  # a finite number beyond this is rejected like an infinite one
    speed_limits: dict[str, SpeedLimit] = msgspec.field(default_factory=lambda: dict(SPEED_LIMITS))
    speed_slack_m: float = 0.02  # tracking noise and clock slew on top of speed * time
    speed_slack_rad: float = 0.1
    frozen_ns: int = 500 * MS  # a device that measures and reports one pose for so long has stopped to measure
    leader_apart: str = "ramp"
    leader_apart_rad: float = 0.2
    # membership
    heartbeat_timeout_ns: int = 3 * SECOND
    grace_ns: int = 30 * SECOND
    gap_ns: int = 150 * MS  # a longer time between two steps is a gap: robots hold until clutched again
    drain_ns: int = 250 * MS  # after a gap nothing expires before the waiting entries had this long to arrive
    max_participants: int = 64
    self_rename: bool = True
    quota: int = 64  # entries per participant and step, urgent ones not counted
    # leases
    policy: Name = AssignmentPolicy.JOIN_ORDER
    assignments: dict[str, tuple[str, ...]] = {}
    default_mode: Name = ""  # empty: the mode of the robot's own specification
    max_queue: int = 32
    max_consents: int = 16
    consent_timeout_ns: int = 15 * SECOND
    intervention_idle_ns: int = 2 * SECOND  # a human whose clutch stays open this long lets agents have the robot
    max_sub_holders: int = 4  # people who share one robot, hands that hold one object
    min_scale: float = 0.05  # motion scaling that holders may set; those of `ControlConfig`
    max_scale: float = 5.0
    # alignment
    unaligned: tuple[Name, ...] = UNALIGNED
    max_error_at_robot_m: float = 0.05  # stated p95; above it the alignment is refused with advice
    max_error_to_view_m: float = 0.2  # the same for alignments that do not drive
    max_residual_tilt_rad: float = 0.01745  # 1 degree: a warning
    patience_ns: int = 2 * SECOND  # of the first refusals of a participant: progress, then a warning
    min_change_m: float = 0.002  # smaller corrections of an accepted alignment are not worth a new version
    min_change_rad: float = 0.002
    min_change_share: float = 0.25  # and at most this share of the stated error
    max_anchor_move_m: float = 5.0  # at once, unless forced: catches wrong units
    anchors: dict[str, Pose] = {}  # T_world_anchor by id, until a director moves one
    doubts: bool = True
    ageing: AgeingLaw | None = msgspec.field(default_factory=AgeingLaw)
    age_check_ns: int = SECOND  # between two looks at the age of an alignment, and at its pairs
    verify_pairs: bool = True
    vote_ns: int = 2 * SECOND  # a warning waits for others that may see the same: five looks of a source at 3 Hz
    settle_ns: int = 15 * SECOND  # after the first alignment of a run; from then on corrections come gently
    slide_ns: int = 500 * MS  # between two parts of a correction that slides in
    slide_m_per_s: float = 0.004  # slow enough not to be noticed in a headset
    slide_rad_per_s: float = 0.00524  # 0.3 degrees
    announce_m: float = 0.010  # larger corrections are announced, and come in one go
    announce_rad: float = 0.0349  # 2 degrees
    announce_ns: int = 2 * SECOND  # from the announcement to the correction
    # handover: contact flickers for a few ticks at every change of grip
    handover_hold_ns: int = 100 * MS  # giver must have held it alone this long; receiver afterwards too
    handover_flicker_ns: int = 50 * MS
    # episodes
    episode_rules: bool = True
    strict_episodes: bool = True
    countdown_ns: int = 3 * SECOND
    confirm_ns: int = 3 * SECOND  # a discard is confirmed within it
    takeover_ns: int = 10 * SECOND  # an episode whose leader is disconnected is then unknown
    verdict_ns: int = 60 * SECOND  # an episode that was stopped without a verdict is then unknown
    task: TaskSpec | None = None
    # output
    feedback_ns: int = 50 * MS
    report_ns: int = SECOND  # between two `samples_rejected` events of one kind
    explains: bool = True  # how long the lease of a disconnected holder is kept; grippers that are out of range
    warning_ns: int = 5 * SECOND  # between two warnings of one kind about the alignment of one participant
    contact_step_n: float = 0.5  # contact force is reported in steps of this size [N]
    max_step_ticks: int = 10_000
    user_owned_loop: bool = False


def check_config(config: AuthorityConfig, robots: Sequence[RobotSpec], objects: Sequence[ObjectSpec]) -> None:
    """Raise `ValueError` for a setting that cannot work; the message says which values can."""
    names = [r.name for r in robots]
    for kind, all_names in (("robot", names), ("object", [o.name for o in objects])):
        if len(set(all_names)) != len(all_names):
            raise ValueError(f"{kind} names must differ: {all_names}")
    for mode in (config.default_mode or LeaseMode.EXCLUSIVE, *(r.mode for r in robots)):
        if mode not in LeaseMode.ALL:
            raise ValueError(f"unknown lease mode {mode!r}, known: {sorted(LeaseMode.ALL)}")
    if config.policy not in AssignmentPolicy.ALL:
        raise ValueError(f"unknown assignment policy {config.policy!r}, known: {sorted(AssignmentPolicy.ALL)}")
    unknown = [r for given in config.assignments.values() for r in given if r not in names]
    if unknown:
        raise ValueError(f"assignments name unknown robots {unknown}, robots: {names}")
    if config.task is not None:
        unknown = [r for r in config.task.robots if r not in names]
        if unknown:
            raise ValueError(f"the task names unknown robots {unknown}, robots: {names}")
        known = [o.name for o in objects]
        unknown = [o.object for o in config.task.objects if o.object not in known]
        if unknown:
            raise ValueError(f"the task names unknown objects {unknown}, objects: {known}")
        if config.task.objects and config.user_owned_loop:
            raise ValueError("the objects of a task are placed in the loop of run(); your own loop places its objects")
    if config.leader_apart not in ("ramp", "refuse"):
        raise ValueError(f"leader_apart is {config.leader_apart!r}, must be 'ramp' or 'refuse'")
    unknown = [who for who in config.unaligned if who not in Role.ALL | Device.ALL and not who.startswith(KEY_PREFIX)]
    if unknown:
        raise ValueError(f"unaligned names {unknown}, which are no roles, devices, or keys as {KEY_PREFIX}FINGERPRINT")
    missing = sorted(Device.ALL - config.speed_limits.keys())
    if missing:
        raise ValueError(f"speed_limits lacks {', '.join(missing)}; it must have every device")
    for name in POSITIVE:
        if not getattr(config, name) > 0:
            raise ValueError(f"{name} is {getattr(config, name)}; it must be positive")
    for name, T in config.anchors.items():
        if not (is_rigid((T.p, T.q), config.reach_m)):
            raise ValueError(f"anchor {name!r}: {T} is not finite with a unit quaternion, within {config.reach_m:g} m")
    if not 0.0 < config.min_scale <= config.max_scale < math.inf:
        raise ValueError(
            f"min_scale {config.min_scale} and max_scale {config.max_scale} must be positive, finite and in this order"
        )
