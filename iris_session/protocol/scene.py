"""The scene specification, version 1: everything a client needs to draw a scene but the bytes of meshes and textures.

A specification is itself an asset: `encode_scene` gives its bytes, and the SHA-256 of these is the scene's hash. All
references are indices into the lists of the specification, -1 for none; bodies are referred to by `Body.id`. World
frame right-handed, Z up; metres and radians unless stated otherwise; colours are red, green, blue (and alpha) in
0..1, without colour management, as MuJoCo blends them. Names may be empty, and may repeat.

Patches (`PatchOp`) are visual changes of a scene in use. They concern drawing only: bodies, joints and collisions
change with another scene. A patch is applied whole or not at all; after it the scene has the hash of its new
specification.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Final

import msgspec

from iris_session.protocol.codec import Bytes, make_decoder
from iris_session.protocol.common import Count, Name, Pose, Text, Vec3
from iris_session.protocol.errors import IrisError
from iris_session.protocol.names import SCENE_VERSION, AssetEncoding, Follow, TextureRole

#: SHA-256 of the bytes of an asset, as 64 hex digits.
Address = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
#: Index into a list of the specification, or -1 for none.
Ref = Annotated[int, msgspec.Meta(ge=-1, le=2**31 - 1)]
#: A small number: of a group, of pixels.
Int32 = Annotated[int, msgspec.Meta(ge=-(2**31), le=2**31 - 1)]
#: Levels of detail of a mesh or texture: each halves the sides, so 32 are more than any image has.
MAX_LEVELS: Final = 32
Rgb = tuple[float, float, float]
Rgba = tuple[float, float, float, float]
Vec2 = tuple[float, float]


class TextureUse(msgspec.Struct, frozen=True):
    """A texture in one `TextureRole`."""

    role: Name
    texture: Ref


class Material(msgspec.Struct, frozen=True):
    """Surface appearance, in MuJoCo's terms. `specular`, `shininess` (times 128: exponent), `reflectance`: 0..1.

    `emission`: light of its own, times the colour. `metallic`, `roughness`: -1 where the scene does not set them. The
    texture's colour multiplies that of the visual. `repeat`: times that a 2d texture is laid over the shape, or over
    one metre when `uniform` (docs/scene.md, texture coordinates).
    """

    name: Text
    rgba: Rgba
    emission: float = 0.0
    specular: float = 0.5
    shininess: float = 0.5
    reflectance: float = 0.0
    metallic: float = -1.0
    roughness: float = -1.0
    textures: Annotated[tuple[TextureUse, ...], msgspec.Meta(max_length=16)] = ()
    repeat: Vec2 = (1.0, 1.0)
    uniform: bool = False

    def find_texture(self, *roles: str) -> int:
        """Return the texture in the first of `roles` that is there, -1 for none. Without roles: the colour."""
        for role in roles or (TextureRole.RGB, TextureRole.RGBA):
            for use in self.textures:
                if use.role == role:
                    return use.texture
        return -1


class TextureLevel(msgspec.Struct, frozen=True):
    """One size of a texture. `max_error`: largest difference of a channel to the exact pixels of this size, 0..255."""

    address: Address
    bytes: Count
    encoding: Name
    width: Count
    height: Count
    max_error: Int32 = 0


class Texture(msgspec.Struct, frozen=True):
    """An image. `height` of cube and skybox is that of one face; their assets hold six, one below the other, in the
    order right, left, up, down, front, back. Level 0 is the whole image, each further one has half its sides.
    """

    name: Text
    kind: Name
    width: Count
    height: Count
    channels: Count
    colorspace: Name
    levels: Annotated[tuple[TextureLevel, ...], msgspec.Meta(max_length=MAX_LEVELS)]


class MeshLevel(msgspec.Struct, frozen=True):
    """One level of detail. `max_error_m`: how far its points lie from the exact mesh at most [m], 0: exact. Parts of
    the exact mesh that are smaller than this may be missing.
    """

    address: Address
    bytes: Count
    encoding: Name
    vertices: Count
    triangles: Count
    max_error_m: float = 0.0


class Mesh(msgspec.Struct, frozen=True):
    """Triangles. Level 0 is exact, each further one coarser. `low`, `high`: the box around it in its frame [m]."""

    name: Text
    low: Vec3
    high: Vec3
    textured: bool
    levels: Annotated[tuple[MeshLevel, ...], msgspec.Meta(max_length=MAX_LEVELS)]


class HeightField(msgspec.Struct, frozen=True):
    """Elevations on a grid, rows along y, columns along x, in 0..1.

    `size` [m]: half length along x, along y, height of elevation 1, depth of the base below 0.
    """

    name: Text
    rows: Count
    columns: Count
    size: tuple[float, float, float, float]
    address: Address
    bytes: Count
    encoding: Name = AssetEncoding.ARRAYS


#: Largest specification in bytes that is read: some 100,000 visuals.
MAX_SCENE_BYTES: Final = 32_000_000
#: Most bodies of a specification, and most of everything else but visuals: small things that a few bytes describe.
MAX_BODIES: Final = 1 << 17
MAX_THINGS: Final = 1 << 16


class Body(msgspec.Struct, frozen=True):
    """One rigid body. `id`: that of `BodyInfo` in the state stream; 0 is the world, which is not streamed.

    `T_parent_body`: rest pose in the parent's frame. `T_world_body`: rest pose in the world, of the initial state. A
    body that is not `moving` stays there for good.
    """

    id: Count
    name: Text
    parent: Ref
    T_parent_body: Pose
    T_world_body: Pose
    moving: bool


class Geometry(msgspec.Struct, frozen=True):
    """A shape, centred in its own frame. `kind` of `GeometryKind`; draw unknown kinds as a box of `size`.

    `size` [m]: half lengths along x, y, z of the extent. plane: half lengths x, y, 0 is without end; its normal is +z,
    z is the spacing of grid lines. sphere: radius three times. capsule, cylinder: radius, radius, half length along z,
    of a capsule without its caps. hfield: half x, half y, height of elevation 1. mesh, sdf: the scale of generated
    texture coordinates (see docs/scene.md); the vertices are in metres as they are.
    """

    kind: Name
    size: Vec3
    mesh: Ref = -1
    hfield: Ref = -1


#: `Visual.id` of the site 0 of a MuJoCo model: above all geoms.
FIRST_SITE_VISUAL: Final = 1 << 20


class Visual(msgspec.Struct, frozen=True):
    """A shape on a body. `id`: the simulator's number of it (MuJoCo geom; of a site 1,048,576 more than its number).
    `rgba` is the colour to draw: a colour of its own, or the material's; with alpha 0 it is not drawn. `group`: see
    `SceneSpec.groups_shown`.
    """

    id: Count
    body: Count
    name: Text
    T_body_visual: Pose
    group: Int32
    geometry: Geometry
    material: Ref
    rgba: Rgba


class Light(msgspec.Struct, frozen=True):
    """A light on a body, shining along `direction`, a unit vector in the body's frame.

    `attenuation`: constant, linear [1/m], quadratic [1/m^2]. `cutoff`: half angle of a spot [deg], `exponent`: of the
    cosine within it. `intensity` [cd]: 0 where the scene does not say. `range` [m]: 0 for no end.
    """

    name: Text
    kind: Name
    body: Count
    p_body: Vec3
    direction_body: Vec3
    ambient: Rgb
    diffuse: Rgb
    specular: Rgb
    attenuation: Vec3 = (1.0, 0.0, 0.0)
    cutoff: float = 45.0
    exponent: float = 10.0
    range: float = 0.0
    intensity: float = 0.0
    bulb_radius: float = 0.0
    texture: Ref = -1
    castshadow: bool = True
    active: bool = True
    follow: Name = Follow.FIXED
    target: Ref = -1


class Camera(msgspec.Struct, frozen=True):
    """A camera on a body: looks along -z of its own frame, y is up.

    `fovy`: vertical field of view [deg], of an orthographic camera the height of what it sees [m]. `focal`,
    `principal`: in pixels, `principal` from the centre of the picture, x right, y up; 0 where only `fovy` counts.
    `resolution`: pixels, 1 x 1 where the scene does not say.
    """

    name: Text
    body: Count
    T_body_camera: Pose
    fovy: float
    orthographic: bool = False
    focal: Vec2 = (0.0, 0.0)
    principal: Vec2 = (0.0, 0.0)
    resolution: tuple[Int32, Int32] = (1, 1)
    follow: Name = Follow.FIXED
    target: Ref = -1


class Site(msgspec.Struct, frozen=True):
    """A place on a body that a tendon runs through, drawn as a shape. Marked places of a MuJoCo model are visuals."""

    id: Count
    body: Count
    name: Text
    T_body_site: Pose
    group: Int32
    geometry: Geometry
    material: Ref
    rgba: Rgba


class Tendon(msgspec.Struct, frozen=True):
    """A cable, drawn as straight pieces of radius `width` [m] through `sites`, ids. Tendons of a MuJoCo model, which go
    around shapes, are deformables.
    """

    name: Text
    group: Int32
    width: float
    sites: Annotated[tuple[Count, ...], msgspec.Meta(max_length=4096)]
    material: Ref
    rgba: Rgba


class Deformable(msgspec.Struct, frozen=True):
    """A mesh whose vertices move: ropes (`dim` 1), cloths (2), surfaces of soft bodies (3).

    The asset has the elements (edges for `dim` 1, triangles else), texture coordinates, and the vertices of the initial
    state, in the world. `stream`: of the media channel, whose frames hold the vertices in the same order. `radius` [m]:
    half the thickness. `flat`: one normal per triangle.
    """

    name: Text
    dim: Count
    group: Int32
    vertices: Count
    elements: Count
    radius: float
    flat: bool
    material: Ref
    rgba: Rgba
    stream: Name
    address: Address
    bytes: Count
    encoding: Name = AssetEncoding.ARRAYS


class Headlight(msgspec.Struct, frozen=True):
    """A light without shadow at the viewer's head that shines where it looks."""

    active: bool = True
    ambient: Rgb = (0.1, 0.1, 0.1)
    diffuse: Rgb = (0.4, 0.4, 0.4)
    specular: Rgb = (0.5, 0.5, 0.5)


