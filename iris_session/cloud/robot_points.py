"""Points that lie on the robots of the session, to be left out of a cloud: clients draw the robots themselves.

Each body gets a grid of cells in its own frame, once: the distance from its visible surface. For a cloud the points
near a body are moved into its frame and looked up. What a gripper holds stays: of an object that the session knows
every point that is nearer to it than to the robot, of another one all but what is within the margin of the fingers.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from anchors.camera import pose_to_matrix
from iris_session.cloud.pipeline import BodyPose
from iris_session.cloud.voxels import Positions, load_kernels
from iris_session.protocol.names import GeometryKind
from iris_session.protocol.scene import Body, SceneSpec, Visual
from iris_session.protocol.server_messages import BodyInfo, RobotInfo
from iris_session.scene.meshes import MeshArrays
from iris_session.scene.nodes import to_matrix
from iris_session.scene.shapes import build_primitive

Floats = npt.NDArray[np.float64]
#: Depth, calibration and the time between a picture and the state together move a point by about this much [m].
MARGIN_M: Final = 0.02
#: Edge of a cell of a body's grid [m]; larger where a body would have more than `_MAX_CELLS`.
_CELL_M: Final = 0.005
_MAX_CELLS: Final = 4_000_000
#: Beyond the margin; distances are in millimetres.
_FAR: Final = 255
#: Pieces that the longest edge of a triangle is cut into, at most: 2.5 m of a robot.
_MAX_PIECES: Final = 512
Distances = npt.NDArray[np.uint8]


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
        margin_m: Distance from the visible surface of a robot up to which a point counts as lying on it [m].
        use_numba: Use numba. By default where it is installed.

    Attributes:
        n_bodies: Number of bodies of robots with a surface.
        n_unknown: Those whose pose was not known in the last call: their points stayed.

    Raises:
        ValueError: `margin_m` is out of range.
        MissingExtraError: `use_numba`, and numba is not installed.
    """

    def __init__(
        self,
        spec: SceneSpec,
        meshes: Mapping[int, MeshArrays],
        robots: Iterable[RobotInfo],
        streamed: Iterable[BodyInfo],
        *,
        margin_m: float = MARGIN_M,
        use_numba: bool | None = None,
    ) -> None:
        if not _CELL_M <= margin_m <= 0.2:
            raise ValueError(f"margin_m is {margin_m}: {_CELL_M:g} to 0.2 m are possible")
        kernels = load_kernels(use_numba)
        known = {body.id: body for body in streamed}
        names = {body.id: body.name for body in known.values()}
        of_robots = find_robot_bodies(spec, robots)
        things = tuple(body for body in spec.bodies if body.id in known and known[body.id].object)
        self._robots = _Shapes(_sample_bodies(spec, meshes, of_robots), names, margin_m, kernels)
        self._things = _Shapes(_sample_bodies(spec, meshes, things), names, margin_m, kernels)
        self.n_bodies = self._robots.n
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
        distances, self.n_unknown = self._robots.measure(positions, body_pose, capture_ns)
        found: npt.NDArray[np.bool_] = distances != _FAR
        if self._things.n and found.any():
            rows = np.flatnonzero(found)
            to_things, _ = self._things.measure(positions[rows], body_pose, capture_ns)
            found[rows] = distances[rows] <= to_things
        return found


def warm_up_removal() -> None:
    """Let numba compile what `RobotPoints.find` needs, or load it: the first time takes seconds."""
    kernels = load_kernels()
    if kernels is not None:
        points, turns = np.zeros((1, 3), np.float32), np.zeros((1, 3, 4), np.float32)
        shapes, found = np.ones((1, 3), np.int32), np.zeros(1, np.uint8)
        kernels.measure_distances(
            points, np.zeros((1, 4), np.float32), turns, np.zeros(1, np.uint8), np.zeros(1, np.int64), shapes, found
        )


