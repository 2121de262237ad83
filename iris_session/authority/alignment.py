"""Alignments: the gate for proposals, placements and tracking frames, corrections, stated errors, notices to the
wearer.

Who may drive: devices of a headset need an alignment. Others, and those that the configuration allows, do without when
they said so at `hello` (`may_be_unaligned`).

Gate: a proposal of the estimator is accepted when its stated p95 error at the robot (lever arm included) is within the
bound, and when it differs enough from the alignment in force, or from the correction under way, to be worth a version.

Corrections: the first measurements come into force at once, later ones so that the wearer is not startled. Before the
alignment is in use every better one applies at once. Afterwards small corrections slide in, larger ones are announced
and come in one go, and while a clutch is engaged nothing changes: the displayed scene moves no robot, and the pose that
moves a robot (`LeaseGrant.T_world_tracking`) is frozen for the engagement anyway.

An alignment by fingertips, or by an anchor that a device kept (`AlignmentKind.VIEW_ONLY`), may be less exact. It moves
nothing, and never replaces one that does.

Alignment runs, alarms and moved anchors are in `anchoring`.
"""

from __future__ import annotations

import math
from typing import Final

from anchors.ageing import grow_covariance
from anchors.pose import (
    apply,
    compose,
    distance,
    interpolate_about_pivot,
    inverse,
    quat_angle,
    quat_conj,
    quat_mul,
    quat_normalize,
    quat_to_rotvec,
)
from iris_session.authority import engagement
from iris_session.authority.config import KEY_PREFIX
from iris_session.authority.context import Context, build_absent_denial, join_names
from iris_session.authority.state import Correction, Participant, Placement, WarningState
from iris_session.protocol.client_messages import PlaceAlignment, TrackingEpoch
from iris_session.protocol.common import MAX_TEXT, Alignment, Denial, Pose, Vec3
from iris_session.protocol.entries import AlignmentProposal, AnchorLooks
from iris_session.protocol.names import AlignmentDoubt, AlignmentKind, DenialReason, HoldReason, TargetKind
from iris_session.protocol.server_messages import Notice

#: For a participant that says `not_needed` and drives with a headset.
UNALIGNED_ADVICE: Final = (
    "join with alignment 'measured' and look at an anchor sheet, drive with device 'desktop', 'target' or 'joints', "
    "or let the configuration of the session (`unaligned`) name this role, device or key"
)
#: 95 % quantile of the standard normal distribution.
Z95: Final = 1.6448536269514722
#: A look agrees with what is in force when it is not further away than so many times the p95 of both.
AGREES_WITHIN: Final = 2.0
#: A doubt is replaced by another one that says more.
_RANKS: Final = {
    doubt: i
    for i, doubt in enumerate(("", AlignmentDoubt.AGED, AlignmentDoubt.UNVERIFIED, AlignmentDoubt.CONTRADICTED))
}
#: A look confirms an alignment when its own stated error is at most so many times that of the alignment.
SAME_ERROR: Final = 1.25
#: A correction without a look since the last one: its age and doubt stay.
_NO_LOOK: Final = -1
#: Walking since a look that is not older than this is neglected.
_FRESH_NS: Final = 2_000_000_000
#: Looks at other anchors speak against a single one that contradicts them, as long as the estimator remembers them.
_REMEMBERED_NS: Final = 600_000_000_000
#: Reasons of a hold that a better alignment ends.
_OF_ALIGNMENT: Final = (HoldReason.UNALIGNED, HoldReason.VIEW_ONLY, HoldReason.UNCONFIRMED)
ADVICE: Final = "step closer to the sheet, look at it from a second place, or add a sheet near the robot"


def may_be_unaligned(ctx: Context, role: str, key_id: str, device: str) -> bool:
    """Return true when the configuration lets this role, key or device drive without an alignment."""
    allowed = ctx.config.unaligned
    return role in allowed or device in allowed or f"{KEY_PREFIX}{key_id}" in allowed


