"""Control of the whole session: e-stop, pause, step, reset, gaps, and scenes.

Another scene brings other robots and objects and a new scene epoch. The holder of a robot whose name the new scene has
too keeps it, and must clutch again. Every other lease and pending request ends with its scene.

Episodes are in `episodes`; here is only how recordings of earlier versions have them.
"""

from __future__ import annotations

from typing import Final

from iris_session.authority import engagement, leases
from iris_session.authority.context import Context, build_value_denial, format_names, join_names
from iris_session.authority.state import (
    HOST_ID,
    NO_CONNECTION,
    NO_REPLY,
    LeaseState,
    Participant,
    Pending,
    StopState,
)
from iris_session.protocol.client_messages import ClearEStop, Control, Episode, EStop
from iris_session.protocol.common import Denial
from iris_session.protocol.entries import PhysicsDiverged, SceneLoaded, ScenePatched
from iris_session.protocol.names import (
    ControlAction,
    DenialReason,
    EpisodeAction,
    HoldReason,
    LeaseMode,
    Role,
    TargetKind,
)
from iris_session.protocol.scene import merge_patches
from iris_session.protocol.server_messages import EpisodeChanged, EStopChanged, Gap, PauseChanged, SceneChanged
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.protocol.status import StopReport

#: `EpisodeChanged.state` of a running episode.
RUNNING: Final = "running"
#: State in which each action ends a running episode.
VERDICTS: Final = {
    EpisodeAction.SUCCESS: "success",
    EpisodeAction.FAILURE: "failure",
    EpisodeAction.DISCARD: "discarded",
}
ACTIONS: Final = frozenset({"start", "success", "failure", "discard", "rerecord", "reset"})
#: Stops in force that are kept for the status, the newest of each participant.
MAX_STOPS: Final = 16
#: Characters of a stop's reason in a denial.
MAX_SHOWN_REASON: Final = 200
#: `LeaseChanged.cause` of leases that end with its scene.
SCENE_CHANGED: Final = "scene_changed"


def latch_estop(ctx: Context, connection: int, m: EStop) -> None:
    """Latch the e-stop; every robot holds from this step on.

    Every stop is counted, also while stopped: a clear must know of all. Stops of one connection within one step are one
    stop. `connection` may have no participant.
    """
    state = ctx.state
    if connection in ctx.stopped_by:
        return
    ctx.stopped_by.add(connection)
    p = ctx.by_connection.get(connection)
    participant, name = (p.id, p.name) if p is not None else ("", "")
    state.stop_seq += 1
    stop = StopState(state.stop_seq, participant, name, m.reason, ctx.now_ns)
    state.stops = [*[old for old in state.stops if old.participant != participant], stop][-MAX_STOPS:]
    ctx.emit(EStopChanged(True, participant, m.reason, state.stop_seq))
    if not state.estop:
        state.estop = True
        engagement.rearm_all(ctx, HoldReason.ESTOP)


def clear_estop(ctx: Context, p: Participant, m: ClearEStop) -> None:
    """End the e-stop; robots hold until clutched again. Denied when there is a stop that the sender has not seen."""
    state = ctx.state
    if m.stop_seq > state.stop_seq:
        text = f"there is no stop {m.stop_seq}, the newest is {state.stop_seq}"
        return ctx.deny(p, m.request_id, Denial(DenialReason.INVALID, text, "name the newest stop that you have seen"))
    if state.estop and m.stop_seq < state.stop_seq:
        return ctx.deny(p, m.request_id, _build_newer_stop_denial(state.stops[-1], m.stop_seq))
    if state.estop:
        state.estop, state.stops = False, []
        ctx.emit(EStopChanged(False, p.id, "", state.stop_seq))
        engagement.rearm_all(ctx, HoldReason.ESTOP)
    return ctx.accept(p, m.request_id)


def _build_newer_stop_denial(newest: StopState, seen: int) -> Denial:
    who = newest.name or "a connection that has not joined"
    reason = f" ({newest.reason[:MAX_SHOWN_REASON]})" if newest.reason else ""
    text = f"stop {newest.stop_seq} of {who}{reason} is newer than stop {seen}, the newest that you have seen"
    advice = f"look who has stopped the session, then clear stop {newest.stop_seq}"
    return Denial(DenialReason.ESTOP, text, advice, "", newest.participant, newest.name)


def build_stop_reports(ctx: Context) -> tuple[StopReport, ...]:
    """Return the e-stops in force, newest first."""
    now_ns = ctx.state.now_ns or 0
    return tuple(
        StopReport(s.stop_seq, s.participant, s.name, s.reason, now_ns - s.stopped_ns)
        for s in reversed(ctx.state.stops)
    )