class Environment(msgspec.Struct, frozen=True):
    """Surroundings of the scene. `skybox`: a texture. Lengths [m]. Haze blends the skybox's horizon, fog all."""

    headlight: Headlight = Headlight()
    skybox: Ref = -1
    haze_rgba: Rgba = (1.0, 1.0, 1.0, 1.0)
    haze: float = 0.3
    fog_rgba: Rgba = (0.0, 0.0, 0.0, 1.0)
    fog_start: float = 0.0
    fog_end: float = 0.0
    znear: float = 0.01
    zfar: float = 50.0
    extent: float = 1.0
    center: Vec3 = (0.0, 0.0, 0.0)


class Totals(msgspec.Struct, frozen=True):
    """Cost of the scene with everything exact: each asset once, triangles as often as they are drawn.

    `objects`, `triangles`: of the groups that are shown at first. `texture_memory`: bytes on a graphics card.
    """

    objects: Count = 0
    triangles: Count = 0
    mesh_bytes: Count = 0
    texture_bytes: Count = 0
    texture_memory: Count = 0
    asset_bytes: Count = 0


_SOME: Final = msgspec.Meta(max_length=MAX_THINGS)


class SceneSpec(msgspec.Struct, frozen=True):
    """A whole scene. `bodies`: parents before their children. `source`: its origin, for people.

    `groups_shown`: visuals, sites, tendons and deformables of other groups are hidden at first.
    """

    version: Count = SCENE_VERSION
    name: Text = ""
    source: Text = ""
    bodies: Annotated[tuple[Body, ...], msgspec.Meta(max_length=MAX_BODIES)] = ()
    visuals: tuple[Visual, ...] = ()
    materials: Annotated[tuple[Material, ...], _SOME] = ()
    textures: Annotated[tuple[Texture, ...], _SOME] = ()
    meshes: Annotated[tuple[Mesh, ...], _SOME] = ()
    hfields: Annotated[tuple[HeightField, ...], _SOME] = ()
    lights: Annotated[tuple[Light, ...], _SOME] = ()
    cameras: Annotated[tuple[Camera, ...], _SOME] = ()
    sites: Annotated[tuple[Site, ...], _SOME] = ()
    tendons: Annotated[tuple[Tendon, ...], _SOME] = ()
    deformables: Annotated[tuple[Deformable, ...], _SOME] = ()
    environment: Environment = Environment()
    groups_shown: Annotated[tuple[Int32, ...], msgspec.Meta(max_length=256)] = (0, 1, 2)
    totals: Totals = Totals()