def process_proposal(ctx: Context, p: Participant, m: AlignmentProposal) -> None:
    """Accept the estimator's result, ignore it as no news, or refuse it with advice."""
    if not p.needs_alignment or not p.aligning or m.tracking_epoch < p.tracking_epoch:
        return None
    if ctx.entry_ns <= max(p.proposals_from_ns, ctx.state.anchors_ns):
        return None  # made before the front knew of a jump, a new run, or where the anchors are now
    drives = m.kind not in AlignmentKind.VIEW_ONLY
    if m.refused or not _is_valid_proposal(ctx, m):
        text = "the anchor measurement is not good enough" if m.refused else "the measurement is not a valid pose"
        if m.refused and m.look_s > 0.0:
            return _ask_to_look(ctx, p, m.look_s)
        if m.refused and _report_progress(ctx, p, m, text):
            return None
        return _notify_refusal(ctx, p, text, m.advice or ADVICE)
    if m.tracking_epoch > p.tracking_epoch:
        # The announcement of the frame can arrive after the first observation in it.
        set_tracking_epoch(ctx, p, TrackingEpoch(m.tracking_epoch))
    if not drives and p.alignment is not None and p.alignment.kind not in AlignmentKind.VIEW_ONLY:
        return None
    error = compute_error_at_robots(ctx, p, m.covariance, m.pivot_world, m.error_at_anchor_m)
    bound = ctx.config.max_error_at_robot_m if drives else ctx.config.max_error_to_view_m
    if error > bound:
        if m.look_s > 0.0:
            return _ask_to_look(ctx, p, m.look_s)
        text = _describe_large_error("the robot", error, bound)
        return None if _report_progress(ctx, p, m, text) else _notify_refusal(ctx, p, text, m.advice or ADVICE)
    tilted = m.residual_tilt_rad > max(ctx.config.max_residual_tilt_rad, m.tilt_noise_rad)
    degrees = math.degrees(m.residual_tilt_rad)
    tilt = f"{p.name}: the anchor is tilted by {degrees:.1f} degrees, is the sheet level?"
    warn_wearer(ctx, p, "tilt", tilt if tilted else "", same="tilted")
    advice = f"alignment of {p.name}: {m.advice}" if m.advice and not tilted else ""
    warn_wearer(ctx, p, "advice", advice, same=m.advice)
    others = join_names(_list_contradicted(ctx, p, m))
    text = others and f"alignment of {p.name} refused: sheet '{m.looks[0].anchor_id}' alone contradicts {others}"
    text = others and f"{text}; look at {others} again"
    warn_wearer(ctx, p, "contradicted", text, same=others, reason=DenialReason.ALIGNMENT_REFUSED)
    if others:
        return None
    looked_ns, walked_m = _find_look(ctx, p, m)
    if p.placed or (looked_ns is None and not _is_after_move(ctx, p, m)):
        return None
    if drives:
        _note_looks(ctx, p, m)
    if _is_news(ctx, p, m, error):
        return offer_measurement(ctx, p, m, looked_ns, walked_m)
    if looked_ns is None:
        return None
    if p.correction is not None:
        p.correction.looked_ns, p.correction.walked_m = looked_ns, walked_m
    elif p.alignment is not None:
        now = p.alignment
        known = compute_error_at_robots(ctx, p, now.covariance, p.pivot_world, 0.0) if now.covariance else error
        if error <= SAME_ERROR * max(known, now.error_at_robot_m):
            confirm_alignment(ctx, p, looked_ns, walked_m)
    return None


def _list_contradicted(ctx: Context, p: Participant, m: AlignmentProposal) -> tuple[str, ...]:
    """Return the anchors that still speak against a proposal: it rests on nothing but the anchor of the alarm, while
    what is in force rests on these too. The front weighs that itself; after a new connection or process it has
    forgotten what it saw.
    """
    if p.alignment is None or p.alarm is None or p.alarm.beside or not p.alarm.anchor_id:
        return ()
    if {one.anchor_id for one in m.looks} != {p.alarm.anchor_id}:
        return ()
    since_ns = ctx.now_ns - _REMEMBERED_NS
    return tuple(n for n, one in sorted(p.looks.items()) if n != p.alarm.anchor_id and one.last_ns >= since_ns)


def _find_look(ctx: Context, p: Participant, m: AlignmentProposal) -> tuple[int | None, float]:
    """Return the time of the newest look that a proposal agrees with, and how far the head had walked by then. `None`:
    it is not later than the last look at what is in force or under way, so it says nothing about the drift since then.
    """
    if m.looked_ns == 0:
        return ctx.now_ns, p.walked_m  # recorded before the front stated it
    looked_ns, now = min(m.looked_ns, ctx.now_ns), p.alignment
    # How far the head has walked since an old look is not known: all since the last one counts.
    walked_m = p.walked_m if ctx.now_ns - looked_ns <= _FRESH_NS else p.confirmed_walked_m
    is_first = now is None or (now.kind in AlignmentKind.VIEW_ONLY and m.kind not in AlignmentKind.VIEW_ONLY)
    is_later = looked_ns > p.confirmed_ns and (p.correction is None or looked_ns >= p.correction.looked_ns)
    return (looked_ns if is_first or is_later else None), walked_m


def _is_after_move(ctx: Context, p: Participant, m: AlignmentProposal) -> bool:
    """Return true when an anchor was moved since the look that confirmed what is in force, and the proposal rests on
    that look: it is the same measurement at the new places.
    """
    is_free = p.correction is None or p.correction.looked_ns == _NO_LOOK
    return is_free and ctx.state.anchors_ns >= p.confirmed_ns and m.looked_ns >= p.confirmed_ns


