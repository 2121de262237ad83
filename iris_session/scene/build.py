"""Assembly of scenes: the content that a `SceneBuilder` has collected (`SceneContent`), and `build_scene`, which
makes the specification.

Every body, mesh, texture and material gets a number; equal ones share it. Assets go to the store. The order of all
lists follows only from the order in which content was added.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from anchors.pose import compose, inverse
from iris_session.assets.store import AssetStore
from iris_session.protocol.common import IDENTITY, Pose, Vec3
from iris_session.protocol.names import GeometryKind, LightKind, TextureKind
from iris_session.protocol.scene import (
    Body,
    Camera,
    Deformable,
    Environment,
    Geometry,
    Headlight,
    Light,
    Material,
    Mesh,
    SceneError,
    SceneSpec,
    Texture,
    TextureUse,
    Visual,
    check_scene,
    encode_scene,
)
from iris_session.scene.asset_builder import AssetBuilder, EncodeOptions, MeshNote, Work
from iris_session.scene.budget import add_totals
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.importers.urdf import Robot
from iris_session.scene.meshes import MeshArrays, encode_deformable, scale_mesh
from iris_session.scene.nodes import (
    MAX_TRIANGLES,
    Appearance,
    DrawnItem,
    LoadedFile,
    Matrix,
    TextureImage,
    is_solid,
    orient,
    split_rigid,
    to_matrix,
    to_vec3,
)
from iris_session.scene.report import compute_box_extent, format_unit_hint, largest_mesh_side
from iris_session.scene.result import Articulation, ComposedScene, DeformableSource
from iris_session.streams.deformable_topology import DeformableTopology

#: Minimum viewing distance [m], and viewing distance in extents of the scene.
_FAR: Final = 50.0
_FAR_EXTENTS: Final = 10.0
#: Light of a scene that brings none: white is drawn between 0.3 and 1 of full brightness.
_DEFAULT_HEADLIGHT: Final = Headlight(True, (0.3,) * 3, (0.35,) * 3, (0.1,) * 3)
_DEFAULT_LIGHT: Final = Light(
    name="default",
    kind=LightKind.DIRECTIONAL,
    body=0,
    p_body=(0.0, 0.0, 3.0),
    direction_body=(0.36, 0.48, -0.8),
    ambient=(0.0,) * 3,
    diffuse=(0.35,) * 3,
    specular=(0.1,) * 3,
)
_FACES: Final = 6
_SCALE_ADVICE: Final = "scale={factor} of what it is now (--scale {factor})"
#: Maximum coordinate of a vertex in its own frame [m]. Larger ones are a mistake of units, and too large for float32.
MAX_COORDINATE_M: Final = 1e6


def build_scene(
    world: SceneContent, environment: Environment | None, store: AssetStore, options: EncodeOptions | None, threads: int
) -> ComposedScene:
    """Build the specification and its assets. Raises `SceneBuildError`."""
    builder = AssetBuilder(store, options, threads)
    ids, bodies = _build_bodies(world)
    placed = [split_rigid(item.matrix) for item in world.items]
    meshes, item_meshes = _build_meshes(world.items, [rest for _, rest in placed], builder)
    looks = [*(item.appearance for item in world.items), *(flexible.look for flexible in world.deformables)]
    textures, materials, item_materials, skybox = _build_materials(looks, world.skybox, builder)
    visuals = tuple(
        Visual(
            id=k,
            body=ids[item.body],
            name=item.name,
            T_body_visual=placed[k][0],
            group=0,
            geometry=_build_geometry(item, item_meshes[k], meshes),
            material=item_materials[k],
            rgba=item.appearance.rgba,
        )
        for k, item in enumerate(world.items)
    )
    deformables, sources = _build_deformables(world.deformables, item_materials[len(visuals) :], builder)
    spec = add_totals(
        SceneSpec(
            name=world.name,
            source="composed",
            bodies=bodies,
            visuals=visuals,
            materials=materials,
            textures=textures,
            meshes=meshes,
            lights=tuple(msgspec.structs.replace(light, body=ids[body]) for body, light in world.lights),
            cameras=tuple(msgspec.structs.replace(camera, body=ids[body]) for body, camera in world.cameras),
            deformables=deformables,
        )
    )
    surroundings = environment or _build_environment(spec, sources)
    if environment is None and not spec.lights and (spec.visuals or sources):
        surroundings = msgspec.structs.replace(surroundings, headlight=_DEFAULT_HEADLIGHT)
        spec = msgspec.structs.replace(spec, lights=(_DEFAULT_LIGHT,))
    if skybox >= 0:
        surroundings = msgspec.structs.replace(surroundings, skybox=skybox)
    spec = msgspec.structs.replace(spec, environment=surroundings)
    unit_hint = format_unit_hint(largest_mesh_side(spec), _SCALE_ADVICE)
    return ComposedScene(
        spec=spec,
        scene_hash=store.put(_encode_checked(spec)),
        moving=tuple(body.name for body in bodies if body.moving),
        poses=tuple(body.T_world_body for body in bodies if body.moving),
        articulations=dict(world.articulations),
        deformables={source.name: source for source in sources},
        skipped=tuple(world.skipped),
        notes=(f"the largest mesh is {unit_hint}",) if unit_hint else (),
        built=builder.built,
        recalled=builder.recalled,
    )


def _encode_checked(spec: SceneSpec) -> bytes:
    """Encode the specification. Raises `SceneBuildError` for one that clients could not read or draw."""
    try:
        check_scene(spec)
        encoded = encode_scene(spec)
    except SceneError as error:
        raise SceneBuildError(f"{error}: join what stands still into fewer meshes") from None
    except (ValueError, TypeError, OverflowError) as error:
        raise SceneBuildError(f"the scene has something that cannot be sent: {error}") from None
    try:  # by way of JSON, in which values that are not finite are no numbers
        msgspec.json.decode(msgspec.json.encode(spec), type=SceneSpec)
    except msgspec.ValidationError as error:
        raise SceneBuildError(f"the scene has something that cannot be drawn: {error}") from None
    return encoded


def _build_bodies(world: SceneContent) -> tuple[dict[int, int], tuple[Body, ...]]:
    """Return ids by index of the body (-1: the world), and the bodies, moving ones first."""
    order = sorted(range(len(world.bodies)), key=lambda k: not world.bodies[k].moving)
    ids = {-1: 0, **{place: number for number, place in enumerate(order, start=1)}}
    bodies = [Body(0, "world", -1, IDENTITY, IDENTITY, moving=False)]
    for place in order:
        thing = world.bodies[place]
        above = world.bodies[thing.parent].pose if thing.parent >= 0 else IDENTITY
        T_parent_body = thing.pose
        if thing.parent >= 0:
            T_parent_body = Pose(*compose(inverse((above.p, above.q)), (thing.pose.p, thing.pose.q)))
        bodies.append(Body(ids[place], thing.name, ids[thing.parent], T_parent_body, thing.pose, thing.moving))
    return ids, tuple(bodies)


# --- meshes -----------------------------------------------------------------------------------------------------------


def _build_meshes(
    items: Sequence[DrawnItem], rests: Sequence[Matrix | None], builder: AssetBuilder
) -> tuple[tuple[Mesh, ...], list[int]]:
    """Return the meshes, and the mesh of every item, -1 for a shape. Meshes that are equal to the bit are merged."""
    pieces: dict[tuple[object, ...], tuple[str, MeshArrays, Matrix | None]] = {}
    keys: list[tuple[object, ...] | None] = []
    for item, rest in zip(items, rests, strict=True):
        if item.mesh is None:
            keys.append(None)
            continue
        mapped = item.mesh.uv is not None and bool(item.appearance.images)
        key: tuple[object, ...] = (id(item.mesh), None if rest is None else rest.tobytes(), mapped)
        mesh = item.mesh if mapped else replace(item.mesh, uv=None)  # unused coordinates would prevent levels
        pieces.setdefault(key, (item.name, mesh, rest))
        keys.append(key)
    _check_copies(pieces.values())
    notes = builder.run([_mesh_work(builder, mesh, rest) for _, mesh, rest in pieces.values()])
    found: dict[str, int] = {}
    meshes: list[Mesh] = []
    places: dict[tuple[object, ...] | None, int] = {None: -1}
    for (key, (name, mesh, _)), note in zip(pieces.items(), notes, strict=True):
        address = note.levels[0].address
        if address not in found:
            found[address] = len(meshes)
            meshes.append(Mesh(name, note.low, note.high, mesh.uv is not None, note.levels))
        places[key] = found[address]
    return tuple(meshes), [places[key] for key in keys]


def _check_copies(pieces: Iterable[tuple[str, MeshArrays, Matrix | None]]) -> None:
    """Raise `SceneBuildError` for too many scaled copies of meshes.

    A scale is applied to the vertices, so each scale of a mesh is another mesh: a small file can request any number.
    """
    seen: set[int] = set()
    copied = 0
    for name, mesh, _ in pieces:
        places = id(mesh.position)  # a mesh and the same one without texture coordinates share it
        copied += mesh.triangles if places in seen else 0
        seen.add(places)
        if copied > MAX_TRIANGLES:
            raise SceneBuildError(
                f"{name!r} and others are drawn in so many scales that they have over {MAX_TRIANGLES:,} triangles: "
                "give what is alike one scale"
            )


def _mesh_work(builder: AssetBuilder, mesh: MeshArrays, rest: Matrix | None) -> Work[MeshNote]:
    marks = np.array([mesh.uv is not None, mesh.color is not None, rest is not None], np.uint8)
    given = (mesh.position, mesh.normal, mesh.index, mesh.uv, mesh.color, rest)
    raw: list[NDArray[Any]] = [marks, *(array for array in given if array is not None)]
    return builder.mesh_work(raw, lambda: _check_reach(scale_mesh(mesh, rest)))


def _check_reach(mesh: MeshArrays) -> MeshArrays:
    """Return `mesh`. Raises `SceneBuildError` for coordinates that cannot be drawn."""
    if not np.abs(mesh.position).max(initial=0.0) <= MAX_COORDINATE_M:  # also true for NaN
        raise SceneBuildError(
            f"a mesh reaches farther than {MAX_COORDINATE_M:,.0f} m from its origin: scale it to metres, or move it"
        )
    return mesh


def _build_geometry(item: DrawnItem, mesh: int, meshes: Sequence[Mesh]) -> Geometry:
    if mesh < 0:
        return Geometry(item.kind, item.size)
    low, high = meshes[mesh].low, meshes[mesh].high
    half: Vec3 = ((high[0] - low[0]) / 2, (high[1] - low[1]) / 2, (high[2] - low[2]) / 2)
    return Geometry(GeometryKind.MESH, half, mesh)


# --- materials --------------------------------------------------------------------------------------------------------


def _build_materials(
    looks: Sequence[Appearance], skybox: TextureImage | None, builder: AssetBuilder
) -> tuple[tuple[Texture, ...], tuple[Material, ...], list[int], int]:
    """Return textures, materials, the material of every appearance (-1: a colour only), and the texture of the
    skybox.
    """
    pictures: dict[int, TextureImage] = {id(picture): picture for look in looks for _, picture in look.images}
    if skybox is not None:
        pictures[id(skybox)] = skybox
    notes = builder.run([builder.texture_work(picture.pixels, picture.kind) for picture in pictures.values()])
    found: dict[tuple[str, str, str], int] = {}
    textures: list[Texture] = []
    places: dict[int, int] = {}
    for (key, picture), note in zip(pictures.items(), notes, strict=True):
        same = (note.levels[0].address, picture.kind, picture.colorspace)
        if same not in found:
            found[same] = len(textures)
            height, width, channels = picture.pixels.shape
            height //= 1 if picture.kind == TextureKind.IMAGE else _FACES
            textures.append(
                Texture(picture.name, picture.kind, width, height, channels, picture.colorspace, note.levels)
            )
        places[key] = found[same]
    materials: dict[Material, int] = {}
    worn = []
    for look in looks:
        uses = tuple(TextureUse(role, places[id(picture)]) for role, picture in look.images)
        worn.append(-1 if look.is_plain_color else materials.setdefault(_to_material(look, uses), len(materials)))
    return tuple(textures), tuple(materials), worn, -1 if skybox is None else places[id(skybox)]


def _to_material(look: Appearance, uses: tuple[TextureUse, ...]) -> Material:
    shared = {name: getattr(look, name) for name in Material.__struct_fields__ if hasattr(look, name)}
    return Material(**shared, textures=uses)


# --- deformables and environment --------------------------------------------------------------------------------------


def _build_deformables(
    flexibles: Sequence[ComposedDeformable], materials: Sequence[int], builder: AssetBuilder
) -> tuple[tuple[Deformable, ...], list[DeformableSource]]:
    sources, works = [], []
    for k, one in enumerate(flexibles):
        ends = {"edges": one.elements} if one.elements.shape[1] == 2 else {"faces": one.elements}
        try:
            topology = DeformableTopology(len(one.vertices), **ends).without_faces()
        except ValueError as error:
            raise SceneBuildError(f"deformable {one.name!r}: {error}") from None
        sources.append(DeformableSource(one.name, f"deformable-{k}", topology, one.vertices))
        uv = None if one.uv is None or one.elements.shape[1] == 2 else one.uv[one.elements]
        raw: list[bytes | NDArray[Any]] = [b"deformable", one.elements, one.vertices]
        encode = partial(encode_deformable, one.elements, uv, one.vertices, topology)
        works.append(builder.blob_work([*raw, *([] if uv is None else [uv])], encode))
    notes = builder.run(works)
    listed = tuple(
        Deformable(
            name=one.name,
            dim=one.elements.shape[1] - 1,
            group=0,
            vertices=len(one.vertices),
            elements=len(one.elements),
            radius=one.radius,
            flat=one.flat,
            material=material,
            rgba=one.look.rgba,
            stream=source.stream,
            address=note.address,
            bytes=note.bytes,
        )
        for one, material, source, note in zip(flexibles, materials, sources, notes, strict=True)
    )
    return listed, sources


def _build_environment(spec: SceneSpec, sources: Sequence[DeformableSource]) -> Environment:
    """Return an environment with centre and extent of the initial content without planes; all of it is within view."""
    box = compute_box_extent(spec, (source.vertices for source in sources))
    if box is None:
        return Environment()
    x, y, z = (0.5 * (low + high) for low, high in zip(box.low, box.high, strict=True))
    extent = max(0.1, math.hypot(*box.size) / 2)
    return Environment(zfar=max(_FAR, _FAR_EXTENTS * extent), extent=extent, center=(x, y, z))


# --- collected content ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ComposedBody:
    """A body of the scene. `parent`: index of an earlier body, -1 for the world. `pose`: initial T_world_body."""

    name: str
    parent: int
    pose: Pose
    moving: bool


@dataclass(frozen=True, eq=False)
class ComposedDeformable:
    """A deformable of the scene; `uv` (n, 2) of the vertices."""

    name: str
    vertices: NDArray[np.float32]
    elements: NDArray[np.uint32]
    uv: NDArray[np.float32] | None
    radius: float
    flat: bool
    look: Appearance


@dataclass
class SceneContent:
    """Content of a scene. `names`: names in use. Bodies of `items`, `lights`, `cameras` are indices of `bodies`."""

    name: str
    bodies: list[ComposedBody] = field(default_factory=list)
    items: list[DrawnItem] = field(default_factory=list)
    lights: list[tuple[int, Light]] = field(default_factory=list)
    cameras: list[tuple[int, Camera]] = field(default_factory=list)
    deformables: list[ComposedDeformable] = field(default_factory=list)
    articulations: dict[str, Articulation] = field(default_factory=dict)
    skybox: TextureImage | None = None
    names: set[str] = field(default_factory=set)
    skipped: list[str] = field(default_factory=list)

    @contextmanager
    def atomic(self) -> Iterator[None]:
        """Undo everything that was added in this context when it raises."""
        lists: tuple[list[Any], ...] = (self.bodies, self.items, self.lights, self.cameras, self.skipped)
        lengths, names = [len(one) for one in lists], self.names.copy()
        try:
            yield
        except BaseException:
            for one, length in zip(lists, lengths, strict=True):
                del one[length:]
            self.names = names
            raise

    def add_skipped(self, texts: tuple[str, ...]) -> None:
        """Add lines on what clients will not see, each once."""
        self.skipped += dict.fromkeys(text for text in texts if text not in self.skipped)

    def add_robot(self, robot: Robot) -> None:
        """Add an articulation with its bodies, joints at rest."""
        articulation = robot.articulation
        first = len(self.bodies)
        for name, pose in articulation.compute_world_poses(articulation.T_world_root, {}).items():
            self.bodies.append(ComposedBody(name, -1, pose, moving=True))
        self.items += [replace(item, body=first + item.body) for item in robot.items]
        self.articulations[articulation.name] = articulation
        self.names.update((articulation.name, *articulation.bodies))
        self.add_skipped(robot.skipped)

    def add_nodes(
        self, loaded: LoadedFile, body: int, T_body_file: Matrix, look: Appearance | None, *, flat: bool
    ) -> None:
        """Add the nodes of a file to `body`.

        `flat`: draw everything on that body; otherwise nodes with content on or below them become bodies. `look`
        replaces the materials of the file and its vertex colours, unless it is `None`.
        """
        self.add_skipped(loaded.skipped)
        bare: dict[int, MeshArrays] = {}
        places = [body] * len(loaded.nodes)
        T_world_body = to_matrix(self.bodies[body].pose) if body >= 0 else np.eye(4)
        used = _find_nodes_with_content(loaded)
        several = len(used) > 1
        for k, node in enumerate(loaded.nodes):
            matrix = T_body_file @ node.matrix
            if k in used and not is_solid(matrix):
                self.add_skipped((f"{self.bodies[body].name}: node {node.name!r} is scaled to nothing",))
                used.discard(k)
                continue
            if not flat and several and k in used:
                pose, rest = split_rigid(T_world_body @ matrix)
                self.bodies.append(
                    ComposedBody(node.name, places[node.parent] if node.parent >= 0 else body, pose, False)
                )
                places[k] = len(self.bodies) - 1
                matrix = np.eye(4)
                if rest is not None:
                    matrix[:3, :3] = rest
            for surface in node.surfaces:
                mesh = surface.mesh
                if look is not None and mesh.color is not None:
                    mesh = bare.setdefault(id(mesh), replace(mesh, color=None))
                self.items.append(
                    DrawnItem(places[k], surface.name, matrix, look or surface.appearance or Appearance(), mesh)
                )
            self.lights += [(places[k], _place_light(matrix, light)) for light in node.lights]
            self.cameras += [(places[k], _place_camera(matrix, camera)) for camera in node.cameras]


def _find_nodes_with_content(loaded: LoadedFile) -> set[int]:
    """Return the indices of nodes with content on or below them."""
    used: set[int] = set()
    for k, node in enumerate(loaded.nodes):
        at = k if node.surfaces or node.lights or node.cameras else -1
        while at >= 0 and at not in used:
            used.add(at)
            at = loaded.nodes[at].parent
    return used


def _place_light(matrix: Matrix, light: Light) -> Light:
    """Return a light in the frame of its body, given the matrix of its node; also for a mirrored one."""
    along = -matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
    return msgspec.structs.replace(light, p_body=to_vec3(matrix[:3, 3]), direction_body=to_vec3(along))


def _place_camera(matrix: Matrix, camera: Camera) -> Camera:
    """Return a camera in the frame of its body: it looks along -z of its node with y up, also of a mirrored one."""
    q = orient(matrix[:3, 2] / np.linalg.norm(matrix[:3, 2]), matrix[:3, 1], IDENTITY.q)
    return msgspec.structs.replace(camera, T_body_camera=Pose(to_vec3(matrix[:3, 3]), q))
