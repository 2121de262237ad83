"""Free objects held by hands without a robot.

The hand that engaged first leads: the object follows it with the offset latched at that moment. When it lets go while
another hand holds, the offset to that one is latched from the object's last commanded pose, so nothing jumps.
"""

from __future__ import annotations

from anchors.pose import compose, inverse
from iris_session.authority.context import Context
from iris_session.authority.state import LeaseState
from iris_session.protocol.common import Pose
from iris_session.protocol.steps import ObjectCommand


def build(ctx: Context) -> tuple[ObjectCommand, ...]:
    """One command per object that an engaged hand holds, in the order of the specification."""
    commands = []
    for lease in ctx.held_objects:
        command = _follow(ctx, lease)
        if command is not None:
            commands.append(command)
    return tuple(commands)


def _follow(ctx: Context, lease: LeaseState) -> ObjectCommand | None:
    hands = [g for g in lease.grants if g.engagement]
    if not hands:
        lease.lead = 0
        return None
    leader = min(hands, key=lambda g: g.engagement)
    source = leader.source
    assert source is not None
    assert source.pose_world is not None
    T_world_hand = (source.pose_world.p, source.pose_world.q)
    if lease.lead != leader.engagement:
        T_now = lease.T_world_object if lease.lead else ctx.view.object_pose(lease.target)
        lease.T_hand_object = Pose(*compose(inverse(T_world_hand), (T_now.p, T_now.q)))
        lease.lead = leader.engagement
    offset = lease.T_hand_object
    lease.T_world_object = Pose(*compose(T_world_hand, (offset.p, offset.q)))
    return ObjectCommand(lease.target, lease.lead, lease.T_world_object)
