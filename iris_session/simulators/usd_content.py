"""Content of USD prims: meshes by material, shapes and points, as `SceneBuilder` takes them.

Texture coordinates of USD have v up, ours have v down.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.names import GeometryKind
from iris_session.protocol.scene import Geometry
from iris_session.scene.builder import AppearanceOptions, SceneBuilder, check_mesh
from iris_session.scene.meshes import MeshArrays
from iris_session.scene.nodes import split_rigid
from iris_session.scene.shapes import build_primitive
from iris_session.simulators.adapter import Floats
from iris_session.simulators.usd_looks import read_look, to_srgb_bytes

#: Scales of a shape that differ by less are equal.
_EQUAL: Final = 1e-6
#: Corners of the base of a cone.
_CONE_CORNERS: Final = 32
#: Rotation from the z axis, along which our shapes lie, to the axis of a prim.
_FROM_AXIS: Final = {
    "X": np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]),
    "Y": np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
    "Z": np.eye(4),
}


class Part(NamedTuple):
    """A mesh with one material. `look`: its appearance."""

    mesh: MeshArrays
    look: AppearanceOptions


class Shape(NamedTuple):
    """A shape of `GeometryKind` along z. `turn` (4, 4): from its frame to that of the prim."""

    kind: str
    size: tuple[float, float, float]
    turn: Floats


def read_points(prim: Any, time: Any) -> Floats:
    """Return the points of a mesh, (n, 3), in its own frame and the stage's unit."""
    from pxr import UsdGeom

    return np.array(UsdGeom.PointBased(prim).GetPointsAttr().Get(time) or [], np.float64).reshape(-1, 3)


