"""Golden vectors of the scene: every struct, whole specifications, patches with their results, and invalid bytes.

Written to docs/protocol/scene.json. Values are written as in golden.json. Addresses are the SHA-256 of the bytes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Final

import msgspec

from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.names import (
    SCENE_VERSION,
    AssetEncoding,
    ColorSpace,
    Follow,
    GeometryKind,
    LightKind,
    TextureKind,
    TextureRole,
)
from iris_session.protocol.scene import (
    AddMaterial,
    AddMesh,
    AddVisual,
    Body,
    Camera,
    Deformable,
    Environment,
    Geometry,
    Headlight,
    HeightField,
    Light,
    Material,
    Mesh,
    MeshLevel,
    PatchOp,
    RemoveVisual,
    SceneSpec,
    SetVisual,
    Site,
    Tendon,
    Texture,
    TextureLevel,
    TextureUse,
    Totals,
    Vec2,
    Visual,
    apply_patch,
    check_scene,
    encode_scene,
)
from tools.codegen.examples import iterate_examples, make_address
from tools.codegen.schema import GROUPS
from tools.codegen.vectors import render_vectors

_pack = msgspec.msgpack.encode
_HALF: Final = math.sqrt(0.5)
_UP: Final = Pose((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
_TURNED: Final = Pose((0.1, -0.2, 0.3), (_HALF, 0.0, 0.0, _HALF))
_RED: Final = (1.0, 0.0, 0.0, 1.0)
_GREY: Final = (0.5, 0.5, 0.5, 1.0)


def render_scene_golden() -> str:
    """Return the text of scene.json."""
    content = {
        "scene_version": SCENE_VERSION,
        "structs": list(_iterate_structs()),
        "scenes": list(_iterate_scenes()),
        "patches": list(_iterate_patches()),
        "malformed": list(_iterate_malformed()),
    }
    return render_vectors(content)


def _iterate_structs() -> Iterator[dict[str, Any]]:
    """Yield every struct by itself; their references have no target."""
    for group in ("scene", "arrays", "patch"):
        for kind in GROUPS[group]:
            nested = kind in (SceneSpec, AddMesh, AddMaterial, AddVisual)  # their parts have extremes of their own
            for name, value in iterate_examples(kind, ("full", "least") if nested else ("full", "least", "extreme")):
                row = {"name": f"{kind.__name__}/{name}", "type": kind.__name__, "hex": _pack(value).hex()}
                yield {**row, "value": msgspec.to_builtins(value)}


def _iterate_scenes() -> Iterator[dict[str, Any]]:
    """Yield whole specifications. `canonical`: the encoder of this version makes these bytes of the value."""
    for name, spec in (("every kind of thing", make_full_scene()), ("nothing", SceneSpec())):
        yield _describe_scene(name, encode_scene(spec), spec, canonical=True)
    body = {"id": 0, "name": "", "parent": -1, "T_parent_body": _P, "T_world_body": _P, "moving": False, "mass": 1}
    grown = {"weather": {"rain": [1, 2.5, None]}, "bodies": [body], "lights": [_LIGHT], "groups_shown": [0]}
    light = Light("", "laser", 0, (0.0, 0.0, 2.0), (0.0, 0.0, -1.0), *((1.0, 1.0, 1.0),) * 3, range=5.0)
    spec = SceneSpec(bodies=(Body(0, "", -1, IDENTITY, IDENTITY, False),), lights=(light,), groups_shown=(0,))
    yield _describe_scene("another encoder: fields left out and unknown, integers for floats", _pack(grown), spec)


_P: Final = [[0, 0, 0], [1, 0, 0, 0]]
_LIGHT: Final = {
    "range": 5,
    "kind": "laser",  # a value that no version of this enumeration has
    "name": "",
    "body": 0,
    "p_body": [0, 0, 2],
    "direction_body": [0, 0, -1.0],
    "ambient": [1, 1, 1],
    "diffuse": [1.0, 1, 1],
    "specular": [1, 1, 1.0],
}


def _describe_scene(name: str, data: bytes, spec: SceneSpec, canonical: bool = False) -> dict[str, Any]:
    row = {"name": name, "canonical": canonical, "address": make_address(data), "hex": data.hex()}
    return {**row, "value": msgspec.to_builtins(spec)}


def _iterate_patches() -> Iterator[dict[str, Any]]:
    """Yield operations on the scene `before`, and the address of the specification after them."""
    before = make_full_scene()
    decoration = Visual(90, 0, "arrow", _UP, 0, Geometry(GeometryKind.MESH, (0.1, 0.1, 0.1), mesh=1), 2, _RED)
    cases: dict[str, tuple[PatchOp, ...]] = {
        "nothing": (),
        "every operation": (
            SetVisual(1, rgba=_RED, group=3, material=-1, T_body_visual=_TURNED),
            AddMesh(Mesh("arrow", (-0.1, -0.1, 0.0), (0.1, 0.1, 0.5), False, (_make_mesh_level("arrow", 12),))),
            AddMaterial(Material("gold", (1.0, 0.8, 0.0, 1.0), reflectance=0.25)),
            AddVisual(decoration),
            RemoveVisual(2),
        ),
        "a visual that comes and goes": (
            AddVisual(Visual(90, 0, "", _UP, 0, _make_box(), -1, _RED)),
            SetVisual(90, group=1),
            RemoveVisual(90),
        ),
    }
    for name, ops in cases.items():
        after = make_address(encode_scene(apply_patch(before, ops)))
        row = {"name": name, "before": "every kind of thing", "after": after, "hex": _pack(ops).hex()}
        yield {**row, "value": msgspec.to_builtins(ops)}


def _iterate_malformed() -> Iterator[dict[str, Any]]:
    """Yield bytes that a reader must reject. `checked`: types and bounds are right, but the content is not."""
    whole = make_full_scene()
    small = msgspec.structs.replace(
        whole, visuals=whole.visuals[-1:], materials=whole.materials[:1], textures=(), lights=(), deformables=(),
        environment=Environment(),
    )  # fmt: skip
    check_scene(small)
    good, plain = encode_scene(small), msgspec.to_builtins(small)

    def changed(where: str, index: int, **fields: Any) -> bytes:
        things = list(plain[where])
        things[index] = {**things[index], **fields}
        return _pack({**plain, where: things})

    cases = {
        "empty": b"",
        "truncated": good[:-1],
        "trailing byte": good + b"\x00",
        "not a map": _pack([1]),
        "version 2": _pack({**plain, "version": 2}),
        "a field is missing": _pack({"bodies": [{"id": 0}]}),
        "an address of 63 digits": changed("hfields", 0, address="0" * 63),
        "an address in capitals": changed("hfields", 0, address="A" * 64),
        "a reference below -1": changed("visuals", 0, material=-2),
        "a material that is not there": changed("visuals", 0, material=1),
        "a body that is not there": changed("cameras", 0, body=77),
        "a target that is not there": changed("cameras", 0, target=77),
        "two bodies of one id": changed("bodies", 1, id=0),
        "two visuals of one id": _pack({**plain, "visuals": 2 * plain["visuals"]}),
        "a child before its parent": changed("bodies", 1, parent=2),
        "a tendon through a site that is not there": changed("tendons", 0, sites=[0, 77]),
        "a mesh without a level": changed("meshes", 0, levels=[]),
        "a name of 65 characters": changed(
            "visuals", 0, geometry={**plain["visuals"][0]["geometry"], "kind": "x" * 65}
        ),
        "33 levels of detail": changed("meshes", 0, levels=33 * plain["meshes"][0]["levels"][:1]),
        "a group beyond int32": changed("visuals", 0, group=2**31),
        "array longer than the message": b"\x81\xa6bodies\xdd\xff\xff\xff\xff",
    }
    for name, data in cases.items():
        yield {"name": name, "checked": name in _CHECKED, "hex": data.hex()}


_CHECKED: Final = {
    "version 2",
    "a material that is not there",
    "a body that is not there",
    "a target that is not there",
    "two bodies of one id",
    "two visuals of one id",
    "a child before its parent",
    "a tendon through a site that is not there",
    "a mesh without a level",
}


def _make_mesh_level(what: str, triangles: int, max_error_m: float = 0.0) -> MeshLevel:
    return MeshLevel(make_address(what.encode()), 1_000, AssetEncoding.ARRAYS, 3 * triangles, triangles, max_error_m)


def _make_texture(name: str, kind: str, side: int, encoding: str, colorspace: str = ColorSpace.AUTO) -> Texture:
    sizes = (side, side // 2)
    levels = tuple(
        TextureLevel(make_address(f"{name}{size}".encode()), 500, encoding, size, size, index)
        for index, size in enumerate(sizes)
    )
    return Texture(name, kind, side, side, 3, colorspace, levels)


def _make_box() -> Geometry:
    return Geometry(GeometryKind.BOX, (0.1, 0.2, 0.3))


def make_full_scene() -> SceneSpec:
    """Return a consistent scene with every kind of element; the content of its assets is left open."""
    textures = (
        _make_texture("wood", TextureKind.IMAGE, 64, AssetEncoding.PNG, ColorSpace.SRGB),
        _make_texture("marble", TextureKind.CUBE, 32, AssetEncoding.ARRAYS),
        _make_texture("sky", TextureKind.SKYBOX, 128, AssetEncoding.JPEG, ColorSpace.LINEAR),
        _make_texture("packed", TextureKind.IMAGE, 16, AssetEncoding.OPAQUE),
    )
    uses = tuple(TextureUse(role, index % 2) for index, role in enumerate(_ROLES))
    materials = (
        Material("plain", _GREY),
        Material("rich", _GREY, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, uses, (2.0, 3.0), True),
    )
    levels = (_make_mesh_level("hammer", 1_000), _make_mesh_level("hammer, coarse", 250, 0.002))
    bodies = (
        Body(0, "world", -1, IDENTITY, IDENTITY, False),
        Body(2, "arm", 0, _UP, _UP, True),
        Body(5, "", 2, _TURNED, Pose((0.1, -0.2, 1.3), _TURNED.q), True),
    )
    return SceneSpec(
        name="every kind of thing",
        source="golden vectors",
        bodies=bodies,
        visuals=tuple(_iterate_visuals()),
        materials=materials,
        textures=textures,
        meshes=(Mesh("hammer", (-0.1, -0.1, -0.2), (0.1, 0.1, 0.2), True, levels),),
        hfields=(HeightField("hills", 20, 30, (2.0, 3.0, 0.5, 0.1), make_address(b"hills"), 2_000),),
        lights=tuple(_iterate_lights()),
        cameras=tuple(_iterate_cameras()),
        sites=(
            Site(0, 2, "tip", _UP, 4, Geometry(GeometryKind.SPHERE, (0.01, 0.01, 0.01)), 0, _RED),
            Site(1, 5, "", _TURNED, 4, _make_box(), -1, _GREY),
        ),
        tendons=(Tendon("rope", 0, 0.003, (0, 1), 0, _RED),),
        deformables=tuple(
            Deformable(f"dim{dim}", dim, 0, 100, 180, 0.005, dim == 3, 1, _GREY, f"deform-{dim}", address, 4_000)
            for dim, address in ((n, make_address(f"dim{n}".encode())) for n in (1, 2, 3))
        ),
        environment=Environment(Headlight(False, (0.2, 0.2, 0.2)), 2, _RED, 0.4, _GREY, 5.0, 9.0, 0.02, 60.0, 2.5),
        groups_shown=(0, 2),
        totals=Totals(9, 12_345, 1_250, 3_000, 70_000, 22_000),
    )


#: One after the other, as a material lists them.
_ROLES: Final = (TextureRole.RGB, TextureRole.NORMAL, TextureRole.ORM, TextureRole.EMISSIVE)


def _iterate_visuals() -> Iterator[Visual]:
    """Return one visual of every geometry, and one of a kind that a later version may have."""
    kinds = [value for key, value in vars(GeometryKind).items() if key.isupper() and isinstance(value, str)]
    for number, kind in enumerate([*kinds, "torus"]):
        mesh = 0 if kind in (GeometryKind.MESH, GeometryKind.SDF) else -1
        hfield = 0 if kind == GeometryKind.HFIELD else -1
        geometry = Geometry(kind, (0.1, 0.2, 0.3), mesh, hfield)
        yield Visual(number, (0, 2, 5)[number % 3], kind, _TURNED, number % 4, geometry, number % 3 - 1, _GREY)


def _iterate_lights() -> Iterator[Light]:
    down, white = (0.0, 0.0, -1.0), (1.0, 1.0, 1.0)
    yield Light("", LightKind.DIRECTIONAL, 0, (0.0, 0.0, 0.0), down, white, white, white)
    attenuation, follow = (1.0, 0.1, 0.01), Follow.TARGET_BODY
    yield Light(
        "lamp", LightKind.SPOT, 2, (0.0, 0.0, 2.0), down, white, white, white, attenuation, 30.0, 5.0, 7.0, 800.0, 0.02,
        castshadow=False, active=False, follow=follow, target=5,
    )  # fmt: skip
    yield Light("", LightKind.POINT, 0, (1.0, 0.0, 2.0), down, white, white, white, intensity=400.0)
    yield Light("", LightKind.IMAGE, 0, (0.0, 0.0, 0.0), down, white, white, white, texture=2)


def _iterate_cameras() -> Iterator[Camera]:
    focal: Vec2 = (600.0, 605.0)
    yield Camera("over", 0, _UP, 45.0)
    yield Camera("map", 0, _UP, 3.5, orthographic=True)
    yield Camera("wrist", 5, _TURNED, 58.0, False, focal, (1.5, -2.5), (640, 480), Follow.TRACK_COM, 2)
