"""Cost of a scene (bytes to fetch, texture memory, triangles), and levels of detail that fit the budget of a client."""

from __future__ import annotations

import heapq
from collections import Counter
from typing import Final, NamedTuple

import msgspec

from iris_session.protocol.names import GeometryKind, TextureKind
from iris_session.protocol.scene import Mesh, SceneSpec, Texture, TextureLevel, Totals, list_assets

#: Triangles of primitives at a usual tessellation, for estimates.
PRIMITIVE_TRIANGLES: Final = {
    GeometryKind.PLANE: 2,
    GeometryKind.BOX: 12,
    GeometryKind.SPHERE: 960,
    GeometryKind.ELLIPSOID: 960,
    GeometryKind.CYLINDER: 128,
    GeometryKind.CAPSULE: 1_024,
}


class Budget(msgspec.Struct, frozen=True):
    """Limits of what a client draws; 0 means no limit.

    Attributes:
        triangles: Triangles drawn.
        texture_bytes: Memory of textures on the graphics card [bytes].
        objects: Objects drawn (draw calls).
    """

    triangles: int = 0
    texture_bytes: int = 0
    objects: int = 0


#: Limits above which a Quest 3 begins to struggle.
QUEST_3: Final = Budget(triangles=750_000, texture_bytes=700 << 20, objects=200)


class LevelChoice(NamedTuple):
    """Levels of detail chosen for a budget.

    Attributes:
        mesh_levels: Level of each mesh.
        texture_levels: Level of each texture.
        hidden: Ids of visuals to leave out, the smallest ones.
        triangles, texture_bytes, objects: Cost of the rest.
        fits: False when even the coarsest levels exceed the budget.
    """

    mesh_levels: tuple[int, ...]
    texture_levels: tuple[int, ...]
    hidden: frozenset[int]
    triangles: int
    texture_bytes: int
    objects: int
    fits: bool


def choose_levels(spec: SceneSpec, budget: Budget) -> LevelChoice:
    """Choose the finest levels that fit: meshes that lose least detail per triangle saved are coarsened first.

    Deformables have no levels and are never left out.
    """
    n_bending, bending_triangles = count_deformables(spec)
    drawn = [i for i, v in enumerate(spec.visuals) if v.rgba[3] > 0 and v.group in spec.groups_shown]
    hidden = _select_hidden(spec, drawn, max(1, budget.objects - n_bending) if budget.objects else 0)
    kept = [i for i in drawn if spec.visuals[i].id not in hidden]
    meshes, n_triangles = _choose_mesh_levels(spec, kept, budget.triangles, bending_triangles)
    textures, memory = _choose_texture_levels(spec, budget.texture_bytes)
    objects = len(kept) + n_bending
    spent = ((n_triangles, budget.triangles), (memory, budget.texture_bytes), (objects, budget.objects))
    fits = all(not limit or used <= limit for used, limit in spent)
    return LevelChoice(meshes, textures, hidden, n_triangles, memory, objects, fits)


def _select_hidden(spec: SceneSpec, drawn: list[int], objects: int) -> frozenset[int]:
    if not objects or len(drawn) <= objects:
        return frozenset()
    smallest = sorted(drawn, key=lambda i: _visual_size(spec, i))[: len(drawn) - objects]
    return frozenset(spec.visuals[i].id for i in smallest)


def _visual_size(spec: SceneSpec, visual: int) -> float:
    """Return the largest side of a visual [m]; planes count as infinitely large."""
    geometry = spec.visuals[visual].geometry
    if geometry.kind == GeometryKind.PLANE:
        return float("inf")
    if geometry.mesh >= 0:
        return _longest_side(spec.meshes[geometry.mesh])
    caps = geometry.size[0] if geometry.kind == GeometryKind.CAPSULE else 0.0
    return 2 * (max(geometry.size) + caps)


def _longest_side(mesh: Mesh) -> float:
    return max(high - low for low, high in zip(mesh.low, mesh.high, strict=True))


def _choose_mesh_levels(spec: SceneSpec, kept: list[int], limit: int, besides: int) -> tuple[tuple[int, ...], int]:
    """Return the level of each mesh, and the triangles drawn. `besides`: triangles of visuals without levels."""
    uses = Counter(spec.visuals[i].geometry.mesh for i in kept)
    costs = [[uses[m] * level.triangles for level in mesh.levels] for m, mesh in enumerate(spec.meshes)]
    shapes = sum(count_triangles(spec, i) for i in kept if spec.visuals[i].geometry.mesh < 0)
    losses = [
        [_relative_loss(mesh, level, uses[m]) for level in range(1, len(mesh.levels))]
        for m, mesh in enumerate(spec.meshes)
    ]
    return _coarsen(costs, losses, limit, besides + shapes)