def _is_valid_proposal(ctx: Context, m: AlignmentProposal) -> bool:
    if m.kind not in (AlignmentKind.MEASURED, *AlignmentKind.VIEW_ONLY):
        return False
    if len(m.covariance) != 36 or not math.isfinite(sum(m.covariance) + sum(m.pivot_world) + m.residual_tilt_rad):
        return False
    variances = m.covariance[::7]
    return min(variances) >= 0.0 and 0.0 <= m.error_at_anchor_m < math.inf and is_valid_pose(ctx, m.T_world_tracking)


def is_valid_pose(ctx: Context, T: Pose) -> bool:
    """Return true for numbers that are a pose: finite, within reach, a unit quaternion."""
    n = math.sqrt(sum(c * c for c in T.q))
    return abs(n - 1.0) <= ctx.config.quaternion_tolerance and all(abs(c) <= ctx.config.reach_m for c in T.p)


def _is_news(ctx: Context, p: Participant, m: AlignmentProposal, error: float) -> bool:
    """Return true when a measurement differs from the alignment in force or under way, or has a smaller
    stated error.
    """
    now, coming = p.alignment, p.correction
    replaced = now is None or now.kind == AlignmentKind.PLACED or now.kind in AlignmentKind.VIEW_ONLY - {m.kind}
    if now is None or replaced or (p.alarm is not None and not p.alarm.beside):
        return True
    if coming is not None:
        old: Pose | None = coming.T_world_tracking
        known = compute_error_at_robots(ctx, p, coming.covariance, coming.pivot_world, coming.error_at_anchor_m)
    else:
        old, known = p.T_world_tracking_measured, compute_stated_errors(ctx, p)[1]
    if old is None or error < 0.8 * known:
        return True
    # Where the anchor's point lies, by the old and the new alignment.
    T_new = (m.T_world_tracking.p, quat_normalize(m.T_world_tracking.q))
    p_tracking = apply(inverse(T_new), m.pivot_world)
    moved = distance(apply((old.p, old.q), p_tracking), m.pivot_world)
    # What is dropped is in no stated error, so it must be small beside it.
    share, turn_p95 = ctx.config.min_change_share, Z95 * math.sqrt(sum(m.covariance[21::7]))
    return moved > min(ctx.config.min_change_m, share * m.error_at_anchor_m) or quat_angle(old.q, T_new[1]) > min(
        ctx.config.min_change_rad, share * turn_p95
    )


def _note_looks(ctx: Context, p: Participant, m: AlignmentProposal) -> None:
    """Note by which anchors `p` is aligned, and when it has looked at them. What contradicts earlier looks begins
    anew, in the next alignment.
    """
    if not ctx.config.verify_pairs or not m.looks:
        return
    now_ns, earlier = ctx.now_ns, p.looks if _is_agreeing(ctx, p, m) else {}
    looks = {name: one for name, one in earlier.items() if name not in m.moved}
    for one in m.looks:
        if one.anchor_id in ctx.state.anchors:
            known = looks.get(one.anchor_id, one)
            first_ns, last_ns = min(known.first_ns, one.first_ns), max(known.last_ns, one.last_ns)
            looks[one.anchor_id] = AnchorLooks(one.anchor_id, min(first_ns, now_ns), min(last_ns, now_ns))
    p.looks = looks


def _is_agreeing(ctx: Context, p: Participant, m: AlignmentProposal) -> bool:
    """Return true when a measurement lies where the alignment in force says, within the stated errors of both. An alarm
    about less is no reason to make others glance.
    """
    if p.alignment is None or p.alignment.kind != AlignmentKind.MEASURED:
        return False
    moved_m, _ = _measure_difference(_get_measured_pose(p), m.T_world_tracking, m.pivot_world)
    known_m = compute_position_p95(compute_aged_covariance(ctx, p), p.pivot_world, m.pivot_world)
    return moved_m <= AGREES_WITHIN * math.hypot(known_m, m.error_at_anchor_m)


def refuse_large_error(ctx: Context, p: Participant, robot: str, error: float, advice: str = "") -> None:
    """Refuse an alignment whose stated error at the robot is too large."""
    _notify_refusal(ctx, p, _describe_large_error(robot, error, ctx.config.max_error_at_robot_m), advice or ADVICE)


def _describe_large_error(robot: str, error: float, bound: float) -> str:
    return f"predicted error {error * 1000:.0f} mm at {robot}, at most {bound * 1000:.0f} mm is allowed"


