"""What callers give as arrays and numbers, checked: every refusal says what would be right."""

from __future__ import annotations

import difflib
import functools
import inspect
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, Final, TypedDict, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.common import IDENTITY, Pose, Quat, Vec3
from iris_session.protocol.names import TextureRole
from iris_session.scene.arrays import array_of
from iris_session.scene.elements import GREY, MAX_TRIANGLES, Look, Picture
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.images import checked_pixels, read_pixels
from iris_session.scene.importers.references import read_bounded
from iris_session.scene.mesh_processing import creased_normals, unit
from iris_session.scene.meshes import MeshArrays, index_corners

_NUMBERS: Final = ("emission", "specular", "shininess", "metallic", "roughness")


class Looks(TypedDict, total=False):
    """How something looks. `rgba`: 0..1. `texture`: a path, or pixels (height, width, 1, 3 or 4) uint8, first row on
    top, which the colour multiplies. `metallic`, `roughness`, `emission`, `specular`, `shininess`: as in `Material`.
    `repeat`: how often the texture lies on a shape, or on a metre where `uniform`.
    """

    rgba: Sequence[float]
    texture: str | PathLike[str] | NDArray[np.uint8]
    metallic: float
    roughness: float
    emission: float
    specular: float
    shininess: float
    repeat: Sequence[float]
    uniform: bool


#: What other libraries call an option.
_ELSEWHERE: Final = {
    "color": "rgba",
    "colour": "rgba",
    "pos": "position",
    "translation": "position",
    "xyz": "position",
    "quat": "quaternion",
    "orientation": "quaternion",
    "rotation": "quaternion",
    "parent": "on",
    "size": "half_size",
}


class _UntilGiven:
    """What `help` shows of a keyword without a value of its own."""

    def __repr__(self) -> str:
        return "..."


_UNTIL_GIVEN: Final = _UntilGiven()
Method = TypeVar("Method", bound=Callable[..., Any])


def takes(options: type[Any] | None = None) -> Callable[[Method], Method]:
    """Of a method, with `**options` or without: a keyword that it does not have, nor the dictionary type `options`, is
    a `TypeError` that names the nearest one; what it was to do would be left undone. `help` shows them one by one."""

    def wrap(method: Method) -> Method:
        signature = inspect.signature(method)
        own = [one for one in signature.parameters.values() if one.kind is not one.VAR_KEYWORD]
        given = [
            inspect.Parameter(
                name,
                inspect.Parameter.KEYWORD_ONLY,
                default=_UNTIL_GIVEN,
                annotation=getattr(kind, "__forward_arg__", kind),
            )
            for name, kind in (options.__annotations__ if options else {}).items()
        ]
        known = [one.name for one in (*own, *given) if one.name != "self"]

        @functools.wraps(method)
        def checked(*values: Any, **named: Any) -> Any:
            for name in named:
                if name not in known:
                    raise TypeError(f"{method.__name__}() has no keyword {name}: {_meant(name, known)}")
            return method(*values, **named)

        checked.__signature__ = signature.replace(parameters=[*own, *given])  # type: ignore[attr-defined]
        return cast(Method, checked)

    return wrap


def _meant(name: str, known: Sequence[str]) -> str:
    same = _ELSEWHERE.get(name)
    near = [same] if same in known else difflib.get_close_matches(name, known, n=1)
    return f"{near[0]} is meant" if near else f"there are {', '.join(sorted(known))}"


def look_of(options: Mapping[str, Any]) -> Look | None:
    """The look that the options ask for, `None` where they ask for none."""
    if not options.keys() & Looks.__annotations__.keys():
        return None
    default = (1.0, 1.0, 1.0, 1.0) if "texture" in options else GREY
    given = options.get("rgba", default)
    short = hasattr(given, "__len__") and len(given) == 3
    try:
        red, green, blue, alpha = (*numbers("rgba", given, 3 if short else 4), 1.0)[:4]
    except SceneBuildError:
        red = green = blue = alpha = -1.0
    if not all(0.0 <= v <= 1.0 for v in (red, green, blue, alpha)):
        raise SceneBuildError(f"rgba is {given!r}: red, green, blue, alpha from 0 to 1 are needed; (1, 0, 0, 1) is red")
    across, down = numbers("repeat", options.get("repeat", (1.0, 1.0)), 2)
    pictures: tuple[tuple[str, Picture], ...] = ()
    if "texture" in options:
        pixels = texture_of(options["texture"], "texture")
        pictures = ((TextureRole.RGBA if pixels.shape[2] == 4 else TextureRole.RGB, Picture(pixels)),)
    values: dict[str, Any] = {name: number(name, options[name])[0] for name in _NUMBERS if name in options}
    for name, value in values.items():
        if value < 0.0 or (value > 1.0 and name != "emission"):
            raise SceneBuildError(f"{name} is {value:g}: {'0 or more' if name == 'emission' else 'from 0 to 1'}")
    if "roughness" in values and "shininess" not in values:  # for clients that do not draw by roughness
        values["shininess"] = min(max(1.0 - values["roughness"], 0.0), 1.0)
    plain = Look(
        rgba=(red, green, blue, alpha),
        pictures=pictures,
        repeat=(across, down),
        uniform=bool(options.get("uniform", False)),
    )
    return replace(plain, **values)


def texture_of(given: Any, what: str) -> NDArray[np.uint8]:
    """Pixels, or those of the picture whose path is given."""
    if isinstance(given, str | PathLike):
        path = path_of(given)
        if path.is_dir():
            raise SceneBuildError(f"{what} is {str(path)!r}, a folder: the path of a picture is needed, or pixels")
        return read_pixels(read_bounded(path), str(path))
    return checked_pixels(given, what)


