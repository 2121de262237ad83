"""Meshes and deformables as assets: indexed corners, exact or quantised, and back; coarser and transformed meshes.

A corner is a vertex with its normal and texture coordinate as drawn; corners that agree in all bits are merged.

Coarser meshes have a stated error: the vertices in one cell of a grid are merged to one of them. Quadric decimation
keeps flat parts better, but here the error is proven: no point of a triangle moves further than the vertex that moves
most. (fast-simplification states no error, and keeps global state: it may not run in threads.) Parts that fit into a
cell vanish. Meshes with texture coordinates or colours are not simplified: these would move across seams.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.assets import MAX_ARRAY_BYTES
from iris_session.protocol.names import ArrayFilter, ArrayKind, ArrayName
from iris_session.protocol.scene import Rgba
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
#: A corner whose smooth normal is farther than this (cosine) from the face's gets the face's: MuJoCo's rule for meshes.
CREASE: Final = 0.8
#: Maximum number of cell sizes tried to reach the wanted number of triangles.
_TRIES: Final = 3
#: Maximum number of times that cells are halved for long and thin parts.
_FINER: Final = 4
Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]


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


# --- coarser meshes, normals, transformed meshes ----------------------------------------------------------------------


def simplify_mesh(mesh: MeshArrays, triangles: int) -> tuple[MeshArrays, float] | None:
    """Return a mesh of about `triangles`, and the maximum distance of its points from `mesh` [m].

    `None` when that would save less than a quarter, and when `mesh` is textured or coloured.
    """
    if mesh.uv is not None or mesh.color is not None or triangles <= 0 or mesh.triangles <= triangles:
        return None
    first, inverse = find_unique_rows(mesh.position + np.float32(0.0))  # -0 is 0
    points = mesh.position[first].astype(np.float64)
    index = inverse[mesh.index]
    area = float(np.linalg.norm(_face_vectors(points[index]), axis=1).sum())
    cell = np.sqrt(max(area, 1e-18) / triangles)  # a cell of surface is about two triangles; `area` is twice the area
    best: tuple[Doubles, Ints, float] | None = None
    for _ in range(_TRIES):
        found = _cluster(points, index, float(cell))
        if len(found[1]) and (best is None or abs(len(found[1]) - triangles) < abs(len(best[1]) - triangles)):
            best = found
        cell *= np.clip(np.sqrt(max(1, len(found[1])) / triangles), 0.5, 2.0)
    if best is None or len(best[1]) > 0.75 * mesh.triangles:
        return None
    return build_smooth_mesh(best[0], best[1]), best[2]


def _cluster(points: Doubles, index: Ints, cell: float) -> tuple[Doubles, Ints, float]:
    """Return the remaining points, the triangles between them, and the largest distance that a point moved.

    Long and thin parts, such as rods and legs of tables, would vanish where their width fits into a cell: they are
    clustered again in finer cells, at last in none.
    """
    found, faces, n_points, longest = [], [], 0, 0.0
    for finer in range(_FINER + 1):
        some, between, lost, moved = _cluster_once(points, index, cell / (1 << finer))
        found.append(some)
        faces.append(between + n_points)
        n_points, longest, index = n_points + len(some), max(longest, moved), lost
        if not len(lost):
            break
    used, last = _compact(index, len(points))
    found.append(points[used])
    faces.append(last + n_points)
    return np.concatenate(found), np.concatenate(faces), longest


def _cluster_once(points: Doubles, index: Ints, cell: float) -> tuple[Doubles, Ints, Ints, float]:
    """Cluster as `_cluster`, for one cell size; the third result are the triangles of vanished parts."""
    used, index = _compact(index, len(points))
    points = points[used]
    cells = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    _, cluster = find_unique_rows(cells)
    count = np.bincount(cluster)
    mean = np.stack([np.bincount(cluster, points[:, k]) for k in range(3)], axis=1) / count[:, None]
    off = np.linalg.norm(points - mean[cluster], axis=1)
    order = np.lexsort((off, cluster))
    keep = order[np.searchsorted(cluster[order], np.arange(len(count)))]  # the point nearest to the mean of each cell
    faces = cluster[index]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    moved = float(np.linalg.norm(points - points[keep][cluster], axis=1).max(initial=0.0))
    lost = used[_find_lost(points, index[~whole], faces[~whole], faces[whole], 2 * moved)]
    faces = faces[whole]
    turned_over = np.einsum("fc,fc->f", _face_vectors(points[index[whole]]), _face_vectors(points[keep][faces])) < 0
    faces[turned_over] = faces[turned_over][:, ::-1]
    turned = np.argmin(faces, axis=1)[:, None] + np.arange(3)
    faces = np.take_along_axis(faces, turned % 3, axis=1)
    faces = faces[np.sort(find_unique_rows(faces)[0])]
    stay, faces = np.unique(faces, return_inverse=True)
    return points[keep[stay]], faces.reshape(-1, 3), lost, moved


def _compact(index: Ints, n_points: int) -> tuple[Ints, Ints]:
    """Return the used points, in order, and the triangles renumbered to them."""
    has = np.zeros(n_points, bool)
    has[index] = True
    return np.flatnonzero(has), (np.cumsum(has) - 1)[index]


def _find_lost(points: Doubles, flat: Ints, ends: Ints, faces: Ints, small: float) -> Ints:
    """Return the triangles of vanished parts larger than `small` [m].

    `flat`: triangles that became lines or points between the clusters `ends`. A part has vanished when no edge or
    corner of `faces` lies where it was.
    """
    low, high = ends.min(axis=1), ends.max(axis=1)
    n = int(max(high.max(initial=0), faces.max(initial=0))) + 1
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    corners = np.flatnonzero(np.bincount(faces.reshape(-1), minlength=n))
    there = np.concatenate([edges[:, 0] * n + edges[:, 1], corners * (n + 1)])
    gone: Ints = flat[~np.isin(low * n + high, there)]
    if not len(gone):
        return gone
    part = _connected_parts(gone, len(points))
    which = np.repeat(part, 3)
    at = points[gone.reshape(-1)]
    box = np.zeros((2, int(part.max()) + 1, 3))
    box[0], box[1] = np.inf, -np.inf
    np.minimum.at(box[0], which, at)
    np.maximum.at(box[1], which, at)
    large: Ints = gone[np.linalg.norm(box[1, part] - box[0, part], axis=1) > small]
    return large


def _connected_parts(faces: Ints, n_points: int) -> Ints:
    """Return the connected part of each triangle, named by the smallest index in it."""
    least = np.arange(n_points)
    while True:
        of_corners = least[faces]
        of_faces = np.repeat(of_corners.min(axis=1), 3)
        lower = least.copy()
        np.minimum.at(lower, of_corners.reshape(-1), of_faces)
        np.minimum.at(lower, faces.reshape(-1), of_faces)
        lower = lower[lower]
        if np.array_equal(lower, least):
            return least[faces[:, 0]]
        least = lower


def build_smooth_mesh(points: Doubles, faces: Ints) -> MeshArrays:
    """Return a mesh with area-weighted normals at its corners, creased by `CREASE`."""
    corners = points[faces]
    return index_corners(corners.astype(np.float32), compute_creased_normals(points, faces).astype(np.float32), None)


def compute_creased_normals(points: Doubles, faces: Ints) -> Doubles:
    """Return normals at the corners of faces, (m, 3, 3): area-weighted, or that of the face across a crease."""
    face_normal = _face_vectors(points[faces])
    around, each = faces.T.reshape(-1), np.tile(face_normal, (3, 1))
    vertex_normal = np.stack([np.bincount(around, each[:, k], len(points)) for k in range(3)], axis=1)
    face_normal = normalise(face_normal)
    normal = normalise(vertex_normal)[faces]
    creased = np.einsum("fkc,fc->fk", normal, face_normal) < CREASE
    normal[creased] = np.broadcast_to(face_normal[:, None], normal.shape)[creased]
    return normal


def _face_vectors(corners: Doubles) -> Doubles:
    """Return normals of triangles (n, 3, 3), of length twice the area."""
    normals: Doubles = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals


def normalise(vectors: NDArray[Any]) -> NDArray[Any]:
    """Return vectors of length 1; vectors without length become +z, as in MuJoCo's renderer."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-15, vectors / np.maximum(length, 1e-15), np.array([0, 0, 1], vectors.dtype))


