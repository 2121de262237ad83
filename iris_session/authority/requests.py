"""Requests for leases: acquire (all or none), queue, consent, grasp, and a director's assign and set_mode.

No deadlock: a waiting request takes nothing until everything it wants is free, later requests do not overtake it, and
nobody waits while holding a robot. Every request gets exactly one reply, when it is decided.
"""

from __future__ import annotations

from typing import Final

from iris_session.authority import assignment, engagement, leases
from iris_session.authority.context import HUMAN, Context, find_grant, no_such, some
from iris_session.authority.leases import held_by_other
from iris_session.authority.state import KEPT, NO_CONNECTION, LeaseState, Participant, Pending
from iris_session.protocol.client_messages import Acquire, Assign, Consent, Grasp, SetMode
from iris_session.protocol.common import Denial
from iris_session.protocol.names import DenialReason, Device, HoldReason, LeaseMode, Role
from iris_session.protocol.server_messages import ConsentRequested

#: Weights of sharers differ by at most a factor of a million, so that normalising them is exact enough.
MIN_WEIGHT: Final = 1e-3


def acquire(ctx: Context, p: Participant, m: Acquire) -> None:
    """All or none of the named robots and objects; without names, what the assignment policy chooses."""
    if ctx.state.queue:
        advance(ctx)  # what was freed earlier in this step belongs to those who wait for it
    robots, objects = tuple(dict.fromkeys(m.robots)), tuple(dict.fromkeys(m.objects))
    denial = _acquire_denial(ctx, p, m, robots, objects)
    any_robot = not robots and not objects
    if denial is None and any_robot:
        chosen = assignment.choose(ctx, p, _free_robots(ctx, p))
        if isinstance(chosen, Denial):
            denial = chosen
        elif not chosen and not m.wait:
            denial = _none_free(ctx)
        else:
            robots, any_robot = chosen, not chosen
    if denial is not None:
        return ctx.deny(p, m.request_id, denial)
    pending = Pending(p.id, m.request_id, robots, objects, float(m.weight), any_robot)
    denial, consent = _obstacles(ctx, p, pending, ctx.state.queue)
    if denial is not None or any_robot:
        return _queue(ctx, p, pending, denial) if m.wait else ctx.deny(p, m.request_id, denial or _none_free(ctx))
    return _ask_consent(ctx, p, pending, consent) if consent else _fulfil(ctx, p, pending, "acquired")


def _acquire_denial(
    ctx: Context, p: Participant, m: Acquire, robots: tuple[str, ...], objects: tuple[str, ...]
) -> Denial | None:
    denial = _role_denial(p)
    if denial is not None:
        return denial
    for name in robots:
        if name not in ctx.robots:
            return no_such("robot", name, ctx.robots)
    for name in objects:
        if name not in ctx.objects:
            return no_such("object", name, ctx.objects)
    if not MIN_WEIGHT <= m.weight <= 1.0 / MIN_WEIGHT:
        text = f"weight {m.weight} is not between {MIN_WEIGHT} and {1.0 / MIN_WEIGHT:g}"
        return Denial(DenialReason.INVALID, text, "use 1.0")
    return assignment.permitted(ctx, p, robots) if robots else None


def _role_denial(p: Participant) -> Denial | None:
    if p.role in Role.DRIVING:
        return None
    may = ", ".join(sorted(Role.DRIVING))
    return Denial(DenialReason.ROLE, f"role {p.role} may not hold anything", f"join as one of: {may}")


def _none_free(ctx: Context) -> Denial:
    robots = list(ctx.state.robots.values())
    if not robots:
        return Denial(DenialReason.UNKNOWN_TARGET, "this session has no robots", "acquire objects by name")
    return held_by_other(ctx, robots[0], "no robot is free: ask a holder to release one")


def _free_robots(ctx: Context, p: Participant) -> list[str]:
    reserved = [name for waiting in ctx.state.queue if waiting.participant != p.id for name in waiting.robots]
    return [n for n, lease in ctx.state.robots.items() if not lease.grants and n not in reserved]


