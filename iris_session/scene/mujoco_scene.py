"""`parse_mujoco`: convert a compiled MuJoCo model to a scene specification and its assets. For MuJoCo 3.3 to 4.

The model is not changed. Left out: collision settings, actuators, sensors, contacts, and skins (see `skipped`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np

from iris_session.assets.store import AssetStore
from iris_session.protocol.common import MAX_TEXT, Vec3
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
    list_assets,
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
    to_pose,
)
from iris_session.scene.mujoco_assets import read_deformables, read_hfields, read_meshes, read_textures

_KINDS: Final = {
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")): kind
    for kind in ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf")
}
_WRAP_SITE: Final = int(mujoco.mjtWrap.mjWRAP_SITE)


@dataclass(frozen=True)
class ParsedScene:
    """Scene whose assets, the specification among them, are in the store.

    Attributes:
        spec: The specification.
        scene_hash: Address of the specification.
        skipped: Content of the model that the specification lacks, one line each.
        built: Number of meshes, textures and other content that were encoded.
        recalled: Number of those whose encoding the store already had.
    """

    spec: SceneSpec
    scene_hash: str
    skipped: tuple[str, ...]
    built: int
    recalled: int

    @property
    def addresses(self) -> tuple[str, ...]:
        """Addresses of all assets in the order in which they become visible, to be kept in the store and served."""
        return (self.scene_hash, *list_assets(self.spec))


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
    skipped = (*_list_skipped(model), *_list_unrequested(model, sites=sites, tendons=tendons), *_list_containers(spec))
    return ParsedScene(spec, store.put(encode_scene(spec)), skipped, builder.built, builder.recalled)


def _read_bodies(model: mujoco.MjModel, data: Any) -> tuple[Body, ...]:
    """Return all bodies by id, without those that MuJoCo made for vertices of flexes; the world is 0."""
    vertices = _flex_vertex_bodies(model)
    weld = model.body_weldid.tolist()
    mocap = model.body_mocapid.tolist()
    moving = [False] * len(weld)
    for i, parent in enumerate(model.body_parentid.tolist()):
        # Before MuJoCo 3.4 mocap bodies, and bodies fixed to them, are welded to the world.
        moving[i] = i > 0 and (weld[i] != 0 or mocap[i] >= 0 or moving[parent])
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
    return frozenset(
        body
        for body in listed
        if body > 0
        and body not in used
        and int(model.body_geomnum[body]) == 0
        and 1 <= int(model.body_jntnum[body]) <= 3
        and _has_only_slides(model, body)
    )


def _has_only_slides(model: mujoco.MjModel, body: int) -> bool:
    """Return whether all joints of a body are slides."""
    first, n = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    return bool((model.jnt_type[first : first + n] == mujoco.mjtJoint.mjJNT_SLIDE).all())


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
    a, b, c = (float(v) for v in size)
    full: Vec3 = (a, b, c)
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
            x, y, z, _ = (float(v) for v in model.hfield_size[asset])
            full = (x, y, z)
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


def _list_skipped(model: mujoco.MjModel) -> tuple[str, ...]:
    found = []
    if model.nskin:
        found.append(f"{model.nskin} skins: only bodies, shapes and flexes are shared; use a flex")
    if model.nflex > MAX_STREAMS:
        found.append(f"motion of {model.nflex - MAX_STREAMS} of {model.nflex} flexes: {MAX_STREAMS} are streamed")
    return tuple(found)


def _list_unrequested(model: mujoco.MjModel, *, sites: bool, tendons: bool) -> Iterator[str]:
    """Yield lines on sites and tendons that MuJoCo shows and that were not requested."""
    shown = SceneSpec().groups_shown
    if not sites:
        marks = (_read_site(model, i) for i in range(model.nsite))
        if n := sum(mark.group in shown and mark.rgba[3] > 0 for mark in marks):
            yield f"{n} sites: serve --sites, or SessionConfig(sites=True), shares them"
    if not tendons:
        cables = (cable for cable in _read_tendons(model) if cable.group in shown)
        if n := sum(cable.width > 0 and cable.rgba[3] > 0 for cable in cables):
            yield f"{n} tendons: serve --tendons, or SessionConfig(tendons=True), shares them"


def _list_containers(spec: SceneSpec) -> Iterator[str]:
    if n := sum(texture.levels[0].encoding == AssetEncoding.OPAQUE for texture in spec.textures):
        yield f"{n} textures in a form of their own (KTX) where that is not read: PNG is everywhere"
