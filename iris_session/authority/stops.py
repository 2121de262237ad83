"""Everything that stops or restarts the whole session: e-stop, pause, reset, gaps, scene changes."""

from __future__ import annotations

from iris_session.authority import engagement
from iris_session.authority.context import Context
from iris_session.authority.state import NO_CONNECTION, Participant
from iris_session.protocol.client_messages import ClearEStop, Control, EStop
from iris_session.protocol.common import Denial
from iris_session.protocol.names import ControlAction, DenialReason, HoldReason
from iris_session.protocol.server_messages import EStopChanged, Gap, PauseChanged, SceneChanged


def estop(ctx: Context, participant: str, m: EStop) -> None:
    """Latched; every robot holds from this step on. `participant`: empty for one who was given up before."""
    ctx.estop_arrived = True
    if not ctx.state.estop:
        ctx.state.estop = True
        ctx.emit(EStopChanged(True, participant, m.reason))
        engagement.rearm_all(ctx, HoldReason.ESTOP)


def clear_estop(ctx: Context, p: Participant, m: ClearEStop) -> None:
    """Ends the e-stop; robots hold until clutched again. Denied in a step in which somebody stops."""
    if ctx.estop_arrived:
        denial = Denial(DenialReason.ESTOP, "somebody stopped the session in this very step", "look, then clear again")
        return ctx.deny(p, m.request_id, denial)
    if ctx.state.estop:
        ctx.state.estop = False
        ctx.emit(EStopChanged(False, p.id))
        engagement.rearm_all(ctx, HoldReason.ESTOP)
    return ctx.accept(p, m.request_id)


def control(ctx: Context, p: Participant, m: Control) -> None:
    """A director's pause, resume, step and reset."""
    if m.action not in ControlAction.ALL:
        known = f"actions: {', '.join(sorted(ControlAction.ALL))}"
        return ctx.deny(p, m.request_id, Denial(DenialReason.UNKNOWN_VALUE, f"unknown action {m.action}", known))
    if ctx.config.user_owned_loop:
        return ctx.deny(p, m.request_id, user_owned(m.action))
    if m.action == ControlAction.STEP:
        if not ctx.state.paused or not 1 <= m.ticks <= ctx.config.max_step_ticks:
            text = f"step needs a paused session and 1 to {ctx.config.max_step_ticks} ticks"
            return ctx.deny(p, m.request_id, Denial(DenialReason.INVALID, text, "pause first"))
        ctx.step_ticks = min(ctx.step_ticks + m.ticks, ctx.config.max_step_ticks)
    elif m.action == ControlAction.RESET:
        reset(ctx)
    elif ctx.state.paused != (m.action == ControlAction.PAUSE):
        ctx.state.paused = not ctx.state.paused
        ctx.emit(PauseChanged(ctx.state.paused, p.id))
        # A hand moves on while physics stands still: motion must be latched anew.
        engagement.rearm_all(ctx, HoldReason.GAP)
    return ctx.accept(p, m.request_id)


def user_owned(action: str) -> Denial:
    """The denial of what only the owner of the loop can do."""
    return Denial(DenialReason.USER_OWNED, f"{action}: the user's own loop drives physics", "do it in that program")


def reset(ctx: Context) -> None:
    """Back to the initial state before the ticks of this step: a new scene epoch, leases stay."""
    if not ctx.reset:
        ctx.reset = True
        new_scene(ctx, "reset")


def new_scene(ctx: Context, cause: str) -> None:
    """Starts a scene epoch: whatever was sent for the old one no longer counts."""
    ctx.state.scene_epoch += 1
    ctx.state.handovers.clear()
    ctx.state.regrasps.clear()
    engagement.rearm_all(ctx, HoldReason.SCENE_CHANGED)
    for lease in ctx.state.objects.values():
        lease.lead = 0
    period_ns = ctx.view.tick_period_ns if cause == "new_scene" else 0
    ctx.emit(SceneChanged(ctx.state.scene_epoch, ctx.state.scene_revision, cause, tick_period_ns=period_ns))


def gap(ctx: Context, duration_ns: int, kind: str = "stalled") -> None:
    """No step was taken for a while: robots hold until clutched again, and nobody expires before the entries that
    waited meanwhile were applied. Once: where every step is a gap, the step after the first one had those entries."""
    ctx.state.hold_expiry_until_ns = ctx.now_ns + ctx.config.drain_ns
    for p in ctx.state.participants.values():
        if p.spared:
            continue
        p.spared = True
        if p.connection == NO_CONNECTION:
            if p.expires_ns < ctx.state.hold_expiry_until_ns:
                p.expires_ns = ctx.state.hold_expiry_until_ns
                for lease in ctx.leases_of(p):
                    ctx.publish(lease, "left", p.id)
        else:
            p.heard_ns = max(p.heard_ns, ctx.now_ns)
    for lease in ctx.state.robots.values():
        lease.override_ns = ctx.now_ns  # whoever took over could not engage meanwhile
    ctx.emit(Gap(kind, max(0, duration_ns)))
    engagement.rearm_all(ctx, HoldReason.GAP)
