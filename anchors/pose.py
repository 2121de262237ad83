"""Rigid transforms as plain tuples of floats, for hot paths and exact journals: no numpy, no allocation to speak of.

A pose `T_a_b` is a pair `(p, q)`: position `p` of frame b in a [m] and unit quaternion `q = (w, x, y, z)` that turns
vectors of b into a. Every function is a pure float computation in a fixed order, so results are reproducible bit for
bit on one machine.
"""

from __future__ import annotations

import math
from typing import Final

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
PoseTuple = tuple[Vec3, Quat]

IDENTITY_QUAT: Final[Quat] = (1.0, 0.0, 0.0, 0.0)
IDENTITY_POSE: Final[PoseTuple] = ((0.0, 0.0, 0.0), IDENTITY_QUAT)


def quat_mul(a: Quat, b: Quat) -> Quat:
    """Return the Hamilton product `a * b`: the rotation `b` followed by `a`."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def quat_conj(q: Quat) -> Quat:
    """Return the inverse of a unit quaternion."""
    return (q[0], -q[1], -q[2], -q[3])


def quat_normalize(q: Quat) -> Quat:
    """Scale `q` to unit length.

    Raises:
        ValueError: The quaternion is zero or not finite.
    """
    n = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if not (n > 1e-12 and math.isfinite(n)):
        raise ValueError(f"quaternion {q} cannot be normalised: it must be finite and not zero")
    return (q[0] / n, q[1] / n, q[2] / n, q[3] / n)


def quat_rotate(q: Quat, v: Vec3) -> Vec3:
    """Rotate vector `v` by unit quaternion `q = (w, u)`: v + 2 w (u x v) + 2 u x (u x v)."""
    w, x, y, z = q
    vx, vy, vz = v
    tx = 2.0 * (y * vz - z * vy)
    ty = 2.0 * (z * vx - x * vz)
    tz = 2.0 * (x * vy - y * vx)
    return (
        vx + w * tx + (y * tz - z * ty),
        vy + w * ty + (z * tx - x * tz),
        vz + w * tz + (x * ty - y * tx),
    )


def quat_from_rotvec(r: Vec3) -> Quat:
    """Return the quaternion of a rotation vector [rad] (exponential map, smooth at zero)."""
    angle = math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
    s = 0.5 - angle * angle / 48.0 if angle < 1e-6 else math.sin(0.5 * angle) / angle
    return quat_normalize((math.cos(0.5 * angle), s * r[0], s * r[1], s * r[2]))


def quat_to_rotvec(q: Quat) -> Vec3:
    """Return the shortest rotation vector [rad] of a unit quaternion (logarithm, length at most pi)."""
    w, x, y, z = q if q[0] >= 0.0 else (-q[0], -q[1], -q[2], -q[3])
    n = math.sqrt(x * x + y * y + z * z)
    s = 2.0 / w if n < 1e-9 else 2.0 * math.atan2(n, w) / n
    return (s * x, s * y, s * z)


def quat_from_yaw(yaw: float) -> Quat:
    """Return the rotation about the vertical (Z) axis by `yaw` [rad]."""
    return (math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw))


def quat_angle(a: Quat, b: Quat) -> float:
    """Return the angle [rad] between two orientations, 0 to pi."""
    r = quat_to_rotvec(quat_mul(quat_conj(a), b))
    return math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])


def compose(a: PoseTuple, b: PoseTuple) -> PoseTuple:
    """Return `T_a_c = compose(T_a_b, T_b_c)`. The quaternion is normalised again, so chains do not drift."""
    r = quat_rotate(a[1], b[0])
    return (
        (a[0][0] + r[0], a[0][1] + r[1], a[0][2] + r[2]),
        quat_normalize(quat_mul(a[1], b[1])),
    )


def inverse(a: PoseTuple) -> PoseTuple:
    """Return `T_b_a` from `T_a_b`."""
    qi = quat_conj(a[1])
    r = quat_rotate(qi, a[0])
    return ((-r[0], -r[1], -r[2]), qi)


def apply(a: PoseTuple, p: Vec3) -> Vec3:
    """Transform a point from frame b to frame a: `p_a = apply(T_a_b, p_b)`."""
    r = quat_rotate(a[1], p)
    return (a[0][0] + r[0], a[0][1] + r[1], a[0][2] + r[2])


def interpolate_about_pivot(old: PoseTuple, new: PoseTuple, pivot_tracking: Vec3, share: float) -> PoseTuple:
    """Interpolate `T_world_tracking`: the pivot moves on a straight line and everything rotates about it, so that a
    small rotation moves nothing far at the anchor."""
    r = quat_to_rotvec(quat_mul(new[1], quat_conj(old[1])))
    q = quat_mul(quat_from_rotvec((share * r[0], share * r[1], share * r[2])), old[1])
    a, b = apply(old, pivot_tracking), apply(new, pivot_tracking)
    turned = quat_rotate(q, pivot_tracking)
    p = (
        a[0] + share * (b[0] - a[0]) - turned[0],
        a[1] + share * (b[1] - a[1]) - turned[1],
        a[2] + share * (b[2] - a[2]) - turned[2],
    )
    return compose((p, q), ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))


def distance(a: Vec3, b: Vec3) -> float:
    """Return the Euclidean distance [m] of two points."""
    return math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


def pose_to_dict(T: PoseTuple) -> dict[str, list[float]]:
    """Return a pose as a JSON object."""
    return {"position_m": list(T[0]), "quaternion_wxyz": list(T[1])}


def is_rigid(T: PoseTuple, reach_m: float = 1e3) -> bool:
    """Return whether untrusted numbers are a pose: finite, unit quaternion (to 1 %), coordinates within `reach_m`."""
    (x, y, z), (a, b, c, d) = T
    norm = math.sqrt(a * a + b * b + c * c + d * d)
    # Comparisons with nan are false.
    return abs(norm - 1.0) <= 1e-2 and abs(x) <= reach_m and abs(y) <= reach_m and abs(z) <= reach_m


def is_valid_point(p: Vec3 | None, reach_m: float = 1e3) -> bool:
    """Return whether untrusted numbers are a finite point within `reach_m`; `None` (unknown) is valid."""
    return p is None or (all(map(math.isfinite, p)) and max(map(abs, p)) <= reach_m)
