"""Requests for leases: acquire (all or none), queue, consent, grasp, a director's assign and set_mode, motion scaling.

No deadlock: a waiting request takes nothing until everything it wants is free, later requests do not overtake it, and
no holder of a robot may wait for another. Every request gets exactly one reply, when it is decided or withdrawn.

Motion scaling is how far a robot moves as its holder's hand moves. It belongs to the grant, so it ends with it. The
scale of a robot is that of the grant in charge (`Context.get_scale`). In mode `shared` one scale is set for all
sharers, and a new one inherits it. In mode `priority` agent and human each keep their own, so an intervention at a
tenth of the speed leaves the agent's alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from iris_session.authority import alignment, assignment, engagement, leases
from iris_session.authority.context import (
    HUMAN,
    Context,
    build_absent_denial,
    build_unknown_denial,
    build_value_denial,
    find_grant,
    join_names,
)
from iris_session.authority.leases import build_held_denial
from iris_session.authority.state import NO_CONNECTION, NO_REPLY, LeaseGrant, LeaseState, Participant, Pending
from iris_session.protocol.client_messages import Acquire, Assign, Consent, Grasp, SetMode, SetScale, Withdraw
from iris_session.protocol.common import Denial
from iris_session.protocol.names import AlignmentKind, DenialReason, Device, HoldReason, LeaseMode, Role
from iris_session.protocol.server_messages import ConsentRequested, ScaleChanged

#: Weights of sharers differ by at most a factor of a million, so that normalising them is exact enough.
MIN_WEIGHT: Final = 1e-3


def acquire_targets(ctx: Context, p: Participant, m: Acquire) -> None:
    """Acquire all or none of the named robots and objects; without names, those that the assignment policy chooses."""
    if ctx.state.queue:
        advance_requests(ctx)  # robots freed earlier in this step belong to the queue
    robots, objects = tuple(dict.fromkeys(m.robots)), tuple(dict.fromkeys(m.objects))
    denial = _check_acquire(ctx, p, m, robots, objects)
    any_robot = not robots and not objects
    if denial is None and any_robot:
        reserved = [name for w in ctx.state.queue if w.participant != p.id for name in w.robots]
        chosen = _choose_robots(ctx, p, reserved)
        if isinstance(chosen, Denial):
            denial = chosen
        elif not chosen and not m.wait:
            denial = _build_none_free_denial(ctx)
        else:
            robots, any_robot = chosen, not chosen
    if denial is not None:
        return ctx.deny(p, m.request_id, denial)
    pending = Pending(p.id, m.request_id, robots, objects, float(m.weight), any_robot)
    denial, consent = _find_obstacles(ctx, p, pending, ctx.state.queue)
    if denial is not None or any_robot:
        return (
            _enqueue_request(ctx, p, pending, denial)
            if m.wait
            else ctx.deny(p, m.request_id, denial or _build_none_free_denial(ctx))
        )
    return _ask_consent(ctx, p, pending, consent) if consent else _grant_request(ctx, p, pending, "acquired")


def _check_acquire(
    ctx: Context, p: Participant, m: Acquire, robots: tuple[str, ...], objects: tuple[str, ...]
) -> Denial | None:
    denial = _check_role(p)
    if denial is not None:
        return denial
    for name in robots:
        if name not in ctx.robots:
            return build_unknown_denial("robot", name, ctx.robots)
    for name in objects:
        if name not in ctx.objects:
            return build_unknown_denial("object", name, ctx.objects)
    if not MIN_WEIGHT <= m.weight <= 1.0 / MIN_WEIGHT:
        text = f"weight {m.weight} is not between {MIN_WEIGHT} and {1.0 / MIN_WEIGHT:g}"
        return Denial(DenialReason.INVALID, text, "use 1.0")
    return assignment.check_policy(ctx, p, robots) if robots else None


def _check_role(p: Participant) -> Denial | None:
    if p.role in Role.DRIVING:
        return None
    may = ", ".join(sorted(Role.DRIVING))
    return Denial(DenialReason.ROLE, f"role {p.role} may not hold anything", f"join as one of: {may}")


def _build_none_free_denial(ctx: Context) -> Denial:
    robots = list(ctx.state.robots.values())
    if not robots:
        return Denial(DenialReason.UNKNOWN_TARGET, "this session has no robots", "acquire objects by name")
    return build_held_denial(ctx, robots[0], "no robot is free: ask a holder to release one")


def _choose_robots(ctx: Context, p: Participant, reserved: list[str]) -> tuple[str, ...] | Denial:
    """Return what the policy chooses for a participant that names no robot: one that is free and not `reserved`, else
    one of an agent that `p` may preempt. Empty: there is none.
    """
    robots = [lease for name, lease in ctx.state.robots.items() if name not in reserved]
    chosen = assignment.choose_robots(ctx, p, [lease.target for lease in robots if not lease.grants])
    if chosen != ():
        return chosen
    preempted = [r.target for r in robots if r.mode == LeaseMode.PRIORITY and r.grants and _admits_at_once(ctx, p, r)]
    return assignment.choose_robots(ctx, p, preempted)


def _find_obstacles(
    ctx: Context, p: Participant, pending: Pending, ahead: list[Pending]
) -> tuple[Denial | None, list[LeaseState]]:
    """Return what prevents a request: a denial, or the robots whose holders must consent."""
    consent: list[LeaseState] = []
    for name in pending.robots:
        lease = ctx.state.robots[name]
        if any(g.participant == p.id for g in lease.grants):
            continue
        if not lease.grants:
            if any(w.participant != p.id and name in w.robots for w in ahead):
                return build_held_denial(ctx, lease), []
        elif lease.mode == LeaseMode.REQUEST:
            consent.append(lease)
        elif not _admits_at_once(ctx, p, lease):
            in_hand = lease.mode == LeaseMode.TAKEOVER
            return (_build_in_hand_denial if in_hand else build_held_denial)(ctx, lease), []
    for name in pending.objects:
        lease = ctx.state.objects[name]
        if find_grant(lease, p.id) is None and len(lease.grants) >= ctx.config.max_sub_holders:
            return build_held_denial(ctx, lease), []
    return None, consent


def _admits_at_once(ctx: Context, p: Participant, lease: LeaseState) -> bool:
    """Return true when the mode of a held robot admits `p` at once."""
    if lease.mode == LeaseMode.TAKEOVER:
        return p.role in HUMAN or not _is_in_hand(ctx, lease)
    if lease.mode == LeaseMode.SHARED:
        return len(lease.grants) < ctx.config.max_sub_holders
    if lease.mode == LeaseMode.PRIORITY:
        agent_alone = len(lease.grants) == 1 and ctx.state.participants[lease.grants[0].participant].role not in HUMAN
        return agent_alone and p.role in HUMAN
    return False


def _is_in_hand(ctx: Context, lease: LeaseState) -> bool:
    """Return true while a human drives, or has not let go: the engagement ended otherwise than by an open clutch, or
    that has been open for less than `intervention_idle_ns` (to reach further).

    In mode `takeover` an agent waits for it: a human who has lost the robot cannot preempt the agent.
    """
    people = [g for g in lease.grants if ctx.state.participants[g.participant].role in HUMAN]
    return any(g.device and not engagement.is_standing_by(ctx, g) for g in people)


def _build_in_hand_denial(ctx: Context, lease: LeaseState) -> Denial:
    seconds = ctx.config.intervention_idle_ns / 1e9
    action = f"ask the holder to release it, or to keep the clutch open for {seconds:g} s"
    return build_held_denial(ctx, lease, action)


def _grant_request(ctx: Context, p: Participant, pending: Pending, cause: str) -> None:
    granted = []
    for name in pending.robots:
        lease = ctx.state.robots[name]
        taken = lease.mode == LeaseMode.TAKEOVER and lease.grants
        why = "takeover" if taken else cause
        leases.grant_lease(ctx, lease, p, why, pending.weight, request_id=pending.request_id)
        granted.append(lease)
    for name in pending.objects:
        leases.grant_lease(ctx, ctx.state.objects[name], p, "acquired", request_id=pending.request_id)
        granted.append(ctx.state.objects[name])
    if pending.request_id != NO_REPLY:
        ctx.accept(p, pending.request_id, granted)
    if pending.robots:
        leases.cancel_requests(ctx, p, "you hold a robot now")


def _enqueue_request(ctx: Context, p: Participant, pending: Pending, denial: Denial | None) -> None:
    state = ctx.state
    held = _list_held_robots(ctx, p)
    if held:
        text = f"who holds a robot cannot wait for another: you hold {join_names(held)}"
        denial = Denial(
            DenialReason.HELD, text, "release it and acquire all robots in one request", held[0], p.id, p.name
        )
        return ctx.deny(p, pending.request_id, denial)
    if _resume_kept_place(ctx, pending):
        return None
    if any(w.participant == p.id for w in state.queue) or len(state.queue) >= ctx.config.max_queue:
        full = Denial(DenialReason.QUEUE_FULL, "you wait already, or the queue is full", "release to leave the queue")
        return ctx.deny(p, pending.request_id, full)
    state.queue.append(pending)
    leases.publish_queues(ctx, pending)
    return None


def _resume_kept_place(ctx: Context, pending: Pending) -> bool:
    """Return true when `pending` repeats the request whose place was kept; any other request gives that place up."""
    kept = next((w for w in ctx.state.queue if w.participant == pending.participant and w.request_id == NO_REPLY), None)
    if kept is None:
        return False
    keys = [(w.any_robot, () if w.any_robot else w.robots, w.objects) for w in (kept, pending)]
    if keys[0] == keys[1]:
        kept.request_id, kept.weight = pending.request_id, pending.weight
        return True
    leases.remove_request(ctx, kept)
    return False


def advance_requests(ctx: Context) -> None:
    """Grant what has become free, in the order of the requests, and end consents that timed out.

    A kept place of a disconnected participant blocks those behind it.
    """
    for pending in tuple(ctx.state.consents):
        if not any(pending is other for other in ctx.state.consents):
            continue  # answered meanwhile: granting one request ends the others of its participant
        p = ctx.state.participants[pending.participant]
        for consent_id, name in tuple(pending.consents.items()):
            if not ctx.state.robots[name].grants:
                del pending.consents[consent_id]
        if not pending.consents:
            _complete_consent(ctx, p, pending)
        elif ctx.now_ns >= pending.expires_ns:
            leases.remove_request(ctx, pending)
            text = f"no answer within {ctx.config.consent_timeout_ns / 1e9:g} s"
            ctx.deny(p, pending.request_id, Denial(DenialReason.CONSENT_REFUSED, text, "ask the holder in person"))
    ahead: list[Pending] = []
    for pending in tuple(ctx.state.queue):
        if not any(pending is other for other in ctx.state.queue):
            continue
        p = ctx.state.participants[pending.participant]
        if pending.any_robot:
            reserved = [name for w in ahead for name in w.robots]
            chosen = _choose_robots(ctx, p, reserved)
            pending.robots = () if isinstance(chosen, Denial) else chosen
            ready = bool(pending.robots)
        else:
            denial, consent = _find_obstacles(ctx, p, pending, ahead)
            ready = denial is None and not consent
        if ready and p.connection != NO_CONNECTION:
            leases.remove_request(ctx, pending)
            _grant_request(ctx, p, pending, "acquired")
        else:
            ahead.append(pending)


def withdraw_request(ctx: Context, p: Participant, m: Withdraw) -> None:
    """Take back an `acquire` that has no reply yet, or whose reply its sender has not seen: what it granted is
    released.
    """
    for pending in (*ctx.state.queue, *ctx.state.consents):
        if pending.participant == p.id and pending.request_id == m.acquire_request_id:
            denial = _build_withdrawn_denial(ctx, pending)
            leases.remove_request(ctx, pending)
            ctx.deny(p, pending.request_id, denial)
            return ctx.accept(p, m.request_id)
    return ctx.accept(p, m.request_id, leases.release_request(ctx, p, m.acquire_request_id))


def _build_withdrawn_denial(ctx: Context, pending: Pending) -> Denial:
    """Return the denial of a request that was withdrawn: what it waited for, and the holder."""
    wanted = ctx.state.robots if pending.any_robot else pending.robots
    held = next((lease for lease in map(ctx.state.robots.__getitem__, wanted) if lease.grants), None)
    holder = "" if held is None else ctx.get_holder(held)
    target = "" if held is None else held.target
    if pending.consents:
        text = f"withdrawn before the holder of {join_names(pending.consents.values())} has answered"
    else:
        line = [w for w in ctx.state.queue if w.any_robot or pending.any_robot or {*w.robots} & {*pending.robots}]
        place = next((i for i, w in enumerate(line, 1) if w is pending), 0)
        names = "any robot" if pending.any_robot else join_names(pending.robots or pending.objects)
        text = f"withdrawn at place {place} of {len(line)} in the queue for {names}"
    name = ctx.state.participants[holder].name if holder else ""
    return Denial(DenialReason.WITHDRAWN, text, "ask the holder to release it", target, holder, name)


# --- consent ---


def _ask_consent(ctx: Context, p: Participant, pending: Pending, robots: list[LeaseState]) -> None:
    asked = [name for other in ctx.state.consents for name in other.consents.values()]
    for lease in robots:
        if lease.target in asked:
            text = f"someone already asked for {lease.target}"
            denial = Denial(
                DenialReason.CONSENT_PENDING, text, "wait for the answer", lease.target, ctx.get_holder(lease)
            )
            return ctx.deny(p, pending.request_id, denial)
    if any(other.participant == p.id for other in ctx.state.consents):
        text = "you asked already, and there is no answer yet"
        denial = Denial(DenialReason.CONSENT_PENDING, text, "wait for the answer, or release to take it back")
        return ctx.deny(p, pending.request_id, denial)
    if len(ctx.state.consents) >= ctx.config.max_consents:
        denial = Denial(DenialReason.QUEUE_FULL, "too many requests wait for consent", "try again in a few seconds")
        return ctx.deny(p, pending.request_id, denial)
    pending.expires_ns = ctx.now_ns + ctx.config.consent_timeout_ns
    for lease in robots:
        consent_id = ctx.state.next_consent
        ctx.state.next_consent += 1
        pending.consents[consent_id] = lease.target
        ctx.emit(ConsentRequested(consent_id, lease.target, p.id, ctx.get_holder(lease)))
    ctx.state.consents.append(pending)
    return None


def answer_consent(ctx: Context, p: Participant, m: Consent) -> None:
    """Process a holder's or director's answer to `consent_requested`."""
    pending = next((c for c in ctx.state.consents if m.consent_id in c.consents), None)
    if pending is None:
        text = f"no request {m.consent_id} waits for consent"
        return ctx.deny(p, m.request_id, Denial(DenialReason.UNKNOWN_REQUEST, text, "it was answered or timed out"))
    lease = ctx.state.robots[pending.consents[m.consent_id]]
    if p.role != Role.DIRECTOR and not any(g.participant == p.id for g in lease.grants):
        text = "only the holder or a director can consent"
        return ctx.deny(p, m.request_id, Denial(DenialReason.ROLE, text, "", lease.target, ctx.get_holder(lease)))
    requester = ctx.state.participants[pending.participant]
    ctx.accept(p, m.request_id)
    if not m.grant:
        leases.remove_request(ctx, pending)
        denial = Denial(DenialReason.CONSENT_REFUSED, f"{p.name} said no", "", lease.target, ctx.get_holder(lease))
        return ctx.deny(requester, pending.request_id, denial)
    del pending.consents[m.consent_id]
    pending.granted[lease.target] = ctx.get_holder(lease)
    return None if pending.consents else _complete_consent(ctx, requester, pending)


def _complete_consent(ctx: Context, p: Participant, pending: Pending) -> None:
    leases.remove_request(ctx, pending)
    denial, consent = _find_obstacles(ctx, p, pending, ctx.state.queue)
    # Consent is that of one holder: one of the robots may have another holder since.
    unasked = [lease for lease in consent if pending.granted.get(lease.target) != ctx.get_holder(lease)]
    if denial is None and unasked:
        denial = build_held_denial(ctx, unasked[0])
    if denial is not None:
        ctx.deny(p, pending.request_id, denial)
    else:
        _grant_request(ctx, p, pending, "consent")


# --- objects and directors ---


def grasp_object(ctx: Context, p: Participant, m: Grasp) -> None:
    """Grant a free object to a hand; several hands may hold one."""
    denial = _check_role(p)
    lease = ctx.state.objects.get(m.object)
    if denial is None and lease is None:
        denial = build_unknown_denial("object", m.object, ctx.objects)
    if denial is None and m.device not in Device.ALL:
        denial = build_value_denial("device", m.device, Device.ALL)
    if denial is None and p.alignment is None:
        denial = Denial(DenialReason.UNALIGNED, "your headset is not aligned", "look at an anchor sheet", m.object)
    if denial is None and p.alignment is not None and p.alignment.kind in AlignmentKind.VIEW_ONLY:
        why, advice = alignment.advise_view_only(p)
        denial = Denial(DenialReason.VIEW_ONLY, f"{p.name} can look, not drive: {why}", advice, m.object)
    if denial is None and not (p.needs_alignment or alignment.may_be_unaligned(ctx, p.role, p.key_id, m.device)):
        text = f"you may not use {m.device} without an alignment"
        denial = Denial(DenialReason.UNALIGNED, text, alignment.UNALIGNED_ADVICE, m.object)
    if denial is not None or lease is None:
        return ctx.deny(p, m.request_id, denial) if denial is not None else None
    own = any(g.participant == p.id and g.hand == m.device for g in lease.grants)
    if not own and len(lease.grants) >= ctx.config.max_sub_holders:
        return ctx.deny(p, m.request_id, build_held_denial(ctx, lease))
    leases.grant_lease(ctx, lease, p, "acquired", hand=m.device)
    return ctx.accept(p, m.request_id, (lease,))


def assign_robots(ctx: Context, p: Participant, m: Assign) -> None:
    """Assign robots to a participant for a director, or free them."""
    person = ctx.find_participant(m.participant) if m.participant else None
    if m.participant and person is None:
        return ctx.deny(p, m.request_id, build_absent_denial(m.participant))
    denial = _check_role(person) if person is not None else None
    unknown = next((name for name in m.robots if name not in ctx.robots), None)
    if unknown is not None:
        denial = build_unknown_denial("robot", unknown, ctx.robots)
    if denial is not None:
        return ctx.deny(p, m.request_id, denial)
    chosen = [ctx.state.robots[name] for name in dict.fromkeys(m.robots)]
    for lease in chosen:
        if person is not None:
            leases.grant_lease(ctx, lease, person, "assigned")
        elif lease.grants:
            previous = ctx.get_holder(lease)
            leases.revoke_all(ctx, lease)
            ctx.publish_lease(lease, "assigned", previous)
    if person is not None and chosen:
        leases.cancel_requests(ctx, person, "a director assigned you a robot")
    return ctx.accept(p, m.request_id, chosen)


def set_mode(ctx: Context, p: Participant, m: SetMode) -> None:
    """Change the mode of a robot for a director. Of several holders only the one in charge stays, unless it is
    shared.
    """
    lease = ctx.state.robots.get(m.robot)
    if lease is None:
        return ctx.deny(p, m.request_id, build_unknown_denial("robot", m.robot, ctx.robots))
    if m.mode not in LeaseMode.ALL:
        return ctx.deny(p, m.request_id, build_value_denial("mode", m.mode, LeaseMode.ALL))
    if m.mode != lease.mode:
        in_charge = ctx.get_holder(lease)
        if lease.override:
            engagement.end_intervention(ctx, lease)
        if m.mode != LeaseMode.SHARED:
            for g in [g for g in lease.grants if g.participant != in_charge]:
                leases.revoke_grant(ctx, lease, g)
        for g in lease.grants:
            engagement.rearm_grant(ctx, lease, g, HoldReason.REARM)
        lease.mode = m.mode
        ctx.publish_lease(lease, "mode", in_charge)
    return ctx.accept(p, m.request_id, (lease,))


# --- motion scaling ---


def set_scale(ctx: Context, p: Participant, m: SetScale) -> None:
    """Set the scale of a holder's own grants, for a director that of the grant in charge; all robots or none."""
    low, high = ctx.config.min_scale, ctx.config.max_scale
    if not low <= m.scale <= high:  # a scale that is no number is in no range
        advice = f"use a scale from {low:g} to {high:g}"
        return ctx.deny(p, m.request_id, Denial(DenialReason.INVALID, f"scale {m.scale:g} is out of range", advice))
    names = tuple(dict.fromkeys(m.robots)) or tuple(_list_held_robots(ctx, p))
    denial = _check_scale_targets(ctx, p, names)
    if denial is not None:
        return ctx.deny(p, m.request_id, denial)
    chosen = [ctx.state.robots[name] for name in names]
    for lease in chosen:
        before = ctx.get_scale(lease)
        for g in _list_scaled_grants(ctx, p, lease):
            g.scale = float(m.scale)
        if ctx.get_scale(lease) != before:
            ctx.emit(ScaleChanged(lease.target, ctx.get_scale(lease), p.id))
    return ctx.accept(p, m.request_id, chosen)


