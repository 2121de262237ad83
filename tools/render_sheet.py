"""Photographs of a printed sheet, computed: an exact pinhole camera with lens distortion looks at the rasterised PDF.

Every pixel is the mean of n x n rays (antialiasing); each ray is undistorted by Newton's method, meets the plane of the
paper, and samples an area-averaged copy of the page of fitting resolution. Then the lens blurs, light falls unevenly,
the sensor adds shot and read noise, and 8 bits remain. Used by `detection_table.py` and the tests.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from anchors.camera import CameraModel, pose_to_matrix
from anchors.pose import PoseTuple

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
DPI = 400.0
MM_PER_INCH = 25.4


@dataclass(frozen=True)
class Conditions:
    """Of one photograph. Grey levels of 255; `blur_px`: standard deviation of the lens; `noise`: of reading a pixel;
    `shot`: electrons' share, variance per grey level; `light`: how far brightness falls across the picture."""

    white: float = 190.0
    black: float = 30.0
    background: float = 95.0
    blur_px: float = 0.6
    noise: float = 1.5
    shot: float = 0.02
    light: float = 0.45
    rays: int = 3  # per pixel and axis


class Page:
    """A rasterised page as reflectance 0 to 1, in ever coarser copies. Origin in the middle of the page."""

    def __init__(self, pdf: bytes) -> None:
        import pypdfium2

        page = pypdfium2.PdfDocument(pdf)[0]
        points = page.get_size()
        picture: Any = page.render(scale=DPI / 72.0, grayscale=True).to_numpy()
        grey = np.asarray(picture, dtype=np.float32).reshape(picture.shape[:2]) / 255.0
        self.size_m = tuple(p / 72.0 * MM_PER_INCH / 1000.0 for p in points)
        self.levels = [grey]
        while min(self.levels[-1].shape) > 64:
            last = self.levels[-1]
            even = last[: last.shape[0] // 2 * 2, : last.shape[1] // 2 * 2]
            self.levels.append(even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).mean(axis=(1, 3)))

    def sample(self, x: Array, y: Array, spacing_m: float) -> tuple[Array, Array]:
        """Reflectance at points of the sheet frame, and whether they are on the paper."""
        (width, height), (rows, columns) = self.size_m, self.levels[0].shape
        texel = width / columns
        level = int(np.clip(np.floor(np.log2(max(spacing_m / texel, 1.0))), 0, len(self.levels) - 1))
        # The page was fitted to a whole number of pixels, so those need not be quite square.
        u = (x / width + 0.5) * columns / 2**level - 0.5
        v = (0.5 - y / height) * rows / 2**level - 0.5
        inside = (np.abs(x) < 0.5 * self.size_m[0]) & (np.abs(y) < 0.5 * self.size_m[1])
        seen: Any = cv2.remap(
            self.levels[level], u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE
        )
        return np.asarray(seen, dtype=np.float64), inside


