"""Fit the known print to the photograph: the pose at which the rendered sheet resembles the picture most.

Corners found by a detector are good to a few tenths of a pixel, and off in the same direction where a marker is a few
pixels wide. All edges of the print together are more accurate: this fits pose, brightness and contrast (both with a
slope across the sheet, for uneven light) to all pixels at once by Gauss-Newton (Lucas and Kanade 1981; Baker and
Matthews 2004), with Huber weights against occlusions, and tries a few widths of blur. Text and ruler of the page are
left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from anchors.camera import CameraModel, apply_increment, pose_from_matrix, pose_to_matrix
from anchors.lie import Array, skew
from anchors.pose import PoseTuple
from anchors.sheet import Sheet

Picture = NDArray[np.float32]

#: Texels of the print per edge of the code.
_TEXELS: Final = 640
#: White border around the markers that is used, as a share of the edge: less than every printer leaves.
_BORDER: Final = 0.025
_MAX_PIXELS: Final = 30_000  # of the part of the picture that is used; larger ones are averaged first
#: Where a module is a few pixels, the print is rendered on a finer grid, each way, and averaged as a sensor does.
_FINER: Final = 2
_FINE_ENOUGH_PX: Final = 12.0  # per module
_ITERATIONS: Final = 15
#: Standard deviations of lens and sensor together that are tried [px].
_BLURS: Final = (0.55, 0.85, 1.3, 2.0)
_HUBER: Final = 2.0
_MAX_TURN_RAD: Final = 0.1  # in one iteration: further away the picture is no longer linear in the pose
#: The residual is not white noise: errors of adjacent pixels are correlated. Measured with `tools/detection_table.py`.
_CORRELATED: Final = 3.0
#: Error of camera and print that no picture shows, as if every corner were off by this [px].
_FLOOR_PX: Final = 0.02


@dataclass(frozen=True)
class PhotometricFit:
    """`covariance`: 6x6 of position of the sheet's origin [m] and rotation [rad], camera frame. `rms`: residual as a
    share of the contrast between paper and ink."""

    T_camera_sheet: PoseTuple
    covariance: Array
    rms: float


@dataclass(frozen=True)
class _View:
    """The part of the picture that shows the sheet: grey values, and undistorted rays of the pixels' centres and of a
    grid `finer` times as fine."""

    grey: Picture
    rays: tuple[Array, Array]
    fine_rays: tuple[Array, Array]
    finer: int
    camera: CameraModel


def fit_print(
    grey: NDArray[np.uint8], camera: CameraModel, sheet: Sheet, T_camera_sheet: PoseTuple
) -> PhotometricFit | None:
    """Refine a pose that is correct to about a pixel; `None` if it does not converge or too little is visible."""
    view = _crop(grey, camera, sheet, T_camera_sheet)
    if view is None:
        return None
    M = pose_to_matrix(T_camera_sheet)
    first = _fit(view, sheet, M, _BLURS[1], _ITERATIONS)
    if first is None:
        return None
    fits = [(blur, first if blur == _BLURS[1] else _fit(view, sheet, first[0], blur, 1)) for blur in _BLURS]
    best, coarse = min(((b, f) for b, f in fits if f is not None), key=lambda found: found[1][2])
    fit = coarse if best == _BLURS[1] else _fit(view, sheet, coarse[0], best, _ITERATIONS)
    if fit is None:
        return None
    M, normal, rms = fit
    covariance = _CORRELATED * np.linalg.inv(normal) + _floor_covariance(camera, sheet, M)
    # From the camera's origin, about which the increments turn, to that of the sheet.
    shift = np.eye(6)
    shift[:3, 3:] = -skew(M[:3, 3])
    return PhotometricFit(pose_from_matrix(M), shift @ covariance @ shift.T, rms)


def _crop(grey: NDArray[np.uint8], camera: CameraModel, sheet: Sheet, pose: PoseTuple) -> _View | None:
    import cv2

    w, h = (half * sheet.edge_m for half in _half_print(sheet))
    corners = camera.project(np.array([(-w, h, 0.0), (w, h, 0.0), (w, -h, 0.0), (-w, -h, 0.0)]), pose)
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 3, (camera.width, camera.height))
    if not np.all(high - low > 8):
        return None
    part: Any = grey[low[1] : high[1], low[0] : high[0]]
    n = int(np.ceil(np.sqrt(part.size / _MAX_PIXELS)))
    if n > 1:
        part = part[: part.shape[0] // n * n, : part.shape[1] // n * n]
        part = cv2.resize(part, (part.shape[1] // n, part.shape[0] // n), interpolation=cv2.INTER_AREA)
    small = camera.scaled(camera.width // n, camera.height // n) if n > 1 else camera
    finer = _FINER if n > 1 or sheet.edge_m / 25.0 * small.fx < _FINE_ENOUGH_PX * pose[0][2] else 1
    return _View(
        part.astype(np.float32),
        _compute_rays(camera, low, n, part.shape, 1),
        _compute_rays(camera, low, n, part.shape, finer),
        finer,
        small,
    )


def _compute_rays(
    camera: CameraModel, low: NDArray[Any], n: int, shape: tuple[int, int], finer: int
) -> tuple[Array, Array]:
    """Return undistorted coordinates of a picture's part that begins at `low` and was averaged over n x n pixels."""
    v, u = ((np.arange(size * finer) + 0.5) * n / finer - 0.5 for size in shape)
    uu, vv = np.meshgrid(u + low[0], v + low[1])
    rays = camera.undistort(np.column_stack([uu.ravel(), vv.ravel()]))
    return rays[:, 0].reshape(uu.shape), rays[:, 1].reshape(uu.shape)


