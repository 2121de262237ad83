"""Membership: join, resume, lost connections, heartbeats, grace and expiry."""

from __future__ import annotations

from typing import Final

from iris_session.authority import anchoring, assignment, corrections, engagement, leases
from iris_session.authority.context import Context
from iris_session.authority.state import HOST_ID, NO_CONNECTION, Participant
from iris_session.protocol.client_messages import RemoveParticipant
from iris_session.protocol.common import IDENTITY, MAX_TEXT, Alignment, Denial
from iris_session.protocol.entries import HOST, Join
from iris_session.protocol.names import AlignmentKind, AuditKind, DenialReason, HoldReason, RefusalCode, Role
from iris_session.protocol.server_messages import AlignmentRun, Audited, ParticipantJoined, ParticipantLeft, Snapshot
from iris_session.protocol.steps import Admitted, Dropped

NOT_NEEDED: Final = Alignment(0, AlignmentKind.NOT_NEEDED, IDENTITY)
#: A client sends the capability `run:<random>`, made anew at every start of its tracking, to keep its alignment when
#: only the connection broke. A client that does not must be aligned again after a resume.
RUN_PREFIX: Final = "run:"

#: A goodbye is free text, the reason of `participant_left` is as short as a name on the wire.
MAX_REASON: Final = 64


def host() -> Participant:
    """The process that owns the session: a director that never joins, times out or leaves."""
    p = Participant(HOST_ID, HOST_ID, Role.DIRECTOR, "", HOST, False, 0)
    p.alignment = NOT_NEEDED
    return p


def join(ctx: Context, connection: int, m: Join) -> None:
    """Lets a connection in, or answers `Refused` with a code of `DenialReason` or `RefusalCode`."""
    state = ctx.state
    if connection in ctx.by_connection or connection <= state.last_connection:
        return ctx.refuse(connection, DenialReason.ALREADY_JOINED, f"connection {connection} was used before")
    state.last_connection = connection
    if m.role not in Role.ALL:
        known = ", ".join(sorted(Role.ALL))
        return ctx.refuse(connection, DenialReason.UNKNOWN_VALUE, f"unknown role {m.role}", f"roles: {known}")
    if m.alignment not in (AlignmentKind.MEASURED, AlignmentKind.NOT_NEEDED):
        text, known = f"unknown alignment {m.alignment}", f"{AlignmentKind.MEASURED}, {AlignmentKind.NOT_NEEDED}"
        return ctx.refuse(connection, DenialReason.UNKNOWN_VALUE, text, known)
    if m.roles and m.role not in m.roles:
        ctx.emit(Audited(AuditKind.ROLE_REFUSED, m.key_id, m.name, "", m.role))
        text = f"this key may not join as {m.role}"
        return ctx.refuse(connection, DenialReason.ROLE, text, f"its roles: {', '.join(m.roles)}")
    if m.gateway:
        gateway = ctx.by_connection.get(m.gateway)
        if gateway is None or gateway.role != Role.GATEWAY:
            text = f"connection {m.gateway} may not speak for others"
            return ctx.refuse(connection, RefusalCode.GATEWAY_ONLY, text, "join with role gateway")
    old = state.participants.get(m.resume_of) if m.resume_of != HOST_ID else None
    if old is not None:
        return _resume(ctx, connection, m, old)
    if len(state.participants) > ctx.config.max_participants and not _evict(ctx):
        text = f"the session is full: {ctx.config.max_participants} participants"
        return ctx.refuse(connection, DenialReason.SESSION_FULL, text, "wait until somebody leaves")
    p = Participant(
        f"p{state.next_participant}", m.name, m.role, m.key_id, connection, m.alignment == AlignmentKind.MEASURED, 0
    )
    state.next_participant += 1
    state.participants[p.id] = p
    return _admit(ctx, p, connection, m, resumed=False)


