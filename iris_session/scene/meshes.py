"""Meshes and deformables as assets: indexed corners, exact or quantised, and back.

A corner is a vertex with its normal and texture coordinate as drawn; corners that agree in all bits are merged.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.assets import MAX_ARRAY_BYTES
from iris_session.protocol.names import ArrayFilter, ArrayKind, ArrayName
from iris_session.scene.arrays import StoredArray, decode_arrays, encode_arrays, require_array
from iris_session.scene.errors import AssetDecodeError
from iris_session.streams.deformable_topology import DeformableTopology

#: Steps of a quantised coordinate, and of a component of a normal.
_POSITION_STEPS: Final = 65_535
_NORMAL_STEPS: Final = 127
Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
#: Fewer vertices than this are numbered with 16 bits.
_SHORT: Final = 1 << 16


@dataclass(frozen=True)
class MeshArrays:
    """Triangles, counter-clockwise seen from outside.

    Attributes:
        position: Positions (n, 3) [m].
        normal: Unit vectors (n, 3).
        uv: Texture coordinates (n, 2) or `None`: u to the right, v down from the upper left corner of the image.
        index: Triangles (m, 3), indices of the n corners.
        color: Red, green, blue, alpha (n, 4), 0..255, at the corners, multiplied with the colour of the visual; or
            `None`.
    """

    position: Floats
    normal: Floats
    uv: Floats | None
    index: NDArray[np.uint32]
    color: Bytes | None = None

    @property
    def vertices(self) -> int:
        return len(self.position)

    @property
    def triangles(self) -> int:
        return len(self.index)


def index_corners(position: Floats, normal: Floats, uv: Floats | None, color: Bytes | None = None) -> MeshArrays:
    """Convert corners of triangles, shape (m, 3, ...), to indexed ones in the order of their first use."""
    parts = [position.reshape(-1, 3), normal.reshape(-1, 3)]
    if uv is not None:
        parts.append(uv.reshape(-1, 2))
    if color is not None:  # its four bytes become one more column: rows are compared by bits
        parts.append(np.ascontiguousarray(color).reshape(-1, 4).view(np.float32))
    rows = np.ascontiguousarray(np.concatenate(parts, axis=1), np.float32)
    first, inverse = find_unique_rows(rows)
    order = np.argsort(first)
    rank = np.empty(len(first), np.uint32)
    rank[order] = np.arange(len(first), dtype=np.uint32)
    kept = rows[first[order]]
    return MeshArrays(
        position=np.ascontiguousarray(kept[:, :3]),
        normal=np.ascontiguousarray(kept[:, 3:6]),
        uv=None if uv is None else np.ascontiguousarray(kept[:, 6:8]),
        index=rank[inverse].reshape(-1, 3),
        color=None if color is None else np.ascontiguousarray(kept[:, -1:]).view(np.uint8),
    )


def find_unique_rows(rows: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first index of each different row, and for every row which of these it is. Compared by bits."""
    bits = rows.view(np.uint32)
    key = np.zeros(len(rows), np.uint64)
    for column in bits.T:  # Fowler-Noll-Vo hash of 64 bits per row, so that one fast sort finds equal rows
        key = (key ^ column) * np.uint64(0x100000001B3) + np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    if not np.array_equal(bits[first[inverse]], bits):  # hash collision: once in 10^8 meshes
        whole = np.ascontiguousarray(bits).view(np.dtype((np.void, bits.shape[1] * 4))).reshape(-1)
        _, first, inverse = np.unique(whole, return_index=True, return_inverse=True)
    return first, inverse.reshape(-1)


def encode_mesh(mesh: MeshArrays) -> bytes:
    """Encode a mesh, exact to the bit."""
    arrays = [
        StoredArray(ArrayName.INDEX, _narrow_index(mesh.index, mesh.vertices), ArrayFilter.DELTA),
        StoredArray(ArrayName.POSITION, mesh.position, ArrayFilter.SHUFFLE),
        StoredArray(ArrayName.NORMAL, mesh.normal, ArrayFilter.SHUFFLE),
    ]
    if mesh.uv is not None:
        arrays.append(StoredArray(ArrayName.UV, mesh.uv, ArrayFilter.SHUFFLE))
    if mesh.color is not None:
        arrays.append(StoredArray(ArrayName.COLOR, mesh.color))
    return encode_arrays(ArrayKind.MESH, arrays)


