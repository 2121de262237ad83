"""What the Rerun viewer draws of a MuJoCo model: visible geoms as primitives and meshes, each fixed in a named frame.

A frame is `world` or the name of a streamed body that moves; the recording moves frames, never geometry. Geoms of
groups 0 to 2 are visible, as in MuJoCo's own viewer. Flexes, skins, height fields and SDF geoms are not drawn.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.server_messages import BodyInfo

WORLD: Final = "world"
VISIBLE_GROUPS: Final = 3
#: Half edge [m] at which an infinite plane is drawn, and half its drawn thickness.
INFINITE_PLANE_M: Final = 10.0
PLANE_HALF_THICKNESS_M: Final = 0.0005

BOX: Final = "box"
ELLIPSOID: Final = "ellipsoid"
CAPSULE: Final = "capsule"
CYLINDER: Final = "cylinder"
MESH: Final = "mesh"

_PRIMITIVES: Final = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): BOX,
    int(mujoco.mjtGeom.mjGEOM_BOX): BOX,
    int(mujoco.mjtGeom.mjGEOM_SPHERE): ELLIPSOID,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): ELLIPSOID,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): CAPSULE,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): CYLINDER,
    int(mujoco.mjtGeom.mjGEOM_MESH): MESH,
}


class Shape(msgspec.Struct, frozen=True):
    """One geom. `p`, `q` `[w, x, y, z]`: `T_frame_geom`. `rgba`: 0 to 255.

    `size`: half sizes (box, ellipsoid), or radius and half length along z (capsule, cylinder) [m], unused for meshes.
    `vertices` (nv, 3) float32 [m], `normals` (nv, 3), `faces` (nf, 3): meshes only.
    """

    name: str
    body: str
    frame: str
    kind: str
    p: tuple[float, float, float]
    q: tuple[float, float, float, float]
    rgba: tuple[int, int, int, int]
    size: tuple[float, ...] = ()
    vertices: NDArray[np.float32] | None = None
    normals: NDArray[np.float32] | None = None
    faces: NDArray[np.int32] | None = None


def load_model(mjb: bytes) -> Any:
    """A `MjModel` from its binary form. Raises `ValueError` when MuJoCo does not take the bytes."""
    fd, name = tempfile.mkstemp(suffix=".mjb")
    try:
        with os.fdopen(fd, "wb") as file:
            file.write(mjb)
        return mujoco.MjModel.from_binary_path(name)
    finally:
        Path(name).unlink(missing_ok=True)


def shapes(model: Any, bodies: Sequence[BodyInfo]) -> list[Shape]:
    """The visible geoms of `model`, fixed in the frames of the moving ones among `bodies`."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    frames = _frames(model, bodies)
    names = {body.id: body.name for body in bodies}
    out = []
    for geom in range(model.ngeom):
        kind = _PRIMITIVES.get(int(model.geom_type[geom]))
        rgba = _rgba(model, geom)
        if kind is None or rgba[3] == 0 or int(model.geom_group[geom]) >= VISIBLE_GROUPS:
            continue
        body = int(model.geom_bodyid[geom])
        frame_body, frame = frames[body]
        p, q = _pose_in(data, frame_body, geom)
        name = mujoco.mj_id2name(model, int(mujoco.mjtObj.mjOBJ_GEOM), geom) or f"geom{geom}"
        shape = Shape(name, names.get(body, WORLD), frame, kind, p, q, rgba, _size(model, geom))
        if kind == MESH:
            shape = _with_mesh(model, geom, shape)
        out.append(shape)
    return out


def _frames(model: Any, bodies: Sequence[BodyInfo]) -> list[tuple[int, str]]:
    """For every body of the model: the nearest moving streamed body at or above it, as (id, frame name)."""
    moving = {body.id: body.name for body in bodies if body.moving}
    out: list[tuple[int, str]] = [(0, WORLD)]
    for body in range(1, model.nbody):
        name = moving.get(body)
        out.append((body, name) if name is not None else out[int(model.body_parentid[body])])
    return out


def _pose_in(data: Any, body: int, geom: int) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    """`T_body_geom` from the kinematics at hand."""
    R_world_body = data.xmat[body].reshape(3, 3)
    p = R_world_body.T @ (data.geom_xpos[geom] - data.xpos[body])
    q = np.empty(4)
    mujoco.mju_mat2Quat(q, (R_world_body.T @ data.geom_xmat[geom].reshape(3, 3)).ravel())
    return (float(p[0]), float(p[1]), float(p[2])), (float(q[0]), float(q[1]), float(q[2]), float(q[3]))


def _size(model: Any, geom: int) -> tuple[float, ...]:
    a, b, c = (float(v) for v in model.geom_size[geom])
    kind = int(model.geom_type[geom])
    if kind == int(mujoco.mjtGeom.mjGEOM_PLANE):
        return (a or INFINITE_PLANE_M, b or INFINITE_PLANE_M, PLANE_HALF_THICKNESS_M)
    if kind == int(mujoco.mjtGeom.mjGEOM_SPHERE):
        return (a, a, a)
    if kind in {int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)}:
        return (a, b)
    return (a, b, c)


def _rgba(model: Any, geom: int) -> tuple[int, int, int, int]:
    """Colour of the geom: its own, times its material's; a textured material counts with its texture's mean colour."""
    rgba = np.array(model.geom_rgba[geom], float)
    material = int(model.geom_matid[geom])
    if material >= 0:
        # A geom without a colour of its own has MuJoCo's default grey, which gives way to the material.
        if np.allclose(rgba, (0.5, 0.5, 0.5, 1.0)):
            rgba[:] = 1.0
        rgba = rgba * model.mat_rgba[material]
        rgba[:3] *= _texture_mean(model, material)
    values = [int(v) for v in np.clip(np.rint(rgba * 255.0), 0, 255)]
    return values[0], values[1], values[2], values[3]


def _texture_mean(model: Any, material: int) -> NDArray[np.float64]:
    textures = [int(t) for t in np.atleast_1d(model.mat_texid[material]) if t >= 0]
    if not textures:
        return np.ones(3)
    texture = textures[0]
    channels = int(model.tex_nchannel[texture])
    begin = int(model.tex_adr[texture])
    n = int(model.tex_height[texture]) * int(model.tex_width[texture]) * channels
    if channels < 3 or n == 0:
        return np.ones(3)
    texels = np.asarray(model.tex_data[begin : begin + n]).reshape(-1, channels)
    return np.asarray(texels[:, :3].mean(axis=0) / 255.0, float)


def _with_mesh(model: Any, geom: int, shape: Shape) -> Shape:
    """Adds the triangles. Corners that share position and normal are one vertex, so that sharp edges stay sharp."""
    mesh = int(model.geom_dataid[geom])
    v0, nv = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    f0, nf = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    n0, nn = int(model.mesh_normaladr[mesh]), int(model.mesh_normalnum[mesh])
    faces = np.asarray(model.mesh_face[f0 : f0 + nf])
    corners = np.stack([faces.ravel(), np.asarray(model.mesh_facenormal[f0 : f0 + nf]).ravel()], axis=1)
    pairs, index = np.unique(corners, axis=0, return_inverse=True)
    return msgspec.structs.replace(
        shape,
        vertices=np.asarray(model.mesh_vert[v0 : v0 + nv], np.float32)[pairs[:, 0]],
        normals=np.asarray(model.mesh_normal[n0 : n0 + nn], np.float32)[pairs[:, 1]],
        faces=np.ascontiguousarray(index.reshape(-1, 3), np.int32),
    )
