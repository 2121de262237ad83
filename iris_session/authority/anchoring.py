"""Alignment runs, moved anchors, alarms of the drift monitor, cross-checks of headsets, and the reports about them."""

from __future__ import annotations

import math
from typing import Final

from anchors.pose import apply, inverse
from iris_session.authority import alignment, pairs, shifts
from iris_session.authority.context import (
    Context,
    build_absent_denial,
    build_unknown_denial,
    build_value_denial,
    join_names,
)
from iris_session.authority.state import HOST_ID, AlarmState, CrossCheckState, Participant
from iris_session.protocol.client_messages import Align, MoveAnchor, TrackingEpoch
from iris_session.protocol.common import MAX_TEXT, Denial, Pose
from iris_session.protocol.entries import AlignmentAlarm, CrossChecked, TipSolved
from iris_session.protocol.names import AlarmKind, AlignAction, AlignmentDoubt, AlignmentKind, DenialReason, Role
from iris_session.protocol.server_messages import (
    AlignmentAlarmed,
    AlignmentRun,
    AnchorMoved,
    HeadsetsCompared,
    Notice,
    TipCalibrated,
)
from iris_session.protocol.status import AlignmentReport, CrossCheckReport

#: Comparisons in a report: of 64 people there are 2,016 pairs.
MAX_REPORTED: Final = 64
#: A comparison is outdated once an alignment has moved by so much of the expected difference.
_OUTDATED_SHARE: Final = 0.5
#: Names in one event.
MAX_NAMES: Final = 32


def control_alignment_run(ctx: Context, p: Participant, m: Align) -> None:
    """Start or stop an alignment run: a director's (or the host's) for everyone, others for themselves."""
    if m.action not in AlignAction.ALL:
        return ctx.deny(p, m.request_id, build_value_denial("action", m.action, AlignAction.ALL))
    person = ctx.find_participant(m.participant) if m.participant else p
    if person is not p and p.role != Role.DIRECTOR:
        text = f"role {p.role} may align only itself"
        denial = Denial(DenialReason.ROLE, text, "leave `participant` empty, or ask a director")
        return ctx.deny(p, m.request_id, denial)
    if person is None:
        return ctx.deny(p, m.request_id, build_absent_denial(m.participant))
    if not person.needs_alignment:
        return ctx.deny(p, m.request_id, Denial(DenialReason.INVALID, f"{person.name} needs no alignment"))
    if m.action == AlignAction.START:
        _start_run(ctx, person)
    elif person.aligning:
        person.aligning, person.correction = False, None
    else:
        return ctx.accept(p, m.request_id)
    ctx.emit(AlignmentRun(person.id, person.aligning, person.alignment_run, p.id))
    return ctx.accept(p, m.request_id)


def _start_run(ctx: Context, p: Participant) -> None:
    """Start to measure anew: the alignment in force stays until then, a director's placement and offset end."""
    p.alignment_run += 1
    p.aligning, p.placed, p.aligned_ns = True, False, None
    p.in_use = alignment.is_engaged(
        ctx, p
    )  # the first of the new measurements must not startle a wearer who is engaged
    p.correction = p.placing = p.offset = None
    p.proposals_from_ns = ctx.now_ns
    p.refused_ns, p.refusal = None, ""
    if p.alignment is not None and p.alignment.kind == AlignmentKind.MEASURED:
        p.T_world_tracking_measured = p.alignment.T_world_tracking
    _clear_alarm(ctx, p)


def move_anchor(ctx: Context, p: Participant, m: MoveAnchor) -> None:
    """Move an anchor for a director: measurements at its old place no longer count."""
    if m.anchor_id not in ctx.state.anchors:
        return ctx.deny(p, m.request_id, build_unknown_denial("anchor", m.anchor_id, ctx.state.anchors))
    if not alignment.is_valid_pose(ctx, m.T_world_anchor):
        text = f"the pose is not finite with a unit quaternion, or further than {ctx.config.reach_m:g} m away"
        return ctx.deny(p, m.request_id, Denial(DenialReason.INVALID, text, "", m.anchor_id))
    away_m, most_m = math.dist(m.T_world_anchor.p, ctx.state.anchors[m.anchor_id].p), ctx.config.max_anchor_move_m
    if away_m > most_m and not m.force:
        text = f"anchor {m.anchor_id} would be moved by {away_m:.1f} m; more than {most_m:g} m needs --force (`force`)"
        return ctx.deny(p, m.request_id, Denial(DenialReason.TOO_FAR, text, "poses are in metres", m.anchor_id))
    _set_anchors(ctx, {**ctx.state.anchors, m.anchor_id: alignment.normalise_pose(m.T_world_anchor)}, p.id)
    return ctx.accept(p, m.request_id)


