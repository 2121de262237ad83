"""Triangles of every geometry of a specification, with normals.

The reference for clients: docs/scene.md has the same formulas. MuJoCo draws round shapes with 28 slices and 16 stacks
by default; so does this.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.names import GeometryKind
from iris_session.protocol.scene import Geometry, HeightField
from iris_session.scene.meshes import MeshArrays, index_corners
from iris_session.scene.simplify import unit

SLICES: Final = 28
STACKS: Final = 16
#: Half the side of a plane that has no end [m], where something has to be drawn.
ENDLESS: Final = 50.0
Floats = NDArray[np.float64]


def primitive(geometry: Geometry) -> MeshArrays | None:
    """A shape that needs no asset, without texture coordinates; `None` for meshes, height fields, unknown kinds."""
    x, y, z = geometry.size
    size = np.array(geometry.size)
    match geometry.kind:
        case GeometryKind.PLANE:
            return _flat(
                _quads(np.array([[[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]]) * [x or ENDLESS, y or ENDLESS, 1])
            )
        case GeometryKind.BOX:
            return _flat(_quads(_BOX * size))
        case GeometryKind.SPHERE | GeometryKind.ELLIPSOID:
            return _turned(_arc(STACKS + 1, -1.0, 1.0), _arc(STACKS + 1, -1.0, 1.0), size)
        case GeometryKind.CYLINDER:
            profile = np.array([[0, -1], [1, -1], [1, -1], [1, 1], [1, 1], [0, 1]], float)
            normal = np.array([[0, -1], [0, -1], [1, 0], [1, 0], [0, 1], [0, 1]], float)
            return _turned(profile, normal, size)
        case GeometryKind.CAPSULE:
            low, high = _arc(STACKS // 2 + 1, -1.0, 0.0), _arc(STACKS // 2 + 1, 0.0, 1.0)
            middle = np.array([0.0, z / x if x else 0.0])
            profile = np.concatenate([low - middle, high + middle])
            return _turned(profile, np.concatenate([low, high]), np.array([x, x, x]))
    return None


def height_field(field: HeightField, elevation: NDArray[np.float32]) -> MeshArrays:
    """The surface, four walls and a floor. Two triangles a cell, split along the diagonal that MuJoCo takes."""
    half_x, half_y, top, base = field.size
    rows, columns = elevation.shape
    x = np.linspace(-half_x, half_x, columns)
    y = np.linspace(-half_y, half_y, rows)
    surface = np.stack([*np.meshgrid(x, y), elevation.astype(np.float64) * top], axis=-1)
    a, b = surface[:-1, :-1], surface[:-1, 1:]
    c, d = surface[1:, 1:], surface[1:, :-1]
    parts = [np.stack([d, a, c], axis=2).reshape(-1, 3, 3), np.stack([a, b, c], axis=2).reshape(-1, 3, 3)]
    for edge in (surface[0], surface[:, -1], surface[-1, ::-1], surface[::-1, 0]):
        foot = edge * [1, 1, 0] - [0, 0, base]
        parts.append(_quads(np.stack([foot[:-1], foot[1:], edge[1:], edge[:-1]], axis=1)))
    corner = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]]) * [half_x, half_y]
    parts.append(_quads(np.column_stack([corner, np.full(4, -base)])[None]))
    return _flat(np.concatenate(parts))


_BOX: Final = np.array(
    [
        [[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]],
        [[-1, 1, -1], [1, 1, -1], [1, -1, -1], [-1, -1, -1]],
        [[1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]],
        [[-1, 1, -1], [-1, -1, -1], [-1, -1, 1], [-1, 1, 1]],
        [[-1, -1, -1], [1, -1, -1], [1, -1, 1], [-1, -1, 1]],
        [[1, 1, -1], [-1, 1, -1], [-1, 1, 1], [1, 1, 1]],
    ],
    float,
)


def _quads(corners: Floats) -> Floats:
    """(n, 4, 3) to triangles (2 n, 3, 3)."""
    return np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])


def _flat(triangles: Floats) -> MeshArrays:
    normal = unit(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    return _mesh(triangles, np.repeat(normal[:, None], 3, axis=1))


def _arc(points: int, low: float, high: float) -> Floats:
    """(distance from the axis, height) on a half circle of radius 1, from `low` to `high` quarter turns."""
    angle = np.linspace(low, high, points) * np.pi / 2
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _turned(profile: Floats, normals: Floats, size: Floats) -> MeshArrays:
    """A profile (distance, height), from below, turned around z and stretched by `size`; `normals` before that."""
    angle = np.linspace(0, 2 * np.pi, SLICES + 1)
    angle[-1] = 0.0  # meets itself exactly
    turn = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def around(values: Floats) -> Floats:
        ring = values[:, None, :1] * turn[None]
        return np.concatenate([ring, np.broadcast_to(values[:, None, 1:], (*ring.shape[:2], 1))], axis=2)

    points, across = around(profile) * size, unit(around(normals) / size)

    def corners(values: Floats) -> Floats:
        a, b, c, d = values[:-1, :-1], values[:-1, 1:], values[1:, 1:], values[1:, :-1]
        return _quads(np.stack([a, b, c, d], axis=2).reshape(-1, 4, 3))

    return _mesh(corners(points), corners(across))


def _mesh(position: Floats, normal: Floats) -> MeshArrays:
    """Without triangles that have no area (at poles)."""
    area = np.linalg.norm(np.cross(position[:, 1] - position[:, 0], position[:, 2] - position[:, 0]), axis=1)
    some = area > 1e-12 * max(float(area.max(initial=0.0)), 1e-30)
    return index_corners(position[some].astype(np.float32), normal[some].astype(np.float32), None)
