"""Checks of samples: every one of docs/protocol.md section 6 with its typed reason, and the effects of a rejection.

A rejection rearms only the latches of the sending participant's own device on the targets it names and holds. An old
`seq` is only counted. NaN and infinity may arrive in any float: they are compared so that they fail.
"""

from __future__ import annotations

import math

from anchors.pose import distance, quat_angle
from iris_session.authority import ageing, alignment, engagement
from iris_session.authority.context import Context, find_grant
from iris_session.authority.state import DeviceState, JointReading, LeaseGrant, LeaseState, Participant, Rejections
from iris_session.authority.tracking import STEADY, Track, follow_pose, is_repeat, is_zero_pose
from iris_session.protocol.client_messages import Sample
from iris_session.protocol.entries import Entry
from iris_session.protocol.names import (
    AlignmentKind,
    DenialReason,
    Device,
    HoldReason,
    LeaseMode,
    RejectReason,
    Role,
    SampleKind,
    TargetKind,
)
from iris_session.protocol.server_messages import SamplesRejected

Drive = tuple[LeaseState, LeaseGrant]
UNSEEN = DeviceState()
#: Reasons of a hold that are said also to one whose clutch is open: nothing moves before they are mended.
_HOLDS = {
    RejectReason.UNALIGNED: HoldReason.UNALIGNED,
    RejectReason.VIEW_ONLY: HoldReason.VIEW_ONLY,
    RejectReason.EMULATED: HoldReason.EMULATED,
    RejectReason.UNCONFIRMED: HoldReason.UNCONFIRMED,
    RejectReason.ZERO_POSE: HoldReason.ZERO_POSE,
}
#: Reasons of a hold of their own, said to one who drives or means to.
_STOPS = {RejectReason.FROZEN: HoldReason.FROZEN, RejectReason.JUMP: HoldReason.JUMP}


def check_sample(ctx: Context, p: Participant, entry: Entry, s: Sample, drives: list[Drive]) -> str:
    """Return the `RejectReason` of a sample, or empty when it counts; then `drives` holds its targets' leases and
    grants.
    """
    if entry.connection_epoch != entry.connection:
        return RejectReason.CONNECTION_EPOCH
    if s.device not in Device.ALL or s.kind not in SampleKind.ALL:
        return RejectReason.UNKNOWN_VALUE
    if (p.devices and s.device not in p.devices) or (s.kind == SampleKind.JOINTS) != (s.device == Device.JOINTS):
        return RejectReason.DEVICE
    seen = p.seen.get(s.device, UNSEEN)
    if s.seq <= seen.seq:
        return RejectReason.SEQ
    if s.scene_epoch != ctx.state.scene_epoch:
        return RejectReason.SCENE_EPOCH
    if s.tracking_epoch != p.tracking_epoch:
        return RejectReason.TRACKING_EPOCH
    reason = _check_time(ctx, entry, s)
    if not reason and s.targets:
        reason = _check_targets(ctx, p, s, drives)
    if not reason:
        reason = _check_alignment(ctx, p, s, drives)
    if not reason:
        reason = _check_numbers(ctx, s)
    if not reason and s.tracked and s.worn:
        reason = _check_payload(ctx, p, s, seen) or (_check_measured(ctx, p, s, seen) if drives else "")
        if not reason and s.clutch:
            reason = _check_engagement(ctx, p, s, drives)
    return reason


def _check_time(ctx: Context, entry: Entry, s: Sample) -> str:
    """Reject stale samples and those from the future, by the capture time and by the time of receipt."""
    oldest = ctx.now_ns - ctx.config.freshness_ns
    if s.capture_ns < oldest or entry.receive_ns < oldest:
        return RejectReason.STALE
    if s.capture_ns - min(ctx.now_ns, entry.receive_ns) > ctx.config.future_ns:
        return RejectReason.FUTURE
    return RejectReason.FUTURE if entry.receive_ns - ctx.now_ns > ctx.config.future_ns else ""


def _check_targets(ctx: Context, p: Participant, s: Sample, drives: list[Drive]) -> str:
    if p.role not in Role.DRIVING:
        return RejectReason.ROLE
    for t in s.targets:
        if t.kind not in (TargetKind.ROBOT, TargetKind.OBJECT):
            return RejectReason.UNKNOWN_VALUE
        lease = ctx.find_lease(t.kind, t.name)
        if lease is None:
            return RejectReason.UNKNOWN_TARGET
        g = find_grant(lease, p.id, s.device)
        if g is None:
            return RejectReason.NOT_HOLDER
        if not g.version <= t.lease_version <= lease.version:
            return RejectReason.LEASE_VERSION
        drives.append((lease, g))
    return ""


