"""Notes on likely mistakes of units in a file: lengths not in metres, limits not in radians, colours not from 0 to 1.

They are questions, one line each, never errors: halls are large, and some wheels turn far. The advice in them can be
copied as it is to replace the present value.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iris_session.scene.extent import LARGEST_M, SMALLEST_M, find_unit_mistake, format_length
from iris_session.scene.meshes import MeshArrays
from iris_session.scene.nodes import Matrix
from iris_session.scene.result import Joint

#: Limits of a joint that are hardly radians: more than three turns one way [rad], and at most 2.5 turns in degrees.
#: Larger values are a common way to write "no limit".
_FAR_RAD: Final = 20.0
_FAR_DEGREES: Final = 900.0
#: Tolerance for colours above 1 by rounding.
_ABOVE_ONE: Final = 1e-3
_BYTE: Final = 255.0
#: Upper bound of the growth of an axis-aligned bounding box when the box in it is rotated.
_TURNED: Final = 3.0**0.5


class Drawn(NamedTuple):
    """One mesh or shape of a URDF.

    Attributes:
        what: Description for messages.
        side_m: Its longest side in the file [m].
        scale: Scale of its `<mesh>`, 1 by default; `None` for a shape, whose sizes are in the file.
    """

    what: str
    side_m: float
    scale: tuple[float, float, float] | None = None


def measure_side(placed: Sequence[tuple[MeshArrays, Matrix]]) -> float:
    """Return the longest side of the bounding box of meshes with their poses (4, 4) [m]; 0 without meshes.

    When the size is clearly plausible, the bounding boxes of the meshes are used instead of their vertices.
    """
    rough = _side(_corners(mesh) @ T[:3, :3].T + T[:3, 3] for mesh, T in placed if mesh.vertices)
    if _TURNED * SMALLEST_M <= rough <= LARGEST_M:
        return rough
    return _side(mesh.position.astype(np.float64) @ T[:3, :3].T + T[:3, 3] for mesh, T in placed if mesh.vertices)


def file_question(name: str, side_m: float, scale: Sequence[float]) -> tuple[str, ...]:
    """Return a note when a file drawn `side_m` large, with the given `scale`, is likely in another unit."""
    mistake = find_unit_mistake(side_m)
    return () if mistake is None else (f"{name} is {_describe_mistake(side_m, mistake, _by_scale(scale, mistake[0]))}",)


def robot_question(name: str, reach_m: float, drawn: Sequence[Drawn], scale: float) -> tuple[str, ...]:
    """Return a note when a URDF is likely in another unit.

    Args:
        name: Name of the file.
        reach_m: Extent of the origins of its links, in the file [m].
        drawn: Its meshes and shapes.
        scale: Scale by which it is drawn.
    """
    largest = max(drawn, key=lambda one: one.side_m, default=Drawn("shape", 0.0))
    side_m, reach_m = scale * largest.side_m, scale * reach_m
    of_drawn, of_joints = find_unit_mistake(side_m), find_unit_mistake(reach_m)
    alike = of_drawn == of_joints or not reach_m
    if of_drawn is not None and (alike and (reach_m or scale != 1.0)):
        return (f"{name} is {_describe_mistake(max(side_m, reach_m), of_drawn, _by_scale([scale], of_drawn[0]))}",)
    if of_drawn is None and of_joints is not None and (scale != 1.0 or of_joints[0] < 1.0):
        remedy = _by_scale([scale], of_joints[0]) if scale != 1.0 else "xyz of their <origin> divided by 1,000"
        return (f"{name}: its joints reach over {_describe_mistake(reach_m, of_joints, remedy, large='')}",)
    if of_drawn is None:
        return ()
    return (
        f"{name}: its largest {largest.what} is {_describe_mistake(side_m, of_drawn, _in_file(largest, of_drawn[0]))}",
    )


def measure_reach(joints: Iterable[Any], root: str) -> float:
    """Return the longest side of the box around the origins of all links in the file, joints at 0 [m]."""
    below: dict[str, list[Any]] = {}
    for joint in joints:
        below.setdefault(joint.parent, []).append(joint)
    origins, waiting = [np.zeros(3)], [(root, np.eye(4))]
    while waiting:
        link, T_root_link = waiting.pop()
        for joint in below.get(link, []):
            T_root_child = T_root_link if joint.origin is None else T_root_link @ joint.origin
            origins.append(T_root_child[:3, 3])
            waiting.append((joint.child, T_root_child))
    return float(np.ptp(origins, axis=0).max())


def degrees_question(name: str, joints: Iterable[Joint]) -> tuple[str, ...]:
    """Return a note on joints whose limits are hardly radians."""
    odd = [
        joint
        for joint in joints
        if joint.kind == "revolute" and _FAR_RAD < max(abs(joint.low), abs(joint.high)) <= _FAR_DEGREES
    ]
    if not odd:
        return ()
    first = odd[0]
    which = f"joint {first.name}" if len(odd) == 1 else f"{len(odd)} joints, as {first.name},"
    right = f"{math.radians(first.low):.4g} to {math.radians(first.high):.4g}"
    return (
        f"{name}: limits of {which} are {first.low:g} to {first.high:g} rad: degrees where radians are meant? "
        f"Then it is {right}",
    )


def colour_question(name: str, material: str, rgba: Sequence[float]) -> tuple[str, ...]:
    """Return a note on a colour that is not from 0 to 1."""
    if min(rgba) >= 0.0 and max(rgba) <= 1.0 + _ABOVE_ONE:
        return ()
    given = " ".join(f"{v:g}" for v in rgba)
    said = (
        f"{name}: rgba of material {material!r} is {given}, drawn as the nearest numbers from 0 to 1, which are meant"
    )
    if min(rgba) < 0.0 or max(rgba) > _BYTE:
        return (said,)
    *color, alpha = rgba
    right = [v / _BYTE for v in color] if max(color) > 1.0 + _ABOVE_ONE else color
    right.append(alpha / _BYTE if alpha > 1.0 + _ABOVE_ONE else alpha)
    return (f"{said}; divided by 255 it is {' '.join(f'{v:.3g}' for v in right)}",)


def _describe_mistake(side_m: float, mistake: tuple[float, str], remedy: str, large: str = " large") -> str:
    factor, what = mistake
    return f"{format_length(side_m)}{large}: {what} {remedy} makes it {format_length(factor * side_m)}"


def _by_scale(given: Sequence[float], factor: float) -> str:
    """Return advice on the scale that makes content drawn by `given` larger by `factor`."""
    whole = [factor * one for one in given]
    if all(math.isclose(one, 1.0) for one in whole):
        return "leaving out scale (--scale)"
    text = f"{whole[0]:g}"
    found = f"scale={text} (--scale {text})"
    if len(set(whole)) > 1:
        found = f"scale=({', '.join(f'{one:g}' for one in whole)})"
    before = {f"{one:g}" for one in given} - {"1"}
    return found + (" in place of the present one" if before else "")


def _in_file(drawn: Drawn, factor: float) -> str:
    if drawn.scale is None:
        return f"its sizes {'divided' if factor < 1.0 else 'multiplied'} by 1,000"
    whole = [factor * one for one in drawn.scale]
    if all(math.isclose(one, 1.0) for one in whole):
        return "leaving out scale at its <mesh>"
    return f'scale="{" ".join(f"{one:g}" for one in whole)}" at its <mesh>'


def _corners(mesh: MeshArrays) -> NDArray[np.float64]:
    """Return the corners (8, 3) of the bounding box of a mesh."""
    low, high = mesh.position.min(axis=0), mesh.position.max(axis=0)
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])], float)


def _side(points: Iterable[NDArray[np.float64]]) -> float:
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for some in points:
        low, high = np.minimum(low, some.min(axis=0)), np.maximum(high, some.max(axis=0))
    return float((high - low).max()) if bool((low <= high).all()) else 0.0