def _ask_to_look(ctx: Context, p: Participant, look_s: float) -> None:
    """Ask the wearer to go on looking, at most once per `warning_ns`: a look that has begun is no refusal."""
    said = p.warnings.setdefault("look", WarningState(said_ns=ctx.now_ns - ctx.config.warning_ns))
    if ctx.now_ns - said.said_ns >= ctx.config.warning_ns:
        said.said_ns = ctx.now_ns
        seconds = max(1, round(min(look_s, 60.0)))
        inform_wearer(
            ctx, p, f"alignment of {p.name}: look at the sheet for {seconds} more second{'s' * (seconds > 1)}"
        )


def _report_progress(ctx: Context, p: Participant, m: AlignmentProposal, text: str) -> bool:
    """Return true for one of the first refusals: more observations are likely to mend it, so the wearer is asked to
    look for `patience_ns`. If nothing better comes in that time, `advance_corrections` makes it a warning.
    """
    if p.alignment is not None or not m.n_observations or p.refused_ns is not None:
        return False
    refusal = f"{text}; {m.advice or ADVICE}"
    if not p.refusal:
        p.refusal_from_ns = ctx.now_ns
        seconds = ctx.config.patience_ns / 1e9
        inform_wearer(ctx, p, f"alignment of {p.name}: look at the sheet for {seconds:g} more seconds ({text})")
    p.refusal = refusal
    return True


def _notify_refusal(ctx: Context, p: Participant, text: str, advice: str) -> None:
    """Publish why an alignment was refused, at most once per report period. The alignment in force stays."""
    if p.refused_ns is not None and ctx.now_ns - p.refused_ns < ctx.config.report_ns:
        return
    p.refused_ns = ctx.now_ns
    text = f"alignment of {p.name} refused: {text}; {advice}"[:MAX_TEXT]
    ctx.emit(Notice("warning", text, p.id, DenialReason.ALIGNMENT_REFUSED))


def place_alignment(ctx: Context, p: Participant, m: PlaceAlignment) -> None:
    """Apply a director's placement: the whole alignment, or an offset in the world on top of the measured one."""
    person = ctx.find_participant(m.participant)
    if person is None:
        return ctx.deny(p, m.request_id, build_absent_denial(m.participant))
    if not person.needs_alignment or not is_valid_pose(ctx, m.T_world_tracking):
        text = f"{person.name} needs no alignment, or the pose is not finite with a unit quaternion"
        return ctx.deny(p, m.request_id, Denial(DenialReason.INVALID, text))
    if m.offset and person.T_world_tracking_measured is None:
        text = f"{person.name} has no measured alignment to add an offset to"
        return ctx.deny(p, m.request_id, Denial(DenialReason.UNALIGNED, text, "place it without offset"))
    apply_placement(ctx, person, Placement(normalise_pose(m.T_world_tracking), m.offset))
    return ctx.accept(p, m.request_id)


def set_tracking_epoch(ctx: Context, p: Participant, m: TrackingEpoch) -> None:
    """Start another tracking frame after a jump: alignment and engagements of this participant end."""
    if m.tracking_epoch <= p.tracking_epoch:
        return
    p.tracking_epoch = m.tracking_epoch
    void_tracking_frame(ctx, p)
    ctx.publish_participant(p)
    if p.needs_alignment and not p.aligning:
        inform_wearer(ctx, p, f"{p.name} is not aligned, and its alignment run is stopped: start it")


def void_tracking_frame(ctx: Context, p: Participant) -> None:
    """Void poses and alignment of the old tracking frame, and hold everything that they moved."""
    for device in p.seen.values():
        device.pose = device.track = None
    if p.needs_alignment:
        void_alignment(p)
    engagement.rearm_participant(ctx, p, HoldReason.REARM)


# --- corrections ---


def is_engaged(ctx: Context, p: Participant) -> bool:
    """Return true when `p` moves anything now."""
    leases = (*ctx.state.robots.values(), *ctx.held_objects)
    return any(g.engagement and g.participant == p.id for lease in leases for g in lease.grants)


def is_in_use(ctx: Context, p: Participant) -> bool:
    """Return true when a sudden change would startle: `p` has engaged, or has been aligned for a while, in this run and
    frame.
    """
    return p.in_use or (p.aligned_ns is not None and ctx.now_ns - p.aligned_ns >= ctx.config.settle_ns)


