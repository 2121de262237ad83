"""What a scene costs: bytes to fetch, memory of textures, triangles to draw."""

from __future__ import annotations

from typing import Final

import msgspec

from iris_session.protocol.names import GeometryKind, TextureKind
from iris_session.protocol.scene import SceneSpec, Texture, TextureLevel, Totals, asset_addresses

#: Triangles of primitives at a usual tessellation, for estimates.
PRIMITIVE_TRIANGLES: Final = {
    GeometryKind.PLANE: 2,
    GeometryKind.BOX: 12,
    GeometryKind.SPHERE: 960,
    GeometryKind.ELLIPSOID: 960,
    GeometryKind.CYLINDER: 128,
    GeometryKind.CAPSULE: 1_024,
}


def with_totals(spec: SceneSpec) -> SceneSpec:
    """`spec` with its `totals`."""
    level_bytes = {level.address: level.bytes for mesh in spec.meshes for level in mesh.levels[:1]}
    image_bytes = {level.address: level.bytes for texture in spec.textures for level in texture.levels[:1]}
    drawn = [i for i, v in enumerate(spec.visuals) if v.rgba[3] > 0 and v.group in spec.groups_shown]
    n_bending, bending_triangles = bending(spec)
    totals = Totals(
        objects=len(drawn) + n_bending,
        triangles=sum(triangles(spec, i) for i in drawn) + bending_triangles,
        mesh_bytes=sum(level_bytes.values()),
        texture_bytes=sum(image_bytes.values()),
        texture_memory=sum(texture_memory(texture, texture.levels[0]) for texture in spec.textures),
        asset_bytes=sum(asset_addresses(spec).values()),
    )
    return msgspec.structs.replace(spec, totals=totals)


def bending(spec: SceneSpec) -> tuple[int, int]:
    """How many deformables are drawn at first, and their triangles; ropes are lines."""
    shown = [part for part in spec.deformables if part.rgba[3] > 0 and part.group in spec.groups_shown]
    return len(shown), sum(part.elements for part in shown if part.dim > 1)


def triangles(spec: SceneSpec, visual: int, level: int = 0) -> int:
    """Triangles of one visual, by its position in `spec.visuals`."""
    geometry = spec.visuals[visual].geometry
    if geometry.mesh >= 0:
        levels = spec.meshes[geometry.mesh].levels
        return levels[min(level, len(levels) - 1)].triangles
    if geometry.hfield >= 0:
        field = spec.hfields[geometry.hfield]
        return 2 * max(0, field.rows - 1) * max(0, field.columns - 1)
    return PRIMITIVE_TRIANGLES.get(geometry.kind, 0)


def texture_memory(texture: Texture, level: TextureLevel) -> int:
    """Bytes on a graphics card: four a pixel, and a third more for its smaller copies."""
    faces = 1 if texture.kind == TextureKind.IMAGE else 6
    return level.width * level.height * 4 * faces * 4 // 3
