"""Membership: join, resume, disconnects, heartbeats, grace and expiry."""

from __future__ import annotations

from typing import Final

from iris_session.authority import alignment, anchoring, assignment, engagement, episodes, leases
from iris_session.authority.context import HUMAN, Context, build_absent_denial, build_value_denial
from iris_session.authority.state import HOST_ID, NO_CONNECTION, Participant
from iris_session.protocol.client_messages import RemoveParticipant, Rename, SetRole
from iris_session.protocol.common import IDENTITY, MAX_TEXT, Alignment, Denial
from iris_session.protocol.entries import HOST, EntryMessage, Join
from iris_session.protocol.names import AlignmentKind, AuditKind, DenialReason, Device, HoldReason, RefusalCode, Role
from iris_session.protocol.server_messages import (
    AlignmentRun,
    AnchorInfo,
    Audited,
    ParticipantJoined,
    ParticipantLeft,
    Snapshot,
)
from iris_session.protocol.steps import Admitted, Dropped

NOT_NEEDED: Final = Alignment(0, AlignmentKind.NOT_NEEDED, IDENTITY)
#: Devices that a wearer of a headset drives with. The head alone is presence; its samples are judged one by one.
HAND_DEVICES: Final = (Device.CONTROLLER_LEFT, Device.CONTROLLER_RIGHT, Device.HAND_LEFT, Device.HAND_RIGHT)
#: A client sends the capability `run:<random>`, made anew at every start of its tracking, to keep its alignment when
#: only the connection broke. A client that does not must be aligned again after a resume.
RUN_PREFIX: Final = "run:"

#: Characters of a name (`protocol.common.Name`).
MAX_NAME: Final = 64
#: A goodbye is free text, the reason of `participant_left` is as short as a name on the wire.
MAX_REASON: Final = 64


def create_host() -> Participant:
    """Return the process that owns the session: a director that never joins, times out or leaves."""
    p = Participant(HOST_ID, HOST_ID, Role.DIRECTOR, "", HOST, False, 0)
    p.alignment = NOT_NEEDED
    return p


def process_join(ctx: Context, connection: int, m: Join) -> None:
    """Admit a connection, or answer `Refused` with a code of `DenialReason` or `RefusalCode`."""
    state = ctx.state
    if connection in ctx.by_connection or connection <= state.last_connection:
        return ctx.refuse_hello(connection, DenialReason.ALREADY_JOINED, f"connection {connection} was used before")
    state.last_connection = connection
    if m.role not in Role.ALL:
        known = ", ".join(sorted(Role.ALL))
        return ctx.refuse_hello(connection, DenialReason.UNKNOWN_VALUE, f"unknown role {m.role}", f"roles: {known}")
    if m.alignment not in (AlignmentKind.MEASURED, AlignmentKind.NOT_NEEDED):
        text, known = f"unknown alignment {m.alignment}", f"{AlignmentKind.MEASURED}, {AlignmentKind.NOT_NEEDED}"
        return ctx.refuse_hello(connection, DenialReason.UNKNOWN_VALUE, text, known)
    unaligned = m.alignment == AlignmentKind.NOT_NEEDED and _describe_unaligned(ctx, m.role, m.key_id, m.devices)
    if unaligned:
        return ctx.refuse_hello(connection, DenialReason.UNALIGNED, unaligned, alignment.UNALIGNED_ADVICE)
    if m.roles and m.role not in m.roles:
        ctx.emit(Audited(AuditKind.ROLE_REFUSED, m.key_id, m.name, "", m.role))
        text = f"this key may not join as {m.role}"
        return ctx.refuse_hello(connection, DenialReason.ROLE, text, f"its roles: {', '.join(m.roles)}")
    if m.gateway:
        gateway = ctx.by_connection.get(m.gateway)
        if gateway is None or gateway.role != Role.GATEWAY:
            text = f"connection {m.gateway} may not speak for others"
            return ctx.refuse_hello(connection, RefusalCode.GATEWAY_ONLY, text, "join with role gateway")
    old = state.participants.get(m.resume_of) if m.resume_of != HOST_ID else None
    if old is not None:
        return _resume_participant(ctx, connection, m, old)
    if len(state.participants) > ctx.config.max_participants and not _evict_disconnected(ctx):
        text = f"the session is full: {ctx.config.max_participants} participants"
        return ctx.refuse_hello(connection, DenialReason.SESSION_FULL, text, "wait until a participant leaves")
    p = Participant(
        f"p{state.next_participant}", m.name, m.role, m.key_id, connection, m.alignment == AlignmentKind.MEASURED, 0
    )
    state.next_participant += 1
    state.participants[p.id] = p
    return _admit_participant(ctx, p, connection, m, resumed=False)