def offer_measurement(
    ctx: Context, p: Participant, m: AlignmentProposal, looked_ns: int | None, walked_m: float
) -> None:
    """Put a measurement that passed the gate in force at once, or make it the goal of a correction.

    Args:
        ctx: Of this step.
        p: Whose measurement it is.
        m: The measurement.
        looked_ns: Time of the newest look that it agrees with; `None`: no look since what is in force was confirmed.
        walked_m: How far the head had walked by then.
    """
    covariance = tuple(map(float, m.covariance))
    x, y, z = m.pivot_world
    pivot_world = (float(x), float(y), float(z))
    goal = Correction(
        normalise_pose(m.T_world_tracking),
        covariance,
        pivot_world,
        float(m.error_at_anchor_m),
        ctx.now_ns + ctx.config.slide_ns,
        looked_ns=_NO_LOOK if looked_ns is None else looked_ns,
        walked_m=walked_m,
    )
    if p.alignment is None or p.alignment.kind in AlignmentKind.VIEW_ONLY:
        return _complete_correction(ctx, p, goal, m.kind)
    if not (is_in_use(ctx, p) or is_engaged(ctx, p)):
        return _complete_correction(ctx, p, goal)
    if p.correction is not None:
        before = p.correction
        goal.slides_ns, goal.T_told = before.slides_ns, before.T_told
    p.correction = goal
    return None


def apply_placement(ctx: Context, p: Participant, word: Placement) -> None:
    """Put a director's placement in force at once, or when the clutch of its wearer opens."""
    if is_engaged(ctx, p):
        p.placing = word
        return inform_wearer(ctx, p, f"a director has placed {p.name}: it comes into force when you let go")
    p.placing = None
    if word.offset and p.T_world_tracking_measured is not None and p.alignment is not None:
        p.offset = word.T_world_tracking
        T = compose_poses(p.offset, p.T_world_tracking_measured)
        return _set_alignment(ctx, p, p.alignment.kind, T, offset=True)
    p.offset = p.T_world_tracking_measured = p.correction = None
    p.placed, p.looks = True, {}
    _set_alignment(ctx, p, AlignmentKind.PLACED, word.T_world_tracking)
    confirm_alignment(ctx, p, ctx.now_ns, p.walked_m)
    return _clear_answered_alarm(ctx, p)


def void_alignment(p: Participant) -> None:
    """Clear everything about the alignment, because the tracking frame is another one."""
    p.alignment = p.offset = p.T_world_tracking_measured = p.correction = p.placing = p.alarm = p.aged = None
    p.stride_from, p.looks = None, {}
    p.placed = p.in_use = False
    p.aligned_ns = p.refused_ns = None
    p.refusal = p.doubt = ""


def advance_corrections(ctx: Context) -> None:
    """Apply waiting placements and corrections where nothing is engaged, and report refusals that have lasted. Once per
    step, after the samples.
    """
    for p in ctx.state.participants.values():
        if p.refusal and ctx.now_ns - p.refusal_from_ns >= ctx.config.patience_ns:
            text, _, advice = p.refusal.partition("; ")
            p.refusal = ""
            _notify_refusal(ctx, p, text, advice)
        if p.correction is None and p.placing is None:
            continue
        if is_engaged(ctx, p):
            _announce_while_engaged(ctx, p)
            continue
        if p.placing is not None:
            apply_placement(ctx, p, p.placing)
        if p.correction is not None:
            _advance_correction(ctx, p, p.correction)


def measure_pending_correction(p: Participant) -> tuple[float, float]:
    """Return how far the pending alignment differs from the one in force, at the anchor: [m] and [rad]."""
    if p.alignment is None:
        return 0.0, 0.0
    if p.placing is not None and not p.placing.offset:
        return _measure_difference(p.alignment.T_world_tracking, p.placing.T_world_tracking, p.pivot_world)
    return (0.0, 0.0) if p.correction is None else _measure_correction(p, p.correction)


def normalise_pose(T: Pose) -> Pose:
    """Return the pose in floats (a host may pass ints, which would not replay byte for byte) with an exact unit
    quaternion.
    """
    x, y, z = T.p
    return Pose((float(x), float(y), float(z)), quat_normalize(T.q))


def compose_poses(a: Pose, b: Pose) -> Pose:
    return Pose(*compose((a.p, a.q), (b.p, b.q)))


def _get_measured_pose(p: Participant) -> Pose:
    """Return the alignment in force without the director's offset."""
    assert p.alignment is not None
    return p.T_world_tracking_measured or p.alignment.T_world_tracking


def _measure_correction(p: Participant, c: Correction) -> tuple[float, float]:
    return _measure_difference(_get_measured_pose(p), c.T_world_tracking, c.pivot_world)


def _measure_difference(old: Pose, new: Pose, pivot_world: Vec3) -> tuple[float, float]:
    """Return how far `old` puts the point that `new` puts at `pivot_world` from there [m], and their angle [rad]."""
    p_tracking = apply(inverse((new.p, new.q)), pivot_world)
    return distance(apply((old.p, old.q), p_tracking), pivot_world), quat_angle(old.q, new.q)


def _is_large(ctx: Context, away_m: float, turn_rad: float) -> bool:
    return away_m > ctx.config.announce_m or turn_rad > ctx.config.announce_rad


