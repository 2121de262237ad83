"""Texture coordinates of 2d textures, as MuJoCo 4 draws them (docs/scene.md has the formulas)."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.names import GeometryKind
from iris_session.protocol.scene import Geometry, Material
from iris_session.scene.meshes import MeshArrays, index_corners

#: Distance from the axis, in radii, below which there is no angle around it.
_POLE: Final = 1e-6
Floats = NDArray[np.float64]


def with_coordinates(mesh: MeshArrays, geometry: Geometry, material: Material) -> MeshArrays:
    """`mesh`, which is that of `geometry`, with the coordinates that `material` gives it."""
    times = np.array(material.repeat) * (geometry.size[:2] if material.uniform else 1.0)
    if mesh.uv is not None:
        return mesh if (times == 1.0).all() else replace(mesh, uv=(mesh.uv * times).astype(np.float32))
    if geometry.mesh >= 0 or geometry.hfield >= 0:
        return replace(mesh, uv=_from_above(mesh.position, geometry, material).astype(np.float32))
    position, normal = mesh.position[mesh.index], mesh.normal[mesh.index]
    uv = _on_shape(position.astype(np.float64), normal, geometry) * times
    if geometry.kind == GeometryKind.PLANE:  # along which it has no end
        endless = np.array(geometry.size[:2]) <= 0
        uv[..., endless] = _from_above(position, geometry, material)[..., endless]
    return index_corners(position, normal, uv.astype(np.float32))


def on_deformable(uv: NDArray[np.float32] | None, material: Material | None) -> NDArray[np.float32] | None:
    """Coordinates that what bends has itself, as `material` repeats them; it has no size that `uniform` could mean."""
    return uv if uv is None or material is None else (uv * np.array(material.repeat)).astype(np.float32)


def _from_above(position: NDArray[np.float32], geometry: Geometry, material: Material) -> Floats:
    """Laid over it along z."""
    size = np.array(geometry.size[:2])
    per_metre = material.repeat / np.where(material.uniform | (size <= 0), 1.0, size)
    return position[..., :2] * per_metre * [0.5, -0.5] - 0.5


def _on_shape(position: Floats, normal: NDArray[np.float32], geometry: Geometry) -> Floats:
    """Where corners of triangles (n, 3, 3) are on the surface: 0..1 to the right and down."""
    size = np.array(geometry.size)
    p = position / np.where(size > 0, size, 1.0)
    match geometry.kind:
        case GeometryKind.SPHERE | GeometryKind.ELLIPSOID:
            return np.stack([_around(p), 0.5 - _latitude(p[..., 2])], axis=-1)
        case GeometryKind.CYLINDER:
            lid = np.abs(normal[..., 2:]) > 0.5
            side = np.stack([_around(p), 0.5 - p[..., 2] / 2], axis=-1)
            return np.where(lid, (p[..., :2] + 1) / 2, side)
        case GeometryKind.CAPSULE:
            radius, _, half = geometry.size
            middle = position[..., 2].mean(axis=1, keepdims=True)
            end = np.sign(middle) * (np.abs(middle) > half)
            cap = (end > 0) - 2 * _latitude((position[..., 2] - end * half) / radius)
            return np.stack([_around(p), np.where(end == 0, 0.5 - p[..., 2] / 2, cap)], axis=-1)
    across = np.abs(normal).argmax(axis=-1)[..., None]  # of boxes and planes: the axis that a side looks along
    right = np.take_along_axis(p, np.where(across == 0, 1, 0), axis=-1)
    up = np.take_along_axis(p, np.where(across == 2, 1, 2), axis=-1)
    return np.concatenate([1 + right, 1 - up], axis=-1) / 2


def _latitude(height: Floats) -> Floats:
    """Of points on a ball of radius 1, from -0.5 to 0.5."""
    return np.arcsin(np.clip(height, -1.0, 1.0)) / np.pi


def _around(p: Floats) -> Floats:
    """Angles around z from x, in turns: triangles that reach over the seam go on beyond 1, at poles lies the mean."""
    turns = (np.arctan2(p[..., 1], p[..., 0]) / (2 * np.pi)) % 1.0
    there = np.hypot(p[..., 0], p[..., 1]) > _POLE
    high = np.where(there, turns, 0.0).max(axis=1, keepdims=True)
    turns = np.where(high - turns > 0.5, turns + 1.0, turns)
    mean = np.where(there, turns, 0.0).sum(axis=1, keepdims=True) / np.maximum(there.sum(axis=1, keepdims=True), 1)
    return np.where(there, turns, mean)
