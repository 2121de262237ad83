"""Alignment by a persistent anchor: a device finds a place of the room again after its program has ended.

The place was tied to an anchor of the session by an earlier alignment, and comes back in a new tracking frame. How well
a device finds it again is not stated by any of them, so the earlier covariance is inflated. Such an alignment is good
enough to look at the scene; marks touched afterwards confirm or contradict it (`confirm_alignment`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from anchors.alignment import AlignmentConfig, AlignmentEstimate
from anchors.lie import Array, quat_exp, quat_multiply, quat_to_matrix, skew, swing, to_quat, to_vec3
from anchors.pose import PoseTuple, Vec3, apply, compose, inverse
from anchors.touch import Touch, TouchNoise
from anchors.uncertainty import Z999, chi2_quantile, isotropic_covariance, length_p95, validate_covariance


@dataclass(frozen=True)
class PersistentConfig:
    """Error of a persistent anchor that was found again, our assumption: `inflation` times the standard deviations of
    the earlier alignment, and `position_sigma_m`, `rotation_sigma_rad` per axis. `unknown_m`, `unknown_rad`: standard
    deviations of an earlier alignment that states none. `max_tilt_rad`: beyond it the place contradicts gravity.
    """

    inflation: float = 2.0
    position_sigma_m: float = 0.010
    rotation_sigma_rad: float = math.radians(0.5)
    unknown_m: float = 0.010
    unknown_rad: float = math.radians(0.6)
    max_tilt_rad: float = math.radians(15.0)


def covariance_at_anchor(
    covariance: Sequence[float], pivot_world: Vec3, T_world_anchor: PoseTuple
) -> tuple[float, ...]:
    """Return the covariance of an alignment at an anchor, in its axes, to be kept with a persistent anchor.

    The axes of the anchor stay where they are in the room, whatever world and tracking frame are later.

    Args:
        covariance: 36 values, 6x6 row-major, (x, y, z [m], rx, ry, rz [rad]), world axes, at `pivot_world`.
        pivot_world: The point of the world at which it is stated.
        T_world_anchor: Pose of the anchor.

    Returns:
        36 values in the same order.
    """
    p, q = T_world_anchor
    X = np.eye(6)
    X[:3, 3:] = -skew(np.array(p) - np.array(pivot_world))
    X = np.kron(np.eye(2), quat_to_matrix(np.array(q)).T) @ X
    return tuple((X @ np.reshape(covariance, (6, 6)) @ X.T).ravel().tolist())


def inflate_covariance(covariance: Sequence[float], config: PersistentConfig | None = None) -> Array:
    """Return the covariance (6, 6) of a persistent anchor whose earlier alignment had `covariance` (36 values)."""
    c = config or PersistentConfig()
    stated = validate_covariance(covariance)
    earlier = np.reshape(stated, (6, 6)) if stated else isotropic_covariance(c.unknown_m, c.unknown_rad)
    return c.inflation**2 * earlier + isotropic_covariance(c.position_sigma_m, c.rotation_sigma_rad)


def align_persistent(
    T_world_anchor: PoseTuple,
    T_tracking_anchor: PoseTuple,
    covariance: Sequence[float],
    tracking_epoch: int,
    config: PersistentConfig | None = None,
) -> AlignmentEstimate | None:
    """Estimate `T_world_tracking` from where the anchor lies by a persistent anchor.

    Args:
        T_world_anchor: Pose of the anchor.
        T_tracking_anchor: The same in the present tracking frame.
        covariance: Of the earlier alignment at the anchor, 36 values, in its axes (`covariance_at_anchor`); empty or
            invalid: not known.
        tracking_epoch: The present tracking frame.
        config: Assumed errors.

    Returns:
        The estimate with inflated covariance, leaning as gravity says; `None` if it contradicts gravity.
    """
    config = config or PersistentConfig()
    p, q = compose(T_world_anchor, inverse(T_tracking_anchor))
    tilt = float(np.linalg.norm(swing(np.array(q))))
    if not tilt <= config.max_tilt_rad:
        return None
    R = np.kron(np.eye(2), quat_to_matrix(np.array(T_world_anchor[1])))
    C = R @ inflate_covariance(covariance, config) @ R.T
    raw = AlignmentEstimate((p, q), tracking_epoch, (), T_world_anchor[0], 0.0, tilt, 1, 1, False, "")
    sigma = AlignmentConfig().tilt_sigma_rad
    H = np.zeros((2, 6))
    H[0, 3] = H[1, 4] = 1.0
    return _update(raw, C, -swing(np.array(q)), H, np.eye(2) * sigma**2)


def confirm_alignment(
    kept: AlignmentEstimate,
    points_world: Mapping[str, Vec3],
    touches: Sequence[Touch],
    tips: Mapping[str, Sequence[float]] | None = None,
) -> AlignmentEstimate:
    """Combine an alignment by a persistent anchor with touches of one mark or more.

    Args:
        kept: Result of `align_persistent`.
        points_world: Positions of the marks.
        touches: Touches in the same tracking frame.
        tips: Covariance of each calibrated tip, 3x3 row-major in the frame of its controller [m^2].

    Returns:
        The combined estimate, refused with advice if the touches contradict the persistent anchor.
    """
    names = sorted({t.point for t in touches})
    by_name = [[t for t in touches if t.point == name] for name in names]
    tip = [np.mean([t.p_tracking_tip for t in same], axis=0).tolist() for same in by_name]
    x = np.array([apply(kept.T_world_tracking, (p[0], p[1], p[2])) for p in tip])
    z = np.array([points_world[name] for name in names]) - x
    J = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(x), 3, 3)), -skew(x - np.array(kept.pivot_world))], axis=2
    ).reshape(-1, 6)
    R = np.kron(np.eye(len(names)), quat_to_matrix(np.array(kept.T_world_tracking[1])))
    noise = R @ TouchNoise.of_touches(by_name, tips or {}).covariance @ R.T
    C = np.reshape(kept.covariance, (6, 6))
    misfit = float(z.ravel() @ np.linalg.solve(J @ C @ J.T + noise, z.ravel()))
    if not misfit <= chi2_quantile(3.0 * len(names), Z999):
        worst = int(np.argmax(np.linalg.norm(z, axis=1)))
        off = f"'{names[worst]}' lies {float(np.linalg.norm(z[worst])) * 1e3:.0f} mm from where the kept anchor says"
        return replace(kept, refused=True, advice=f"{off}: touch it again, or touch three marks", n_observations=0)
    return replace(_update(kept, C, z.ravel(), J, noise), n_observations=len(touches))


def _update(before: AlignmentEstimate, C: Array, z: Array, H: Array, noise: Array) -> AlignmentEstimate:
    """Return the estimate corrected by `z = H d + noise`, with d: motion of the pivot and rotation about it, and C its
    covariance before."""
    gain = C @ H.T @ np.linalg.inv(H @ C @ H.T + noise)
    d = gain @ z
    keep = np.eye(6) - gain @ H
    C = keep @ C @ keep.T + gain @ noise @ gain.T
    p_pivot = apply(inverse(before.T_world_tracking), before.pivot_world)
    q = quat_multiply(quat_exp(d[3:]), np.array(before.T_world_tracking[1]))
    pivot = np.array(before.pivot_world) + d[:3]
    t = pivot - quat_to_matrix(q) @ np.array(p_pivot)
    return replace(
        before,
        T_world_tracking=(to_vec3(t), to_quat(q)),
        covariance=tuple(C.ravel().tolist()),
        pivot_world=to_vec3(pivot),
        error_at_anchor_m=length_p95(C[:3, :3]),
    )
