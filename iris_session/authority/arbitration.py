"""From counted samples to exactly one command per robot and step."""

from __future__ import annotations

from anchors.pose import compose, quat_rotate
from iris_session.authority import engagement, roster, samples
from iris_session.authority.context import HUMAN, Context
from iris_session.authority.state import DeviceState, Grant, JointsSeen, LeaseState, Participant
from iris_session.protocol.client_messages import Sample
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import Entry
from iris_session.protocol.names import CommandKind, Device, HoldReason, LeaseMode, RejectReason, SampleKind
from iris_session.protocol.server_messages import PresenceItem
from iris_session.protocol.steps import Command, CommandSource

#: Hold reasons after which a closed clutch alone shows the wearer what is missing: let go and take hold again.
_WAITING = (HoldReason.NO_SAMPLE, HoldReason.CLUTCH_OPEN)
_INVISIBLE = (Device.JOINTS, Device.TARGET)


def sample(ctx: Context, entry: Entry, s: Sample) -> None:
    """One sample of the reconcile phase: counted, or rejected with its reason."""
    p = ctx.by_connection.get(entry.connection)
    if p is None:
        return samples.count(ctx, None, s.device, RejectReason.CONNECTION_EPOCH)
    drives: list[samples.Drive] = []
    reason = samples.check(ctx, p, entry, s, drives)
    if reason:
        return samples.reject(ctx, p, s, reason)
    usable = s.tracked and s.worn
    _remember(p, s, usable)
    if s.worn != p.worn:
        roster.set_worn(ctx, p, s.worn)
    for lease, g in drives:
        _latch(ctx, p, lease, g, s)
        if g.engagement and g.device == s.device:
            _follow(ctx, p, lease, g, entry, s)
    if usable and s.kind == SampleKind.POSE and s.device not in _INVISIBLE:
        _show(ctx, p, s)
    return None


def _remember(p: Participant, s: Sample, usable: bool) -> None:
    seen = p.seen.get(s.device)
    if seen is None:
        seen = p.seen[s.device] = DeviceState()
    seen.seq = s.seq
    # Capture times that go back must not make time for a jump when they come forward again.
    if usable and s.kind == SampleKind.POSE:
        seen.pose, seen.pose_ns = s.pose, max(seen.pose_ns, s.capture_ns)
    elif usable and s.kind == SampleKind.JOINTS:
        before = seen.joints.get(len(s.q))
        capture_ns = s.capture_ns if before is None else max(before.capture_ns, s.capture_ns)
        seen.joints[len(s.q)] = JointsSeen(capture_ns, tuple(map(float, s.q)))


def _latch(ctx: Context, p: Participant, lease: LeaseState, g: Grant, s: Sample) -> None:
    """Clutch edges, and what ends an engagement by the sample's own word."""
    mine = g.engagement != 0 and g.device == s.device
    if not (s.worn and s.tracked):
        if s.device in g.armed:
            g.armed.remove(s.device)
        if mine or not g.engagement:
            engagement.end(ctx, lease, g, HoldReason.UNTRACKED if s.worn else HoldReason.NOT_WORN)
    elif not s.clutch:
        if s.device not in g.armed:
            g.armed.append(s.device)
        if mine or not g.engagement:
            engagement.end(ctx, lease, g, HoldReason.CLUTCH_OPEN)
    elif not g.engagement and s.device in g.armed and _may_engage(ctx, p, lease):
        engagement.begin(ctx, lease, g, p, s.device)
    elif not mine:
        # A closed clutch without an edge: it must open first.
        if s.device in g.armed:
            g.armed.remove(s.device)
        if not g.engagement and g.hold in _WAITING:
            g.hold = HoldReason.REARM
    if not s.clutch and lease.override == p.id and g.device == s.device:
        engagement.give_back(ctx, lease)


def _may_engage(ctx: Context, p: Participant, lease: LeaseState) -> bool:
    # In the step of a reset the world seen is the one before it: nothing may be latched against that.
    if ctx.state.estop or ctx.state.paused or ctx.reset:
        return False
    return not lease.override or lease.override == p.id or p.role in HUMAN


def _follow(ctx: Context, p: Participant, lease: LeaseState, g: Grant, entry: Entry, s: Sample) -> None:
    """Makes the sample the newest source of an engaged grant, in the world by the alignment of the engagement."""
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


