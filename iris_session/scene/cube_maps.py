"""Cube textures for formats without them (glTF, Rerun): the six faces in one image, and texture coordinates in it.

MuJoCo looks up a direction at every pixel; here the directions become texture coordinates at corners. Triangles are cut
where the direction crosses from one face of the cube to another, and split until straight lines in the image are close
to what MuJoCo draws. Adjacent triangles are cut and split alike, so that no gaps open between them. docs/scene.md has
the formulas.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iris_session.assets.store import AssetStore
from iris_session.protocol.names import AssetEncoding, GeometryKind, TextureKind
from iris_session.protocol.scene import Geometry, SceneSpec, Texture
from iris_session.scene.errors import AssetDecodeError
from iris_session.scene.images import Pixels, decode_image, halve
from iris_session.scene.meshes import MeshArrays, index_corners, normalise

#: Maximum side of a face in an exported file [pixels]: headsets can load six of them in one image.
CUBE_SIDE: Final = 2_048
#: Maximum error of a texture coordinate, in sides of a face.
TOLERANCE: Final = 1 / 128
#: Maximum number of times that an edge is halved: near the centre, directions vary without bound.
_DEPTH: Final = 8
_FACES: Final = 6
#: Share of a direction's length below which it counts as on the edge between two faces, or as zero.
_EDGE: Final = 1e-6
#: Per face the dominant axis, its sign, and the axes and signs of right and down: OpenGL's cube maps.
_AXES: Final = (
    (0, 1, 2, -1, 1, -1),
    (0, -1, 2, 1, 1, -1),
    (1, 1, 0, 1, 2, 1),
    (1, -1, 0, 1, 2, -1),
    (2, 1, 0, 1, 1, -1),
    (2, -1, 0, -1, 1, -1),
)
Floats = NDArray[np.float64]


class Atlas(NamedTuple):
    """Six faces in one image.

    `pixels`: two rows of three faces, each with a border that repeats the adjacent faces, so that filtering does not
    mix in neighbouring faces of the image. `side`, `border`: of a face [pixels].
    """

    pixels: Pixels
    side: int
    border: int

    def to_uv(self, face: NDArray[np.int64], on_face: Floats) -> Floats:
        """Convert coordinates on faces to coordinates in the image, 0..1 (..., 2)."""
        cell = self.side + 2 * self.border
        corner = np.stack([face % 3, face // 3], axis=-1) * cell + self.border
        return (corner + np.clip(on_face, 0.0, 1.0) * self.side) / [3 * cell, 2 * cell]


class CubeMap(NamedTuple):
    """Cube texture of a visual: one colour (0..1), or an atlas.

    `address`: of the source asset. `encoding`: suitable for export, PNG or JPEG.
    """

    address: str
    encoding: str
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    atlas: Atlas | None = None


class CubeMapReader:
    """Reader of the cube textures of a specification, each read once.

    `max_side`: maximum side of a face [pixels]; larger textures are read in a coarser level. Raises `SceneBuildError`
    for missing or damaged assets.
    """

    def __init__(self, spec: SceneSpec, store: AssetStore, max_side: int) -> None:
        self._spec = spec
        self._store = store
        self._max_side = max_side
        self._read: dict[str, CubeMap] = {}

    def find(self, material: int, geometry: Geometry) -> CubeMap | None:
        """Return the cube texture of a visual.

        `None` without one, and for a mesh with texture coordinates: MuJoCo draws no cube there.
        """
        index = find_cube_texture(self._spec, material)
        textured = geometry.mesh >= 0 and self._spec.meshes[geometry.mesh].textured
        return None if index < 0 or textured else self._read_texture(self._spec.textures[index])

    def _read_texture(self, texture: Texture) -> CubeMap | None:
        levels = [level for level in texture.levels if level.encoding != AssetEncoding.OPAQUE]
        if not levels:
            return None
        level = next((level for level in levels if level.width <= self._max_side), levels[-1])
        if level.address not in self._read:
            pixels = decode_image(self._store.get(level.address), level.encoding)
            encoding = AssetEncoding.JPEG if level.encoding == AssetEncoding.JPEG else AssetEncoding.PNG
            self._read[level.address] = _with_atlas(CubeMap(level.address, encoding), pixels, self._max_side)
        return self._read[level.address]


def find_cube_texture(spec: SceneSpec, material: int) -> int:
    """Return the cube texture of a material's colour, -1 without one."""
    index = -1 if material < 0 else spec.materials[material].find_texture()
    return -1 if index < 0 or spec.textures[index].kind == TextureKind.IMAGE else index


