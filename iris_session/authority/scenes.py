"""Another scene in a running session: other robots, other objects, a new scene epoch.

Who holds a robot whose name the new scene has too keeps it, and must clutch again. Everything else that was held or
waited for ends with its scene.
"""

from __future__ import annotations

from iris_session.authority import leases, stops
from iris_session.authority.context import Context, listed, some
from iris_session.authority.state import HOST_ID, KEPT, LeaseState, Pending
from iris_session.protocol.common import Denial
from iris_session.protocol.entries import SceneLoaded, ScenePatched
from iris_session.protocol.names import DenialReason, LeaseMode, TargetKind
from iris_session.protocol.scene import merged
from iris_session.protocol.server_messages import SceneChanged
from iris_session.protocol.specs import ObjectSpec, RobotSpec

#: `LeaseChanged.cause` of what ends with its scene.
CAUSE = "scene_changed"


def load(ctx: Context, m: SceneLoaded) -> None:
    """Takes the robots and objects of `m`. The plant of `ctx.view` is that of the new scene already."""
    state = ctx.state
    robots = robot_leases(m.robots, ctx.config.default_mode)
    for name, lease in state.robots.items():
        if name in robots:
            robots[name] = lease
        else:
            _end(ctx, lease)
    for lease in state.objects.values():
        _end(ctx, lease)
    state.robots, state.objects = robots, object_leases(m.objects)
    state.feedback = {name: told for name, told in state.feedback.items() if name in robots}
    state.handover_tick = -1
    state.scene, state.patches, state.scene_revision = m, (), 0
    ctx.use(m.robots, m.objects)
    for pending in (*state.queue, *state.consents):
        _end_request(ctx, pending)
    stops.new_scene(ctx, "new_scene")


def patch(ctx: Context, m: ScenePatched) -> None:
    """What is drawn is another: nothing else changes, so no robot stops."""
    state = ctx.state
    state.patches = merged(state.patches, m.ops)
    state.scene_revision += 1
    ctx.emit(SceneChanged(state.scene_epoch, state.scene_revision, "patch", m.scene_hash))


def robot_leases(robots: tuple[RobotSpec, ...], default_mode: str) -> dict[str, LeaseState]:
    """Free robots, in their order."""
    return {r.name: LeaseState(r.name, TargetKind.ROBOT, default_mode or r.mode) for r in robots}


def object_leases(objects: tuple[ObjectSpec, ...]) -> dict[str, LeaseState]:
    """Free objects, in their order."""
    return {o.name: LeaseState(o.name, TargetKind.OBJECT, LeaseMode.SHARED) for o in objects}


def _end(ctx: Context, lease: LeaseState) -> None:
    """Takes a target from everyone, because it will be no more."""
    if lease.grants:
        holder = ctx.holder(lease)
        leases.clear(ctx, lease)
        ctx.publish(lease, CAUSE, holder)


def _end_request(ctx: Context, pending: Pending) -> None:
    """Answers what waits for something that the scene does not have."""
    gone = [name for name in pending.robots if name not in ctx.robots and not pending.any_robot]
    gone += [name for name in pending.objects if name not in ctx.objects]
    if pending.any_robot:
        pending.robots = ()
    if not gone:
        return
    ctx.state.queue = [other for other in ctx.state.queue if other is not pending]
    ctx.state.consents = [other for other in ctx.state.consents if other is not pending]
    p = ctx.state.participants[pending.participant]
    if pending.request_id != KEPT and p.id != HOST_ID:
        text = f"another scene was loaded, which has no {some(gone)}"
        ctx.deny(p, pending.request_id, Denial(DenialReason.UNKNOWN_TARGET, text, listed("robots", ctx.robots)))