def _resume(ctx: Context, connection: int, m: Join, p: Participant) -> None:
    if m.key_id != p.key_id or m.role != p.role:
        text = f"{p.id} has another key or role"
        return ctx.refuse(connection, RefusalCode.RESUME_TOKEN, text, "join without the resume token")
    if p.connection != NO_CONNECTION:
        ctx.dropped.append(Dropped(p.connection, "replaced"))
        lose(ctx, p, "replaced")
    needs_alignment = m.alignment == AlignmentKind.MEASURED
    if not p.run or p.run not in _runs(m) or needs_alignment != p.needs_alignment:
        p.tracking_epoch = 0
        corrections.void(p)
        if not p.aligning:
            p.aligning, p.alignment_run = True, p.alignment_run + 1
            ctx.emit(AlignmentRun(p.id, True, p.alignment_run))
    p.name, p.needs_alignment = m.name, needs_alignment
    p.seen.clear()
    return _admit(ctx, p, connection, m, resumed=True)


def _runs(m: Join) -> list[str]:
    return [c for c in m.capabilities if c.startswith(RUN_PREFIX)]


def _admit(ctx: Context, p: Participant, connection: int, m: Join, resumed: bool) -> None:
    p.connection, p.gateway, p.heard_ns, p.expires_ns, p.worn = connection, m.gateway, ctx.now_ns, 0, True
    p.devices, p.run, p.spared = m.devices, next(iter(_runs(m)), ""), False
    assignment.settle_names(ctx)
    for told in ctx.state.feedback.values():
        told.sent.pop(p.id, None)  # it may never have come over the connection before
    if not p.needs_alignment:
        p.alignment = NOT_NEEDED
    ctx.by_connection[connection] = p
    ctx.admitted.append(Admitted(connection, p.id, p.role, resumed))
    ctx.emit(ParticipantJoined(ctx.info(p), resumed))
    if not p.aligning:  # a front that was started anew has heard nothing of it
        ctx.emit(AlignmentRun(p.id, False, p.alignment_run))
    if resumed:
        leases.fence(ctx, p)


def _evict(ctx: Context) -> bool:
    """Makes room: forgets the first lost participant that holds nothing."""
    for p in ctx.state.participants.values():
        if p.connection == NO_CONNECTION and not ctx.leases_of(p):
            remove(ctx, p, "expired")
            return True
    return False


def lose(ctx: Context, p: Participant, reason: str, *, keeps_place: bool = False) -> None:
    """The connection is gone: its robots hold, and the grace period begins."""
    if p.connection == NO_CONNECTION or p.id == HOST_ID:
        return
    del ctx.by_connection[p.connection]
    connection, p.connection = p.connection, NO_CONNECTION
    p.expires_ns = ctx.now_ns + ctx.config.grace_ns
    leases.forget_requests(ctx, p, "", keeps_place=keeps_place)
    ctx.emit(ParticipantLeft(p.id, reason, grace=True))
    for lease in ctx.leases_of(p):
        overrides = lease.override == p.id
        for g in lease.grants:
            if g.participant == p.id:
                engagement.rearm(ctx, lease, g, HoldReason.DISCONNECTED)
        if overrides:
            engagement.give_back(ctx, lease)
        ctx.publish(lease, "left", p.id)
    _lose_clients(ctx, connection, reason, keeps_place=keeps_place)


def leave(ctx: Context, p: Participant, reason: str) -> None:
    """Bye: releases everything without grace."""
    if p.id == HOST_ID:
        return
    connection = p.connection
    ctx.dropped.append(Dropped(connection, "bye"))
    del ctx.by_connection[connection]
    p.connection = NO_CONNECTION
    remove(ctx, p, "left", reason[:MAX_REASON] or "bye")
    _lose_clients(ctx, connection, "gateway")


def remove_participant(ctx: Context, p: Participant, m: RemoveParticipant) -> None:
    """A director ends somebody's participation, at once and without grace."""
    gone = ctx.person(m.participant)
    if gone is None or gone.id == HOST_ID:
        text = f"no participant {m.participant}"
        denial = Denial(DenialReason.UNKNOWN_PARTICIPANT, text, "use an id of the roster")
        return ctx.deny(p, m.request_id, denial)
    ctx.accept(p, m.request_id)
    kind = AuditKind.KEY_REVOKED if m.revoke else AuditKind.REMOVED
    ctx.emit(Audited(kind, gone.id, gone.name, "", f"{p.name}: {m.reason}"[:MAX_TEXT]))
    connection = gone.connection
    if connection != NO_CONNECTION:
        ctx.dropped.append(Dropped(connection, "revoked" if m.revoke else "removed", gone.key_id if m.revoke else ""))
        del ctx.by_connection[connection]
        gone.connection = NO_CONNECTION
    elif m.revoke:
        ctx.dropped.append(Dropped(HOST, "revoked", gone.key_id))
    remove(ctx, gone, "removed")
    return _lose_clients(ctx, connection, "gateway")


