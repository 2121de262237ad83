"""From counted samples to exactly one command per robot and step, commands of held objects, and feedback to holders.

Free objects are held by hands without a robot. The hand that engaged first leads: the object follows it with the offset
latched at that moment. When it releases while another hand holds, the offset to that one is latched from the object's
last commanded pose, so nothing jumps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import msgspec

from anchors.pose import compose, inverse, quat_rotate
from iris_session.authority import ageing, engagement, episodes, roster, samples, tracking
from iris_session.authority.config import SECOND
from iris_session.authority.context import HUMAN, Context
from iris_session.authority.state import (
    HOST_ID,
    DeviceState,
    FeedbackState,
    JointReading,
    LeaseGrant,
    LeaseState,
    Participant,
    WarningState,
)
from iris_session.protocol.client_messages import Sample
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import Entry
from iris_session.protocol.names import CommandKind, Device, HoldReason, LeaseMode, RejectReason, SampleKind
from iris_session.protocol.server_messages import Feedback, Notice, PresenceItem
from iris_session.protocol.specs import ON_RELEASE_HOME
from iris_session.protocol.steps import Command, CommandSource, ObjectCommand

#: Objects farther away than this [m] have left the scene; far below what arithmetic can hold.
_FARTHEST: Final = 1e9
#: Hold reasons after which a closed clutch changes the reason to `rearm`: the clutch must open and close again.
_WAITING = (HoldReason.NO_SAMPLE, HoldReason.CLUTCH_OPEN)
#: A gripper value that is out of range by more than rounding is reported: a policy has other units (0 to 255, -1 to 1).
GRIPPER_SLACK: Final = 0.01
GRIPPER_REPORT_NS: Final = 60 * SECOND
#: A released robot stands for so long before it goes home, and gives up after so long [ns].
HOME_AFTER_NS: Final = SECOND // 2
HOME_WITHIN_NS: Final = 20 * SECOND
#: It is there when every joint is within this [rad or m].
HOME_CLOSE: Final = 0.01
_INVISIBLE = (Device.JOINTS, Device.TARGET)


def process_sample(ctx: Context, entry: Entry, s: Sample) -> None:
    """Count one sample, or reject it with its reason."""
    p = ctx.by_connection.get(entry.connection)
    if p is None:
        return samples.count_rejection(ctx, None, s.device, RejectReason.CONNECTION_EPOCH)
    drives: list[samples.Drive] = []
    reason = samples.check_sample(ctx, p, entry, s, drives)
    if reason:
        return samples.reject_sample(ctx, p, s, reason)
    usable = samples.is_measured(ctx, p, s)
    before = p.seen[s.device].buttons if s.device in p.seen else s.buttons
    _store_payload(p, s, usable)
    if s.buttons != before and s.tracked and s.worn:
        episodes.press_buttons(ctx, p, s, before)
    if s.worn != p.worn:
        roster.set_worn(ctx, p, s.worn)
    way = samples.follow_device(ctx, p, s) if usable else tracking.STEADY
    if way == tracking.JUMP and _stop_device(ctx, p, s.device):
        return samples.reject_sample(ctx, p, s, RejectReason.JUMP)
    if way == tracking.OUTLIER:
        samples.count_rejection(ctx, p, s.device, RejectReason.JUMP)
    for lease, g in drives:
        waits = way == tracking.SURPRISE and s.clutch
        if not waits:
            _update_latch(ctx, p, lease, g, s)
        if g.engagement and g.device == s.device:
            if waits:
                g.counted_ns = ctx.now_ns
            else:
                _set_source(ctx, p, lease, g, entry, s)
    if usable and s.kind == SampleKind.POSE and s.device == Device.HEAD:
        ageing.measure_walk(ctx, p, s)
    if usable and s.kind == SampleKind.POSE and s.device not in _INVISIBLE:
        _publish_presence(ctx, p, s)
    return None


def _stop_device(ctx: Context, p: Participant, device: str) -> bool:
    """End every engagement of a device that jumped. Return false when there was none: then nothing moves by it."""
    engaged = [
        (lease, g)
        for lease in ctx.list_leases(p)
        for g in lease.grants
        if g.participant == p.id and g.engagement and g.device == device
    ]
    for lease, g in engaged:
        engagement.end_engagement(ctx, lease, g, HoldReason.JUMP)
    return bool(engaged)


def _store_payload(p: Participant, s: Sample, usable: bool) -> None:
    seen = p.seen.get(s.device)
    if seen is None:
        seen = p.seen[s.device] = DeviceState()
    seen.seq, seen.buttons = s.seq, s.buttons
    # Capture times that go back must not make time for a jump when they come forward again.
    if usable and s.kind == SampleKind.POSE:
        seen.pose, seen.pose_ns = s.pose, max(seen.pose_ns, s.capture_ns)
    elif usable and s.kind == SampleKind.JOINTS:
        before = seen.joints.get(len(s.q))
        capture_ns = s.capture_ns if before is None else max(before.capture_ns, s.capture_ns)
        seen.joints[len(s.q)] = JointReading(capture_ns, tuple(map(float, s.q)))


def _update_latch(ctx: Context, p: Participant, lease: LeaseState, g: LeaseGrant, s: Sample) -> None:
    """Update the clutch latch of a grant, and end an engagement that the sample itself ends.

    A human who opens the clutch gives the robot back to the agent: at once when that ends its engagement, else (the
    clutch must open after an e-stop or a disconnect before it can engage) after `intervention_idle_ns`.
    """
    mine = g.engagement != 0 and g.device == s.device
    if not (s.worn and s.tracked):
        if s.device in g.armed:
            g.armed.remove(s.device)
        if g.device == s.device:
            g.open_ns = 0
        if mine or not g.engagement:
            engagement.end_engagement(ctx, lease, g, HoldReason.UNTRACKED if s.worn else HoldReason.NOT_WORN)
    elif not s.clutch:
        if s.device not in g.armed:
            g.armed.append(s.device)
        if mine or not g.engagement:
            engagement.end_engagement(ctx, lease, g, HoldReason.CLUTCH_OPEN)
        if g.device == s.device:
            engagement.note_open_clutch(ctx, g)
        if mine and lease.override == p.id:
            engagement.end_intervention(ctx, lease)
    elif not g.engagement and s.device in g.armed and _may_engage(ctx, p, lease):
        engagement.begin_engagement(ctx, lease, g, p, s.device)
    elif not mine:
        # A closed clutch without an edge: it must open first.
        if s.device in g.armed:
            g.armed.remove(s.device)
        if g.device == s.device:
            g.open_ns = 0
        if not g.engagement and g.hold in _WAITING:
            g.hold = HoldReason.REARM


def _may_engage(ctx: Context, p: Participant, lease: LeaseState) -> bool:
    # In the step of a reset the world seen is the one before it: nothing may be latched against that.
    if ctx.state.estop or ctx.state.paused or ctx.reset or ctx.is_closing:
        return False
    return not lease.override or lease.override == p.id or p.role in HUMAN


def _set_source(ctx: Context, p: Participant, lease: LeaseState, g: LeaseGrant, entry: Entry, s: Sample) -> None:
    """Make the sample the newest source of an engaged grant, in the world by the alignment of the engagement."""
    T = g.T_world_tracking
    pose: Pose | None = None
    twist: tuple[float, float, float, float, float, float] | None = None
    q: tuple[float, ...] = ()
    qd: tuple[float, ...] = ()
    if s.kind == SampleKind.POSE and s.pose is not None:
        pose = Pose(*compose((T.p, T.q), (s.pose.p, s.pose.q)))
        g.kind = CommandKind.POSE
    elif s.kind == SampleKind.TWIST and s.twist is not None:
        v = quat_rotate(T.q, s.twist[:3])
        w = quat_rotate(T.q, s.twist[3:])
        twist = (*v, *w)
        g.kind = CommandKind.TWIST
    else:
        q, qd = p.seen[s.device].joints[len(s.q)].q, tuple(map(float, s.qd))
        g.kind = CommandKind.JOINTS
    g.source = CommandSource(
        p.id,
        s.device,
        g.engagement,
        s.seq,
        s.capture_ns,
        entry.receive_ns,
        1.0,
        True,
        pose,
        twist,
        q,
        qd,
        s.device == Device.TARGET,
    )
    g.counted_ns, g.counted_step = ctx.now_ns, ctx.state.step
    if s.gripper is not None:
        g.gripper = min(1.0, max(0.0, float(s.gripper)))
        if ctx.config.explains and abs(s.gripper - g.gripper) > GRIPPER_SLACK:
            _report_clipped_gripper(ctx, p, lease, s.gripper, g.gripper)


def _report_clipped_gripper(ctx: Context, p: Participant, lease: LeaseState, asked: float, used: float) -> None:
    """Report a gripper value that is out of range: at once, then once a minute with the number of samples."""
    w = p.warnings.setdefault("gripper", WarningState(said_ns=ctx.now_ns - GRIPPER_REPORT_NS))
    w.left_out += 1
    if ctx.now_ns - w.said_ns >= GRIPPER_REPORT_NS:
        n = "" if w.left_out == 1 else f" ({w.left_out} samples)"
        text = f"gripper {asked:g} for {lease.target} is not between 0 (open) and 1 (closed): {used:g} is used{n}"
        ctx.emit(Notice("warning", f"{p.name}: {text}", p.id))
        w.said_ns, w.left_out = ctx.now_ns, 0


def _publish_presence(ctx: Context, p: Participant, s: Sample) -> None:
    """Publish the pose of an aligned participant's device, newest of this step, by the alignment in force."""
    if p.alignment is None or s.pose is None:
        return
    T = p.alignment.T_world_tracking
    pose = Pose(*compose((T.p, T.q), (s.pose.p, s.pose.q)))
    ctx.presence[(p.id, s.device)] = PresenceItem(p.id, s.device, pose, s.capture_ns)


