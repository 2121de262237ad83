"""The clutch: relative motion of hands, latched at engagement, and its blending when several people share a robot.

At engagement the device pose and the robot's own commanded target are latched; from then on the target moves as the
device has moved since: translation times `scale`, rotation about the world's axes, applied to the latched orientation.
One source of full weight is computed from the latch itself, so rounding never accumulates. Several sources (mode
`shared`) are blended by increments since each one's previous sample, so nobody's joining or leaving moves the target.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

from anchors.pose import (
    PoseTuple,
    Vec3,
    quat_conj,
    quat_from_rotvec,
    quat_mul,
    quat_normalize,
    quat_to_rotvec,
)
from iris_session.protocol.common import Pose
from iris_session.protocol.steps import Command, CommandSource

Twist = tuple[float, float, float, float, float, float]
Box = tuple[Vec3, Vec3]


class SourceLatch(msgspec.Struct, array_like=True):
    """One source: who it is, and the last sample of it that moved the target."""

    participant: str
    device: str
    engagement: int
    weight: float
    pose0: PoseTuple | None = None
    pose: PoseTuple | None = None
    twist: Twist | None = None
    q: tuple[float, ...] = ()


class Latch(msgspec.Struct, array_like=True):
    """State of one robot's clutch. `base`: target at the latch; `target`: `T_world_tip` asked for now."""

    kind: str
    scale: float
    base: PoseTuple
    target: PoseTuple
    sources: list[SourceLatch]
    clamped: bool = False


def pose_tuple(pose: Pose) -> PoseTuple:
    return (pose.p, pose.q)


def clip_scale(scale: float, low: float, high: float) -> float:
    """Motion scale within its limits; a scale that is no number counts as 1."""
    return min(max(scale, low), high) if math.isfinite(scale) else 1.0


def latch(command: Command, scale: float, T_world_target: PoseTuple, previous: Latch | None = None) -> Latch:
    """Latches every source of `command` against the robot's commanded target.

    Sources that were already in `previous` keep their last sample, so that their motion goes on without a gap.
    """
    kept = {(s.participant, s.device, s.engagement): s for s in previous.sources} if previous else {}
    sources = []
    for source in command.sources:
        old = kept.get((source.participant, source.device, source.engagement))
        pose = old.pose if old and old.pose else source.pose_world and pose_tuple(source.pose_world)
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


def continues(state: Latch, command: Command) -> bool:
    """True when the command is of the latched kind and at least one latched engagement goes on in it."""
    if state.kind != command.kind:
        return False
    for new in command.sources:
        for old in state.sources:
            if (old.engagement, old.participant, old.device) == (new.engagement, new.participant, new.device):
                return True
    return False


def same_sources(state: Latch, command: Command, scale: float) -> bool:
    """True when nobody joined or left and no weight nor the scale has changed."""
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


def follow(state: Latch, sources: Sequence[CommandSource], box: Box | None) -> None:
    """Moves `state.target` by the newest samples of pose sources; twists are stored for `integrate`."""
    if len(sources) == 1 and sources[0].weight == 1.0 and sources[0].pose_world is not None:
        pose = pose_tuple(sources[0].pose_world)
        old = state.sources[0]
        if sources[0].absolute:
            state.target = pose
        else:
            old.pose0 = old.pose0 or pose
            state.target = _relative(state.base, old.pose0, pose, state.scale)
        old.pose = pose
    else:
        for old, new in zip(state.sources, sources, strict=True):
            _increment(state, old, new)
    _clamp(state, box)


def integrate(state: Latch, dt: float, speed: float, angular_speed: float, box: Box | None) -> bool:
    """Moves the target by the weighted twists of all sources over `dt` [s], speeds bounded. False: nothing moves."""
    v, w = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for source in state.sources:
        if source.twist is not None:
            t, k = source.twist, source.weight
            v = (v[0] + k * t[0], v[1] + k * t[1], v[2] + k * t[2])
            w = (w[0] + k * t[3], w[1] + k * t[4], w[2] + k * t[5])
    v, w = _bounded(v, speed / state.scale), _bounded(w, angular_speed)
    if v == (0.0, 0.0, 0.0) == w:
        return False
    step = dt * state.scale
    p, q = state.target
    p = (p[0] + v[0] * step, p[1] + v[1] * step, p[2] + v[2] * step)
    turn = quat_from_rotvec((w[0] * dt, w[1] * dt, w[2] * dt))
    state.target = (p, quat_normalize(quat_mul(turn, q)))
    _clamp(state, box)
    return True


def toward(T_from: PoseTuple, T_to: PoseTuple, distance: float, angle: float) -> PoseTuple:
    """`T_to`, or the pose on the way to it that is at most `distance` [m] and `angle` [rad] from `T_from`."""
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


def separation(T_a: PoseTuple, T_b: PoseTuple) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    (pa, qa), (pb, qb) = T_a, T_b
    return _norm((pb[0] - pa[0], pb[1] - pa[1], pb[2] - pa[2])), _norm(quat_to_rotvec(quat_mul(qb, quat_conj(qa))))


def _relative(base: PoseTuple, start: PoseTuple, now: PoseTuple, scale: float) -> PoseTuple:
    (b, qb), (p0, q0), (p, q) = base, start, now
    moved = (b[0] + scale * (p[0] - p0[0]), b[1] + scale * (p[1] - p0[1]), b[2] + scale * (p[2] - p0[2]))
    if q == q0:
        return (moved, qb)
    return (moved, quat_normalize(quat_mul(quat_mul(q, quat_conj(q0)), qb)))


def _increment(state: Latch, old: SourceLatch, new: CommandSource) -> None:
    """Moves the target by a source's motion since its previous sample. That of an absolute one is not scaled."""
    if new.twist_world is not None:
        old.twist = new.twist_world
    if new.pose_world is None:
        return
    pose = pose_tuple(new.pose_world)
    (p0, q0), (p, q), k = old.pose or pose, pose, new.weight * (1.0 if new.absolute else state.scale)
    r = quat_to_rotvec(quat_mul(q, quat_conj(q0)))
    turn = quat_from_rotvec((new.weight * r[0], new.weight * r[1], new.weight * r[2]))
    (t, qt) = state.target
    moved = (t[0] + k * (p[0] - p0[0]), t[1] + k * (p[1] - p0[1]), t[2] + k * (p[2] - p0[2]))
    state.target = (moved, quat_normalize(quat_mul(turn, qt)))
    old.pose = pose


def _clamp(state: Latch, box: Box | None) -> None:
    """Keeps the target inside the workspace box, widened to where the robot was at the latch (no jump into it)."""
    if box is None:
        return
    p, b = state.target[0], state.base[0]
    x, y, z = (min(max(p[i], min(box[0][i], b[i])), max(box[1][i], b[i])) for i in range(3))
    state.clamped = (x, y, z) != p
    state.target = ((x, y, z), state.target[1])


def _norm(v: Vec3) -> float:
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


def _bounded(v: Vec3, limit: float) -> Vec3:
    n = _norm(v)
    return v if n <= limit else (v[0] * limit / n, v[1] * limit / n, v[2] * limit / n)
