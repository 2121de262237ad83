"""Kernels of the voxel filter, compiled by numba; the machine code is kept for the next time.

Rows of a picture are first turned into keys of cells, in loops without branches that compile to vector instructions;
then pixels side by side in one cell are added to it at once. Cells lie together in blocks of 4 x 4 x 4, and a hash
finds the block: what is beside a pixel in the picture is beside it in memory.
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
#: Bits of a key that tell the cells of a block apart, and the number of those cells.
_INNER = np.int64((3 << 42) | (3 << 21) | 3)
_BLOCK_CELLS = 64


class Band:
    """Cells of one band of a picture: sums by key. Cells, and blocks, are numbered as they come."""

    def __init__(self, max_cells: int) -> None:
        bits = max(4, (2 * max_cells - 1).bit_length())
        self._n = np.zeros(2, np.int64)  # cells, blocks
        self._keys = np.empty(max_cells, np.int64)
        self._sums = np.empty((max_cells, COLUMNS), np.float32)
        self._grids = np.empty((max_cells, _BLOCK_CELLS), np.int32)  # by block: the cells in it, set when it comes
        self._used = np.empty(max_cells, np.int32)  # by block: its place in the tables that follow
        self._blocks = np.empty(2**bits, np.int32)
        self._hashed = np.full(2**bits, _EMPTY, np.int64)  # key of the block's first cell
        tables = (self._used, self._blocks, self._hashed, np.uint64(64 - bits))
        self._table = (self._n, self._keys, self._sums, self._grids, *tables)

    @property
    def n_cells(self) -> int:
        return int(self._n[0])

    def clear(self) -> None:
        self._hashed[self._used[: self._n[1]]] = _EMPTY
        self._n[:] = 0

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
        picture = (depth, color, ray_x, ray_y, first, last, T_cells_camera, scale_m, box)
        return int(_add(*picture, *depths, self._table))

    def merge(self, other: Band) -> int:
        """Add the cells of another band. Return how many points were dropped."""
        return int(_merge(other._keys[: other._n[0]], other._sums, self._table))

    def read(self, min_points: int, min_around: int, voxel_m: float) -> tuple[npt.NDArray[Any], ...]:
        """Return positions, colours and numbers of points of the cells that have enough, and cells around them."""
        order = np.argsort(self._keys[: self._n[0]], kind="stable")  # in part they are: faster than the default
        return _read(order, self._keys, self._sums, min_points, min_around, voxel_m)  # type: ignore[no-any-return]


def _jit(function: Any) -> Any:
    return njit(cache=True, nogil=True)(function)


@_jit
def _find(hashed: Any, block: Any, shift: Any) -> Any:
    """Return the place of a block, or the empty one where it belongs."""
    place = np.int64((np.uint64(block) * _SPREAD) >> shift)
    while hashed[place] != block and hashed[place] != _EMPTY:
        place = (place + 1) & (hashed.shape[0] - 1)
    return place


@_jit
def _inner(key: Any) -> Any:
    """Return the number of a cell in its block."""
    return ((key >> 38) & 48) | ((key >> 19) & 12) | (key & 3)


@_jit
def _put(
    key: Any, block: Any, place: Any, n: Any, keys: Any, sums: Any, grids: Any, used: Any, blocks: Any, hashed: Any
) -> Any:
    """Add a cell, for which there is room, and its block if that is `_EMPTY`. Return the number of the block."""
    if block == _EMPTY:
        block = n[1]
        hashed[place], blocks[place], used[block] = key & ~_INNER, block, place
        grids[block, :] = _EMPTY
        n[1] += 1
    cell = n[0]
    grids[block, _inner(key)], keys[cell] = cell, key
    sums[cell, :] = 0.0
    n[0] += 1
    return block


@_jit
def _leave_out_edges(chosen: Any, units: Any, beside: Any, jump: Any) -> None:
    """Leave out pixels that lie between two surfaces: far from a pixel beside them."""
    for u in range(chosen.shape[0]):
        here, there = np.int32(units[u]), np.int32(beside[u])
        chosen[u] &= (there == 0) | (there == 0xFFFF) | (abs(here - there) <= jump * here)


@_jit
def _place_row(
    depth: Any, v: Any, ray_x: Any, ray_y: Any, T: Any, scale_m: Any, box: Any, nearest: Any, farthest: Any,
    jump: Any, chosen: Any, keys: Any, parts: Any,
) -> None:  # fmt: skip
    """Set keys of the cells of a row, `_EMPTY` for pixels that do not count, and where in its cell each point is."""
    units, last = depth[v], depth.shape[0] - 1
    for u in range(units.shape[0]):
        unit = np.float64(units[u])
        chosen[u] = (unit > 0.0) & (unit < 65_535.0) & (unit >= nearest) & (unit <= farthest)
    _leave_out_edges(chosen[1:], units[1:], units[:-1], jump)
    _leave_out_edges(chosen[:-1], units[:-1], units[1:], jump)
    _leave_out_edges(chosen, units, depth[max(v - 1, 0)], jump)
    _leave_out_edges(chosen, units, depth[min(v + 1, last)], jump)
    r00, r01, r02, tx = T[0, 0], T[0, 1], T[0, 2], T[0, 3]  # numbers, not elements: else nothing is vectorised
    r10, r11, r12, ty = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, tz = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    (low_x, low_y, low_z), (high_x, high_y, high_z) = box[0], box[1]
    part_x, part_y, part_z = parts
    for u in range(units.shape[0]):
        z = units[u] * scale_m
        x, y = ray_x[u] * z, ray_y[u] * z
        px = r00 * x + r01 * y + r02 * z + tx
        py = r10 * x + r11 * y + r12 * z + ty
        pz = r20 * x + r21 * y + r22 * z + tz
        i, j, k = np.floor(px), np.floor(py), np.floor(pz)
        inside = (  # not so what is not a number
            (px >= low_x) & (px < high_x) & (py >= low_y) & (py < high_y) & (pz >= low_z) & (pz < high_z)
        )
        key = ((np.int64(i) + REACH) << 42) | ((np.int64(j) + REACH) << 21) | (np.int64(k) + REACH)
        keys[u] = key if inside & chosen[u] else _EMPTY
        part_x[u], part_y[u], part_z[u] = px - i, py - j, pz - k


@_jit
def _add(
    depth: Any, color: Any, ray_x: Any, ray_y: Any, first: Any, last: Any, T: Any, scale_m: Any, box: Any,
    nearest: Any, farthest: Any, jump: Any, table: Any,
) -> Any:  # fmt: skip
    width = depth.shape[1]
    chosen, keys, parts = np.empty(width, np.bool_), np.empty(width, np.int64), np.empty((3, width), np.float32)
    part_x, part_y, part_z = parts[0], parts[1], parts[2]
    n, known, sums, grids, used, blocks, hashed, shift = table  # once, and little is called: numba counts references
    dropped: Any = 0
    present, place, block = np.int64(_EMPTY), np.int64(0), np.int64(_EMPTY)  # of the block of the cell before
    for v in range(first, last):
        _place_row(
            depth, v, ray_x[v], ray_y[v], T, scale_m, box, nearest, farthest, jump, chosen, keys,
            (part_x, part_y, part_z),
        )  # fmt: skip
        colors = color[v]
        u: Any = 0
        while u < width:
            key = keys[u]
            begin = u
            x, y, z = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            red, green, blue = 0, 0, 0
            while u < width and keys[u] == key:
                x, y, z = x + part_x[u], y + part_y[u], z + part_z[u]
                red, green, blue = red + colors[u, 0], green + colors[u, 1], blue + colors[u, 2]
                u += 1
            if key == _EMPTY:
                continue
            if key & ~_INNER != present:
                present = key & ~_INNER
                place = _find(hashed, present, shift)
                block = np.int64(_EMPTY if hashed[place] == _EMPTY else blocks[place])
            cell = np.int64(_EMPTY if block == _EMPTY else grids[block, _inner(key)])
            if cell == _EMPTY:
                if n[0] == known.shape[0]:
                    dropped += u - begin
                    continue
                block = _put(key, block, place, n, known, sums, grids, used, blocks, hashed)
                cell = n[0] - 1
            row = sums[cell]
            row[0] += u - begin
            row[1] += x
            row[2] += y
            row[3] += z
            row[4] += red
            row[5] += green
            row[6] += blue
    return dropped


@_jit
def _merge(other_keys: Any, other_sums: Any, table: Any) -> Any:
    n, keys, sums, grids, used, blocks, hashed, shift = table
    dropped: Any = 0
    for one in range(other_keys.shape[0]):
        key = other_keys[one]
        place = _find(hashed, key & ~_INNER, shift)
        block = np.int64(_EMPTY if hashed[place] == _EMPTY else blocks[place])
        cell = np.int64(_EMPTY if block == _EMPTY else grids[block, _inner(key)])
        if cell == _EMPTY:
            if n[0] == keys.shape[0]:
                dropped += np.int64(other_sums[one, 0])
                continue
            _put(key, block, place, n, keys, sums, grids, used, blocks, hashed)
            cell = n[0] - 1
        for k in range(COLUMNS):
            sums[cell, k] += other_sums[one, k]
    return dropped


@_jit
def _count_around(keys: Any) -> Any:
    """Return how many of the 26 cells around each cell there are. Keys are ascending.

    Along an axis cells follow one another; the others lie in four rows ahead, which are swept along, and four behind:
    one cell is ahead of the other.
    """
    n = keys.shape[0]
    around = np.zeros(n, np.uint8)
    for one in range(n - 1):
        beside = keys[one + 1] == keys[one] + 1
        around[one] += beside
        around[one + 1] += beside
    for i, j in ((0, 1), (1, -1), (1, 0), (1, 1)):
        begin = 0
        for one in range(n):
            low = keys[one] + (i << 42) + (j << 21) - 1
            while begin < n and keys[begin] < low:
                begin += 1
            other = begin
            while other < n and keys[other] <= low + 2:
                around[one] += 1
                around[other] += 1
                other += 1
    return around


@_jit
def _read(order: Any, keys: Any, sums: Any, min_points: Any, min_around: Any, voxel_m: Any) -> Any:
    """Return positions, colours and numbers of points of the cells that are kept, in ascending order of their keys."""
    ordered = keys[order]
    around = _count_around(ordered) if min_around > 0 else np.zeros(order.shape[0], np.uint8)
    positions = np.empty((order.shape[0], 3), np.float32)
    colors, counts = np.empty((order.shape[0], 3), np.uint8), np.empty(order.shape[0], np.int64)
    n: Any = 0
    mask = 2 * REACH - 1
    for one in range(order.shape[0]):
        row = sums[order[one]]
        if row[0] < min_points or around[one] < min_around:
            continue
        key, share = ordered[one], 1.0 / np.float64(row[0])
        positions[n, 0] = ((key >> 42) - REACH + row[1] * share) * voxel_m
        positions[n, 1] = (((key >> 21) & mask) - REACH + row[2] * share) * voxel_m
        positions[n, 2] = ((key & mask) - REACH + row[3] * share) * voxel_m
        for k in range(3):
            colors[n, k] = np.uint8(np.rint(row[4 + k] * share))
        counts[n] = np.int64(row[0])
        n += 1
    return positions[:n], colors[:n], counts[:n]
