"""Checks of the arguments of `SceneBuilder`: numbers, arrays, meshes, poses and appearance.

Every `SceneBuildError` names the argument and says what would be right.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, Final, TypedDict

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.common import IDENTITY, Pose, Quat, Vec3
from iris_session.protocol.scene import Rgba
from iris_session.scene.arrays import to_array
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.images import check_pixels, read_pixels
from iris_session.scene.importers.references import read_bounded
from iris_session.scene.mesh_processing import compute_creased_normals, normalise
from iris_session.scene.meshes import MeshArrays, index_corners
from iris_session.scene.nodes import GREY, MAX_TRIANGLES, Appearance, TextureImage, color_images

_STRENGTHS: Final = ("emission", "specular", "shininess", "metallic", "roughness")


class PlacementOptions(TypedDict, total=False):
    """Arguments of `SceneBuilder` that place something; see there."""

    position: Sequence[float]
    quaternion: Sequence[float]
    movable: bool
    on: str


class AppearanceOptions(TypedDict, total=False):
    """Arguments of `SceneBuilder` that say how something looks; see there. `None` is the default."""

    rgba: Sequence[float] | None
    texture: str | PathLike[str] | NDArray[np.uint8] | None
    metallic: float | None
    roughness: float | None
    emission: float | None
    specular: float | None
    shininess: float | None
    repeat: Sequence[float]
    uniform: bool


class DrawingOptions(PlacementOptions, AppearanceOptions, total=False):
    """Arguments of `SceneBuilder` for what is drawn at a place."""


def parse_appearance(options: AppearanceOptions | DrawingOptions, known: type = DrawingOptions) -> Appearance | None:
    """Return the appearance that arguments describe, `None` when all are defaults.

    Raises:
        SceneBuildError: A value is out of its range, or the texture cannot be read.
        TypeError: An argument is not one of `known`.
    """
    if unknown := [name for name in options if name not in known.__annotations__]:
        names = ", ".join(known.__annotations__)
        raise TypeError(f"unexpected argument {unknown[0]!r}: these are known: {names}")
    rgba, texture = options.get("rgba"), options.get("texture")
    across, down = check_numbers("repeat", options.get("repeat", (1.0, 1.0)), 2)
    uniform = bool(options.get("uniform", False))
    values: dict[str, Any] = {
        name: check_number(name, value) for name in _STRENGTHS if (value := options.get(name)) is not None
    }
    if rgba is None and texture is None and not values and (across, down) == (1.0, 1.0) and not uniform:
        return None
    color = (GREY if texture is None else (1.0, 1.0, 1.0, 1.0)) if rgba is None else _check_rgba(rgba)
    images = () if texture is None else color_images(TextureImage(check_texture(texture, "texture")))
    for name, value in values.items():
        if value < 0.0 or (value > 1.0 and name != "emission"):
            raise SceneBuildError(f"{name} is {value:g}: {'0 or more' if name == 'emission' else 'from 0 to 1'}")
    if "roughness" in values and "shininess" not in values:  # for clients that do not draw by roughness
        values["shininess"] = min(max(1.0 - values["roughness"], 0.0), 1.0)
    return replace(Appearance(rgba=color, images=images, repeat=(across, down), uniform=uniform), **values)


def _check_rgba(rgba: Any) -> Rgba:
    try:
        numbers = check_numbers("rgba", rgba, len(rgba))
    except (TypeError, SceneBuildError):
        numbers = ()
    if len(numbers) not in (3, 4) or not all(0.0 <= v <= 1.0 for v in numbers):
        raise SceneBuildError(f"rgba is {rgba!r}: red, green, blue, alpha from 0 to 1 are needed; (1, 0, 0, 1) is red")
    red, green, blue, alpha = (*numbers, 1.0)[:4]
    return red, green, blue, alpha


def check_texture(given: Any, what: str) -> NDArray[np.uint8]:
    """Return the pixels given, or those of the image whose path is given."""
    if isinstance(given, str | PathLike):
        path = check_path(given)
        if path.is_dir():
            raise SceneBuildError(f"{what} is {str(path)!r}, a folder: the path of a picture is needed, or pixels")
        return read_pixels(read_bounded(path), str(path))
    return check_pixels(given, what)


def check_path(path: Any) -> Path:
    """Return the path of a file."""
    try:
        return Path(os.fsdecode(path))
    except TypeError:
        raise SceneBuildError(f"path is {path!r}: the path of a file is needed, as text or a Path") from None


def check_numbers(
    what: str, values: Any, count: int, needed: str = "", *, above: float | None = None
) -> tuple[float, ...]:
    """Return `count` finite numbers, greater than `above`. `needed`: what they are, for the message."""
    try:
        found = tuple(check_number(what, v) for v in values)
    except (TypeError, SceneBuildError):
        found = ()
    if len(found) != count:
        raise SceneBuildError(f"{what} is {values!r}: {count} finite numbers {needed} are needed".replace("  ", " "))
    if above is not None and min(found) <= above:
        raise SceneBuildError(f"{what} is {values!r}: numbers greater than {above:g} are needed")
    return found


def check_number(what: str, value: Any, *, above: float | None = None) -> float:
    """Return one finite number, greater than `above`."""
    try:
        found = math.nan if isinstance(value, str | bytes) else float(value)  # though `float` takes their digits
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if not math.isfinite(found):
        raise SceneBuildError(f"{what} is {value!r}: a finite number is needed")
    if above is not None and found <= above:
        raise SceneBuildError(f"{what} is {value!r}: a number greater than {above:g} is needed")
    return found


def check_vertices(what: str, values: Any, width: int = 3, count: int | None = None) -> NDArray[np.float32]:
    """Return rows of finite float32, read-only."""
    needed = f"finite numbers of shape (n, {width}) are needed"
    given = to_array(values, what)
    if given.dtype.kind not in "biuf":
        raise SceneBuildError(f"{what}: an array of {given.dtype} of shape {given.shape}: {needed}")
    with np.errstate(over="ignore"):  # what float32 cannot hold is not finite then
        array = np.array(given, np.float32)
    if array.ndim != 2 or array.shape[1] != width or not len(array) or not np.isfinite(array).all():
        raise SceneBuildError(f"{what}: an array of shape {array.shape}: {needed}")
    if count is not None and len(array) != count:
        raise SceneBuildError(f"{what}: {len(array)} rows for {count} vertices: one each is needed")
    array.setflags(write=False)
    return array


def check_triangles(what: str, values: Any, vertices: int, width: int = 3) -> NDArray[np.uint32]:
    """Return rows of vertex numbers."""
    array = to_array(values, what)
    if array.ndim != 2 or array.shape[1] != width or not len(array) or array.dtype.kind not in "iu":
        raise SceneBuildError(
            f"{what}: an array {array.shape} of {array.dtype}: whole numbers of shape (m, {width}) are needed, at "
            "least one row"
        )
    if len(array) > MAX_TRIANGLES:
        raise SceneBuildError(f"{what}: {len(array)} rows: at most {MAX_TRIANGLES:,}")
    low, high = int(array.min()), int(array.max())
    if low < 0 or high >= vertices:
        wrong = low if low < 0 else high
        raise SceneBuildError(f"{what}: vertex {wrong} of {vertices}: numbers go from 0 to {vertices - 1}")
    return np.ascontiguousarray(array, np.uint32)


def check_mesh(whose: str, vertices: Any, triangles: Any, normals: Any, uvs: Any, colors: Any) -> MeshArrays:
    """Return a mesh of arrays per vertex. `whose`: its name in messages."""
    points = check_vertices(f"vertices of {whose}", vertices)
    index = check_triangles(f"triangles of {whose}", triangles, len(points)).astype(np.int64)
    if normals is None:
        across = compute_creased_normals(points.astype(np.float64), index).astype(np.float32)
    else:
        across = np.asarray(
            normalise(check_vertices(f"normals of {whose}", normals, 3, len(points)))[index], np.float32
        )
    uv = None if uvs is None else check_vertices(f"uvs of {whose}", uvs, 2, len(points))[index]
    color = None
    if colors is not None:
        array = to_array(colors, f"colors of {whose}")
        if array.dtype != np.uint8 or array.ndim != 2 or array.shape[1] not in (3, 4) or len(array) != len(points):
            raise SceneBuildError(
                f"colors of {whose}: {array.shape} of {array.dtype}: ({len(points)}, 3 or 4) of uint8"
            )
        if array.shape[1] == 3:
            array = np.concatenate([array, np.full((len(array), 1), 255, np.uint8)], axis=1)
        color = array[index]
    return index_corners(points[index], across, uv, color)


def check_pose(position: Any, quaternion: Any) -> Pose:
    """Return a pose with the quaternion normalised. Raises `SceneBuildError`."""
    x, y, z = check_numbers("position", position, 3, "(x, y, z) [m]")
    p: Vec3 = (x, y, z)
    q = check_numbers("quaternion", quaternion, 4, "(w, x, y, z)")
    length = math.hypot(*q)
    if not 1e-9 <= length < math.inf:
        raise SceneBuildError(
            f"quaternion is {quaternion!r}, of length {length:g}: (w, x, y, z) of length 1; (1, 0, 0, 0) turns nothing"
        )
    unit: Quat = (q[0] / length, q[1] / length, q[2] / length, q[3] / length)
    return IDENTITY if (p, unit) == (IDENTITY.p, IDENTITY.q) else Pose(p, unit)
