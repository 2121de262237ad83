"""Alignments age: their stated error grows since the last look that confirmed them, until they are *unconfirmed*.

The law is `anchors.ageing`, its constants are in the configuration. An alignment whose error by age alone is above the
bound at the robot begins no engagement until a glance; an engagement under way goes on. Clients get the error in steps
of 20 %, as `AlignmentChanged` of the same version.

A placement and an offset by a director have no stated error. An offset lies on a measurement, which ages as any other.
A placement cannot be confirmed by a look, so that it would hold its wearer for ever: its age is said, nothing else.
Alignments that move nothing (`AlignmentKind.VIEW_ONLY`) age against their own bound.
"""

from __future__ import annotations

from typing import Final

import msgspec

from anchors.ageing import Covariance
from anchors.pose import distance
from iris_session.authority import alignment
from iris_session.authority.context import Context
from iris_session.authority.state import Participant
from iris_session.protocol.client_messages import Sample
from iris_session.protocol.common import Pose, Vec3
from iris_session.protocol.names import AlignmentDoubt, AlignmentKind

#: Growth of the stated error that is published.
STATED_STEP: Final = 1.2
MIN_STATED_STEP_M: Final = 0.0005
#: A time that is not known counts as so much, after which every alignment waits for a glance.
UNKNOWN_NS: Final = 3_600_000_000_000
_MINUTE_NS: Final = 60e9


def measure_walk(ctx: Context, p: Participant, s: Sample) -> None:
    """Add to the distance walked by the head. Shorter motions than a stride are noise, or a person who stands."""
    if ctx.config.ageing is None or s.pose is None or not p.needs_alignment:
        return
    if p.stride_from is None:
        p.stride_from = s.pose.p
        return
    stride_m = distance(p.stride_from, s.pose.p)
    if stride_m >= ctx.config.ageing.stride_m:
        p.walked_m += stride_m
        p.stride_from = s.pose.p


def check_ages(ctx: Context) -> None:
    """Look at the age of every alignment, once per `age_check_ns`: state its error, and doubt what is too old."""
    if ctx.config.ageing is None:
        return
    for p in ctx.state.participants.values():
        if p.alignment is not None and p.needs_alignment and ctx.now_ns >= p.age_due_ns:
            p.age_due_ns = ctx.now_ns + ctx.config.age_check_ns
            _check_age(ctx, p)


def is_too_old(ctx: Context, p: Participant, robot: str) -> bool:
    """Return true when the error at `robot` is above the bound because of the alignment's age."""
    if ctx.config.ageing is None or p.alignment is None or p.alignment.kind == AlignmentKind.PLACED:
        return False
    return _exceeds(
        p, alignment.compute_aged_covariance(ctx, p), ctx.view.tip_pose(robot).p, ctx.config.max_error_at_robot_m
    )


def doubt_age(ctx: Context, p: Participant) -> None:
    """Make an alignment that is too old unconfirmed, and ask its wearer for a glance."""
    sheet = min(ctx.state.anchors.items(), key=lambda item: _distance_to(item[1], p), default=("", None))[0]
    where = f"sheet '{sheet}'" if sheet else "a sheet"
    glance = f"glance at {where}, or touch three of its marks"
    text = f"{describe_age(ctx, p)}: {'' if p.aligning else 'start its alignment run and '}{glance}"
    alignment.doubt_alignment(ctx, p, AlignmentDoubt.AGED, f"{text}; until then the next clutch moves nothing")


def add_unknown_age(ctx: Context) -> None:
    """Let all alignments age by `UNKNOWN_NS`: it is not known for how long the session was down."""
    for p in ctx.state.participants.values():
        p.confirmed_ns -= UNKNOWN_NS
        p.age_due_ns = ctx.now_ns


def describe_age(ctx: Context, p: Participant) -> str:
    """Return how old an alignment is, in words."""
    minutes = (ctx.now_ns - p.confirmed_ns) / _MINUTE_NS
    age = f"{minutes:.0f} minutes" if minutes >= 1.5 else f"{minutes * 60.0:.0f} seconds"
    return f"the alignment of {p.name} is {age} old"


def _check_age(ctx: Context, p: Participant) -> None:
    assert p.alignment is not None
    now = p.alignment
    view_only = now.kind in AlignmentKind.VIEW_ONLY
    bound = ctx.config.max_error_to_view_m if view_only else ctx.config.max_error_at_robot_m
    if now.kind == AlignmentKind.PLACED:
        drift = alignment.compute_aged_covariance(ctx, p)
        if alignment.compute_position_p95(drift, p.pivot_world, p.pivot_world) > bound:
            text = f"{describe_age(ctx, p)}, and placed by hand: check it, and have it placed again"
            alignment.warn_wearer(ctx, p, "age", text, same=str(now.version))
        return
    grown = alignment.compute_aged_covariance(ctx, p)
    if now.covariance:
        at_anchor, at_robot = alignment.compute_stated_errors(ctx, p)
        said = (p.aged or now).error_at_anchor_m
        if at_anchor > said + max((STATED_STEP - 1.0) * said, MIN_STATED_STEP_M):
            p.aged = msgspec.structs.replace(
                now, covariance=grown, error_at_anchor_m=at_anchor, error_at_robot_m=at_robot
            )
            ctx.publish_alignment(p)
    points = alignment.find_robot_points(ctx, p) or [p.pivot_world]
    if p.doubt in ("", AlignmentDoubt.AGED) and any(_exceeds(p, grown, point, bound) for point in points):
        doubt_age(ctx, p)


def _exceeds(p: Participant, grown: Covariance, point: Vec3, bound: float) -> bool:
    """Return true when the error at a point is above the bound now, and was not when the alignment was confirmed."""
    assert p.alignment is not None
    known = p.alignment.covariance
    if known and alignment.compute_position_p95(known, p.pivot_world, point) > bound:
        return False
    return alignment.compute_position_p95(grown, p.pivot_world if known else point, point) > bound


def _distance_to(T_world_anchor: Pose, p: Participant) -> float:
    return distance(T_world_anchor.p, p.pivot_world)