def _announce_while_engaged(ctx: Context, p: Participant) -> None:
    """Announce a pending correction once while a clutch is engaged, unless it will slide in unseen."""
    c = p.correction
    if c is not None and c.T_told is None and _is_large(ctx, *_measure_correction(p, c)) and _may_announce(ctx, p):
        _announce_correction(ctx, p, c, "the correction waits until you let go")


def _may_announce(ctx: Context, p: Participant) -> bool:
    """Return true when the last announcement is old enough: wild measurements must not fill the wearer's view."""
    return p.told_ns is None or ctx.now_ns - p.told_ns >= ctx.config.announce_ns


def _announce_correction(ctx: Context, p: Participant, c: Correction, what: str) -> None:
    away_m, turn_rad = _measure_correction(p, c)
    c.T_told, p.told_ns = c.T_world_tracking, ctx.now_ns
    far = f"{away_m * 1e3:.0f} mm" if away_m >= 0.001 else ""
    turned = f"{math.degrees(turn_rad):.1f} degrees" if turn_rad >= 0.001 else ""
    inform_wearer(ctx, p, f"the alignment of {p.name} is off by {' and '.join(filter(None, (far, turned)))}: {what}")


def _advance_correction(ctx: Context, p: Participant, c: Correction) -> None:
    away_m, turn_rad = _measure_correction(p, c)
    if not is_in_use(ctx, p):
        _complete_correction(ctx, p, c)
    elif not _is_large(ctx, away_m, turn_rad):
        if ctx.now_ns >= c.slides_ns:
            _slide_correction(ctx, p, c, away_m, turn_rad)
    elif _may_announce(ctx, p):
        # The correction may have changed since it was announced.
        if c.T_told is None or _is_large(ctx, *_measure_difference(c.T_told, c.T_world_tracking, c.pivot_world)):
            _announce_correction(ctx, p, c, f"the scene moves by that in {ctx.config.announce_ns * 1e-9:g} s")
        else:
            _complete_correction(ctx, p, c)


def _slide_correction(ctx: Context, p: Participant, c: Correction, away_m: float, turn_rad: float) -> None:
    """Apply one part of a small correction; after a pause it continues to slide, it does not leap."""
    seconds = ctx.config.slide_ns * 1e-9
    parts = max(away_m / (ctx.config.slide_m_per_s * seconds), turn_rad / (ctx.config.slide_rad_per_s * seconds))
    if parts <= 1.0 + 1e-6:  # a rounding error is no part of its own
        return _complete_correction(ctx, p, c)
    old, new = _get_measured_pose(p), c.T_world_tracking
    p_tracking = apply(inverse((new.p, new.q)), c.pivot_world)
    T = Pose(*interpolate_about_pivot((old.p, old.q), (new.p, new.q), p_tracking, 1.0 / parts))
    at = apply((T.p, T.q), p_tracking)
    left = [c.pivot_world[i] - at[i] for i in range(3)] + list(quat_to_rotvec(quat_mul(new.q, quat_conj(T.q))))
    c.slides_ns = ctx.now_ns + ctx.config.slide_ns
    error_at_anchor_m = c.error_at_anchor_m + distance(at, c.pivot_world)
    _apply_measured(ctx, p, T, c.pivot_world, widen_covariance(c.covariance, tuple(left)), error_at_anchor_m)
    return _confirm_correction(ctx, p, c)


def _complete_correction(ctx: Context, p: Participant, c: Correction, kind: str = AlignmentKind.MEASURED) -> None:
    """Apply all of a correction."""
    p.correction = None
    _apply_measured(ctx, p, c.T_world_tracking, c.pivot_world, c.covariance, c.error_at_anchor_m, kind)
    _confirm_correction(ctx, p, c)
    if c.looked_ns != _NO_LOOK:
        _clear_answered_alarm(ctx, p)


def _confirm_correction(ctx: Context, p: Participant, c: Correction) -> None:
    if c.looked_ns == _NO_LOOK:
        p.age_due_ns = ctx.now_ns  # its error as aged is stated at once
    else:
        confirm_alignment(ctx, p, c.looked_ns, c.walked_m)


def _apply_measured(
    ctx: Context,
    p: Participant,
    T: Pose,
    pivot_world: Vec3,
    covariance: tuple[float, ...],
    error_at_anchor_m: float,
    kind: str = AlignmentKind.MEASURED,
) -> None:
    """Put a measured alignment in force; a director's offset on top of it voids the stated error."""
    p.T_world_tracking_measured, p.pivot_world = T, pivot_world
    if p.offset is not None:
        return _set_alignment(ctx, p, kind, compose_poses(p.offset, T), offset=True)
    error_at_robot_m = compute_error_at_robots(ctx, p, covariance, pivot_world, error_at_anchor_m)
    return _set_alignment(ctx, p, kind, T, covariance, error_at_anchor_m, error_at_robot_m)


