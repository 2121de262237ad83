"""Granting, releasing and fencing of leases. `requests` decides which requests are granted."""

from __future__ import annotations

from typing import Final

from iris_session.authority import engagement
from iris_session.authority.config import SECOND
from iris_session.authority.context import Context, build_unknown_denial, find_grant
from iris_session.authority.state import NO_REPLY, LeaseGrant, LeaseState, Participant, Pending
from iris_session.protocol.client_messages import Release
from iris_session.protocol.common import Denial
from iris_session.protocol.names import DenialReason, HoldReason, LeaseMode, TargetKind
from iris_session.protocol.server_messages import Feedback

#: What a request can do that is denied because others hold its target.
QUEUE_ADVICE: Final = "acquire with wait to queue for it"


def build_held_denial(ctx: Context, lease: LeaseState, action: str = "ask the holder to release it") -> Denial:
    """Return the denial `held`, with the holder and what to do.

    A disconnected holder, such as a program that crashed or a tab that was closed, cannot be asked: the denial says
    until when it keeps its lease.
    """
    holder = ctx.state.participants.get(ctx.get_holder(lease))
    if holder is None:
        return Denial(DenialReason.HELD, f"others wait for {lease.target}", QUEUE_ADVICE, lease.target)
    text, advice = f"{lease.target} is held by {holder.name}", f"{action}, or {QUEUE_ADVICE}"
    if holder.expires_ns and ctx.config.explains:
        ago_s, left_s = (ctx.now_ns - holder.heard_ns) // SECOND, -((ctx.now_ns - holder.expires_ns) // SECOND)
        text += f", disconnected {ago_s} s ago, free in {left_s} s"
        advice = f"{QUEUE_ADVICE}; a program that joins again with the same identity= resumes it"
    return Denial(DenialReason.HELD, text, advice, lease.target, holder.id, holder.name)


def revoke_grant(ctx: Context, lease: LeaseState, g: LeaseGrant) -> None:
    """Remove one grant without publishing the lease."""
    engagement.end_engagement(ctx, lease, g, HoldReason.REARM)
    if lease.override and (g.participant == lease.override or g is lease.grants[0]):
        # One side of an intervention has left, so it is over: the other one alone is in charge.
        engagement.end_intervention(ctx, lease)
    lease.grants.remove(g)
    if not lease.grants and lease.home:
        is_still = ctx.state.estop or ctx.state.paused
        lease.freed_ns, lease.homing = 0 if is_still else ctx.now_ns, 0
    if lease.kind == TargetKind.OBJECT:
        if not lease.grants:
            lease.lead = 0  # free from here on: it may lie anywhere when it is next taken
        ctx.update_held_objects()


def grant_lease(
    ctx: Context,
    lease: LeaseState,
    p: Participant,
    cause: str,
    weight: float = 1.0,
    hand: str = "",
    request_id: int = NO_REPLY,
) -> None:
    """Grant `lease` to `p`; grants that exclude it are revoked in the same step. For a holder only the
    weight is set.
    """
    own = find_grant(lease, p.id, hand)
    joins = lease.mode in (LeaseMode.SHARED, LeaseMode.PRIORITY) and cause != "assigned"
    if own is not None and own.hand == hand and (joins or len(lease.grants) == 1):
        if own.weight != weight and lease.mode == LeaseMode.SHARED:
            own.weight = weight
            ctx.publish_lease(lease, "acquired", ctx.get_holder(lease))
        return
    previous = ctx.get_holder(lease)
    if not joins:
        revoke_all(ctx, lease)
    lease.version += 1
    lease.freed_ns = 0
    scale = ctx.get_scale(lease) if lease.mode == LeaseMode.SHARED else ctx.default_scale
    lease.grants.append(LeaseGrant(p.id, lease.version, weight, hand, scale, request_id=request_id))
    if lease.kind == TargetKind.OBJECT:
        ctx.update_held_objects()
    ctx.publish_lease(lease, cause, previous if previous != p.id else "")


def revoke_all(ctx: Context, lease: LeaseState) -> None:
    """Revoke every grant of a robot and notify the holders by feedback."""
    for g in tuple(lease.grants):
        old = ctx.state.participants[g.participant]
        revoke_grant(ctx, lease, g)
        ctx.send(old, Feedback(lease.target, "hold", HoldReason.NO_LEASE, rejected=dict(old.rejected)))


def release_target(ctx: Context, lease: LeaseState, p: Participant, cause: str) -> None:
    """End every grant of `p` on one target and publish the lease."""
    previous = ctx.get_holder(lease)
    for g in [g for g in lease.grants if g.participant == p.id]:
        revoke_grant(ctx, lease, g)
    ctx.publish_lease(lease, cause, previous)


