"""`parse_mujoco`: convert a compiled MuJoCo model to a scene specification and its assets. For MuJoCo 3.3 to 4.

The model is not changed. Left out: collision settings, actuators, sensors and contacts. Everything else is as MuJoCo's
own renderer draws it: sites are visuals, skins and spatial tendons are deformables beside the flexes; meshes without
texture coordinates get creases (`meshes.CREASE`), with them the normals of the file; a texture coordinate (0, 0) is the
upper left corner of the image.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from anchors.pose import PoseTuple, compose, inverse, quat_rotate
from iris_session.assets.store import AssetStore
from iris_session.protocol.common import IDENTITY, MAX_TEXT, Pose, Vec3
from iris_session.protocol.media import MAX_STREAMS
from iris_session.protocol.names import (
    ArrayFilter,
    ArrayKind,
    ArrayName,
    AssetEncoding,
    ColorSpace,
    Follow,
    LightKind,
    TextureKind,
)
from iris_session.protocol.scene import (
    Body,
    Camera,
    Environment,
    Headlight,
    HeightField,
    Light,
    Material,
    Mesh,
    SceneSpec,
    Texture,
    TextureUse,
    encode_scene,
)
from iris_session.scene.arrays import StoredArray, encode_arrays
from iris_session.scene.asset_builder import AssetBuilder, EncodeOptions, MeshNote, Work
from iris_session.scene.budget import add_totals
from iris_session.scene.meshes import CREASE, MeshArrays, index_corners, normalise
from iris_session.scene.mujoco_deformables import read_deformables, read_drawn_meshes
from iris_session.scene.mujoco_visuals import (
    VIEWER_GROUPS,
    Shown,
    make_shown,
    read_name,
    read_visuals,
    to_floats,
    to_pose,
)
from iris_session.scene.result import ParsedScene

_ROLES: Final = {
    int(value): name.removeprefix("mjTEXROLE_").lower()
    for name, value in mujoco.mjtTextureRole.__members__.items()
    if name.startswith("mjTEXROLE_")
}
_LIGHTS: Final = {0: LightKind.SPOT, 1: LightKind.DIRECTIONAL, 2: LightKind.POINT, 3: LightKind.IMAGE}
_FOLLOW: Final = {
    0: Follow.FIXED,
    1: Follow.TRACK,
    2: Follow.TRACK_COM,
    3: Follow.TARGET_BODY,
    4: Follow.TARGET_BODY_COM,
}
_ORTHOGRAPHIC: Final = 1
#: Values of `_FOLLOW` for lights and cameras that move with a body without rotating with it.
_TRACKING: Final = frozenset({1, 2})
#: Smaller differences [m, components of unit vectors] are ignored: the values of the model are used unchanged.
_SAME: Final = 1e-6
_TEXTURES: Final = {
    int(mujoco.mjtTexture.mjTEXTURE_2D): TextureKind.IMAGE,
    int(mujoco.mjtTexture.mjTEXTURE_CUBE): TextureKind.CUBE,
    int(mujoco.mjtTexture.mjTEXTURE_SKYBOX): TextureKind.SKYBOX,
}
_SPACES: Final = {0: ColorSpace.AUTO, 1: ColorSpace.LINEAR, 2: ColorSpace.SRGB}
_FACES: Final = 6


def parse_mujoco(
    model: mujoco.MjModel,
    store: AssetStore,
    *,
    data: Any = None,
    name: str = "",
    options: EncodeOptions | None = None,
    groups: Iterable[int] | None = None,
    sites: bool | Iterable[int] | None = None,
    threads: int = 0,
) -> ParsedScene:
    """Convert a compiled MuJoCo model to a scene specification, and put its assets into `store`.

    Args:
        model: The model; it is not changed.
        store: Store for the assets and the encoded specification.
        data: Initial state with kinematics computed; by default that of the model.
        name: Name of the scene.
        options: Encoding of meshes and textures; see `EncodeOptions`.
        groups: Groups of geoms that clients show; `None` for those that the model's own viewer shows: 0, 1 and 2, but
            not 0 where that has the collision shapes (robosuite).
        sites: Groups of sites to include, True for all sites, False for none; `None` for those that MuJoCo's viewer
            shows, 0 to 2.
        threads: Number of threads that encode; 0: one per CPU core, at most 8.

    Returns:
        The scene, and a line for each thing that was left out.

    Raises:
        ValueError: `groups` or `sites` are no groups.
    """
    shown = make_shown(groups, sites)
    chosen = shown.choose_groups(model)
    at = compute_tracked(model, data)
    if data is None:
        data = mujoco.MjData(model)
        mujoco.mj_fwdPosition(model, data)
    builder = AssetBuilder(store, options, threads)
    found_textures = read_textures(model, builder)
    spec = SceneSpec(
        name=name[:MAX_TEXT],
        source=f"MuJoCo {mujoco.__version__}",
        bodies=_read_bodies(model, data),
        visuals=read_visuals(model, shown, chosen),
        materials=read_materials(model),
        textures=found_textures,
        meshes=read_meshes(model, builder),
        hfields=read_hfields(model, builder),
        lights=read_lights(model, at),
        cameras=read_cameras(model, at),
        deformables=read_deformables(read_drawn_meshes(model), data, builder, chosen),
        environment=read_environment(model, found_textures),
        groups_shown=chosen,
    )
    spec = add_totals(spec)
    skipped = tuple(_list_skipped(model, spec, shown))
    return ParsedScene(spec, store.put(encode_scene(spec)), skipped, builder.built, builder.recalled)


def _read_bodies(model: mujoco.MjModel, data: Any) -> tuple[Body, ...]:
    """Return all bodies by id, without those that MuJoCo made for vertices of flexes; the world is 0."""
    vertices = _flex_vertex_bodies(model)
    moving = ((model.body_weldid != 0) | (model.body_mocapid >= 0)).tolist()
    for i, parent in enumerate(model.body_parentid.tolist()):
        # Before MuJoCo 3.4 mocap bodies, and bodies fixed to them, are welded to the world.
        moving[i] = moving[i] or moving[parent]
    return tuple(
        Body(
            id=i,
            name=read_name(model, "body", i),
            parent=int(model.body_parentid[i]) if i else -1,
            T_parent_body=to_pose(model.body_pos[i], model.body_quat[i]),
            T_world_body=to_pose(data.xpos[i], data.xquat[i]),
            moving=moving[i],
        )
        for i in range(model.nbody)
        if i not in vertices
    )


def _flex_vertex_bodies(model: mujoco.MjModel) -> frozenset[int]:
    """Return bodies that hold only a vertex or node of a flex, and that nothing refers to: they are not streamed."""
    listed: set[int] = set()
    for field in ("flex_vertbodyid", "flex_nodebodyid"):
        if model.nflex and hasattr(model, field):
            bodies, points = np.unique(getattr(model, field), return_counts=True)
            listed.update(bodies[points == 1].tolist())
    used = {
        *model.body_parentid.tolist(),
        *model.light_bodyid.tolist(),
        *model.cam_bodyid.tolist(),
        *model.site_bodyid.tolist(),
        *model.light_targetbodyid.tolist(),
        *model.cam_targetbodyid.tolist(),
    }
    of_slides = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE]
    slides = np.bincount(of_slides, minlength=model.nbody).tolist()
    return frozenset(
        body
        for body in listed - used
        if body > 0 and model.body_geomnum[body] == 0 and 1 <= model.body_jntnum[body] == slides[body] <= 3
    )


def _list_skipped(model: mujoco.MjModel, spec: SceneSpec, shown: Shown) -> Iterator[str]:
    """Yield lines on content that clients will not see."""
    if shown.groups is None and (hidden := set(VIEWER_GROUPS) - set(spec.groups_shown)):
        n = sum(visual.group in hidden and visual.rgba[3] > 0 for visual in spec.visuals)
        yield f"{n} collision shapes in group {', '.join(map(str, sorted(hidden)))}: --groups 0,1,2 shows them"
    if (n := len(spec.deformables)) > MAX_STREAMS:
        yield f"motion of {n - MAX_STREAMS} of {n} flexes, skins and tendons: {MAX_STREAMS} are streamed"
    if n := sum(texture.levels[0].encoding == AssetEncoding.OPAQUE for texture in spec.textures):
        yield f"{n} textures in a form of their own (KTX) where that is not read: PNG is everywhere"


# --- materials, lights, cameras and environment; fields that older versions lack keep their defaults -----------


def read_materials(model: mujoco.MjModel) -> tuple[Material, ...]:
    """Return all materials, by id."""
    return tuple(
        Material(
            name=read_name(model, "material", i),
            rgba=to_floats(model.mat_rgba[i]),
            emission=float(model.mat_emission[i]),
            specular=float(model.mat_specular[i]),
            shininess=float(model.mat_shininess[i]),
            reflectance=float(model.mat_reflectance[i]),
            metallic=_read_optional(model, "mat_metallic", i, -1.0),
            roughness=_read_optional(model, "mat_roughness", i, -1.0),
            textures=tuple(
                TextureUse(_ROLES.get(role, str(role)), int(texture))
                for role, texture in enumerate(model.mat_texid[i])
                if texture >= 0
            ),
            repeat=to_floats(model.mat_texrepeat[i]),
            uniform=bool(model.mat_texuniform[i]),
        )
        for i in range(model.nmat)
    )


def compute_tracked(model: mujoco.MjModel, data: Any) -> Any | None:
    """Return a copy of `data` with poses of lights and cameras, if one moves with its body without rotating with it.

    The pose of such a one in the frame of its body depends on the state. `None`: all poses are those of the model.
    """
    if data is None or not {*model.light_mode.tolist(), *model.cam_mode.tolist()} & _TRACKING:
        return None
    own = copy.copy(data)
    mujoco.mj_kinematics(model, own)
    mujoco.mj_comPos(model, own)
    mujoco.mj_camlight(model, own)
    return own


def _to_body_frame(at: Any, body: int, p_world: Any, q_world: Any = IDENTITY.q) -> PoseTuple:
    """Return T_body_x of something at `p_world` with the orientation `q_world`. `at`: result of `compute_tracked`."""
    T_world_body = to_floats(at.xpos[body]), to_floats(at.xquat[body])
    return compose(inverse(T_world_body), (to_floats(p_world), to_floats(q_world)))


def _find_light_place(model: mujoco.MjModel, i: int, at: Any | None) -> tuple[Vec3, Vec3]:
    """Return position and direction in the frame of the body. `at`: result of `compute_tracked`."""
    rigid = to_floats(model.light_pos[i]), to_floats(model.light_dir[i])
    if at is None or int(model.light_mode[i]) not in _TRACKING:
        return rigid
    body = int(model.light_bodyid[i])
    p_body, q_body_world = _to_body_frame(at, body, at.light_xpos[i])
    found = p_body, quat_rotate(q_body_world, to_floats(at.light_xdir[i]))
    return rigid if np.allclose(rigid, found, rtol=0, atol=_SAME) else found


def _find_camera_pose(model: mujoco.MjModel, i: int, at: Any | None) -> Pose:
    """Return T_body_camera. `at`: result of `compute_tracked`."""
    rigid = to_pose(model.cam_pos[i], model.cam_quat[i])
    if at is None or int(model.cam_mode[i]) not in _TRACKING:
        return rigid
    q_world = np.zeros(4)
    mujoco.mju_mat2Quat(q_world, at.cam_xmat[i])
    found = Pose(*_to_body_frame(at, int(model.cam_bodyid[i]), at.cam_xpos[i], q_world))
    near = abs(np.dot(rigid.q, found.q)) >= 1.0 - _SAME**2 and np.allclose(rigid.p, found.p, rtol=0, atol=_SAME)
    return rigid if near else found


def read_lights(model: mujoco.MjModel, at: Any | None = None) -> tuple[Light, ...]:
    """Return all lights, by id. `at`: result of `compute_tracked`."""
    places = [_find_light_place(model, i, at) for i in range(model.nlight)]
    return tuple(
        Light(
            name=read_name(model, "light", i),
            kind=_read_light_kind(model, i),
            body=int(model.light_bodyid[i]),
            p_body=places[i][0],
            direction_body=places[i][1],
            ambient=to_floats(model.light_ambient[i]),
            diffuse=to_floats(model.light_diffuse[i]),
            specular=to_floats(model.light_specular[i]),
            attenuation=to_floats(model.light_attenuation[i]),
            cutoff=float(model.light_cutoff[i]),
            exponent=float(model.light_exponent[i]),
            range=_read_optional(model, "light_range", i, 0.0),
            intensity=_read_optional(model, "light_intensity", i, 0.0),
            bulb_radius=_read_optional(model, "light_bulbradius", i, 0.0),
            texture=int(_read_optional(model, "light_texid", i, -1)),
            castshadow=bool(model.light_castshadow[i]),
            active=bool(model.light_active[i]),
            follow=_FOLLOW.get(int(model.light_mode[i]), Follow.FIXED),
            target=int(model.light_targetbodyid[i]),
        )
        for i in range(model.nlight)
    )


def _read_light_kind(model: mujoco.MjModel, index: int) -> str:
    if hasattr(model, "light_type"):
        return _LIGHTS.get(int(model.light_type[index]), LightKind.SPOT)
    return LightKind.DIRECTIONAL if model.light_directional[index] else LightKind.SPOT  # before MuJoCo 3.3.3


def read_cameras(model: mujoco.MjModel, at: Any | None = None) -> tuple[Camera, ...]:
    """Return all cameras, by id. `at`: result of `compute_tracked`."""
    found = []
    projection = "cam_projection" if hasattr(model, "cam_projection") else "cam_orthographic"
    for i in range(model.ncam):
        sensor = np.asarray(model.cam_sensorsize[i], np.float64)
        lens = np.zeros((2, 2))
        if (sensor > 0).all():  # convert lengths on the sensor to pixels
            lens = np.reshape(model.cam_intrinsic[i], (2, 2)).astype(np.float64) * (model.cam_resolution[i] / sensor)
        found.append(
            Camera(
                name=read_name(model, "camera", i),
                body=int(model.cam_bodyid[i]),
                T_body_camera=_find_camera_pose(model, i, at),
                fovy=float(model.cam_fovy[i]),
                orthographic=int(getattr(model, projection)[i]) == _ORTHOGRAPHIC,
                focal=to_floats(lens[0]),
                principal=to_floats(lens[1]),
                resolution=tuple(model.cam_resolution[i].tolist()),
                follow=_FOLLOW.get(int(model.cam_mode[i]), Follow.FIXED),
                target=int(model.cam_targetbodyid[i]),
            )
        )
    return tuple(found)


def read_environment(model: mujoco.MjModel, textures: Sequence[Texture]) -> Environment:
    """Return the environment of the scene; MuJoCo draws the first texture of kind skybox."""
    extent = float(model.stat.extent)
    headlight, scale = model.vis.headlight, model.vis.map
    skyboxes = [i for i, texture in enumerate(textures) if texture.kind == TextureKind.SKYBOX]
    return Environment(
        headlight=Headlight(
            bool(headlight.active),
            *(to_floats(light) for light in (headlight.ambient, headlight.diffuse, headlight.specular)),
        ),
        skybox=skyboxes[0] if skyboxes else -1,
        haze_rgba=to_floats(model.vis.rgba.haze),
        haze=float(scale.haze),
        fog_rgba=to_floats(model.vis.rgba.fog),
        fog_start=float(scale.fogstart) * extent,
        fog_end=float(scale.fogend) * extent,
        znear=float(scale.znear) * extent,
        zfar=float(scale.zfar) * extent,
        extent=extent,
        center=to_floats(model.stat.center),
    )


def _read_optional(model: mujoco.MjModel, field: str, index: int, default: float) -> float:
    return float(getattr(model, field)[index]) if hasattr(model, field) else default


# --- meshes, textures and height fields -------------------------------------------------------------------------------


def read_meshes(model: mujoco.MjModel, builder: AssetBuilder) -> tuple[Mesh, ...]:
    """Return all meshes, by id."""
    notes = builder.run([_mesh_work(model, builder, i) for i in range(model.nmesh)])
    return tuple(
        Mesh(read_name(model, "mesh", i), note.low, note.high, int(model.mesh_texcoordadr[i]) >= 0, note.levels)
        for i, note in enumerate(notes)
    )


def _mesh_work(model: mujoco.MjModel, builder: AssetBuilder, index: int) -> Work[MeshNote]:
    vertex, normal, texcoord, face, face_normal, face_texcoord = _mesh_views(model, index)
    raw = [vertex, normal, face, face_normal]
    if texcoord is not None and face_texcoord is not None:
        raw += [texcoord, face_texcoord]
    return builder.mesh_work(raw, lambda: read_mesh_corners(model, index))


def _mesh_views(model: mujoco.MjModel, index: int) -> tuple[Any, ...]:
    """Return views of one mesh: vertices, normals, texture coordinates or `None`, and per face three indices into
    each.
    """
    v, n, f = (int(getattr(model, f"mesh_{name}adr")[index]) for name in ("vert", "normal", "face"))
    vertex = model.mesh_vert[v : v + int(model.mesh_vertnum[index])]
    normal = model.mesh_normal[n : n + int(model.mesh_normalnum[index])]
    faces = slice(f, f + int(model.mesh_facenum[index]))
    t = int(model.mesh_texcoordadr[index])
    texcoord = model.mesh_texcoord[t : t + int(model.mesh_texcoordnum[index])] if t >= 0 else None
    face_texcoord = model.mesh_facetexcoord[faces] if t >= 0 else None
    return vertex, normal, texcoord, model.mesh_face[faces], model.mesh_facenormal[faces], face_texcoord


def read_mesh_corners(model: mujoco.MjModel, index: int) -> MeshArrays:
    """Return one mesh with a normal and a texture coordinate at every corner, as it is drawn."""
    vertex, normals, texcoord, face, face_normal, face_texcoord = _mesh_views(model, index)
    position = vertex[face]
    normal = normals[face_normal].copy()
    if texcoord is not None:
        return index_corners(position, normal, texcoord[face_texcoord])
    flat = normalise(np.cross(position[:, 1] - position[:, 0], position[:, 2] - position[:, 0]))
    creased = np.einsum("fkc,fc->fk", normal, flat) < CREASE
    normal[creased] = np.broadcast_to(flat[:, None], normal.shape)[creased]
    return index_corners(position, normal, None)


def read_textures(model: mujoco.MjModel, builder: AssetBuilder) -> tuple[Texture, ...]:
    """Return all textures, by id."""
    kinds = [_TEXTURES.get(int(kind), TextureKind.IMAGE) for kind in model.tex_type]
    spaces = getattr(model, "tex_colorspace", None)  # since MuJoCo 3.3.1
    images = [_read_pixels(model, i, kind) for i, kind in enumerate(kinds)]
    notes = builder.run([builder.texture_work(image, kind) for image, kind in zip(images, kinds, strict=True)])
    return tuple(
        Texture(
            name=read_name(model, "texture", i),
            kind=kind,
            width=image.shape[1],
            height=image.shape[0] // (1 if kind == TextureKind.IMAGE else _FACES),
            channels=image.shape[2],
            colorspace=ColorSpace.AUTO if spaces is None else _SPACES.get(int(spaces[i]), ColorSpace.AUTO),
            levels=note.levels,
        )
        for i, (kind, image, note) in enumerate(zip(kinds, images, notes, strict=True))
    )


def _read_pixels(model: mujoco.MjModel, index: int, kind: str) -> NDArray[np.uint8]:
    """Return pixels (height, width, channels), of cubes six faces. A cube of one square has it on every face."""
    shape = tuple(int(getattr(model, f"tex_{side}")[index]) for side in ("height", "width", "nchannel"))
    start = int(model.tex_adr[index])
    image: NDArray[np.uint8] = model.tex_data[start : start + math.prod(shape)].reshape(shape)
    return np.tile(image, (_FACES, 1, 1)) if kind != TextureKind.IMAGE and shape[0] == shape[1] else image


def read_hfields(model: mujoco.MjModel, builder: AssetBuilder) -> tuple[HeightField, ...]:
    """Return all height fields, by id."""
    grids = []
    for i in range(model.nhfield):
        rows, columns, start = (int(getattr(model, f"hfield_{name}")[i]) for name in ("nrow", "ncol", "adr"))
        grids.append(model.hfield_data[start : start + rows * columns].reshape(rows, columns))
    notes = builder.run([builder.blob_work([b"hfield", grid], partial(_encode_grid, grid)) for grid in grids])
    return tuple(
        HeightField(
            name=read_name(model, "hfield", i),
            rows=grid.shape[0],
            columns=grid.shape[1],
            size=tuple(model.hfield_size[i].tolist()),
            address=note.address,
            bytes=note.bytes,
        )
        for i, (grid, note) in enumerate(zip(grids, notes, strict=True))
    )


def _encode_grid(grid: NDArray[np.float32]) -> bytes:
    return encode_arrays(ArrayKind.GRID, [StoredArray(ArrayName.ELEVATION, grid, ArrayFilter.SHUFFLE)])
