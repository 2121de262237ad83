"""Depth pictures of a room with tables and boxes: by intersecting rays, with the noise and the holes of a camera."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from anchors.camera import CameraModel

#: Inner corners of the room; boxes in it: low corner, high corner, red, green, blue [m].
ROOM: Final = ((-2.2, -2.2, 0.0), (2.2, 2.2, 2.6))
BOXES: Final = (
    ((0.3, -0.8, 0.70), (1.1, 0.8, 0.75), (150, 110, 70)),
    ((0.35, -0.75, 0.0), (0.41, -0.69, 0.7), (90, 90, 95)),
    ((0.35, 0.69, 0.0), (0.41, 0.75, 0.7), (90, 90, 95)),
    ((1.0, -0.75, 0.0), (1.06, -0.69, 0.7), (90, 90, 95)),
    ((1.0, 0.69, 0.0), (1.06, 0.75, 0.7), (90, 90, 95)),
    ((0.45, -0.5, 0.75), (0.65, -0.25, 0.93), (190, 60, 50)),
    ((0.60, 0.10, 0.75), (0.78, 0.40, 0.87), (60, 120, 190)),
    ((0.85, -0.1, 0.75), (0.95, 0.0, 1.05), (70, 160, 80)),
    ((1.5, -1.8, 0.0), (2.1, -0.9, 1.7), (200, 195, 180)),
    ((-0.4, 0.9, 0.0), (0.1, 1.5, 0.45), (120, 80, 140)),
)
#: Corners of the crop box of the benchmark: table, what is on it, and what is around it [m].
WORKSPACE: Final = ((-0.6, -1.6, -0.1), (1.9, 1.6, 2.0))
#: Standard deviation of a depth, divided by its square [1/m]: of a stereo camera, whose errors extend over the pixels
#: that it matches together, and beside it of single pixels.
NOISE: Final = 0.0015
NOISE_PIXELS: Final = 8
GRAIN: Final = 0.0003
#: Share of the pixels without a measurement, alone and in patches.
HOLES: Final = 0.02
PATCHES: Final = 60


class RoomPicture(NamedTuple):
    """A depth picture [mm], its colours, and the pose of its camera (4, 4)."""

    depth: npt.NDArray[np.uint16]
    color: npt.NDArray[np.uint8]
    T_world_camera: npt.NDArray[np.float64]


def make_room_camera(width: int, height: int) -> CameraModel:
    """Return a camera of that size with a field of view of 70 degrees."""
    focal = 0.5 * width / math.tan(math.radians(35.0))
    return CameraModel(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))


def make_room_pose(angle: float, height_m: float = 1.5) -> npt.NDArray[np.float64]:
    """Return the pose of a camera at an angle around the table, which looks at it."""
    target = np.array((0.7, 0.0, 0.7))
    place = np.array((0.7 - 1.5 * math.cos(angle), 1.5 * math.sin(angle), height_m))
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = place
    return pose


def render_room(camera: CameraModel, T_world_camera: npt.NDArray[np.float64], seed: int) -> RoomPicture:
    """Render the room for a camera without lens distortion.

    Args:
        camera: Its intrinsics.
        T_world_camera: Its pose.
        seed: Of noise and holes.
    """
    random = np.random.default_rng(seed)
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=2)
    rays = (rays @ T_world_camera[:3, :3].T).astype(np.float32)
    rays[rays == 0.0] = 1e-9
    place = T_world_camera[:3, 3].astype(np.float32)
    walls = (np.where(rays > 0.0, *(np.array(corner, np.float32) for corner in ROOM[::-1])) - place) / rays
    z = walls.min(axis=2)
    color = np.array(((215, 210, 200), (205, 210, 215), (130, 120, 110)), np.uint8)[walls.argmin(axis=2)]
    for low, high, paint in BOXES:
        sides = np.stack([(np.array(corner, np.float32) - place) / rays for corner in (low, high)])
        enter, leave = sides.min(axis=0).max(axis=2), sides.max(axis=0).min(axis=2)
        hit = (enter > 0.0) & (enter < leave) & (enter < z)
        z[hit] = enter[hit]
        color[hit] = paint
    grain = random.integers(-12, 13, u.shape, np.int8)[..., None]
    color = np.clip(color.astype(np.int16) + grain, 0, 255).astype(np.uint8)
    wide = random.standard_normal((z.shape[0] // NOISE_PIXELS, z.shape[1] // NOISE_PIXELS), np.float32) * np.float32(
        NOISE
    )
    noise = np.asarray(cv2.resize(wide, z.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
    z += (noise + random.standard_normal(z.shape, np.float32) * np.float32(GRAIN)) * z**2
    z[random.random(z.shape, np.float32) < HOLES] = 0.0
    for row, column in random.integers(0, z.shape, (PATCHES, 2)):
        z[row : row + camera.height // 40, column : column + camera.width // 40] = 0.0
    return RoomPicture(np.clip(np.rint(z * 1000.0), 0, 65_535).astype(np.uint16), color, T_world_camera)
