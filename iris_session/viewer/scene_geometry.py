"""Geometry of a scene specification for the Rerun viewer: visuals as primitives and meshes, fixed in frames.

A frame is `world` or the name of a streamed body that moves; the recording moves bodies, never geometry. If no assets
are shared, the specification is made from the recorded model, here and not in the process that runs physics.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from anchors.pose import IDENTITY_POSE, PoseTuple, apply, compose, inverse
from iris_session.journal.messages import RobotLabels, SceneAssets
from iris_session.journal.rows import unpack_model
from iris_session.protocol.common import Pose
from iris_session.protocol.names import ArrayKind, AssetEncoding, GeometryKind, TextureKind
from iris_session.protocol.scene import Deformable, Geometry, Rgba, SceneSpec, Visual, decode_scene
from iris_session.protocol.server_messages import BodyInfo
from iris_session.protocol.specs import RobotSpec
from iris_session.scene import AssetStore, EncodeOptions, MeshArrays, decode_arrays, decode_image, decode_mesh
from iris_session.scene.cube_maps import Atlas, CubeMapReader, bake_cube_map, direction_scale
from iris_session.scene.shapes import (
    add_texture_coordinates,
    build_height_field,
    build_primitive,
    repeat_texture_coordinates,
)

WORLD: Final = "world"
#: Distance [m] to which a plane is drawn beyond the moving bodies: a camera that is reset in the viewer has all that is
#: drawn in sight.
PLANE_MARGIN_M: Final = 3.0
#: Maximum side [px] of the texture level that is used: each texture is in the file once per visual that has it. For
#: cube maps it is the side of a face: six faces lie in one image, which is then no larger.
TEXTURE_SIDE: Final = 512
CUBE_SIDE: Final = 128
#: A mesh of more triangles gets the mean colour of its cube map: cutting a million triangles takes seconds and a
#: gigabyte, which would delay the recorder.
MOST_BAKED: Final = 50_000

#: A mesh is drawn at the first level of fewer vertices, if it has one: finer ones are several times as large and are
#: not seen.
ENOUGH_VERTICES: Final = 8_000
#: A cylinder of a larger diameter or length is drawn as a mesh: Rerun's own have few sides [m].
SMALL_CYLINDER_M: Final = 0.3

BOX: Final = "box"
ELLIPSOID: Final = "ellipsoid"
CAPSULE: Final = "capsule"
CYLINDER: Final = "cylinder"
MESH: Final = "mesh"
_FORMS: Final = {
    GeometryKind.SPHERE: ELLIPSOID,
    GeometryKind.ELLIPSOID: ELLIPSOID,
    GeometryKind.CAPSULE: CAPSULE,
    GeometryKind.CYLINDER: CYLINDER,
}
_WHITE: Final = (1.0, 1.0, 1.0)
#: Name of the model in memory; no file has it.
_BUFFER: Final = "recorded.mjb"

Rgba8 = tuple[int, int, int, int]
Pixels = NDArray[np.uint8]


class VisualShape(NamedTuple):
    """Drawn shape of a visual.

    `size`: half sizes (box, ellipsoid), or radius twice and half length along z (capsule, cylinder) [m]; unused for
    meshes. `tint`: factor of its colour, in place of a texture of one colour.
    """

    kind: str
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mesh: MeshArrays | None = None
    uv: NDArray[np.float32] | None = None
    texture: Pixels | None = None
    tint: tuple[float, float, float] = _WHITE


class BodyPlacement(NamedTuple):
    """Frame of a body and its pose `T` in that frame."""

    frame: str
    T: PoseTuple


@contextmanager
def open_scene(assets: SceneAssets, packed_model: bytes) -> Iterator[tuple[SceneSpec, AssetStore]]:
    """Open specification and asset store of a scene.

    Raises `SceneBuildError`, `OSError`, and `ValueError` for an invalid specification or model.
    """
    if assets.root:
        store = AssetStore(assets.root)
        yield decode_scene(store.get(assets.scene_hash)), store
    else:
        with tempfile.TemporaryDirectory(prefix="iris-picture-") as folder:
            store = AssetStore(folder)
            yield _parse_packed_model(packed_model, store), store


def _parse_packed_model(packed_model: bytes, store: AssetStore) -> SceneSpec:
    import mujoco

    from iris_session.scene.mujoco_scene import parse_mujoco

    mjb = unpack_model(packed_model)
    try:
        model = mujoco.MjModel.from_binary_path(_BUFFER, assets={_BUFFER: mjb})
    except mujoco.FatalError as error:
        raise ValueError(str(error)) from error
    return parse_mujoco(model, store, options=EncodeOptions(levels=False)).spec


class SceneReader:
    """Reader of the drawn geometry of one specification; each mesh and texture is read once.

    Raises `SceneBuildError` for geometry that cannot be read.
    """

    def __init__(self, spec: SceneSpec, store: AssetStore, bodies: Sequence[BodyInfo]) -> None:
        self._spec = spec
        self._store = store
        self._places = place_bodies(spec, bodies)
        self._moving = [body.T_world_body.p for body in spec.bodies if body.moving] or [(0.0, 0.0, 0.0)]
        self._meshes: dict[tuple[int, int], MeshArrays] = {}
        self._textures: dict[int, Pixels | None] = {}
        self._cubes = CubeMapReader(spec, store, CUBE_SIDE)
        self._baked: dict[tuple[Geometry, int, int], MeshArrays] = {}

    def is_shown(self, thing: Visual | Deformable) -> bool:
        """Return whether it is drawn: not fully transparent, and in a visible group."""
        return thing.rgba[3] > 0 and thing.group in self._spec.groups_shown

    def place_visual(self, visual: Visual) -> tuple[str, PoseTuple]:
        """Return the frame of a visual and `T_frame_visual`."""
        frame, T_frame_body = self._places[visual.body]
        return frame, compose(T_frame_body, _tuple(visual.T_body_visual))

    def read_shape(self, visual: Visual) -> VisualShape:
        """Return shape and surface of a visual."""
        geometry = visual.geometry
        cube = self._cubes.find(visual.material, geometry)
        atlas, tint = (None, _WHITE) if cube is None else (cube.atlas, cube.tint)
        texture = self.read_texture(visual.material) if atlas is None else _with_colours(atlas.pixels)
        mesh = self._mesh(geometry)
        is_cylinder = geometry.kind == GeometryKind.CYLINDER  # its size: radius twice and half length
        if atlas is not None and mesh is not None and mesh.triangles > MOST_BAKED:
            return VisualShape(MESH, mesh=mesh, tint=_mean_colour(atlas.pixels))
        if geometry.kind == GeometryKind.PLANE:
            mesh = self._crop_plane(visual)
        elif mesh is None and (texture is not None or (is_cylinder and max(geometry.size) > SMALL_CYLINDER_M / 2.0)):
            mesh = build_primitive(geometry)
        if mesh is None:
            return VisualShape(_FORMS.get(geometry.kind, BOX), geometry.size, tint=tint)
        if texture is None:
            return VisualShape(MESH, mesh=mesh, tint=tint)
        if atlas is not None:
            mesh = self._with_atlas(mesh, visual, atlas)
        else:
            mesh = add_texture_coordinates(mesh, geometry, self._spec.materials[visual.material])
        return VisualShape(MESH, mesh=mesh, uv=mesh.uv, texture=texture)

    def _crop_plane(self, visual: Visual) -> MeshArrays | None:
        """Return the part of a plane that is near the scene, all of it if none is; an infinite one ends there."""
        frame, T_frame_plane = self.place_visual(visual)
        mesh = build_primitive(visual.geometry)
        if mesh is None:
            return None
        to_plane = inverse(T_frame_plane) if frame == WORLD else IDENTITY_POSE
        points = np.array([apply(to_plane, p) for p in self._moving] if frame == WORLD else [(0.0, 0.0, 0.0)])
        near = np.percentile(points, (1.0, 99.0), axis=0)  # a few bodies may be parked far away
        low, high = near[0, :2] - PLANE_MARGIN_M, near[1, :2] + PLANE_MARGIN_M
        position = mesh.position.copy()
        position[:, :2] = np.clip(position[:, :2], low, high)
        is_near = bool((np.ptp(position[:, :2], axis=0) > 0.0).all())
        return replace(mesh, position=position) if is_near else mesh

    def _with_atlas(self, mesh: MeshArrays, visual: Visual, atlas: Atlas) -> MeshArrays:
        plane = visual.id if visual.geometry.kind == GeometryKind.PLANE else -1  # cut out by the place of the visual
        key = visual.geometry, visual.material, plane
        if key not in self._baked:
            scale = direction_scale(self._spec, visual.geometry, visual.material)
            self._baked[key] = bake_cube_map(mesh, visual.geometry, scale, atlas)
        return self._baked[key]

    def read_texture(self, material: int) -> Pixels | None:
        """Return the 2d texture of a material, shape (height, width, 3 or 4) uint8; None if it has none."""
        index = -1 if material < 0 else self._spec.materials[material].find_texture()
        if index < 0:
            return None
        if index not in self._textures:
            self._textures[index] = self._texture(index)
        return self._textures[index]

    def read_arrays(self, deformable: Deformable) -> dict[str, NDArray[Any]]:
        """Return the arrays of a deformable, with texture coordinates repeated as its material demands."""
        arrays = decode_arrays(self._store.get(deformable.address), ArrayKind.DEFORMABLE)
        worn = None if deformable.material < 0 else self._spec.materials[deformable.material]
        uv = repeat_texture_coordinates(arrays.get("uv"), worn)
        return arrays if uv is None else {**arrays, "uv": uv}

    def _mesh(self, geometry: Geometry) -> MeshArrays | None:
        key = (geometry.mesh, geometry.hfield)
        if key == (-1, -1):
            return None
        if key not in self._meshes:
            self._meshes[key] = self._read_mesh(*key)
        return self._meshes[key]

    def _read_mesh(self, mesh: int, hfield: int) -> MeshArrays:
        if mesh >= 0:
            levels = self._spec.meshes[mesh].levels
            level = next((one for one in levels if one.vertices < ENOUGH_VERTICES), levels[-1])
            return decode_mesh(self._store.get(level.address))
        field = self._spec.hfields[hfield]
        return build_height_field(field, decode_arrays(self._store.get(field.address), ArrayKind.GRID)["elevation"])

    def _texture(self, index: int) -> Pixels | None:
        texture = self._spec.textures[index]
        levels = [level for level in texture.levels if level.encoding != AssetEncoding.OPAQUE]
        if not levels or texture.kind != TextureKind.IMAGE:
            return None
        level = next((lev for lev in levels if max(lev.width, lev.height) <= TEXTURE_SIDE), levels[-1])
        return _with_colours(decode_image(self._store.get(level.address), level.encoding))


def _with_colours(pixels: Pixels) -> Pixels:
    """Return the pixels with grey expanded to red, green, blue."""
    return pixels if pixels.shape[2] >= 3 else np.repeat(pixels[:, :, :1], 3, axis=2)


def _mean_colour(pixels: Pixels) -> tuple[float, float, float]:
    red, green, blue = (_with_colours(pixels)[:, :, :3].mean(axis=(0, 1)) / 255.0).tolist()
    return (red, green, blue)


def place_bodies(spec: SceneSpec, bodies: Sequence[BodyInfo]) -> dict[int, BodyPlacement]:
    """Return, per body, the nearest moving streamed body at or above it as frame, and the body's pose in that frame."""
    moving = {body.id: body.name for body in bodies if body.moving}
    found: dict[int, BodyPlacement] = {-1: BodyPlacement(WORLD, IDENTITY_POSE)}
    for body in spec.bodies:  # parents before their children
        name, above = moving.get(body.id), found[body.parent]
        if name is not None:
            found[body.id] = BodyPlacement(name, IDENTITY_POSE)
        elif above.frame == WORLD:
            found[body.id] = BodyPlacement(WORLD, _tuple(body.T_world_body))
        else:
            found[body.id] = BodyPlacement(above.frame, compose(above.T, _tuple(body.T_parent_body)))
    return found


def assign_robots(spec: SceneSpec, robots: Sequence[RobotSpec | RobotLabels]) -> dict[int, str]:
    """Return the robot of each body at or below the base of one, by id."""
    bases = {robot.base_body: robot.name for robot in robots}
    found: dict[int, str] = {}
    for body in spec.bodies:  # parents before their children
        robot = bases.get(body.name) or found.get(body.parent)
        if robot:
            found[body.id] = robot
    return found


def to_rgba8(rgba: Rgba, tint: tuple[float, float, float] = _WHITE) -> Rgba8:
    """Convert a colour (0 to 1) to Rerun's range 0 to 255, multiplied by `tint`."""
    r, g, b, a = (min(255, max(0, round(v * t * 255.0))) for v, t in zip(rgba, (*tint, 1.0), strict=True))
    return r, g, b, a


def _tuple(pose: Pose) -> PoseTuple:
    return pose.p, pose.q