def photograph(
    pages: list[tuple[Page, PoseTuple]],
    camera: CameraModel,
    conditions: Conditions,
    rng: np.random.Generator,
    background: Image | None = None,
) -> Image:
    """What the camera sees of pages at `T_camera_sheet`, in front of a table, or of a `background` picture."""
    light = _light(camera, conditions, rng)
    if background is None:
        smooth = cv2.GaussianBlur(rng.normal(0.0, 1.0, light.shape), (0, 0), 6.0)
        picture = conditions.background * (1.0 + 0.5 * np.asarray(smooth))
    else:
        picture = np.asarray(cv2.resize(background, (camera.width, camera.height)), dtype=np.float64) / light
    for page, T_camera_sheet in pages:
        x0, y0, x1, y1 = _region(page, camera, T_camera_sheet)
        if x0 >= x1 or y0 >= y1:
            continue
        seen, share = _rays(page, camera, T_camera_sheet, (x0, y0, x1, y1), conditions.rays)
        ink = conditions.black + (conditions.white - conditions.black) * seen
        picture[y0:y1, x0:x1] = share * ink + (1.0 - share) * picture[y0:y1, x0:x1]
    if conditions.blur_px > 0.0:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), conditions.blur_px))
    picture = picture * light
    sigma = np.sqrt(conditions.noise**2 + conditions.shot * np.maximum(picture, 0.0))
    noisy = picture + sigma * rng.normal(0.0, 1.0, picture.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def _light(camera: CameraModel, conditions: Conditions, rng: np.random.Generator) -> Array:
    """Brightness: falls by `light` from one side of the picture to the other, in a direction drawn at random."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    along = ((u / camera.width - 0.5) * np.cos(angle) + (v / camera.height - 0.5) * np.sin(angle)) * np.sqrt(0.5)
    return np.asarray(1.0 - conditions.light * (0.5 + along))


def _region(page: Page, camera: CameraModel, T_camera_sheet: PoseTuple) -> tuple[int, int, int, int]:
    """Pixels that may show the page."""
    w, h = (0.5 * s for s in page.size_m)
    around = np.linspace(-1.0, 1.0, 21)
    one = np.ones_like(around)
    xy = np.concatenate([np.stack(s, axis=1) for s in ((around, one), (around, -one), (one, around), (-one, around))])
    pixels = camera.project(np.column_stack([xy * (w, h), np.zeros(len(xy))]), T_camera_sheet)
    low = np.floor(pixels.min(axis=0)).astype(int) - 2
    high = np.ceil(pixels.max(axis=0)).astype(int) + 3
    return max(low[0], 0), max(low[1], 0), min(high[0], camera.width), min(high[1], camera.height)


def _rays(
    page: Page, camera: CameraModel, T_camera_sheet: PoseTuple, region: tuple[int, int, int, int], n: int
) -> tuple[Array, Array]:
    """Mean reflectance of the rays of each pixel that meet the page, and the share of them that do."""
    x0, y0, x1, y1 = region
    x, y = (grid[y0 * n : y1 * n, x0 * n : x1 * n] for grid in _grid(camera, n))
    M = pose_to_matrix(T_camera_sheet)
    H = np.linalg.inv(M[:3, [0, 1, 3]])
    s = H[2, 0] * x + H[2, 1] * y + H[2, 2]
    X = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / s
    Y = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / s
    spacing = float(np.linalg.norm(M[:3, 3])) / camera.fx / n
    seen, inside = page.sample(X, Y, spacing)
    inside = (inside & (s > 0.0)).astype(np.float64)
    shape = (y1 - y0, n, x1 - x0, n)
    share = inside.reshape(shape).mean(axis=(1, 3))
    total = (seen * inside).reshape(shape).mean(axis=(1, 3))
    return total / np.maximum(share, 1e-9), share


@lru_cache(maxsize=2)
def _grid(camera: CameraModel, n: int) -> tuple[Array, Array]:
    """Normalised coordinates of n x n rays through every pixel of a camera."""
    offsets = (np.arange(n) + 0.5) / n - 0.5
    u = (np.arange(camera.width)[:, None] + offsets).ravel()
    v = (np.arange(camera.height)[:, None] + offsets).ravel()
    return undistort(camera, *np.meshgrid(u, v))


def undistort(camera: CameraModel, u: Array, v: Array) -> tuple[Array, Array]:
    """Normalised coordinates of pixels, by Newton's method on the distortion, to 1e-9 (a millionth of a pixel)."""
    xd, yd = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    k1, k2, p1, p2, k3 = (*camera.distortion, *(0.0,) * 5)[:5]
    x, y = xd.copy(), yd.copy()
    if not any(camera.distortion):
        return x, y
    for _ in range(10):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)  # d(radial) / d(r2)
        fx = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - xd
        fy = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - yd
        a = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        b = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        d = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        det = a * d - b * b
        x -= (d * fx - b * fy) / det
        y -= (a * fy - b * fx) / det
        if max(float(np.abs(fx).max()), float(np.abs(fy).max())) < 1e-9:
            break
    return x, y
