"""Errors of fitted cameras, and whether a calibration still fits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from anchors import depth_calibration
from anchors.depth_calibration import CameraFit, PlacedCamera, check_pose, compute_points_error, fit_cameras
from anchors.icp import Refinement, RefinementRefusedError
from anchors.uncertainty import position_error_p95

Floats = NDArray[np.float64]
COVARIANCE = tuple(np.diag([1e-6, 0.0, 0.0, 0.0, 0.0, 0.0]).ravel())
POINTS = np.random.default_rng(1).normal(size=(1000, 3))


def make_pose(x: float = 0.0, turn_rad: float = 0.0) -> Floats:
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(turn_rad), -math.sin(turn_rad)], [math.sin(turn_rad), math.cos(turn_rad)]]
    pose[0, 3] = x
    return pose


def test_a_fitted_camera_has_the_error_of_its_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """And that of the camera that it was fitted to, and of the sheet; no more that of the pose that it left."""
    refinement = Refinement(make_pose(0.01), 0.02, 0.004, 0.9, 0.01, 0.0, 1.0)
    monkeypatch.setattr(depth_calibration, "refine_pose", lambda points, reference: refinement)
    cameras = {
        "left": PlacedCamera(make_pose(), COVARIANCE, POINTS, 0.2),
        "front": PlacedCamera(make_pose(), COVARIANCE, POINTS, 0.003),
    }
    first, fits = fit_cameras(cameras, 0.005)
    assert (first, list(fits)) == ("front", ["left"])
    fit = fits["left"]
    assert isinstance(fit, CameraFit)
    assert fit.camera.T_world_camera[:3, 3] == pytest.approx([0.01, 0.0, 0.0])
    assert fit.camera.points == pytest.approx(np.add(POINTS, (0.01, 0.0, 0.0)))
    first_m = position_error_p95(COVARIANCE, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    assert fit.camera.error_m == pytest.approx(math.hypot(first_m, 0.008, 0.005))


def test_a_camera_that_sees_nothing_of_the_others_is_left_as_it_was() -> None:
    far = PlacedCamera(make_pose(), COVARIANCE, POINTS + 50.0, 0.02)
    _, fits = fit_cameras({"front": PlacedCamera(make_pose(), COVARIANCE, POINTS, 0.003), "far": far}, 0.0)
    error = fits["far"]
    assert isinstance(error, RefinementRefusedError)
    assert error.reason == "overlap"


def test_the_error_of_points_grows_with_their_distance() -> None:
    turning = tuple(np.diag([0.0, 0.0, 0.0, 0.0, 1e-4, 0.0]).ravel())
    near, far = (compute_points_error(turning, make_pose(), np.array([[0.0, 0.0, z]])) for z in (1.0, 2.0))
    assert far == pytest.approx(2.0 * near)
    assert compute_points_error(turning, make_pose(), np.empty((0, 3))) == pytest.approx(1.5 * near)


@pytest.mark.parametrize(
    ("pose", "fits"),
    [
        (make_pose(), True),
        (make_pose(0.012), True),
        (make_pose(0.03), False),
        (make_pose(turn_rad=math.radians(2.0)), False),
    ],
)
def test_a_calibration_fits_within_the_stated_errors(pose: Floats, fits: bool) -> None:
    points = np.array([[1.0, 0.0, 1.0]]) + 0.01 * POINTS
    found = check_pose(pose, 0.012, PlacedCamera(make_pose(), COVARIANCE, points, 0.009))
    assert found.fits == fits
    assert found.limit_m == pytest.approx(0.015)
    assert found.shift_m == pytest.approx(pose[0, 3])
    assert found.turn_rad == pytest.approx(math.acos(min(1.0, pose[0, 0])))
