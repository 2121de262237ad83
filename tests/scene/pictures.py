"""Pictures by MuJoCo's own renderer, without a display, and their agreement."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 240, 180
Image = NDArray[np.uint8]


class ModelRenderer:
    """Draws one model, at first in its default state: colour, and which geom each pixel shows (-1: none)."""

    def __init__(self, model: mujoco.MjModel, width: int = WIDTH, height: int = HEIGHT) -> None:
        model.vis.quality.offsamples = 0
        model.vis.quality.shadowsize = 0
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._width, self._height = width, height
        self.model = model
        self.data = mujoco.MjData(model)
        mujoco.mj_forward(model, self.data)
        self._scene = mujoco.MjvScene(model, 2_000)
        self._option = mujoco.MjvOption()
        self._context = mujoco.MjrContext(model, int(mujoco.mjtFontScale.mjFONTSCALE_50))

    def colour(self, camera: mujoco.MjvCamera) -> Image:
        return self._draw(camera, segments=False)

    def segments(self, camera: mujoco.MjvCamera, attribute: str = "objid") -> NDArray[np.int64]:
        """Return an attribute of the geom that each pixel shows, such as `objtype`, -1 where there is none."""
        raw = self._draw(camera, segments=True).astype(np.int64)
        number = raw[..., 0] + (raw[..., 1] << 8) + (raw[..., 2] << 16) - 1
        owner = {geom.segid: int(getattr(geom, attribute)) for geom in self._scene.geoms[: self._scene.ngeom]}
        table = np.array([owner.get(i, -1) for i in range(int(number.max()) + 1)] + [-1])
        return table[number]

    def close(self) -> None:
        self._context.free()

    def _draw(self, camera: mujoco.MjvCamera, *, segments: bool) -> Image:
        mujoco.mjv_updateScene(
            self.model, self.data, self._option, None, camera, int(mujoco.mjtCatBit.mjCAT_ALL), self._scene
        )
        for flag, on in (("SEGMENT", segments), ("IDCOLOR", segments), ("SHADOW", False), ("REFLECTION", False)):
            self._scene.flags[int(getattr(mujoco.mjtRndFlag, f"mjRND_{flag}"))] = on
        image = np.empty((self._height, self._width, 3), np.uint8)
        view = mujoco.MjrRect(0, 0, self._width, self._height)
        mujoco.mjr_setBuffer(int(mujoco.mjtFramebuffer.mjFB_OFFSCREEN), self._context)
        mujoco.mjr_render(view, self._scene, self._context)
        mujoco.mjr_readPixels(image, None, view, self._context)
        return image[::-1]


@contextmanager
def graphics() -> Iterator[None]:
    """Return a headless software OpenGL context. No other test draws."""
    before = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "egl"
    from mujoco.egl import GLContext

    context = GLContext(WIDTH, HEIGHT)
    context.make_current()
    try:
        yield
    finally:
        context.free()
        if before is None:
            del os.environ["MUJOCO_GL"]
        else:
            os.environ["MUJOCO_GL"] = before


def cameras(model: mujoco.MjModel, views: int = 3) -> list[mujoco.MjvCamera]:
    """Return free cameras around the scene, and every camera of the model."""
    found = []
    for k in range(views):
        camera = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(model, camera)
        camera.azimuth, camera.elevation = 30.0 + 360.0 * k / views, -25.0 - 10.0 * k
        found.append(camera)
    for k in range(model.ncam):
        camera = mujoco.MjvCamera()
        camera.type, camera.fixedcamid = int(mujoco.mjtCamera.mjCAMERA_FIXED), k
        found.append(camera)
    return found


def silhouette_iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Return intersection over union of the drawn pixels, 1 when both are empty."""
    union = int((a | b).sum())
    return 1.0 if union == 0 else int((a & b).sum()) / union
