"""Topology of a deformable mesh: its triangles and edges, and the order in which the codec predicts its vertices.

Both ends hold the same topology, so frames (`deformable`) carry coordinates only. Its bytes (normative:
docs/deformables.md) are sent once; a client needs no algorithm but to follow the tables. A plan is one of two:

- `ROWS`: the vertices, perhaps in another order, are rows x cols; residuals are differences along both directions.
  Cloths whose vertices are numbered in rows, and ropes, as one row. Undone by two cumulative sums.
- `TREE`: a vertex is predicted from three that come before it, a + b - c, the parallelogram over a neighbouring
  triangle. Any other mesh. Undone level by level; the number of levels grows with the radius of the mesh.

A plan only makes frames smaller: with any plan they decode to the same vertices.
"""

from __future__ import annotations

import struct
import zlib
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from iris_session.streams.errors import StreamError

FORMAT: Final = 1
ROWS: Final = 0
TREE: Final = 1
MAX_VERTICES: Final = 2**18
MAX_FACES: Final = 2**20
#: Of a tree: about the radius of the largest mesh. A mesh with more (a long ribbon) is predicted along a walk instead.
MAX_LEVELS: Final = 1024
#: Bit of `flags`: the vertices are in another order than their numbers.
_ORDERED: Final = 1
#: format u8, plan u8, flags u16, vertices u32, rows u32, cols u32, faces u32, edges u32.
_HEADER: Final = struct.Struct("<BBHIIIII")

Ints = npt.NDArray[np.int32]
Edges = npt.NDArray[np.int64]


class _Plan(NamedTuple):
    """`order` (n,): vertex at each place, None for its number. `parents` (3, n): places, for a tree."""

    order: Ints | None
    rows: int
    cols: int
    parents: Ints | None


class DeformableTopology:
    """Triangles and lines of a mesh; read-only.

    `identity`: in every frame, so that no frame is decoded with another mesh.

    Args:
        n_vertices: Number of vertices.
        faces: Triangles of vertex numbers, shape (m, 3).
        edges: Lines of vertex numbers, shape (k, 2).

    Raises:
        ValueError: The mesh is invalid.
    """

    def __init__(self, n_vertices: int, faces: npt.ArrayLike = (), edges: npt.ArrayLike = ()) -> None:
        if not 1 <= n_vertices <= MAX_VERTICES:
            raise ValueError(f"{n_vertices} vertices: a deformable stream has 1 to {MAX_VERTICES}")
        face_table, edge_table = _table(faces, 3, n_vertices), _table(edges, 2, n_vertices)
        self._set_tables(n_vertices, face_table, edge_table, _plan(n_vertices, face_table, edge_table))

    def _set_tables(self, n_vertices: int, faces: Ints, edges: Ints, plan: _Plan) -> None:
        self.n_vertices = n_vertices
        self.faces, self.edges = faces, edges
        self.order, self.rows, self.cols, self.parents = plan
        self.levels = () if plan.parents is None else _levels(plan.parents)
        for table in (faces, edges, plan.order, plan.parents):
            if table is not None:
                table.setflags(write=False)
        self.identity = zlib.crc32(self.to_bytes())

    @property
    def plan(self) -> int:
        """`ROWS` or `TREE`."""
        return ROWS if self.parents is None else TREE

    def to_bytes(self) -> bytes:
        """Encode the topology for clients."""
        flags = 0 if self.order is None else _ORDERED
        tables = [table for table in (self.order, self.parents, self.faces, self.edges) if table is not None]
        sizes = (self.n_vertices, self.rows, self.cols, len(self.faces), len(self.edges))
        return _HEADER.pack(FORMAT, self.plan, flags, *sizes) + b"".join(t.astype("<u4").tobytes() for t in tables)

    def without_faces(self) -> DeformableTopology:
        """Return the same plan without triangles and lines, for clients that have them already. Another identity."""
        made = DeformableTopology.__new__(DeformableTopology)
        plan = _Plan(self.order, self.rows, self.cols, self.parents)
        made._set_tables(self.n_vertices, self.faces[:0], self.edges[:0], plan)
        return made

    @classmethod
    def from_bytes(cls, data: bytes | memoryview) -> DeformableTopology:
        """Decode the bytes of `to_bytes`.

        Raises:
            StreamError: Any other bytes.
        """
        if len(data) < _HEADER.size:
            raise StreamError(f"topology of {len(data)} bytes, shorter than its header of {_HEADER.size}")
        form, plan, flags, n, rows, cols, n_faces, n_edges = _HEADER.unpack_from(data)
        if form != FORMAT or plan not in (ROWS, TREE) or flags & ~_ORDERED:
            raise StreamError(f"topology of format {form}, plan {plan}, flags {flags}: format {FORMAT} is known")
        if not 1 <= n <= MAX_VERTICES or max(n_faces, n_edges) > MAX_FACES:
            raise StreamError(f"topology of {n} vertices, {n_faces} faces, {n_edges} edges: too many, or no vertex")
        if (rows, cols) != (0, 0) if plan == TREE else rows * cols != n:
            raise StreamError(f"{rows} rows of {cols} for {n} vertices")
        shapes = [(n,)] * flags + [(3, n)] * (plan == TREE) + [(n_faces, 3), (n_edges, 2)]
        tables, at = [], _HEADER.size
        if len(data) != at + sum(4 * int(np.prod(shape)) for shape in shapes):
            raise StreamError(f"topology of {len(data)} bytes: its header asks for another number")
        for shape in shapes:
            table = np.ndarray(shape, "<u4", data, at)
            if table.size and table.max() >= n:
                raise StreamError(f"topology names vertex {table.max()} of {n}")
            tables.append(table.astype(np.int32))
            at += table.nbytes
        order = tables.pop(0) if flags else None
        parents = tables.pop(0) if plan == TREE else None
        if order is not None and (np.bincount(order, minlength=n) != 1).any():
            raise StreamError("the order of a topology is not one of all vertices, each once")
        made = cls.__new__(cls)
        made._set_tables(n, tables[0], tables[1], _Plan(order, rows, cols, parents))
        return made


