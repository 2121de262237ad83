"""Elements of a scene before it is built: nodes of files, surfaces, appearances, textures, drawn items; plain values.

Frames: the matrix of a node leads to the frame of the file, with its scale. Colours are sRGB and texture coordinates
have v down, as in the specification.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from anchors.lie import quat_from_matrix, quat_to_matrix
from iris_session.protocol.common import MAX_TEXT, Pose, Quat, Vec3
from iris_session.protocol.names import ColorSpace, GeometryKind, TextureKind, TextureRole
from iris_session.protocol.scene import Camera, Light, Rgba, Vec2
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.images import Pixels
from iris_session.scene.meshes import MeshArrays

#: Maximum size of a file, and of each file that it refers to [bytes].
MAX_FILE_BYTES: Final = 512 << 20
#: Maximum number of triangles and of nodes of one file.
MAX_TRIANGLES: Final = 20_000_000
MAX_NODES: Final = 100_000
#: Default colour.
GREY: Final[Rgba] = (0.5, 0.5, 0.5, 1.0)
#: Scales further than this from the identity are applied to the vertices.
_RIGID: Final = 1e-9
#: Significant digits of a scale.
_DIGITS: Final = 12
Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TextureImage:
    """Image of a texture. `pixels` (height, width, 1, 3 or 4); of a cube six faces below one another."""

    pixels: Pixels
    name: str = ""
    kind: str = TextureKind.IMAGE
    colorspace: str = ColorSpace.AUTO


def color_images(image: TextureImage) -> tuple[tuple[str, TextureImage], ...]:
    """Return an image as the colour of an appearance."""
    return ((TextureRole.RGBA if image.pixels.shape[2] == 4 else TextureRole.RGB, image),)


@dataclass(frozen=True, eq=False)
class Appearance:
    """Appearance of a surface: fields as in `Material`, which it becomes unless it is a colour only.

    `images`: (role, image) pairs.
    """

    rgba: Rgba = GREY
    name: str = ""
    emission: float = 0.0
    specular: float = 0.5
    shininess: float = 0.5
    metallic: float = -1.0
    roughness: float = -1.0
    images: tuple[tuple[str, TextureImage], ...] = ()
    repeat: Vec2 = (1.0, 1.0)
    uniform: bool = False

    @property
    def is_plain_color(self) -> bool:
        """True if all values but the colour are defaults."""
        surface = (self.emission, self.specular, self.shininess, self.metallic, self.roughness)
        return not self.images and surface == (0.0, 0.5, 0.5, -1.0, -1.0)


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles with one appearance."""

    mesh: MeshArrays
    appearance: Appearance | None = None
    name: str = ""


@dataclass(eq=False)
class Node:
    """Node of a file. `matrix` (4, 4): T_file_node. `parent`: index of an earlier node, -1 for none.

    The `lights` and `cameras` are at its origin and look along -z; their bodies are not yet known.
    """

    name: str = ""
    parent: int = -1
    matrix: Matrix = field(default_factory=lambda: np.eye(4))
    surfaces: list[Surface] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    cameras: list[Camera] = field(default_factory=list)


@dataclass(eq=False)
class DrawnItem:
    """Item drawn on body `body` (index in a list of bodies, -1 for the world): a `mesh`, or a shape of `kind` and
    `size`.

    Kind and size are as in `Geometry`. `matrix` (4, 4): T_body_item, of meshes with scale.
    """

    body: int
    name: str
    matrix: Matrix
    appearance: Appearance
    mesh: MeshArrays | None = None
    kind: str = GeometryKind.MESH
    size: Vec3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LoadedFile:
    """Content of a file: nodes, parents first. `up`: its up axis, `y` or `z`.

    `unit`: its unit of length [m]. `skipped`: content that the specification cannot hold, one line each.
    """

    nodes: tuple[Node, ...]
    up: str = "z"
    unit: float = 1.0
    skipped: tuple[str, ...] = ()


def split_rigid(matrix: Matrix) -> tuple[Pose, Matrix | None]:
    """Split `matrix` (4, 4) into a pose and the rest of its linear part (3, 3), which is applied first.

    The rest is scale, shear or reflection, `None` when it is the identity. Raises `SceneBuildError` for a matrix that
    flattens or is not finite.
    """
    if not is_solid(matrix):
        raise SceneBuildError("a scale is 0: give every axis one")
    turn = np.asarray(matrix[:3, :3], np.float64)
    U, scale, Vt = np.linalg.svd(turn)
    R = U @ Vt
    if np.linalg.det(R) < 0:
        R = -R
    digits = _DIGITS - math.floor(math.log10(float(scale[0])))
    rest = np.round(R.T @ turn, digits) + 0.0  # so that equal scales at different angles share one mesh
    rigid = bool(np.abs(rest - np.eye(3)).max() <= _RIGID)
    return to_pose(R, matrix[:3, 3]), None if rigid else rest


def is_solid(matrix: Matrix) -> bool:
    """Return whether `matrix` keeps all three dimensions. Raises `SceneBuildError` for one that is not finite."""
    if not np.isfinite(matrix).all():
        raise SceneBuildError("a place in the file is not finite")
    scale = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    return bool(scale[-1] > 1e-12 * max(1.0, float(scale[0])))


def to_pose(R: NDArray[np.float64], p: Any) -> Pose:
    """Return the pose of a rotation matrix (3, 3) and a position."""
    w, i, j, k = quat_from_matrix(np.asarray(R, np.float64)).tolist()
    return Pose(to_vec3(p), (w, i, j, k))


def orient(back: NDArray[np.float64], up: ArrayLike, default: Quat) -> Quat:
    """Return the rotation of a frame whose z axis is `back`, with its y axis close to `up`.

    `default`: rotation where these are parallel.
    """
    side = np.cross(np.asarray(up, np.float64), back)
    if np.linalg.norm(side) <= 1e-9:
        return default
    side /= np.linalg.norm(side)
    w, x, y, z = quat_from_matrix(np.stack([side, np.cross(back, side), back], axis=1)).tolist()
    return w, x, y, z


def to_vec3(p: Any) -> Vec3:
    """Return the first three values of an array."""
    x, y, z = (float(v) for v in p[:3])
    return x, y, z


def to_matrix(pose: Pose) -> Matrix:
    """Return the matrix (4, 4) of a pose."""
    matrix = np.eye(4)
    matrix[:3, :3] = quat_to_matrix(np.array(pose.q))
    matrix[:3, 3] = pose.p
    return matrix


def truncate_name(name: object) -> str:
    """Return a name that the wire can hold: not too long, without lone surrogates (JSON may have them)."""
    return str(name)[:MAX_TEXT].encode("utf-8", "replace").decode() if name is not None else ""