def _fit(view: _View, sheet: Sheet, M: Array, blur: float, iterations: int) -> tuple[Array, Array, float] | None:
    """Return the pose (4, 4), its normal matrix (6, 6) over the variance of a pixel, and the relative residual."""
    v, u = np.mgrid[-1.0 : 1.0 : view.grey.shape[0] * 1j, -1.0 : 1.0 : view.grey.shape[1] * 1j]
    for _ in range(iterations):
        rendered, inside, slopes = _render(view, sheet, M, blur)
        if np.count_nonzero(inside) < 200:
            return None
        P, seen, uu, vv = rendered[inside], view.grey[inside].astype(np.float64), u[inside], v[inside]
        one = np.ones_like(uu)
        light = np.column_stack([one, uu, vv, P, P * uu, P * vv])
        plain = np.linalg.solve(light.T @ light + 1e-9 * np.eye(6), light.T @ seen)
        contrast = plain[3] + plain[4] * uu + plain[5] * vv
        J = np.column_stack([light, contrast[:, None] * slopes[inside]])
        r = seen - light @ plain
        scale = 1.4826 * float(np.median(np.abs(r))) + 1e-6
        weights = np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(r), 1e-9))
        normal = J.T @ (J * weights[:, None])
        try:
            step = np.linalg.solve(normal, J.T @ (weights * r))[6:]
        except np.linalg.LinAlgError:
            return None
        step = step * min(1.0, _MAX_TURN_RAD / max(float(np.linalg.norm(step[3:])), 1e-12))
        M = apply_increment(np.eye(4), step) @ M  # about the camera's origin
        if float(np.abs(step).max()) < 1e-6:  # a micrometre, a microradian
            break
    mean_contrast = float(np.mean(contrast))
    if mean_contrast <= 1.0:  # paper darker than ink, or nothing to see
        return None
    variance = float(np.sum(weights * r * r) / max(len(r) - 12, 1))
    # Brightness and contrast are solved along: the pose's part of the inverse is what counts.
    pose_normal = np.linalg.inv(np.linalg.inv(normal)[6:, 6:]) / max(variance, 1e-6)
    return M, pose_normal, float(np.sqrt(np.mean(r * r))) / mean_contrast


def _render(view: _View, sheet: Sheet, M: Array, blur: float) -> tuple[Array, NDArray[np.bool_], Array]:
    """Return the print as the camera should see it, the mask of pixels that count, and the derivative of each by
    (position, rotation) of the sheet, shape (rows, columns, 6)."""
    import cv2

    texels_per_sample = _TEXELS / sheet.edge_m * float(np.linalg.norm(M[:3, 3])) / view.camera.fx / view.finer
    levels = _build_pyramid(sheet.anchor_id, sheet.layout)
    half_width, half_height = _half_print(sheet)
    level = int(np.clip(np.log2(max(texels_per_sample, 1.0)), 0, len(levels) - 1))
    per_edge = _TEXELS / 2**level
    X, Y, _ = _intersect_sheet(sheet, M, *view.fine_rays)
    U = ((X + half_width) * per_edge - 0.5).astype(np.float32)
    V = ((half_height - Y) * per_edge - 0.5).astype(np.float32)
    seen: Any = cv2.remap(levels[level], np.nan_to_num(U, nan=-1e6), np.nan_to_num(V, nan=-1e6),
                          cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, 1.0)  # fmt: skip
    seen = cv2.GaussianBlur(seen, (0, 0), blur * view.finer)
    if view.finer > 1:
        seen = cv2.resize(seen, view.grey.shape[::-1], interpolation=cv2.INTER_AREA)
    rendered = np.asarray(seen, dtype=np.float64)
    down, across = np.gradient(rendered)
    # By the point's movement in normalised coordinates, which moves the print the other way.
    du: Array = -view.camera.fx * np.asarray(across)
    dv: Array = -view.camera.fy * np.asarray(down)
    x, y = view.rays
    dw = -(du * x + dv * y)
    X, Y, s = _intersect_sheet(sheet, M, x, y)
    slopes = np.stack([du * s, dv * s, dw * s, *_rotation_derivatives(du, dv, dw, x, y)], axis=2)
    ax, ay = np.abs(X), np.abs(Y)
    inside = (ax < half_width) & (ay < half_height)
    written = (ay > 0.5 + 2 * _BORDER) & (ax < sheet.shape.half_width - sheet.shape.marker_edge - _BORDER)
    return rendered, inside & ~written, np.nan_to_num(slopes)


