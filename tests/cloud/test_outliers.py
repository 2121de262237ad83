"""Outliers of clouds, compared with statistical removal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from iris_session.bench.cloud_room import WORKSPACE, make_room_camera, make_room_pose, render_room
from iris_session.cloud.voxels import DepthLimits, VoxelFilter, make_rays

VOXEL_M = 0.02
CAMERA = make_room_camera(320, 180)


def filter_room(min_around: int, *, specks: int = 0) -> NDArray[np.float32]:
    """Return the points of the room, with specks of 2 x 2 pixels that float in the air."""
    pose = make_room_pose(0.3)
    depth, color, _ = render_room(CAMERA, pose, 1)
    random = np.random.default_rng(0)
    for row, column in random.integers((5, 5), (170, 310), (specks, 2)):
        depth[row : row + 2, column : column + 2] = random.integers(500, 1000)
    voxels = VoxelFilter(VOXEL_M)
    limits = DepthLimits(*WORKSPACE, nearest_m=0.3, farthest_m=4.0, jump=10.0)
    voxels.add_depth(depth, color, make_rays(CAMERA), pose, limits=limits)
    return voxels.collect(min_around=min_around).positions


def remove_statistically(points: NDArray[np.float32], neighbours: int = 20, ratio: float = 2.0) -> NDArray[np.bool_]:
    """Return which points stay: as of open3d's `remove_statistical_outlier`."""
    distances, _ = cKDTree(points).query(points, neighbours)
    mean = distances.mean(axis=1)
    return np.asarray(mean < mean.mean() + ratio * mean.std(ddof=1))


def label_clusters(points: NDArray[np.float32]) -> NDArray[np.int32]:
    """Return the cluster of each point: of those whose cells touch."""
    pairs = cKDTree(points).query_pairs(2.0 * VOXEL_M, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), (len(points), len(points)))
    return np.asarray(connected_components(links, directed=False)[1])


def test_clusters_that_survive_are_those_of_statistical_removal() -> None:
    points = filter_room(0, specks=40)
    kept = filter_room(4, specks=40)
    ours = cKDTree(kept).query(points)[0] < 1e-6
    theirs = remove_statistically(points)
    cluster = label_clusters(points)
    size = np.bincount(cluster)
    alive = [np.bincount(cluster, stay) > 0.5 * size for stay in (ours, theirs)]
    assert (size < 5).sum() > 20, "specks"
    assert 1 <= alive[0].sum() < 10, "surfaces"
    assert (alive[0] == alive[1]).all()
    assert ours[size[cluster] > 100].mean() > 0.97, "surfaces keep their points"
