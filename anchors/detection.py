"""Detect printed sheets in camera pictures: `T_camera_sheet` with covariance, and the mirrored pose of nearly the same
image.

Markers first (OpenCV's detector; where some are missing, once more in the picture enlarged twice), all markers of one
sheet as one board, then the whole print is fitted to the picture (`anchors.photometric`). A plane seen from afar has
two poses that look nearly alike (Collins and Bartoli 2014, IPPE): both are refined, the better one is the result, and
`mirrored_ratio` says how much worse the other one fits. Bare codes: `detect_codes`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from anchors.camera import CameraModel, pose_from_rvec_tvec, to_rvec_tvec
from anchors.lie import Array, left_jacobian
from anchors.photometric import PhotometricFit, fit_print
from anchors.pose import PoseTuple
from anchors.sheet import LAYOUTS, Sheet, load_dictionary

Image = NDArray[np.uint8]

#: Minimum number of its four markers by which a sheet is identified: a single one may be misread from clutter.
MIN_MARKERS: Final = 2
#: Corners of a marker that lie further than this from where the rest of the board puts them are not of this board [px].
_MAX_CORNER_ERROR_PX: Final = 2.5
#: Standard deviation of a detected corner [px], used if the print cannot be fitted to the picture.
_CORNER_SIGMA_PX: Final = 0.6
_CODE_CORNER_SIGMA_PX: Final = 1.2  # of a bare code, whose corners are not refined
_ENLARGE: Final = 2
_MIN_PERIMETER_PX: Final = 24.0  # smaller ones cannot be read
#: Samples of a module, per axis, when it is read. OpenCV's 4 read a third fewer of the markers at the end of the range.
_PIXELS_PER_CELL: Final = 8
_MAX_ENLARGED_PIXELS: Final = 5_000_000
#: A mirrored pose that fits the corners worse than by this factor is not considered any further.
_CLEAR_RATIO: Final = 4.0
#: Ratios of residuals below which both poses fit alike: of thousands of pixels, and of a few corners.
_AMBIGUOUS_PRINT: Final = 1.05
_AMBIGUOUS_CORNERS: Final = 2.0
#: Number of markers that must agree if the print cannot be fitted to the picture.
_MIN_MARKERS_ALONE: Final = 3
#: A registered print differs from the picture by at most this share of its contrast.
_MAX_RMS: Final = 0.25


@dataclass(frozen=True)
class SheetDetection:
    """One sheet in one picture.

    `covariance`: 36 values, 6x6 row-major, (x, y, z [m], rx, ry, rz [rad]), camera frame, at the sheet's origin.
    `mirrored`, `mirrored_ratio`: the other pose that a plane allows, and its residual over that of the result, at least
    1: near 1 the two cannot be distinguished (`ambiguous`). `reprojection_px`: rms of the
    detected corners. `registered`: whether the whole print was used. `layout`: that of the print.
    """

    anchor_id: str
    kind: str
    edge_m: float
    T_camera_sheet: PoseTuple
    covariance: tuple[float, ...]
    mirrored: PoseTuple | None
    mirrored_ratio: float
    reprojection_px: float
    markers: int
    registered: bool
    layout: int

    @property
    def ambiguous(self) -> bool:
        """True if both poses fit equally well; an estimator should not use such a detection."""
        bound = _AMBIGUOUS_PRINT if self.registered else _AMBIGUOUS_CORNERS
        return self.mirrored is not None and self.mirrored_ratio < bound


class DetectionError(ValueError):
    """A picture or a set of sheets that cannot be used."""


class SheetDetector:
    """Detector of known sheets in pictures of one camera, in every layout that was printed."""

    def __init__(self, sheets: Sequence[Sheet], camera: CameraModel) -> None:
        names = [sheet.anchor_id for sheet in sheets]
        if len(set(names)) != len(names):
            raise DetectionError(f"two sheets have the same id: {', '.join(sorted(names))}")
        self.sheets = tuple(sheets)
        self._prints = [[replace(sheet, layout=number) for number in LAYOUTS] for sheet in sheets]
        self.camera = camera
        longer = max(camera.width, camera.height)
        self._detectors = {scale: _marker_detector(longer * scale) for scale in (1, _ENLARGE)}

    def detect(self, image: NDArray[Any]) -> list[SheetDetection]:
        """Return the sheets detected in a picture, shape (height, width) or (height, width, 3) uint8.

        Raises:
            DetectionError: The picture is not one of this camera.
        """
        grey = to_grey(image, self.camera)
        found = self._find_markers(grey, 1)
        if any(not _is_complete(prints, found) for prints in self._prints) and (
            grey.size * _ENLARGE**2 <= _MAX_ENLARGED_PIXELS
        ):
            for marker_id, corners in self._find_markers(grey, _ENLARGE).items():
                found.setdefault(marker_id, corners)
        sightings = [self._detect_print(prints, found, grey) for prints in self._prints]
        return [one for one in sightings if one is not None]

    def _find_markers(self, grey: Image, scale: int) -> dict[int, list[Array]]:
        """Return corners of markers by id, shape (4, 2) [px of the picture]; an id may be found more than once."""
        import cv2

        picture: Any = grey
        if scale != 1:
            picture = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        corners, ids, _ = self._detectors[scale].detectMarkers(picture)
        found: dict[int, list[Array]] = {}
        for marker_id, four in zip([] if ids is None else ids.ravel().tolist(), corners, strict=True):
            found.setdefault(marker_id, []).append((four.reshape(4, 2).astype(np.float64) + 0.5) / scale - 0.5)
        return found

    def _detect_print(
        self, prints: Sequence[Sheet], found: Mapping[int, list[Array]], grey: Image
    ) -> SheetDetection | None:
        """Return the detection with most markers: a sheet has one layout."""
        seen = [one for sheet in prints if (one := self._detect_sheet(sheet, found, grey)) is not None]
        return max(seen, key=lambda one: one.markers, default=None)

    def _detect_sheet(self, sheet: Sheet, found: Mapping[int, list[Array]], grey: Image) -> SheetDetection | None:
        seen = {
            number: candidates[0]
            for number, marker_id in enumerate(sheet.marker_ids)
            # Found twice: one belongs to another sheet or to the room.
            if len(candidates := found.get(marker_id, [])) == 1
        }
        poses = _find_consistent_markers(sheet, seen, self.camera)
        if poses is None:
            return None
        return _refine_photometric(sheet, poses, grey, self.camera)


def _is_complete(prints: Sequence[Sheet], found: Mapping[int, list[Array]]) -> bool:
    """Return whether every marker of one of the layouts was found."""
    return any(all(marker_id in found for marker_id in sheet.marker_ids) for sheet in prints)


@dataclass(frozen=True)
class _Poses:
    """Two poses of a plane by its corners, better one first, with their rms [px]."""

    best: tuple[PoseTuple, float]
    mirrored: tuple[PoseTuple, float] | None
    points: Array
    pixels: Array
    markers: int


def detect_codes(image: NDArray[Any], camera: CameraModel, edges_m: Mapping[str, float]) -> list[SheetDetection]:
    """Detect bare QR codes whose text and edge length [m] are known, at half the range of the markers of a sheet."""
    import cv2

    grey = to_grey(image, camera)
    found, texts, corners, _ = cv2.QRCodeDetectorAruco().detectAndDecodeMulti(grey)
    sightings = []
    for text, four in zip(texts if found else (), corners if found else (), strict=True):
        if text not in edges_m:
            continue
        sheet = Sheet(text, edges_m[text])
        poses = _plane_poses(sheet.code_corners, np.asarray(four, dtype=np.float64), camera, 0)
        if poses is not None:
            sightings.append(replace(_detect_by_corners(sheet, poses, camera, _CODE_CORNER_SIGMA_PX), kind="qr"))
    return sightings


def to_grey(image: NDArray[Any], camera: CameraModel) -> Image:
    """Return the picture as grey values (height, width) uint8.

    Raises:
        DetectionError: The picture is not one of this camera.
    """
    import cv2

    if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] not in (3, 4)):
        raise DetectionError(f"a picture is (height, width[, 3]) uint8, not {image.shape} {image.dtype}")
    if image.shape[:2] != (camera.height, camera.width):
        raise DetectionError(
            f"the picture is {image.shape[1]} x {image.shape[0]}, the intrinsics are for {camera.width} x "
            f"{camera.height}: they must belong to the same resolution"
        )
    grey: Any = image if image.ndim == 2 else cv2.cvtColor(image[:, :, :3], cv2.COLOR_BGR2GRAY)
    return np.ascontiguousarray(grey)


def _marker_detector(longer_side_px: int) -> Any:
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.minMarkerPerimeterRate = _MIN_PERIMETER_PX / longer_side_px
    parameters.relativeCornerRefinmentWinSize = 0.2
    parameters.perspectiveRemovePixelPerCell = _PIXELS_PER_CELL
    return cv2.aruco.ArucoDetector(load_dictionary(), parameters)


def _find_consistent_markers(sheet: Sheet, seen: Mapping[int, Array], camera: CameraModel) -> _Poses | None:
    """Return poses by the largest set of markers that agree on one board; of equally large ones, the best fit."""
    for n in range(len(seen), MIN_MARKERS - 1, -1):
        agreeing = []
        for numbers in combinations(seen, n):
            points = sheet.marker_corners[list(numbers)].reshape(-1, 3)
            pixels = np.concatenate([seen[number] for number in numbers])
            poses = _plane_poses(points, pixels, camera, n)
            if poses is not None and _largest_error(poses, poses.best[0], camera) <= _MAX_CORNER_ERROR_PX:
                agreeing.append(poses)
        if agreeing:
            return min(agreeing, key=lambda poses: poses.best[1])
    return None


def _largest_error(poses: _Poses, pose: PoseTuple, camera: CameraModel) -> float:
    return float(np.linalg.norm(camera.project(poses.points, pose) - poses.pixels, axis=1).max())


def _plane_poses(points: Array, pixels: Array, camera: CameraModel, markers: int) -> _Poses | None:
    import cv2

    # Undistorted to the last bit first: solvePnP does so to a few hundredths of a pixel only.
    normalised = camera.undistort(pixels)
    ok, rvecs, tvecs, _ = cv2.solvePnPGeneric(
        points.reshape(-1, 1, 3), normalised.reshape(-1, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    if not ok:
        return None
    solved: list[tuple[PoseTuple, float]] = []
    for rvec, tvec in zip(rvecs, tvecs, strict=True):
        pose = _refine_corners(points, pixels, camera, np.asarray(rvec).ravel(), np.asarray(tvec).ravel())
        if pose is not None:
            rms = float(np.sqrt(np.mean(np.sum((camera.project(points, pose) - pixels) ** 2, axis=1))))
            solved.append((pose, rms))
    if not solved:
        return None
    solved.sort(key=lambda one: one[1])
    other = solved[1] if len(solved) > 1 and _are_distinct(solved[0][0], solved[1][0]) else None
    return _Poses(solved[0], other, points, pixels, markers)


def _refine_corners(points: Array, pixels: Array, camera: CameraModel, rvec: Array, tvec: Array) -> PoseTuple | None:
    """Minimize the reprojection error from one of the two starts; `None` if the result lies behind the camera."""
    from scipy.optimize import least_squares

    if not (np.all(np.isfinite(rvec)) and np.all(np.isfinite(tvec)) and tvec[2] > 0.0):
        return None
    solved = least_squares(
        lambda p: (camera.project_with_jacobian(points, p[:3], p[3:])[0] - pixels).ravel(),
        np.concatenate([rvec, tvec]),
        jac=lambda p: camera.project_with_jacobian(points, p[:3], p[3:])[1],
        method="lm",
        max_nfev=50,
    )
    return pose_from_rvec_tvec(solved.x[:3], solved.x[3:]) if solved.x[5] > 0.0 else None


def _are_distinct(a: PoseTuple, b: PoseTuple) -> bool:
    return abs(sum(p * q for p, q in zip(a[1], b[1], strict=True))) < math.cos(0.5 * math.radians(0.5))


def _refine_photometric(sheet: Sheet, poses: _Poses, grey: Image, camera: CameraModel) -> SheetDetection | None:
    """Return the better of both poses after the photometric fit; by corners alone where that fails."""
    by_corners = _detect_by_corners(sheet, poses, camera)
    starts = [poses.best[0]]
    if poses.mirrored is not None and by_corners.mirrored_ratio < _CLEAR_RATIO:
        starts.append(poses.mirrored[0])
    tried = [fit_print(grey, camera, sheet, start) for start in starts]
    right = [
        one
        for one in tried
        if one is not None
        and one.rms < _MAX_RMS
        and _largest_error(poses, one.T_camera_sheet, camera) <= _MAX_CORNER_ERROR_PX
    ]
    if not right:
        return by_corners if poses.markers >= _MIN_MARKERS_ALONE else None
    best = min(right, key=lambda one: one.rms)
    mirrored, ratio = by_corners.mirrored, by_corners.mirrored_ratio
    if len(starts) > 1:
        mirrored, ratio = _compare_mirrored(best, starts, tried)
    return replace(
        by_corners,
        T_camera_sheet=best.T_camera_sheet,
        covariance=tuple(float(v) for v in best.covariance.ravel()),
        mirrored=mirrored,
        mirrored_ratio=ratio,
        registered=True,
    )


def _compare_mirrored(
    best: PhotometricFit, starts: Sequence[PoseTuple], tried: Sequence[PhotometricFit | None]
) -> tuple[PoseTuple | None, float]:
    """Return the pose that the other start leads to and its residual ratio; `None` if both lead to the same pose."""
    for start, other in zip(starts, tried, strict=True):
        if other is None:
            return start, 1.0  # no fit, so nothing was compared
        if _are_distinct(best.T_camera_sheet, other.T_camera_sheet):
            return other.T_camera_sheet, other.rms / max(best.rms, 1e-9)
    return None, math.inf


def _detect_by_corners(
    sheet: Sheet, poses: _Poses, camera: CameraModel, sigma_px: float = _CORNER_SIGMA_PX
) -> SheetDetection:
    pose, rms = poses.best
    rvec, tvec = to_rvec_tvec(pose)
    J = camera.project_with_jacobian(poses.points, rvec, tvec)[1]
    per_axis = max(rms / math.sqrt(2.0), sigma_px)
    by_rvec: Array = np.asarray(np.linalg.inv(J.T @ J) * per_axis**2, dtype=np.float64)
    mirrored, ratio = None, math.inf
    if poses.mirrored is not None:
        mirrored, ratio = poses.mirrored[0], poses.mirrored[1] / max(rms, 1e-9)
    return SheetDetection(
        anchor_id=sheet.anchor_id,
        kind="board",
        edge_m=sheet.edge_m,
        T_camera_sheet=pose,
        covariance=tuple(float(v) for v in _to_pose_covariance(by_rvec, rvec).ravel()),
        mirrored=mirrored,
        mirrored_ratio=ratio,
        reprojection_px=rms,
        markers=poses.markers,
        registered=False,
        layout=sheet.layout,
    )


def _to_pose_covariance(by_rvec: Array, rvec: Array) -> Array:
    """Convert a covariance (6, 6) of (rotation vector, translation) to (translation, small rotation in the camera
    frame) by the left Jacobian of the exponential map (Barfoot 2017, section 7.1.5)."""
    turn = np.zeros((6, 6))
    turn[:3, 3:] = np.eye(3)
    turn[3:, :3] = left_jacobian(rvec)
    return np.asarray(turn @ by_rvec @ turn.T)
