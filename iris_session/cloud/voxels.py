"""Voxel filter: from depth pictures to the mean point and colour of each cell of a lattice fixed in the world.

One pass over a picture: deprojection, range, flying pixels, crop, cell, sums. Since the lattice is that of the world,
merging cameras is adding their cells. With numba the picture is passed in bands, each in a thread of its own that
does not hold the interpreter lock; without it numpy does the same and takes longer.
"""

from __future__ import annotations

import logging
import math
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from anchors.camera import CameraModel
from iris_session.cloud import COLUMNS, REACH
from iris_session.system.extras import MissingExtraError, describe_missing

_HAS_NUMBA = True
try:
    from iris_session.cloud import kernels
except ImportError:  # not installed, or not for this version of numpy
    _HAS_NUMBA = False

log = logging.getLogger(__name__)

Floats = npt.NDArray[np.float64]
Positions = npt.NDArray[np.float32]
Colors = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.uint16]

#: Cells of one filter by default: what comes beyond is dropped and counted.
MAX_CELLS: Final = 2**18
#: Share of the cells above which a filter is too full: few remain for what moves into the picture.
FULL: Final = 0.9
MIN_VOXEL_M: Final = 0.001
#: Cells of a depth camera with fewer points, or with fewer occupied cells around them, are outliers.
MIN_POINTS: Final = 2
MIN_AROUND: Final = 4
#: Cells around a cell, itself left out.
_AROUND: Final = tuple((i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (i, j, k) != (0, 0, 0))


class PointSet(NamedTuple):
    """Points of a filter.

    Attributes:
        positions: (n, 3) [m], world frame: the mean of the points of each cell.
        colors: (n, 3), the mean of their colours.
        counts: (n,) points of each cell.
    """

    positions: Positions
    colors: Colors
    counts: npt.NDArray[np.int64]


class Rays(NamedTuple):
    """Directions of the pixels of a camera: `x`, `y` (height, width), both divided by z; lens distortion is undone."""

    x: Positions
    y: Positions


class DepthLimits(NamedTuple):
    """Limits of the pixels that count.

    Attributes:
        low: Lowest corner of the crop box [m], world frame.
        high: Highest corner [m].
        nearest_m: Least depth along the camera's axis.
        farthest_m: Greatest depth.
        jump: A pixel whose depth differs from one beside it by more than this share of it lies between two surfaces,
            where depth cameras make things up: it is left out.
    """

    low: tuple[float, float, float] = (-1e4, -1e4, -1e4)
    high: tuple[float, float, float] = (1e4, 1e4, 1e4)
    nearest_m: float = 0.1
    farthest_m: float = 10.0
    jump: float = 0.03


def make_rays(camera: CameraModel) -> Rays:
    """Compute the directions of the pixels of a camera.

    Args:
        camera: Its intrinsics, for pictures of this size.

    Returns:
        The directions, lens distortion undone.
    """
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    if not any(camera.distortion):
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    else:
        found = camera.undistort(np.stack([u.ravel(), v.ravel()], axis=1))
        x, y = found[:, 0].reshape(u.shape), found[:, 1].reshape(u.shape)
    return Rays(np.ascontiguousarray(x, np.float32), np.ascontiguousarray(y, np.float32))


def count_outside(
    depth: Depth, rays: Rays, T_world_camera: Floats, depth_scale_m: float, limits: DepthLimits
) -> tuple[int, int]:
    """Return how many measured pixels of a depth picture are out of range, and how many of the others out of the box.

    Args:
        depth, rays, T_world_camera, depth_scale_m, limits: As for `VoxelFilter.add_depth`.
    """
    measured = (depth > 0) & (depth < 65_535)
    z = depth * depth_scale_m
    near = measured & (z >= limits.nearest_m) & (z <= limits.farthest_m)
    p_camera = np.stack([rays.x[near], rays.y[near], np.ones(np.count_nonzero(near))]) * z[near]
    p_world = T_world_camera[:3, :3] @ p_camera + T_world_camera[:3, 3:]
    low, high = (np.array(corner)[:, None] for corner in (limits.low, limits.high))
    outside = ((p_world < low) | (p_world >= high)).any(axis=0)
    return int(np.count_nonzero(measured & ~near)), int(np.count_nonzero(outside))


class VoxelFilter:
    """Collect points in cells.

    Args:
        voxel_m: Edge of a cell [m].
        max_cells: Cells at most.
        threads: Threads of one picture, by default as many as there are processors, and at most four.
        use_numba: Use numba. By default where it is installed.

    Attributes:
        voxel_m: Edge of a cell [m]; `clear` sets it.
        max_cells: Cells at most.
        overflow: Points that were dropped because there were too many cells, since `clear`.

    Raises:
        ValueError: An argument is out of range.
        MissingExtraError: `use_numba`, and numba is not installed.
    """

    def __init__(
        self,
        voxel_m: float,
        *,
        max_cells: int = MAX_CELLS,
        threads: int | None = None,
        use_numba: bool | None = None,
    ) -> None:
        if not 1 <= max_cells <= 2**24:
            raise ValueError(f"max_cells is {max_cells}: 1 to {2**24} are possible")
        if threads is not None and threads < 1:
            raise ValueError(f"threads is {threads}: at least 1")
        if use_numba and not _HAS_NUMBA:
            raise MissingExtraError(describe_missing("numba", "use_numba=True"), name="numba")
        if use_numba is None and not _HAS_NUMBA:
            log.warning("depth pictures are filtered by numpy, which takes longer: %s", describe_missing("numba"))
        n = max(1, min(4, os.cpu_count() or 1)) if threads is None else threads
        self.max_cells = max_cells
        has_kernels = _HAS_NUMBA and use_numba is not False
        self._table = _NumbaTable(max_cells, n) if has_kernels else _NumpyTable(max_cells)
        self.clear(voxel_m)

    def clear(self, voxel_m: float | None = None) -> None:
        """Remove all points.

        Args:
            voxel_m: Edge of the cells from now on [m], by default as before.

        Raises:
            ValueError: `voxel_m` is out of range.
        """
        if voxel_m is not None:
            if not MIN_VOXEL_M <= voxel_m <= 10.0:
                raise ValueError(f"voxel_m is {voxel_m}: {MIN_VOXEL_M:g} to 10 m are possible")
            self.voxel_m = voxel_m
        self._table.clear()
        self.overflow = 0

    def add_depth(
        self,
        depth: Depth,
        color: Colors,
        rays: Rays,
        T_world_camera: Floats,
        *,
        depth_scale_m: float = 0.001,
        limits: DepthLimits | None = None,
    ) -> None:
        """Add the points of a depth picture.

        Args:
            depth: (height, width) uint16, along the camera's axis; 0 and 65,535 are no measurement.
            color: (height, width, 3) uint8, of the same pixels.
            rays: Of this camera, from `make_rays`.
            T_world_camera: (4, 4), from the camera's optical frame (x right, y down, z forward) to the world.
            depth_scale_m: Length of one unit of `depth` [m].
            limits: Which pixels count.

        Raises:
            ValueError: Shapes or types that do not fit each other, or a transform or scale that is not finite.
        """
        shape = rays.x.shape
        if depth.shape != shape or depth.dtype != np.uint16:
            raise ValueError(f"depth is {depth.shape} of {depth.dtype}: the camera's pictures are {shape} of uint16")
        if color.shape != (*shape, 3) or color.dtype != np.uint8:
            raise ValueError(f"colour is {color.shape} of {color.dtype}: the depth's pictures are {shape}, 3 of uint8")
        pose = np.asarray(T_world_camera, np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError("T_world_camera must be 4 x 4 finite numbers")
        if not 0.0 < depth_scale_m < 1.0:
            raise ValueError(f"depth_scale_m is {depth_scale_m}: more than 0 and less than 1 m, usually 0.001")
        chosen = limits or DepthLimits()
        box = np.clip(np.array((chosen.low, chosen.high)) / self.voxel_m, 1 - REACH, REACH - 1)
        cells = np.ascontiguousarray(pose[:3] / self.voxel_m)
        depth, color = np.ascontiguousarray(depth), np.ascontiguousarray(color)
        self.overflow += self._table.add_depth(_Picture(depth, color, rays, cells, depth_scale_m, chosen, box))

    def warm_up(self) -> None:
        """Let numba compile what a filter needs, or load it: the first time takes seconds. Removes all points."""
        depth, color = np.full((4, 4), 1000, np.uint16), np.zeros((4, 4, 3), np.uint8)
        self.add_depth(depth, color, make_rays(CameraModel(4, 4, 4.0, 4.0, 2.0, 2.0)), np.eye(4))
        self.collect(min_points=1, min_around=1)
        self.clear()

    @property
    def n_cells(self) -> int:
        """Number of cells with points, outliers among them."""
        return self._table.n_cells

    def collect(self, *, min_points: int = 1, min_around: int = 0) -> PointSet:
        """Return the mean of each cell.

        Args:
            min_points: Cells with fewer points are left out.
            min_around: Cells with fewer occupied cells among the 26 around them are left out: they are outliers.

        Returns:
            The points, ordered by their cells.
        """
        return PointSet(*self._table.read(min_points, min_around, self.voxel_m))


def choose_max_cells(budget: int) -> int:
    """Choose how many cells a filter needs for a budget of points: outliers have cells, too."""
    return max(MAX_CELLS, 2 * budget)


def choose_voxel_m(voxel_m: float, n_points: int, budget: int, smallest_m: float) -> float:
    """Choose the edge of the cells with which the next picture meets a budget of points.

    Surfaces have as many cells as their area has squares. The edge is one of steps of 2^(1/4); it is kept until there
    are too many points, or so few that the step below meets the budget with a fifth to spare.

    Args:
        voxel_m: The present edge [m].
        n_points: Points that it gave.
        budget: Points at most.
        smallest_m: Least edge: the first of the steps [m].

    Returns:
        The edge [m].
    """
    step = round(4.0 * math.log2(max(voxel_m, smallest_m) / smallest_m))
    if n_points > budget:
        step += math.ceil(2.0 * math.log2(n_points / budget))
    else:
        step -= max(0, math.floor(2.0 * math.log2(0.8 * budget / max(n_points, 1))))
    return float(smallest_m * 2.0 ** (max(0, step) / 4.0))


def pack_keys(cells: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return one number for each cell (n, 3)."""
    i, j, k = (cells[:, axis] + REACH for axis in range(3))
    return np.asarray((i << 42) | (j << 21) | k, np.int64)


def unpack_keys(keys: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Undo `pack_keys`."""
    mask = 2 * REACH - 1
    return np.stack([(keys >> 42) - REACH, ((keys >> 21) & mask) - REACH, (keys & mask) - REACH], axis=1)


# --- tables of cells --------------------------------------------------------------------------------------------------


class _Picture(NamedTuple):
    """A depth picture, with its pose in cells (3, 4)."""

    depth: Depth
    color: Colors
    rays: Rays
    T_cells_camera: Floats
    scale_m: float
    limits: DepthLimits
    box: Floats


class _NumbaTable:
    """Open addressing, one table for each band of a picture."""

    def __init__(self, max_cells: int, threads: int) -> None:
        self._bands = [kernels.Band(max_cells) for _ in range(threads)]
        self._pool = ThreadPoolExecutor(threads, "iris-voxels") if threads > 1 else None

    def clear(self) -> None:
        for band in self._bands:
            band.clear()

    def add_depth(self, picture: _Picture) -> int:
        """Add a picture. Return how many points were dropped."""
        depth, color, rays, pose, scale_m, limits, box = picture
        depths = (limits.nearest_m / scale_m, limits.farthest_m / scale_m, limits.jump)
        edges = np.linspace(0, depth.shape[0], len(self._bands) + 1).astype(int)

        def run(band: Any, first: int, last: int) -> int:
            return int(band.add(depth, color, rays.x, rays.y, first, last, pose, scale_m, box, depths))

        work = list(zip(self._bands, edges[:-1].tolist(), edges[1:].tolist(), strict=True))
        if self._pool is None:
            dropped = sum(run(*one) for one in work)
        else:
            dropped = sum(self._pool.map(lambda one: run(*one), work))
        for band in self._bands[1:]:
            dropped += self._bands[0].merge(band)
            band.clear()
        return dropped

    @property
    def n_cells(self) -> int:
        return int(self._bands[0].n_cells)

    def read(self, min_points: int, min_around: int, voxel_m: float) -> tuple[npt.NDArray[Any], ...]:
        positions, colors, counts = self._bands[0].read(min_points, min_around, voxel_m)
        return positions, colors, counts


class _NumpyTable:
    """Sorted cells, merged with those of each picture."""

    def __init__(self, max_cells: int) -> None:
        self._max_cells = max_cells
        self.clear()

    def clear(self) -> None:
        self._keys = np.empty(0, np.int64)
        self._sums = np.empty((0, COLUMNS))

    def add_depth(self, picture: _Picture) -> int:
        """Add a picture. Return how many points were dropped."""
        depth, color, rays, pose, scale_m, limits, (low, high) = picture
        chosen = select_pixels(depth, scale_m, limits)
        z = depth[chosen] * scale_m
        camera = np.stack([rays.x[chosen] * z, rays.y[chosen] * z, z], axis=1)
        points = camera @ pose[:, :3].T + pose[:, 3]
        inside = ((points >= low) & (points < high)).all(axis=1)
        points, colors = points[inside], color[chosen][inside]
        cells = np.floor(points).astype(np.int64)
        columns = np.concatenate([np.ones((len(points), 1)), points - cells, colors], axis=1)
        keys = np.concatenate([self._keys, pack_keys(cells)])
        self._keys, inverse = np.unique(keys, return_inverse=True)
        rows = np.concatenate([self._sums, columns])
        self._sums = np.stack(
            [np.bincount(inverse.ravel(), rows[:, k], len(self._keys)) for k in range(COLUMNS)], axis=1
        )
        if len(self._keys) <= self._max_cells:
            return 0
        dropped = self._sums[self._max_cells :, 0].sum()
        self._keys, self._sums = self._keys[: self._max_cells], self._sums[: self._max_cells]
        return int(dropped)

    @property
    def n_cells(self) -> int:
        return len(self._keys)

    def read(self, min_points: int, min_around: int, voxel_m: float) -> tuple[npt.NDArray[Any], ...]:
        kept = self._sums[:, 0] >= min_points
        if min_around:
            kept &= self._count_around() >= min_around
        cells, sums = unpack_keys(self._keys[kept]), self._sums[kept]
        counts = sums[:, 0]
        positions = (cells + sums[:, 1:4] / counts[:, None]) * voxel_m
        colors = np.rint(sums[:, 4:7] / counts[:, None]).astype(np.uint8)
        return positions.astype(np.float32), colors, counts.astype(np.int64)

    def _count_around(self) -> npt.NDArray[np.int64]:
        count = np.zeros(len(self._keys), np.int64)
        for i, j, k in _AROUND:
            wanted = self._keys + ((i << 42) + (j << 21) + k)
            at = np.minimum(np.searchsorted(self._keys, wanted), len(self._keys) - 1)
            count += self._keys[at] == wanted
        return count


def select_pixels(depth: Depth, scale_m: float, limits: DepthLimits) -> npt.NDArray[np.bool_]:
    """Return the pixels that are measured, within range, and not between two surfaces."""
    measured = (depth > 0) & (depth < 0xFFFF)
    chosen = measured & (depth >= limits.nearest_m / scale_m) & (depth <= limits.farthest_m / scale_m)
    units = depth.astype(np.float64)
    for axis in (0, 1):
        first = (slice(None, -1), slice(None))[:: 1 if axis == 0 else -1]
        second = (slice(1, None), slice(None))[:: 1 if axis == 0 else -1]
        both = measured[first] & measured[second]
        apart = np.abs(units[first] - units[second])
        chosen[first] &= ~(both & (apart > limits.jump * units[first]))
        chosen[second] &= ~(both & (apart > limits.jump * units[second]))
    return chosen
