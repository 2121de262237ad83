"""A camera: intrinsics with lens distortion, points to pixels and back, and poses as matrices and rotation vectors.

Camera frame as OpenCV: x right, y down, z into the scene. A pixel's centre has whole coordinates. Distortion is the
Brown-Conrady model with OpenCV's coefficients `k1, k2, p1, p2[, k3[, k4, k5, k6]]`.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from anchors.lie import Array, quat_exp, quat_from_matrix, quat_to_matrix, to_quat, to_vec3
from anchors.pose import PoseTuple, quat_to_rotvec

_N_DISTORTION: Final = (0, 4, 5, 8)


class CameraError(ValueError):
    """Invalid intrinsics."""


@dataclass(frozen=True)
class CameraModel:
    """Intrinsics of a camera, in OpenCV's model.

    Attributes:
        width, height: Size of its pictures [px].
        fx, fy: Focal lengths [px].
        cx, cy: Principal point [px]; the centre of the first pixel is at 0.
        distortion: None, or 4, 5 or 8 coefficients of the lens (k1, k2, p1, p2, k3, ...).

    Raises:
        CameraError: A value is out of range.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not all(map(math.isfinite, values)) or min(self.fx, self.fy) <= 0.0 or min(self.width, self.height) <= 0:
            raise CameraError("intrinsics must be finite, focal lengths and image size above 0")
        if len(self.distortion) not in _N_DISTORTION:
            raise CameraError(f"{len(self.distortion)} distortion coefficients: 0, 4, 5 or 8 of OpenCV's model")

    @property
    def matrix(self) -> Array:
        """Matrix of the projection (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def coefficients(self) -> Array:
        """Coefficients of the lens, zeros without distortion."""
        return np.array(self.distortion if self.distortion else (0.0,) * 4)

    def scaled(self, width: int, height: int) -> CameraModel:
        """Return the same camera read out at another resolution with the same field of view.

        Args:
            width: Width of its pictures [px].
            height: Their height [px].
        """
        sx, sy = width / self.width, height / self.height
        # Pixel centres are whole numbers: the image's left edge is at -0.5.
        return CameraModel(
            width,
            height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
            self.distortion,
        )

    def project(self, points: Array, T_camera_points: PoseTuple | None = None) -> Array:
        """Project points to pixels.

        Args:
            points: Shape (n, 3) [m].
            T_camera_points: Pose of their frame in the optical frame; None: they are in the optical frame.

        Returns:
            Pixels, shape (n, 2).
        """
        pose = T_camera_points if T_camera_points is not None else ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        return self.project_with_jacobian(points, *to_rvec_tvec(pose))[0]

    def project_with_jacobian(self, points: Array, rvec: Array, tvec: Array) -> tuple[Array, Array]:
        """Project points to pixels.

        Args:
            points: Shape (n, 3) [m].
            rvec: Rotation vector (3,) [rad] from their frame to the optical frame.
            tvec: Position (3,) [m] of their frame in the optical frame.

        Returns:
            Pixels (n, 2), and their derivatives by rotation vector and translation (2 n, 6).
        """
        import cv2

        found: Any = cv2.projectPoints(
            np.ascontiguousarray(points).reshape(-1, 1, 3), rvec, tvec, self.matrix, self.coefficients
        )
        return np.asarray(found[0]).reshape(-1, 2), np.asarray(found[1])[:, :6]

    def undistort(self, pixels: Array) -> Array:
        """Return undistorted coordinates (x / z, y / z), shape (n, 2), of pixels (n, 2)."""
        import cv2

        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
        points = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        found: Any = cv2.undistortPoints(
            points, self.matrix, self.coefficients, R=np.eye(3), P=np.eye(3), criteria=criteria
        )
        return np.asarray(found).reshape(-1, 2)


def parse_camera(text: str, width: int = 0, height: int = 0) -> CameraModel:
    """Parse intrinsics: TOML (`width, height, fx, fy, cx, cy`, optional `distortion`), or a bare 3x3 matrix.

    Args:
        text: Contents of the file.
        width: Image width [px], needed for a matrix.
        height: Image height [px], needed for a matrix.

    Raises:
        CameraError: The text is neither, or the values are invalid.
    """
    matrix = _parse_matrix(text)
    if matrix is not None:
        return CameraModel(width, height, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    wanted = "width, height, fx, fy, cx, cy [pixels], and if known distortion = [k1, k2, p1, p2, k3]"
    try:
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also a number or a nesting that Python does not take
        raise CameraError(f"neither a 3x3 matrix nor TOML ({error}); wanted: {wanted}") from error
    try:
        fx, fy, cx, cy = (float(table[key]) for key in ("fx", "fy", "cx", "cy"))
        width, height = int(table.get("width", width)), int(table.get("height", height))
        return CameraModel(width, height, fx, fy, cx, cy, tuple(float(k) for k in table.get("distortion", ())))
    except KeyError as error:
        raise CameraError(f"{error.args[0]} is missing; wanted: {wanted}") from error
    except (TypeError, ValueError) as error:
        if isinstance(error, CameraError):
            raise
        raise CameraError(f"not a number ({error}); wanted: {wanted}") from error


def _parse_matrix(text: str) -> Array | None:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        return None
    return values.reshape(3, 3) if values.size == 9 else None


def to_rvec_tvec(pose: PoseTuple) -> tuple[Array, Array]:
    """Return rotation vector and translation of a pose, as OpenCV takes them."""
    return np.array(quat_to_rotvec(pose[1])), np.array(pose[0])


def pose_from_rvec_tvec(rvec: Array, tvec: Array) -> PoseTuple:
    """Return the pose of a rotation vector and translation."""
    return to_vec3(np.ravel(tvec)), to_quat(quat_exp(np.ravel(rvec)))


def pose_to_matrix(pose: PoseTuple) -> Array:
    """Return the matrix (4, 4) of a pose."""
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = quat_to_matrix(np.array(pose[1])), pose[0]
    return M


def pose_from_matrix(matrix: Array) -> PoseTuple:
    """Return the pose of a matrix (4, 4); its rotation is made orthonormal (nearest in the least-squares sense)."""
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return to_vec3(matrix[:3, 3]), to_quat(quat_from_matrix(turn))


def apply_increment(matrix: Array, step: Array) -> Array:
    """Return the pose (4, 4) moved by `step[:3]` [m], and rotated on the left about its own origin by `step[3:]`."""
    out = np.eye(4)
    out[:3, :3] = quat_to_matrix(quat_exp(step[3:])) @ matrix[:3, :3]
    out[:3, 3] = matrix[:3, 3] + step[:3]
    return out