class SceneError(IrisError, ValueError):
    """The bytes are not a scene specification that this package reads."""


_encoder: Final = msgspec.msgpack.Encoder()
_decode: Final = make_decoder(SceneSpec)


def encode_scene(spec: SceneSpec) -> bytes:
    """Return the bytes of the specification: an asset, whose address is the scene's hash.

    Raises `SceneError` for one above `MAX_SCENE_BYTES`, which no reader accepts.
    """
    data = _encoder.encode(spec)
    if len(data) > MAX_SCENE_BYTES:
        what = f"{len(spec.visuals)} visuals, {len(spec.bodies)} bodies"
        raise SceneError(f"a specification of {len(data)} bytes ({what}), at most {MAX_SCENE_BYTES} are read")
    return data


def decode_scene(data: Bytes) -> SceneSpec:
    """Decode and check a specification: every reference has its target. Raises `SceneError`."""
    if len(data) > MAX_SCENE_BYTES:
        raise SceneError(f"a scene specification of {len(data)} bytes, at most {MAX_SCENE_BYTES} are read")
    try:
        spec = _decode(data)
    except msgspec.DecodeError as error:
        raise SceneError(f"no scene specification: {error}") from None
    if spec.version != SCENE_VERSION:
        raise SceneError(f"scene specification version {spec.version}, this side reads {SCENE_VERSION}: update it")
    check_scene(spec)
    return spec


