"""Draws GLB files by ray casting, without a renderer: unlit colour and alpha of the materials.

Reads the files with trimesh; no code of the exporter is used.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from tests.scene.pictures import HEIGHT, WIDTH

Floats = NDArray[np.float64]
#: Rays go through every so many rows and columns of a picture: each takes a millisecond.
STEP = 3


def rays(model: mujoco.MjModel, camera: mujoco.MjvCamera) -> tuple[Floats, Floats]:
    """Return origin (3) and directions (HEIGHT / STEP, WIDTH / STEP, 3) through pixels of that camera, in the world."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene = mujoco.MjvScene(model, 100)
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, int(mujoco.mjtCatBit.mjCAT_STATIC), scene)
    eyes = scene.camera
    ahead, up = np.array(eyes[0].forward, float), np.array(eyes[0].up, float)
    across = np.cross(ahead, up)
    half = np.tan(np.radians(model.vis.global_.fovy) / 2)
    x = (np.arange(0, WIDTH, STEP) + 0.5 - WIDTH / 2) / (HEIGHT / 2) * half
    y = (HEIGHT / 2 - np.arange(0, HEIGHT, STEP) - 0.5) / (HEIGHT / 2) * half
    direction = ahead + x[None, :, None] * across + y[:, None, None] * up
    return (np.array(eyes[0].pos, float) + eyes[1].pos) / 2, direction


def draw(path: Path, origin: Floats, direction: Floats, *, emitted: bool = False) -> tuple[Floats, NDArray[np.int64]]:
    """Return colour and alpha (rows, columns, 4), 0..255 sRGB, of the first hit of every ray, and the index of its
    mesh, -1 for none. `emitted`: the emission in place of the base colour."""
    parts = _parts(path)
    for part in parts:
        if part["visual"].material.doubleSided:
            continue  # others are visible from outside only
        corners = part["vertices"][part["faces"]]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        outside = np.einsum("fc,fc->f", across, origin - corners[:, 0]) > 0
        part["faces"] = part["faces"][outside]
    whole = trimesh.util.concatenate([trimesh.Trimesh(p["vertices"], p["faces"], process=False) for p in parts])
    owner = np.repeat(np.arange(len(parts)), [len(p["faces"]) for p in parts])
    first = np.cumsum([0, *(len(p["faces"]) for p in parts)])
    flat = direction.reshape(-1, 3)
    image, shown = np.zeros((len(flat), 4)), np.full(len(flat), -1)
    points, ray, face = whole.ray.intersects_location(np.tile(origin, (len(flat), 1)), flat, multiple_hits=False)
    corners = trimesh.triangles.points_to_barycentric(whole.triangles[face], points)
    for k, part in enumerate(parts):
        on = owner[face] == k
        shown[ray[on]] = k
        image[ray[on]] = _colour(part, face[on] - first[k], corners[on], emitted=emitted)
    return image.reshape(*direction.shape[:2], 4), shown.reshape(direction.shape[:2])


def _parts(path: Path) -> list[dict[str, Any]]:
    """Return the meshes in the world, z up, with their materials."""
    scene = trimesh.load_scene(path, process=False)
    found = []
    for name in scene.graph.nodes_geometry:
        T, geometry = scene.graph[name]
        mesh = scene.geometry[geometry]
        vertices = trimesh.transform_points(mesh.vertices, T) @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
        found.append({"vertices": vertices, "faces": mesh.faces, "visual": mesh.visual})
    return found


def _colour(part: dict[str, Any], face: Any, corners: Floats, *, emitted: bool) -> Floats:
    material, uv = part["visual"].material, part["visual"].uv
    picture, factor = material.baseColorTexture, material.baseColorFactor
    if emitted:
        picture = material.emissiveTexture
        glow = (0, 0, 0) if material.emissiveFactor is None else material.emissiveFactor
        factor = np.rint(255 * np.append(glow, 1.0))
    linear = np.ones(4) if factor is None else np.asarray(factor, float) / 255
    linear = np.tile(linear, (len(face), 1))
    if picture is not None:
        at = np.einsum("nk,nkc->nc", corners, uv[part["faces"][face]])
        sampled = _sampled(np.asarray(picture.convert("RGBA"), float) / 255, at)
        sampled[:, :3] = _to_linear(sampled[:, :3])
        linear = linear * sampled
    return 255 * np.column_stack([_to_seen(linear[:, :3]), linear[:, 3]])


def _sampled(image: Floats, uv: Floats) -> Floats:
    """Sample between the four nearest pixels, repeating. trimesh has v upwards."""
    height, width = image.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    a, b = (x - left)[:, None], (y - top)[:, None]
    near = [[image[(top + j) % height, (left + i) % width] for i in (0, 1)] for j in (0, 1)]
    return (near[0][0] * (1 - a) + near[0][1] * a) * (1 - b) + (near[1][0] * (1 - a) + near[1][1] * a) * b


def _to_linear(seen: Floats) -> Floats:
    return np.where(seen <= 0.04045, seen / 12.92, ((seen + 0.055) / 1.055) ** 2.4)


def _to_seen(linear: Floats) -> Floats:
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.clip(linear, 1e-9, None) ** (1 / 2.4) - 0.055)
