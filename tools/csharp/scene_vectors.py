"""Levels of detail, shapes and texture coordinates of the Python client, for the tests of the C# one.

A line is a kind and its values, with tabs between; bytes in hexadecimal, arrays of float32 as their bytes.

    levels  specification, triangles, texture bytes, objects of the budget, levels of meshes, levels of textures,
            hidden visuals (with commas), triangles, texture bytes, objects, fits (0 or 1)
    shape   Geometry, Material or empty, HeightField and elevation or empty, corners of triangles: position, normal and,
            with a material, texture coordinates
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cache
from random import Random
from typing import Any, Final

import msgspec
import numpy as np

from iris_session.protocol.common import Pose
from iris_session.protocol.names import AssetEncoding, GeometryKind, TextureKind
from iris_session.protocol.scene import (
    Body,
    Deformable,
    Geometry,
    HeightField,
    Material,
    Mesh,
    MeshLevel,
    SceneSpec,
    Texture,
    TextureLevel,
    TextureUse,
    Visual,
    encode_scene,
)
from iris_session.scene.budget import QUEST_3, Budget, choose_levels
from iris_session.scene.shapes import add_texture_coordinates, build_height_field, build_primitive

_REST: Final = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
_KINDS: Final = (
    GeometryKind.PLANE, GeometryKind.BOX, GeometryKind.SPHERE, GeometryKind.ELLIPSOID, GeometryKind.CYLINDER,
    GeometryKind.CAPSULE,
)  # fmt: skip
_SIZES: Final = ((0.1, 0.2, 0.3), (0.5, 0.5, 0.5), (2.0, 0.0, 0.4), (0.03, 0.03, 0.2))


@cache
def render_scene_vectors(count: int = 40) -> str:
    """Return the lines. `count`: scenes."""
    random = Random(34)
    lines = [_describe_levels(random, make_scene(random)) for _ in range(count)]
    lines += _iterate_shapes()
    return "".join("\t".join(line) + "\n" for line in lines)


def make_scene(random: Random, visuals: int = 40) -> SceneSpec:
    """Return a scene of random things."""
    bodies = [Body(0, "world", -1, _REST, _REST, False)]
    bodies += [
        Body(n, f"body {n}", random.randrange(n), _REST, _make_pose(random), random.random() < 0.7) for n in range(1, 9)
    ]
    meshes, textures = [_make_mesh(random) for _ in range(8)], [_make_texture(random) for _ in range(5)]
    materials = [_make_material(random, len(textures)) for _ in range(6)]
    shown = tuple(_make_visual(random, n, len(meshes), len(materials)) for n in range(visuals))
    deformables = tuple(
        Deformable(f"cloth {n}", random.choice((1, 2, 3)), random.choice((0, 4)), 100, random.randrange(5_000), 0.01,
                   False, random.randrange(-1, 6), (1.0, 1.0, 1.0, 1.0), f"cloth{n}", _make_address(random), 1_000)
        for n in range(random.randrange(3))
    )  # fmt: skip
    return SceneSpec(
        bodies=tuple(bodies), visuals=shown, materials=tuple(materials), textures=tuple(textures),
        meshes=tuple(meshes), deformables=deformables,
    )  # fmt: skip


def _make_address(random: Random) -> str:
    return random.randbytes(32).hex()


def _make_pose(random: Random) -> Pose:
    w, x, y, z = (random.gauss(0.0, 1.0) for _ in range(4))
    n = math.hypot(w, x, y, z)
    return Pose(tuple(random.uniform(-2.0, 2.0) for _ in range(3)), (w / n, x / n, y / n, z / n))  # type: ignore[arg-type]


def _make_mesh(random: Random) -> Mesh:
    low = [random.uniform(-1.0, 0.0) for _ in range(3)]
    triangles, error = random.randrange(100, 300_000), 0.0
    levels = []
    for _ in range(random.choice((1, 2, 4))):
        levels.append(MeshLevel(_make_address(random), 99, AssetEncoding.ARRAYS, triangles, triangles, error))
        triangles = int(triangles * random.choice((0.5, 0.25, 1.0)))
        error += random.uniform(0.0, 0.01)
    low_corner, high = (low[0], low[1], low[2]), (random.random(), random.random(), random.random())
    return Mesh("mesh", low_corner, high, random.random() < 0.5, tuple(levels))


def _make_texture(random: Random) -> Texture:
    side, kind = random.choice((64, 1000, 4096)), random.choice((TextureKind.IMAGE, TextureKind.CUBE))
    levels = []
    for k in range(random.choice((1, 3, 5))):
        encoding = random.choice((AssetEncoding.PNG, AssetEncoding.ARRAYS, AssetEncoding.OPAQUE))
        levels.append(TextureLevel(_make_address(random), 99, encoding, side >> k, side >> k))
    return Texture("texture", kind, side, side, random.choice((3, 4)), "srgb", tuple(levels))


def _make_material(random: Random, textures: int) -> Material:
    uses = (TextureUse(random.choice(("rgb", "normal")), random.randrange(textures)),)
    return Material("", (1.0, 1.0, 1.0, 1.0), textures=uses if random.random() < 0.5 else ())


def _make_visual(random: Random, number: int, meshes: int, materials: int) -> Visual:
    kind = random.choice((GeometryKind.MESH, GeometryKind.MESH, *_KINDS))
    mesh = random.randrange(meshes) if kind == GeometryKind.MESH else -1
    geometry = Geometry(kind, random.choice(_SIZES), mesh)
    rgba = random.choice(((1.0, 0.0, 0.0, 1.0), (0.0, 1.0, 0.0, 0.5), (0.0, 0.0, 1.0, 0.0), (1.0, 1.0, 1.0, 1.0)))
    group, material = random.choice((0, 1, 2, 3)), random.randrange(-1, materials)
    return Visual(number, random.randrange(9), f"visual {number}", _make_pose(random), group, geometry, material, rgba)


def _describe_levels(random: Random, spec: SceneSpec) -> tuple[str, ...]:
    budget = random.choice(
        (
            QUEST_3,
            Budget(random.randrange(1, 3_000_000), random.randrange(1, 1 << 28), random.randrange(1, 40)),
            Budget(),
        )
    )
    choice = choose_levels(spec, budget)
    return (
        "levels", encode_scene(spec).hex(), str(budget.triangles), str(budget.texture_bytes), str(budget.objects),
        _join(choice.mesh_levels), _join(choice.texture_levels), _join(sorted(choice.hidden)), str(choice.triangles),
        str(choice.texture_bytes), str(choice.objects), str(int(choice.fits)),
    )  # fmt: skip


def _join(values: Sequence[int]) -> str:
    return ",".join(map(str, values))


def _iterate_shapes() -> Iterator[tuple[str, ...]]:
    materials = [None, Material("", (1.0,) * 4, repeat=(2.0, 3.0)), Material("", (1.0,) * 4, uniform=True)]
    rng = np.random.default_rng(34)
    elevation = rng.random((5, 4), np.float32)
    field = HeightField("", 5, 4, (1.0, 2.0, 0.5, 0.1), "0" * 64, 0)
    for material in materials:
        for kind in _KINDS:
            for size in _SIZES[:1] if kind != GeometryKind.PLANE else _SIZES:
                geometry = Geometry(kind, size)
                mesh = build_primitive(geometry)
                assert mesh is not None
                yield _describe_shape(geometry, material, mesh, None)
        geometry = Geometry(GeometryKind.HFIELD, field.size[:3], hfield=0)
        yield _describe_shape(geometry, material, build_height_field(field, elevation), (field, elevation))


def _describe_shape(geometry: Geometry, material: Material | None, mesh: Any, field: Any) -> tuple[str, ...]:
    if material is not None:
        mesh = add_texture_coordinates(mesh, geometry, material)
    columns = [mesh.position[mesh.index], mesh.normal[mesh.index]]
    if material is not None:
        columns.append(mesh.uv[mesh.index])
    corners = np.concatenate(columns, axis=-1).astype("<f4").tobytes().hex()
    encoded = "" if material is None else msgspec.msgpack.encode(material).hex()
    more = (
        ("", "") if field is None else (msgspec.msgpack.encode(field[0]).hex(), field[1].astype("<f4").tobytes().hex())
    )
    return "shape", msgspec.msgpack.encode(geometry).hex(), encoded, *more, corners
