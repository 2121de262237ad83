"""Report on a scene: its content, its heavy assets, and the limits of a headset that it exceeds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Final

import msgspec

from iris_session.protocol.names import AssetEncoding, GeometryKind, LightKind
from iris_session.protocol.scene import Body, SceneSpec, Totals
from iris_session.scene.budget import QUEST_3, LevelChoice, choose_levels, count_triangles, texture_memory_bytes
from iris_session.scene.cube_maps import CUBE_SIDE, find_cube_texture
from iris_session.scene.extent import Extent
from iris_session.scene.shapes import ENDLESS

#: Number of heavy assets that are listed.
HEAVIEST: Final = 8
#: Triangles above which a mesh should be simplified before it is shared: a third of the limit of a Quest 3.
LARGE_MESH: Final = 250_000
_MIB: Final = 1 << 20


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