def _obstacles(
    ctx: Context, p: Participant, pending: Pending, ahead: list[Pending]
) -> tuple[Denial | None, list[LeaseState]]:
    """What stands in the way of a request: a denial, or the robots whose holders must consent."""
    consent: list[LeaseState] = []
    for name in pending.robots:
        lease = ctx.state.robots[name]
        if any(g.participant == p.id for g in lease.grants):
            continue
        if not lease.grants:
            if any(w.participant != p.id and name in w.robots for w in ahead):
                return held_by_other(ctx, lease), []
        elif lease.mode == LeaseMode.REQUEST:
            consent.append(lease)
        elif not _gives_way(ctx, p, lease):
            return held_by_other(ctx, lease), []
    for name in pending.objects:
        lease = ctx.state.objects[name]
        if find_grant(lease, p.id) is None and len(lease.grants) >= ctx.config.max_sub_holders:
            return held_by_other(ctx, lease), []
    return None, consent


def _gives_way(ctx: Context, p: Participant, lease: LeaseState) -> bool:
    """Whether the mode of a held robot lets `p` in at once."""
    if lease.mode == LeaseMode.TAKEOVER:
        return True
    if lease.mode == LeaseMode.SHARED:
        return len(lease.grants) < ctx.config.max_sub_holders
    if lease.mode == LeaseMode.PRIORITY:
        agent_alone = len(lease.grants) == 1 and ctx.state.participants[lease.grants[0].participant].role not in HUMAN
        return agent_alone and p.role in HUMAN
    return False


def _fulfil(ctx: Context, p: Participant, pending: Pending, cause: str) -> None:
    granted = []
    for name in pending.robots:
        lease = ctx.state.robots[name]
        taken = lease.mode == LeaseMode.TAKEOVER and lease.grants
        leases.grant(ctx, lease, p, "takeover" if taken else cause, pending.weight)
        granted.append(lease)
    for name in pending.objects:
        leases.grant(ctx, ctx.state.objects[name], p, "acquired")
        granted.append(ctx.state.objects[name])
    if pending.request_id != KEPT:
        ctx.accept(p, pending.request_id, granted)
    if pending.robots:
        leases.forget_requests(ctx, p, "you hold a robot now")


def _queue(ctx: Context, p: Participant, pending: Pending, denial: Denial | None) -> None:
    state = ctx.state
    held = [lease.target for lease in state.robots.values() if any(g.participant == p.id for g in lease.grants)]
    if held:
        text = f"who holds a robot cannot wait for another: you hold {some(held)}"
        denial = Denial(
            DenialReason.HELD, text, "release it and acquire all robots in one request", held[0], p.id, p.name
        )
        return ctx.deny(p, pending.request_id, denial)
    if _takes_kept_place(ctx, pending):
        return None
    if any(w.participant == p.id for w in state.queue) or len(state.queue) >= ctx.config.max_queue:
        full = Denial(DenialReason.QUEUE_FULL, "you wait already, or the queue is full", "release to leave the queue")
        return ctx.deny(p, pending.request_id, full)
    state.queue.append(pending)
    leases.publish_queues(ctx, pending)
    return None


def _takes_kept_place(ctx: Context, pending: Pending) -> bool:
    """Whether this is asked again by somebody whose place was kept; who asks for something else gives it up."""
    kept = next((w for w in ctx.state.queue if w.participant == pending.participant and w.request_id == KEPT), None)
    if kept is None:
        return False
    if _wish(kept) == _wish(pending):
        kept.request_id, kept.weight = pending.request_id, pending.weight
        return True
    leases.drop_request(ctx, kept)
    return False


def _wish(pending: Pending) -> tuple[object, ...]:
    return (pending.any_robot, () if pending.any_robot else pending.robots, pending.objects)


