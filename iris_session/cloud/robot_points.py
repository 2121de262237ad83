"""Points that lie on the robots of the session, to be left out of a cloud: clients draw the robots themselves.

Each body gets a grid of cells in its own frame, once: the distance from its visible surface. For a cloud the points
near a body are moved into its frame and looked up. What a gripper holds stays: of an object that the session knows
every point that is nearer to it than to the robot, of another one all but what is within the margin of the fingers.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from anchors.camera import pose_to_matrix
from iris_session.cloud.pipeline import BodyPose
from iris_session.cloud.voxels import Positions
from iris_session.protocol.names import GeometryKind
from iris_session.protocol.scene import FIRST_SITE_VISUAL, Body, SceneSpec, Visual
from iris_session.protocol.server_messages import BodyInfo, RobotInfo
from iris_session.scene.meshes import MeshArrays
from iris_session.scene.nodes import to_matrix
from iris_session.scene.shapes import build_primitive

Floats = npt.NDArray[np.float64]
Distances = npt.NDArray[np.uint8]
#: Depth, calibration and the time between a picture and the state together move a point by about this much [m].
MARGIN_M: Final = 0.02
#: Edge of a cell of a body's grid [m]; larger where a body would have more than `_MAX_CELLS`.
_CELL_M: Final = 0.005
_MAX_CELLS: Final = 4_000_000
#: Beyond the margin; distances are in millimetres.
_FAR: Final = 255
#: Pieces that the longest edge of a triangle is cut into, at most: 2.5 m of a robot.
_MAX_PIECES: Final = 512


def find_robot_bodies(spec: SceneSpec, robots: Iterable[RobotInfo]) -> tuple[Body, ...]:
    """Return the bodies of robots: each base and everything below it.

    Args:
        spec: Specification of the scene.
        robots: Robots of the session, as `client.mirror.robots.values()`.

    Returns:
        The bodies, parents first. What carries several arms, as a torso, belongs to none of them.
    """
    found = {robot.base_body for robot in robots}
    for body in spec.bodies:  # parents before their children
        if body.parent in found and body.parent != 0:
            found.add(body.id)
    return tuple(body for body in spec.bodies if body.id in found and body.id != 0)


class RobotPoints:
    """Find the points of a cloud that lie on robots.

    Args:
        spec: Specification of the scene.
        meshes: Meshes by their index in `spec.meshes`, as `FetchedScene.meshes`.
        robots: Robots of the session, as `client.mirror.robots.values()`.
        streamed: Bodies with poses in the state stream, as `client.mirror.bodies`.

    Attributes:
        n_bodies: Number of bodies of robots with a surface.
        n_unknown: Those whose pose was not known in the last call: their points stayed.
    """

    def __init__(
        self,
        spec: SceneSpec,
        meshes: Mapping[int, MeshArrays],
        robots: Iterable[RobotInfo],
        streamed: Iterable[BodyInfo],
    ) -> None:
        known = {body.id: body for body in streamed}

        def make_shapes(bodies: Iterable[Body]) -> list[_BodyShape]:
            return [
                _make_shape(known[body.id].name if body.id in known else "", body, points)
                for body, points in _sample_bodies(spec, meshes, bodies)
            ]

        self._robots = make_shapes(find_robot_bodies(spec, robots))
        self._objects = make_shapes(body for body in spec.bodies if body.id in known and known[body.id].object)
        self.n_bodies = len(self._robots)
        self.n_unknown = 0

    def find(self, positions: Positions, body_pose: BodyPose, capture_ns: int) -> npt.NDArray[np.bool_]:
        """Return which points lie on a robot.

        Args:
            positions: (n, 3) [m], world frame.
            body_pose: Poses of bodies by name and time; one that is not known gives `None`.
            capture_ns: Session time of the points.

        Returns:
            (n,) true for the points on robots.
        """
        distances, self.n_unknown = _measure(self._robots, positions, body_pose, capture_ns)
        found: npt.NDArray[np.bool_] = distances != _FAR
        rows = np.flatnonzero(found)
        to_objects, _ = _measure(self._objects, positions[rows], body_pose, capture_ns)
        found[rows] = distances[rows] <= to_objects
        return found


class _BodyShape(NamedTuple):
    """Distances from the surface of a body in the cells of a grid.

    Attributes:
        name: Name of the body in the state stream, empty where it has no poses there.
        T_world_rest: (4, 4), where the specification has it.
        grid: Distance of each cell [mm]; `_FAR` beyond the margin, and so in all the outermost cells.
        low: Lowest corner of the grid [m], body frame.
        cell_m: Edge of a cell.
        center, radius: Sphere around the grid [m], body frame.
    """

    name: str
    T_world_rest: Floats
    grid: Distances
    low: Floats
    cell_m: float
    center: Floats
    radius: float


def _measure(
    shapes: Sequence[_BodyShape], positions: Positions, body_pose: BodyPose, now_ns: int
) -> tuple[Distances, int]:
    """Return the distance of each point from the nearest body [mm], and of how many bodies no pose is known."""
    found = np.full(len(positions), _FAR, np.uint8)
    poses = [body_pose(shape.name, now_ns) if shape.name else None for shape in shapes]
    placed = [
        (shape, shape.T_world_rest if pose is None else pose_to_matrix(pose))
        for shape, pose in zip(shapes, poses, strict=True)
        if pose is not None or not shape.name
    ]
    if not placed:
        return found, len(shapes)
    centers = np.array([T[:3, :3] @ shape.center + T[:3, 3] for shape, T in placed])
    radii = np.array([[shape.radius] for shape, _ in placed])
    low, high = (centers - radii).min(axis=0), (centers + radii).max(axis=0)
    near = np.flatnonzero(((positions > low) & (positions < high)).all(axis=1))
    columns = np.ascontiguousarray(positions[near].T, np.float32)  # so that each step runs through memory in order
    for (shape, T), center in zip(placed, centers.astype(np.float32), strict=True):
        away = columns - center[:, None]
        inside = np.flatnonzero(np.einsum("ij,ij->j", away, away) < shape.radius**2)
        turn = (T[:3, :3].T / shape.cell_m).astype(np.float32)
        # Relative to the centre, where single precision is enough.
        cells = turn @ away[:, inside] + ((shape.center - shape.low) / shape.cell_m).astype(np.float32)[:, None]
        i, j, k = np.clip(cells.astype(np.int64), 0, np.array(shape.grid.shape)[:, None] - 1)
        rows = near[inside]
        found[rows] = np.minimum(found[rows], shape.grid[i, j, k])
    return found, len(shapes) - len(placed)


def _make_shape(name: str, body: Body, surface: Floats) -> _BodyShape:
    """Return the distances from the samples (n, 3) of a surface."""
    extent = np.ptp(surface, axis=0) + 2.0 * MARGIN_M
    cell_m = max(_CELL_M, float(np.prod(extent) / _MAX_CELLS) ** (1 / 3))
    reach = math.ceil(MARGIN_M / cell_m) + 1  # the outermost cells stay beyond the margin
    low = surface.min(axis=0) - reach * cell_m
    shape = np.floor((surface.max(axis=0) - low) / cell_m).astype(int) + reach + 1
    grid = np.full(shape, _FAR, np.uint8)
    flat = grid.reshape(-1)
    cells = np.unique(np.ravel_multi_index(tuple(np.floor((surface - low) / cell_m).astype(int).T), grid.shape))
    steps = np.arange(-reach, reach + 1)
    around = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    distances = np.linalg.norm(around, axis=1) * cell_m
    for one in np.argsort(-distances, kind="stable"):  # nearer ones come last and remain
        if distances[one] <= MARGIN_M + 0.5 * cell_m:
            step = int(around[one] @ (grid.shape[1] * grid.shape[2], grid.shape[2], 1))
            flat[cells + step] = min(round(1e3 * float(distances[one])), _FAR - 1)
    half = 0.5 * cell_m * shape
    return _BodyShape(name, to_matrix(body.T_world_body), grid, low, cell_m, low + half, float(np.linalg.norm(half)))


def _sample_bodies(
    spec: SceneSpec, meshes: Mapping[int, MeshArrays], bodies: Iterable[Body]
) -> Iterator[tuple[Body, Floats]]:
    """Yield the bodies that have a surface, with points of it (n, 3), body frame, no further apart than a cell."""
    visuals: dict[int, list[Visual]] = {}
    for visual in spec.visuals:
        if visual.id < FIRST_SITE_VISUAL:  # sites mark places, they have no surface
            visuals.setdefault(visual.body, []).append(visual)
    for body in bodies:
        every = visuals.get(body.id, [])
        drawn = [one for one in every if one.rgba[3] > 0 and one.group in spec.groups_shown]
        surface = [sample_visual(one, meshes) for one in drawn or every]
        if any(map(len, surface)):
            yield body, np.concatenate(surface)


def sample_visual(visual: Visual, meshes: Mapping[int, MeshArrays]) -> Floats:
    """Return points (n, 3) [m] of the surface of a visual, body frame; none of a plane."""
    mesh = meshes.get(visual.geometry.mesh) or build_primitive(visual.geometry)
    if mesh is None or visual.geometry.kind == GeometryKind.PLANE:
        return np.empty((0, 3))
    points = _sample_triangles(np.asarray(mesh.position, np.float64)[np.asarray(mesh.index, np.int64)])
    T = to_matrix(visual.T_body_visual)
    return points @ T[:3, :3].T + T[:3, 3]


def _sample_triangles(corners: Floats) -> Floats:
    """Return points of triangles (n, 3, 3): each is cut along a lattice finer than a cell, corners included."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    pieces = np.clip(np.ceil(longest / _CELL_M), 1, _MAX_PIECES).astype(int)
    samples = [np.empty((0, 3))]
    for n in np.unique(pieces):
        i, j = (steps.ravel() for steps in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
        chosen = i + j <= n
        weights = np.stack([i[chosen], j[chosen], n - i[chosen] - j[chosen]], axis=1) / n
        samples.append(np.einsum("wc,tcx->twx", weights, corners[pieces == n]).reshape(-1, 3))
    return np.concatenate(samples)
