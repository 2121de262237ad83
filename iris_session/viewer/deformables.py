"""Deformables in the picture of a recording: topology once, then vertices with every frame received.

Cloths and surfaces of soft bodies are meshes, ropes are lines. The viewer shades by normals but computes none, so they
are in the file beside the positions. A surface without a texture has a checker pattern, by which folds are seen.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from iris_session.protocol.scene import Deformable
from iris_session.scene import AssetDecodeError
from iris_session.scene.arrays import require_array
from iris_session.scene.meshes import normalise
from iris_session.streams.deformable import DeformableDecoder
from iris_session.streams.deformable_topology import DeformableTopology
from iris_session.streams.errors import StreamError
from iris_session.viewer.scene_geometry import Pixels, Rgba8, to_rgba8

#: Fields of the checker pattern along the longest side of a surface, and the grey of the dark ones.
CHECKERS: Final = 6
DARK: Final = 165

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


class DrawnDeformable:
    """One deformable. `arrays`: arrays of its asset. Raises `AssetDecodeError` if they do not fit the deformable."""

    def __init__(
        self,
        entity: str,
        deformable: Deformable,
        arrays: dict[str, NDArray[Any]],
        texture: Pixels | None = None,
    ) -> None:
        corners = 2 if deformable.dim == 1 else 3
        self.entity = entity
        self._rest: Floats = require_array(arrays, "position", "f4", (None, 3))
        elements = require_array(arrays, "elements", "u2 u4", (None, corners)).astype(np.int64)
        if elements.size and int(elements.max()) >= len(self._rest):
            raise AssetDecodeError(f"deformable {deformable.name!r} has no vertex {int(elements.max())}")
        try:
            topology = DeformableTopology.from_bytes(require_array(arrays, "plan", "u1", (None,)).tobytes())
        except StreamError as error:
            raise AssetDecodeError(f"deformable {deformable.name!r}: {error}") from error
        if topology.n_vertices != len(self._rest):
            raise AssetDecodeError(f"deformable {deformable.name!r}: {topology.n_vertices} vertices are streamed")
        self._decoder = DeformableDecoder(topology)
        self._last: Floats = self._rest
        self._radius, self._colour = deformable.radius, to_rgba8(deformable.rgba)
        self._form: _Lines | _Surface
        if deformable.dim == 1:
            self._form = _Lines(elements)
        else:
            uv = require_array(arrays, "uv", "f4", (len(elements), 3, 2)) if "uv" in arrays else None
            self._form = _Surface(elements, uv, texture)

    def build_components(self) -> list[Any]:
        """Return the Rerun components that do not change, and the vertices at rest."""
        return [self._form.build_components(self._rest, self._colour, self._radius)]

    def decode_frame(self, frame: bytes) -> Floats | None:
        """Decode a frame of the stream: vertices (n, 3) [m], `None` if unchanged. Raises `StreamError`."""
        vertices = np.nan_to_num(self._decoder.decode(frame), copy=False, nan=0.0, posinf=0.0, neginf=0.0)
        if np.array_equal(vertices, self._last):
            return None
        self._last = vertices
        return vertices

    def build_columns(self, rows: list[Floats]) -> Any:
        """Return the columns for `rerun.send_columns`, one row per result of `decode_frame`."""
        return self._form.build_columns(np.stack(rows))


def build_checker(rest: Floats) -> NDArray[np.uint8]:
    """Return colours of vertices (n, 3) in a checker pattern of their rest positions, by which folds are seen."""
    low = rest.min(axis=0, initial=np.inf)
    size = float(np.ptp(rest, axis=0).max(initial=0.0)) if len(rest) else 0.0
    cell = np.floor((rest - low) / (size / CHECKERS or 1.0) + 1e-3).astype(np.int64)
    grey = np.where(cell.sum(axis=1) % 2, DARK, 255).astype(np.uint8)
    return np.repeat(grey[:, None], 3, axis=1)


class _Lines:
    """A rope: one line per edge."""

    def __init__(self, edges: Ints) -> None:
        self._edges = edges

    def build_components(self, rest: Floats, rgba: Rgba8, radius: float) -> Any:
        return rr.LineStrips3D(strips=rest[self._edges], radii=[radius], colors=[rgba])

    def build_columns(self, vertices: Floats) -> Any:
        strips = vertices[:, self._edges]
        columns = rr.LineStrips3D.columns(strips=strips.reshape(-1, 2, 3))
        return columns.partition([len(self._edges)] * len(vertices))


class _Surface:
    """A surface of triangles. A vertex whose texture coordinates differ between triangles is repeated."""

    def __init__(self, triangles: Ints, uv: Floats | None, texture: Pixels | None) -> None:
        self._uv, self._texture = uv, texture
        self._source: Ints | None = None
        self._corners = triangles
        self._drawn = triangles
        flat = triangles.ravel()
        self._order = np.argsort(flat, kind="stable")
        self._owners, self._starts = np.unique(flat[self._order], return_index=True)
        if uv is not None and texture is not None:
            rows = np.column_stack([flat, uv.reshape(-1, 2)])
            different, index = np.unique(rows, axis=0, return_inverse=True)
            self._source, self._drawn = different[:, 0].astype(np.int64), index.reshape(-1, 3)
            self._uv = different[:, 1:].astype(np.float32)

    def build_components(self, rest: Floats, rgba: Rgba8, radius: float) -> Any:
        position, normal = self._arranged(rest)
        colours = {} if self._source is not None else {"vertex_colors": build_checker(rest)}
        worn = {} if self._source is None else {"vertex_texcoords": self._uv, "albedo_texture": self._texture}
        return rr.Mesh3D(
            vertex_positions=position,
            vertex_normals=normal,
            triangle_indices=self._drawn.astype(np.uint32),
            albedo_factor=rgba,
            **colours,
            **worn,
        )

    def build_columns(self, vertices: Floats) -> Any:
        both = [self._arranged(row) for row in vertices]
        columns = rr.Mesh3D.columns(
            vertex_positions=np.concatenate([position for position, _ in both]),
            vertex_normals=np.concatenate([normal for _, normal in both]),
        )
        return columns.partition([len(position) for position, _ in both])

    def _arranged(self, vertices: Floats) -> tuple[Floats, Floats]:
        normal = self._normals(vertices)
        return (vertices, normal) if self._source is None else (vertices[self._source], normal[self._source])

    def _normals(self, vertices: Floats) -> Floats:
        """Return vertex normals: the area-weighted mean of the normals of adjacent triangles."""
        normal = np.zeros_like(vertices)
        if len(self._starts):
            a, b, c = (vertices[self._corners[:, k]] for k in range(3))
            across = np.cross(b - a, c - a)
            normal[self._owners] = np.add.reduceat(across[self._order // 3], self._starts, axis=0)
        return normalise(normal).astype(np.float32)