def _intersect_sheet(sheet: Sheet, M: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return where rays meet the sheet, in edges of the code, and 1 / depth [1/m]; NaN behind the camera."""
    H = np.linalg.inv(M[:3, [0, 1, 3]])
    s = H[2, 0] * x + H[2, 1] * y + H[2, 2]
    s = np.where(s > 1e-6, s, np.nan)
    X = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / s
    Y = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / s
    return X / sheet.edge_m, Y / sheet.edge_m, s


def _rotation_derivatives(du: Array, dv: Array, dw: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return derivatives by a rotation about the camera's origin: (x, y, 1) x (du, dv, dw), the depth cancels."""
    return y * dw - dv, du - x * dw, x * dv - y * du


def _half_print(sheet: Sheet) -> tuple[float, float]:
    """Return half width and height of the print with its border, in edges of the code."""
    return sheet.shape.half_width + _BORDER, sheet.shape.half_height + _BORDER


@lru_cache(maxsize=32)
def _build_pyramid(anchor_id: str, layout: int) -> tuple[Picture, ...]:
    """Return the print with its border, 1 for paper and 0 for ink, and an image pyramid of it."""
    sheet = Sheet(anchor_id, 1.0, layout=layout)
    w, h = _half_print(sheet)
    columns, rows = round(2 * w * _TEXELS), round(2 * h * _TEXELS)
    ink = np.zeros((rows, columns), dtype=np.float32)
    for rects in sheet.list_black_rects().values():
        for r in rects:
            across = _cover_cells((r.x + w) * _TEXELS, r.width * _TEXELS, columns)
            down = _cover_cells((h - r.y - r.height) * _TEXELS, r.height * _TEXELS, rows)
            (i,), (j,) = np.nonzero(down), np.nonzero(across)
            ink[i[0] : i[-1] + 1, j[0] : j[-1] + 1] += np.outer(down[i], across[j]).astype(np.float32)
    levels: list[Picture] = [(1.0 - np.minimum(ink, 1.0)).astype(np.float32)]
    while min(levels[-1].shape) > 32:
        last = levels[-1][: levels[-1].shape[0] // 2 * 2, : levels[-1].shape[1] // 2 * 2]
        levels.append(last.reshape(last.shape[0] // 2, 2, last.shape[1] // 2, 2).mean(axis=(1, 3)).astype(np.float32))
    return tuple(levels)


def _cover_cells(start: float, length: float, n: int) -> Array:
    """Return the share of each of n cells that the interval covers."""
    cells = np.arange(n)
    covered: Array = np.clip(np.minimum(cells + 1, start + length) - np.maximum(cells, start), 0.0, 1.0)
    return covered


def _floor_covariance(camera: CameraModel, sheet: Sheet, M: Array) -> Array:
    """Return the covariance (6, 6) of increments about the camera's origin if every corner had an error of
    `_FLOOR_PX`."""
    points = sheet.marker_corners.reshape(-1, 3) @ M[:3, :3].T + M[:3, 3]
    x, y, s = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2], 1.0 / points[:, 2]
    rows = []
    for fu, fv in ((camera.fx, 0.0), (0.0, camera.fy)):
        du, dv = np.full_like(x, fu), np.full_like(x, fv)
        dw = -(du * x + dv * y)
        rows.append(np.column_stack([du * s, dv * s, dw * s, *_rotation_derivatives(du, dv, dw, x, y)]))
    J = np.concatenate(rows)
    return np.asarray(np.linalg.inv(J.T @ J) * _FLOOR_PX**2)