def used_vertices(n_vertices: int, faces: npt.ArrayLike) -> tuple[npt.NDArray[np.int64], Ints]:
    """Return the vertices of `faces`, ascending, and the faces renumbered by their place among these.

    For a solid, of which only the shell is drawn: stream `vertices[used]`.
    """
    table = _table(faces, 3, n_vertices)
    used, places = np.unique(table, return_inverse=True)
    return used.astype(np.int64), places.reshape(table.shape).astype(np.int32)


# --- plans ----------------------------------------------------------------------------------------------------------


def _table(values: npt.ArrayLike, width: int, n_vertices: int) -> Ints:
    table = np.array(values, np.int64).reshape(-1, width)
    if table.size and not 0 <= table.min() <= table.max() < n_vertices:
        raise ValueError(f"vertices {table.min()} to {table.max()} of {n_vertices}: numbers begin at 0")
    if len(table) > MAX_FACES:
        raise ValueError(f"{len(table)} faces or edges: at most {MAX_FACES}")
    return table.astype(np.int32)


def _plan(n_vertices: int, faces: Ints, edges: Ints) -> _Plan:
    links = np.concatenate([edges, faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    links = links[links[:, 0] != links[:, 1]]
    cols = _columns(n_vertices, links)
    if cols:
        return _Plan(None, n_vertices // cols, cols, None)
    tree = _tree(n_vertices, faces) if len(faces) else None
    if tree is not None:
        return tree
    return _Plan(_walk(n_vertices, links), 1, n_vertices, None)


def _columns(n_vertices: int, links: Edges) -> int:
    """Return the row length when every link joins adjacent vertices of a grid (also diagonally), 0 for other meshes."""
    strides = np.unique(np.abs(links[:, 0] - links[:, 1]))
    if len(strides) == 0 or len(strides) > 4:
        return 0
    if strides[-1] == 1:
        return n_vertices  # a rope
    for cols in sorted({int(s) + d for s in strides for d in (-1, 0, 1)}):
        if cols < 2 or n_vertices % cols or cols == n_vertices:
            continue
        rows, places = np.divmod(links, cols)
        if max(np.abs(np.diff(rows)).max(), np.abs(np.diff(places)).max()) <= 1:
            return cols
    return 0


def _walk(n_vertices: int, links: Edges) -> Ints | None:
    """Return each vertex once, along links, from the ends of lines first; None when that is their order already."""
    both = np.concatenate([links, links[:, ::-1]])
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    degrees = np.bincount(both[:, 0], minlength=n_vertices)
    starts = np.concatenate([[0], np.cumsum(degrees)]).tolist()
    adjacent = both[:, 1].tolist()
    seen = bytearray(n_vertices)
    order: list[int] = []
    for begin in np.argsort(degrees, kind="stable").tolist():
        stack = [begin]
        while stack:
            vertex = stack.pop()
            if seen[vertex]:
                continue
            seen[vertex] = 1
            order.append(vertex)
            stack += [v for v in adjacent[starts[vertex] : starts[vertex + 1]] if not seen[v]]
    return None if order == list(range(n_vertices)) else np.array(order, np.int32)


def _tree(n_vertices: int, faces: Ints) -> _Plan | None:
    """Grow a tree over the triangles, a whole front of vertices at once; None when it takes too many levels."""
    across = _find_opposite_corners(faces)
    known = np.zeros(n_vertices, np.bool_)
    in_face = np.zeros(n_vertices, np.bool_)
    in_face[faces] = True
    parents = np.zeros((n_vertices, 3), np.int64)
    root = int(faces[0, 0])
    # Vertices without a triangle come directly after the root.
    parents[:] = root
    first = np.concatenate([[root], np.flatnonzero(~in_face)])
    known[first] = True
    order = [first]
    while not known.all():
        if len(order) > MAX_LEVELS - 2:
            return None
        held = known[faces]
        count = held.sum(axis=1)
        open_faces = count < 3
        faces, across, held, count = faces[open_faces], across[open_faces], held[open_faces], count[open_faces]
        new = _front(faces, across, held, count, known, parents)
        known[new] = True
        order.append(new)
    places = np.concatenate(order)
    place_of = np.empty(n_vertices, np.int32)
    place_of[places] = np.arange(n_vertices, dtype=np.int32)
    table = np.ascontiguousarray(place_of[parents[places]].T)
    return _Plan(places.astype(np.int32), 0, 0, table)


def _front(
    faces: Ints, across: Ints, held: npt.NDArray[np.bool_], count: Edges, known: npt.NDArray[np.bool_], parents: Edges
) -> Edges:
    """Return the next vertices and write their `parents`. `held`: known corners of `faces`; `count`: their number."""
    ready = np.flatnonzero(count == 2)
    if not len(ready):
        touching = np.flatnonzero(count == 1)
        if not len(touching):  # another piece: its first vertex follows the root
            return faces[0, :1].astype(np.int64)
        face = faces[touching[0]]
        new = np.unique(face[~held[touching[0]]]).astype(np.int64)
        parents[new] = face[held[touching[0]]][0]
        return new
    corner = np.argmin(held[ready], axis=1)
    vertex = faces[ready, corner].astype(np.int64)
    a, b = faces[ready, (corner + 1) % 3], faces[ready, (corner + 2) % 3]
    c = across[ready, corner]
    whole = (c >= 0) & known[c]
    # Of several triangles that reach a vertex, one with a known triangle on its other side.
    best = np.lexsort((ready, ~whole, vertex))
    new, at = np.unique(vertex[best], return_index=True)
    best = best[at]
    parents[new] = np.stack([a[best], b[best], np.where(whole[best], c[best], b[best])], axis=1)
    return new


def _find_opposite_corners(faces: Ints) -> Ints:
    """Return (m, 3): of the edge opposite each corner, the opposite corner of the other triangle there; -1 for none."""
    low = np.minimum(faces[:, [1, 2, 0]], faces[:, [2, 0, 1]]).astype(np.int64)
    high = np.maximum(faces[:, [1, 2, 0]], faces[:, [2, 0, 1]]).astype(np.int64)
    key = (low * MAX_VERTICES + high).ravel()
    opposite = faces.ravel()
    by_edge = np.argsort(key, kind="stable")
    same = key[by_edge][1:] == key[by_edge][:-1]
    across = np.full(len(key), -1, np.int32)
    first, second = by_edge[:-1][same], by_edge[1:][same]
    across[second] = opposite[first]
    across[first] = opposite[second]
    return across.reshape(faces.shape)


def _levels(parents: Ints) -> tuple[tuple[int, int], ...]:
    """Return ranges of places whose parents all come before the range. Raises `StreamError` when there are none."""
    newest = parents.max(axis=0)
    n = len(newest)
    if newest[0] != 0 or (newest[1:] >= np.arange(1, n)).any():
        raise StreamError("a vertex of the topology is predicted from one that comes after it")
    levels, begin = [], 1
    while begin < n:
        later = newest[begin:] >= begin
        end = begin + int(np.argmax(later)) if later.any() else n
        levels.append((begin, end))
        begin = end
        if len(levels) > MAX_LEVELS:
            raise StreamError(f"the topology has more than {MAX_LEVELS} levels")
    return tuple(levels)