def list_assets(spec: SceneSpec) -> dict[str, int]:
    """Return every asset of a scene with its size in bytes, each once: those that show something early come first.

    Order: deformables, height fields and coarsest levels of meshes, of textures, then the finer levels.
    """
    found: dict[str, int] = {}
    found.update((entry.address, entry.bytes) for entry in spec.deformables)
    found.update((entry.address, entry.bytes) for entry in spec.hfields)
    ladders = [tuple((level.address, level.bytes) for level in mesh.levels) for mesh in spec.meshes]
    ladders += [tuple((level.address, level.bytes) for level in texture.levels) for texture in spec.textures]
    for depth in range(1, max(map(len, ladders), default=0) + 1):
        for ladder in ladders:
            if depth <= len(ladder):
                found.setdefault(*ladder[-depth])
    return found


def check_scene(spec: SceneSpec) -> None:
    """Raise `SceneError` unless every reference has its target, every id is unique, and no list is too long."""
    for kind, most in _MOST.items():
        if len(getattr(spec, kind)) > most:
            raise SceneError(f"{len(getattr(spec, kind))} {kind}, at most {most} are read")
    bodies, sites = _check_ids("bodies", spec.bodies), _check_ids("sites", spec.sites)
    _check_ids("visuals", spec.visuals)
    before = {-1}
    for body in spec.bodies:
        if body.parent not in before:  # so there is no cycle either
            raise SceneError(f"body {body.id} has the parent {body.parent}, which is not listed before it")
        before.add(body.id)
    _check_bodies("visual", spec.visuals, bodies)
    _check_bodies("site", spec.sites, bodies)
    _check_bodies("light", spec.lights, bodies)
    _check_bodies("camera", spec.cameras, bodies)
    watchers: tuple[Light | Camera, ...] = (*spec.lights, *spec.cameras)
    for watcher in watchers:
        if watcher.target not in bodies and watcher.target != -1:
            raise SceneError(f"{watcher.name!r} looks at body {watcher.target}: no such body")
    for geometry in (*(visual.geometry for visual in spec.visuals), *(site.geometry for site in spec.sites)):
        _check_reference("mesh", geometry.mesh, len(spec.meshes))
        _check_reference("height field", geometry.hfield, len(spec.hfields))
    for worn in (spec.visuals, spec.sites, spec.tendons, spec.deformables):
        for one in worn:
            _check_reference("material", one.material, len(spec.materials))
    for material in spec.materials:
        for use in material.textures:
            _check_reference("texture", use.texture, len(spec.textures))
    for light in spec.lights:
        _check_reference("texture", light.texture, len(spec.textures))
    _check_reference("texture", spec.environment.skybox, len(spec.textures))
    for tendon in spec.tendons:
        if not sites.issuperset(tendon.sites):
            raise SceneError(f"tendon {tendon.name!r} runs through a site that is not there")
    if not (all(mesh.levels for mesh in spec.meshes) and all(texture.levels for texture in spec.textures)):
        raise SceneError("a mesh or texture has no level")


#: Bounds from the types, for specifications that were made in memory and not decoded.
_MOST: Final = {
    "bodies": MAX_BODIES,
    **dict.fromkeys(("materials", "textures", "meshes", "hfields", "lights", "cameras"), MAX_THINGS),
    **dict.fromkeys(("sites", "tendons", "deformables"), MAX_THINGS),
}


def _check_ids(what: str, things: Sequence[Body | Site | Visual]) -> set[int]:
    found = {thing.id for thing in things}
    if len(found) != len(things):
        raise SceneError(f"two {what} have the same id")
    return found


def _check_bodies(what: str, things: Sequence[Visual | Site | Light | Camera], bodies: set[int]) -> None:
    for thing in things:
        if thing.body not in bodies:
            raise SceneError(f"{what} {thing.name!r} is on body {thing.body}: no such body")


