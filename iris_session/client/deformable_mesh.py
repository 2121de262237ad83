"""What a client needs to draw a deformable besides its vertices: triangles or lines, texture coordinates, look."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.names import ArrayName
from iris_session.protocol.scene import Deformable
from iris_session.scene.arrays import require_array
from iris_session.streams.deformable_topology import MAX_FACES, MAX_VERTICES

#: `Deformable.dim` of what is drawn as lines.
ROPE: Final = 1


@dataclass(frozen=True)
class DeformableMesh:
    """Of the deformable `name`, whose vertices are `Deformables.vertices[name]`. Arrays are read-only.

    `faces` (m, 3): triangles, counter-clockwise from outside where it has an outside; `edges` (k, 2): lines of a rope,
    drawn as cylinders. One of the two is empty. Both name rows of the vertices, and none that is not a number.
    `uv` (m, 3, 2) or `None`: of every triangle's corners; u to the right, v down from the upper left of the image.
    `rows` (n,): rows of the vertices that are drawn. A soft body's others are inside of it: they do not
    travel, and are not a number (NaN), so that rows are the numbers of its vertices in the model.
    `look`: what the specification says: `dim` (1 rope, 2 cloth, 3 soft body), `group`, `rgba`, `material` (a place in
    `FetchedScene.spec.materials`, -1: none), `radius` (half the thickness [m]), `flat` (one normal per triangle).
    """

    faces: NDArray[np.int32]
    edges: NDArray[np.int32]
    uv: NDArray[np.float32] | None
    rows: NDArray[np.int32]
    look: Deformable

    def looking(self, look: Deformable) -> DeformableMesh:
        """The same with another look."""
        return self if look == self.look else replace(self, look=look)


def read_mesh(spec: Deformable, arrays: Mapping[str, NDArray[Any]], n_vertices: int) -> DeformableMesh:
    """`arrays`: of its asset. `n_vertices`: how many its stream has. Raises `AssetDecodeError` or `ValueError`."""
    corners = 2 if spec.dim == ROPE else 3
    rows = np.arange(n_vertices, dtype=np.int32)
    if ArrayName.VERTEX in arrays:
        numbers = require_array(arrays, ArrayName.VERTEX, "u2 u4", (n_vertices,))
        if int(numbers.max(initial=0)) >= MAX_VERTICES:
            raise ValueError(f"deformable {spec.name!r} numbers its vertices beyond {MAX_VERTICES}")
        rows = numbers.astype(np.int32)
    places = require_array(arrays, ArrayName.ELEMENTS, "u2 u4", (None, corners))
    if len(places) > MAX_FACES or int(places.max(initial=0)) >= n_vertices:
        raise ValueError(
            f"deformable {spec.name!r} has {len(places)} elements up to vertex {int(places.max(initial=0))}: "
            f"at most {MAX_FACES}, of {n_vertices} vertices"
        )
    elements, none = rows[places], np.empty((0, 5 - corners), np.int32)
    uv = None
    if ArrayName.UV in arrays:
        # A copy: no view of the asset.
        uv = require_array(arrays, ArrayName.UV, "f4", (len(places), corners, 2)).astype(np.float32)
    faces, edges = (none, elements) if corners == 2 else (elements, none)
    for array in (faces, edges, rows, uv):
        if array is not None:
            array.setflags(write=False)
    return DeformableMesh(faces, edges, uv, rows, spec)