def advance(ctx: Context) -> None:
    """Grants what has become free, in the order of the requests, and ends consents that nobody answered.

    Who keeps a place and is not back yet is waited for.
    """
    for pending in tuple(ctx.state.consents):
        if not any(pending is other for other in ctx.state.consents):
            continue  # answered meanwhile: granting one request ends the others of its participant
        p = ctx.state.participants[pending.participant]
        for consent_id, name in tuple(pending.consents.items()):
            if not ctx.state.robots[name].grants:
                del pending.consents[consent_id]
        if not pending.consents:
            _consented(ctx, p, pending)
        elif ctx.now_ns >= pending.expires_ns:
            leases.drop_request(ctx, pending)
            text = f"no answer within {ctx.config.consent_timeout_ns / 1e9:g} s"
            ctx.deny(p, pending.request_id, Denial(DenialReason.CONSENT_REFUSED, text, "ask the holder in person"))
    ahead: list[Pending] = []
    for pending in tuple(ctx.state.queue):
        if not any(pending is other for other in ctx.state.queue):
            continue
        p = ctx.state.participants[pending.participant]
        if pending.any_robot:
            reserved = [name for w in ahead for name in w.robots]
            chosen = assignment.choose(ctx, p, [n for n in _unheld(ctx) if n not in reserved])
            pending.robots = () if isinstance(chosen, Denial) else chosen
            ready = bool(pending.robots)
        else:
            denial, consent = _obstacles(ctx, p, pending, ahead)
            ready = denial is None and not consent
        if ready and p.connection != NO_CONNECTION:
            leases.drop_request(ctx, pending)
            _fulfil(ctx, p, pending, "acquired")
        else:
            ahead.append(pending)


def _unheld(ctx: Context) -> list[str]:
    return [name for name, lease in ctx.state.robots.items() if not lease.grants]


# --- consent ---


def _ask_consent(ctx: Context, p: Participant, pending: Pending, robots: list[LeaseState]) -> None:
    asked = [name for other in ctx.state.consents for name in other.consents.values()]
    for lease in robots:
        if lease.target in asked:
            text = f"someone already asked for {lease.target}"
            denial = Denial(DenialReason.CONSENT_PENDING, text, "wait for the answer", lease.target, ctx.holder(lease))
            return ctx.deny(p, pending.request_id, denial)
    if any(other.participant == p.id for other in ctx.state.consents):
        text = "you asked already, and nobody has answered yet"
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
        ctx.emit(ConsentRequested(consent_id, lease.target, p.id, ctx.holder(lease)))
    ctx.state.consents.append(pending)
    return None


def consent(ctx: Context, p: Participant, m: Consent) -> None:
    """A holder's or director's answer to `consent_requested`."""
    pending = next((c for c in ctx.state.consents if m.consent_id in c.consents), None)
    if pending is None:
        text = f"no request {m.consent_id} waits for consent"
        return ctx.deny(p, m.request_id, Denial(DenialReason.UNKNOWN_REQUEST, text, "it was answered or timed out"))
    lease = ctx.state.robots[pending.consents[m.consent_id]]
    if p.role != Role.DIRECTOR and not any(g.participant == p.id for g in lease.grants):
        text = "only the holder or a director can consent"
        return ctx.deny(p, m.request_id, Denial(DenialReason.ROLE, text, "", lease.target, ctx.holder(lease)))
    requester = ctx.state.participants[pending.participant]
    ctx.accept(p, m.request_id)
    if not m.grant:
        leases.drop_request(ctx, pending)
        denial = Denial(DenialReason.CONSENT_REFUSED, f"{p.name} said no", "", lease.target, ctx.holder(lease))
        return ctx.deny(requester, pending.request_id, denial)
    del pending.consents[m.consent_id]
    pending.granted[lease.target] = ctx.holder(lease)
    return None if pending.consents else _consented(ctx, requester, pending)


