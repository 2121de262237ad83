"""Extent of a scene: the bounding box of its initial content, and whether that looks like a mistake of units.

Planes are not counted: a floor has any size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.assets.store import AssetStore
from iris_session.protocol.common import Vec3
from iris_session.protocol.names import ArrayKind, GeometryKind
from iris_session.protocol.scene import Geometry, SceneSpec, Visual
from iris_session.scene.arrays import decode_arrays
from iris_session.scene.meshes import decode_mesh
from iris_session.scene.nodes import to_matrix, to_vec3

#: Larger than any part or robot and most rooms [m]; a part of a centimetre with a file in millimetres is larger.
_LARGEST_M: Final = 10.0
#: Too small to be seen or grasped [m]; a part of two metres that was divided by 1,000 once too often is smaller.
_SMALLEST_M: Final = 0.002
Points = NDArray[Any]


class Extent(msgspec.Struct, frozen=True):
    """A box in the world: lowest and highest corner, lengths of its sides [m]."""

    low: Vec3
    high: Vec3
    size: Vec3


def compute_extent(spec: SceneSpec, store: AssetStore) -> Extent | None:
    """Return the extent of the initial content, by the vertices of its meshes; `None` when there are only planes.

    Raises `AssetMissingError` when the store lacks an asset of the scene.
    """
    shown = [v for v in spec.visuals if v.rgba[3] > 0 and v.group in spec.groups_shown]
    bending = (
        decode_arrays(store.get(part.address), ArrayKind.DEFORMABLE)["position"]
        for part in spec.deformables
        if part.rgba[3] > 0 and part.group in spec.groups_shown
    )
    return compute_bounds(
        spec, shown, lambda mesh: decode_mesh(store.get(spec.meshes[mesh].levels[0].address)).position, bending
    )


def compute_box_extent(spec: SceneSpec, more: Iterable[Points] = ()) -> Extent | None:
    """Return the extent of everything, by the bounding boxes of meshes: no asset is read.

    Rotated meshes count as up to 1.7 times as large. `more`: further points (n, 3) [m].
    """
    return compute_bounds(spec, spec.visuals, lambda k: _box_corners(spec.meshes[k].low, spec.meshes[k].high), more)


@np.errstate(all="ignore")  # lengths that are not finite are rejected with the specification
def compute_bounds(
    spec: SceneSpec, visuals: Iterable[Visual], points_of: Callable[[int], Points], more: Iterable[Points] = ()
) -> Extent | None:
    """Return the bounding box in the world of `visuals` and of `more` points (n, 3).

    `points_of`: returns the points (n, 3) of a mesh by its number.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    T_world_body = {body.id: to_matrix(body.T_world_body) for body in spec.bodies}
    mesh, points = -1, np.empty((0, 3))
    for visual in sorted(visuals, key=lambda v: v.geometry.mesh):  # one mesh in memory at a time
        if visual.geometry.kind == GeometryKind.PLANE:
            continue
        T = T_world_body[visual.body] @ to_matrix(visual.T_body_visual)
        if visual.geometry.mesh >= 0:
            if visual.geometry.mesh != mesh:
                mesh = visual.geometry.mesh
                points = np.asarray(points_of(mesh), np.float64)
            placed = points @ T[:3, :3].T + T[:3, 3]
        elif visual.geometry.hfield >= 0:
            placed = _field_corners(spec, visual.geometry) @ T[:3, :3].T + T[:3, 3]
        else:
            reach = _shape_reach(visual.geometry, T[:3, :3])
            placed = np.stack([T[:3, 3] - reach, T[:3, 3] + reach])
        low, high = _extend_bounds(placed, low, high)
    for vertices in more:
        low, high = _extend_bounds(np.asarray(vertices, np.float64), low, high)
    return Extent(to_vec3(low), to_vec3(high), to_vec3(high - low)) if bool((low <= high).all()) else None


def largest_mesh_side(spec: SceneSpec) -> float:
    """Return the longest side of a drawn mesh, in its own frame [m]; 0 without meshes."""
    worn = {v.geometry.mesh for v in spec.visuals if v.rgba[3] > 0 and v.geometry.mesh >= 0}
    boxes = (spec.meshes[mesh] for mesh in worn)
    return max((b - a for box in boxes for a, b in zip(box.low, box.high, strict=True)), default=0.0)


def format_unit_hint(side_m: float, remedy: str) -> str:
    """Return the likely mistake of units behind a longest side as a line, empty where the side is plausible.

    `remedy`: correction, with `{factor}` for the factor.
    """
    if side_m > _LARGEST_M:
        factor, what = 1e-3, "in millimetres where metres are meant?"
    elif 0.0 < side_m < _SMALLEST_M:
        factor, what = 1e3, "divided by 1,000 once too often?"
    else:
        return ""
    remedied = remedy.format(factor=f"{factor:g}")
    return f"{format_length(side_m)} large: {what} {remedied} makes it {format_length(side_m * factor)}"


def format_size(extent: Extent) -> str:
    """Return the sides of a box as text."""
    return " x ".join(format_coordinates(extent, extent.size)) + " m"


def format_coordinates(extent: Extent, values: Vec3) -> list[str]:
    """Return coordinates of a box as text [m]; values that are negligible beside its sides are rounding errors,
    shown as 0.
    """
    least = 1e-9 * max(map(abs, (*extent.low, *extent.high)))
    return [f"{0.0 if abs(v) < least else v:.3g}" for v in values]


def format_length(metres: float) -> str:
    """Return a length as text."""
    value, unit = (metres, "m") if metres >= 0.1 else (1e3 * metres, "mm")
    return f"{value:,.0f} {unit}" if value >= 1e4 else f"{value:.4g} {unit}"


def _box_corners(low: Vec3, high: Vec3) -> Points:
    """Return the eight corners of a box, (8, 3)."""
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def _extend_bounds(points: Points, low: Points, high: Points) -> tuple[Points, Points]:
    if not len(points):
        return low, high
    return np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))


def _field_corners(spec: SceneSpec, geometry: Geometry) -> Points:
    """Return the corners of the box around a height field: its highest elevation is 1."""
    half_x, half_y, top, base = spec.hfields[geometry.hfield].size
    return _box_corners((-half_x, -half_y, -base), (half_x, half_y, top))


def _shape_reach(geometry: Geometry, R_world_visual: Points) -> Points:
    """Return the half extents of a shape along the axes of the world, (3,) [m]."""
    R, size = np.abs(R_world_visual), np.array(geometry.size)
    match geometry.kind:
        case GeometryKind.SPHERE | GeometryKind.ELLIPSOID:
            return np.asarray(np.linalg.norm(R * size, axis=1))
        case GeometryKind.CAPSULE:
            return np.asarray(R[:, 2] * size[2] + size[0])
        case GeometryKind.CYLINDER:
            return np.asarray(R[:, 2] * size[2] + size[0] * np.sqrt(np.maximum(0.0, 1.0 - R[:, 2] ** 2)))
    return np.asarray(R @ size)