def _describe_unaligned(ctx: Context, role: str, key_id: str, devices: tuple[str, ...]) -> str:
    """Return why a participant without an alignment may not have this role with its declared devices, or an empty
    string.
    """
    worn = [d for d in dict.fromkeys(devices) if d in HAND_DEVICES]
    if role not in Role.DRIVING or not worn:
        return ""
    if any(alignment.may_be_unaligned(ctx, role, key_id, device) for device in devices):
        return ""
    return f"role {role} may not drive with {', '.join(worn)} without an alignment"


def _resume_participant(ctx: Context, connection: int, m: Join, p: Participant) -> None:
    if m.key_id != p.key_id or m.role not in (p.role, p.hello_role) or (m.roles and p.role not in m.roles):
        text = f"{p.id} has another key or role"
        return ctx.refuse_hello(connection, RefusalCode.RESUME_TOKEN, text, "join without the resume token")
    if p.connection != NO_CONNECTION:
        ctx.dropped.append(Dropped(p.connection, "replaced"))
        disconnect_participant(ctx, p, "replaced")
    needs_alignment = m.alignment == AlignmentKind.MEASURED
    if not p.run or p.run not in _list_runs(m) or needs_alignment != p.needs_alignment:
        p.tracking_epoch = 0
        alignment.void_alignment(p)
        if not p.aligning:
            p.aligning, p.alignment_run = True, p.alignment_run + 1
            ctx.emit(AlignmentRun(p.id, True, p.alignment_run))
    if m.name != p.hello_name:  # else it has been renamed
        p.name, p.hello_name = m.name, ""
    p.needs_alignment = needs_alignment
    p.warnings.pop("doubt", None)  # it may not have arrived: it is said again
    p.seen.clear()
    return _admit_participant(ctx, p, connection, m, resumed=True)


def _list_runs(m: Join) -> list[str]:
    return [c for c in m.capabilities if c.startswith(RUN_PREFIX)]


def _admit_participant(ctx: Context, p: Participant, connection: int, m: Join, resumed: bool) -> None:
    p.connection, p.gateway, p.heard_ns, p.expires_ns, p.worn = connection, m.gateway, ctx.now_ns, 0, True
    p.devices, p.run, p.spared, p.roles = m.devices, next(iter(_list_runs(m)), ""), False, m.roles
    assignment.update_name_owners(ctx)
    for feedback in ctx.state.feedback.values():
        feedback.sent.pop(p.id, None)  # it may not have arrived over the old connection
    if not p.needs_alignment:
        p.alignment = NOT_NEEDED
    ctx.by_connection[connection] = p
    ctx.admitted.append(Admitted(connection, p.id, p.role, resumed))
    ctx.emit(ParticipantJoined(ctx.to_participant_info(p), resumed))
    if not p.aligning:  # a restarted front does not know it
        ctx.emit(AlignmentRun(p.id, False, p.alignment_run))
    if resumed:
        leases.renew_fencing_tokens(ctx, p)
        episodes.note_return(ctx, p)


def _evict_disconnected(ctx: Context) -> bool:
    """Make room: remove the first disconnected participant that holds nothing."""
    for p in ctx.state.participants.values():
        if p.connection == NO_CONNECTION and not ctx.list_leases(p):
            remove_participant(ctx, p, "expired")
            return True
    return False


def disconnect_participant(ctx: Context, p: Participant, reason: str, *, keeps_place: bool = False) -> None:
    """Handle a disconnect: the participant's robots hold, and the grace period begins.

    A human who has preempted an agent stays in charge through it: the agent must not move a robot that was taken from
    it and not given back.
    """
    if p.connection == NO_CONNECTION or p.id == HOST_ID:
        return
    del ctx.by_connection[p.connection]
    connection, p.connection = p.connection, NO_CONNECTION
    p.expires_ns = ctx.now_ns + ctx.config.grace_ns
    leases.cancel_requests(ctx, p, "", keeps_place=keeps_place)
    ctx.emit(ParticipantLeft(p.id, reason, grace=True))
    episodes.note_leaving(ctx, p, "lost")
    for lease in ctx.list_leases(p):
        for g in lease.grants:
            if g.participant == p.id:
                engagement.rearm_grant(ctx, lease, g, HoldReason.DISCONNECTED)
        ctx.publish_lease(lease, "left", p.id)
    _disconnect_clients(ctx, connection, reason, keeps_place=keeps_place)