def _with_atlas(cube: CubeMap, pixels: Pixels, max_side: int) -> CubeMap:
    """Return a cube map with the atlas, or with the one colour, of six faces below one another."""
    if not len(pixels) == _FACES * pixels.shape[1] > 0:
        raise AssetDecodeError(
            f"a cube texture of {pixels.shape[1]} x {len(pixels)} pixels: expected six squares below one another"
        )
    faces = pixels.reshape(_FACES, len(pixels) // _FACES, *pixels.shape[1:])
    if bool((faces == faces[:1, :1, :1]).all()) and (faces.shape[3] < 4 or faces[0, 0, 0, 3] == 255):
        red, green, blue = np.resize(faces[0, 0, 0, : 3 if faces.shape[3] >= 3 else 1] / 255.0, 3).tolist()
        return cube._replace(tint=(red, green, blue))
    while faces.shape[2] > max_side:
        faces = np.stack([halve(face) for face in faces])
    side = faces.shape[2]
    border = max(2, side // 16)
    return cube._replace(atlas=Atlas(_join_cells(_add_borders(faces, border)), side, border))


def _join_cells(cells: Pixels) -> Pixels:
    return np.concatenate([np.concatenate(list(cells[k : k + 3]), axis=1) for k in (0, 3)])


def _add_borders(faces: Pixels, border: int) -> Pixels:
    """Return faces with borders, which show the adjacent faces."""
    side = faces.shape[1]
    cells = np.pad(faces, ((0, 0), (border, border), (border, border), (0, 0)))
    at = (np.arange(-border, side + border) + 0.5) / side * 2 - 1
    down, right = np.nonzero(np.maximum(np.abs(at)[:, None], np.abs(at)[None]) > 1)
    for cell, (lead, sign, u, u_sign, v, v_sign) in zip(cells, _AXES, strict=True):
        direction = np.empty((len(down), 1, 3))
        direction[:, 0, lead] = sign
        direction[:, 0, u] = u_sign * at[right]
        direction[:, 0, v] = v_sign * at[down]
        face = np.stack([_face_distances(direction, k).min(axis=(1, 2)) for k in range(_FACES)], axis=1).argmax(axis=1)
        x, y = np.clip((_face_coordinates(direction, face)[0][:, 0] * side).astype(int), 0, side - 1).T
        cell[down, right] = faces[face, y, x]
    return cells


def direction_scale(spec: SceneSpec, geometry: Geometry, material: int) -> tuple[float, float, float]:
    """Return the factors that turn positions in a visual's frame into directions."""
    x, y, z = geometry.size
    uniform = spec.materials[material].uniform
    if geometry.kind == GeometryKind.PLANE:  # 0: infinite; no direction when both are
        return (x, y, 1.0) if uniform and (x or y) else (1.0, 1.0, 1.0)
    if geometry.hfield >= 0:
        _, _, top, base = spec.hfields[geometry.hfield].size
        return (x, y, 0.25 * top + 0.5 * base) if uniform else (1.0, 1.0, 1.0)
    if geometry.mesh >= 0:
        return (x, y, z) if uniform else (1.0, 1.0, 1.0)
    if uniform:
        return (1.0, 1.0, 1.0)
    return (1 / x if x else 1.0, 1 / y if y else 1.0, 1 / z if z else 1.0)


def bake_cube_map(mesh: MeshArrays, geometry: Geometry, scale: tuple[float, float, float], atlas: Atlas) -> MeshArrays:
    """Return `mesh` cut and split, with coordinates in `atlas`. `scale`: result of `direction_scale`."""
    columns = np.concatenate([mesh.position, mesh.normal, *([] if mesh.color is None else [mesh.color])], axis=1)
    rest = columns[mesh.index].astype(np.float64)
    direction = rest[:, :, :3] * scale
    if geometry.kind == GeometryKind.CAPSULE:
        direction = _capsule_directions(rest[:, :, :3], direction, geometry.size)
    corners, face = _cut_at_faces(np.concatenate([direction, rest], axis=2))
    corners, face, on_face = _split_triangles(corners, face)
    position, normal, color = corners[:, :, 3:6], normalise(corners[:, :, 6:9]), None
    if mesh.color is not None:
        color = np.rint(corners[:, :, 9:13]).astype(np.uint8)
    uv = atlas.to_uv(np.repeat(face[:, None], 3, axis=1), on_face)
    return index_corners(position.astype(np.float32), normal.astype(np.float32), uv.astype(np.float32), color)


def _capsule_directions(position: Floats, direction: Floats, size: tuple[float, float, float]) -> Floats:
    """Return directions of a capsule: MuJoCo looks up caps as if cylinder and half spheres all had a half length of 1.

    `uniform` stretches them alike.
    """
    radius, _, half = size
    middle = position[:, :, 2].mean(axis=1)
    cap = np.abs(middle) > half
    end = np.sign(middle[cap])[:, None]
    stretch = direction[cap, :, 2] / position[cap, :, 2] * half
    found = direction.copy()
    found[cap, :, 2] = ((position[cap, :, 2] - end * half) / radius + end) * stretch
    return found


def _cut_at_faces(corners: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Return triangles that face one side of the cube each, and which side. The first three columns are directions."""
    length = np.abs(corners[:, :, :3]).max(axis=(1, 2))
    margin = np.stack([_face_distances(corners, k).min(axis=(1, 2)) for k in range(_FACES)], axis=1)
    face = margin.argmax(axis=1)
    whole = margin.max(axis=1) >= -_EDGE * length
    found, faces = [corners[whole]], [face[whole]]
    for k in range(_FACES):
        part, count = corners[~whole], np.full(int((~whole).sum()), 3)
        for side in range(4):
            distance = _face_distances(part, k)[:, :, side]
            distance[np.abs(distance) < _EDGE * length[~whole][:, None]] = 0.0
            part, count = _clip_polygons(part, count, distance)
        for last in range(2, part.shape[1]):
            fan = part[count > last][:, [0, last - 1, last]]
            found.append(fan)
            faces.append(np.full(len(fan), k))
    return np.concatenate(found), np.concatenate(faces)


def _face_distances(corners: Floats, face: int) -> Floats:
    """Return distances of directions inside the four planes that bound a face (..., 4)."""
    lead, sign, right, _, down, _ = _AXES[face]
    ahead = sign * corners[..., lead]
    a, b = corners[..., right], corners[..., down]
    return np.stack([ahead - a, ahead + a, ahead - b, ahead + b], axis=-1)


def _clip_polygons(polygon: Floats, count: NDArray[np.int64], distance: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Return the part of convex polygons (n, m, columns) with non-negative distance.

    `count`: number of the m corners that each polygon has.
    """
    m = polygon.shape[1]
    slot = np.arange(m)[None]
    after = np.where(slot + 1 < count[:, None], slot + 1, 0)
    beyond, following = np.take_along_axis(distance, after, 1), np.take_along_axis(polygon, after[:, :, None], 1)
    crossed = (slot < count[:, None]) & (distance * beyond < 0)
    gap = np.where(crossed, distance - beyond, 1.0)[:, :, None]
    crossing = (distance[:, :, None] * following - beyond[:, :, None] * polygon) / gap  # symmetric in both ends
    used = np.stack([(slot < count[:, None]) & (distance >= 0), crossed], axis=2).reshape(-1, 2 * m)
    order = np.argsort(~used, axis=1, kind="stable")[:, : m + 1]
    points = np.stack([polygon, crossing], axis=2).reshape(-1, 2 * m, polygon.shape[2])
    return np.take_along_axis(points, order[:, :, None], 1), used.sum(axis=1)


def _face_coordinates(direction: Floats, face: NDArray[np.int64]) -> tuple[Floats, NDArray[np.bool_]]:
    """Return coordinates on faces (n, k, 2), 0..1 right and down, and a mask of the valid ones: the centre has none."""
    lead, sign, right, right_sign, down, down_sign = np.array(_AXES)[face].T
    row = np.arange(len(face))
    ahead = sign[:, None] * direction[row, :, lead]
    there = ahead > _EDGE * np.abs(direction).max(axis=(1, 2), initial=0.0)[:, None]
    depth = np.where(there, ahead, 1.0)
    u, v = (s[:, None] * direction[row, :, axis] / depth for axis, s in ((right, right_sign), (down, down_sign)))
    return (np.stack([u, v], axis=2) + 1) / 2, there


def _split_triangles(corners: Floats, face: NDArray[np.int64]) -> tuple[Floats, NDArray[np.int64], Floats]:
    """Split triangles until the coordinates in the middles of their edges are within `TOLERANCE` of exact ones.

    Returns them with their faces, and the coordinates of their corners. Each edge is judged alone, as for its other
    triangle.
    """
    done: list[tuple[Floats, NDArray[np.int64], Floats]] = []
    for depth in range(_DEPTH + 1):
        on_face, there = _face_coordinates(corners[:, :, :3], face)
        middles = (corners + corners[:, [1, 2, 0]]) / 2
        exact, _ = _face_coordinates(middles[:, :, :3], face)
        following, known = on_face[:, [1, 2, 0]], there & there[:, [1, 2, 0]]
        error = np.abs(exact - (on_face + following) / 2).max(axis=2)
        # A corner at the centre takes the mean of the others, which must then be close to each other.
        fan = np.where(there.all(axis=1, keepdims=True), 0.0, np.abs(following - on_face).max(axis=2) / 2)
        error = np.where(known, np.maximum(error, fan), 0.0)
        cut = error > (TOLERANCE if depth < _DEPTH else np.inf)
        stay = cut.sum(axis=1) == 0
        others = (on_face * there[:, :, None]).sum(axis=1) / np.maximum(there.sum(axis=1), 1)[:, None]
        uv = np.where(there[:, :, None], on_face, others[:, None])
        done.append((corners[stay], face[stay], uv[stay]))
        if bool(stay.all()):
            break
        corners, which = _split_edges(corners[~stay], middles[~stay], cut[~stay])
        face = face[~stay][which]
    return (
        np.concatenate([part[0] for part in done]),
        np.concatenate([part[1] for part in done]),
        np.concatenate([part[2] for part in done]),
    )


def _split_edges(corners: Floats, middles: Floats, cut: NDArray[np.bool_]) -> tuple[Floats, NDArray[np.int64]]:
    """Split triangles at the middles of their cut edges (0-1, 1-2, 2-0); return them with the index of their source."""
    n_cut = cut.sum(axis=1)
    # Corners are rotated so that a single cut edge is the first one, and of two cut edges the last one is uncut.
    first = np.where(n_cut == 1, cut.argmax(axis=1), np.where(n_cut == 2, ((~cut).argmax(axis=1) + 1) % 3, 0))
    turn = (first[:, None] + np.arange(3)) % 3
    points = np.concatenate(
        [np.take_along_axis(part, turn[:, :, None], 1) for part in (corners, middles)], axis=1
    )  # 0, 1, 2: corners; 3, 4, 5: the middles after them
    found, which = [], []
    for n, triangles in (
        (1, ((0, 3, 2), (3, 1, 2))),
        (2, ((3, 1, 4), (0, 3, 4), (0, 4, 2))),
        (3, ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))),
    ):
        chosen = np.flatnonzero(n_cut == n)
        for triangle in triangles:
            found.append(points[chosen][:, triangle])
            which.append(chosen)
    return np.concatenate(found), np.concatenate(which)
