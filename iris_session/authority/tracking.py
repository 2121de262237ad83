"""Plausibility of measured poses: jumps, surprises and repeats, by what the last motion of the device explains.

A device that measures (head, controller, hand) moves on steadily: its next pose lies near its last one moved on with
its last velocity. A pose further off is a surprise. It waits, and the next one decides:

- back on the old way: the surprise was an outlier, and never drove;
- elsewhere, and the velocities before and after the surprise do not explain the way between them: a jump;
- else the device was accelerated, and drives on.

A pose that not even the acceleration of a table tennis stroke explains is a jump at once. No bound grows with
silence: a time without poses counts as one interval of the slowest device.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from anchors.pose import quat_conj, quat_mul, quat_to_rotvec
from iris_session.authority.config import SpeedLimit
from iris_session.protocol.common import Pose, Vec3

STEADY: Final = "steady"
OUTLIER: Final = "outlier"  # steady, and the pose before was an outlier
SURPRISE: Final = "surprise"
JUMP: Final = "jump"

#: Interval of the slowest device [s]: no longer time makes room for motion.
LONGEST_S: Final = 1.0 / 30.0
#: A longer time between two poses is a silence [s].
SILENCE_S: Final = 1.5 * LONGEST_S
#: Times of capture may be coarse, or go back [s].
SHORTEST_S: Final = 0.004
#: Share of the way in one interval at recent speed, by which a way may change before it surprises: a hand that is
#: shaken with 5 Hz at 30 samples a second, and a wrist that is turned by 2 rad in 0.13 s.
SHARE: Final = 0.45
TURN_SHARE: Final = 0.8
#: Arms follow no hand that is faster [m/s]: what a hand is faster by may change within one interval.
FAST_M_PER_S: Final = 1.5
#: Speed counts as recent for so long [s], less and less.
MEMORY_S: Final = 1.0
#: Floats of a pose at the origin of its frame: the zero of some runtimes, as float32.
ZERO_TOLERANCE: Final = 1e-6

ZERO: Final[Vec3] = (0.0, 0.0, 0.0)


class Track(msgspec.Struct, array_like=True):
    """The way of one device in its tracking frame. A pose that is repeated to the last bit counts once.

    `pose` was captured at `pose_ns` with velocities `v` [m/s] and `w` [rad/s]. `speed`, `turn_speed`: recent
    ones, which fade. `surprise`: a later pose, of `surprise_ns`, that waits. `same_ns`: since when the newest
    pose is the same.
    """

    pose: Pose
    pose_ns: int
    same_ns: int
    v: Vec3 = ZERO
    w: Vec3 = ZERO
    speed: float = 0.0
    turn_speed: float = 0.0
    surprise: Pose | None = None
    surprise_ns: int = 0


class _Step(msgspec.Struct, frozen=True):
    """Displacement `d` [m] and turn `r` [rad] in `dt` seconds."""

    dt: float
    d: Vec3
    r: Vec3


def is_zero_pose(pose: Pose) -> bool:
    """Return true for the origin of the tracking frame, unturned."""
    w, *others = pose.q
    return abs(abs(w) - 1.0) <= ZERO_TOLERANCE and all(abs(c) <= ZERO_TOLERANCE for c in (*pose.p, *others))


def is_repeat(track: Track, pose: Pose) -> bool:
    """Return true for the newest pose again, to the last bit."""
    return pose == (track.pose if track.surprise is None else track.surprise)


def follow_pose(track: Track, limit: SpeedLimit, pose: Pose, capture_ns: int) -> str:
    """Take the next pose of a device into its track.

    Returns:
        `STEADY`; `OUTLIER`; `SURPRISE`: the pose must not drive yet; `JUMP`: the track begins anew with it.
    """
    if is_repeat(track, pose):
        return STEADY if track.surprise is None else SURPRISE
    track.same_ns = capture_ns
    verdict = _judge_pose(track, limit, pose, capture_ns)
    if verdict == JUMP:
        track.pose, track.pose_ns, track.surprise = pose, capture_ns, None
        track.v, track.w, track.speed, track.turn_speed = ZERO, ZERO, 0.0, 0.0
    return verdict


def _judge_pose(track: Track, limit: SpeedLimit, pose: Pose, capture_ns: int) -> str:
    whole = _measure_step(track.pose, track.pose_ns, pose, capture_ns)
    verdict = _judge_step(track, limit, whole)
    if track.surprise is None:
        if verdict == STEADY:
            if not 0 <= capture_ns - track.pose_ns < SHORTEST_S * 1e9:  # else no velocity: measured with the next one
                _advance(track, whole, pose, capture_ns)
        elif verdict == SURPRISE:
            track.surprise, track.surprise_ns = pose, capture_ns
        return verdict
    surprise, surprise_ns, track.surprise = track.surprise, track.surprise_ns, None
    if verdict == STEADY:
        _advance(track, whole, pose, capture_ns)
        return OUTLIER
    step = _measure_step(track.pose, track.pose_ns, surprise, surprise_ns)
    after = _measure_step(surprise, surprise_ns, pose, capture_ns)
    dt = min(step.dt, LONGEST_S)
    speed = max(track.speed, math.hypot(*after.d) / after.dt)
    turn_speed = max(track.turn_speed, math.hypot(*after.r) / after.dt)
    excess = _find_excess(step.d, step.dt, track.v, after.d, after.dt)
    excess_rad = _find_excess(step.r, step.dt, track.w, after.r, after.dt)
    if excess > _find_slack(limit, speed, step.dt) or excess_rad > limit.noise_rad + TURN_SHARE * turn_speed * dt:
        return JUMP
    _advance(track, step, surprise, surprise_ns)
    if _judge_step(track, limit, after) == JUMP:
        return JUMP
    _advance(track, after, pose, capture_ns)
    return STEADY


def _measure_step(a: Pose, a_ns: int, b: Pose, b_ns: int) -> _Step:
    turn = quat_mul(b.q, quat_conj(a.q))
    if turn[0] < 0.0:
        turn = (-turn[0], -turn[1], -turn[2], -turn[3])
    d = (b.p[0] - a.p[0], b.p[1] - a.p[1], b.p[2] - a.p[2])
    return _Step(max(SHORTEST_S, (b_ns - a_ns) * 1e-9), d, quat_to_rotvec(turn))


def _judge_step(track: Track, limit: SpeedLimit, step: _Step) -> str:
    """Return whether a step continues the track, surprises, or cannot be."""
    dt = min(step.dt, LONGEST_S)
    off, off_rad = _subtract_way(step.d, track.v, step.dt), _subtract_way(step.r, track.w, step.dt)
    apart, apart_rad = math.hypot(*off), math.hypot(*off_rad)
    possible = (
        apart <= limit.linear_acceleration * dt * dt + limit.noise_m
        and apart_rad <= limit.angular_acceleration * dt * dt + limit.noise_rad
        and math.hypot(*step.d) <= limit.linear * step.dt + limit.noise_m
        and math.hypot(*step.r) <= limit.angular * step.dt + limit.noise_rad
    )
    if not possible:
        return JUMP
    steady = (
        apart <= _find_slack(limit, track.speed, step.dt)
        and apart_rad <= limit.noise_rad + TURN_SHARE * track.turn_speed * dt
    )
    return STEADY if steady else SURPRISE


def _find_slack(limit: SpeedLimit, speed: float, dt: float) -> float:
    """Return by how much the way in `dt` may differ from that of the interval before, without a surprise [m].

    After a silence it is a choice, not a sum: the next pose tells a device that was accelerated from one that jumped.
    """
    counted = min(dt, LONGEST_S)
    change = (SHARE * speed + max(0.0, speed - FAST_M_PER_S)) * counted
    return max(limit.noise_m, change) if dt > SILENCE_S else limit.noise_m + change


def _find_excess(way: Vec3, dt: float, v: Vec3, next_way: Vec3, next_dt: float) -> float:
    """Return by how much a way in `dt` differs from what the mean of the velocities before (`v`) and after it explains.

    A way that falls short of it, in the direction in which it surprises, is that of a device that is accelerated.
    """
    off = _subtract_way(way, v, dt)
    apart = math.hypot(*off)
    if apart <= 0.0:
        return 0.0
    x, y, z = (0.5 * (v[i] + next_way[i] / next_dt) for i in range(3))
    excess = _subtract_way(way, (x, y, z), dt)
    along = min(0.0, sum(a * b for a, b in zip(excess, off, strict=True))) / (apart * apart)
    return math.hypot(*_subtract_way(excess, off, along))


def _subtract_way(way: Vec3, v: Vec3, dt: float) -> Vec3:
    return (way[0] - v[0] * dt, way[1] - v[1] * dt, way[2] - v[2] * dt)


def _advance(track: Track, step: _Step, pose: Pose, capture_ns: int) -> None:
    x, y, z = step.d
    a, b, c = step.r
    kept = max(0.0, 1.0 - step.dt / MEMORY_S)
    track.v, track.w = (x / step.dt, y / step.dt, z / step.dt), (a / step.dt, b / step.dt, c / step.dt)
    track.speed = max(track.speed * kept, math.hypot(*track.v))
    track.turn_speed = max(track.turn_speed * kept, math.hypot(*track.w))
    track.pose, track.pose_ns = pose, capture_ns