def _set_anchors(ctx: Context, anchors: dict[str, Pose], by: str) -> None:
    """Replace the anchors and publish those that moved.

    The front cannot know of it before this step is over. What it proposes between then and the moment it receives the
    news is followed by what it proposes afterwards, over the same connection: nothing of it has come into force by then
    for any alignment in use, as corrections need half a second to begin.
    """
    moved = [name for name, T in anchors.items() if ctx.state.anchors.get(name) != T]
    if not moved and anchors.keys() == ctx.state.anchors.keys():
        return
    ctx.state.anchors, ctx.state.anchors_ns = anchors, ctx.now_ns
    for name in moved:
        ctx.emit(AnchorMoved(name, anchors[name], by))
    for p in ctx.state.participants.values():
        p.correction = None
        p.looks = {name: one for name, one in p.looks.items() if name in anchors}
        about = "" if p.alarm is None else p.alarm.anchor_id  # empty too where a head jumped: no anchor resolves that
        if about and (about in moved or about not in anchors):
            _clear_alarm(ctx, p)


def replace_anchors(ctx: Context, anchors: dict[str, Pose]) -> None:
    """Set the anchors given to a session that resumes from a recording."""
    if anchors and all(alignment.is_valid_pose(ctx, T) for T in anchors.values()):
        _set_anchors(ctx, {name: alignment.normalise_pose(T) for name, T in anchors.items()}, HOST_ID)


def raise_alarm(ctx: Context, p: Participant, m: AlignmentAlarm) -> None:
    """Record an alarm of the front's drift monitor. A jump voids the alignment at once, the others ask for a new
    measurement. Where other headsets see the same shift of an anchor, the tracking frame did not jump.
    """
    if not p.needs_alignment or m.kind not in AlarmKind.ALL or m.tracking_epoch < p.tracking_epoch:
        return
    if m.tracking_epoch > p.tracking_epoch:
        alignment.set_tracking_epoch(ctx, p, TrackingEpoch(m.tracking_epoch))
    is_known = p.alignment is None or (p.correction is not None and not ctx.config.doubts)
    if m.kind == AlarmKind.DIFFERS and not m.beside and is_known:
        return
    size_m = min(max(0.0, m.size_m), ctx.config.reach_m) if math.isfinite(m.size_m) else ctx.config.reach_m
    witnesses = shifts.note_shift(ctx, p, m)
    kind = AlarmKind.CHANGED if witnesses and m.kind == AlarmKind.JUMP else m.kind
    if m.kind == AlarmKind.JUMP:
        p.proposals_from_ns = max(p.proposals_from_ns, ctx.entry_ns)
    if kind == AlarmKind.JUMP:
        alignment.void_tracking_frame(ctx, p)
    elif not m.beside:
        p.correction = None  # its measurements contradict the present observations
    p.alarm = AlarmState(kind, m.anchor_id, size_m, m.beside, ctx.now_ns)
    ctx.emit(AlignmentAlarmed(p.id, kind, m.anchor_id, size_m, m.beside, tuple(q.id for q in witnesses[:MAX_NAMES])))
    if kind == AlarmKind.JUMP:
        ctx.publish_participant(p)
    placed = kind == AlarmKind.DIFFERS and p.placed  # a director's word is to count more than what is measured
    if kind != AlarmKind.JUMP and not m.beside and not placed:
        alignment.doubt_alignment(ctx, p, AlignmentDoubt.CONTRADICTED, "")  # the warning of the alarm says it
    if kind == AlarmKind.TWO_PLACES:
        _doubt_prints(ctx, p, m.anchor_id, size_m)
        return
    if m.beside and m.anchor_id in p.looks:
        known = p.looks[m.anchor_id]
        p.looks = {name: one for name, one in p.looks.items() if name != m.anchor_id}
        pairs.doubt_anchor(ctx, p, m.anchor_id, known)
    text = _describe_alarm(p, m, size_m)
    if witnesses:
        shifts.announce_shift(ctx, p, witnesses)
    elif not shifts.warn_later(ctx, p, text):
        alignment.warn_wearer(ctx, p, "alarm", text, same=f"{kind} {m.anchor_id}")


def _doubt_prints(ctx: Context, p: Participant, anchor_id: str, apart_m: float) -> None:
    """Doubt all alignments that rest on an anchor of which there are two prints, and nothing else: it is not known
    who looked at which.
    """
    for other in ctx.state.participants.values():
        if set(other.looks) == {anchor_id}:
            alignment.doubt_alignment(ctx, other, AlignmentDoubt.CONTRADICTED, "")
    text = f"sheet '{anchor_id}' is in two places, {apart_m:.2f} m apart, as {p.name} sees it: print each id once"
    ctx.emit(Notice("warning", text[:MAX_TEXT]))