def process_bye(ctx: Context, p: Participant, reason: str) -> None:
    """Remove a participant that said goodbye, without grace."""
    if p.id == HOST_ID:
        return
    connection = p.connection
    ctx.dropped.append(Dropped(connection, "bye"))
    del ctx.by_connection[connection]
    p.connection = NO_CONNECTION
    remove_participant(ctx, p, "left", reason[:MAX_REASON] or "bye")
    _disconnect_clients(ctx, connection, "gateway")


def process_removal(ctx: Context, p: Participant, m: RemoveParticipant) -> None:
    """Remove a participant for a director, at once and without grace."""
    gone = _find_person(ctx, p, m)
    if gone is None:
        return None
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
    remove_participant(ctx, gone, "removed")
    return _disconnect_clients(ctx, connection, "gateway")


def is_self_rename(ctx: Context, p: Participant, m: EntryMessage) -> bool:
    """Return whether a participant asks for another name of its own, which needs no director."""
    return ctx.config.self_rename and isinstance(m, Rename) and m.participant == p.id


def rename_participant(ctx: Context, p: Participant, m: Rename) -> None:
    """Give a participant another name, for itself or a director; one that another participant has gets a number."""
    person = _find_person(ctx, p, m)
    name = m.name.strip()
    if person is None:
        return None
    if not name or not name.isprintable():
        text = f"{m.name!r} is not a name: expected 1 to {MAX_NAME} printable characters"
        return ctx.deny(p, m.request_id, Denial(DenialReason.INVALID, text))
    taken = {other.name for other in ctx.state.participants.values() if other is not person}
    name = _make_unique(name, taken)
    if name != person.name:
        ctx.emit(Audited(AuditKind.RENAMED, person.id, name, "", f"{p.name}: was {person.name}"[:MAX_TEXT]))
        person.hello_name, person.name = person.hello_name or person.name, name
        assignment.update_name_owners(ctx)
        ctx.publish_participant(person)
    return ctx.accept(p, m.request_id)


def _make_unique(name: str, taken: set[str]) -> str:
    """Return `name`, with a number when it is taken: `ann-2`."""
    if name not in taken:
        return name
    numbered = (f"{name[: MAX_NAME - 4]}-{n}" for n in range(2, len(taken) + 3))
    return next(one for one in numbered if one not in taken)


def set_role(ctx: Context, p: Participant, m: SetRole) -> None:
    """Give a participant another role for a director, one that its key may join in.

    It keeps its leases when it drives in both roles, as a person or as an agent: between these, lease modes treat it
    differently.
    """
    person = _find_person(ctx, p, m)
    if person is None:
        return None
    denial = _check_new_role(ctx, person, m.role)
    if denial is not None:
        return ctx.deny(p, m.request_id, denial)
    if m.role != person.role:
        detail = f"{p.name}: {person.role} to {m.role}"[:MAX_TEXT]
        ctx.emit(Audited(AuditKind.ROLE_CHANGED, person.id, person.name, "", detail))
        if m.role not in Role.DRIVING or (m.role in HUMAN) != (person.role in HUMAN):
            if ctx.config.episode_rules:  # earlier recordings replay as they were
                leases.cancel_requests(ctx, person, "your role is another one")
            leases.release_everything(ctx, person, "role")
        person.hello_role, person.role = person.hello_role or person.role, m.role
        ctx.publish_participant(person)
    return ctx.accept(p, m.request_id)


def _find_person(ctx: Context, p: Participant, m: RemoveParticipant | Rename | SetRole) -> Participant | None:
    """Return the participant that a director's request names; deny the request when there is none."""
    person = ctx.find_participant(m.participant)
    if person is None or person.id == HOST_ID:
        ctx.deny(p, m.request_id, build_absent_denial(m.participant))
        return None
    return person


