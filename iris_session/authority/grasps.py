"""Free objects held by hands without a robot.

The hand that engaged first leads: the object follows it with the offset latched at that moment. When it lets go while
another hand holds, the offset to that one is latched from the object's last commanded pose, so nothing jumps.
"""

from __future__ import annotations

import math
from typing import Final

from anchors.pose import compose, inverse
from iris_session.authority import engagement
from iris_session.authority.context import Context
from iris_session.authority.state import LeaseState
from iris_session.protocol.common import Pose
from iris_session.protocol.names import HoldReason
from iris_session.protocol.steps import ObjectCommand

#: Objects farther away than this [m] have left the scene; far below what arithmetic can hold.
_FARTHEST: Final = 1e9


def _is_somewhere(T: Pose) -> bool:
    """False for the pose of an object in physics that diverged: no hand can hold that."""
    n = math.sqrt(sum(c * c for c in T.q))
    return all(abs(c) < _FARTHEST for c in T.p) and 0.5 < n < 2.0


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
        if not _is_somewhere(T_now):
            for g in hands:
                engagement.rearm(ctx, lease, g, HoldReason.REARM)
            lease.lead = 0
            return None
        lease.T_hand_object = Pose(*compose(inverse(T_world_hand), (T_now.p, T_now.q)))
        lease.lead = leader.engagement
    offset = lease.T_hand_object
    lease.T_world_object = Pose(*compose(T_world_hand, (offset.p, offset.q)))
    return ObjectCommand(lease.target, lease.lead, lease.T_world_object)
