"""The clutch: relative motion of hands, latched at engagement, blended when several participants share a robot;
leaders.

At engagement the device pose and the robot's own commanded target are latched; from then on the target moves as the
device has moved since: translation times `scale`, rotation about the world's axes, applied to the latched orientation.
One source of full weight is computed from the latch itself, so rounding never accumulates. Several sources (mode
`shared`) are blended by increments since each one's previous sample, so joining or leaving moves no target, but that of
an absolute source that is left alone is the pose that it states.

Leader robots control in joint space: the follower takes the leader's joints, ramped when they are apart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from anchors.pose import (
    PoseTuple,
    Vec3,
    quat_conj,
    quat_from_rotvec,
    quat_mul,
    quat_normalize,
    quat_to_rotvec,
)
from iris_session.control.arm_model import Floats
from iris_session.control.config import ControlConfig, ControlError
from iris_session.protocol.common import Pose
from iris_session.protocol.steps import Command, CommandSource

Twist = tuple[float, float, float, float, float, float]
Box = tuple[Vec3, Vec3]


class SourceLatch(msgspec.Struct, array_like=True):
    """One source: its identity, and its last sample that moved the target."""

    participant: str
    device: str
    engagement: int
    weight: float
    pose0: PoseTuple | None = None
    pose: PoseTuple | None = None
    twist: Twist | None = None
    q: tuple[float, ...] = ()


class Latch(msgspec.Struct, array_like=True):
    """State of one robot's clutch. `base`: target at the latch; `target`: `T_world_tip` of the present goal."""

    kind: str
    scale: float
    base: PoseTuple
    target: PoseTuple
    sources: list[SourceLatch]
    clamped: bool = False


def to_pose_tuple(pose: Pose) -> PoseTuple:
    return (pose.p, pose.q)


def clip_scale(scale: float, low: float, high: float) -> float:
    """Return the motion scale within its limits; a scale that is not finite counts as 1."""
    return min(max(scale, low), high) if math.isfinite(scale) else 1.0


def latch_sources(command: Command, scale: float, T_world_target: PoseTuple, previous: Latch | None = None) -> Latch:
    """Latch every source of `command` against the robot's commanded target.

    Sources that were already in `previous` keep their last sample, so that their motion continues without a gap.
    """
    kept = {(s.participant, s.device, s.engagement): s for s in previous.sources} if previous else {}
    sources = []
    for source in command.sources:
        old = kept.get((source.participant, source.device, source.engagement))
        pose = old.pose if old and old.pose else source.pose_world and to_pose_tuple(source.pose_world)
        sources.append(
            SourceLatch(
                source.participant,
                source.device,
                source.engagement,
                source.weight,
                pose0=pose or None,
                pose=pose or None,
                twist=old.twist if old else None,
                q=old.q if old and old.q else source.q,
            )
        )
    return Latch(command.kind, scale, T_world_target, T_world_target, sources)


def is_continued_by(state: Latch, command: Command) -> bool:
    """Return true when the command is of the latched kind and at least one latched engagement continues in it."""
    if state.kind != command.kind:
        return False
    for new in command.sources:
        for old in state.sources:
            if (old.engagement, old.participant, old.device) == (new.engagement, new.participant, new.device):
                return True
    return False


def has_same_sources(state: Latch, command: Command, scale: float) -> bool:
    """Return true when the sources, their weights and the scale have not changed."""
    if state.scale != scale or len(state.sources) != len(command.sources):
        return False
    for old, new in zip(state.sources, command.sources, strict=True):
        if (
            old.engagement != new.engagement
            or old.participant != new.participant
            or old.device != new.device
            or old.weight != new.weight
        ):
            return False
    return True


def follow_poses(state: Latch, sources: Sequence[CommandSource], box: Box | None) -> None:
    """Move `state.target` by the newest samples of pose sources; twists are stored for `integrate_twists`."""
    if len(sources) == 1 and sources[0].weight == 1.0 and sources[0].pose_world is not None:
        pose = to_pose_tuple(sources[0].pose_world)
        old = state.sources[0]
        if sources[0].absolute:
            state.target = pose
        else:
            old.pose0 = old.pose0 or pose
            state.target = _move_relative(state.base, old.pose0, pose, state.scale)
        old.pose = pose
    else:
        for old, new in zip(state.sources, sources, strict=True):
            _add_increment(state, old, new)
    _clamp_target(state, box)


def integrate_twists(state: Latch, dt: float, speed: float, angular_speed: float, box: Box | None) -> bool:
    """Move the target by the weighted twists of all sources over `dt` [s], speeds bounded. Return false when nothing
    moves.
    """
    v, w = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for source in state.sources:
        if source.twist is not None:
            t, k = source.twist, source.weight
            v = (v[0] + k * t[0], v[1] + k * t[1], v[2] + k * t[2])
            w = (w[0] + k * t[3], w[1] + k * t[4], w[2] + k * t[5])
    v, w = _limit_length(v, speed / state.scale), _limit_length(w, angular_speed)
    if v == (0.0, 0.0, 0.0) == w:
        return False
    step = dt * state.scale
    p, q = state.target
    p = (p[0] + v[0] * step, p[1] + v[1] * step, p[2] + v[2] * step)
    turn = quat_from_rotvec((w[0] * dt, w[1] * dt, w[2] * dt))
    state.target = (p, quat_normalize(quat_mul(turn, q)))
    _clamp_target(state, box)
    return True


