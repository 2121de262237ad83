"""Several cameras and sheets in one frame: exact without noise, better with more views, unconnected cameras named."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchors.camera import pose_from_matrix, pose_from_rvec_tvec, pose_to_matrix
from anchors.camera_rig import SheetView, solve_rig
from anchors.pose import PoseTuple, compose, distance, inverse, quat_from_rotvec
from anchors.robot_world import CalibrationError

CAMERAS: dict[str, PoseTuple] = {
    "front": ((1.5, 0.0, 1.0), quat_from_rotvec((-2.0, 0.1, 0.2))),
    "left": ((0.2, 1.4, 1.1), quat_from_rotvec((1.2, 1.9, -0.4))),
    "wrist": ((0.1, -0.2, 0.7), quat_from_rotvec((3.0, 0.2, 0.1))),
}
SHEETS: dict[str, PoseTuple] = {
    "table": ((0.0, 0.0, 0.0), quat_from_rotvec((0.0, 0.0, 0.0))),
    "shelf": ((0.5, 0.4, 0.3), quat_from_rotvec((1.0, 0.0, 0.3))),
    "wand@1": ((0.3, 0.2, 0.6), quat_from_rotvec((0.2, 0.5, 1.3))),
}
COVARIANCE = tuple(np.diag([1e-6] * 3 + [math.radians(0.2) ** 2] * 3).ravel())
SEEN = [("front", "table"), ("front", "shelf"), ("left", "shelf"), ("left", "wand@1"), ("wrist", "wand@1")]


def _views(seen: list[tuple[str, str]], rng: np.random.Generator | None = None) -> list[SheetView]:
    views = []
    for camera, sheet in seen:
        T = compose(inverse(CAMERAS[camera]), SHEETS[sheet])
        if rng is not None:
            noise = pose_to_matrix(pose_from_rvec_tvec(rng.normal(0.0, math.radians(0.2), 3), np.zeros(3)))[:3, :3]
            M = pose_to_matrix(T)
            M[:3, :3] = noise @ M[:3, :3]
            M[:3, 3] += rng.normal(0.0, 1e-3, 3)
            T = pose_from_matrix(M)
        views.append(SheetView(camera, sheet, T, COVARIANCE))
    return views


def test_chain_of_cameras_is_exact_without_noise() -> None:
    rig = solve_rig(_views(SEEN), {"table": SHEETS["table"]})
    for name, at in CAMERAS.items():
        assert distance(rig.cameras[name][0], at[0]) < 1e-8
    assert distance(rig.sheets["shelf"][0], SHEETS["shelf"][0]) < 1e-8
    assert set(rig.covariances) == set(CAMERAS)


def test_more_views_reduce_error_and_stated_error() -> None:
    off: dict[int, list[float]] = {1: [], 8: []}
    stated = {}
    for seed in range(12):
        for n, errors in off.items():
            rig = solve_rig(_views([("front", "table")] * n, np.random.default_rng(seed)), {"table": SHEETS["table"]})
            errors.append(distance(rig.cameras["front"][0], CAMERAS["front"][0]))
            stated[n] = math.sqrt(np.trace(np.reshape(rig.covariances["front"], (6, 6))[:3, :3]))
    assert np.mean(off[8]) < 0.6 * np.mean(off[1])
    assert stated[8] < 0.6 * stated[1]
    assert 0.4 < np.sqrt(np.mean(np.square(off[1]))) / stated[1] < 1.6


def test_unconnected_cameras_are_named() -> None:
    with pytest.raises(CalibrationError, match="camera left, wrist"):
        solve_rig(_views([SEEN[0], SEEN[3], SEEN[4]]), {"table": SHEETS["table"]})
    with pytest.raises(CalibrationError, match="no camera"):
        solve_rig([], {"table": SHEETS["table"]})