def release_request(ctx: Context, p: Participant, request_id: int) -> list[LeaseState]:
    """End every grant that one `acquire` of `p` gave; return their leases."""
    released = []
    for lease in ctx.list_leases(p):
        for g in [g for g in lease.grants if g.participant == p.id and g.request_id == request_id]:
            previous = ctx.get_holder(lease)
            revoke_grant(ctx, lease, g)
            ctx.publish_lease(lease, "released", previous)
            released.append(lease)
    return released


def release_everything(ctx: Context, p: Participant, cause: str) -> None:
    """End every grant and every pending request of `p`."""
    cancel_requests(ctx, p, "")
    for lease in ctx.list_leases(p):
        release_target(ctx, lease, p, cause)


def renew_fencing_tokens(ctx: Context, p: Participant) -> None:
    """Issue new fencing tokens for everything `p` holds after a resume, so that nothing sent before it counts."""
    for lease in ctx.list_leases(p):
        lease.version += 1
        for g in lease.grants:
            if g.participant == p.id:
                engagement.rearm_grant(ctx, lease, g, HoldReason.REARM)
                g.version, g.request_id = lease.version, NO_REPLY  # another connection numbers its requests anew
        ctx.publish_lease(lease, "resumed")


def process_release(ctx: Context, p: Participant, m: Release) -> None:
    """Process the urgent `release`: named targets, or everything and every place in a queue."""
    if not m.targets:
        cancel_requests(ctx, p, "you released everything")
        held = ctx.list_leases(p)
        for own in held:
            release_target(ctx, own, p, "released")
        return ctx.accept(p, m.request_id, held)
    chosen: list[LeaseState] = []
    for t in m.targets:
        lease = ctx.find_lease(t.kind, t.name)
        grants = [g for g in lease.grants if g.participant == p.id] if lease is not None else []
        if t.kind not in (TargetKind.ROBOT, TargetKind.OBJECT):
            known = f"kinds: {TargetKind.ROBOT}, {TargetKind.OBJECT}"
            return ctx.deny(p, m.request_id, Denial(DenialReason.UNKNOWN_VALUE, f"unknown kind {t.kind}", known))
        if lease is None:
            there = ctx.robots if t.kind == TargetKind.ROBOT else ctx.objects
            return ctx.deny(p, m.request_id, build_unknown_denial(t.kind, t.name, there))
        if not grants:
            text, holder = f"you do not hold {t.name}", ctx.get_holder(lease)
            return ctx.deny(p, m.request_id, Denial(DenialReason.NOT_HOLDER, text, "", t.name, holder))
        if not any(g.version <= t.lease_version <= lease.version for g in grants):
            text = f"{t.name}: lease version {t.lease_version} is not yours"
            advice = f"use version {lease.version}"
            return ctx.deny(p, m.request_id, Denial(DenialReason.LEASE_VERSION, text, advice, t.name, p.id, p.name))
        if lease not in chosen:
            chosen.append(lease)
    for own in chosen:
        release_target(ctx, own, p, "released")
    return ctx.accept(p, m.request_id, chosen)


def cancel_requests(ctx: Context, p: Participant, why: str, *, keeps_place: bool = False) -> None:
    """Cancel the pending requests of `p`, denied with `why` unless that is empty (the participant is removed).

    `keeps_place`: its place in the queue stays, without a request to answer.
    """
    for pending in (*ctx.state.queue, *ctx.state.consents):
        if pending.participant == p.id and keeps_place and pending in ctx.state.queue:
            pending.request_id = NO_REPLY
        elif pending.participant == p.id:
            remove_request(ctx, pending)
            if why and pending.request_id != NO_REPLY:
                text = f"no longer waiting: {why}"
                ctx.deny(p, pending.request_id, Denial(DenialReason.NOT_HOLDER, text, "acquire again to wait again"))


def remove_request(ctx: Context, pending: Pending) -> None:
    """Remove one unanswered request and publish the queues it stood in."""
    ctx.state.consents = [other for other in ctx.state.consents if other is not pending]
    waiting = len(ctx.state.queue)
    ctx.state.queue = [other for other in ctx.state.queue if other is not pending]
    if len(ctx.state.queue) < waiting:
        publish_queues(ctx, pending)


def publish_queues(ctx: Context, pending: Pending) -> None:
    """Publish the queues that `pending` has joined or left."""
    for lease in ctx.state.robots.values():
        if pending.any_robot or lease.target in pending.robots:
            ctx.publish_lease(lease, "queue", ctx.get_holder(lease))