def _check_alignment(ctx: Context, p: Participant, s: Sample, drives: list[Drive]) -> str:
    """Reject poses and twists in another alignment than the one in force, or the one frozen at this engagement, and
    those that would drive without one and may not.
    """
    if s.kind == SampleKind.JOINTS:
        return ""
    if not p.needs_alignment:
        allowed = not drives or alignment.may_be_unaligned(ctx, p.role, p.key_id, s.device)
        return "" if allowed else RejectReason.UNALIGNED
    if p.alignment is None:
        return RejectReason.UNALIGNED if drives else ""
    if drives and p.alignment.kind in AlignmentKind.VIEW_ONLY:
        return RejectReason.VIEW_ONLY
    if s.alignment_version == p.alignment.version:
        return ""
    frozen = drives and all(
        g.engagement and g.device == s.device and g.alignment_version == s.alignment_version for _, g in drives
    )
    return "" if frozen else RejectReason.ALIGNMENT_VERSION


def _check_numbers(ctx: Context, s: Sample) -> str:
    """Reject numbers that are not finite or out of reach, whether or not this sample's payload will be used."""
    total = sum(s.q) + sum(s.qd) + sum(s.hand_joints)
    if s.gripper is not None:
        total += s.gripper
    if s.pose is not None:
        reach = ctx.config.reach_m
        x, y, z = s.pose.p
        if not (-reach <= x <= reach and -reach <= y <= reach and -reach <= z <= reach):
            return RejectReason.NOT_FINITE
        total += sum(s.pose.q)
    if s.twist is not None:
        total += sum(s.twist)
    return "" if math.isfinite(total) else RejectReason.NOT_FINITE


def is_measuring(ctx: Context, p: Participant, device: str) -> bool:
    """Return true for a device whose poses are measured: no two are the same, and they never jump. Agents compute
    theirs, unless they wear a headset.
    """
    computes = p.role == Role.AGENT and not p.needs_alignment
    return ctx.config.speed_limits[device].linear_acceleration > 0.0 and not computes


def is_measured(ctx: Context, p: Participant, s: Sample) -> bool:
    """Return false for a sample that says, or shows, that no measurement is behind it."""
    if not (s.tracked and s.worn) or s.emulated:
        return False
    return s.kind != SampleKind.POSE or s.pose is None or not (is_measuring(ctx, p, s.device) and is_zero_pose(s.pose))


def follow_device(ctx: Context, p: Participant, s: Sample) -> str:
    """Take the pose of a measured sample into the track of its device; returns as `tracking.follow_pose`."""
    if s.kind != SampleKind.POSE or s.pose is None or not is_measuring(ctx, p, s.device):
        return STEADY
    seen = p.seen[s.device]
    if seen.track is None:
        seen.track = Track(s.pose, s.capture_ns, s.capture_ns)
        return STEADY
    return follow_pose(seen.track, ctx.config.speed_limits[s.device], s.pose, s.capture_ns)


def _check_measured(ctx: Context, p: Participant, s: Sample, seen: DeviceState) -> str:
    """Reject a sample with targets whose pose is no measurement: it must not drive."""
    if s.emulated:
        return RejectReason.EMULATED
    if not is_measured(ctx, p, s):
        return RejectReason.ZERO_POSE
    if not s.clutch or s.pose is None or s.kind != SampleKind.POSE or not is_measuring(ctx, p, s.device):
        return ""
    limit_ns, track = ctx.config.frozen_ns, seen.track
    if track is not None and is_repeat(track, s.pose) and s.capture_ns - track.same_ns >= limit_ns:
        return RejectReason.FROZEN
    # A headset whose head stands still to the last bit does not know where its hands are either.
    head = p.seen.get(Device.HEAD, UNSEEN)
    if p.needs_alignment and head.track is not None and head.pose_ns - head.track.same_ns >= limit_ns:
        return RejectReason.FROZEN if s.capture_ns - head.pose_ns <= ctx.config.freshness_ns else ""
    return ""


def _check_payload(ctx: Context, p: Participant, s: Sample, seen: DeviceState) -> str:
    """Reject a wrong shape or an impossible speed of the payload that `kind` names."""
    limit = ctx.config.speed_limits[s.device]
    if s.kind == SampleKind.POSE:
        if s.pose is None:
            return RejectReason.SHAPE
        w, x, y, z = s.pose.q
        if not abs(math.sqrt(w * w + x * x + y * y + z * z) - 1.0) <= ctx.config.quaternion_tolerance:
            return RejectReason.NOT_UNIT
        if seen.pose is None or is_measuring(ctx, p, s.device):
            return ""
        dt = max(0, s.capture_ns - seen.pose_ns) * 1e-9
        possible = (
            distance(s.pose.p, seen.pose.p) <= limit.linear * dt + ctx.config.speed_slack_m
            and quat_angle(seen.pose.q, s.pose.q) <= limit.angular * dt + ctx.config.speed_slack_rad
        )
    elif s.kind == SampleKind.TWIST:
        if s.twist is None:
            return RejectReason.SHAPE
        vx, vy, vz, wx, wy, wz = s.twist
        possible = (
            vx * vx + vy * vy + vz * vz <= limit.linear * limit.linear
            and wx * wx + wy * wy + wz * wz <= limit.angular * limit.angular
        )
    else:
        if not s.q or (s.qd and len(s.qd) != len(s.q)):
            return RejectReason.SHAPE
        before = seen.joints.get(len(s.q), JointReading(0, s.q))
        bound = limit.angular * max(0, s.capture_ns - before.capture_ns) * 1e-9 + ctx.config.speed_slack_rad
        possible = max(map(abs, (*s.q, *s.qd))) <= ctx.config.reach_m and all(
            abs(a - b) <= bound for a, b in zip(s.q, before.q, strict=True)
        )
    return "" if possible else RejectReason.TOO_FAST