class _Shapes:
    """Distance grids of bodies, one behind the other: `_starts[b]` is where that of body b begins.

    The value at (i, j, k) is the distance from the surface [mm] of a cube of edge `_cells_m[b]` that begins at
    `_lows[b]` + (i, j, k) edges, body frame; `_FAR` beyond the margin, and so in all the outermost cells.
    """

    def __init__(
        self, surfaces: Iterable[tuple[Body, Floats]], names: Mapping[int, str], margin_m: float, kernels: Any
    ) -> None:
        grids, cells_m, lows, self._names, self._rest = [], [], [], [], []
        for body, points in surfaces:
            grid, cell_m, low = _build_grid(points, margin_m)
            grids.append(grid)
            cells_m.append(cell_m)
            lows.append(low)
            self._names.append(names.get(body.id, ""))
            self._rest.append(to_matrix(body.T_world_body))
        self.n = len(grids)
        self._kernels = kernels
        self._cells_m, self._lows = np.array(cells_m), np.array(lows).reshape(-1, 3)
        self._shapes = np.array([grid.shape for grid in grids], np.int32).reshape(-1, 3)
        self._starts = np.concatenate([[0], np.cumsum([grid.size for grid in grids])]).astype(np.int64)
        self._flat = np.concatenate([grid.reshape(-1) for grid in grids]) if grids else np.empty(0, np.uint8)
        sizes = self._shapes * self._cells_m[:, None]
        self._centers, self._radii = self._lows + 0.5 * sizes, 0.5 * np.linalg.norm(sizes, axis=1)

    def measure(self, positions: Positions, body_pose: BodyPose, now_ns: int) -> tuple[Distances, int]:
        """Return the distance of each point from the nearest body [mm], and of how many bodies no pose is known."""
        poses = [body_pose(name, now_ns) if name else None for name in self._names]
        present = [b for b, pose in enumerate(poses) if pose is not None or not self._names[b]]
        found = np.full(len(positions), _FAR, np.uint8)
        if not present or not len(positions):
            return found, self.n - len(present)
        T = np.array([self._rest[b] if (pose := poses[b]) is None else pose_to_matrix(pose) for b in present])
        R, p, cells_m = T[:, :3, :3], T[:, :3, 3:], self._cells_m[present][:, None, None]
        turn = R.transpose(0, 2, 1) / cells_m
        to_cells = np.concatenate([turn, -turn @ p - self._lows[present][:, :, None] / cells_m], axis=2)
        centers = R @ self._centers[present][:, :, None] + p
        spheres = np.concatenate([centers[:, :, 0], self._radii[present][:, None]], axis=1)
        measure = _measure if self._kernels is None else self._kernels.measure_distances
        measure(
            np.ascontiguousarray(positions, np.float32),
            np.ascontiguousarray(spheres, np.float32),
            np.ascontiguousarray(to_cells, np.float32),
            self._flat,
            self._starts[present],
            self._shapes[present],
            found,
        )
        return found, self.n - len(present)


def _measure(
    positions: Positions,
    spheres: Positions,
    to_cells: Positions,
    grids: Distances,
    starts: npt.NDArray[np.int64],
    shapes: npt.NDArray[np.int32],
    found: Distances,
) -> None:
    """Lower `found` to the distances of the points. In numba: `kernels.measure_distances`, in half the time."""
    low, high = (spheres[:, :3] - spheres[:, 3:]).min(axis=0), (spheres[:, :3] + spheres[:, 3:]).max(axis=0)
    near = np.flatnonzero(((positions > low) & (positions < high)).all(axis=1))
    columns = np.ascontiguousarray(positions[near].T)  # so that each step runs through memory in order
    for sphere, turn, start, shape in zip(spheres, to_cells, starts, shapes, strict=True):
        away = columns - sphere[:3, None]
        inside = np.flatnonzero(np.einsum("ij,ij->j", away, away) < sphere[3] ** 2)
        cells = turn[:, :3] @ columns[:, inside] + turn[:, 3:]
        i, j, k = (np.clip(cells[axis], 0, shape[axis] - 1).astype(np.int64) for axis in range(3))
        rows = near[inside]
        found[rows] = np.minimum(found[rows], grids[start + (i * shape[1] + j) * shape[2] + k])


def _build_grid(surface: Floats, margin_m: float) -> tuple[Distances, float, Floats]:
    """Return the distances [mm] from the samples (n, 3) of a surface, the edge of a cell, and the lowest corner."""
    extent = surface.max(axis=0) - surface.min(axis=0) + 2.0 * margin_m
    cell_m = max(_CELL_M, float(np.prod(extent) / _MAX_CELLS) ** (1 / 3))
    reach = math.ceil(margin_m / cell_m) + 1  # the outermost cells stay beyond the margin
    low = surface.min(axis=0) - reach * cell_m
    shape = np.floor((surface.max(axis=0) - low) / cell_m).astype(int) + reach + 1
    grid = np.full(shape, _FAR, np.uint8)
    flat = grid.reshape(-1)
    cells = np.unique(np.ravel_multi_index(tuple(np.floor((surface - low) / cell_m).astype(int).T), grid.shape))
    steps = np.arange(-reach, reach + 1)
    around = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    distances = np.linalg.norm(around, axis=1) * cell_m
    for one in np.argsort(-distances, kind="stable"):  # nearer ones come last and remain
        if distances[one] <= margin_m + 0.5 * cell_m:
            step = int(around[one] @ (grid.shape[1] * grid.shape[2], grid.shape[2], 1))
            flat[cells + step] = min(round(1e3 * float(distances[one])), _FAR - 1)
    return grid, cell_m, low


def _sample_bodies(
    spec: SceneSpec, meshes: Mapping[int, MeshArrays], bodies: Iterable[Body]
) -> Iterator[tuple[Body, Floats]]:
    """Yield the bodies that have a surface, with points of it (n, 3), body frame, no further apart than a cell."""
    visuals: dict[int, list[Visual]] = {}
    for visual in spec.visuals:
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
