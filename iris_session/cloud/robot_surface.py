"""The robots' surface by model and state, compared with the depth that a camera measures. No clocks, no sockets.

Measured points near the surface are brought onto it by a small motion of the camera (point-to-plane, as in
`iris_session.cloud.icp`, whose model here is exact). Only directions that the surface determines are moved in: where a
cylinder could slide along itself nothing is claimed. The result counts when it explains what the camera sees of the
robots: of the samples that nothing hides, most are then where depth is measured, and many more than without the motion.
So what stands beside a robot, or is held by it, moves nothing: it hides samples, and puts none of them elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from anchors.camera import CameraModel, pose_to_matrix
from iris_session.cloud.icp import Reference, find_pairs, make_motion, make_normal_equations
from iris_session.cloud.pipeline import BodyPose
from iris_session.cloud.robot_points import find_robot_bodies, sample_bodies
from iris_session.cloud.voxels import make_rays
from iris_session.protocol.scene import SceneSpec
from iris_session.protocol.server_messages import BodyInfo, RobotInfo
from iris_session.scene.meshes import MeshArrays
from iris_session.scene.nodes import to_matrix

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]
Verdict = Literal["fits", "off", "lost", ""]

#: Distance between samples of the surface [m].
_SAMPLE_M: Final = 0.01
#: Depth and state may be apart by so much: drivers date frames when they arrive.
DELAY_NS: Final = 100_000_000
#: A body that moved further in that time is not compared [m].
STILL_M: Final = 0.003
#: Columns of the picture that is compared: each look costs some 50 ms.
_WIDTH: Final = 160
#: Measured points further from the surface are not paired with it, at first and in the end [m].
REACH_M: Final = 0.12
_LAST_REACH_M: Final = 0.03
_ITERATIONS: Final = 30
_SETTLED: Final = 1e-4  # [m] and [rad]
#: Samples seen at a flatter angle are not compared: cosine of the angle from the normal.
_LEAST_COSINE: Final = 0.3
#: A sample so far behind another in the same pixel is hidden [m].
_HIDDEN_M: Final = 0.02
#: A sample fits when depth is measured within this distance of it, along the ray [m].
_FITS_M: Final = 0.015
#: Samples that must fit, and their share: of those that nothing hides, and of all.
_LEAST_FITTING: Final = 200
_LEAST_SHARE: Final = 0.8
_LEAST_SEEN: Final = 0.5
#: A motion of the camera makes so many times more of them fit.
_GAIN: Final = 1.25
#: Eigenvalues of the normal equations per pair: a direction below is free, and more than one such makes no verdict.
_LEAST_EIGENVALUE: Final = 0.02
_LEAST_DIRECTIONS: Final = 5
#: Allowed beyond the stated error: of model and state [m], and of the depth as a share of it.
FLOOR_M: Final = 0.005
DEPTH_SHARE: Final = 0.005


class PlacedSurface(NamedTuple):
    """Samples of the robots' surface at one time.

    Attributes:
        points: (n, 3) [m], world frame.
        normals: (n, 3), of any sign.
        still: (n,) false on bodies that move, as seen from what carries the camera.
    """

    points: Floats
    normals: Floats
    still: npt.NDArray[np.bool_]


class SurfaceLook(NamedTuple):
    """One depth picture compared with the surface.

    Attributes:
        verdict: `fits`; `off`: the robots are elsewhere, by more than the errors explain; `lost`: they are not where
            the camera should see them, and not near it; empty: the picture does not tell.
        T_world_world: (4, 4) correction: `T_world_world @ T_world_camera` is where the camera is. Of `lost` nothing.
        shift_m: How far the robots are from where they should be, root mean square.
    """

    verdict: Verdict
    T_world_world: Floats
    shift_m: float


class RobotSurface:
    """Samples of the surfaces of the session's robots.

    Args:
        spec: Specification of the scene.
        meshes: Meshes by their index in `spec.meshes`, as `FetchedScene.meshes`.
        robots: Robots of the session, as `client.mirror.robots.values()`.
        streamed: Bodies with poses in the state stream, as `client.mirror.bodies`.
    """

    def __init__(
        self,
        spec: SceneSpec,
        meshes: Mapping[int, MeshArrays],
        robots: Iterable[RobotInfo],
        streamed: Iterable[BodyInfo],
    ) -> None:
        names = {body.id: body.name for body in streamed}
        self._bodies: list[tuple[str, Floats, Floats, Floats]] = []  # name, T at rest, points, normals
        for body, points, normals in sample_bodies(spec, meshes, find_robot_bodies(spec, robots)):
            chosen = _thin_out(points, normals)
            self._bodies.append((names.get(body.id, ""), to_matrix(body.T_world_body), points[chosen], normals[chosen]))

    def place(self, body_pose: BodyPose, capture_ns: int, carrier: str = "") -> PlacedSurface | None:
        """Place the surface as it was at a time.

        Args:
            body_pose: Poses of bodies by name and time; one that is not known gives `None`.
            capture_ns: Session time of a picture.
            carrier: Name of the body that carries the camera, empty for the world.

        Returns:
            The samples of bodies whose pose is known then and `DELAY_NS` before; `None` where there are none.
        """

        times = (capture_ns, capture_ns - DELAY_NS)

        def find(name: str, rest: Floats) -> list[Floats | None]:
            if not name:
                return [rest, rest]
            poses = [body_pose(name, at_ns) for at_ns in times]
            return [None if pose is None else pose_to_matrix(pose) for pose in poses]

        carrier_now, carrier_before = find(carrier, np.eye(4))
        if carrier_now is None or carrier_before is None:
            return None
        parts = []
        for name, rest, points, normals in self._bodies:
            now, before = find(name, rest)
            if now is None or before is None:
                continue
            placed = points @ now[:3, :3].T + now[:3, 3]
            # Where its points were then, carried to the present by what carries the camera.
            T = carrier_now @ np.linalg.inv(carrier_before) @ before
            moved = np.abs(points @ T[:3, :3].T + T[:3, 3] - placed).max()
            parts.append((placed, normals @ now[:3, :3].T, np.full(len(points), moved <= STILL_M)))
        return PlacedSurface(*map(np.concatenate, zip(*parts, strict=True))) if parts else None


class _View(NamedTuple):
    """A depth picture [m], 0 where nothing is measured, and its camera."""

    depth: Floats
    camera: CameraModel
    rays: Floats  # (height, width, 3), z is 1


class _Count(NamedTuple):
    """Samples by the depth measured in their pixel: near them, behind them, before them."""

    fits: int
    behind: int
    before: int

    @property
    def is_good(self) -> bool:
        """True if most of the robots are seen where they should be."""
        shown = self.fits + self.behind
        return (
            self.fits >= _LEAST_FITTING
            and self.fits >= _LEAST_SHARE * shown
            and self.fits >= _LEAST_SEEN * (shown + self.before)
        )


def compare_depth(
    surface: PlacedSurface,
    depth: npt.NDArray[np.uint16],
    camera: CameraModel,
    depth_scale_m: float,
    T_world_camera: npt.NDArray[Any],
    error_m: float,
) -> SurfaceLook:
    """Compare a depth picture with the surface of the robots at its capture.

    Args:
        surface: The surface.
        depth: (height, width), 0 and 65,535 are no measurement.
        camera: Intrinsics.
        depth_scale_m: Length of one unit of depth [m].
        T_world_camera: (4, 4) by the calibration.
        error_m: Stated error of the calibration, 95 % [m].

    Returns:
        The verdict, and by how much the camera is off.
    """
    view, T_world_camera = _shrink(depth, camera, depth_scale_m), np.asarray(T_world_camera, np.float64)
    undecided = SurfaceLook("", np.eye(4), 0.0)
    rows = _find_visible(surface, view, T_world_camera)
    still = rows[surface.still[rows]]
    if len(still) < _LEAST_FITTING:
        return undecided
    before = _count(surface.points[still], view, T_world_camera)
    found = _fit(surface, rows, view, T_world_camera)
    if found is not None:
        T, shift_m = found
        corrected = T @ T_world_camera
        seen = _find_visible(surface, view, corrected)
        after = _count(surface.points[seen[surface.still[seen]]], view, corrected)
        distance = float(np.median(np.linalg.norm(surface.points[still] - T_world_camera[:3, 3], axis=1)))
        if after.is_good and shift_m <= error_m + FLOOR_M + DEPTH_SHARE * distance:
            return SurfaceLook("fits", T, shift_m)
        if after.is_good and shift_m <= REACH_M and after.fits > _GAIN * before.fits:
            return SurfaceLook("off", T, shift_m)
    if before.is_good:
        return undecided._replace(verdict="fits")
    is_lost = before.behind >= _LEAST_FITTING and before.behind > before.fits + before.before
    return undecided._replace(verdict="lost" if is_lost else "")


def _thin_out(points: Floats, normals: Floats) -> Rows:
    """Return rows of one sample for each cell and each octant of normals: thin plates keep both sides."""
    cells = np.floor((points - points.min(axis=0)) / _SAMPLE_M).astype(np.int64)
    octant = (normals > 0.0) @ np.array([1, 2, 4])
    shape = cells.max(axis=0) + 1
    key = ((cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]) * 8 + octant
    return np.unique(key, return_index=True)[1]


def _shrink(depth: npt.NDArray[np.uint16], camera: CameraModel, depth_scale_m: float) -> _View:
    """Take every n-th pixel."""
    n = max(1, round(camera.width / _WIDTH))
    small = depth[::n, ::n]
    shown = CameraModel(
        small.shape[1], small.shape[0], camera.fx / n, camera.fy / n, camera.cx / n, camera.cy / n, camera.distortion
    )
    rays = make_rays(shown)
    measured = np.where((small > 0) & (small < 65_535), small * depth_scale_m, 0.0)
    return _View(measured, shown, np.stack([rays.x, rays.y, np.ones_like(rays.x)], axis=2).astype(np.float64))


def _project(points: Floats, view: _View, T_world_camera: Floats) -> tuple[Rows, Rows, Floats]:
    """Return the rows of the points (n, 3) that are in the picture, their pixels (m, 2), and their depths (m,)."""
    inside = (points - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    z = inside[:, 2]
    widest = np.abs(view.rays).max(axis=(0, 1))[:2]  # beyond, a polynomial for the lens means nothing
    rows = np.flatnonzero((z > 0.05) & (np.abs(inside[:, :2]) < widest * z[:, None]).all(axis=1))
    if not len(rows):
        return rows, np.empty((0, 2), np.int64), np.empty(0)
    pixels = np.rint(view.camera.project(inside[rows])).astype(np.int64)
    # One pixel of border: a sample covers the pixels around it.
    ok = ((pixels >= 1) & (pixels < (view.camera.width - 1, view.camera.height - 1))).all(axis=1)
    return rows[ok], pixels[ok], z[rows[ok]]


def _find_visible(surface: PlacedSurface, view: _View, T_world_camera: Floats) -> Rows:
    """Return the rows of the samples that face the camera and are hidden by no others."""
    rows, pixels, z = _project(surface.points, view, T_world_camera)
    nearest = np.full(view.depth.shape, np.inf)
    for i in (-1, 0, 1):  # each sample covers the pixels around it: at 0.5 m samples are three pixels apart
        for j in (-1, 0, 1):
            np.minimum.at(nearest, (pixels[:, 1] + i, pixels[:, 0] + j), z)
    away = surface.points[rows] - T_world_camera[:3, 3]
    cosines = np.abs(np.einsum("ij,ij->i", away, surface.normals[rows])) / np.linalg.norm(away, axis=1)
    shown: Rows = rows[(cosines > _LEAST_COSINE) & (z <= nearest[pixels[:, 1], pixels[:, 0]] + _HIDDEN_M)]
    return shown


def _count(points: Floats, view: _View, T_world_camera: Floats) -> _Count:
    """Count samples by what is measured at them."""
    _, pixels, z = _project(points, view, T_world_camera)
    measured = view.depth[pixels[:, 1], pixels[:, 0]]
    away = (measured - z)[measured > 0.0]
    fits, behind = int((np.abs(away) <= _FITS_M).sum()), int((away > _FITS_M).sum())
    return _Count(fits, behind, len(away) - fits - behind)


def _fit(surface: PlacedSurface, rows: Rows, view: _View, T_world_camera: Floats) -> tuple[Floats, float] | None:
    """Bring the measured points onto the samples `rows`.

    Returns:
        The correction (4, 4), and by how much it moves the points [m]; `None` where too little determines it.
    """
    from scipy.spatial import cKDTree

    points = (view.depth[:, :, None] * view.rays)[view.depth > 0.0] @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    every = surface.points[rows]
    near = ((points > every.min(axis=0) - REACH_M) & (points < every.max(axis=0) + REACH_M)).all(axis=1)
    points = points[near]
    distance, at = cKDTree(every).query(points, distance_upper_bound=REACH_M)
    still = surface.still[rows]
    source = points[np.isfinite(distance) & np.append(still, False)[at]]  # not those beside a body that moves
    target = Reference(every[still], surface.normals[rows][still], cKDTree(every[still]))
    T, moved, reach = np.eye(4), source, REACH_M
    for _ in range(_ITERATIONS):
        pairs = find_pairs(moved, target, reach)
        if len(pairs.rows) < _LEAST_FITTING // 2:
            return None
        information, gradient, center, size = make_normal_equations(moved, pairs)
        values, vectors = np.linalg.eigh(information)
        held = values >= _LEAST_EIGENVALUE
        step = -vectors[:, held] @ ((vectors[:, held].T @ gradient) / values[held])
        T = make_motion(step[:3], step[3:] / size, center) @ T
        moved = source @ T[:3, :3].T + T[:3, 3]
        if reach == _LAST_REACH_M and np.abs(step).max() < _SETTLED:
            break
        reach = max(_LAST_REACH_M, 0.85 * reach)
    if held.sum() < _LEAST_DIRECTIONS:
        return None
    return T, math.sqrt(float(((moved - source)[pairs.rows] ** 2).sum(axis=1).mean()))
