"""Camera models: against OpenCV, round trips, other resolutions, intrinsics files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from anchors.camera import (
    CameraError,
    CameraModel,
    parse_camera,
    pose_from_matrix,
    pose_from_rvec_tvec,
    pose_to_matrix,
    to_rvec_tvec,
)

CAMERA = CameraModel(640, 480, 585.0, 584.0, 319.5, 239.5, (0.08, -0.18, 0.0008, -0.0005, 0.01))


def test_projection_agrees_with_opencv_and_inverts() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-0.3, 0.3, (50, 3))
    rvec, tvec = np.array([0.3, -0.5, 1.1]), np.array([0.05, -0.02, 1.3])
    pixels = CAMERA.project(points, pose_from_rvec_tvec(rvec, tvec))
    wanted = cv2.projectPoints(points, rvec, tvec, CAMERA.matrix, CAMERA.coefficients)[0].reshape(-1, 2)
    assert np.allclose(pixels, wanted, atol=1e-9)
    seen = points @ cv2.Rodrigues(rvec)[0].T + tvec
    assert np.allclose(CAMERA.undistort(pixels), seen[:, :2] / seen[:, 2:], atol=1e-10)


def test_matrices_agree_with_rodrigues() -> None:
    for rvec in ([0.0, 0.0, 0.0], [0.2, -0.3, 2.0], [np.pi, 0.0, 0.0]):
        pose = pose_from_rvec_tvec(np.array(rvec), np.array([1.0, 2.0, 3.0]))
        assert np.allclose(pose_to_matrix(pose)[:3, :3], cv2.Rodrigues(np.array(rvec))[0], atol=1e-12)
        assert np.allclose(pose_to_matrix(pose_from_matrix(pose_to_matrix(pose))), pose_to_matrix(pose), atol=1e-12)
        assert np.allclose(pose_to_matrix(pose_from_rvec_tvec(*to_rvec_tvec(pose))), pose_to_matrix(pose), atol=1e-12)


def test_scaled_intrinsics_project_to_the_same_image_position() -> None:
    """Image edges are invariant: pixel (-0.5, -0.5) is the corner at every resolution."""
    double = CAMERA.scaled(1280, 960)
    points = np.array([[0.1, -0.2, 1.0], [0.0, 0.0, 2.0]])
    assert np.allclose(double.project(points), 2.0 * (CAMERA.project(points) + 0.5) - 0.5)


def test_intrinsics_of_a_real_camera_are_read(rgbd: Path) -> None:
    camera = parse_camera((rgbd / "camera-intrinsics.txt").read_text(), 640, 480)
    assert (camera.fx, camera.cx, camera.width) == (585.0, 320.0, 640)


def test_invalid_intrinsics_files_are_rejected() -> None:
    text = "width = 640\nheight = 480\nfx = 585\nfy = 584.0\ncx = 319.5\ncy = 239.5\n"
    assert parse_camera(text + "distortion = [0.08, -0.18, 0.0008, -0.0005, 0.01]") == CAMERA
    with pytest.raises(CameraError, match="cy is missing"):
        parse_camera(text.replace("cy", "c_y"))
    with pytest.raises(CameraError, match="3x3 matrix nor TOML"):
        parse_camera("%YAML:1.0")
    with pytest.raises(CameraError, match="3 distortion coefficients: 0, 4, 5 or 8"):
        parse_camera(text + "distortion = [1, 2, 3]")
    with pytest.raises(CameraError, match="not a number"):
        parse_camera(text.replace("585", '"wide"'))
    with pytest.raises(CameraError, match="above 0"):
        parse_camera("585 0 320 0 585 240 0 0 1")
