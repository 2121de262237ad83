"""Meshes of a compiled MuJoCo model whose vertices move: flexes, skins, and spatial tendons.

They become deformables of the scene; `DrawnMesh.read_vertices` reads the vertices of a state. A skin follows its bones
as in MuJoCo's renderer. Tendons that look the same are one deformable: a rope along their paths, around shapes too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.scene import Deformable, Rgba
from iris_session.scene.asset_builder import AssetBuilder
from iris_session.scene.meshes import encode_deformable
from iris_session.scene.mujoco_visuals import VIEWER_GROUPS, move_to_shown, read_name, resolve_rgba
from iris_session.streams.deformable_topology import MAX_VERTICES, DeformableTopology, used_vertices

_SITE: Final = int(mujoco.mjtWrap.mjWRAP_SITE)
_PULLEY: Final = int(mujoco.mjtWrap.mjWRAP_PULLEY)
_CYLINDER: Final = int(mujoco.mjtWrap.mjWRAP_CYLINDER)
_AROUND: Final = frozenset({int(mujoco.mjtWrap.mjWRAP_SPHERE), _CYLINDER})
#: Categories of geoms for `mjv_updateScene`.
_NO_GEOMS: Final = 0
#: Points of a tendon around a shape, at equal distances on the chord.
_ARC: Final = np.linspace(0.0, 1.0, 6)[:, None]

Vertices = NDArray[np.floating]


class DrawnMesh(NamedTuple):
    """A mesh whose vertices move.

    Attributes:
        stream: Name of its media stream.
        name: Name in the model, empty for tendons.
        dim: As in `Deformable`, as are `group`, `radius` [m], `flat`, `material` and `rgba`.
        elements: Edges (n, 2) of ropes, triangles (n, 3) of cloths, of skins, and of the surfaces of soft bodies.
        uv: Texture coordinates at the corners of each element, if any.
        numbers: Numbers of the vertices in the model, where some are left out.
        topology: Plan of the stream.
        read_vertices: Returns the vertices (n, 3) of a state with kinematics [m], world frame.
    """

    stream: str
    name: str
    dim: int
    group: int
    radius: float
    flat: bool
    material: int
    rgba: Rgba
    elements: NDArray[np.uint32]
    uv: NDArray[np.float32] | None
    numbers: NDArray[np.int64] | None
    topology: DeformableTopology
    read_vertices: Callable[[Any], Vertices]


def read_drawn_meshes(model: mujoco.MjModel) -> list[DrawnMesh]:
    """Return flexes, then the skins and tendons of the groups that MuJoCo's viewer shows."""
    flexes = (_read_flex(model, i) for i in range(model.nflex))
    skins = (
        _read_skin(model, i)
        for i in range(model.nskin)
        if model.skin_group[i] in VIEWER_GROUPS and 0 < model.skin_vertnum[i] <= MAX_VERTICES
    )
    return [*flexes, *skins, *_read_tendons(model)]


def read_deformables(
    meshes: Iterable[DrawnMesh], data: Any, builder: AssetBuilder, groups: tuple[int, ...]
) -> tuple[Deformable, ...]:
    """Return the deformables of a scene. `data`: the initial state; `groups`: of visuals, those that are shown."""
    parts = [(mesh, np.array(mesh.read_vertices(data), np.float32)) for mesh in meshes]
    notes = builder.run([builder.blob_work(_list_content(*part), _make_encode(*part)) for part in parts])
    return tuple(
        Deformable(
            name=mesh.name,
            dim=mesh.dim,
            group=move_to_shown(mesh.group, groups),
            vertices=len(rest),
            elements=len(mesh.elements),
            radius=mesh.radius,
            flat=mesh.flat,
            material=mesh.material,
            rgba=mesh.rgba,
            stream=mesh.stream,
            address=note.address,
            bytes=note.bytes,
        )
        for (mesh, rest), note in zip(parts, notes, strict=True)
    )


def _list_content(mesh: DrawnMesh, rest: NDArray[np.float32]) -> list[Any]:
    """Return what the asset depends on."""
    return [b"flex", mesh.elements, *(part for part in (mesh.numbers, mesh.uv) if part is not None), rest]


def _make_encode(mesh: DrawnMesh, rest: NDArray[np.float32]) -> Callable[[], bytes]:
    return lambda: encode_deformable(mesh.elements, mesh.uv, rest, mesh.topology, mesh.numbers)