# --- transformed meshes -----------------------------------------------------------------------------------------------


@np.errstate(all="ignore")  # coordinates that get too large are rejected later
def scale_mesh(mesh: MeshArrays, scale: Doubles | None) -> MeshArrays:
    """Return `mesh` with the matrix (3, 3) applied to its vertices; a mirroring matrix reverses the triangles."""
    if scale is None:
        return mesh
    across = np.linalg.inv(scale)  # normals transform by the transpose of the inverse
    position = (mesh.position.astype(np.float64) @ scale.T).astype(np.float32)
    normal = normalise(mesh.normal.astype(np.float64) @ across).astype(np.float32)
    if np.linalg.det(scale) > 0:
        return replace(mesh, position=position, normal=normal)
    index = mesh.index[:, [0, 2, 1]]  # and with it the order in which corners are used, by which they are numbered
    uv = None if mesh.uv is None else mesh.uv[index]
    color = None if mesh.color is None else mesh.color[index]
    return index_corners(position[index], normal[index], uv, color)


def is_closed(mesh: MeshArrays) -> bool:
    """Return whether every edge has triangles on both sides, so that the inside is never visible."""
    _, vertex = find_unique_rows(np.ascontiguousarray(mesh.position + np.float32(0.0)))  # -0 is 0
    corner = vertex[mesh.index].astype(np.int64)
    start, end = corner.reshape(-1), corner[:, [1, 2, 0]].reshape(-1)
    count = int(corner.max(initial=0)) + 1
    return bool(np.array_equal(np.sort(start * count + end), np.sort(end * count + start)))


def add_back_sides(mesh: MeshArrays) -> MeshArrays:
    """Return `mesh` with the back side of every triangle added, unless it is closed."""
    if is_closed(mesh):
        return mesh
    n = np.uint32(mesh.vertices)

    def twice(values: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([values, values])

    return MeshArrays(
        position=twice(mesh.position),
        normal=np.concatenate([mesh.normal, -mesh.normal]),
        uv=None if mesh.uv is None else twice(mesh.uv),
        index=np.concatenate([mesh.index, mesh.index[:, [0, 2, 1]] + n]),
        color=None if mesh.color is None else twice(mesh.color),
    )


def merge_vertex_color(mesh: MeshArrays, rgba: Rgba) -> tuple[MeshArrays, Rgba]:
    """Return the mesh without vertex colours and the colour times theirs, when all corners have the same colour."""
    if mesh.color is None or not len(mesh.color) or bool((mesh.color != mesh.color[0]).any()):
        return mesh, rgba
    red, green, blue, alpha = (float(a) * float(b) / 255 for a, b in zip(rgba, mesh.color[0], strict=True))
    return replace(mesh, color=None), (red, green, blue, alpha)
