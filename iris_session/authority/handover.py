"""Recognises handovers by contact alone: the giver's gripper held the object, then both grippers, then the receiver's.

Anything else that touches the object in between (table, a third robot, a virtual hand, a free fall) makes it no
handover. Contacts flicker for single ticks, so a grip counts as lost only after `handover_flicker_ns`.
"""

from __future__ import annotations

from iris_session.authority.context import Context
from iris_session.authority.state import HandoverTrack
from iris_session.protocol.server_messages import Handover
from iris_session.protocol.steps import ObjectContact


def observe(ctx: Context) -> None:
    """Advances every object by the contacts of a new tick."""
    state = ctx.state
    if ctx.view.tick == state.handover_tick:
        return
    state.handover_tick = ctx.view.tick
    touched = {c.object: c for c in ctx.view.object_contacts() if c.object in ctx.objects}
    in_hand = [lease.target for lease in ctx.held_objects if lease.lead]
    for name in in_hand:
        state.handovers.pop(name, None)
    for name, contact in touched.items():
        if name not in in_hand:
            _advance(ctx, name, contact)
    for name in [n for n in state.handovers if n not in touched]:
        if ctx.now_ns - state.handovers[name].seen_ns > ctx.config.handover_flicker_ns:
            del state.handovers[name]


def _advance(ctx: Context, name: str, c: ObjectContact) -> None:
    track = ctx.state.handovers.get(name)
    pair = (track.giver, track.receiver or _second(c, track.giver)) if track is not None else ()
    if c.others or (track is not None and any(r not in pair for r in c.touching)):
        ctx.state.handovers.pop(name, None)
        return
    if track is None:
        if len(c.grippers) == 1 and c.touching == c.grippers:
            ctx.state.handovers[name] = HandoverTrack(c.grippers[0], ctx.now_ns, seen_ns=ctx.now_ns)
        return
    if any(r in c.grippers for r in pair):
        track.seen_ns = ctx.now_ns
    elif ctx.now_ns - track.seen_ns > ctx.config.handover_flicker_ns:
        del ctx.state.handovers[name]
        return
    _exchange(ctx, name, track, c)


def _second(c: ObjectContact, giver: str) -> str:
    """The first other robot that touches the object."""
    return next((r for r in c.touching if r != giver), "")


def _exchange(ctx: Context, name: str, track: HandoverTrack, c: ObjectContact) -> None:
    now, config = ctx.now_ns, ctx.config
    receiver = track.receiver or _second(c, track.giver)
    both = receiver != "" and track.giver in c.touching and receiver in c.touching
    if both and now - track.alone_ns >= config.handover_hold_ns:
        track.receiver = receiver
        track.both_from_ns = now if track.both_from_ns is None else track.both_from_ns
        track.both_until_ns = now
    if track.both_from_ns is None:
        if both:
            track.alone_ns = now  # touched by both before the giver held it long enough: start the hold again
        return
    if track.giver in c.touching:
        track.taken_ns = None
        if receiver not in c.touching and now - track.both_until_ns > config.handover_flicker_ns:
            track.receiver, track.both_from_ns, track.alone_ns = "", None, track.both_until_ns
        return
    if receiver not in c.grippers:
        return
    track.taken_ns = now if track.taken_ns is None else track.taken_ns
    if now - track.taken_ns >= config.handover_hold_ns:
        _announce(ctx, name, track)
        ctx.state.handovers[name] = HandoverTrack(receiver, track.taken_ns, seen_ns=now)


def _announce(ctx: Context, name: str, track: HandoverTrack) -> None:
    giver, receiver = (ctx.state.robots.get(robot) for robot in (track.giver, track.receiver))
    duration = track.both_until_ns - (track.both_from_ns or 0)
    people = [ctx.holder(lease) if lease is not None else "" for lease in (giver, receiver)]
    ctx.emit(Handover(name, track.giver, track.receiver, people[0], people[1], duration))