def control_session(ctx: Context, p: Participant, m: Control) -> None:
    """Process a director's pause, resume, step or reset."""
    if m.action not in ControlAction.ALL:
        return ctx.deny(p, m.request_id, build_value_denial("action", m.action, ControlAction.ALL))
    if ctx.config.user_owned_loop:
        if m.action == ControlAction.RESET and ctx.state.owner_listens:
            return ctx.accept(p, m.request_id)  # the owner hears of it, and resets
        return ctx.deny(p, m.request_id, build_user_owned_denial(m.action))
    if m.action == ControlAction.STEP:
        if not ctx.state.paused or not 1 <= m.ticks <= ctx.config.max_step_ticks:
            text = f"step needs a paused session and 1 to {ctx.config.max_step_ticks} ticks"
            return ctx.deny(p, m.request_id, Denial(DenialReason.INVALID, text, "pause first"))
        if ctx.state.diverged:
            text = f"physics stands still: {ctx.state.diverged}"
            return ctx.deny(p, m.request_id, Denial(DenialReason.INVALID, text, "reset the session first"))
        ctx.step_ticks = min(ctx.step_ticks + m.ticks, ctx.config.max_step_ticks)
    elif m.action == ControlAction.RESET:
        reset_scene(ctx, p.id)
    elif m.action == ControlAction.RESUME:
        if ctx.state.diverged:
            reset_scene(ctx, p.id)  # nothing else can go on
        _set_paused(ctx, p.id, False)
    else:
        ctx.state.paused_by_divergence = False  # a director wants it: a reset does not end it
        _set_paused(ctx, p.id, True)
    return ctx.accept(p, m.request_id)


def _set_paused(ctx: Context, by: str, paused: bool, reason: str = "") -> None:
    if ctx.state.paused == paused:
        return
    ctx.state.paused = paused
    ctx.emit(PauseChanged(paused, by, reason))
    # A hand moves on while physics stands still: motion must be latched anew.
    engagement.rearm_all(ctx, HoldReason.GAP)


def record_divergence(ctx: Context, m: PhysicsDiverged) -> None:
    """Record that physics stands still until a reset, and pause; the owner of a loop of its own resets it there."""
    state = ctx.state
    if m.scene_epoch != state.scene_epoch or state.diverged:
        return  # a reset or another scene came before
    state.diverged = m.text or "numbers that are not finite"
    if not state.paused and not ctx.config.user_owned_loop:
        state.paused_by_divergence = True
        _set_paused(ctx, HOST_ID, True, state.diverged)


def build_user_owned_denial(action: str) -> Denial:
    """Return the denial of what only the owner of the loop can do."""
    return Denial(DenialReason.USER_OWNED, f"{action}: the user's own loop drives physics", "do it in that program")


def reset_scene(ctx: Context, by: str) -> None:
    """Return to the initial state before the ticks of this step: a new scene epoch, leases stay. `by`: who wants it."""
    if not ctx.reset:
        ctx.reset = True
        begin_scene_epoch(ctx, "reset", by)


def begin_scene_epoch(ctx: Context, cause: str, by: str = HOST_ID) -> None:
    """Begin a scene epoch: entries sent for the old one no longer count. Ends the pause of physics that diverged."""
    was_paused, ctx.state.diverged = ctx.state.paused_by_divergence, ""
    ctx.state.paused_by_divergence = False
    if was_paused:
        _set_paused(ctx, by, False)
    ctx.state.scene_epoch += 1
    ctx.state.handovers.clear()
    ctx.state.regrasps.clear()
    engagement.rearm_all(ctx, HoldReason.SCENE_CHANGED)
    for lease in ctx.state.objects.values():
        lease.lead = 0
    period_ns = ctx.view.tick_period_ns if cause == "new_scene" else 0
    ctx.emit(SceneChanged(ctx.state.scene_epoch, ctx.state.scene_revision, cause, tick_period_ns=period_ns))


def record_gap(ctx: Context, duration_ns: int, kind: str = "stalled") -> None:
    """Hold all robots after a time without steps, and let no participant expire before its waiting entries were
    applied.

    Once: where every step is a gap, the step after the first one had those entries.
    """
    ctx.state.hold_expiry_until_ns = ctx.now_ns + ctx.config.drain_ns
    for p in ctx.state.participants.values():
        if p.spared:
            continue
        p.spared = True
        if p.connection == NO_CONNECTION:
            if p.expires_ns < ctx.state.hold_expiry_until_ns:
                p.expires_ns = ctx.state.hold_expiry_until_ns
                for lease in ctx.list_leases(p):
                    ctx.publish_lease(lease, "left", p.id)
        else:
            p.heard_ns = max(p.heard_ns, ctx.now_ns)
    ctx.emit(Gap(kind, max(0, duration_ns)))
    engagement.rearm_all(ctx, HoldReason.GAP)


# --- episodes of earlier recordings ---