def _check_new_role(ctx: Context, person: Participant, role: str) -> Denial | None:
    if role not in Role.ALL:
        return build_value_denial("role", role, Role.ALL)
    if role != person.role and Role.GATEWAY in (role, person.role):
        text = f"{person.name} is {person.role}: a role cannot be changed to or from gateway while connected"
        return Denial(DenialReason.ROLE, text, f"let it join anew as {role}")
    if person.roles and role not in person.roles:
        return Denial(
            DenialReason.ROLE, f"the key of {person.name} may not be {role}", f"its roles: {', '.join(person.roles)}"
        )
    unaligned = "" if person.needs_alignment else _describe_unaligned(ctx, role, person.key_id, person.devices)
    return Denial(DenialReason.UNALIGNED, unaligned, alignment.UNALIGNED_ADVICE) if unaligned else None


def _disconnect_clients(ctx: Context, gateway: int, reason: str, *, keeps_place: bool = False) -> None:
    """Disconnect every client behind the gateway at that connection, and let the front close them."""
    for p in tuple(ctx.state.participants.values()):
        if p.gateway == gateway and gateway != HOST and p.connection != NO_CONNECTION:
            ctx.dropped.append(Dropped(p.connection, "gateway"))
            disconnect_participant(ctx, p, reason, keeps_place=keeps_place)


def remove_participant(ctx: Context, p: Participant, cause: str, reason: str = "") -> None:
    """Remove a participant and free what it holds."""
    episodes.note_leaving(ctx, p, cause)
    leases.release_everything(ctx, p, cause)
    for feedback in ctx.state.feedback.values():
        feedback.sent.pop(p.id, None)
    del ctx.state.participants[p.id]
    anchoring.remove_cross_checks(ctx, p)
    assignment.update_name_owners(ctx)
    ctx.emit(ParticipantLeft(p.id, reason or cause))


def disconnect_all(ctx: Context, reason: str) -> None:
    """Disconnect everyone: the front was replaced, or the session resumes after it was down.

    Queued participants keep their place, as they did not choose to leave it.
    """
    for p in tuple(ctx.state.participants.values()):
        disconnect_participant(ctx, p, reason, keeps_place=True)


def restart_grace_periods(ctx: Context) -> None:
    """Restart all grace periods: the time that the session was down counts for no participant."""
    for p in ctx.state.participants.values():
        if p.connection == NO_CONNECTION:
            p.spared = False
            p.expires_ns = ctx.now_ns + ctx.config.grace_ns
            for lease in ctx.list_leases(p):
                ctx.publish_lease(lease, "left", p.id)


def set_worn(ctx: Context, p: Participant, worn: bool) -> None:
    """Record that the headset was put on or taken off; taken off, everything it drives holds."""
    if p.worn != worn:
        p.worn = worn
        if not worn:
            engagement.rearm_participant(ctx, p, HoldReason.NOT_WORN)
        ctx.publish_participant(p)


def expire_participants(ctx: Context) -> None:
    """Apply heartbeat timeouts and grace periods, by session time; after the entries of the step were applied."""
    draining = ctx.now_ns < ctx.state.hold_expiry_until_ns
    silent_before = ctx.now_ns - ctx.config.heartbeat_timeout_ns
    for p in tuple(ctx.state.participants.values()):
        if not draining:
            p.spared = False
        elif not p.spared:
            continue
        if p.connection > HOST and p.heard_ns < silent_before:
            ctx.dropped.append(Dropped(p.connection, "heartbeat"))
            disconnect_participant(ctx, p, "heartbeat")
        elif p.expires_ns and ctx.now_ns >= p.expires_ns:
            remove_participant(ctx, p, "expired")


def build_snapshot(ctx: Context, request_id: int) -> Snapshot:
    """Return the snapshot for a late joiner; the front adds robots, bodies, scene hash and poses."""
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
        participants=tuple(ctx.to_participant_info(p) for p in state.participants.values() if p.id != HOST_ID),
        leases=tuple(ctx.to_lease(lease) for lease in (*state.robots.values(), *state.objects.values())),
        paused=state.paused,
        estop=state.estop,
        stop_seq=state.stop_seq,
        consent_timeout_ns=ctx.config.consent_timeout_ns,
        episode=state.episode,
        tick_period_ns=ctx.view.tick_period_ns,
        anchors=tuple(AnchorInfo(name, T) for name, T in state.anchors.items()),
    )
