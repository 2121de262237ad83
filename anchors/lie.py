"""Rotations and rigid transforms as numpy arrays, many at once: the group operations behind solvers.

Quaternions are `(..., 4)` with w first, rotation vectors `(..., 3)` [rad], poses a pair of positions `(..., 3)` [m] and
quaternions. Perturbations are on the left: `exp(r) * q`. Single poses on hot paths: `anchors.pose`.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from anchors.pose import Quat, Vec3, quat_from_rotvec, quat_normalize

Array = NDArray[np.float64]

_SMALL: Final = 1e-7  # [rad] below it the series of sine and cosine are exact to double precision
_LEFT: Final = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
_LEFT_SIGN: Final = np.array(
    [[1.0, -1.0, -1.0, -1.0], [1.0, 1.0, -1.0, 1.0], [1.0, 1.0, 1.0, -1.0], [1.0, -1.0, 1.0, 1.0]]
)
_CONJUGATE: Final = np.array([1.0, -1.0, -1.0, -1.0])


def quat_multiply(a: Array, b: Array) -> Array:
    """Return the Hamilton product of quaternions `(..., 4)`: the rotation `b` followed by `a`."""
    if b.ndim == 1:  # many by one: a product with a matrix is one call
        w, x, y, z = b.tolist()
        return np.asarray(a @ np.array([[w, x, y, z], [-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]]))
    left = a[..., _LEFT] * _LEFT_SIGN  # a * b is this matrix times b
    return np.asarray((left @ b[..., None])[..., 0])


def quat_conjugate(q: Array) -> Array:
    """Return the inverse of unit quaternions `(..., 4)`."""
    return np.asarray(q * _CONJUGATE)


def quat_exp(r: Array) -> Array:
    """Return unit quaternions `(..., 4)` of rotation vectors `(..., 3)` [rad], smooth at zero."""
    if r.ndim == 1:  # one alone: plain floats are faster
        return np.array(quat_from_rotvec((float(r[0]), float(r[1]), float(r[2]))))
    angle = np.linalg.norm(r, axis=-1, keepdims=True)
    safe = np.maximum(angle, _SMALL)
    scale = np.where(angle < _SMALL, 0.5, np.sin(0.5 * safe) / safe)
    return np.concatenate((np.cos(0.5 * angle), scale * r), axis=-1)


def quat_log(q: Array) -> Array:
    """Return the shortest rotation vectors `(..., 3)` [rad] of unit quaternions `(..., 4)`, smooth at zero."""
    w, v = q[..., :1], q[..., 1:]
    n = np.sqrt(np.add.reduce(v * v, axis=-1, keepdims=True))
    half = np.arctan2(n, np.abs(w)) / np.maximum(n, 1e-150)  # half the angle over n, which tends to 1 / w
    return np.asarray(np.copysign(2.0, w) * half * v)


def quat_to_matrix(q: Array) -> Array:
    """Return rotation matrices `(..., 3, 3)` of unit quaternions `(..., 4)`."""
    w, x, y, z = q.tolist() if q.ndim == 1 else (q[..., 0], q[..., 1], q[..., 2], q[..., 3])
    values = (
        *(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        *(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        *(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    R = np.empty((*q.shape[:-1], 9))
    for i, value in enumerate(values):
        R[..., i] = value
    return R.reshape(*q.shape[:-1], 3, 3)


def quat_from_matrix(R: Array) -> Array:
    """Return the unit quaternion (4,), w >= 0, of a rotation matrix (3, 3) (Shepperd 1978: greatest of four forms)."""
    t = float(np.trace(R))
    candidates = (t, float(R[0, 0]), float(R[1, 1]), float(R[2, 2]))
    k = candidates.index(max(candidates))
    if k == 0:
        q = np.array([1.0 + t, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    else:
        i, j, m = k - 1, k % 3, (k + 1) % 3
        q = np.zeros(4)
        q[0] = R[m, j] - R[j, m]
        q[1 + i] = 1.0 + R[i, i] - R[j, j] - R[m, m]
        q[1 + j] = R[j, i] + R[i, j]
        q[1 + m] = R[m, i] + R[i, m]
    q = q / np.linalg.norm(q)
    return np.asarray(-q if q[0] < 0.0 else q)


def to_vec3(v: Array) -> Vec3:
    """Return a vector (3,) as plain floats."""
    x, y, z = v.tolist()
    return x, y, z


def to_quat(q: Array) -> Quat:
    """Return a quaternion (4,) as plain floats of unit length."""
    w, x, y, z = q.tolist()
    return quat_normalize((w, x, y, z))


def skew(v: Array) -> Array:
    """Return cross-product matrices `(..., 3, 3)`: `skew(a) @ b == cross(a, b)`."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def left_jacobian(r: Array) -> Array:
    """Return the left Jacobian (3, 3) of SO(3) at `r`: exp(r + d) ~ exp(J d) exp(r) (Barfoot 2017, eq. 7.77)."""
    angle = float(np.linalg.norm(r))
    K = skew(r)
    if angle < 1e-4:  # series: the closed forms cancel
        return np.asarray(np.eye(3) + 0.5 * K + K @ K / 6.0)
    return np.asarray(np.eye(3) + (1.0 - np.cos(angle)) / angle**2 * K + (angle - np.sin(angle)) / angle**3 * (K @ K))


def swing(q: Array) -> Array:
    """Return the tilt of rotations `(..., 4)` as rotation vectors `(..., 2)` (x, y) [rad].

    The tilt is the swing of the swing-twist decomposition about Z, `q = swing * twist` (Dobrowolski 2015).
    """
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    n = np.sqrt(w * w + z * z)
    safe = np.maximum(n, 1e-12)
    # swing = q * conj(twist), twist = (w, 0, 0, z) / n: its vector part is (xw - yz, yw + xz, 0) / n, its scalar n.
    sx, sy = (x * w - y * z) / safe, (y * w + x * z) / safe
    s = np.sqrt(sx * sx + sy * sy)
    scale = np.where(s < 1e-12, 2.0, 2.0 * np.arctan2(s, n) / np.maximum(s, 1e-12))
    return np.stack((scale * sx, scale * sy), axis=-1)