def mark_episode(ctx: Context, p: Participant, m: Episode) -> None:
    """Process an action on an episode as before `AuthorityConfig.episode_rules`, so that earlier recordings replay."""
    if m.action not in ACTIONS:
        return ctx.deny(p, m.request_id, build_value_denial("action", m.action, ACTIONS))
    if p.role not in Role.DRIVING:
        denial = Denial(DenialReason.ROLE, f"role {p.role} may not control episodes", "ask an operator or director")
        return ctx.deny(p, m.request_id, denial)
    now = ctx.state.episode
    running = now is not None and now.state == RUNNING
    resets = m.action in (EpisodeAction.RESET, EpisodeAction.RERECORD)
    if resets and ctx.config.user_owned_loop and not ctx.state.owner_listens:
        return ctx.deny(p, m.request_id, build_user_owned_denial(m.action))
    if running == (m.action in (EpisodeAction.START, EpisodeAction.RESET)):
        text = "an episode is running" if running else "no episode is running"
        advice = "end it with success, failure or discard" if running else "start one"
        return ctx.deny(p, m.request_id, Denial(DenialReason.EPISODE_STATE, text, advice))
    number = now.number if now is not None else 0
    if m.action in VERDICTS:
        _set_episode(ctx, EpisodeChanged(number, VERDICTS[m.action], m.label, p.id))
    if m.action == EpisodeAction.RERECORD:
        _set_episode(ctx, EpisodeChanged(number, VERDICTS[EpisodeAction.DISCARD], m.label, p.id))
    ctx.state.rerecording = None
    following = EpisodeChanged(number + 1, RUNNING, m.label, p.id)
    if resets and ctx.config.user_owned_loop:
        ctx.state.rerecording = following if m.action == EpisodeAction.RERECORD else None
    elif resets:
        reset_scene(ctx, p.id)
    if m.action == EpisodeAction.START or (m.action == EpisodeAction.RERECORD and not ctx.config.user_owned_loop):
        _set_episode(ctx, following)
    return ctx.accept(p, m.request_id)


def start_rerecording(ctx: Context) -> None:
    """Start the episode that waited for the owner of a user loop to reset the scene."""
    following, ctx.state.rerecording = ctx.state.rerecording, None
    if following is not None:
        _set_episode(ctx, following)


def _set_episode(ctx: Context, episode: EpisodeChanged) -> None:
    ctx.state.episode = episode
    ctx.emit(episode)


# --- scenes ---


def load_scene(ctx: Context, m: SceneLoaded) -> None:
    """Replace robots and objects by those of `m`. The plant of `ctx.view` is that of the new scene already."""
    state = ctx.state
    robots = create_robot_leases(m.robots, ctx.config.default_mode)
    for name, lease in state.robots.items():
        if name in robots:
            robots[name] = lease
        else:
            _end_lease(ctx, lease)
    for lease in state.objects.values():
        _end_lease(ctx, lease)
    state.robots, state.objects = robots, create_object_leases(m.objects)
    state.feedback = {name: feedback for name, feedback in state.feedback.items() if name in robots}
    state.handover_tick = -1
    state.scene, state.patches, state.scene_revision = m, (), 0
    ctx.set_targets(m.robots, m.objects)
    for pending in (*state.queue, *state.consents):
        _end_request(ctx, pending)
    begin_scene_epoch(ctx, "new_scene")


def patch_scene(ctx: Context, m: ScenePatched) -> None:
    """Record a visual change of the scene: nothing else changes, so no robot stops."""
    state = ctx.state
    state.patches = merge_patches(state.patches, m.ops)
    state.scene_revision += 1
    ctx.emit(SceneChanged(state.scene_epoch, state.scene_revision, "patch", m.scene_hash))


def create_robot_leases(robots: tuple[RobotSpec, ...], default_mode: str) -> dict[str, LeaseState]:
    """Return free robots, in their order."""
    return {r.name: LeaseState(r.name, TargetKind.ROBOT, default_mode or r.mode) for r in robots}


def create_object_leases(objects: tuple[ObjectSpec, ...]) -> dict[str, LeaseState]:
    """Return free objects, in their order."""
    return {o.name: LeaseState(o.name, TargetKind.OBJECT, LeaseMode.SHARED) for o in objects}


def _end_lease(ctx: Context, lease: LeaseState) -> None:
    """Revoke every grant of a target that the new scene does not have."""
    if lease.grants:
        holder = ctx.get_holder(lease)
        leases.revoke_all(ctx, lease)
        ctx.publish_lease(lease, SCENE_CHANGED, holder)


def _end_request(ctx: Context, pending: Pending) -> None:
    """Deny a pending request for targets that the new scene does not have."""
    gone = [name for name in pending.robots if name not in ctx.robots and not pending.any_robot]
    gone += [name for name in pending.objects if name not in ctx.objects]
    if pending.any_robot:
        pending.robots = ()
    if not gone:
        return
    ctx.state.queue = [other for other in ctx.state.queue if other is not pending]
    ctx.state.consents = [other for other in ctx.state.consents if other is not pending]
    p = ctx.state.participants[pending.participant]
    if pending.request_id != NO_REPLY and p.id != HOST_ID:
        text = f"another scene was loaded, which has no {join_names(gone)}"
        ctx.deny(p, pending.request_id, Denial(DenialReason.UNKNOWN_TARGET, text, format_names("robots", ctx.robots)))
