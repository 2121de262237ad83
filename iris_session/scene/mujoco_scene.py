"""`parse_mujoco`: convert a compiled MuJoCo model to a scene specification and its assets. For MuJoCo 3.3 to 4.

The model is not changed. Left out: collision settings, actuators, sensors, contacts, and skins (see `skipped`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import mujoco
import numpy as np

from iris_session.assets.store import AssetStore
from iris_session.protocol.common import MAX_TEXT
from iris_session.protocol.media import MAX_STREAMS
from iris_session.protocol.names import AssetEncoding, GeometryKind
from iris_session.protocol.scene import (
    Body,
    Geometry,
    SceneSpec,
    Site,
    Tendon,
    Visual,
    encode_scene,
)
from iris_session.scene.asset_builder import AssetBuilder, EncodeOptions
from iris_session.scene.budget import add_totals
from iris_session.scene.mujoco_appearance import (
    compute_tracked,
    read_cameras,
    read_environment,
    read_lights,
    read_materials,
    read_name,
    resolve_rgba,
    to_floats,
    to_pose,
)
from iris_session.scene.mujoco_assets import read_deformables, read_hfields, read_meshes, read_textures
from iris_session.scene.result import ParsedScene

_KINDS: Final = {
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")): kind
    for kind in ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf")
}
_WRAP_SITE: Final = int(mujoco.mjtWrap.mjWRAP_SITE)


def parse_mujoco(
    model: mujoco.MjModel,
    store: AssetStore,
    *,
    data: Any = None,
    name: str = "",
    options: EncodeOptions | None = None,
    sites: bool = False,
    tendons: bool = False,
    threads: int = 0,
) -> ParsedScene:
    """Convert a compiled MuJoCo model to a scene specification, and put its assets into `store`.

    Args:
        model: The model; it is not changed.
        store: Store for the assets and the encoded specification.
        data: Initial state with kinematics computed; by default that of the model.
        name: Name of the scene.
        options: Encoding of meshes and textures; see `EncodeOptions`.
        sites: Include sites.
        tendons: Include spatial tendons, and the sites that they run through.
        threads: Number of threads that encode; 0: one per CPU core, at most 8.

    Returns:
        The scene, and a line for each thing that was left out.
    """
    at = compute_tracked(model, data)
    if data is None:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        if model.nflex:
            mujoco.mj_comPos(model, data)
            mujoco.mj_flex(model, data)
    builder = AssetBuilder(store, options, threads)
    found_textures = read_textures(model, builder)
    cables = _read_tendons(model) if tendons else ()
    needed = {site for cable in cables for site in cable.sites}
    spec = SceneSpec(
        name=name[:MAX_TEXT],
        source=f"MuJoCo {mujoco.__version__}",
        bodies=_read_bodies(model, data),
        visuals=tuple(_read_visual(model, i) for i in range(model.ngeom)),
        materials=read_materials(model),
        textures=found_textures,
        meshes=read_meshes(model, builder),
        hfields=read_hfields(model, builder),
        lights=read_lights(model, at),
        cameras=read_cameras(model, at),
        sites=tuple(_read_site(model, i) for i in range(model.nsite) if sites or i in needed),
        tendons=cables,
        deformables=read_deformables(model, data, builder),
        environment=read_environment(model, found_textures),
    )
    spec = add_totals(spec)
    skipped = tuple(_list_skipped(model, spec, sites=sites, tendons=tendons))
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


def _read_visual(model: mujoco.MjModel, index: int) -> Visual:
    material = int(model.geom_matid[index])
    return Visual(
        id=index,
        body=int(model.geom_bodyid[index]),
        name=read_name(model, "geom", index),
        T_body_visual=to_pose(model.geom_pos[index], model.geom_quat[index]),
        group=int(model.geom_group[index]),
        geometry=_read_geometry(
            model, int(model.geom_type[index]), model.geom_size[index], int(model.geom_dataid[index])
        ),
        material=material,
        rgba=resolve_rgba(model, model.geom_rgba[index], material),
    )


def _read_site(model: mujoco.MjModel, index: int) -> Site:
    material = int(model.site_matid[index])
    mesh = int(model.site_dataid[index]) if hasattr(model, "site_dataid") else -1
    return Site(
        id=index,
        body=int(model.site_bodyid[index]),
        name=read_name(model, "site", index),
        T_body_site=to_pose(model.site_pos[index], model.site_quat[index]),
        group=int(model.site_group[index]),
        geometry=_read_geometry(model, int(model.site_type[index]), model.site_size[index], mesh),
        material=material,
        rgba=resolve_rgba(model, model.site_rgba[index], material),
    )


def _read_geometry(model: mujoco.MjModel, kind: int, size: Any, asset: int) -> Geometry:
    shape = _KINDS.get(kind, GeometryKind.BOX)
    full = a, b, _ = to_floats(size)
    mesh = hfield = -1
    match shape:
        case GeometryKind.SPHERE:
            full = (a, a, a)
        case GeometryKind.CAPSULE | GeometryKind.CYLINDER:
            full = (a, a, b)
        case GeometryKind.MESH | GeometryKind.SDF:
            mesh = asset
        case GeometryKind.HFIELD:
            hfield = asset
            full = to_floats(model.hfield_size[asset][:3])
    return Geometry(shape, full, mesh, hfield)


def _read_tendons(model: mujoco.MjModel) -> tuple[Tendon, ...]:
    """Return the spatial tendons that run through at least two sites."""
    found = []
    for i in range(model.ntendon):
        wraps = range(int(model.tendon_adr[i]), int(model.tendon_adr[i]) + int(model.tendon_num[i]))
        through = tuple(int(model.wrap_objid[w]) for w in wraps if int(model.wrap_type[w]) == _WRAP_SITE)
        material = int(model.tendon_matid[i])
        if len(through) >= 2:
            found.append(
                Tendon(
                    name=read_name(model, "tendon", i),
                    group=int(model.tendon_group[i]),
                    width=float(model.tendon_width[i]),
                    sites=through,
                    material=material,
                    rgba=resolve_rgba(model, model.tendon_rgba[i], material),
                )
            )
    return tuple(found)


def _list_skipped(model: mujoco.MjModel, spec: SceneSpec, *, sites: bool, tendons: bool) -> Iterator[str]:
    """Yield lines on content that clients will not see: also sites and tendons that were not requested."""
    shown = spec.groups_shown
    if model.nskin:
        yield f"{model.nskin} skins: only bodies, shapes and flexes are shared; use a flex"
    if model.nflex > MAX_STREAMS:
        yield f"motion of {model.nflex - MAX_STREAMS} of {model.nflex} flexes: {MAX_STREAMS} are streamed"
    if not sites:
        marks = (_read_site(model, i) for i in range(model.nsite))
        if n := sum(mark.group in shown and mark.rgba[3] > 0 for mark in marks):
            yield f"{n} sites: serve --sites, or SessionConfig(sites=True), shares them"
    if not tendons:
        cables = (cable for cable in _read_tendons(model) if cable.group in shown)
        if n := sum(cable.width > 0 and cable.rgba[3] > 0 for cable in cables):
            yield f"{n} tendons: serve --tendons, or SessionConfig(tendons=True), shares them"
    if n := sum(texture.levels[0].encoding == AssetEncoding.OPAQUE for texture in spec.textures):
        yield f"{n} textures in a form of their own (KTX) where that is not read: PNG is everywhere"
