"""Voxel filter: its means are those of a slow reference, with numba and without, in any order of cameras."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from anchors.camera import CameraModel
from iris_session.cloud import voxels
from iris_session.cloud.voxels import DepthLimits, PointSet, Rays, VoxelFilter, make_rays
from iris_session.system.extras import MissingExtraError

VOXEL_M = 0.02
CAMERA = CameraModel(80, 60, 70.0, 72.0, 39.5, 29.5)
backends = pytest.mark.parametrize("use_numba", [True, False], ids=["numba", "numpy"])


def make_picture(seed: int) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Return a bumpy wall with holes, a box before it, and noise."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[0:60, 0:80]
    depth = 1500.0 + 60.0 * np.sin(u / 9.0) + 40.0 * np.cos(v / 7.0) + random.normal(0.0, 2.0, u.shape)
    depth[20:40, 30:50] = 900.0
    depth[random.random(u.shape) < 0.05] = 0.0
    depth[random.random(u.shape) < 0.02] = 65_535.0
    return depth.astype(np.uint16), random.integers(0, 256, (60, 80, 3)).astype(np.uint8)


def make_pose(seed: int) -> NDArray[np.float64]:
    """Return a camera's pose within a metre of the origin."""
    random = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3], _ = cv2.Rodrigues(random.normal(size=3)) if seed else (np.eye(3), None)
    pose[:3, 3] = random.uniform(-1.0, 1.0, 3)
    return pose


def filter_slowly(
    pictures: list[Any], limits: DepthLimits, rays: Rays, min_around: int = 0
) -> dict[tuple[int, ...], Any]:
    """Return mean position, mean colour and number of points by cell, one pixel at a time."""
    cells: dict[tuple[int, ...], list[Any]] = defaultdict(list)
    for depth, color, pose in pictures:
        height, width = depth.shape
        for v in range(height):
            for u in range(width):
                unit = int(depth[v, u])
                if unit in (0, 65_535) or not limits.nearest_m <= unit * 0.001 <= limits.farthest_m:
                    continue
                beside = [(v, u - 1), (v, u + 1), (v - 1, u), (v + 1, u)]
                near = [int(depth[b, a]) for b, a in beside if 0 <= b < height and 0 <= a < width]
                if any(one not in (0, 65_535) and abs(one - unit) > limits.jump * unit for one in near):
                    continue
                z = unit * 0.001
                point = pose[:3, :3] @ (rays.x[v, u] * z, rays.y[v, u] * z, z) + pose[:3, 3]
                if (point >= limits.low).all() and (point < limits.high).all():
                    cells[tuple(np.floor(point / VOXEL_M).astype(int).tolist())].append((point, color[v, u]))
    steps = [(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (i, j, k) != (0, 0, 0)]
    found = {}
    for cell, members in cells.items():
        around = sum(tuple(np.add(cell, step).tolist()) in cells for step in steps)
        if around >= min_around:
            points, colors = zip(*members, strict=True)
            found[cell] = (np.mean(points, axis=0), np.mean(np.array(colors, float), axis=0), len(members))
    return found


def run_filter(pictures: list[Any], limits: DepthLimits, rays: Rays, *, use_numba: bool, **options: Any) -> PointSet:
    found = VoxelFilter(VOXEL_M, use_numba=use_numba, threads=2)
    for depth, color, pose in pictures:
        found.add_depth(depth, color, rays, pose, limits=limits)
    assert found.overflow == 0
    return found.collect(**options)


def compare(points: PointSet, expected: dict[tuple[int, ...], Any]) -> None:
    assert len(points.positions) == len(expected)
    positions = np.array([mean for mean, _, _ in expected.values()])
    distance, at = cKDTree(points.positions).query(positions)
    assert distance.max() < 2e-6
    assert len(set(at.tolist())) == len(expected)
    colors = np.array([color for _, color, _ in expected.values()])
    assert np.abs(points.colors[at] - colors).max() <= 0.5 + 1e-3
    assert points.counts[at].tolist() == [n for _, _, n in expected.values()]


@backends
@pytest.mark.parametrize("distortion", [(), (0.1, -0.05, 0.001, 0.002)])
def test_means_are_those_of_a_slow_reference(use_numba: bool, distortion: tuple[float, ...]) -> None:
    camera = CameraModel(80, 60, 70.0, 72.0, 39.5, 29.5, distortion)
    rays, limits = make_rays(camera), DepthLimits((-1.0, -0.8, -2.0), (0.9, 2.0, 1.9), 0.5, 1.56, 0.03)
    pictures = [(*make_picture(seed), make_pose(seed)) for seed in range(3)]
    for options in ({}, {"min_around": 4}):
        expected = filter_slowly(pictures, limits, rays, **options)
        assert len(expected) > 500
        compare(run_filter(pictures, limits, rays, use_numba=use_numba, **options), expected)


@backends
def test_cells_beyond_the_bound_are_dropped_and_counted(use_numba: bool) -> None:
    depth, color = make_picture(1)
    small = VoxelFilter(VOXEL_M, max_cells=50, threads=1, use_numba=use_numba)
    small.add_depth(depth, color, make_rays(CAMERA), np.eye(4))
    whole = VoxelFilter(VOXEL_M, use_numba=use_numba)
    whole.add_depth(depth, color, make_rays(CAMERA), np.eye(4))
    kept = small.collect()
    assert len(kept.positions) == 50
    assert small.n_cells == len(kept.positions)
    assert small.overflow == whole.collect().counts.sum() - kept.counts.sum() > 0
    small.clear()
    assert small.overflow == len(small.collect().positions) == 0


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"depth": np.zeros((60, 81), np.uint16)}, "depth"),
        ({"color": np.zeros((60, 80), np.uint8)}, "colour"),
        ({"T_world_camera": np.full((4, 4), np.nan)}, "T_world_camera"),
        ({"depth_scale_m": np.nan}, "depth_scale_m"),
    ],
)
def test_pictures_that_do_not_fit_are_refused(change: dict[str, Any], named: str) -> None:
    depth, color = make_picture(0)
    arguments = {"depth": depth, "color": color, "rays": make_rays(CAMERA), "T_world_camera": np.eye(4), **change}
    with pytest.raises(ValueError, match=named):
        VoxelFilter(VOXEL_M, use_numba=False).add_depth(**arguments)


@pytest.mark.parametrize("options", [{"voxel_m": np.nan}, {"max_cells": 0}, {"threads": 0}])
def test_filters_that_cannot_be_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        VoxelFilter(**{"voxel_m": 0.01, **options})


def test_without_numba_numpy_filters_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(voxels, "_HAS_NUMBA", False)
    depth, color = make_picture(1)
    found = VoxelFilter(VOXEL_M)
    assert "iris-session[cloud]" in caplog.text
    found.add_depth(depth, color, make_rays(CAMERA), np.eye(4))
    assert found.n_cells > 0
    with pytest.raises(MissingExtraError) as caught:
        VoxelFilter(VOXEL_M, use_numba=True)
    assert caught.value.name == "numba"
