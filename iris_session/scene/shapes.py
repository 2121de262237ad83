"""Triangles and texture coordinates of every geometry of a specification, as MuJoCo 4 draws them.

The reference for clients: docs/scene.md has the same formulas. MuJoCo draws round shapes with 28 slices and 16 stacks
by default; so does this.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.names import GeometryKind
from iris_session.protocol.scene import Geometry, HeightField, Material
from iris_session.scene.meshes import MeshArrays, index_corners, normalise

SLICES: Final = 28
STACKS: Final = 16
#: Half the side of an infinite plane [m] where it is drawn as a finite one.
ENDLESS: Final = 50.0
Floats = NDArray[np.float64]
#: Distance from the axis, in radii, below which the angle around it is undefined.
_POLE: Final = 1e-6


def build_primitive(geometry: Geometry) -> MeshArrays | None:
    """Return the mesh of a shape that needs no asset, without texture coordinates; `None` for other geometries."""
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
            return _revolve(_arc(STACKS + 1, -1.0, 1.0), _arc(STACKS + 1, -1.0, 1.0), size)
        case GeometryKind.CYLINDER:
            profile = np.array([[0, -1], [1, -1], [1, -1], [1, 1], [1, 1], [0, 1]], float)
            normal = np.array([[0, -1], [0, -1], [1, 0], [1, 0], [0, 1], [0, 1]], float)
            return _revolve(profile, normal, size)
        case GeometryKind.CAPSULE:
            low, high = _arc(STACKS // 2 + 1, -1.0, 0.0), _arc(STACKS // 2 + 1, 0.0, 1.0)
            middle = np.array([0.0, z / x if x else 0.0])
            profile = np.concatenate([low - middle, high + middle])
            return _revolve(profile, np.concatenate([low, high]), np.array([x, x, x]))
    return None


def build_height_field(field: HeightField, elevation: NDArray[np.float32]) -> MeshArrays:
    """Return the surface, four walls and a floor. Each cell has two triangles, split along the same diagonal as in
    MuJoCo.
    """
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
    """Convert quads (n, 4, 3) to triangles (2 n, 3, 3)."""
    return np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])


def _flat(triangles: Floats) -> MeshArrays:
    normal = normalise(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    return _mesh(triangles, np.repeat(normal[:, None], 3, axis=1))


def _arc(points: int, low: float, high: float) -> Floats:
    """Return (distance from the axis, height) on a half circle of radius 1, from `low` to `high` quarter turns."""
    angle = np.linspace(low, high, points) * np.pi / 2
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _revolve(profile: Floats, normals: Floats, size: Floats) -> MeshArrays:
    """Revolve a profile (distance, height), from below, around z and scale it by `size`; `normals` are before
    scaling.
    """
    angle = np.linspace(0, 2 * np.pi, SLICES + 1)
    angle[-1] = 0.0  # closes exactly
    turn = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def around(values: Floats) -> Floats:
        ring = values[:, None, :1] * turn[None]
        return np.concatenate([ring, np.broadcast_to(values[:, None, 1:], (*ring.shape[:2], 1))], axis=2)

    points, across = around(profile) * size, normalise(around(normals) / size)

    def corners(values: Floats) -> Floats:
        a, b, c, d = values[:-1, :-1], values[:-1, 1:], values[1:, 1:], values[1:, :-1]
        return _quads(np.stack([a, b, c, d], axis=2).reshape(-1, 4, 3))

    return _mesh(corners(points), corners(across))


def _mesh(position: Floats, normal: Floats) -> MeshArrays:
    """Return a mesh without triangles of zero area (at poles)."""
    area = np.linalg.norm(np.cross(position[:, 1] - position[:, 0], position[:, 2] - position[:, 0]), axis=1)
    some = area > 1e-12 * max(float(area.max(initial=0.0)), 1e-30)
    return index_corners(position[some].astype(np.float32), normal[some].astype(np.float32), None)


# --- texture coordinates ----------------------------------------------------------------------------------------------


def add_texture_coordinates(mesh: MeshArrays, geometry: Geometry, material: Material) -> MeshArrays:
    """Return `mesh`, the mesh of `geometry`, with the texture coordinates that `material` gives it."""
    times = np.array(material.repeat) * (geometry.size[:2] if material.uniform else 1.0)
    if mesh.uv is not None:
        return mesh if (times == 1.0).all() else replace(mesh, uv=(mesh.uv * times).astype(np.float32))
    if geometry.mesh >= 0 or geometry.hfield >= 0:
        return replace(mesh, uv=_project_along_z(mesh.position, geometry, material).astype(np.float32))
    position, normal = mesh.position[mesh.index], mesh.normal[mesh.index]
    uv = _shape_coordinates(position.astype(np.float64), normal, geometry) * times
    if geometry.kind == GeometryKind.PLANE:  # axes along which it is infinite
        endless = np.array(geometry.size[:2]) <= 0
        uv[..., endless] = _project_along_z(position, geometry, material)[..., endless]
    return index_corners(position, normal, uv.astype(np.float32))


def repeat_texture_coordinates(uv: NDArray[np.float32] | None, material: Material | None) -> NDArray[np.float32] | None:
    """Return texture coordinates of a deformable, repeated by `material`; `uniform` has no meaning without a size."""
    return uv if uv is None or material is None else (uv * np.array(material.repeat)).astype(np.float32)


def _project_along_z(position: NDArray[np.float32], geometry: Geometry, material: Material) -> Floats:
    """Return texture coordinates projected along z."""
    size = np.array(geometry.size[:2])
    per_metre = material.repeat / np.where(material.uniform | (size <= 0), 1.0, size)
    return position[..., :2] * per_metre * [0.5, -0.5] - 0.5


def _shape_coordinates(position: Floats, normal: NDArray[np.float32], geometry: Geometry) -> Floats:
    """Return texture coordinates of corners of triangles (n, 3, 3): 0..1 to the right and down."""
    size = np.array(geometry.size)
    p = position / np.where(size > 0, size, 1.0)
    match geometry.kind:
        case GeometryKind.SPHERE | GeometryKind.ELLIPSOID:
            return np.stack([_angles_around_z(p), 0.5 - _latitude(p[..., 2])], axis=-1)
        case GeometryKind.CYLINDER:
            lid = np.abs(normal[..., 2:]) > 0.5
            side = np.stack([_angles_around_z(p), 0.5 - p[..., 2] / 2], axis=-1)
            return np.where(lid, (p[..., :2] + 1) / 2, side)
        case GeometryKind.CAPSULE:
            radius, _, half = geometry.size
            middle = position[..., 2].mean(axis=1, keepdims=True)
            end = np.sign(middle) * (np.abs(middle) > half)
            cap = (end > 0) - 2 * _latitude((position[..., 2] - end * half) / radius)
            return np.stack([_angles_around_z(p), np.where(end == 0, 0.5 - p[..., 2] / 2, cap)], axis=-1)
    across = np.abs(normal).argmax(axis=-1)[..., None]  # boxes and planes: the axis of the normal
    right = np.take_along_axis(p, np.where(across == 0, 1, 0), axis=-1)
    up = np.take_along_axis(p, np.where(across == 2, 1, 2), axis=-1)
    return np.concatenate([1 + right, 1 - up], axis=-1) / 2


def _latitude(height: Floats) -> Floats:
    """Return the latitude of points on a unit sphere, from -0.5 to 0.5."""
    return np.arcsin(np.clip(height, -1.0, 1.0)) / np.pi


def _angles_around_z(p: Floats) -> Floats:
    """Return angles around z from x, in turns; triangles across the seam continue beyond 1, poles have the mean."""
    turns = (np.arctan2(p[..., 1], p[..., 0]) / (2 * np.pi)) % 1.0
    there = np.hypot(p[..., 0], p[..., 1]) > _POLE
    high = np.where(there, turns, 0.0).max(axis=1, keepdims=True)
    turns = np.where(high - turns > 0.5, turns + 1.0, turns)
    mean = np.where(there, turns, 0.0).sum(axis=1, keepdims=True) / np.maximum(there.sum(axis=1, keepdims=True), 1)
    return np.where(there, turns, mean)
