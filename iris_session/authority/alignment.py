"""The alignment gate: proposals of the estimator, a director's word, and jumps of a tracking frame.

`T_world_tracking` of a participant changes only here. A proposal is accepted when its stated p95 error at the robot
(lever arm included) is within the bound, and when it differs enough from the alignment in force to be worth a version.
"""

from __future__ import annotations

import math
from typing import Final

from anchors.pose import apply, compose, distance, inverse, quat_angle, quat_normalize
from iris_session.authority import engagement
from iris_session.authority.context import Context
from iris_session.authority.state import Participant, Warned
from iris_session.protocol.client_messages import PlaceAlignment, TrackingEpoch
from iris_session.protocol.common import MAX_TEXT, Alignment, Denial, Pose, Vec3
from iris_session.protocol.entries import AlignmentProposal
from iris_session.protocol.names import AlignmentKind, DenialReason, HoldReason
from iris_session.protocol.server_messages import AlignmentChanged, Notice

ADVICE: Final = "step closer to the sheet, look at it from a second place, or add a sheet near the robot"
#: 95 % quantile of the standard normal distribution.
Z95: Final = 1.6448536269514722


def position_p95(covariance: tuple[float, ...], pivot: Vec3, point: Vec3) -> float:
    """95 % quantile [m] of the length of the position error at `point`, from a 6x6 covariance stated at `pivot`.

    The error at the point is dp + dtheta x r with r = point - pivot. Its squared length is a weighted sum of chi-square
    variables, approximated by one with the same mean and variance (Satterthwaite), its quantile by Wilson-Hilferty.
    """
    r = (point[0] - pivot[0], point[1] - pivot[1], point[2] - pivot[2])
    # Rows of [I | -[r]x]: how (dp, dtheta) moves the point.
    J = (
        (1.0, 0.0, 0.0, 0.0, r[2], -r[1]),
        (0.0, 1.0, 0.0, -r[2], 0.0, r[0]),
        (0.0, 0.0, 1.0, r[1], -r[0], 0.0),
    )
    CJ = [[sum(covariance[6 * i + k] * row[k] for k in range(6)) for i in range(6)] for row in J]
    C = [[sum(J[i][k] * CJ[j][k] for k in range(6)) for j in range(3)] for i in range(3)]
    mean = C[0][0] + C[1][1] + C[2][2]
    if not (0.0 < mean < math.inf):
        return 0.0 if mean == 0.0 else math.inf
    spread = sum(c * c for row in C for c in row)
    freedom = min(3.0, max(1.0, mean * mean / spread)) if math.isfinite(spread) and spread > 0.0 else 1.0
    a = 2.0 / (9.0 * freedom)
    return math.sqrt(mean * (1.0 - a + Z95 * math.sqrt(a)) ** 3)


def error_at(ctx: Context, p: Participant, robot: str) -> float:
    """Stated p95 position error [m] of `p` at the end effector of `robot`; 0 where none is stated (placed, offset)."""
    alignment = p.alignment
    if alignment is None or not alignment.covariance:
        return 0.0
    return position_p95(alignment.covariance, p.pivot_world, ctx.view.tip_pose(robot).p)


def _error_at_robots(ctx: Context, p: Participant, m: AlignmentProposal) -> float:
    """At the robots that `p` holds (the worst of them), else at the robot nearest to the anchor."""
    held = [g.target for g in ctx.state.robots.values() if any(h.participant == p.id for h in g.grants)]
    points = {name: ctx.view.tip_pose(name).p for name in held or ctx.robots}
    errors = [position_p95(m.covariance, m.pivot_world, point) for point in points.values()]
    return max(errors) if held else min(errors, default=m.error_at_anchor_m)


def propose(ctx: Context, p: Participant, m: AlignmentProposal) -> None:
    """Gate for the estimator's result: accepted, ignored as no news, or refused with advice."""
    if not p.needs_alignment or m.tracking_epoch < p.tracking_epoch:
        return None
    if m.refused or not _valid(ctx, m):
        text = "the anchor measurement is not good enough" if m.refused else "the measurement is not a valid pose"
        return _refuse(ctx, p, text, m.advice or ADVICE)
    if m.tracking_epoch > p.tracking_epoch:
        # The frame's announcement can come after the first observation in it.
        tracking_epoch(ctx, p, TrackingEpoch(m.tracking_epoch))
    error = _error_at_robots(ctx, p, m)
    if error > ctx.config.max_error_at_robot_m:
        return refuse_at_robot(ctx, p, "the robot", error, m.advice)
    tilted = m.residual_tilt_rad > ctx.config.max_residual_tilt_rad
    degrees = math.degrees(m.residual_tilt_rad)
    tilt = f"{p.name}: the anchor is tilted by {degrees:.1f} degrees, is the sheet level?"
    _warn(ctx, p, "tilt", tilt if tilted else "", same="tilted")
    _warn(ctx, p, "advice", f"alignment of {p.name}: {m.advice}" if m.advice and not tilted else "", same=m.advice)
    placed = p.alignment is not None and p.alignment.kind == AlignmentKind.PLACED
    if placed or not _is_news(ctx, p, m, error):
        return None
    T = _clean(m.T_world_tracking)
    p.T_world_tracking_measured, p.pivot_world = T, m.pivot_world
    if p.offset is not None:
        return _accept(ctx, p, AlignmentKind.MEASURED, _compose(p.offset, T), offset=True)
    return _accept(
        ctx, p, AlignmentKind.MEASURED, T, tuple(map(float, m.covariance)), float(m.error_at_anchor_m), error
    )