def _choose_texture_levels(spec: SceneSpec, limit: int) -> tuple[tuple[int, ...], int]:
    costs = [[texture_memory_bytes(texture, level) for level in texture.levels] for texture in spec.textures]
    return _coarsen(costs, [[-float(size) for size in sizes[:-1]] for sizes in costs], limit, 0)


def _coarsen(
    costs: list[list[int]], losses: list[list[float]], limit: int, besides: int
) -> tuple[tuple[int, ...], int]:
    """Return the level of each thing, and the cost of all with `besides`: at most `limit` (0: none) if that can be.

    `costs`: of each thing by level. `losses`: of each step to a coarser level; the step that loses least comes first, 0
    is not taken.
    """
    levels = [0] * len(costs)
    total = besides + sum(cost[0] for cost in costs)
    queue = [(loss[0], k) for k, loss in enumerate(losses) if loss and loss[0]]
    heapq.heapify(queue)
    while limit and total > limit and queue:
        _, k = heapq.heappop(queue)
        total += costs[k][levels[k] + 1] - costs[k][levels[k]]
        levels[k] += 1
        if levels[k] < len(losses[k]) and (loss := losses[k][levels[k]]):
            heapq.heappush(queue, (loss, k))
    return tuple(levels), total


def _relative_loss(mesh: Mesh, level: int, uses: int) -> float:
    """Return the error relative to the size, per triangle that `level` saves; 0 when it saves none."""
    saved = uses * (mesh.levels[level - 1].triangles - mesh.levels[level].triangles)
    return (mesh.levels[level].max_error_m + 1e-9) / max(_longest_side(mesh), 1e-6) / saved if saved > 0 else 0.0


# --- costs ------------------------------------------------------------------------------------------------------------


def add_totals(spec: SceneSpec) -> SceneSpec:
    """Return `spec` with its `totals` computed."""
    level_bytes = {level.address: level.bytes for mesh in spec.meshes for level in mesh.levels[:1]}
    image_bytes = {level.address: level.bytes for texture in spec.textures for level in texture.levels[:1]}
    drawn = [i for i, v in enumerate(spec.visuals) if v.rgba[3] > 0 and v.group in spec.groups_shown]
    n_bending, bending_triangles = count_deformables(spec)
    totals = Totals(
        objects=len(drawn) + n_bending,
        triangles=sum(count_triangles(spec, i) for i in drawn) + bending_triangles,
        mesh_bytes=sum(level_bytes.values()),
        texture_bytes=sum(image_bytes.values()),
        texture_memory=sum(texture_memory_bytes(texture, texture.levels[0]) for texture in spec.textures),
        asset_bytes=sum(list_assets(spec).values()),
    )
    return msgspec.structs.replace(spec, totals=totals)


def count_deformables(spec: SceneSpec) -> tuple[int, int]:
    """Return the number of deformables drawn at first, and of their triangles; ropes are lines."""
    shown = [part for part in spec.deformables if part.rgba[3] > 0 and part.group in spec.groups_shown]
    return len(shown), sum(part.elements for part in shown if part.dim > 1)


def count_triangles(spec: SceneSpec, visual: int, level: int = 0) -> int:
    """Return the triangles of one visual, by its index in `spec.visuals`."""
    geometry = spec.visuals[visual].geometry
    if geometry.mesh >= 0:
        levels = spec.meshes[geometry.mesh].levels
        return levels[min(level, len(levels) - 1)].triangles
    if geometry.hfield >= 0:
        field = spec.hfields[geometry.hfield]
        return 2 * max(0, field.rows - 1) * max(0, field.columns - 1)
    return PRIMITIVE_TRIANGLES.get(geometry.kind, 0)


def texture_memory_bytes(texture: Texture, level: TextureLevel) -> int:
    """Return the bytes on a graphics card: four a pixel, and a third more for mipmaps."""
    faces = 1 if texture.kind == TextureKind.IMAGE else 6
    return level.width * level.height * 4 * faces * 4 // 3