def _check_engagement(ctx: Context, p: Participant, s: Sample, drives: list[Drive]) -> str:
    """Reject samples that cannot drive their target, beyond the checks above."""
    for lease, g in drives:
        begins = not g.engagement and s.device in g.armed
        if begins and p.doubt and s.kind != SampleKind.JOINTS:
            return RejectReason.UNCONFIRMED
        if lease.kind == TargetKind.OBJECT:
            if s.kind != SampleKind.POSE:
                return RejectReason.SHAPE
            continue
        if s.kind == SampleKind.JOINTS and len(s.q) != len(ctx.robots[lease.target].joints):
            return RejectReason.SHAPE
        if (g.engagement or s.device in g.armed) and _is_kind_mismatch(lease, g, s):
            return RejectReason.KIND_MISMATCH
        if not begins:
            continue
        if p.role == Role.LEADER and s.kind == SampleKind.JOINTS and ctx.config.leader_apart == "refuse":
            apart = max(abs(a - b) for a, b in zip(s.q, ctx.view.joints(lease.target), strict=True))
            if not apart <= ctx.config.leader_apart_rad:  # NaN joints of a diverged robot are not near its leader
                return RejectReason.LEADER_APART
        if s.kind != SampleKind.JOINTS and p.needs_alignment:
            error = alignment.compute_error_at_robot(ctx, p, lease.target)
            if error > ctx.config.max_error_at_robot_m:
                alignment.refuse_large_error(ctx, p, lease.target, error)
                return RejectReason.UNALIGNED
            if ageing.is_too_old(ctx, p, lease.target):
                ageing.doubt_age(ctx, p)
                return RejectReason.UNCONFIRMED
    return ""


def _is_kind_mismatch(lease: LeaseState, g: LeaseGrant, s: Sample) -> bool:
    """Return true when another sharer drives the robot by another kind of sample: these cannot be blended (mode
    `shared`).
    """
    if lease.mode != LeaseMode.SHARED or (g.engagement and g.device != s.device):
        return False
    return any(other.engagement and other is not g and other.kind != s.kind for other in lease.grants)


def reject_sample(ctx: Context, p: Participant, s: Sample, reason: str) -> None:
    """Count a rejected sample and rearm what its sender's device drives of the targets it names."""
    count_rejection(ctx, p, s.device, reason)
    if reason == RejectReason.SEQ:
        return
    hold = _HOLDS.get(reason) or _STOPS.get(reason, HoldReason.REJECTED)
    if reason == RejectReason.UNALIGNED and p.alignment is None:
        advice = "look at an anchor sheet" if p.aligning else "start its alignment run"
        alignment.warn_wearer(ctx, p, "unaligned", f"{p.name} is not aligned and moves nothing: {advice}", same=advice)
    if reason == RejectReason.UNALIGNED and not p.needs_alignment:
        text = f"{p.name} may not drive with {s.device} without an alignment: {alignment.UNALIGNED_ADVICE}"
        alignment.warn_wearer(ctx, p, "unaligned", text, same=s.device)
    if reason == RejectReason.VIEW_ONLY:
        why, advice = alignment.advise_view_only(p)
        text = f"{p.name} can look, not drive: {why}; {advice}"
        alignment.warn_wearer(ctx, p, "unaligned", text, same=why, reason=DenialReason.VIEW_ONLY)
    for t in s.targets:
        lease = ctx.find_lease(t.kind, t.name)
        g = find_grant(lease, p.id, s.device) if lease is not None else None
        if lease is None or g is None:
            continue
        if s.device in g.armed:
            g.armed.remove(s.device)
        if not g.engagement:
            # The cause of an earlier stop (e-stop, reset) stays visible until the clutch opens, and another device that
            # is ready to engage stays ready.
            shown = reason in _HOLDS or g.hold in (HoldReason.NO_SAMPLE, HoldReason.CLUTCH_OPEN)
            if shown and not g.armed:
                g.hold = hold
        elif g.device == s.device:
            engagement.end_engagement(ctx, lease, g, hold)


def count_rejection(ctx: Context, p: Participant | None, device: str, reason: str, n: int = 1) -> None:
    """Count `n` rejections; emit an event at the first one of a kind, then at most one per report period."""
    device = device if device in Device.ALL else ""
    book = ctx.state.unattributed if p is None else p.rejections
    if p is not None:
        p.rejected[reason] = p.rejected.get(reason, 0) + n
    entry = book.setdefault(f"{device} {reason}", Rejections())
    entry.count += n
    if entry.reported_ns is None or ctx.now_ns - entry.reported_ns >= ctx.config.report_ns:
        entry.reported_ns = ctx.now_ns
        ctx.emit(SamplesRejected(p.id if p is not None else "", device, reason, entry.count))
