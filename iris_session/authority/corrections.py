"""How an alignment comes into force: the first ones at once, later corrections so that nobody is startled.

Who has not used the alignment yet gets every better one at once. Afterwards small corrections slide in, larger ones are
announced and come in one go, and while a clutch is engaged nothing changes: what is seen moves no robot, and what moves
a robot (`Grant.T_world_tracking`) is frozen for the engagement anyway.
"""

from __future__ import annotations

import math

from anchors.correction import interpolate_about_pivot
from anchors.pose import (
    Vec3,
    apply,
    compose,
    distance,
    inverse,
    quat_angle,
    quat_conj,
    quat_mul,
    quat_normalize,
    quat_to_rotvec,
)
from iris_session.authority import stated_error, telling
from iris_session.authority.context import Context
from iris_session.authority.state import Correction, Participant, Placing
from iris_session.protocol.common import Alignment, Pose
from iris_session.protocol.entries import AlignmentProposal
from iris_session.protocol.names import AlignmentKind
from iris_session.protocol.server_messages import AlignmentChanged


def engaged(ctx: Context, p: Participant) -> bool:
    """Whether `p` moves anything now."""
    leases = (*ctx.state.robots.values(), *ctx.held_objects)
    return any(g.engagement and g.participant == p.id for lease in leases for g in lease.grants)


def in_use(ctx: Context, p: Participant) -> bool:
    """Whether somebody would be startled: it has engaged, or has been aligned for a while, in this run and frame."""
    return p.in_use or (p.aligned_ns is not None and ctx.now_ns - p.aligned_ns >= ctx.config.settle_ns)


def offer(ctx: Context, p: Participant, m: AlignmentProposal) -> None:
    """A measurement that passed the gate: in force at once, or the goal of a correction."""
    covariance = tuple(map(float, m.covariance))
    x, y, z = m.pivot_world
    pivot_world = (float(x), float(y), float(z))
    goal = Correction(
        clean(m.T_world_tracking),
        covariance,
        pivot_world,
        float(m.error_at_anchor_m),
        ctx.now_ns + ctx.config.slide_ns,
    )
    if p.alignment is None or not (in_use(ctx, p) or engaged(ctx, p)):
        return _arrive(ctx, p, goal)
    if p.correction is not None:
        before = p.correction
        goal.slides_ns, goal.T_told = before.slides_ns, before.T_told
    p.correction = goal
    return None


def place(ctx: Context, p: Participant, word: Placing) -> None:
    """A director's word: in force at once, or when the clutch of its wearer opens."""
    if engaged(ctx, p):
        p.placing = word
        return telling.inform(ctx, p, f"a director has placed {p.name}: it comes into force when you let go")
    p.placing = None
    if word.offset and p.T_world_tracking_measured is not None:
        p.offset = word.T_world_tracking
        T = combined(p.offset, p.T_world_tracking_measured)
        return _put(ctx, p, AlignmentKind.MEASURED, T, offset=True)
    p.offset = p.T_world_tracking_measured = p.correction = None
    p.placed = True
    _put(ctx, p, AlignmentKind.PLACED, word.T_world_tracking)
    return _answer(ctx, p)


def void(p: Participant) -> None:
    """The tracking frame is another one: everything about the alignment in the old one is forgotten."""
    p.alignment = p.offset = p.T_world_tracking_measured = p.correction = p.placing = p.alarm = None
    p.placed = p.in_use = False
    p.aligned_ns = None


def advance(ctx: Context) -> None:
    """Once per step, after the samples: what has waited and may come now."""
    for p in ctx.state.participants.values():
        if p.correction is None and p.placing is None:
            continue
        if engaged(ctx, p):
            _wait(ctx, p)
            continue
        if p.placing is not None:
            place(ctx, p, p.placing)
        if p.correction is not None:
            _approach(ctx, p, p.correction)


def pending(p: Participant) -> tuple[float, float]:
    """How far what is to come is away from what is in force, at the anchor: [m] and [rad]."""
    if p.alignment is None:
        return 0.0, 0.0
    if p.placing is not None and not p.placing.offset:
        return _apart(p.alignment.T_world_tracking, p.placing.T_world_tracking, p.pivot_world)
    return (0.0, 0.0) if p.correction is None else _away(p, p.correction)


def clean(T: Pose) -> Pose:
    """Floats (a host may pass whole numbers, which would not replay byte for byte) and an exact unit quaternion."""
    x, y, z = T.p
    return Pose((float(x), float(y), float(z)), quat_normalize(T.q))


def combined(a: Pose, b: Pose) -> Pose:
    return Pose(*compose((a.p, a.q), (b.p, b.q)))


def _measured(p: Participant) -> Pose:
    """What is in force, without the director's offset."""
    assert p.alignment is not None
    return p.T_world_tracking_measured or p.alignment.T_world_tracking


def _away(p: Participant, c: Correction) -> tuple[float, float]:
    return _apart(_measured(p), c.T_world_tracking, c.pivot_world)


