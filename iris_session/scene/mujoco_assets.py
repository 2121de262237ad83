"""Meshes, textures, height fields and deformables of a compiled MuJoCo model, as work for an `AssetBuilder`.

Everything is as MuJoCo's own renderer draws it: meshes without texture coordinates get creases
(`mesh_processing.CREASE`), with them the normals of the file; a texture coordinate (0, 0) is the upper left corner of
the image. Skins are not shared: MuJoCo moves their vertices by weighted bodies, on the drawing side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.names import ArrayFilter, ArrayKind, ArrayName, ColorSpace, TextureKind
from iris_session.protocol.scene import Deformable, HeightField, Mesh, Texture
from iris_session.scene.arrays import StoredArray, encode_arrays
from iris_session.scene.asset_builder import AssetBuilder, MeshNote, Work
from iris_session.scene.mesh_processing import CREASE, normalise
from iris_session.scene.meshes import MeshArrays, encode_deformable, index_corners
from iris_session.scene.mujoco_appearance import read_name, resolve_rgba
from iris_session.streams.deformable_topology import DeformableTopology, used_vertices

_KINDS: Final = {
    int(mujoco.mjtTexture.mjTEXTURE_2D): TextureKind.IMAGE,
    int(mujoco.mjtTexture.mjTEXTURE_CUBE): TextureKind.CUBE,
    int(mujoco.mjtTexture.mjTEXTURE_SKYBOX): TextureKind.SKYBOX,
}
_SPACES: Final = {0: ColorSpace.AUTO, 1: ColorSpace.LINEAR, 2: ColorSpace.SRGB}
_FACES: Final = 6


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
    kinds = [_KINDS.get(int(kind), TextureKind.IMAGE) for kind in model.tex_type]
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


# --- deformables ------------------------------------------------------------------------------------------------------


def stream_name(index: int) -> str:
    """Return the name of a flex's media stream, by its id."""
    return f"flex-{index}"


def read_deformables(model: mujoco.MjModel, data: Any, builder: AssetBuilder) -> tuple[Deformable, ...]:
    """Return all flexes, by id; `data` has the initial state, with kinematics."""
    parts = [read_flex_mesh(model, i) for i in range(model.nflex)]
    rest = [np.array(data.flexvert_xpos[part.vertices], np.float32) for part in parts]
    notes = builder.run(
        [
            builder.blob_work([b"flex", *part.raw, vertices], partial(part.encode, vertices))
            for part, vertices in zip(parts, rest, strict=True)
        ]
    )
    return tuple(
        Deformable(
            name=read_name(model, "flex", i),
            dim=int(model.flex_dim[i]),
            group=int(model.flex_group[i]),
            vertices=len(rest[i]),
            elements=len(parts[i].elements),
            radius=float(model.flex_radius[i]),
            flat=bool(model.flex_flatskin[i]),
            material=_find_flex_material(model, i),
            rgba=resolve_rgba(model, model.flex_rgba[i], _find_flex_material(model, i)),
            stream=stream_name(i),
            address=note.address,
            bytes=note.bytes,
        )
        for i, note in enumerate(notes)
    )


def _find_flex_material(model: mujoco.MjModel, index: int) -> int:
    """Return the material of a flex. Since MuJoCo 4 every element has one; models give all the same, so the first is
    used.
    """
    by_element = len(model.flex_matid) == model.nflexelem
    return int(model.flex_matid[int(model.flex_elemadr[index]) if by_element else index])


@dataclass(frozen=True)
class FlexMesh:
    """Drawn mesh of a flex.

    `elements`: edges (n, 2) of a rope, triangles (n, 3) of a cloth or of the surface of a soft body; `uv`: texture
    coordinates at the corners of each element, if any. `vertices`: rows of `flexvert_xpos`, without those inside of a
    solid; `numbers`: their numbers in the flex. `topology`: the plan of the stream.
    """

    elements: NDArray[np.uint32]
    uv: NDArray[np.float32] | None
    vertices: NDArray[np.int64]
    numbers: NDArray[np.int64]
    topology: DeformableTopology

    @property
    def raw(self) -> list[NDArray[Any]]:
        """Return the content that the asset depends on, besides the vertices at rest."""
        return [self.elements, self.numbers, *([] if self.uv is None else [self.uv])]

    def encode(self, rest: NDArray[np.float32]) -> bytes:
        """Return the asset, for vertices at rest (n, 3) [m], world frame."""
        numbers = self.numbers if len(self.numbers) <= int(self.numbers.max()) else None  # the inside is left out
        return encode_deformable(self.elements, self.uv, rest, self.topology, numbers)


def read_flex_mesh(model: mujoco.MjModel, index: int) -> FlexMesh:
    """Return the mesh of one flex, by its id."""
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
    return FlexMesh(
        np.ascontiguousarray(elements, np.uint32),
        _read_texture_coordinates(model, index, start, corners),
        int(model.flex_vertadr[index]) + used,
        used,
        DeformableTopology(len(used), **ends).without_faces(),
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
