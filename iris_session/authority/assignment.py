"""Assignment policies: which robot a participant gets when it names none, and which ones it may name.

`config`: the robots that the configuration gives to its name, or to its key as `key:<fingerprint>`. A name is an
unverified label: use keys where participants are not trusted to use their own. `join-order`: the first free robot.
`nearest`: the free robot whose end effector is nearest to the participant's head. `director`: none, a director assigns.
"""

from __future__ import annotations

from anchors.pose import apply, distance
from iris_session.authority.config import KEY_PREFIX
from iris_session.authority.context import Context
from iris_session.authority.state import Participant
from iris_session.protocol.common import Denial
from iris_session.protocol.names import AssignmentPolicy, DenialReason, Device, Role


def check_policy(ctx: Context, p: Participant, robots: tuple[str, ...]) -> Denial | None:
    """Return `None` when the policy lets `p` ask for `robots` by name, else the denial. Directors may ask for any."""
    if p.role == Role.DIRECTOR:
        return None
    if ctx.config.policy == AssignmentPolicy.DIRECTOR:
        return Denial(DenialReason.POLICY, "a director assigns the robots of this session", "ask a director")
    if ctx.config.policy == AssignmentPolicy.CONFIG:
        own = _list_assigned_robots(ctx, p)
        for owner, names in ctx.config.assignments.items():
            for robot in robots:
                if robot in names and robot not in own:
                    taken = owner == p.name and _check_name_owner(ctx, p)
                    return taken or Denial(
                        DenialReason.POLICY,
                        f"the configuration gives {robot} to {owner}",
                        "acquire without names to get your own",
                        robot,
                    )
    return None


def _list_assigned_robots(ctx: Context, p: Participant) -> tuple[str, ...]:
    """Return the robots that the configuration gives to the key of `p`, and to its name unless another key has that
    name.

    A name that begins like a key is a name all the same, and has none.
    """
    plain = not p.name.startswith(KEY_PREFIX) and not _check_name_owner(ctx, p)
    named = ctx.config.assignments.get(p.name, ()) if plain else ()
    given = (*ctx.config.assignments.get(KEY_PREFIX + p.key_id, ()), *named)
    return tuple(dict.fromkeys(robot for robot in given if robot in ctx.robots))  # another scene may have other robots


def _check_name_owner(ctx: Context, p: Participant) -> Denial | None:
    """Return a denial when another key has the name of `p`.

    Names are unverified: the first key that joins under an assigned one has it, while it is connected or in grace.
    """
    if ctx.state.name_owners.get(p.name, p.key_id) == p.key_id:
        return None
    text = f"another participant has joined as {p.name} before, and has the robots of that name"
    advice = f"join under a name of your own, or have robots assigned to {KEY_PREFIX}{p.key_id}"
    return Denial(DenialReason.POLICY, text, advice)


def update_name_owners(ctx: Context) -> None:
    """Update which key has each assigned name after a participant joined or was removed. First come, first served."""
    owners = ctx.state.name_owners
    for name in ctx.config.assignments:
        if name.startswith(KEY_PREFIX):
            continue
        keys = [p.key_id for p in ctx.state.participants.values() if p.name == name]
        if keys and owners.get(name) not in keys:
            owners[name] = keys[0]
        elif not keys:
            owners.pop(name, None)


def choose_robots(ctx: Context, p: Participant, free: list[str]) -> tuple[str, ...] | Denial:
    """Return robots for `p`, which named none: out of `free`, or (policy `config`) all of its own. Empty: none is
    free.
    """
    policy = ctx.config.policy
    if policy == AssignmentPolicy.DIRECTOR and p.role != Role.DIRECTOR:
        return Denial(DenialReason.POLICY, "a director assigns the robots of this session", "ask a director")
    if policy == AssignmentPolicy.CONFIG:
        robots = _list_assigned_robots(ctx, p)
        if not robots:
            taken = _check_name_owner(ctx, p) if p.name in ctx.config.assignments else None
            if taken is not None:
                return taken
            text = f"the configuration assigns no robot to {p.name}"
            return Denial(DenialReason.POLICY, text, "name the robot, or add the name to `assignments`")
        return robots
    if policy == AssignmentPolicy.NEAREST:
        return _choose_nearest(ctx, p, free)
    return tuple(free[:1])


def _choose_nearest(ctx: Context, p: Participant, free: list[str]) -> tuple[str, ...] | Denial:
    head = p.seen.get(Device.HEAD)
    if p.alignment is None or head is None or head.pose is None:
        if p.needs_alignment:
            text = "the nearest robot is not known before your headset is aligned"
            return Denial(DenialReason.UNALIGNED, text, "look at an anchor sheet, then acquire again")
        return tuple(free[:1])
    T = p.alignment.T_world_tracking
    p_world = apply((T.p, T.q), head.pose.p)
    return tuple(sorted(free, key=lambda robot: distance(ctx.view.tip_pose(robot).p, p_world))[:1])
