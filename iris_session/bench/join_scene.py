"""Scene of `bench join`: moving bodies with meshes and textures, and a process that prepares it as a server does.

The memory of a scene can only be measured in a process that did nothing else.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
import psutil
from numpy.typing import NDArray

from iris_session.bench.plugins import Plugin
from iris_session.demo.scenes import free_bodies_scene

MESHES: Final = 60
TEXTURES: Final = 60
#: Share of the bytes in textures; meshes have the rest.
TEXTURE_SHARE: Final = 0.8
#: Measured ratios with coarser levels: bytes of a texture per byte of raw pixels, bytes of a mesh per vertex.
_LEVELS: Final = 1.228
_VERTEX_BYTES: Final = 35.5


class PreparedScene(msgspec.Struct, frozen=True):
    """Result of preparing a scene.

    Attributes:
        seconds: From the compiled model to assets that can be fetched.
        rss_mib: Peak memory meanwhile, above that of the process with the model.
        built: Assets that were encoded.
        scene: Content hash of the specification.
        sizes: Bytes of all assets by content hash.
    """

    seconds: float
    rss_mib: float
    built: int
    scene: str
    sizes: dict[str, int]


def make_join_model(objects: int, assets_mb: float, seed: int) -> Any:
    """Return an `mujoco.MjSpec` of moving bodies that share 60 meshes and 60 textures, about `assets_mb` MB."""
    import mujoco

    spec = free_bodies_scene(objects, seed)
    rng = np.random.default_rng(seed)
    side = max(16, round((assets_mb * 1e6 * TEXTURE_SHARE / TEXTURES / 3 / _LEVELS) ** 0.5))
    vertices = max(100, round(assets_mb * 1e6 * (1.0 - TEXTURE_SHARE) / MESHES / _VERTEX_BYTES))
    for i in range(TEXTURES):
        pixels = rng.integers(0, 256, (side, side, 3), np.uint8)  # noise does not compress
        spec.add_texture(
            name=f"texture{i}",
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            width=side,
            height=side,
            nchannel=3,
            data=pixels.ravel().tolist(),
        )
        material = spec.add_material(name=f"material{i}")
        material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = f"texture{i}"
    for i in range(MESHES):
        points, faces, uv = _make_stone(rng, vertices)
        spec.add_mesh(
            name=f"mesh{i}",
            uservert=points.ravel().tolist(),
            userface=faces.ravel().tolist(),
            usertexcoord=uv.ravel().tolist(),
            userfacetexcoord=faces.ravel().tolist(),
        )
    for i, body in enumerate(body for body in spec.bodies if body.name.startswith("body")):
        geom = body.first_geom()
        geom.type = mujoco.mjtGeom.mjGEOM_MESH
        geom.meshname = f"mesh{i % MESHES}"
        geom.material = f"material{i % TEXTURES}"
    return spec


def _make_stone(
    rng: np.random.Generator, vertices: int
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Return points [m] of a rough ball of 6 cm, triangles and texture coordinates."""
    rows = max(4, round((vertices / 2) ** 0.5))
    columns = 2 * rows
    v, u = np.meshgrid(np.linspace(0.0, 1.0, rows), np.linspace(0.0, 1.0, columns, endpoint=False), indexing="ij")
    theta, phi = np.pi * (0.02 + 0.96 * v), 2 * np.pi * u
    radius = 0.06 * rng.uniform(0.97, 1.0, theta.shape)
    points = radius[..., None] * np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1
    )
    at = np.arange(rows * columns).reshape(rows, columns)
    right = np.roll(at, -1, axis=1)
    a, b, c, d = at[:-1], at[1:], right[1:], right[:-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    top, bottom = np.full((columns,), at[0, 0]), np.full((columns,), at[-1, 0])
    caps = [np.stack([top, at[0], right[0]], -1)[1:-1], np.stack([bottom, right[-1], at[-1]], -1)[1:-1]]
    return points.reshape(-1, 3), np.concatenate([faces, *caps]), np.stack([u, v], axis=-1).reshape(-1, 2)


class SceneJob(msgspec.Struct, frozen=True):
    """Files of a compiled model and of the store of its assets."""

    model: str
    store: str


class ScenePreparer(Plugin):
    """Plug-in that prepares a compiled model as a server does at its start."""

    job_type = SceneJob

    def prepare(self) -> PreparedScene:
        """Prepare the scene, and measure it."""
        from iris_session.assets.store import AssetStore
        from iris_session.physics.load import load_model
        from iris_session.protocol.scene import encode_scene, list_assets
        from iris_session.scene.mujoco_scene import parse_mujoco

        model = load_model(self.job.model)
        store = AssetStore(Path(self.job.store))
        before = psutil.Process().memory_info().rss
        Path("/proc/self/clear_refs").write_text("5")  # the peak of memory is counted from now on (Linux)
        began_s = time.perf_counter()
        parsed = parse_mujoco(model, store)
        data = encode_scene(parsed.spec)
        scene = store.put(data)
        seconds = time.perf_counter() - began_s
        sizes = {scene: len(data), **list_assets(parsed.spec)}
        return PreparedScene(seconds, (_read_peak_rss() - before) / 2**20, parsed.built, scene, sizes)


def _read_peak_rss() -> int:
    """Return the peak resident memory of this process [bytes] since the last reset of the peak."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) * 1024