def _show(ctx: Context, p: Participant, s: Sample) -> None:
    """Presence of an aligned participant's device, newest of this step. By the alignment in force."""
    if p.alignment is None or s.pose is None:
        return
    T = p.alignment.T_world_tracking
    pose = Pose(*compose((T.p, T.q), (s.pose.p, s.pose.q)))
    ctx.presence[(p.id, s.device)] = PresenceItem(p.id, s.device, pose, s.capture_ns)


def expire_samples(ctx: Context) -> None:
    """Ends every engagement without a counted sample within the freshness bound, by session time, and every
    intervention whose human has not been engaged for a while."""
    oldest = ctx.now_ns - ctx.config.freshness_ns
    for lease in (*ctx.state.robots.values(), *ctx.held_objects):
        for g in lease.grants:
            if g.engagement and g.counted_ns < oldest:
                engagement.rearm(ctx, lease, g, HoldReason.STALE)
            if g.participant == lease.override:
                if g.engagement or ctx.state.paused or ctx.state.estop:
                    lease.override_ns = ctx.now_ns
                elif ctx.now_ns - lease.override_ns >= ctx.config.intervention_idle_ns:
                    engagement.give_back(ctx, lease)


class Commands:
    """Builds the commands of a step; unchanged ones are the same objects as in the step before (a cache, no state)."""

    def __init__(self) -> None:
        self._holds: dict[tuple[str, str], Command] = {}
        self._last: dict[str, Command] = {}

    def build(self, ctx: Context) -> tuple[Command, ...]:
        """Exactly one command per robot, in the order of the specification."""
        return tuple([self._command(ctx, lease) for lease in ctx.state.robots.values()])

    def _command(self, ctx: Context, lease: LeaseState) -> Command:
        grants = lease.grants
        if not grants:
            return self._hold(lease.target, HoldReason.ESTOP if ctx.state.estop else HoldReason.NO_LEASE)
        if lease.mode == LeaseMode.SHARED and len(grants) > 1:
            return self._blend(ctx, lease)
        g = grants[0]
        if lease.override:
            g = next(other for other in grants if other.participant == lease.override)
        if not g.engagement or g.source is None:
            return self._hold(lease.target, HoldReason.ESTOP if ctx.state.estop else g.hold)
        source = _aged(ctx, g)
        last = self._last.get(lease.target)
        if last is not None and last.sources[0] is source and last.scale == g.scale and len(last.sources) == 1:
            return last
        command = Command(lease.target, g.kind, "", (source,), g.gripper, g.scale)
        self._last[lease.target] = command
        return command

    def _hold(self, robot: str, reason: str) -> Command:
        command = self._holds.get((robot, reason))
        if command is None:
            command = self._holds[(robot, reason)] = Command(robot, CommandKind.HOLD, reason)
        return command

    def _blend(self, ctx: Context, lease: LeaseState) -> Command:
        """All engaged sharers, who send samples of one kind (`samples` sees to that), weights summing to 1."""
        engaged = [g for g in lease.grants if g.engagement and g.source is not None]
        if not engaged:
            return self._hold(lease.target, HoldReason.ESTOP if ctx.state.estop else lease.grants[0].hold)
        total = sum(g.weight for g in engaged)
        sources = tuple(_weighted(_aged(ctx, g), g.weight / total) for g in engaged)
        gripping = [(g.weight, g.gripper) for g in engaged if g.gripper is not None]
        gripper = sum(w * v for w, v in gripping) / sum(w for w, _ in gripping) if gripping else None
        return Command(lease.target, engaged[0].kind, "", sources, gripper, ctx.scale(lease))


def _aged(ctx: Context, g: Grant) -> CommandSource:
    """The grant's source, with `new` only in the step in which it was counted."""
    s = g.source
    assert s is not None
    if s.new and g.counted_step != ctx.state.step:
        s = g.source = _copy(s, s.weight, False)
    return s


def _weighted(s: CommandSource, weight: float) -> CommandSource:
    return _copy(s, weight, s.new)


def _copy(s: CommandSource, weight: float, new: bool) -> CommandSource:
    return CommandSource(
        s.participant,
        s.device,
        s.engagement,
        s.seq,
        s.capture_ns,
        s.receive_ns,
        weight,
        new,
        s.pose_world,
        s.twist_world,
        s.q,
        s.qd,
        s.absolute,
    )
