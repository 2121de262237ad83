"""Report on a scene: its content, its heavy assets, and the limits of a headset that it exceeds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.assets.store import AssetStore
from iris_session.protocol.common import Vec3
from iris_session.protocol.names import ArrayKind, AssetEncoding, GeometryKind, LightKind
from iris_session.protocol.scene import Body, Geometry, SceneSpec, Totals, Visual
from iris_session.scene.arrays import decode_arrays
from iris_session.scene.budget import QUEST_3, LevelChoice, choose_levels, count_triangles, texture_memory_bytes
from iris_session.scene.cube_maps import CUBE_SIDE, find_cube_texture
from iris_session.scene.meshes import decode_mesh
from iris_session.scene.nodes import to_matrix, to_vec3
from iris_session.scene.shapes import ENDLESS

#: Number of heavy assets that are listed.
HEAVIEST: Final = 8
#: Triangles above which a mesh should be simplified before it is shared: a third of the limit of a Quest 3.
LARGE_MESH: Final = 250_000
_MIB: Final = 1 << 20
#: Larger than any part or robot and most rooms [m]; a part of a centimetre with a file in millimetres is larger.
_LARGEST_M: Final = 10.0
#: Too small to be seen or grasped [m]; a part of two metres that was divided by 1,000 once too often is smaller.
_SMALLEST_M: Final = 0.002
#: Correction of the meshes of a model that are too large or too small.
_MODEL_SCALE_ADVICE: Final = 'scale="{factor} {factor} {factor}" at its <mesh>, times the one that it has,'
Points = NDArray[Any]


class HeavyAsset(msgspec.Struct, frozen=True):
    """Mesh or texture with a high cost. `uses`: number of visuals that draw it. `why`: reason, as text."""

    kind: str
    name: str
    uses: int
    bytes: int
    triangles: int
    memory: int
    levels: int
    why: str


class SceneReport(msgspec.Struct, frozen=True):
    """Report on a scene.

    `extent`: of the initial content. `struggles`: limits of a Quest 3 that it exceeds, as text; empty when none.
    `for_headset`: result of the levels of detail (triangles, texture bytes, objects drawn, visuals left out).
    `skipped`: content that clients do not get. `simplified`: content that images of recordings and GLB files show
    differently.
    """

    scene_hash: str
    totals: Totals
    extent: Extent | None
    bodies: int
    moving: int
    kinds: dict[str, int]
    heavy: tuple[HeavyAsset, ...]
    struggles: tuple[str, ...]
    for_headset: dict[str, int]
    skipped: tuple[str, ...]
    simplified: tuple[str, ...]


def build_report(
    spec: SceneSpec, scene_hash: str, skipped: tuple[str, ...] = (), extent: Extent | None = None
) -> SceneReport:
    """Return the report of a scene."""
    choice = choose_levels(spec, QUEST_3)
    heavy = sorted(
        (*_heavy_meshes(spec), *_heavy_textures(spec)), key=lambda h: -(h.memory + 40 * h.triangles * h.uses)
    )
    return SceneReport(
        scene_hash=scene_hash,
        totals=spec.totals,
        extent=extent,
        bodies=len(spec.bodies) - 1,
        moving=sum(body.moving for body in spec.bodies),
        kinds=dict(Counter(visual.geometry.kind for visual in spec.visuals if visual.rgba[3] > 0)),
        heavy=tuple(heavy[:HEAVIEST]),
        struggles=tuple(_list_struggles(spec, choice)),
        for_headset={
            "triangles": choice.triangles,
            "texture_bytes": choice.texture_bytes,
            "objects": choice.objects,
            "hidden": len(choice.hidden),
        },
        skipped=skipped,
        simplified=list_simplified(spec),
    )


def list_large_meshes(spec: SceneSpec) -> tuple[str, ...]:
    """Return advice on meshes that should be simplified before they are shared; a line each."""
    return tuple(
        f"mesh {mesh.name} has {mesh.levels[0].triangles:,} triangles: over {LARGE_MESH:,}, simplify it in a program "
        "for meshes (Blender: Decimate), or it takes long to prepare and to fetch"
        for mesh in spec.meshes
        if mesh.levels and mesh.levels[0].triangles > LARGE_MESH
    )


def list_simplified(spec: SceneSpec) -> tuple[str, ...]:
    """Return content that recordings and GLB files draw differently from clients, or not; a line each."""
    found = []
    if spec.environment.skybox >= 0:
        found.append("the skybox: neither has a form for it, nothing is drawn around the scene")
    if any(light.kind == LightKind.IMAGE for light in spec.lights):
        found.append("lights from all around (kind image): they do not shine")
    return tuple(found)


def list_glb_differences(spec: SceneSpec) -> tuple[str, ...]:
    """Return content that a GLB file of the scene lacks or has differently; a line each."""
    opaque = sum(texture.levels[0].encoding == AssetEncoding.OPAQUE for texture in spec.textures)
    found = [f"{opaque} textures in a form of their own (KTX): left out"] if opaque else []
    worn = {find_cube_texture(spec, k) for k in range(len(spec.materials))} - {-1}
    fine = sum(spec.textures[k].width > CUBE_SIDE for k in worn)
    if fine:
        found.append(f"{fine} cube textures of more than {CUBE_SIDE} pixels a face: they are there in a smaller size")
    if any(part.dim == 1 for part in spec.deformables):
        found.append("ropes: lines without thickness")
    if any(v.geometry.kind == GeometryKind.PLANE and 0.0 in v.geometry.size[:2] for v in spec.visuals):
        found.append(f"planes without end: they end after {2 * ENDLESS:.0f} m")
    return (*list_simplified(spec), *found)


def format_tree(spec: SceneSpec) -> Iterator[str]:
    """Yield one line per body, indented by depth, with the visuals that it has."""
    children: dict[int, list[Body]] = {}
    for body in spec.bodies:
        children.setdefault(body.parent, []).append(body)
    drawn: dict[int, list[int]] = {}
    for index, visual in enumerate(spec.visuals):
        drawn.setdefault(visual.body, []).append(index)
    stack = [(body, 0) for body in reversed(children.get(-1, []))]
    while stack:
        body, depth = stack.pop()
        shapes = drawn.get(body.id, [])
        kinds = Counter(spec.visuals[i].geometry.kind for i in shapes if spec.visuals[i].rgba[3] > 0)
        what = ", ".join(f"{n} {kind}" if n > 1 else kind for kind, n in kinds.items()) or "-"
        count = sum(count_triangles(spec, i) for i in shapes if spec.visuals[i].rgba[3] > 0)
        name = body.name or f"(body {body.id})"
        mark = "" if body.moving or not body.id else "  static"
        yield f"{'  ' * depth}{name}: {what}{f', {count:,} triangles' if count else ''}{mark}"
        stack += [(child, depth + 1) for child in reversed(children.get(body.id, []))]


def _heavy_meshes(spec: SceneSpec) -> Iterator[HeavyAsset]:
    uses = Counter(visual.geometry.mesh for visual in spec.visuals if visual.rgba[3] > 0)
    for i, mesh in enumerate(spec.meshes):
        level = mesh.levels[0]
        why = f"{level.triangles:,} triangles"
        if uses[i] != 1:
            why += f", drawn {uses[i]} times"
        if len(mesh.levels) == 1 and level.triangles > 5_000:
            why += ", no coarser level: it has texture coordinates or colours, or it would save little"
        yield HeavyAsset(
            "mesh", mesh.name or f"mesh {i}", uses[i], level.bytes, level.triangles, 0, len(mesh.levels), why
        )


def _heavy_textures(spec: SceneSpec) -> Iterator[HeavyAsset]:
    uses: Counter[int] = Counter()
    for visual in spec.visuals:
        if visual.material >= 0:
            uses.update(use.texture for use in spec.materials[visual.material].textures)
    uses.update(texture for texture in (spec.environment.skybox, *(light.texture for light in spec.lights)))
    for i, texture in enumerate(spec.textures):
        level, memory = texture.levels[0], texture_memory_bytes(texture, texture.levels[0])
        why = f"{level.width} x {level.height} {texture.kind}: {memory / _MIB:.1f} MiB on a graphics card"
        yield HeavyAsset(
            "texture", texture.name or f"texture {i}", uses[i], level.bytes, 0, memory, len(texture.levels), why
        )


def _list_struggles(spec: SceneSpec, choice: LevelChoice) -> Iterator[str]:
    totals = spec.totals
    yield from list_large_meshes(spec)
    if totals.objects > QUEST_3.objects:
        yield (
            f"{totals.objects} objects, about {QUEST_3.objects} is what a Quest 3 draws: join static shapes into one "
            "mesh, or hide collision shapes (groups 3 to 5)"
        )
    if totals.triangles > QUEST_3.triangles:
        yield (
            f"{totals.triangles:,} triangles, about {QUEST_3.triangles:,} is what a Quest 3 draws: coarser levels "
            f"bring it to {choice.triangles:,}"
        )
    if totals.texture_memory > QUEST_3.texture_bytes:
        yield (
            f"{totals.texture_memory / _MIB:.0f} MiB of textures, about {QUEST_3.texture_bytes / _MIB:.0f} is what a "
            f"Quest 3 holds: smaller levels bring it to {choice.texture_bytes / _MIB:.0f}"
        )


# --- extent: planes are not counted, a floor has any size -------------------------------------------------------------


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
    boxes: list[Points] = []  # lowest and highest corner of each
    T_world_body = {body.id: to_matrix(body.T_world_body) for body in spec.bodies}
    mesh, points = -1, np.empty((0, 3))
    for visual in sorted(visuals, key=lambda v: v.geometry.mesh):  # one mesh in memory at a time
        geometry = visual.geometry
        if geometry.kind == GeometryKind.PLANE:
            continue
        T = T_world_body[visual.body] @ to_matrix(visual.T_body_visual)
        if geometry.mesh >= 0 and geometry.mesh != mesh:
            mesh, points = geometry.mesh, np.asarray(points_of(geometry.mesh), np.float64)
        if geometry.mesh >= 0 or geometry.hfield >= 0:
            placed = points if geometry.mesh >= 0 else _field_corners(spec, geometry)
            boxes += _bounds(placed @ T[:3, :3].T + T[:3, 3])
        else:
            reach = _shape_reach(geometry, T[:3, :3])
            boxes += [T[:3, 3] - reach, T[:3, 3] + reach]
    for vertices in more:
        boxes += _bounds(np.asarray(vertices, np.float64))
    if not boxes:
        return None
    low, high = _bounds(np.array(boxes))
    return Extent(to_vec3(low), to_vec3(high), to_vec3(high - low))


def _bounds(points: Points) -> list[Points]:
    return [points.min(axis=0), points.max(axis=0)] if len(points) else []


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


def check_model_units(spec: SceneSpec) -> tuple[str, ...]:
    """Return a note if the meshes of a MuJoCo model do not seem to be in metres.

    Only the largest mesh is considered: poses are in metres, and a hall may be large.
    """
    hint = format_unit_hint(largest_mesh_side(spec), _MODEL_SCALE_ADVICE)
    return (f"the largest mesh is {hint}",) if hint else ()


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
