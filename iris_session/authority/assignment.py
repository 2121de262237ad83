"""Assignment policies: which robot a participant gets when it asks for none by name, and which it may ask for.

`config`: the robots that the configuration gives to its name. `join-order`: the first free robot. `nearest`: the free
robot whose end effector is nearest to the participant's head. `director`: none, a director assigns.
"""

from __future__ import annotations

from anchors.pose import apply, distance
from iris_session.authority.context import Context
from iris_session.authority.state import Participant
from iris_session.protocol.common import Denial
from iris_session.protocol.names import AssignmentPolicy, DenialReason, Device, Role


def permitted(ctx: Context, p: Participant, robots: tuple[str, ...]) -> Denial | None:
    """`None` when the policy lets `p` ask for `robots` by name. Directors may ask for any."""
    if p.role == Role.DIRECTOR:
        return None
    if ctx.config.policy == AssignmentPolicy.DIRECTOR:
        return Denial(DenialReason.POLICY, "a director assigns the robots of this session", "ask a director")
    if ctx.config.policy == AssignmentPolicy.CONFIG:
        for owner, names in ctx.config.assignments.items():
            for robot in robots:
                if robot in names and owner != p.name and robot not in ctx.config.assignments.get(p.name, ()):
                    text = f"the configuration gives {robot} to {owner}"
                    return Denial(DenialReason.POLICY, text, "acquire without names to get your own", robot)
    return None


def choose(ctx: Context, p: Participant, free: list[str]) -> tuple[str, ...] | Denial:
    """Robots for `p`, who named none: out of `free`, or (policy `config`) all of its own. Empty: none is free."""
    policy = ctx.config.policy
    if policy == AssignmentPolicy.DIRECTOR and p.role != Role.DIRECTOR:
        return Denial(DenialReason.POLICY, "a director assigns the robots of this session", "ask a director")
    if policy == AssignmentPolicy.CONFIG:
        robots = ctx.config.assignments.get(p.name, ())
        if not robots:
            text = f"the configuration assigns no robot to {p.name}"
            return Denial(DenialReason.POLICY, text, "name the robot, or add the name to `assignments`")
        return tuple(robots)
    if policy == AssignmentPolicy.NEAREST:
        return _nearest(ctx, p, free)
    return tuple(free[:1])


def _nearest(ctx: Context, p: Participant, free: list[str]) -> tuple[str, ...] | Denial:
    head = p.seen.get(Device.HEAD)
    if p.alignment is None or head is None or head.pose is None:
        if p.needs_alignment:
            text = "the nearest robot is not known before your headset is aligned"
            return Denial(DenialReason.UNALIGNED, text, "look at an anchor sheet, then acquire again")
        return tuple(free[:1])
    T = p.alignment.T_world_tracking
    p_world = apply((T.p, T.q), head.pose.p)
    return tuple(sorted(free, key=lambda robot: distance(ctx.view.tip_pose(robot).p, p_world))[:1])