def step_toward(T_from: PoseTuple, T_to: PoseTuple, distance: float, angle: float) -> PoseTuple:
    """Return `T_to`, or the pose on the way to it that is at most `distance` [m] and `angle` [rad] from `T_from`."""
    (p, q), (p_to, q_to) = T_from, T_to
    d = (p_to[0] - p[0], p_to[1] - p[1], p_to[2] - p[2])
    r = quat_to_rotvec(quat_mul(q_to, quat_conj(q)))
    length, turn = _norm(d), _norm(r)
    share = max(length / distance, turn / angle)
    if share <= 1.0:
        return T_to
    k = 1.0 / share
    part = quat_from_rotvec((k * r[0], k * r[1], k * r[2]))
    return ((p[0] + k * d[0], p[1] + k * d[1], p[2] + k * d[2]), quat_normalize(quat_mul(part, q)))


def measure_separation(T_a: PoseTuple, T_b: PoseTuple) -> tuple[float, float]:
    """Return distance [m] and angle [rad] between two poses."""
    (pa, qa), (pb, qb) = T_a, T_b
    return _norm((pb[0] - pa[0], pb[1] - pa[1], pb[2] - pa[2])), _norm(quat_to_rotvec(quat_mul(qb, quat_conj(qa))))


def _move_relative(base: PoseTuple, start: PoseTuple, now: PoseTuple, scale: float) -> PoseTuple:
    (b, qb), (p0, q0), (p, q) = base, start, now
    moved = (b[0] + scale * (p[0] - p0[0]), b[1] + scale * (p[1] - p0[1]), b[2] + scale * (p[2] - p0[2]))
    if q == q0:
        return (moved, qb)
    return (moved, quat_normalize(quat_mul(quat_mul(q, quat_conj(q0)), qb)))


def _add_increment(state: Latch, old: SourceLatch, new: CommandSource) -> None:
    """Move the target by a source's motion since its previous sample. That of an absolute one is not scaled."""
    if new.twist_world is not None:
        old.twist = new.twist_world
    if new.pose_world is None:
        return
    pose = to_pose_tuple(new.pose_world)
    (p0, q0), (p, q), k = old.pose or pose, pose, new.weight * (1.0 if new.absolute else state.scale)
    r = quat_to_rotvec(quat_mul(q, quat_conj(q0)))
    turn = quat_from_rotvec((new.weight * r[0], new.weight * r[1], new.weight * r[2]))
    (t, qt) = state.target
    moved = (t[0] + k * (p[0] - p0[0]), t[1] + k * (p[1] - p0[1]), t[2] + k * (p[2] - p0[2]))
    state.target = (moved, quat_normalize(quat_mul(turn, qt)))
    old.pose = pose


def _clamp_target(state: Latch, box: Box | None) -> None:
    """Keep the target inside the workspace box, widened to where the robot was at the latch (no jump into it)."""
    if box is None:
        return
    p, b = state.target[0], state.base[0]
    x, y, z = (min(max(p[i], min(box[0][i], b[i])), max(box[1][i], b[i])) for i in range(3))
    state.clamped = (x, y, z) != p
    state.target = ((x, y, z), state.target[1])


def _norm(v: Vec3) -> float:
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


def _limit_length(v: Vec3, limit: float) -> Vec3:
    n = _norm(v)
    return v if n <= limit else (v[0] * limit / n, v[1] * limit / n, v[2] * limit / n)


def compute_leader_goal(state: Latch, sources: Sequence[CommandSource], goal: Floats, config: ControlConfig) -> Floats:
    """Return the new joint goal, shape (n,).

    One source of full weight: its joints, predicted by `qd` across the interpolation delay. Several (mode `shared`):
    the present `goal` plus their weighted increments.
    """
    n = len(goal)
    single = len(sources) == 1 and sources[0].weight == 1.0
    for old, new in zip(state.sources, sources, strict=True):
        if len(new.q) != n or len(new.qd) not in (0, n):
            raise ControlError(f"joint sample of {new.participant!r} has {len(new.q)} joints; it must have {n}")
        q = np.array(new.q)
        if single:
            goal = q
            if new.qd:
                bound = config.leader_lookahead_max
                goal = q + np.clip(np.array(new.qd) * config.leader_lookahead_s, -bound, bound)
        else:
            goal = goal + new.weight * (q - np.array(old.q or new.q))
        old.q = new.q
    return goal


def is_ramping(active: bool, apart: float, config: ControlConfig) -> bool:
    """Return true while the follower is ramped: from `leader_apart` [rad] on, until it has caught up."""
    return apart > (config.leader_caught_up if active else config.leader_apart)