def encode_mesh_quantised(mesh: MeshArrays) -> tuple[bytes, float]:
    """Encode a mesh with 16 bits a coordinate and 8 a component of a normal, a third of the size.

    Returns the bytes, and the bound on the position error [m].
    """
    low, step = _compute_lattice(mesh.position)
    error = float(np.linalg.norm(step)) / 2 + _compute_rounding_error(mesh.position)
    arrays = [
        StoredArray(ArrayName.INDEX, _narrow_index(mesh.index, mesh.vertices), ArrayFilter.DELTA),
        _quantise(ArrayName.POSITION, mesh.position, low, step),
        StoredArray(
            ArrayName.NORMAL,
            np.rint(np.clip(mesh.normal, -1, 1) * _NORMAL_STEPS).astype(np.int8),
            ArrayFilter.SHUFFLE,
            (1 / _NORMAL_STEPS,) * 3,
            (0.0,) * 3,
        ),
    ]
    if mesh.uv is not None:
        arrays.append(_quantise(ArrayName.UV, mesh.uv, *_compute_lattice(mesh.uv)))
    if mesh.color is not None:
        arrays.append(StoredArray(ArrayName.COLOR, mesh.color))
    return encode_arrays(ArrayKind.MESH, arrays, error), error


def decode_mesh(data: bytes | bytearray | memoryview, max_bytes: int = MAX_ARRAY_BYTES) -> MeshArrays:
    """Decode a mesh of `encode_mesh` or `encode_mesh_quantised`. Raises `AssetDecodeError` for other bytes."""
    arrays = decode_arrays(data, ArrayKind.MESH, max_bytes)
    position = require_array(arrays, ArrayName.POSITION, "f4", (None, 3))
    normal = require_array(arrays, ArrayName.NORMAL, "f4", (len(position), 3))
    uv = require_array(arrays, ArrayName.UV, "f4", (len(position), 2)) if ArrayName.UV in arrays else None
    color = require_array(arrays, ArrayName.COLOR, "u1", (len(position), 4)) if ArrayName.COLOR in arrays else None
    index = require_array(arrays, ArrayName.INDEX, "u2 u4", (None, 3)).astype(np.uint32)
    if index.size and int(index.max()) >= len(position):
        raise AssetDecodeError(f"a triangle has the corner {int(index.max())}, but there are {len(position)}")
    if not np.isfinite(position).all():
        raise AssetDecodeError("a vertex is not finite")
    return MeshArrays(position, normal, uv, index, color)


def _narrow_index(index: NDArray[np.uint32], vertices: int) -> NDArray[np.uint32] | NDArray[np.uint16]:
    return index.astype(np.uint16) if vertices <= 1 << 16 else index


def _compute_lattice(values: Floats) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest value and the step of 16 bits, per column."""
    if not len(values):
        return np.zeros(values.shape[1]), np.ones(values.shape[1])
    low = values.min(axis=0).astype(np.float64)
    step = (values.max(axis=0).astype(np.float64) - low) / _POSITION_STEPS
    return low, np.where(step > 0, step, 1e-12)


def _compute_rounding_error(values: Floats) -> float:
    """Return the error that float32 arithmetic in the decoder may add, over three axes [m]."""
    return float(np.abs(values).max(initial=0.0)) * 2.0**-22


def _quantise(name: str, values: Floats, low: NDArray[np.float64], step: NDArray[np.float64]) -> StoredArray:
    stored = np.clip(np.rint((values - low) / step), 0, _POSITION_STEPS).astype(np.uint16)
    return StoredArray(name, stored, ArrayFilter.SHUFFLE, tuple(step.tolist()), tuple(low.tolist()))


# --- deformables ------------------------------------------------------------------------------------------------------


def encode_deformable(
    elements: NDArray[np.uint32],
    uv: NDArray[np.float32] | None,
    rest: NDArray[np.float32],
    topology: DeformableTopology,
    numbers: NDArray[Any] | None = None,
) -> bytes:
    """Encode a deformable.

    `elements`: edges (m, 2) or triangles (m, 3); `uv` (m, corners, 2). `rest`: vertices (n, 3) [m], world frame.
    `topology`: plan of the stream, without triangles, which are `elements`. `numbers`: numbers of the vertices in the
    simulator, if some are left out.
    """
    narrow = elements.astype(np.uint16) if len(rest) <= _SHORT else elements
    arrays = [
        StoredArray(ArrayName.ELEMENTS, narrow, ArrayFilter.DELTA),
        StoredArray(ArrayName.POSITION, rest, ArrayFilter.SHUFFLE),
        StoredArray(ArrayName.PLAN, np.frombuffer(topology.to_bytes(), np.uint8)),
    ]
    if numbers is not None:
        arrays.append(StoredArray(ArrayName.VERTEX, numbers.astype(np.uint32), ArrayFilter.DELTA))
    if uv is not None:
        arrays.append(StoredArray(ArrayName.UV, uv, ArrayFilter.SHUFFLE))
    return encode_arrays(ArrayKind.DEFORMABLE, arrays)