def path_of(path: Any) -> Path:
    """Where a file is."""
    try:
        return Path(os.fsdecode(path))
    except TypeError:
        raise SceneBuildError(f"path is {path!r}: the path of a file is needed, as text or a Path") from None


def numbers(what: str, values: Any, count: int, *, above: float | None = None) -> tuple[float, ...]:
    """As many finite numbers, greater than `above`."""
    try:
        texts = isinstance(values, str | bytes)  # whose digits would be taken for numbers
        found = tuple(float(_no_text(v)) for v in ((None,) if texts else values))
    except (TypeError, ValueError, OverflowError):
        raise SceneBuildError(f"{what} is {values!r}: {count} numbers are needed") from None
    if len(found) != count or not np.isfinite(found).all():
        raise SceneBuildError(f"{what} is {values!r}: {count} finite numbers are needed")
    if above is not None and min(found) <= above:
        raise SceneBuildError(f"{what} is {values!r}: numbers greater than {above:g} are needed")
    return found


def number(what: str, value: Any, needed: str = "a number is needed", *, above: float | None = None) -> tuple[float]:
    """One finite number, greater than `above`."""
    try:
        found = float(_no_text(value))
    except (TypeError, ValueError, OverflowError):
        raise SceneBuildError(f"{what} is {value!r}: {needed}") from None
    if not np.isfinite(found):
        raise SceneBuildError(f"{what} is {value!r}: a finite number is needed")
    if above is not None and found <= above:
        raise SceneBuildError(f"{what} is {value!r}: a number greater than {above:g} is needed")
    return (found,)


def _no_text(value: Any) -> Any:
    return None if isinstance(value, str | bytes) else value


def given_vertices(what: str, values: Any, width: int = 3, count: int | None = None) -> NDArray[np.float32]:
    """Rows of finite float32, read-only."""
    needed = f"finite numbers of shape (n, {width}) are needed"
    try:
        given = np.asarray(values)
    except (TypeError, ValueError):
        raise SceneBuildError(f"{what}: rows that are no array: {needed}") from None
    if given.dtype.kind not in "biuf":
        kind = "texts" if given.dtype.kind in "US" else f"an array of {given.dtype}"
        raise SceneBuildError(f"{what}: {kind} of shape {given.shape}: {needed}")
    with np.errstate(over="ignore"):  # what float32 cannot hold is not finite then
        array = np.array(given, np.float32)
    if array.ndim != 2 or array.shape[1] != width or not len(array) or not np.isfinite(array).all():
        raise SceneBuildError(f"{what}: an array of shape {array.shape}: {needed}")
    if count is not None and len(array) != count:
        raise SceneBuildError(f"{what}: {len(array)} rows for {count} vertices: one each is needed")
    array.setflags(write=False)
    return array


def triangles_of(what: str, values: Any, vertices: int, width: int = 3) -> NDArray[np.uint32]:
    """Rows of vertex numbers."""
    array = array_of(values, what)
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


def given_mesh(whose: str, vertices: Any, triangles: Any, normals: Any, uvs: Any, colors: Any) -> MeshArrays:
    """A mesh of arrays per vertex; `whose` they are, for error texts."""
    points = given_vertices(f"vertices of {whose}", vertices)
    index = triangles_of(f"triangles of {whose}", triangles, len(points)).astype(np.int64)
    if normals is None:
        across = creased_normals(points.astype(np.float64), index).astype(np.float32)
    else:
        across = np.asarray(unit(given_vertices(f"normals of {whose}", normals, 3, len(points)))[index], np.float32)
    uv = None if uvs is None else given_vertices(f"uvs of {whose}", uvs, 2, len(points))[index]
    color = None
    if colors is not None:
        array = array_of(colors, f"colors of {whose}")
        if array.dtype != np.uint8 or array.ndim != 2 or array.shape[1] not in (3, 4) or len(array) != len(points):
            raise SceneBuildError(
                f"colors of {whose}: {array.shape} of {array.dtype}: ({len(points)}, 3 or 4) of uint8"
            )
        if array.shape[1] == 3:
            array = np.concatenate([array, np.full((len(array), 1), 255, np.uint8)], axis=1)
        color = array[index]
    return index_corners(points[index], across, uv, color)


def checked_pose(position: Any, quaternion: Any) -> Pose:
    """A pose of what a caller gave; the quaternion is normalised. Raises `SceneBuildError` for what is none."""
    x, y, z = _finite("position", position, 3, "(x, y, z) [m]")
    p: Vec3 = (x, y, z)
    q = _finite("quaternion", quaternion, 4, "(w, x, y, z)")
    length = math.hypot(*q)
    if not 1e-9 <= length < math.inf:
        raise SceneBuildError(
            f"quaternion is {quaternion!r}, of length {length:g}: (w, x, y, z) of length 1; (1, 0, 0, 0) turns nothing"
        )
    unit: Quat = (q[0] / length, q[1] / length, q[2] / length, q[3] / length)
    return IDENTITY if (p, unit) == (IDENTITY.p, IDENTITY.q) else Pose(p, unit)


def _finite(what: str, values: Any, count: int, names: str) -> list[float]:
    try:
        found = [float(v) for v in ([] if isinstance(values, str | bytes) else values)]  # digits are no numbers
    except (TypeError, ValueError):
        found = []
    if len(found) != count or not np.isfinite(found).all():
        raise SceneBuildError(f"{what} is {values!r}: {count} finite numbers {names} are needed")
    return found
