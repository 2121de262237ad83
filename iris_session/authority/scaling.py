"""Motion scaling: how far a robot moves as its holder's hand moves. It belongs to the grant, so it ends with it.

The scale of a robot is that of the grant in charge (`Context.scale`). In mode `shared` there is one for everybody: a
scale that is set is set for all sharers, and who joins takes it over. In mode `priority` agent and human each keep
their own, so an intervention at a tenth of the speed leaves the agent's alone.
"""

from __future__ import annotations

from collections.abc import Sequence

from iris_session.authority.context import Context, no_such
from iris_session.authority.state import Grant, LeaseState, Participant
from iris_session.protocol.client_messages import SetScale
from iris_session.protocol.common import Denial
from iris_session.protocol.names import DenialReason, LeaseMode, Role
from iris_session.protocol.server_messages import ScaleChanged


def set_scale(ctx: Context, p: Participant, m: SetScale) -> None:
    """A holder sets its own scale, a director that of whoever is in charge; all robots or none."""
    low, high = ctx.config.min_scale, ctx.config.max_scale
    if not low <= m.scale <= high:  # a scale that is no number is in no range
        advice = f"use a scale from {low:g} to {high:g}"
        return ctx.deny(p, m.request_id, Denial(DenialReason.INVALID, f"scale {m.scale:g} is out of range", advice))
    names = tuple(dict.fromkeys(m.robots)) or _held(ctx, p)
    denial = _denial(ctx, p, names)
    if denial is not None:
        return ctx.deny(p, m.request_id, denial)
    chosen = [ctx.state.robots[name] for name in names]
    for lease in chosen:
        before = ctx.scale(lease)
        for g in _meant(ctx, p, lease):
            g.scale = float(m.scale)
        if ctx.scale(lease) != before:
            ctx.emit(ScaleChanged(lease.target, ctx.scale(lease), p.id))
    return ctx.accept(p, m.request_id, chosen)


def _held(ctx: Context, p: Participant) -> tuple[str, ...]:
    return tuple(n for n, lease in ctx.state.robots.items() if any(g.participant == p.id for g in lease.grants))


def _denial(ctx: Context, p: Participant, names: Sequence[str]) -> Denial | None:
    if not names:
        return Denial(DenialReason.NOT_HOLDER, "you hold no robot", "acquire one first, or name robots")
    for name in names:
        lease = ctx.state.robots.get(name)
        if lease is None:
            return no_such("robot", name, ctx.robots)
        if not _meant(ctx, p, lease):
            holder = ctx.holder(lease)
            held_by = ctx.state.participants[holder].name if holder else "nobody"
            advice = "acquire it first, or ask its holder" if holder else "acquire it first"
            text = f"{name} is held by {held_by}"
            return Denial(DenialReason.NOT_HOLDER, text, advice, name, holder, held_by if holder else "")
    return None


def _meant(ctx: Context, p: Participant, lease: LeaseState) -> list[Grant]:
    """The grants whose scale `p` sets; empty when it may not."""
    own = [g for g in lease.grants if g.participant == p.id]
    if lease.mode == LeaseMode.SHARED and (own or p.role == Role.DIRECTOR):
        return lease.grants
    if own or p.role != Role.DIRECTOR:
        return own
    return [g for g in lease.grants if g.participant == ctx.holder(lease)]
