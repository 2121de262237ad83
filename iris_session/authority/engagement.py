"""Clutch latches: when a holder's motion starts to move its robot, and everything that ends that.

A latch is armed by a counted sample with the clutch open, and fires with a counted sample with the clutch closed. Every
disturbance (e-stop, gap, reset, rejection, takeover, resume, new tracking frame) disarms it, so that nothing moves
before the clutch was opened and closed again.
"""

from __future__ import annotations

from iris_session.authority.context import HUMAN, Context
from iris_session.authority.state import NO_CONNECTION, LeaseGrant, LeaseState, Participant
from iris_session.protocol.names import HoldReason, LeaseMode, TargetKind
from iris_session.protocol.server_messages import EngagementChanged, Intervention, ObjectGrasped


def _emit_change(ctx: Context, lease: LeaseState, g: LeaseGrant, engaged: bool, reason: str = "") -> None:
    if lease.kind == TargetKind.OBJECT:
        ctx.emit(ObjectGrasped(lease.target, g.participant, g.device, engaged))
    else:
        ctx.emit(EngagementChanged(lease.target, g.participant, engaged, reason))


def begin_engagement(ctx: Context, lease: LeaseState, g: LeaseGrant, p: Participant, device: str) -> None:
    """Engage `g` with `device`; the alignment is frozen until the engagement ends."""
    if lease.mode == LeaseMode.PRIORITY and p.role in HUMAN and len(lease.grants) > 1 and not lease.override:
        preempt_agent(ctx, lease, p)
    g.armed.remove(device)
    g.engagement = ctx.state.next_engagement
    ctx.state.next_engagement += 1
    g.device = device
    g.open_ns = 0
    g.hold = ""
    p.in_use = True
    if p.alignment is not None:
        g.alignment_version = p.alignment.version
        g.T_world_tracking = p.alignment.T_world_tracking
    _emit_change(ctx, lease, g, True)


def end_engagement(ctx: Context, lease: LeaseState, g: LeaseGrant, reason: str) -> None:
    """End the engagement, if there is one: from this step on the target holds for `reason`."""
    if g.engagement:
        _emit_change(ctx, lease, g, False, reason)
        g.engagement = 0
        g.source = None
        g.gripper = None
    g.hold = reason


def rearm_grant(ctx: Context, lease: LeaseState, g: LeaseGrant, reason: str) -> None:
    """End the engagement and disarm every latch of `g`: the clutch must open and close again."""
    end_engagement(ctx, lease, g, reason)
    g.armed.clear()
    g.open_ns = 0


def rearm_participant(ctx: Context, p: Participant, reason: str) -> None:
    """Rearm everything that `p` holds."""
    for lease in ctx.list_leases(p):
        for g in lease.grants:
            if g.participant == p.id:
                rearm_grant(ctx, lease, g, reason)


def rearm_all(ctx: Context, reason: str) -> None:
    """Rearm everything in the session."""
    for lease in (*ctx.state.robots.values(), *ctx.held_objects):
        lease.freed_ns = 0  # a free robot does not begin to move by itself
        for g in lease.grants:
            rearm_grant(ctx, lease, g, reason)


def note_open_clutch(ctx: Context, g: LeaseGrant) -> None:
    """Note a counted sample with an open clutch of the device that drove last."""
    if not g.open_ns or ctx.now_ns - g.open_ns > ctx.config.freshness_ns:
        g.open_from_ns = ctx.now_ns
    g.open_ns = ctx.now_ns


def is_standing_by(ctx: Context, g: LeaseGrant) -> bool:
    """Return true when the holder has kept the clutch open for `intervention_idle_ns`, by samples without a pause.

    Time in which it is disconnected, untracked, not worn, silent, or rejected says nothing about the hand.
    """
    if g.engagement or not g.open_ns or ctx.now_ns - g.open_ns > ctx.config.freshness_ns:
        return False
    return ctx.now_ns - g.open_from_ns >= ctx.config.intervention_idle_ns


def preempt_agent(ctx: Context, lease: LeaseState, human: Participant) -> None:
    """Let `human` override the agent that drives the robot (mode `priority`)."""
    agent = lease.grants[0]
    rearm_grant(ctx, lease, agent, HoldReason.INTERVENTION)
    lease.override = human.id
    ctx.publish_lease(lease, "priority", agent.participant)
    ctx.emit(Intervention(lease.target, human.id, agent.participant, True))


def end_intervention(ctx: Context, lease: LeaseState) -> None:
    """End an intervention: the agent is in charge again, and must clutch again."""
    human, agent = lease.override, lease.grants[0]
    lease.override = ""
    lost = ctx.state.participants[agent.participant].connection == NO_CONNECTION
    rearm_grant(ctx, lease, agent, HoldReason.DISCONNECTED if lost else HoldReason.REARM)
    ctx.publish_lease(lease, "priority", human)
    ctx.emit(Intervention(lease.target, human, agent.participant, False))
