"""Calibrated depth cameras: stated errors of their points, their fit to each other, and whether a calibration holds.

The poses come from sheets that the cameras see (`anchors.camera_rig`); points are those of the cameras, in the world.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from anchors.icp import Refinement, RefinementRefusedError, measure_turn, refine_pose
from anchors.uncertainty import position_error_p95

Floats = NDArray[np.float64]
#: Points of a camera at which its error is computed, at most.
_MAX_POINTS: Final = 200
#: A camera without points: one on its axis, so far away [m].
_USUAL_DISTANCE_M: Final = 1.5


class PlacedCamera(NamedTuple):
    """A depth camera whose pose was measured.

    Attributes:
        T_world_camera: (4, 4), of the optical frame.
        covariance: 36 values of (x, y, z [m], rx, ry, rz [rad]) of that pose, world frame.
        points: (n, 3) [m], world frame, what it sees.
        error_m: Stated error of these points, 95 % [m].
    """

    T_world_camera: Floats
    covariance: Sequence[float]
    points: Floats
    error_m: float


class CameraFit(NamedTuple):
    """A camera that was fitted to others, and by how much."""

    camera: PlacedCamera
    refinement: Refinement


class PoseCheck(NamedTuple):
    """A calibrated pose beside one that was measured again.

    Attributes:
        shift_m: Distance between the positions of the camera [m].
        turn_rad: Angle between its orientations [rad].
        off_m: Distance between both places of a point that it sees, which 95 % of them keep [m].
        limit_m: Distance that the stated errors of both poses explain [m].
    """

    shift_m: float
    turn_rad: float
    off_m: float
    limit_m: float

    @property
    def fits(self) -> bool:
        """True if the stated errors explain the difference."""
        return self.off_m <= self.limit_m


def compute_points_error(covariance: Sequence[float], T_world_camera: Floats, points: Floats) -> float:
    """Return the error that 95 % of the points of a camera keep, 95 % of the time: rotation counts with distance.

    Args:
        covariance: 36 values of (x, y, z [m], rx, ry, rz [rad]) of the pose, world frame.
        T_world_camera: (4, 4).
        points: (n, 3) [m], world frame; empty: a point on the camera's axis, 1.5 m away.

    Returns:
        The error [m].
    """
    x, y, z = T_world_camera[:3, 3].tolist()
    chosen = _choose_points(T_world_camera, points).tolist()
    return float(np.quantile([position_error_p95(covariance, (x, y, z), (p[0], p[1], p[2])) for p in chosen], 0.95))


def fit_cameras(
    cameras: Mapping[str, PlacedCamera], sheet_error_m: float
) -> tuple[str, dict[str, CameraFit | RefinementRefusedError]]:
    """Fit cameras by ICP, one by one to those before them, in the order of their stated errors.

    A camera that was fitted has the error of the first one at its own points, that of the sheets, and twice what its
    surfaces are apart from those that it was fitted to, as these may be from the first one's.

    Args:
        cameras: At least one, by name.
        sheet_error_m: Error of the poses of the sheets, 95 % [m].

    Returns:
        Name of the first camera, which stays; of each other one the fit, or why there is none.
    """
    first, *others = sorted(cameras, key=lambda name: cameras[name].error_m)
    reference = cameras[first].points
    errors_m = [sheet_error_m]
    fits: dict[str, CameraFit | RefinementRefusedError] = {}
    for name in others:
        camera = cameras[name]
        try:
            refinement = refine_pose(camera.points, reference)
        except RefinementRefusedError as error:
            fits[name] = error
            continue
        T = refinement.T_world_world
        points = camera.points @ T[:3, :3].T + T[:3, 3]
        reference = np.concatenate([reference, points])
        errors_m.append(2.0 * refinement.rmse_after_m)
        own_m = compute_points_error(cameras[first].covariance, cameras[first].T_world_camera, points)
        fitted = PlacedCamera(T @ camera.T_world_camera, camera.covariance, points, math.hypot(own_m, *errors_m))
        fits[name] = CameraFit(fitted, refinement)
    return first, fits


def check_pose(T_world_camera: Floats, error_m: float, measured: PlacedCamera) -> PoseCheck:
    """Compare the calibrated pose of a camera with one that was measured again.

    Args:
        T_world_camera: (4, 4) by the calibration.
        error_m: Its stated error, 95 % [m].
        measured: The camera by the measurement.

    Returns:
        How far they are apart.
    """
    T = T_world_camera @ np.linalg.inv(measured.T_world_camera)
    points = _choose_points(measured.T_world_camera, measured.points)
    off_m = np.quantile(np.linalg.norm(points @ T[:3, :3].T + T[:3, 3] - points, axis=1), 0.95)
    shift_m = np.linalg.norm(T_world_camera[:3, 3] - measured.T_world_camera[:3, 3])
    return PoseCheck(float(shift_m), measure_turn(T[:3, :3]), float(off_m), math.hypot(error_m, measured.error_m))


def _choose_points(T_world_camera: Floats, points: Floats) -> Floats:
    if not len(points):
        return (T_world_camera @ (0.0, 0.0, _USUAL_DISTANCE_M, 1.0))[None, :3]
    return points[:: max(1, len(points) // _MAX_POINTS)]
