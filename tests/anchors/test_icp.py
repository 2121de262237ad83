"""ICP mends poses of cameras on real and on computed pictures, and refuses what does not determine them."""

from __future__ import annotations

import dataclasses
import math
from functools import cache
from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anchors import icp
from anchors.camera import CameraModel
from anchors.icp import Refinement, RefinementRefusedError, refine_pose
from iris_session.cloud.voxels import DepthLimits, VoxelFilter, make_rays
from iris_session.demo.named_scenes import scene_by_name
from tests.cloud.rays import cast_picture, look_at

Floats = NDArray[np.float64]
KINECT = CameraModel(640, 480, 585.0, 585.0, 320.0, 240.0)
EYES = ((1.3, -1.2, 0.9), (-1.2, -1.3, 0.8), (0.1, 1.6, 0.7))


def bump(p_camera: Floats, seed: int, shift_m: float = 0.02, turn_deg: float = 1.0) -> Floats:
    """Return an error of the extrinsics: in a random direction, about a random axis through the camera."""
    random = np.random.default_rng(seed)
    axis, shift = (v / np.linalg.norm(v) for v in random.normal(size=(2, 3)))
    error = np.eye(4)
    error[:3, :3] = Rotation.from_rotvec(axis * math.radians(turn_deg)).as_matrix()
    error[:3, 3] = p_camera - error[:3, :3] @ p_camera + shift_m * shift
    return error


def measure_error(found: Refinement, error: Floats, p_camera: Floats) -> tuple[float, float]:
    """Return what is left of an error at the camera: [m], [deg]."""
    left = found.T_world_world @ error
    turn = np.linalg.norm(Rotation.from_matrix(left[:3, :3]).as_rotvec())
    return float(np.linalg.norm(left[:3, :3] @ p_camera + left[:3, 3] - p_camera)), math.degrees(turn)


def move(T: Floats, points: Floats) -> Floats:
    return points @ T[:3, :3].T + T[:3, 3]


@cache
def see_real_room(rgbd: Path, number: int) -> tuple[Floats, Floats]:
    """Return points and position of the camera of a real picture, by its pose."""
    path = rgbd / f"frame-{number:06d}"
    depth = cv2.imread(f"{path}.depth.png", cv2.IMREAD_UNCHANGED)
    color = cv2.imread(f"{path}.color.jpg")
    assert depth is not None
    assert color is not None
    pose = np.loadtxt(f"{path}.pose.txt")
    return make_cloud(depth.astype(np.uint16), color.astype(np.uint8), pose), pose[:3, 3]


def make_cloud(depth: NDArray[np.uint16], color: NDArray[np.uint8], pose: Floats) -> Floats:
    voxels = VoxelFilter(0.02, threads=1)
    limits = DepthLimits(low=(-9.0, -9.0, -9.0), high=(9.0, 9.0, 9.0), farthest_m=3.5)
    voxels.add_depth(depth, color, make_rays(KINECT), pose, limits=limits)
    return voxels.collect(min_points=2, min_around=4).positions.astype(np.float64)


@cache
def see_table(camera: int) -> tuple[Floats, Floats]:
    """Return points and position of a camera at the handover scene; depth has a noise of 3 mm."""
    model = scene_by_name("handover").model
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    pose = look_at(EYES[camera], (0.0, 0.0, 0.1))
    depth = cast_picture(model, data, KINECT, pose, 0.003, seed=camera).depth
    return make_cloud(depth, np.zeros((*depth.shape, 3), np.uint8), pose), pose[:3, 3]


def test_extrinsics_off_by_2_cm_and_1_degree_are_mended_on_real_frames(rgbd: Path) -> None:
    reference, _ = see_real_room(rgbd, 0)
    points, p_camera = see_real_room(rgbd, 20)
    error = bump(p_camera, 0)
    found = refine_pose(move(error, points), reference)
    left_m, left_deg = measure_error(found, error, p_camera)
    assert left_m < 0.005
    assert left_deg < 0.3
    assert found.rmse_after_m < 0.8 * found.rmse_before_m
    assert found.overlap > 0.8
    assert found.condition < 20.0


def test_extrinsics_of_two_cameras_at_a_table_are_mended() -> None:
    reference, _ = see_table(0)
    points, p_camera = see_table(1)
    error = bump(p_camera, 1)
    left_m, left_deg = measure_error(refine_pose(move(error, points), reference), error, p_camera)
    assert left_m < 0.005
    assert left_deg < 0.3


def make_walls(normals: list[tuple[float, float, float]], seed: int, noise_m: float = 0.004) -> Floats:
    """Return squares of 2 m through the origin, 3,000 points each."""
    random = np.random.default_rng(seed)
    walls = []
    for normal in normals:
        _, _, axes = np.linalg.svd(np.array([normal]))
        flat = random.uniform(-1.0, 1.0, (3000, 2)) @ axes[1:]
        walls.append(flat + random.normal(0.0, noise_m, (3000, 1)) * axes[:1])
    return np.concatenate(walls)


X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


@pytest.mark.parametrize(("walls", "way"), [([Z], "slide along|turn about"), ([X, Y], r"slide along \(-?0.0, -?0.0, ")])
def test_walls_that_slide_along_themselves_are_refused(walls: list[tuple[float, float, float]], way: str) -> None:
    points = make_walls(walls, 1) + 0.015
    with pytest.raises(RefinementRefusedError, match=way) as caught:
        refine_pose(points, make_walls(walls, 2))
    assert caught.value.reason == "slides"
    found = refine_pose(make_walls([X, Y, Z], 1) + 0.015, make_walls([X, Y, Z], 2))
    assert np.abs(found.T_world_world[:3, 3] + 0.015).max() < 0.002


@pytest.mark.parametrize("points", [make_walls([X, Y, Z], 1) + 5.0, make_walls([X, Y, Z], 1)[:100], np.empty((0, 3))])
def test_clouds_without_overlap_are_refused(points: Floats) -> None:
    reference = make_walls([X, Y, Z], 2)
    for first, second in ((points, reference), (reference, points)):
        with pytest.raises(RefinementRefusedError) as caught:
            refine_pose(first, second)
        assert caught.value.reason == "overlap"


def test_corrections_larger_than_allowed_are_refused() -> None:
    with pytest.raises(RefinementRefusedError, match="calibrate") as caught:
        refine_pose(make_walls([X, Y, Z], 1) + 0.055, make_walls([X, Y, Z], 2))
    assert caught.value.reason == "far"


def test_a_fit_that_is_worse_is_refused() -> None:
    found = refine_pose(make_walls([X, Y, Z], 1), make_walls([X, Y, Z], 2))
    icp._check_result(found, 1.0, np.ones(6))
    worse = dataclasses.replace(found, rmse_after_m=1.02 * found.rmse_before_m)
    with pytest.raises(RefinementRefusedError, match="the calibration stays") as caught:
        icp._check_result(worse, 1.0, np.ones(6))
    assert caught.value.reason == "worse"
