"""Handover detection by contact alone: the giver's gripper held the object, then both grippers, then the receiver's.

Anything else that touches the object in between (table, a third robot, a virtual hand, a free fall) makes it no
handover. Contacts flicker for single ticks, so a grip counts as lost only after `handover_flicker_ns`.

Two arms of one person are one giver, or one receiver. So every object is followed twice: from person to person, where
an arm stands for the other one of its holder, and from arm to arm, for a regrasp between the two arms of one person.
"""

from __future__ import annotations

from iris_session.authority.context import Context
from iris_session.authority.state import HandoverTrack
from iris_session.protocol.server_messages import Handover
from iris_session.protocol.steps import ObjectContact


def track_handovers(ctx: Context) -> None:
    """Advance the tracks of every object by the contacts of a new tick."""
    state = ctx.state
    if ctx.view.tick == state.handover_tick:
        return
    state.handover_tick = ctx.view.tick
    touched = {c.object: c for c in ctx.view.object_contacts() if c.object in ctx.objects}
    in_hand = [lease.target for lease in ctx.held_objects if lease.lead]
    for tracks in (state.handovers, state.regrasps):
        for name in in_hand:
            tracks.pop(name, None)
        for name in [n for n in tracks if n not in touched]:
            if ctx.now_ns - tracks[name].seen_ns > ctx.config.handover_flicker_ns:
                del tracks[name]
    for name, contact in touched.items():
        if contact.others:  # most objects of a session lie on something
            state.handovers.pop(name, None)
            state.regrasps.pop(name, None)
        elif name not in in_hand:
            _advance_track(ctx, state.handovers, _merge_arms_by_person(ctx, state.handovers.get(name), contact))
            _advance_track(ctx, state.regrasps, contact)


def _merge_arms_by_person(ctx: Context, track: HandoverTrack | None, c: ObjectContact) -> ObjectContact:
    """Return the contact with one arm per person: the one in `track`, else the first that touches."""
    if len(c.touching) < 2 and track is None:
        return c
    arms: dict[str, str] = {}  # person, or a free robot -> the arm that stands for them
    if track is not None:
        # The arm that still touches stands for one that released: it is the one that gives, or takes.
        track.giver = _find_touching_arm(ctx, track.giver, c)
        track.receiver = _find_touching_arm(ctx, track.receiver, c)
        for robot in (track.receiver, track.giver):
            if robot:
                arms[_get_person(ctx, robot)] = robot
    for robot in (*c.grippers, *c.touching):
        arms.setdefault(_get_person(ctx, robot), robot)
    grippers, touching = (
        tuple(dict.fromkeys(arms[_get_person(ctx, robot)] for robot in robots)) for robots in (c.grippers, c.touching)
    )
    return ObjectContact(c.object, grippers, touching, c.others)


def _find_touching_arm(ctx: Context, robot: str, c: ObjectContact) -> str:
    """Return `robot` while it touches, else another arm of the same person that does."""
    if not robot or robot in c.touching:
        return robot
    person = _get_person(ctx, robot)
    return next((other for other in (*c.grippers, *c.touching) if _get_person(ctx, other) == person), robot)


def _get_person(ctx: Context, robot: str) -> str:
    """Return the holder of a robot; a free robot stands for itself."""
    return _get_holder(ctx, robot) or f"robot {robot}"


def _get_holder(ctx: Context, robot: str) -> str:
    lease = ctx.state.robots.get(robot)
    return "" if lease is None else ctx.get_holder(lease)


def _advance_track(ctx: Context, tracks: dict[str, HandoverTrack], c: ObjectContact) -> None:
    track = tracks.get(c.object)
    pair = (track.giver, track.receiver or _find_second_robot(c, track.giver)) if track is not None else ()
    if track is not None and any(r not in pair for r in c.touching):
        tracks.pop(c.object, None)
        return
    if track is None:
        if len(c.grippers) == 1 and c.touching == c.grippers:
            tracks[c.object] = HandoverTrack(c.grippers[0], ctx.now_ns, seen_ns=ctx.now_ns)
        return
    if any(r in c.grippers for r in pair):
        track.seen_ns = ctx.now_ns
    elif ctx.now_ns - track.seen_ns > ctx.config.handover_flicker_ns:
        del tracks[c.object]
        return
    if _update_exchange(ctx, track, c):
        _emit_handover(ctx, c.object, track, own=tracks is ctx.state.regrasps)
        tracks[c.object] = HandoverTrack(track.receiver, track.taken_ns or 0, seen_ns=ctx.now_ns)


def _find_second_robot(c: ObjectContact, giver: str) -> str:
    """Return the first other robot that touches the object."""
    return next((r for r in c.touching if r != giver), "")


def _update_exchange(ctx: Context, track: HandoverTrack, c: ObjectContact) -> bool:
    """Advance the exchange; return true when the receiver has had the object alone for long enough."""
    now, config = ctx.now_ns, ctx.config
    receiver = track.receiver or _find_second_robot(c, track.giver)
    both = receiver != "" and track.giver in c.touching and receiver in c.touching
    if both and now - track.alone_ns >= config.handover_hold_ns:
        track.receiver = receiver
        track.both_from_ns = now if track.both_from_ns is None else track.both_from_ns
        track.both_until_ns = now
    if track.both_from_ns is None:
        if both:
            track.alone_ns = now  # touched by both before the giver held it long enough: start the hold again
        return False
    if track.giver in c.touching:
        track.taken_ns = None
        if receiver not in c.touching and now - track.both_until_ns > config.handover_flicker_ns:
            track.receiver, track.both_from_ns, track.alone_ns = "", None, track.both_until_ns
        return False
    if receiver not in c.grippers:
        return False
    track.taken_ns = now if track.taken_ns is None else track.taken_ns
    return now - track.taken_ns >= config.handover_hold_ns


def _emit_handover(ctx: Context, name: str, track: HandoverTrack, *, own: bool) -> None:
    """Emit the event. `own`: tracked from arm to arm, which counts only between two arms of one person."""
    giver, receiver = _get_holder(ctx, track.giver), _get_holder(ctx, track.receiver)
    if own != (giver == receiver != ""):
        return
    duration = track.both_until_ns - (track.both_from_ns or 0)
    ctx.emit(Handover(name, track.giver, track.receiver, giver, receiver, duration))