def _check_reference(what: str, index: int, count: int) -> None:
    if index >= count:
        raise SceneError(f"reference to {what} {index}, but there are {count}")


# --- patches ---

#: Operations of one patch, and all that a scene may have had since it was loaded.
MAX_OPS: Final = 64
MAX_PATCHES: Final = 1024


class SetVisual(msgspec.Struct, frozen=True, tag_field="op", tag="set_visual"):
    """Change how a visual is drawn; fields that are null stay. `rgba` with alpha 0 hides it."""

    visual: Count
    rgba: Rgba | None = None
    group: Int32 | None = None
    material: Ref | None = None
    T_body_visual: Pose | None = None


class AddVisual(msgspec.Struct, frozen=True, tag_field="op", tag="add_visual"):
    """Add decoration to a body (0: the world). Its `id` must be free."""

    visual: Visual


class RemoveVisual(msgspec.Struct, frozen=True, tag_field="op", tag="remove_visual"):
    """Remove a visual."""

    visual: Count


class AddMesh(msgspec.Struct, frozen=True, tag_field="op", tag="add_mesh"):
    """Append a mesh to the list, for visuals that come after it."""

    mesh: Mesh


class AddMaterial(msgspec.Struct, frozen=True, tag_field="op", tag="add_material"):
    """Append a material to the list, for visuals that come after it."""

    material: Material


PatchOp = SetVisual | AddVisual | RemoveVisual | AddMesh | AddMaterial


def apply_patch(spec: SceneSpec, ops: Sequence[PatchOp]) -> SceneSpec:
    """Return the scene after a patch. Raises `SceneError` for an operation that does not fit; nothing is changed then.

    `totals` stay those of the scene as it was loaded.
    """
    if len(ops) > MAX_PATCHES:
        raise SceneError(f"{len(ops)} operations at once, at most {MAX_PATCHES}")
    visuals = {visual.id: visual for visual in spec.visuals}
    meshes, materials = list(spec.meshes), list(spec.materials)
    for op in ops:
        if isinstance(op, AddVisual):
            if op.visual.id in visuals:
                raise SceneError(f"there is a visual {op.visual.id} already: take an id that is free")
            visuals[op.visual.id] = op.visual
        elif isinstance(op, AddMesh):
            meshes.append(op.mesh)
        elif isinstance(op, AddMaterial):
            materials.append(op.material)
        elif op.visual not in visuals:
            raise SceneError(f"there is no visual {op.visual}")
        elif isinstance(op, SetVisual):
            visuals[op.visual] = _apply_set_visual(visuals[op.visual], op)
        else:
            del visuals[op.visual]
    after = msgspec.structs.replace(
        spec, visuals=tuple(visuals.values()), meshes=tuple(meshes), materials=tuple(materials)
    )
    check_scene(after)
    return after


def merge_patches(before: Iterable[PatchOp], ops: Iterable[PatchOp]) -> tuple[PatchOp, ...]:
    """Return one list of operations that has the effect of both, with as few operations per visual as possible."""
    found: list[PatchOp] = list(before)
    for op in ops:
        earlier = next((i for i in range(len(found) - 1, -1, -1) if _get_visual_id(found[i]) == _get_visual_id(op)), -1)
        old = found[earlier] if earlier >= 0 else None
        if isinstance(op, SetVisual) and isinstance(old, SetVisual):
            found[earlier] = msgspec.structs.replace(old, **_list_changes(op))
        elif isinstance(op, SetVisual) and isinstance(old, AddVisual):
            found[earlier] = AddVisual(_apply_set_visual(old.visual, op))
        elif isinstance(op, RemoveVisual) and isinstance(old, AddVisual):
            del found[earlier]  # what it refers to may serve others: lists keep their order
        elif isinstance(op, RemoveVisual) and isinstance(old, SetVisual):
            found[earlier] = op
        else:
            found.append(op)
    return tuple(found)


def _get_visual_id(op: PatchOp) -> int | None:
    """Return the id of the visual that an operation changes; an addition to a list counts as its own."""
    if isinstance(op, AddVisual):
        return op.visual.id
    return op.visual if isinstance(op, SetVisual | RemoveVisual) else None


def _list_changes(op: SetVisual) -> dict[str, object]:
    fields = ("rgba", "group", "material", "T_body_visual")
    return {name: getattr(op, name) for name in fields if getattr(op, name) is not None}


def _apply_set_visual(visual: Visual, op: SetVisual) -> Visual:
    return msgspec.structs.replace(visual, **_list_changes(op))