def expire_samples(ctx: Context) -> None:
    """End every engagement without a counted sample within the freshness bound, by session time, and every intervention
    whose human stands by.
    """
    oldest = ctx.now_ns - ctx.config.freshness_ns
    for lease in (*ctx.state.robots.values(), *ctx.held_objects):
        for g in lease.grants:
            if g.engagement and g.counted_ns < oldest:
                engagement.rearm_grant(ctx, lease, g, HoldReason.STALE)
            stopped = ctx.state.paused or ctx.state.estop  # a human who thinks meanwhile keeps the robot
            if g.participant == lease.override and not stopped and engagement.is_standing_by(ctx, g):
                engagement.end_intervention(ctx, lease)


class CommandBuilder:
    """Builder of a step's commands; unchanged ones are the same objects as in the step before (a cache, no state)."""

    def __init__(self) -> None:
        self._holds: dict[tuple[str, str], Command] = {}
        self._last: dict[str, Command] = {}

    def build_commands(self, ctx: Context) -> tuple[Command, ...]:
        """Return exactly one command per robot, in the order of the specification."""
        return tuple([self._build_command(ctx, lease) for lease in ctx.state.robots.values()])

    def _build_command(self, ctx: Context, lease: LeaseState) -> Command:
        grants = lease.grants
        goes_home = ctx.robots[lease.target].on_release == ON_RELEASE_HOME and not ctx.config.user_owned_loop
        if goes_home and not lease.home:
            lease.home = tuple(ctx.view.joints(lease.target))
        if not grants and lease.freed_ns and (command := _build_home_command(ctx, lease)) is not None:
            return command
        if not grants:
            return self._get_hold_command(lease.target, _choose_hold(ctx, HoldReason.NO_LEASE))
        if lease.mode == LeaseMode.SHARED and len(grants) > 1:
            return self._blend_sources(ctx, lease)
        g = grants[0]
        if lease.override:
            g = next(other for other in grants if other.participant == lease.override)
        if not g.engagement or g.source is None:
            return self._get_hold_command(lease.target, _choose_hold(ctx, g.hold))
        source = _age_source(ctx, g)
        last = self._last.get(lease.target)
        if last is not None and last.sources[0] is source and last.scale == g.scale and len(last.sources) == 1:
            return last
        command = Command(lease.target, g.kind, "", (source,), g.gripper, g.scale)
        self._last[lease.target] = command
        return command

    def _get_hold_command(self, robot: str, reason: str) -> Command:
        command = self._holds.get((robot, reason))
        if command is None:
            command = self._holds[(robot, reason)] = Command(robot, CommandKind.HOLD, reason)
        return command

    def _blend_sources(self, ctx: Context, lease: LeaseState) -> Command:
        """Blend all engaged sharers, whose samples are of one kind (`samples` ensures it), with weights
        summing to 1.
        """
        engaged = [g for g in lease.grants if g.engagement and g.source is not None]
        if not engaged:
            return self._get_hold_command(lease.target, _choose_hold(ctx, lease.grants[0].hold))
        total = sum(g.weight for g in engaged)
        sources = tuple(msgspec.structs.replace(_age_source(ctx, g), weight=g.weight / total) for g in engaged)
        gripping = [(g.weight, g.gripper) for g in engaged if g.gripper is not None]
        gripper = sum(w * v for w, v in gripping) / sum(w for w, _ in gripping) if gripping else None
        return Command(lease.target, engaged[0].kind, "", sources, gripper, ctx.get_scale(lease))


