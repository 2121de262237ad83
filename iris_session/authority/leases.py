"""Granting, releasing and fencing of leases. Who may ask for what is decided in `requests`."""

from __future__ import annotations

from iris_session.authority import engagement
from iris_session.authority.context import Context, find_grant, no_such
from iris_session.authority.state import KEPT, Grant, LeaseState, Participant, Pending
from iris_session.protocol.client_messages import Release
from iris_session.protocol.common import Denial
from iris_session.protocol.names import DenialReason, HoldReason, LeaseMode, TargetKind
from iris_session.protocol.server_messages import Feedback


def held_by_other(ctx: Context, lease: LeaseState, action: str = "ask the holder to release it") -> Denial:
    """The denial `held`, with the holder and what to do."""
    holder = ctx.holder(lease)
    name = ctx.state.participants[holder].name if holder else ""
    text = f"{lease.target} is held by {name}" if holder else f"others wait for {lease.target}"
    advice = f"{action}, or acquire with wait to queue for it"
    return Denial(DenialReason.HELD, text, advice, lease.target, holder, name)


def revoke(ctx: Context, lease: LeaseState, g: Grant) -> None:
    """Takes one grant away without publishing it."""
    engagement.end(ctx, lease, g, HoldReason.REARM)
    if lease.override and (g.participant == lease.override or g is lease.grants[0]):
        # One side of an intervention is gone, so it is over: the other one alone is in charge.
        engagement.give_back(ctx, lease)
    lease.grants.remove(g)
    if lease.kind == TargetKind.OBJECT:
        if not lease.grants:
            lease.lead = 0  # nobody holds it from here on: it may lie anywhere when it is next taken
        ctx.refresh_held()


def grant(ctx: Context, lease: LeaseState, p: Participant, cause: str, weight: float = 1.0, hand: str = "") -> None:
    """Gives `lease` to `p`; who must give way loses it in the same step. Holding it already only sets the weight."""
    own = find_grant(lease, p.id, hand)
    joins = lease.mode in (LeaseMode.SHARED, LeaseMode.PRIORITY) and cause != "assigned"
    if own is not None and own.hand == hand and (joins or len(lease.grants) == 1):
        if own.weight != weight and lease.mode == LeaseMode.SHARED:
            own.weight = weight
            ctx.publish(lease, "acquired", ctx.holder(lease))
        return
    previous = ctx.holder(lease)
    if not joins:
        clear(ctx, lease)
    lease.version += 1
    scale = ctx.scale(lease) if lease.mode == LeaseMode.SHARED else ctx.plain_scale
    lease.grants.append(Grant(p.id, lease.version, weight, hand, scale))
    if lease.kind == TargetKind.OBJECT:
        ctx.refresh_held()
    ctx.publish(lease, cause, previous if previous != p.id else "")


def clear(ctx: Context, lease: LeaseState) -> None:
    """Takes a robot from everyone who holds it, and tells them so by feedback."""
    for g in tuple(lease.grants):
        old = ctx.state.participants[g.participant]
        revoke(ctx, lease, g)
        ctx.send(old, Feedback(lease.target, "hold", HoldReason.NO_LEASE, rejected=dict(old.rejected)))


def free(ctx: Context, lease: LeaseState, p: Participant, cause: str) -> None:
    """Ends every grant of `p` on one target and publishes the lease."""
    previous = ctx.holder(lease)
    for g in [g for g in lease.grants if g.participant == p.id]:
        revoke(ctx, lease, g)
    ctx.publish(lease, cause, previous)


def free_all(ctx: Context, p: Participant, cause: str) -> None:
    """Ends everything that `p` holds or waits for."""
    forget_requests(ctx, p, "")
    for lease in ctx.leases_of(p):
        free(ctx, lease, p, cause)


def fence(ctx: Context, p: Participant) -> None:
    """After a resume: new fencing tokens for everything `p` holds, so that nothing sent before it counts."""
    for lease in ctx.leases_of(p):
        lease.version += 1
        for g in lease.grants:
            if g.participant == p.id:
                engagement.rearm(ctx, lease, g, HoldReason.REARM)
                g.version = lease.version
        ctx.publish(lease, "resumed")


def release(ctx: Context, p: Participant, m: Release) -> None:
    """The urgent `release`: named targets, or everything and every place in a queue."""
    if not m.targets:
        forget_requests(ctx, p, "you released everything")
        held = ctx.leases_of(p)
        for own in held:
            free(ctx, own, p, "released")
        return ctx.accept(p, m.request_id, held)
    chosen: list[LeaseState] = []
    for t in m.targets:
        lease = ctx.lease(t.kind, t.name)
        grants = [g for g in lease.grants if g.participant == p.id] if lease is not None else []
        if t.kind not in (TargetKind.ROBOT, TargetKind.OBJECT):
            known = f"kinds: {TargetKind.ROBOT}, {TargetKind.OBJECT}"
            return ctx.deny(p, m.request_id, Denial(DenialReason.UNKNOWN_VALUE, f"unknown kind {t.kind}", known))
        if lease is None:
            there = ctx.robots if t.kind == TargetKind.ROBOT else ctx.objects
            return ctx.deny(p, m.request_id, no_such(t.kind, t.name, there))
        if not grants:
            text, holder = f"you do not hold {t.name}", ctx.holder(lease)
            return ctx.deny(p, m.request_id, Denial(DenialReason.NOT_HOLDER, text, "", t.name, holder))
        if not any(g.version <= t.lease_version <= lease.version for g in grants):
            text = f"{t.name}: lease version {t.lease_version} is not yours"
            advice = f"use version {lease.version}"
            return ctx.deny(p, m.request_id, Denial(DenialReason.LEASE_VERSION, text, advice, t.name, p.id, p.name))
        if lease not in chosen:
            chosen.append(lease)
    for own in chosen:
        free(ctx, own, p, "released")
    return ctx.accept(p, m.request_id, chosen)


def forget_requests(ctx: Context, p: Participant, why: str, *, keeps_place: bool = False) -> None:
    """Drops what `p` waits for; answers it with `why` unless that is empty (the participant is gone). `keeps_place`:
    its place in the queue stays, and nobody waits for the answer."""
    for pending in (*ctx.state.queue, *ctx.state.consents):
        if pending.participant == p.id and keeps_place and pending in ctx.state.queue:
            pending.request_id = KEPT
        elif pending.participant == p.id:
            drop_request(ctx, pending)
            if why and pending.request_id != KEPT:
                text = f"no longer waiting: {why}"
                ctx.deny(p, pending.request_id, Denial(DenialReason.NOT_HOLDER, text, "acquire again to wait again"))


def drop_request(ctx: Context, pending: Pending) -> None:
    """Takes one unanswered request off its list and publishes the queues it stood in."""
    ctx.state.consents = [other for other in ctx.state.consents if other is not pending]
    waiting = len(ctx.state.queue)
    ctx.state.queue = [other for other in ctx.state.queue if other is not pending]
    if len(ctx.state.queue) < waiting:
        publish_queues(ctx, pending)


def publish_queues(ctx: Context, pending: Pending) -> None:
    """Shows everyone the queues that `pending` has joined or left."""
    for lease in ctx.state.robots.values():
        if pending.any_robot or lease.target in pending.robots:
            ctx.publish(lease, "queue", ctx.holder(lease))
