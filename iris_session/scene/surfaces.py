"""Meshes as they are drawn: with a scale in their vertices, from both sides, and of one colour when they have one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.scene import Rgba
from iris_session.scene.meshes import MeshArrays, index_corners, unique_rows
from iris_session.scene.parts import Matrix
from iris_session.scene.simplify import unit


@np.errstate(all="ignore")  # what gets out of reach is refused by its coordinates
def scaled(mesh: MeshArrays, scale: Matrix | None) -> MeshArrays:
    """`mesh` with the matrix (3, 3) in its vertices; the triangles are turned over where that mirrors."""
    if scale is None:
        return mesh
    across = np.linalg.inv(scale)  # normals go with the inverse's transpose
    position = (mesh.position.astype(np.float64) @ scale.T).astype(np.float32)
    normal = unit(mesh.normal.astype(np.float64) @ across).astype(np.float32)
    if np.linalg.det(scale) > 0:
        return replace(mesh, position=position, normal=normal)
    index = mesh.index[:, [0, 2, 1]]  # and with it the order in which corners are used, by which they are numbered
    uv = None if mesh.uv is None else mesh.uv[index]
    color = None if mesh.color is None else mesh.color[index]
    return index_corners(position[index], normal[index], uv, color)


def closed(mesh: MeshArrays) -> bool:
    """Whether every edge has its triangles on both sides, so that nobody sees the inside."""
    _, vertex = unique_rows(np.ascontiguousarray(mesh.position + np.float32(0.0)))  # -0 is 0
    corner = vertex[mesh.index].astype(np.int64)
    start, end = corner.reshape(-1), corner[:, [1, 2, 0]].reshape(-1)
    count = int(corner.max(initial=0)) + 1
    return bool(np.array_equal(np.sort(start * count + end), np.sort(end * count + start)))


def both_sides(mesh: MeshArrays) -> MeshArrays:
    """`mesh` with every triangle from behind too, unless it is closed."""
    if closed(mesh):
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


def recoloured(mesh: MeshArrays, rgba: Rgba) -> tuple[MeshArrays, Rgba]:
    """A mesh whose corners all have one colour, without them and with that colour in `rgba`."""
    if mesh.color is None or not len(mesh.color) or bool((mesh.color != mesh.color[0]).any()):
        return mesh, rgba
    red, green, blue, alpha = (float(a) * float(b) / 255 for a, b in zip(rgba, mesh.color[0], strict=True))
    return replace(mesh, color=None), (red, green, blue, alpha)