def _warn(ctx: Context, p: Participant, kind: str, text: str, *, same: str) -> None:
    """Tells the wearer, at most once per `warning_ns` and kind; what was left out meanwhile is counted in the next one.

    `text` empty: all is well now. `same`: what stays equal in warnings that need not be said again.
    """
    w = p.warnings.get(kind)
    if w is None:
        if not text:
            return
        w = p.warnings[kind] = Warned(said_ns=ctx.now_ns - ctx.config.warning_ns)
    now = same if text else ""
    changed, w.seen = now != w.seen, now
    if not now:
        w.said = ""
    elif now != w.said and ctx.now_ns - w.said_ns < ctx.config.warning_ns:
        w.left_out += changed
    elif now != w.said:
        more = f" ({w.left_out} more of these meanwhile)" if w.left_out else ""
        ctx.emit(Notice("warning", text[: MAX_TEXT - len(more)] + more, p.id))
        w.said, w.said_ns, w.left_out = now, ctx.now_ns, 0


def _valid(ctx: Context, m: AlignmentProposal) -> bool:
    if len(m.covariance) != 36 or not math.isfinite(sum(m.covariance) + sum(m.pivot_world) + m.residual_tilt_rad):
        return False
    variances = m.covariance[::7]
    return min(variances) >= 0.0 and 0.0 <= m.error_at_anchor_m < math.inf and _is_pose(ctx, m.T_world_tracking)


def _is_pose(ctx: Context, T: Pose) -> bool:
    n = math.sqrt(sum(c * c for c in T.q))
    return abs(n - 1.0) <= ctx.config.quaternion_tolerance and all(abs(c) <= ctx.config.reach_m for c in T.p)


def _is_news(ctx: Context, p: Participant, m: AlignmentProposal, error: float) -> bool:
    old, now = p.T_world_tracking_measured, p.alignment
    if old is None or now is None:
        return True
    if error < 0.8 * now.error_at_robot_m:
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


def _accept(
    ctx: Context,
    p: Participant,
    kind: str,
    T_world_tracking: Pose,
    covariance: tuple[float, ...] = (),
    error_at_anchor_m: float = 0.0,
    error_at_robot_m: float = 0.0,
    offset: bool = False,
) -> None:
    p.alignment_version += 1
    p.refused_ns = None
    p.alignment = Alignment(
        p.alignment_version,
        kind,
        T_world_tracking,
        p.tracking_epoch,
        covariance,
        error_at_anchor_m,
        error_at_robot_m,
        offset,
    )
    ctx.emit(AlignmentChanged(p.id, p.alignment))


def place(ctx: Context, p: Participant, m: PlaceAlignment) -> None:
    """A director's word: the whole alignment, or an offset in the world on top of the measured one."""
    person = ctx.person(m.participant)
    if person is None:
        text = f"no participant {m.participant}"
        return ctx.deny(p, m.request_id, Denial(DenialReason.UNKNOWN_PARTICIPANT, text, "use an id of the roster"))
    if not person.needs_alignment or not _is_pose(ctx, m.T_world_tracking):
        text = f"{person.name} needs no alignment, or the pose is not finite with a unit quaternion"
        return ctx.deny(p, m.request_id, Denial(DenialReason.INVALID, text))
    T = _clean(m.T_world_tracking)
    if not m.offset:
        person.offset = person.T_world_tracking_measured = None
        _accept(ctx, person, AlignmentKind.PLACED, T)
    elif person.T_world_tracking_measured is None:
        text = f"{person.name} has no measured alignment to add an offset to"
        return ctx.deny(p, m.request_id, Denial(DenialReason.UNALIGNED, text, "place it without offset"))
    else:
        person.offset = T
        _accept(ctx, person, AlignmentKind.MEASURED, _compose(T, person.T_world_tracking_measured), offset=True)
    return ctx.accept(p, m.request_id)


def tracking_epoch(ctx: Context, p: Participant, m: TrackingEpoch) -> None:
    """The tracking frame jumped: alignment and engagements of this participant end."""
    if m.tracking_epoch <= p.tracking_epoch:
        return
    p.tracking_epoch = m.tracking_epoch
    for device in p.seen.values():
        device.pose = None
    if p.needs_alignment:
        p.alignment = p.offset = p.T_world_tracking_measured = None
    engagement.rearm_participant(ctx, p, HoldReason.REARM)
    ctx.publish_participant(p)


def _compose(a: Pose, b: Pose) -> Pose:
    return Pose(*compose((a.p, a.q), (b.p, b.q)))


def _clean(T: Pose) -> Pose:
    """Floats (a host may pass whole numbers, which would not replay byte for byte) and an exact unit quaternion."""
    x, y, z = T.p
    return Pose((float(x), float(y), float(z)), quat_normalize(T.q))