def read_triangles(prim: Any, time: Any) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return vertices (m, 3), corners (m, 3) among all corners of the faces, and the face of each triangle (m,)."""
    from pxr import UsdGeom

    mesh = UsdGeom.Mesh(prim)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(time) or [], np.int64)
    index = np.array(mesh.GetFaceVertexIndicesAttr().Get(time) or [], np.int64)
    holes = np.array(mesh.GetHoleIndicesAttr().Get(time) or [], np.int64)
    starts = np.cumsum(counts) - counts
    fans = np.maximum(counts - 2, 0)
    fans[holes[holes < len(fans)]] = 0
    face = np.repeat(np.arange(len(counts)), fans)
    step = np.arange(len(face)) - np.repeat(np.cumsum(fans) - fans, fans)  # of the fan, from 0
    corners = np.stack([starts[face], starts[face] + step + 1, starts[face] + step + 2], axis=-1)
    if mesh.GetOrientationAttr().Get(time) == UsdGeom.Tokens.leftHanded:
        corners = corners[:, [0, 2, 1]]
    return index[corners], corners, face


def read_mesh_parts(prim: Any, time: Any) -> Iterator[Part]:
    """Yield the parts of a mesh, one for each material that is bound to it or to subsets of its faces.

    Raises `SceneBuildError` for a mesh that has none or refers to points that it does not have.
    """
    from pxr import UsdGeom, UsdShade

    points = read_points(prim, time)
    triangles, corners, face = read_triangles(prim, time)
    uvs = _read_corner_values(prim, ("st", "UVMap", "st0", "st_0"), triangles, corners, face, 2)
    colors = _read_corner_values(prim, ("displayColor",), triangles, corners, face, 3, constant=False)
    owners: list[tuple[Any, NDArray[np.bool_]]] = []
    rest = np.ones(len(face), bool)
    for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
        chosen = np.isin(face, np.array(UsdGeom.Subset(subset).GetIndicesAttr().Get(time) or [], np.int64))
        owners.append((subset.GetPrim(), chosen & rest))
        rest &= ~chosen
    for owner, mask in [(prim, rest), *owners]:
        if not mask.any() and owners:
            continue
        look = read_look(owner, prim)
        uv = None if uvs is None or "texture" not in look else uvs[mask]
        color = None if colors is None or "rgba" in look or "texture" in look else to_srgb_bytes(colors[mask])
        yield Part(_weld(prim.GetName(), points, triangles[mask], uv, color), look)


def _weld(
    name: str, points: Floats, triangles: NDArray[np.int64], uv: Floats | None, color: NDArray[np.uint8] | None
) -> MeshArrays:
    """Return a mesh of values at corners; corners with equal values are one vertex."""
    if uv is None and color is None:
        return check_mesh(f"mesh {name!r}", points, triangles, None, None, None)
    columns = [triangles.reshape(-1, 1).astype(np.float64)]
    columns += [] if uv is None else [uv.reshape(-1, 2)]
    columns += [] if color is None else [color.reshape(-1, 3).astype(np.float64)]
    rows, index = np.unique(np.concatenate(columns, axis=1), axis=0, return_inverse=True)
    at = rows[:, 0].astype(np.int64)
    if len(at) and at.max() >= len(points):
        return check_mesh(f"mesh {name!r}", points, triangles, None, None, None)  # which says so
    uvs = None if uv is None else np.stack([rows[:, 1], 1.0 - rows[:, 2]], axis=-1)
    colors = None if color is None else rows[:, -3:].astype(np.uint8)
    return check_mesh(f"mesh {name!r}", points[at], index.reshape(-1, 3), None, uvs, colors)


def _read_corner_values(
    prim: Any,
    names: tuple[str, ...],
    triangles: NDArray[np.int64],
    corners: NDArray[np.int64],
    face: NDArray[np.int64],
    width: int,
    *,
    constant: bool = True,
) -> Floats | None:
    """Return values of a primvar at the corners of triangles, (m, 3, width); `None` where there is none."""
    from pxr import UsdGeom

    api = UsdGeom.PrimvarsAPI(prim)
    for name in names:
        primvar = api.FindPrimvarWithInheritance(name)
        if not primvar or not primvar.HasValue():
            continue
        values = np.array(primvar.ComputeFlattened(), np.float64).reshape(-1, width)
        where = primvar.GetInterpolation()
        at = {"vertex": triangles, "varying": triangles, "faceVarying": corners, "uniform": face[:, None]}.get(where)
        if at is None:
            at = np.zeros((len(face), 1), np.int64) if constant else None
        if at is None or (len(at) and at.max() >= len(values)):
            return None
        return np.broadcast_to(values[at], (len(face), 3, width))
    return None


def read_shape(prim: Any, time: Any) -> Shape | None:
    """Return a cube, sphere, cylinder, capsule or plane; `None` for another prim."""

    def get(name: str) -> Any:
        return prim.GetAttribute(name).Get(time)

    kind = prim.GetTypeName()
    if kind == "Cube":
        half = 0.5 * float(get("size"))
        return Shape(GeometryKind.BOX, (half, half, half), np.eye(4))
    if kind == "Sphere":
        radius = float(get("radius"))
        return Shape(GeometryKind.SPHERE, (radius, radius, radius), np.eye(4))
    if kind in ("Cylinder", "Capsule"):
        radius, half = float(get("radius")), 0.5 * float(get("height"))
        known = GeometryKind.CYLINDER if kind == "Cylinder" else GeometryKind.CAPSULE
        return Shape(known, (radius, radius, half), _FROM_AXIS[str(get("axis"))])
    if kind == "Plane":
        sides = (0.5 * float(get("width")), 0.5 * float(get("length")), 1.0)
        return Shape(GeometryKind.PLANE, sides, _FROM_AXIS[str(get("axis"))])
    return None


def read_cone(prim: Any, time: Any) -> MeshArrays:
    """Return a cone as a mesh in the frame of its prim."""
    radius, half = float(prim.GetAttribute("radius").Get(time)), 0.5 * float(prim.GetAttribute("height").Get(time))
    angle = np.arange(_CONE_CORNERS) * (2.0 * math.pi / _CONE_CORNERS)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(_CONE_CORNERS, -half)], axis=-1)
    points = np.concatenate([ring, [[0.0, 0.0, half], [0.0, 0.0, -half]]])
    here = np.arange(_CONE_CORNERS)
    after, top, below = (
        (here + 1) % _CONE_CORNERS,
        np.full_like(here, _CONE_CORNERS),
        np.full_like(here, _CONE_CORNERS + 1),
    )
    sides, base = np.stack([here, after, top], -1), np.stack([after, here, below], -1)
    turned = points @ _FROM_AXIS[str(prim.GetAttribute("axis").Get(time))][:3, :3].T
    return check_mesh(f"cone {prim.GetName()!r}", turned, np.concatenate([sides, base]), None, None, None)


def find_joint_trees(stage: Any, moving: Container[Any]) -> Iterator[tuple[Any, list[Any], list[int], list[bool]]]:
    """Yield trees of moving prims that joints connect: root, links, number of each one's parent, whether it moves.

    Args:
        stage: The stage.
        moving: Paths of what moves.
    """
    from pxr import UsdPhysics

    children: dict[Any, list[tuple[Any, bool]]] = {}
    held = set()
    for prim in stage.Traverse():
        if not prim.IsA(UsdPhysics.Joint):
            continue
        joint = UsdPhysics.Joint(prim)
        ends = [rel.GetForwardedTargets() for rel in (joint.GetBody0Rel(), joint.GetBody1Rel())]
        if all(ends) and ends[0][0] in moving and ends[1][0] in moving:
            children.setdefault(ends[0][0], []).append((ends[1][0], not prim.IsA(UsdPhysics.FixedJoint)))
            held.add(ends[1][0])
    for root in [path for path in children if path not in held]:
        links, parents, moves = [root], [-1], [False]
        for at, path in enumerate(links):  # grows
            for child, is_moving in children.get(path, ()):
                if child not in links:
                    links.append(child)
                    parents.append(at)
                    moves.append(is_moving)
        yield root, links, parents, moves


def add_shape(scene: SceneBuilder, name: str, shape: Shape, T_body_shape: Floats, on: str, look: Any) -> None:
    """Add a shape whose transform may scale and shear: as a shape where one fits, else as its mesh."""
    pose, rest = split_rigid(T_body_shape)
    stretch = np.eye(3) if rest is None else rest
    scale = np.abs(np.diagonal(stretch))
    size = np.array(shape.size) * scale
    is_round = shape.kind in (GeometryKind.SPHERE, GeometryKind.CAPSULE, GeometryKind.CYLINDER)
    even = bool(np.ptp(scale[:2]) <= _EQUAL * scale.max())
    fits = float(np.abs(stretch - np.diag(np.diagonal(stretch))).max()) <= _EQUAL * scale.max()
    if is_round:
        fits &= even and (shape.kind == GeometryKind.CYLINDER or bool(np.ptp(scale) <= _EQUAL * scale.max()))
    if not fits:
        mesh = build_primitive(Geometry(shape.kind, shape.size))
        assert mesh is not None
        scene.add_mesh_arrays(name, mesh, transform=T_body_shape, on=on, **look)
        return
    place = {"position": pose.p, "quaternion": pose.q, "on": on, **look}
    match shape.kind:
        case GeometryKind.BOX:
            scene.add_box(name, half_size=size.tolist(), **place)
        case GeometryKind.SPHERE:
            scene.add_sphere(name, radius=size[0], **place)
        case GeometryKind.CYLINDER:
            scene.add_cylinder(name, radius=size[0], half_length=size[2], **place)
        case GeometryKind.CAPSULE:
            scene.add_capsule(name, radius=size[0], half_length=size[2], **place)
        case GeometryKind.PLANE:
            scene.add_plane(name, half_size=size[:2].tolist(), **place)