# --- flexes -----------------------------------------------------------------------------------------------------------


def _find_flex_material(model: mujoco.MjModel, index: int) -> int:
    """Return the material of a flex. Since MuJoCo 4 every element has one; models give all the same, so the first is
    used.
    """
    by_element = len(model.flex_matid) == model.nflexelem
    return int(model.flex_matid[int(model.flex_elemadr[index]) if by_element else index])


def _read_flex(model: mujoco.MjModel, index: int) -> DrawnMesh:
    dim = int(model.flex_dim[index])
    if dim == 3:
        start, count = int(model.flex_shelldataadr[index]), int(model.flex_shellnum[index])
        corners = model.flex_shell[start : start + 3 * count].reshape(-1, 3)
    else:
        start, count = int(model.flex_elemdataadr[index]), int(model.flex_elemnum[index])
        corners = model.flex_elem[start : start + (dim + 1) * count].reshape(-1, dim + 1)
    n = int(model.flex_vertnum[index])
    used, elements = used_vertices(n, corners) if dim == 3 else (np.arange(n), corners)
    ends = {"edges": elements} if dim == 1 else {"faces": elements}
    rows, material = int(model.flex_vertadr[index]) + used, _find_flex_material(model, index)
    return DrawnMesh(
        stream=f"flex-{index}",
        name=read_name(model, "flex", index),
        dim=dim,
        group=int(model.flex_group[index]),
        radius=float(model.flex_radius[index]),
        flat=bool(model.flex_flatskin[index]),
        material=material,
        rgba=resolve_rgba(model, model.flex_rgba[index], material),
        elements=np.ascontiguousarray(elements, np.uint32),
        uv=_read_texture_coordinates(model, index, start, corners),
        numbers=used if len(used) <= int(used.max()) else None,  # the inside is left out
        topology=DeformableTopology(len(used), **ends).without_faces(),
        read_vertices=lambda data: data.flexvert_xpos[rows],
    )


def _read_texture_coordinates(
    model: mujoco.MjModel, index: int, start: int, corners: NDArray[np.int32]
) -> NDArray[np.float32] | None:
    at, dim = int(model.flex_texcoordadr[index]), int(model.flex_dim[index])
    if at < 0 or dim == 1:
        return None
    which = corners
    if dim == 2 and hasattr(model, "flex_elemtexcoord"):
        which = model.flex_elemtexcoord[start : start + 3 * len(corners)].reshape(-1, 3)
    return np.ascontiguousarray(model.flex_texcoord[at + which], np.float32)


# --- skins ------------------------------------------------------------------------------------------------------------


def _read_skin(model: mujoco.MjModel, index: int) -> DrawnMesh:
    at, count = int(model.skin_vertadr[index]), int(model.skin_vertnum[index])
    first = int(model.skin_faceadr[index])
    faces = np.ascontiguousarray(model.skin_face[first : first + int(model.skin_facenum[index])], np.uint32)
    texcoord, material = int(model.skin_texcoordadr[index]), int(model.skin_matid[index])
    # Skins are computed on MuJoCo's drawing side, which needs no graphics for that.
    scene, option, camera = mujoco.MjvScene(model, 1), mujoco.MjvOption(), mujoco.MjvCamera()

    def read(data: Any) -> Vertices:
        mujoco.mjv_updateScene(model, data, option, None, camera, _NO_GEOMS, scene)
        return np.array(scene.skinvert, np.float32).reshape(-1, 3)[at : at + count]

    return DrawnMesh(
        stream=f"skin-{index}",
        name=read_name(model, "skin", index),
        dim=2,
        group=int(model.skin_group[index]),
        radius=0.0,
        flat=False,
        material=material,
        rgba=resolve_rgba(model, model.skin_rgba[index], material),
        elements=faces,
        uv=None if texcoord < 0 else np.ascontiguousarray(model.skin_texcoord[texcoord + faces], np.float32),
        numbers=None,
        topology=DeformableTopology(count, faces=faces).without_faces(),
        read_vertices=read,
    )


# --- tendons ----------------------------------------------------------------------------------------------------------