def _choose_hold(ctx: Context, reason: str) -> str:
    """Return the reason of a hold: what stops every robot counts before its own `reason`."""
    return HoldReason.ESTOP if ctx.state.estop else HoldReason.EPISODE if ctx.is_closing else reason


def _build_home_command(ctx: Context, lease: LeaseState) -> Command | None:
    """Return the command that moves a released robot to where it stood at the beginning, as a leader's joints would;
    `None` before and after.
    """
    since_ns = ctx.now_ns - lease.freed_ns
    if since_ns < HOME_AFTER_NS or ctx.state.estop or ctx.state.paused or ctx.reset or ctx.is_closing:
        return None
    apart = max((abs(a - b) for a, b in zip(ctx.view.joints(lease.target), lease.home, strict=True)), default=0.0)
    if apart <= HOME_CLOSE or since_ns > HOME_WITHIN_NS:
        lease.freed_ns = 0
        return None
    is_new = not lease.homing
    if is_new:
        lease.homing = ctx.state.next_engagement
        ctx.state.next_engagement += 1
    at_ns = lease.freed_ns
    source = CommandSource(HOST_ID, Device.JOINTS, lease.homing, 0, at_ns, at_ns, new=is_new, q=lease.home)
    return Command(lease.target, CommandKind.JOINTS, "", (source,))


