"""The alignment gate: proposals of the estimator, a director's word, and jumps of a tracking frame.

A proposal is accepted when its stated p95 error at the robot (lever arm included) is within the bound, and when it
differs enough from what is in force, or on its way, to be worth a version. How it then comes into force is decided in
`corrections`; runs, alarms and moved anchors are in `anchoring`.
"""

from __future__ import annotations

import math
from typing import Final

from anchors.pose import apply, distance, inverse, quat_angle, quat_normalize
from iris_session.authority import corrections, engagement, stated_error, telling
from iris_session.authority.context import Context
from iris_session.authority.state import Participant, Placing
from iris_session.protocol.client_messages import PlaceAlignment, TrackingEpoch
from iris_session.protocol.common import MAX_TEXT, Denial, Pose
from iris_session.protocol.entries import AlignmentProposal
from iris_session.protocol.names import AlignmentKind, DenialReason, HoldReason
from iris_session.protocol.server_messages import Notice

ADVICE: Final = "step closer to the sheet, look at it from a second place, or add a sheet near the robot"


def propose(ctx: Context, p: Participant, m: AlignmentProposal) -> None:
    """Gate for the estimator's result: accepted, ignored as no news, or refused with advice."""
    if not p.needs_alignment or not p.aligning or m.tracking_epoch < p.tracking_epoch:
        return None
    if ctx.entry_ns <= max(p.proposals_from_ns, ctx.state.anchors_ns):
        return None  # made before the front knew of a jump, a new run, or where the anchors are now
    if m.refused or not _valid(ctx, m):
        text = "the anchor measurement is not good enough" if m.refused else "the measurement is not a valid pose"
        return _refuse(ctx, p, text, m.advice or ADVICE)
    if m.tracking_epoch > p.tracking_epoch:
        # The frame's announcement can come after the first observation in it.
        tracking_epoch(ctx, p, TrackingEpoch(m.tracking_epoch))
    error = stated_error.at_robots(ctx, p, m.covariance, m.pivot_world, m.error_at_anchor_m)
    if error > ctx.config.max_error_at_robot_m:
        return refuse_at_robot(ctx, p, "the robot", error, m.advice)
    tilted = m.residual_tilt_rad > ctx.config.max_residual_tilt_rad
    degrees = math.degrees(m.residual_tilt_rad)
    tilt = f"{p.name}: the anchor is tilted by {degrees:.1f} degrees, is the sheet level?"
    telling.warn(ctx, p, "tilt", tilt if tilted else "", same="tilted")
    advice = f"alignment of {p.name}: {m.advice}" if m.advice and not tilted else ""
    telling.warn(ctx, p, "advice", advice, same=m.advice)
    if not p.placed and _is_news(ctx, p, m, error):
        corrections.offer(ctx, p, m)
    return None


def _valid(ctx: Context, m: AlignmentProposal) -> bool:
    if len(m.covariance) != 36 or not math.isfinite(sum(m.covariance) + sum(m.pivot_world) + m.residual_tilt_rad):
        return False
    variances = m.covariance[::7]
    return min(variances) >= 0.0 and 0.0 <= m.error_at_anchor_m < math.inf and is_pose(ctx, m.T_world_tracking)


def is_pose(ctx: Context, T: Pose) -> bool:
    """Whether numbers from elsewhere are a pose: finite, within reach, a unit quaternion."""
    n = math.sqrt(sum(c * c for c in T.q))
    return abs(n - 1.0) <= ctx.config.quaternion_tolerance and all(abs(c) <= ctx.config.reach_m for c in T.p)


def _is_news(ctx: Context, p: Participant, m: AlignmentProposal, error: float) -> bool:
    """Whether a measurement says something else, or says it better, than the one in force or on its way."""
    now, coming = p.alignment, p.correction
    if now is None or now.kind == AlignmentKind.PLACED or (p.alarm is not None and not p.alarm.beside):
        return True
    if coming is not None:
        old: Pose | None = coming.T_world_tracking
        known = stated_error.at_robots(ctx, p, coming.covariance, coming.pivot_world, coming.error_at_anchor_m)
    else:
        old, known = p.T_world_tracking_measured, now.error_at_robot_m
    if old is None or error < 0.8 * known:
        return True
    # Where the anchor's point lies, by the old and the new alignment.
    T_new = (m.T_world_tracking.p, quat_normalize(m.T_world_tracking.q))
    p_tracking = apply(inverse(T_new), m.pivot_world)
    moved = distance(apply((old.p, old.q), p_tracking), m.pivot_world)
    return moved > ctx.config.min_change_m or quat_angle(old.q, T_new[1]) > ctx.config.min_change_rad


def refuse_at_robot(ctx: Context, p: Participant, robot: str, error: float, advice: str = "") -> None:
    """Tells the wearer that the stated error at the robot is too large."""
    bound = ctx.config.max_error_at_robot_m
    text = f"predicted error {error * 1000:.0f} mm at {robot}, at most {bound * 1000:.0f} mm is allowed"
    _refuse(ctx, p, text, advice or ADVICE)


def _refuse(ctx: Context, p: Participant, text: str, advice: str) -> None:
    """Tells everyone why, the wearer among them, at most once per report period. The alignment in force stays."""
    if p.refused_ns is not None and ctx.now_ns - p.refused_ns < ctx.config.report_ns:
        return
    p.refused_ns = ctx.now_ns
    text = f"alignment of {p.name} refused: {text}; {advice}"[:MAX_TEXT]
    ctx.emit(Notice("warning", text, p.id, DenialReason.ALIGNMENT_REFUSED))


def place(ctx: Context, p: Participant, m: PlaceAlignment) -> None:
    """A director's word: the whole alignment, or an offset in the world on top of the measured one."""
    person = ctx.person(m.participant)
    if person is None:
        text = f"no participant {m.participant}"
        return ctx.deny(p, m.request_id, Denial(DenialReason.UNKNOWN_PARTICIPANT, text, "use an id of the roster"))
    if not person.needs_alignment or not is_pose(ctx, m.T_world_tracking):
        text = f"{person.name} needs no alignment, or the pose is not finite with a unit quaternion"
        return ctx.deny(p, m.request_id, Denial(DenialReason.INVALID, text))
    if m.offset and person.T_world_tracking_measured is None:
        text = f"{person.name} has no measured alignment to add an offset to"
        return ctx.deny(p, m.request_id, Denial(DenialReason.UNALIGNED, text, "place it without offset"))
    corrections.place(ctx, person, Placing(corrections.clean(m.T_world_tracking), m.offset))
    return ctx.accept(p, m.request_id)


def tracking_epoch(ctx: Context, p: Participant, m: TrackingEpoch) -> None:
    """The tracking frame jumped: alignment and engagements of this participant end."""
    if m.tracking_epoch <= p.tracking_epoch:
        return
    p.tracking_epoch = m.tracking_epoch
    new_frame(ctx, p)
    ctx.publish_participant(p)
    if p.needs_alignment and not p.aligning:
        telling.inform(ctx, p, f"{p.name} is not aligned, and its alignment run is stopped: start it")


def new_frame(ctx: Context, p: Participant) -> None:
    """What was seen and aligned in the old frame counts no more, and what it moved holds."""
    for device in p.seen.values():
        device.pose = None
    if p.needs_alignment:
        corrections.void(p)
    engagement.rearm_participant(ctx, p, HoldReason.REARM)