def _lose_clients(ctx: Context, gateway: int, reason: str, *, keeps_place: bool = False) -> None:
    """Everyone for whom the gateway at that connection spoke is lost with it, and forgotten by the front."""
    for p in tuple(ctx.state.participants.values()):
        if p.gateway == gateway and gateway != HOST and p.connection != NO_CONNECTION:
            ctx.dropped.append(Dropped(p.connection, "gateway"))
            lose(ctx, p, reason, keeps_place=keeps_place)


def remove(ctx: Context, p: Participant, cause: str, reason: str = "") -> None:
    """Forgets a participant and frees what it holds."""
    leases.free_all(ctx, p, cause)
    for tracked in ctx.state.feedback.values():
        tracked.sent.pop(p.id, None)
    del ctx.state.participants[p.id]
    anchoring.forget(ctx, p)
    assignment.settle_names(ctx)
    ctx.emit(ParticipantLeft(p.id, reason or cause))


def lose_everyone(ctx: Context, reason: str) -> None:
    """The front was replaced, or the session goes on after it was down: every connection is lost.

    Who waited for a robot keeps the place, as nobody could choose to leave it.
    """
    for p in tuple(ctx.state.participants.values()):
        lose(ctx, p, reason, keeps_place=True)


def begin_grace_anew(ctx: Context) -> None:
    """The time that the session was down counts against nobody, those who were away before included."""
    for p in ctx.state.participants.values():
        if p.connection == NO_CONNECTION:
            p.spared = False
            p.expires_ns = ctx.now_ns + ctx.config.grace_ns
            for lease in ctx.leases_of(p):
                ctx.publish(lease, "left", p.id)


def set_worn(ctx: Context, p: Participant, worn: bool) -> None:
    """The headset was put on or taken off; taken off, everything it drives holds."""
    if p.worn != worn:
        p.worn = worn
        if not worn:
            engagement.rearm_participant(ctx, p, HoldReason.NOT_WORN)
        ctx.publish_participant(p)


def expire(ctx: Context) -> None:
    """Heartbeats and grace periods, by session time; after the entries of the step were applied."""
    draining = ctx.now_ns < ctx.state.hold_expiry_until_ns
    silent_before = ctx.now_ns - ctx.config.heartbeat_timeout_ns
    for p in tuple(ctx.state.participants.values()):
        if not draining:
            p.spared = False
        elif not p.spared:
            continue
        if p.connection > HOST and p.heard_ns < silent_before:
            ctx.dropped.append(Dropped(p.connection, "heartbeat"))
            lose(ctx, p, "heartbeat")
        elif p.expires_ns and ctx.now_ns >= p.expires_ns:
            remove(ctx, p, "expired")


def snapshot(ctx: Context, request_id: int) -> Snapshot:
    """What a late joiner needs; the front adds robots, bodies, scene hash and poses."""
    state = ctx.state
    return Snapshot(
        request_id=request_id,
        event_seq=state.event_seq,
        scene_epoch=state.scene_epoch,
        scene_revision=state.scene_revision,
        scene_hash="",
        tick=ctx.view.tick,
        sim_time=ctx.view.sim_time,
        session_time=ctx.now_ns,
        participants=tuple(ctx.info(p) for p in state.participants.values() if p.id != HOST_ID),
        leases=tuple(ctx.lease_info(lease) for lease in (*state.robots.values(), *state.objects.values())),
        paused=state.paused,
        estop=state.estop,
        episode=state.episode,
        tick_period_ns=ctx.view.tick_period_ns,
    )
