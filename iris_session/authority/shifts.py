"""Votes across headsets: two that see the same shift of an anchor mean that the anchor was moved, not they.

A headset that alone sees a shift is doubted itself. Where others are looking at the anchor, its warning waits for them,
at most `vote_ns`; what holds its robots does not wait.
"""

from __future__ import annotations

import math
from typing import Final

from anchors.pose import Vec3, distance
from iris_session.authority import alignment
from iris_session.authority.context import Context, join_names
from iris_session.authority.state import NO_CONNECTION, Participant, SheetShift
from iris_session.protocol.common import MAX_TEXT
from iris_session.protocol.entries import AlignmentAlarm
from iris_session.protocol.names import AlarmKind
from iris_session.protocol.server_messages import Notice

#: Noise of the looks that show a shift, p95: five of them from 1 m away (docs/anchors.md, "Noise").
LOOKS_P95_M: Final = 0.010
#: Of two shifts that are the same by their stated errors, one may be at most this much of the other.
_MAX_APART_SHARE: Final = 0.5
#: Looks are counted some time after they were made, as an estimate and its way take it.
_LOOK_DELAY_NS: Final = 3_000_000_000
_MAX_WITNESSES: Final = 8


def note_shift(ctx: Context, p: Participant, m: AlignmentAlarm) -> list[Participant]:
    """Note a shift of an anchor by which `p` is aligned, and return the others who see the same."""
    looks, T_world_anchor = p.looks.get(m.anchor_id), ctx.state.anchors.get(m.anchor_id)
    is_usable = len(m.shift_m) == 3 and all(math.isfinite(v) and abs(v) < ctx.config.reach_m for v in m.shift_m)
    is_usable = is_usable and not m.beside and m.kind != AlarmKind.TWO_PLACES
    if not ctx.config.verify_pairs or looks is None or T_world_anchor is None or not is_usable:
        return []
    x, y, z = m.shift_m
    covariance = alignment.compute_aged_covariance(ctx, p)
    p95_m = math.hypot(alignment.compute_position_p95(covariance, p.pivot_world, T_world_anchor.p), LOOKS_P95_M)
    p.shift = SheetShift(m.anchor_id, (float(x), float(y), float(z)), p95_m, ctx.now_ns)
    return [
        other
        for other in ctx.state.participants.values()
        if other is not p
        and other.shift is not None
        and looks.first_ns <= other.shift.seen_ns  # both were aligned before it was moved,
        and looks.last_ns <= other.shift.seen_ns + _LOOK_DELAY_NS  # and `p` has not seen it there since
        and _is_same_shift(p.shift, other.shift)
    ]


def announce_shift(ctx: Context, p: Participant, witnesses: list[Participant]) -> None:
    """Say once that an anchor was moved, instead of warning everybody who sees it."""
    assert p.shift is not None
    shifts = [other.shift for other in (p, *witnesses) if other.shift is not None]
    if not any(shift.is_said for shift in shifts):
        names = join_names([other.name for other in (*witnesses, p)], _MAX_WITNESSES)
        far = f"{math.hypot(*p.shift.shift_m) * 1e3:.0f} mm"
        text = f"sheet '{p.shift.anchor_id}' was moved by {far}, as {names} see it"
        if len(ctx.state.anchors) > 1:
            advice = "put it back, or set where it lies now (iris-session anchors move)"
        else:
            advice = "headsets that look at it follow it; tape it down"
        ctx.emit(Notice("warning", f"{text}: {advice}"[:MAX_TEXT]))
    for shift in shifts:
        shift.is_said, shift.text = True, ""


def warn_later(ctx: Context, p: Participant, text: str) -> bool:
    """Keep a warning about `p` back while others look at the same anchor; return false if no other does."""
    if p.shift is None or p.shift.seen_ns != ctx.now_ns or not any(_may_vote(ctx, p, p.shift.anchor_id)):
        return False
    p.shift.text, p.shift.due_ns = text, ctx.now_ns + ctx.config.vote_ns
    return True


def warn_due(ctx: Context) -> None:
    """Give the warnings for which no other has voted in time."""
    for p in ctx.state.participants.values():
        if p.shift is not None and p.shift.text and ctx.now_ns >= p.shift.due_ns:
            text, p.shift.text = p.shift.text, ""
            alignment.warn_wearer(ctx, p, "alarm", text, same=p.shift.anchor_id)


def _may_vote(ctx: Context, p: Participant, anchor_id: str) -> list[bool]:
    others = [q for q in ctx.state.participants.values() if q is not p and q.connection != NO_CONNECTION]
    looks = [q.looks[anchor_id] for q in others if anchor_id in q.looks]
    return [one.last_ns + _LOOK_DELAY_NS >= ctx.now_ns for one in looks]


def _is_same_shift(a: SheetShift, b: SheetShift) -> bool:
    if a.anchor_id != b.anchor_id:
        return False
    apart_m, least_m = distance(a.shift_m, b.shift_m), min(_length(a.shift_m), _length(b.shift_m))
    return apart_m <= min(alignment.AGREES_WITHIN * math.hypot(a.p95_m, b.p95_m), _MAX_APART_SHARE * least_m)


def _length(shift_m: Vec3) -> float:
    return math.hypot(*shift_m)