def _consented(ctx: Context, p: Participant, pending: Pending) -> None:
    leases.drop_request(ctx, pending)
    denial, consent = _obstacles(ctx, p, pending, ctx.state.queue)
    # Consent is that of one holder: somebody may have taken one of the robots since.
    unasked = [lease for lease in consent if pending.granted.get(lease.target) != ctx.holder(lease)]
    if denial is None and unasked:
        denial = held_by_other(ctx, unasked[0])
    if denial is not None:
        ctx.deny(p, pending.request_id, denial)
    else:
        _fulfil(ctx, p, pending, "consent")


# --- objects and directors ---


def grasp(ctx: Context, p: Participant, m: Grasp) -> None:
    """A hand takes a free object; several hands may hold one."""
    denial = _role_denial(p)
    lease = ctx.state.objects.get(m.object)
    if denial is None and lease is None:
        denial = no_such("object", m.object, ctx.objects)
    if denial is None and m.device not in Device.ALL:
        known = f"devices: {', '.join(sorted(Device.ALL))}"
        denial = Denial(DenialReason.UNKNOWN_VALUE, f"unknown device {m.device}", known)
    if denial is None and p.alignment is None:
        denial = Denial(DenialReason.UNALIGNED, "your headset is not aligned", "look at an anchor sheet", m.object)
    if denial is not None or lease is None:
        return ctx.deny(p, m.request_id, denial) if denial is not None else None
    own = any(g.participant == p.id and g.hand == m.device for g in lease.grants)
    if not own and len(lease.grants) >= ctx.config.max_sub_holders:
        return ctx.deny(p, m.request_id, held_by_other(ctx, lease))
    leases.grant(ctx, lease, p, "acquired", hand=m.device)
    return ctx.accept(p, m.request_id, (lease,))


def assign(ctx: Context, p: Participant, m: Assign) -> None:
    """A director gives robots to a participant, or frees them."""
    person = ctx.person(m.participant) if m.participant else None
    if m.participant and person is None:
        text = f"no participant {m.participant}"
        return ctx.deny(p, m.request_id, Denial(DenialReason.UNKNOWN_PARTICIPANT, text, "use an id of the roster"))
    denial = _role_denial(person) if person is not None else None
    unknown = next((name for name in m.robots if name not in ctx.robots), None)
    if unknown is not None:
        denial = no_such("robot", unknown, ctx.robots)
    if denial is not None:
        return ctx.deny(p, m.request_id, denial)
    chosen = [ctx.state.robots[name] for name in dict.fromkeys(m.robots)]
    for lease in chosen:
        if person is not None:
            leases.grant(ctx, lease, person, "assigned")
        elif lease.grants:
            previous = ctx.holder(lease)
            leases.clear(ctx, lease)
            ctx.publish(lease, "assigned", previous)
    if person is not None and chosen:
        leases.forget_requests(ctx, person, "a director assigned you a robot")
    return ctx.accept(p, m.request_id, chosen)


def set_mode(ctx: Context, p: Participant, m: SetMode) -> None:
    """A director changes the mode of a robot. Of several holders only the one in charge stays, unless it is shared."""
    lease = ctx.state.robots.get(m.robot)
    if lease is None:
        return ctx.deny(p, m.request_id, no_such("robot", m.robot, ctx.robots))
    if m.mode not in LeaseMode.ALL:
        known = f"modes: {', '.join(sorted(LeaseMode.ALL))}"
        return ctx.deny(p, m.request_id, Denial(DenialReason.UNKNOWN_VALUE, f"unknown mode {m.mode}", known))
    if m.mode != lease.mode:
        in_charge = ctx.holder(lease)
        if lease.override:
            engagement.give_back(ctx, lease)
        if m.mode != LeaseMode.SHARED:
            for g in [g for g in lease.grants if g.participant != in_charge]:
                leases.revoke(ctx, lease, g)
        for g in lease.grants:
            engagement.rearm(ctx, lease, g, HoldReason.REARM)
        lease.mode = m.mode
        ctx.publish(lease, "mode", in_charge)
    return ctx.accept(p, m.request_id, (lease,))