def _apart(old: Pose, new: Pose, pivot_world: Vec3) -> tuple[float, float]:
    """How far the point that `new` puts at `pivot_world` lies elsewhere by `old` [m], and their angle [rad]."""
    p_tracking = apply(inverse((new.p, new.q)), pivot_world)
    return distance(apply((old.p, old.q), p_tracking), pivot_world), quat_angle(old.q, new.q)


def _is_large(ctx: Context, away_m: float, turn_rad: float) -> bool:
    return away_m > ctx.config.announce_m or turn_rad > ctx.config.announce_rad


def _wait(ctx: Context, p: Participant) -> None:
    """A clutch is engaged: the wearer is told once what will come, unless it will slide in unseen."""
    c = p.correction
    if c is not None and c.T_told is None and _is_large(ctx, *_away(p, c)) and _may_tell(ctx, p):
        _tell(ctx, p, c, "the correction waits until you let go")


def _may_tell(ctx: Context, p: Participant) -> bool:
    """Wild measurements must not fill the wearer's view. It is also how long ago the last one was announced."""
    return p.told_ns is None or ctx.now_ns - p.told_ns >= ctx.config.announce_ns


def _tell(ctx: Context, p: Participant, c: Correction, what: str) -> None:
    away_m, turn_rad = _away(p, c)
    c.T_told, p.told_ns = c.T_world_tracking, ctx.now_ns
    far = f"{away_m * 1e3:.0f} mm" if away_m >= 0.001 else ""
    turned = f"{math.degrees(turn_rad):.1f} degrees" if turn_rad >= 0.001 else ""
    telling.inform(ctx, p, f"the alignment of {p.name} is off by {' and '.join(filter(None, (far, turned)))}: {what}")


def _approach(ctx: Context, p: Participant, c: Correction) -> None:
    away_m, turn_rad = _away(p, c)
    if not in_use(ctx, p):
        _arrive(ctx, p, c)
    elif not _is_large(ctx, away_m, turn_rad):
        if ctx.now_ns >= c.slides_ns:
            _slide(ctx, p, c, away_m, turn_rad)
    elif _may_tell(ctx, p):
        # What was told and what it has become meanwhile may be two things.
        if c.T_told is None or _is_large(ctx, *_apart(c.T_told, c.T_world_tracking, c.pivot_world)):
            _tell(ctx, p, c, f"the scene moves by that in {ctx.config.announce_ns * 1e-9:g} s")
        else:
            _arrive(ctx, p, c)


def _slide(ctx: Context, p: Participant, c: Correction, away_m: float, turn_rad: float) -> None:
    """One part of a small correction; after a pause it goes on sliding, it does not leap."""
    seconds = ctx.config.slide_ns * 1e-9
    parts = max(away_m / (ctx.config.slide_m_per_s * seconds), turn_rad / (ctx.config.slide_rad_per_s * seconds))
    if parts <= 1.0 + 1e-6:  # what rounding leaves is no part of its own
        return _arrive(ctx, p, c)
    old, new = _measured(p), c.T_world_tracking
    p_tracking = apply(inverse((new.p, new.q)), c.pivot_world)
    T = Pose(*interpolate_about_pivot((old.p, old.q), (new.p, new.q), p_tracking, 1.0 / parts))
    at = apply((T.p, T.q), p_tracking)
    left = [c.pivot_world[i] - at[i] for i in range(3)] + list(quat_to_rotvec(quat_mul(new.q, quat_conj(T.q))))
    c.slides_ns = ctx.now_ns + ctx.config.slide_ns
    error_at_anchor_m = c.error_at_anchor_m + distance(at, c.pivot_world)
    return _use(ctx, p, T, c.pivot_world, stated_error.widened(c.covariance, tuple(left)), error_at_anchor_m)


def _arrive(ctx: Context, p: Participant, c: Correction) -> None:
    """All of it."""
    p.correction = None
    _use(ctx, p, c.T_world_tracking, c.pivot_world, c.covariance, c.error_at_anchor_m)
    _answer(ctx, p)


def _use(
    ctx: Context,
    p: Participant,
    T: Pose,
    pivot_world: Vec3,
    covariance: tuple[float, ...],
    error_at_anchor_m: float,
) -> None:
    """A measured alignment comes into force; a director's offset on top of it voids the stated error."""
    p.T_world_tracking_measured, p.pivot_world = T, pivot_world
    if p.offset is not None:
        return _put(ctx, p, AlignmentKind.MEASURED, combined(p.offset, T), offset=True)
    error_at_robot_m = stated_error.at_robots(ctx, p, covariance, pivot_world, error_at_anchor_m)
    return _put(ctx, p, AlignmentKind.MEASURED, T, covariance, error_at_anchor_m, error_at_robot_m)


def _put(
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
    if p.aligned_ns is None:
        p.aligned_ns = ctx.now_ns
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
    telling.warn(ctx, p, "unaligned", "", same="")
    ctx.emit(AlignmentChanged(p.id, p.alignment))


def _answer(ctx: Context, p: Participant) -> None:
    """A new alignment answers what was wrong with the one before; but not that somebody moved a sheet."""
    if p.alarm is not None and not p.alarm.beside:
        p.alarm = None
        telling.warn(ctx, p, "alarm", "", same="")