class _Path:
    """Path of one spatial tendon: its sites, and an arc for each shape that it may go around.

    Args:
        model: The model.
        tendon: Number of the tendon.
        first: Number of its first vertex.

    Attributes:
        edges: Pairs of vertices.
        sites: Vertices and the sites they are at.
        count: Number of vertices.
    """

    def __init__(self, model: mujoco.MjModel, tendon: int, first: int) -> None:
        start = int(model.tendon_adr[tendon])
        wraps = slice(start, start + int(model.tendon_num[tendon]))
        kinds, objects = model.wrap_type[wraps].tolist(), model.wrap_objid[wraps].tolist()
        self._tendon = tendon
        self._steps: list[tuple[int, int, int]] = []  # per wrap: its kind, geom and first vertex
        self.edges: list[tuple[int, int]] = []
        self.sites: list[tuple[int, int]] = []
        self.count = 0
        before = -1
        for kind, target in zip(kinds, objects, strict=True):
            points = 0 if kind == _PULLEY else len(_ARC) if kind in _AROUND else 1
            self._steps.append((kind, target, first + self.count))
            if kind == _PULLEY:  # the path ends here, and another begins
                before = -1
            for _ in range(points):
                vertex = first + self.count
                if kind == _SITE:
                    self.sites.append((vertex, target))
                if before >= 0:
                    self.edges.append((before, vertex))
                before = vertex
                self.count += 1
        self.is_straight = _AROUND.isdisjoint(kinds)

    def place(self, data: Any, out: Vertices) -> None:
        """Write the points around shapes; where the tendon does not touch one, they are at the site before it."""
        start, count = int(data.ten_wrapadr[self._tendon]), int(data.ten_wrapnum[self._tendon])
        touched = data.wrap_obj.reshape(-1)[start : start + count].tolist()
        points = data.wrap_xpos.reshape(-1, 3)[start : start + count]
        at = 0
        for kind, geom, row in self._steps:
            if kind not in _AROUND:
                at += 1
            elif touched[at : at + 2] == [geom, geom]:
                R_world_geom, p_world = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
                begin, end = (points[at : at + 2] - p_world) @ R_world_geom
                out[row : row + len(_ARC)] = _make_arc(kind, begin, end) @ R_world_geom.T + p_world
                at += 2
            else:
                out[row : row + len(_ARC)] = out[row - 1]


def _make_arc(kind: int, begin: Vertices, end: Vertices) -> Vertices:
    """Return points on the shorter way around a sphere, or a cylinder along z, in its frame [m]."""
    chord = begin + _ARC * (end - begin)
    across = chord[:, : 2 if kind == _CYLINDER else 3]
    length = np.linalg.norm(across, axis=1, keepdims=True)
    radius = length[0] + _ARC * (length[-1] - length[0])
    across *= np.divide(radius, length, out=np.ones_like(length), where=length > 0.0)
    return chord


def _read_tendons(model: mujoco.MjModel) -> list[DrawnMesh]:
    """Return the visible spatial tendons; those that look the same are one mesh."""
    alike: dict[tuple[Any, ...], list[int]] = {}
    for i in range(model.ntendon):
        start, material = int(model.tendon_adr[i]), int(model.tendon_matid[i])
        rgba = resolve_rgba(model, model.tendon_rgba[i], material)
        look = int(model.tendon_group[i]), float(model.tendon_width[i]), material, rgba
        is_spatial = model.wrap_type[start] == _SITE
        if is_spatial and look[0] in VIEWER_GROUPS and look[1] > 0.0 and rgba[3] > 0.0:
            alike.setdefault(look, []).append(i)
    return [_join_tendons(model, k, look, tendons) for k, (look, tendons) in enumerate(alike.items())]


def _join_tendons(model: mujoco.MjModel, number: int, look: tuple[Any, ...], tendons: list[int]) -> DrawnMesh:
    paths: list[_Path] = []
    count = 0
    for tendon in tendons:
        paths.append(_Path(model, tendon, count))
        count += paths[-1].count
    edges = np.array([edge for path in paths for edge in path.edges], np.uint32).reshape(-1, 2)
    vertices, sites = np.array([pair for path in paths for pair in path.sites]).T
    around = [path for path in paths if not path.is_straight]

    def read(data: Any) -> Vertices:
        out = np.empty((count, 3))
        out[vertices] = data.site_xpos[sites]
        for path in around:
            path.place(data, out)
        return out

    group, width, material, rgba = look
    return DrawnMesh(
        stream=f"tendon-{number}",
        name="",
        dim=1,
        group=group,
        radius=width,
        flat=False,
        material=material,
        rgba=rgba,
        elements=edges,
        uv=None,
        numbers=None,
        topology=DeformableTopology(count, edges=edges),
        read_vertices=read,
    )