def _age_source(ctx: Context, g: LeaseGrant) -> CommandSource:
    """Return the grant's source, with `new` only in the step in which it was counted."""
    s = g.source
    assert s is not None
    if s.new and g.counted_step != ctx.state.step:
        s = g.source = msgspec.structs.replace(s, new=False)
    return s


# --- held objects ---


def _is_finite_pose(T: Pose) -> bool:
    """Return false for the pose of an object in physics that diverged: no hand can hold that."""
    n = math.sqrt(sum(c * c for c in T.q))
    return all(abs(c) < _FARTHEST for c in T.p) and 0.5 < n < 2.0


def build_object_commands(ctx: Context) -> tuple[ObjectCommand, ...]:
    """Return one command per object that an engaged hand holds, in the order of the specification."""
    commands = [_build_object_command(ctx, lease) for lease in ctx.held_objects]
    return tuple(command for command in commands if command is not None)


def _build_object_command(ctx: Context, lease: LeaseState) -> ObjectCommand | None:
    hands = [g for g in lease.grants if g.engagement]
    if not hands:
        lease.lead = 0
        return None
    leader = min(hands, key=lambda g: g.engagement)
    source = leader.source
    assert source is not None
    assert source.pose_world is not None
    T_world_hand = (source.pose_world.p, source.pose_world.q)
    if lease.lead != leader.engagement:
        T_now = lease.T_world_object if lease.lead else ctx.view.object_pose(lease.target)
        if not _is_finite_pose(T_now):
            for g in hands:
                engagement.rearm_grant(ctx, lease, g, HoldReason.REARM)
            lease.lead = 0
            return None
        lease.T_hand_object = Pose(*compose(inverse(T_world_hand), (T_now.p, T_now.q)))
        lease.lead = leader.engagement
    offset = lease.T_hand_object
    lease.T_world_object = Pose(*compose(T_world_hand, (offset.p, offset.q)))
    return ObjectCommand(lease.target, lease.lead, lease.T_world_object)


# --- feedback to holders ---


def send_feedback(ctx: Context, commands: Sequence[Command]) -> None:
    """Send feedback on change, at most once per `feedback_ns` and robot."""
    for command in commands:
        state = ctx.state.feedback.get(command.robot)
        if state is None:
            state = ctx.state.feedback[command.robot] = FeedbackState()
        if ctx.now_ns >= state.due_ns:
            state.due_ns = ctx.now_ns + ctx.config.feedback_ns
            _send_robot_feedback(ctx, command, state)


def _send_robot_feedback(ctx: Context, command: Command, state: FeedbackState) -> None:
    lease = ctx.state.robots[command.robot]
    holders = [g.participant for g in lease.grants]
    for participant in [name for name in state.sent if name not in holders]:
        del state.sent[participant]
    if not holders:
        return
    step = ctx.config.contact_step_n
    force = ctx.view.gripper_force(command.robot)
    contact_n = round(force / step) * step if math.isfinite(force) else 0.0  # not finite: physics that diverged
    limits: tuple[str, ...] = next((c.limits for c in ctx.control if c.robot == command.robot), ())
    for name in dict.fromkeys(holders):
        p = ctx.state.participants[name]
        kind, reason = command.kind, command.hold_reason
        if lease.override and name != lease.override:
            kind, reason = CommandKind.HOLD, HoldReason.INTERVENTION  # the human moves it, not this agent
        message = Feedback(command.robot, kind, reason, contact_n, limits, dict(p.rejected))
        if state.sent.get(name) != message:
            state.sent[name] = message
            ctx.send(p, message)