def _set_alignment(
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
    p.aged = None
    p.refused_ns, p.refusal = None, ""
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
    warn_wearer(ctx, p, "unaligned", "", same="")
    ctx.publish_alignment(p)
    _rearm_holds(ctx, p)


def _clear_answered_alarm(ctx: Context, p: Participant) -> None:
    """Clear an alarm that a new alignment resolves; one about a moved sheet stays."""
    if p.alarm is not None and not p.alarm.beside:
        p.alarm = None
        warn_wearer(ctx, p, "alarm", "", same="")


# --- confirmed, or in doubt ---


def doubt_alignment(ctx: Context, p: Participant, doubt: str, text: str) -> None:
    """Make the alignment in force *unconfirmed*: it begins no engagement until a look confirms or replaces it.

    An engagement under way goes on, in the alignment that was frozen for it.

    Args:
        ctx: Of this step.
        p: Whose alignment it is; nothing happens without one, or where the configuration lets nothing be doubted.
        doubt: The `AlignmentDoubt`; it replaces one that says less.
        text: Warning to the wearer: why, and what to do. Empty: another one says it.
    """
    if not ctx.config.doubts or p.alignment is None or _RANKS[doubt] < _RANKS.get(p.doubt, 0):
        return
    p.doubt = doubt
    warn_wearer(ctx, p, "doubt", text, same=doubt)


def confirm_alignment(ctx: Context, p: Participant, looked_ns: int, walked_m: float) -> None:
    """Note that a look at `looked_ns`, after the head had walked `walked_m`, agrees with the alignment in force: doubts
    end, and its age starts again.
    """
    p.confirmed_ns, p.confirmed_walked_m = looked_ns, walked_m
    if p.aged is not None:
        p.aged = None
        ctx.publish_alignment(p)
    warn_wearer(ctx, p, "age", "", same="")
    if p.doubt and not (p.doubt == AlignmentDoubt.UNVERIFIED and p.looks):  # that one is about a certain anchor
        end_doubt(ctx, p)


def end_doubt(ctx: Context, p: Participant) -> None:
    """End what `doubt_alignment` began."""
    p.doubt = ""
    warn_wearer(ctx, p, "doubt", "", same="")
    _rearm_holds(ctx, p)


def _rearm_holds(ctx: Context, p: Participant) -> None:
    """Ask for another squeeze where the alignment was why a target holds, and is not any more."""
    if not ctx.config.doubts or p.alignment is None or p.alignment.kind in AlignmentKind.VIEW_ONLY:
        return
    for lease in ctx.list_leases(p):
        for g in lease.grants:
            if g.participant != p.id or g.hold not in _OF_ALIGNMENT or (g.hold == HoldReason.UNCONFIRMED and p.doubt):
                continue
            is_robot = lease.kind == TargetKind.ROBOT
            if not is_robot or compute_error_at_robot(ctx, p, lease.target) <= ctx.config.max_error_at_robot_m:
                g.hold = HoldReason.REARM


# --- stated errors ---


def compute_position_p95(covariance: tuple[float, ...], pivot: Vec3, point: Vec3) -> float:
    """Return the 95 % quantile [m] of the length of the position error at `point`, from a 6x6 covariance stated at
    `pivot`.

    The error at the point is dp + dtheta x r with r = point - pivot. Its squared length is a weighted sum of chi-square
    variables, approximated by one with the same mean and variance (Satterthwaite), its quantile by Wilson-Hilferty.
    """
    x, y, z = point[0] - pivot[0], point[1] - pivot[1], point[2] - pivot[2]
    # C = J covariance J^T, J = [I | -[r]x]: how (dp, dtheta) moves the point. Written out: it is asked often.
    CJ0, CJ1, CJ2 = [], [], []
    for i in range(0, 36, 6):
        px, py, pz, rx, ry, rz = covariance[i : i + 6]
        CJ0.append(px + ry * z - rz * y)
        CJ1.append(py - rx * z + rz * x)
        CJ2.append(pz + rx * y - ry * x)
    columns = (CJ0, CJ1, CJ2)
    C = [px + ry * z - rz * y for px, _, _, _, ry, rz in columns]
    C += [py - rx * z + rz * x for _, py, _, rx, _, rz in columns]
    C += [pz + rx * y - ry * x for _, _, pz, rx, ry, _ in columns]
    mean = C[0] + C[4] + C[8]
    if not (0.0 < mean < math.inf):
        return 0.0 if mean == 0.0 else math.inf
    spread = sum([c * c for c in C])
    freedom = min(3.0, max(1.0, mean * mean / spread)) if math.isfinite(spread) and spread > 0.0 else 1.0
    a = 2.0 / (9.0 * freedom)
    return math.sqrt(mean * (1.0 - a + Z95 * math.sqrt(a)) ** 3)


def compute_error_at_robot(ctx: Context, p: Participant, robot: str) -> float:
    """Return the stated p95 position error [m] of `p` at the end effector of `robot`; 0 where none is stated (placed,
    offset).
    """
    alignment = p.alignment
    if alignment is None or not alignment.covariance:
        return 0.0
    return compute_position_p95(alignment.covariance, p.pivot_world, ctx.view.tip_pose(robot).p)


def compute_error_at_robots(
    ctx: Context, p: Participant, covariance: tuple[float, ...], pivot_world: Vec3, error_at_anchor_m: float
) -> float:
    """Return the stated p95 error [m]: the largest at the robots that `p` holds, else at the robot nearest to the
    anchor.
    """
    held = find_robot_points(ctx, p)
    points = held or [ctx.view.tip_pose(name).p for name in ctx.robots]
    errors = [compute_position_p95(covariance, pivot_world, point) for point in points]
    return max(errors) if held else min(errors, default=error_at_anchor_m)


def find_robot_points(ctx: Context, p: Participant) -> list[Vec3]:
    """Return the positions of the end effectors that `p` holds, in the world."""
    leases = ctx.state.robots.values()
    return [ctx.view.tip_pose(g.target).p for g in leases if any(h.participant == p.id for h in g.grants)]


def compute_aged_covariance(ctx: Context, p: Participant) -> tuple[float, ...]:
    """Return the covariance of the alignment in force as it is now, at its pivot; of one without, that of its drift."""
    known = (p.alignment.covariance if p.alignment is not None else ()) or (0.0,) * 36
    if ctx.config.ageing is None:
        return known
    minutes = (ctx.now_ns - p.confirmed_ns) / 60e9
    return grow_covariance(known, ctx.config.ageing, minutes, p.walked_m - p.confirmed_walked_m)


def compute_stated_errors(ctx: Context, p: Participant) -> tuple[float, float]:
    """Return the stated p95 [m] now, at the anchor and at the robot: 0 where none is stated. Age never lowers it."""
    now = p.alignment
    if now is None or not now.covariance or ctx.config.ageing is None:
        return (0.0, 0.0) if now is None else (now.error_at_anchor_m, now.error_at_robot_m)
    grown = compute_aged_covariance(ctx, p)
    at_anchor_m = max(now.error_at_anchor_m, compute_position_p95(grown, p.pivot_world, p.pivot_world))
    at_robot_m = compute_error_at_robots(ctx, p, grown, p.pivot_world, at_anchor_m)
    return at_anchor_m, max(now.error_at_robot_m, at_robot_m)


def widen_covariance(covariance: tuple[float, ...], away: tuple[float, ...]) -> tuple[float, ...]:
    """Return a covariance that includes an error (3 m, 3 rad, at its pivot) still to be corrected: C + v v^T.

    Its p95 is never less than that error itself, at any lever arm.
    """
    return tuple(c + away[i // 6] * away[i % 6] for i, c in enumerate(covariance))


# --- notices to the wearer ---


def advise_view_only(p: Participant) -> tuple[str, str]:
    """Return why `p` may look but not drive, and what to do about it."""
    if p.alignment is not None and p.alignment.kind == AlignmentKind.PERSISTENT:
        return "its alignment comes from a kept anchor and is not confirmed", "touch one mark with a calibrated tip"
    return (
        "its marks were touched with a fingertip, or with a tip that is not calibrated",
        "calibrate the tip of a controller in a pricked hole, and touch three marks with it",
    )


def warn_wearer(ctx: Context, p: Participant, kind: str, text: str, *, same: str, reason: str = "") -> None:
    """Warn the wearer, at most once per `warning_ns` and kind; the next warning counts those left out meanwhile.

    `text` empty: the condition has ended. `same`: the part of a warning that stays equal in repetitions, which are not
    sent again. `reason`: the `DenialReason` that the warning explains.
    """
    w = p.warnings.get(kind)
    if w is None:
        if not text:
            return
        w = p.warnings[kind] = WarningState(said_ns=ctx.now_ns - ctx.config.warning_ns)
    now = same if text else ""
    changed, w.seen = now != w.seen, now
    if not now:
        w.said = ""
    elif now != w.said and ctx.now_ns - w.said_ns < ctx.config.warning_ns:
        w.left_out += changed
    elif now != w.said:
        more = f" ({w.left_out} more of these meanwhile)" if w.left_out else ""
        ctx.emit(Notice("warning", text[: MAX_TEXT - len(more)] + more, p.id, reason))
        w.said, w.said_ns, w.left_out = now, ctx.now_ns, 0


def inform_wearer(ctx: Context, p: Participant, text: str) -> None:
    """Send the wearer a notice that reports no fault."""
    ctx.emit(Notice("info", text[:MAX_TEXT], p.id))