def _list_held_robots(ctx: Context, p: Participant) -> list[str]:
    return [n for n, lease in ctx.state.robots.items() if any(g.participant == p.id for g in lease.grants)]


def _check_scale_targets(ctx: Context, p: Participant, names: Sequence[str]) -> Denial | None:
    if not names:
        return Denial(DenialReason.NOT_HOLDER, "you hold no robot", "acquire one first, or name robots")
    for name in names:
        lease = ctx.state.robots.get(name)
        if lease is None:
            return build_unknown_denial("robot", name, ctx.robots)
        if not _list_scaled_grants(ctx, p, lease):
            holder = ctx.get_holder(lease)
            held_by = ctx.state.participants[holder].name if holder else ""
            advice = "acquire it first, or ask its holder" if holder else "acquire it first"
            text = f"{name} is held by {held_by}" if holder else f"{name} is free"
            return Denial(DenialReason.NOT_HOLDER, text, advice, name, holder, held_by)
    return None


def _list_scaled_grants(ctx: Context, p: Participant, lease: LeaseState) -> list[LeaseGrant]:
    """Return the grants whose scale `p` sets; empty when it may not."""
    own = [g for g in lease.grants if g.participant == p.id]
    if lease.mode == LeaseMode.SHARED and (own or p.role == Role.DIRECTOR):
        return lease.grants
    if own or p.role != Role.DIRECTOR:
        return own
    return [g for g in lease.grants if g.participant == ctx.get_holder(lease)]
