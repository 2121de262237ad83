"""Kernels of the voxel filter and of `robot_points`, compiled by numba; the machine code is kept for the next time.

A table has twice as many places as cells, and is searched from a place that the key's bits choose. Places in use are
listed, so that clearing and reading cost as much as there are cells.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from iris_session.cloud import COLUMNS, REACH

_EMPTY = -1
#: 2^64 divided by the golden ratio: multiples of it spread over the highest bits.
_SPREAD = np.uint64(0x9E3779B97F4A7C15)


class Band:
    """Cells of one band of a picture: sums by key."""

    def __init__(self, max_cells: int) -> None:
        bits = max(4, (2 * max_cells - 1).bit_length())
        self._shift = np.uint64(64 - bits)
        self._keys = np.full(2**bits, _EMPTY, np.int64)
        self._sums = np.zeros((2**bits, COLUMNS), np.float32)
        self._used = np.empty(max_cells, np.int32)
        self._n = 0

    def clear(self) -> None:
        _clear(self._keys, self._sums, self._used, self._n)
        self._n = 0

    def add(
        self,
        depth: npt.NDArray[np.uint16],
        color: npt.NDArray[np.uint8],
        ray_x: npt.NDArray[np.float32],
        ray_y: npt.NDArray[np.float32],
        first: int,
        last: int,
        T_cells_camera: npt.NDArray[np.float64],
        scale_m: float,
        box: npt.NDArray[np.float64],
        depths: tuple[float, float, float],
    ) -> int:
        """Add the rows from `first` to before `last`. Return how many points were dropped."""
        self._n, dropped = _add(
            depth, color, ray_x, ray_y, first, last, T_cells_camera, scale_m, box, *depths,
            self._keys, self._sums, self._used, self._n, self._shift,
        )  # fmt: skip
        return int(dropped)

    def merge(self, other: Band) -> int:
        """Add the cells of another band. Return how many points were dropped."""
        self._n, dropped = _merge(
            other._keys, other._sums, other._used, other._n, self._keys, self._sums, self._used, self._n, self._shift
        )
        return int(dropped)

    def read(self, min_points: int, min_around: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """Return keys and sums of the cells that have enough points and occupied cells around them."""
        used = self._used[: self._n]
        kept = _select(self._keys, self._sums, used, self._shift, min_points, min_around)
        return self._keys[kept], self._sums[kept].astype(np.float64)


def _jit(function: Any) -> Any:
    return njit(cache=True, nogil=True)(function)


@_jit
def _find(keys: Any, key: Any, shift: Any) -> Any:
    """Return the place of a key, or the empty one where it belongs."""
    place = np.int64((np.uint64(key) * _SPREAD) >> shift)
    mask = keys.shape[0] - 1
    while keys[place] != key and keys[place] != _EMPTY:
        place = (place + 1) & mask
    return place


@_jit
def _put(key: Any, sums_of: Any, keys: Any, sums: Any, used: Any, n: Any, shift: Any) -> Any:
    """Add sums to a cell. Return the number of cells, which is the same when there is no room for another."""
    place = _find(keys, key, shift)
    if keys[place] == _EMPTY:
        if n == used.shape[0]:
            return n, False
        keys[place] = key
        used[n] = place
        n += 1
    row = sums[place]
    for k in range(COLUMNS):
        row[k] += sums_of[k]
    return n, True


@_jit
def _add(
    depth: Any, color: Any, ray_x: Any, ray_y: Any, first: Any, last: Any, T: Any, scale_m: Any, box: Any,
    nearest: Any, farthest: Any, jump: Any, keys: Any, sums: Any, used: Any, n: Any, shift: Any,
) -> Any:  # fmt: skip
    height, width = depth.shape
    dropped: Any = 0
    here = np.zeros(COLUMNS, np.float32)  # of the cell that the last pixel was in: pixels side by side share cells
    present = np.int64(_EMPTY)
    r00, r01, r02, tx = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, ty = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, tz = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for v in range(first, last):
        for u in range(width):
            unit = np.int64(depth[v, u])
            if unit == 0 or unit == 0xFFFF or unit < nearest or unit > farthest:  # noqa: PLR1714 (numba has no sets of numbers)
                continue
            bound = jump * unit
            if u > 0 and 0 < depth[v, u - 1] < 0xFFFF and abs(unit - np.int64(depth[v, u - 1])) > bound:
                continue
            if u + 1 < width and 0 < depth[v, u + 1] < 0xFFFF and abs(unit - np.int64(depth[v, u + 1])) > bound:
                continue
            if v > 0 and 0 < depth[v - 1, u] < 0xFFFF and abs(unit - np.int64(depth[v - 1, u])) > bound:
                continue
            if v + 1 < height and 0 < depth[v + 1, u] < 0xFFFF and abs(unit - np.int64(depth[v + 1, u])) > bound:
                continue
            z = unit * scale_m
            x, y = ray_x[v, u] * z, ray_y[v, u] * z
            px = r00 * x + r01 * y + r02 * z + tx
            py = r10 * x + r11 * y + r12 * z + ty
            pz = r20 * x + r21 * y + r22 * z + tz
            if not (box[0, 0] <= px < box[1, 0] and box[0, 1] <= py < box[1, 1] and box[0, 2] <= pz < box[1, 2]):
                continue  # so is what is not a number
            if not (abs(px) < REACH - 1 and abs(py) < REACH - 1 and abs(pz) < REACH - 1):
                continue
            i, j, k = np.int64(np.floor(px)), np.int64(np.floor(py)), np.int64(np.floor(pz))
            key = ((i + REACH) << 42) | ((j + REACH) << 21) | (k + REACH)
            if key != present:
                if present != _EMPTY:
                    n, fits = _put(present, here, keys, sums, used, n, shift)
                    if not fits:
                        dropped += np.int64(here[0])
                present = key
                here[:] = 0.0
            here[0] += 1.0
            here[1] += px - i
            here[2] += py - j
            here[3] += pz - k
            here[4] += color[v, u, 0]
            here[5] += color[v, u, 1]
            here[6] += color[v, u, 2]
    if present != _EMPTY:
        n, fits = _put(present, here, keys, sums, used, n, shift)
        if not fits:
            dropped += np.int64(here[0])
    return n, dropped


@_jit
def _merge(
    other_keys: Any, other_sums: Any, other_used: Any, other_n: Any, keys: Any, sums: Any, used: Any, n: Any, shift: Any
) -> Any:
    dropped: Any = 0
    for one in range(other_n):
        place = other_used[one]
        n, fits = _put(other_keys[place], other_sums[place], keys, sums, used, n, shift)
        if not fits:
            dropped += np.int64(other_sums[place, 0])
    return n, dropped


@_jit
def _clear(keys: Any, sums: Any, used: Any, n: Any) -> None:
    for one in range(n):
        keys[used[one]] = _EMPTY
        sums[used[one]] = 0.0


@_jit
def _select(keys: Any, sums: Any, used: Any, shift: Any, min_points: Any, min_around: Any) -> Any:
    """Return the places of the cells that are kept."""
    kept = np.empty(used.shape[0], np.int32)
    n = 0
    for place in used:
        if sums[place, 0] < min_points:
            continue
        around = 0
        if min_around > 0:
            for i in range(-1, 2):
                for j in range(-1, 2):
                    for k in range(-1, 2):
                        key = keys[place] + (i << 42) + (j << 21) + k
                        if key != keys[place] and keys[_find(keys, key, shift)] == key:
                            around += 1
        if around >= min_around:
            kept[n] = place
            n += 1
    return kept[:n]


@_jit
def measure_distances(
    positions: Any, spheres: Any, to_cells: Any, grids: Any, starts: Any, shapes: Any, found: Any
) -> None:
    """Lower `found` to the distances of points from bodies: see `robot_points`."""
    n = spheres.shape[0]
    low, high = np.full(3, np.inf, np.float32), np.full(3, -np.inf, np.float32)
    for b in range(n):
        for axis in range(3):
            low[axis] = min(low[axis], spheres[b, axis] - spheres[b, 3])
            high[axis] = max(high[axis], spheres[b, axis] + spheres[b, 3])
    for p in range(positions.shape[0]):
        x, y, z = positions[p, 0], positions[p, 1], positions[p, 2]
        if not (low[0] < x < high[0] and low[1] < y < high[1] and low[2] < z < high[2]):
            continue
        for b in range(n):
            dx, dy, dz = x - spheres[b, 0], y - spheres[b, 1], z - spheres[b, 2]
            if dx * dx + dy * dy + dz * dz >= spheres[b, 3] * spheres[b, 3]:
                continue
            T = to_cells[b]
            i = np.int64(T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3])
            j = np.int64(T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3])
            k = np.int64(T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3])
            if 0 <= i < shapes[b, 0] and 0 <= j < shapes[b, 1] and 0 <= k < shapes[b, 2]:
                found[p] = min(found[p], grids[starts[b] + (i * shapes[b, 1] + j) * shapes[b, 2] + k])