def _describe_alarm(p: Participant, m: AlignmentAlarm, size_m: float) -> str:
    size = f"{size_m * 1e3:.0f} mm"
    if m.beside:
        others = join_names(m.beside)
        return f"{p.name} sees anchor {m.anchor_id} {size} elsewhere, and {others} where it was: was the sheet moved?"
    advice = "look at an anchor sheet again" if p.aligning else "start its alignment run again"
    advice = "have it placed again" if p.placed else advice
    if m.kind == AlarmKind.JUMP:
        return f"the tracking of {p.name} jumped by {size}: it is not aligned, robots hold; {advice}"
    holds = ", robots hold at the next engagement" if p.doubt else ""
    return f"{p.name} sees anchor {m.anchor_id} {size} off from its alignment{holds}: {advice}"


def _clear_alarm(ctx: Context, p: Participant) -> None:
    p.alarm = None
    alignment.warn_wearer(ctx, p, "alarm", "", same="")


def publish_tip(ctx: Context, p: Participant, m: TipSolved) -> None:
    """Publish the tip of a controller, or why it could not be calibrated. Ignored for invalid numbers."""
    numbers = (*m.p_grip_tip, *m.covariance, m.error_m, m.residual_m)
    if not all(map(math.isfinite, numbers)) or len(m.covariance) != (0 if m.refused else 9):
        return
    x, y, z = m.p_grip_tip
    covariance = tuple(map(float, m.covariance))
    sizes = (float(m.error_m), float(m.residual_m))
    tip = (float(x), float(y), float(z))
    ctx.emit(TipCalibrated(p.id, m.device, tip, covariance, *sizes, m.n_poses, m.refused, m.advice))


def record_cross_check(ctx: Context, p: Participant, m: CrossChecked) -> None:
    """Record that two headsets observed the same anchor. Ignored when either has left, or for invalid numbers."""
    other = ctx.by_connection.get(m.other)
    if other is None or other is p or HOST_ID in (p.id, other.id):
        return
    x, y, z = m.p_world
    sizes = (float(m.error_m), float(m.error_rad), float(m.expected_p95_m))
    if not all(math.isfinite(v) for v in (*sizes, x, y, z)) or min(sizes) < 0.0:
        return
    key = " ".join(sorted((p.id, other.id))) + " touched" * m.touched
    at = (float(x), float(y), float(z))
    poses = tuple(one.alignment.T_world_tracking for one in (p, other) if one.alignment is not None)
    aligned = poses if len(poses) == 2 else ()
    check = CrossCheckState(p.id, other.id, m.anchor_id, *sizes, m.n, ctx.now_ns, m.touched, at, aligned)
    ctx.state.cross_checks[key] = check
    ctx.emit(HeadsetsCompared(p.id, other.id, m.anchor_id, *sizes, at, m.n, m.touched))


def remove_cross_checks(ctx: Context, p: Participant) -> None:
    """Remove the cross-checks of a participant that has left."""
    kept = {key: c for key, c in ctx.state.cross_checks.items() if p.id not in (c.a, c.b)}
    ctx.state.cross_checks = kept


def build_alignment_report(ctx: Context, p: Participant) -> AlignmentReport:
    """Return the authority's part of an alignment report; the front adds what it observes."""
    now, last = p.alignment, p.alarm
    at_anchor_m, at_robot_m = alignment.compute_stated_errors(ctx, p)
    pending_m, pending_rad = alignment.measure_pending_correction(p)
    return AlignmentReport(
        version=0 if now is None else now.version,
        running=p.aligning,
        offset=now is not None and now.offset,
        error_at_anchor_m=at_anchor_m,
        error_at_robot_m=at_robot_m,
        pending_m=pending_m,
        pending_rad=pending_rad,
        alarm="" if last is None else last.kind,
        alarm_size_m=0.0 if last is None else last.size_m,
        alarm_ns=-1 if last is None else ctx.now_ns - last.raised_ns,
        doubt=p.doubt,
        confirmed_ns=-1 if now is None else ctx.now_ns - p.confirmed_ns,
    )


def build_cross_check_reports(ctx: Context) -> tuple[CrossCheckReport, ...]:
    """Return the newest cross-checks of every pair, by looks and by touch, newest first."""
    newest = sorted(ctx.state.cross_checks.values(), key=lambda c: -c.compared_ns)[:MAX_REPORTED]
    return tuple(
        CrossCheckReport(
            c.a,
            c.b,
            c.anchor_id,
            c.error_m,
            c.error_rad,
            c.expected_p95_m,
            ctx.now_ns - c.compared_ns,
            c.n,
            c.touched,
            _is_outdated(ctx, c),
        )
        for c in newest
    )


def _is_outdated(ctx: Context, c: CrossCheckState) -> bool:
    """Return true when one of the two has been aligned elsewhere since, by a share of what is expected of the pair."""
    for name, then in zip((c.a, c.b), c.T_world_trackings, strict=False):
        p = ctx.state.participants.get(name)
        if p is None or p.alignment is None:
            return True
        now = p.alignment.T_world_tracking
        p_now = apply((now.p, now.q), apply(inverse((then.p, then.q)), c.p_world))
        if math.dist(p_now, c.p_world) > _OUTDATED_SHARE * c.expected_p95_m:
            return True
    return False
