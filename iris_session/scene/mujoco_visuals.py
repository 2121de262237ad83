"""Visuals of a compiled MuJoCo model: its geoms and sites, in the groups that are shown. Not here: everything else of a
scene (`mujoco_scene`), and changes while the model is in use (`mujoco_looks`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np

from iris_session.protocol.common import MAX_TEXT, Pose
from iris_session.protocol.names import GeometryKind
from iris_session.protocol.scene import FIRST_SITE_VISUAL, Geometry, Rgba, Visual

#: Groups of geoms, sites, tendons, skins and flexes that MuJoCo's own viewer shows at first.
VIEWER_GROUPS: Final = (0, 1, 2)
#: Group of shapes that only collide, where a model is made by robosuite's rules, and of their visuals.
_COLLIDING_GROUP: Final = 0
_DRAWN_GROUP: Final = 1

_KINDS: Final = {
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")): kind
    for kind in ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf")
}
_TYPES: Final = {
    kind: int(getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"))
    for kind in (
        *("body", "geom", "site", "mesh", "texture", "material", "hfield", "light", "camera", "flex", "skin", "tendon"),
    )
}
#: MuJoCo's default colour: a geom with it has the colour of its material.
_DEFAULT_RGBA: Final = (0.5, 0.5, 0.5, 1.0)


class Shown(NamedTuple):
    """Choice of what clients see of a model.

    Attributes:
        groups: Groups of geoms; `None` for those that the model's own viewer shows.
        sites: Groups of sites; True for all sites, False for none, `None` for those that MuJoCo's viewer shows.
    """

    groups: tuple[int, ...] | None = None
    sites: bool | tuple[int, ...] | None = None

    def choose_groups(self, model: mujoco.MjModel) -> tuple[int, ...]:
        """Return the groups of visuals that are shown at first."""
        return find_viewer_groups(model) if self.groups is None else self.groups

    def has_site(self, group: int) -> bool:
        """Return whether the sites of a group are shown."""
        if isinstance(self.sites, bool):
            return self.sites
        return group in (VIEWER_GROUPS if self.sites is None else self.sites)


def make_shown(groups: Iterable[int] | None, sites: bool | Iterable[int] | None) -> Shown:
    """Return the choice of groups that a caller gave. Raises `ValueError` for anything but groups."""
    chosen = None if groups is None else _check_groups("groups", groups)
    if chosen == ():
        raise ValueError("groups is empty: give the numbers of geom groups, such as (0, 1, 2)")
    return Shown(chosen, sites if sites is None or isinstance(sites, bool) else _check_groups("sites", sites))


def _check_groups(what: str, groups: object) -> tuple[int, ...]:
    found = tuple(groups) if isinstance(groups, Iterable) and not isinstance(groups, str | bytes) else None
    if found is None or not all(isinstance(one, int | np.integer) and not isinstance(one, bool) for one in found):
        raise ValueError(f"{what} is {groups!r:.60}: numbers of groups are expected, such as (0, 1, 2)")
    if wrong := [one for one in found if not 0 <= one < mujoco.mjNGROUP]:
        raise ValueError(f"{what} has {wrong[0]}: MuJoCo has groups 0 to {mujoco.mjNGROUP - 1}")
    return tuple(dict.fromkeys(int(one) for one in found))


def find_viewer_groups(model: mujoco.MjModel) -> tuple[int, ...]:
    """Return the geom groups that the model's own viewer shows.

    These are MuJoCo's, without group 0 where a model follows robosuite's rules: all that is visible in it collides, and
    most of the bodies concerned have shapes in group 1 that do not.
    """
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    visible = model.geom_rgba[:, 3] > 0
    inner = visible & (model.geom_group == _COLLIDING_GROUP)
    if not inner.any() or not collides[inner].all():
        return VIEWER_GROUPS
    outer = visible & (model.geom_group == _DRAWN_GROUP) & ~collides
    bodies = np.unique(model.geom_bodyid[inner])
    if 2 * np.isin(bodies, model.geom_bodyid[outer]).sum() < len(bodies):
        return VIEWER_GROUPS
    return tuple(group for group in VIEWER_GROUPS if group != _COLLIDING_GROUP)


def move_to_shown(group: int, shown: tuple[int, ...]) -> int:
    """Return the group in which clients show what MuJoCo shows at first, though its group of geoms may be hidden."""
    return shown[0] if group in VIEWER_GROUPS and group not in shown else group


def read_visuals(model: mujoco.MjModel, shown: Shown, groups: tuple[int, ...]) -> tuple[Visual, ...]:
    """Return the visuals: all geoms, and the sites that are shown. `groups`: those that clients show."""
    sites = (read_site(model, i, shown, groups) for i in range(model.nsite))
    return (*(read_geom(model, i) for i in range(model.ngeom)), *(site for site in sites if site is not None))


def read_geom(model: mujoco.MjModel, index: int) -> Visual:
    """Return the visual of a geom."""
    return Visual(
        id=index, T_body_visual=to_pose(model.geom_pos[index], model.geom_quat[index]),
        group=int(model.geom_group[index]), **_read_shape(model, "geom", index),
    )  # fmt: skip


def read_site(model: mujoco.MjModel, index: int, shown: Shown, groups: tuple[int, ...]) -> Visual | None:
    """Return the visual of a site, `None` for one that is not shown."""
    group = int(model.site_group[index])
    if not shown.has_site(group):
        return None
    return Visual(
        id=FIRST_SITE_VISUAL + index, T_body_visual=to_pose(model.site_pos[index], model.site_quat[index]),
        group=group if group in groups else groups[0], **_read_shape(model, "site", index),
    )  # fmt: skip


def _read_shape(model: mujoco.MjModel, kind: str, index: int) -> dict[str, Any]:
    """Return what geoms and sites have in common."""
    body, shape, size, material, rgba = (
        getattr(model, f"{kind}_{field}")[index] for field in ("bodyid", "type", "size", "matid", "rgba")
    )
    meshes = getattr(model, f"{kind}_dataid", None)  # older versions have no meshes of sites
    return {
        "body": int(body),
        "name": read_name(model, kind, index),
        "geometry": _read_geometry(model, int(shape), size, -1 if meshes is None else int(meshes[index])),
        "material": int(material),
        "rgba": resolve_rgba(model, rgba, int(material)),
    }


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


def to_floats(values: Any) -> Any:
    """Return an array as a tuple of floats: a vector or a colour."""
    return tuple(np.asarray(values, np.float64).tolist())


def to_pose(position: Any, quaternion: Any) -> Pose:
    return Pose(to_floats(position), to_floats(quaternion))


def resolve_rgba(model: mujoco.MjModel, own: Any, material: int) -> Rgba:
    """Return the colour that MuJoCo draws: the own colour, unless that is the default and there is a material."""
    color: Rgba = to_floats(own)
    return to_floats(model.mat_rgba[material]) if material >= 0 and color == _DEFAULT_RGBA else color


def read_name(model: mujoco.MjModel, kind: str, index: int) -> str:
    """Return the name, or an empty text."""
    return (mujoco.mj_id2name(model, _TYPES[kind], index) or "")[:MAX_TEXT]
