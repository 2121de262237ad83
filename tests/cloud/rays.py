"""Depth pictures of MuJoCo scenes by rays: exact, with the geom that each pixel shows, and without a graphics card."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from anchors.camera import CameraModel
from iris_session.cloud.voxels import make_rays

Floats = NDArray[np.float64]


class RayPicture(NamedTuple):
    """What a camera sees: `points` (n, 3) [m] of the world, `geoms` (n,), and the depth picture [mm]."""

    points: Floats
    geoms: NDArray[np.int32]
    depth: NDArray[np.uint16]


def look_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> Floats:
    """Return `T_world_camera` of a camera's optical frame: x right, y down, z forward."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return pose


def cast_picture(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    camera: CameraModel,
    T_world_camera: Floats,
    noise_m: float = 0.0,
    seed: int = 0,
) -> RayPicture:
    """Look at the shown geoms. `noise_m`: standard deviation of the depth."""
    rays = make_rays(camera)
    inside = np.stack([rays.x.ravel(), rays.y.ravel(), np.ones(rays.x.size)], axis=1).astype(np.float64)
    lengths = np.linalg.norm(inside, axis=1)
    directions = np.ascontiguousarray((inside / lengths[:, None]) @ T_world_camera[:3, :3].T)
    n = len(directions)
    geoms, distance = np.full(n, -1, np.int32), np.full(n, -1.0)
    shown = np.array([1, 1, 1, 0, 0, 0], np.uint8)
    mujoco.mj_multiRay(
        model, data, T_world_camera[:3, 3].copy(), directions.ravel(), shown, True, -1, geoms, distance, None, n, 100.0
    )
    hit = (geoms >= 0) & (distance > 0.0)
    z = np.where(hit, distance / lengths, 0.0)
    z[hit] += np.random.default_rng(seed).normal(0.0, noise_m, int(hit.sum())) if noise_m else 0.0
    points = (inside[hit] * z[hit, None]) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    depth = np.clip(np.round(1e3 * z), 0, 65_534).astype(np.uint16).reshape(rays.x.shape)
    return RayPicture(points, geoms[hit], depth)
