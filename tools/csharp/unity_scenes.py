"""Scenes and frames of the Python server for the tests of the Unity layer, each in a folder.

`scene` is the specification, `assets` has a file for each address. The lines of `frames` have tabs between:

    body   id, x y z qw qx qy qz at the newest `state`
    state  state_seq, base_seq, payload in hexadecimal, scene_epoch, session time [ns]
    media  MediaHeader and payload, in hexadecimal
    probe  x y z [m]: a point of the world where something must be drawn after all lines before
    vertex, point  x y z [m]: of the cloth, and of the cloud, in any order
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
import numpy.typing as npt

from iris_session import AssetStore, SceneBuilder, parse_mujoco
from iris_session.demo.scenes.models import WHEEL, find_wheel_folder
from iris_session.protocol.codec import encode_media_header
from iris_session.protocol.media import MediaHeader
from iris_session.protocol.scene import SceneSpec, encode_scene
from iris_session.scene.asset_builder import EncodeOptions
from iris_session.streams.cloud import encode_cloud
from iris_session.streams.deformable import DeformableEncoder
from iris_session.streams.rigid import RigidEncoder
from tools.csharp.toolchain import ToolchainError

Floats = npt.NDArray[np.float64]
#: Every scene is planned at one level: what the probes are exact for.
_OPTIONS: Final = EncodeOptions(levels=False)
_STEP_NS: Final = 16_000_000
_FIRST_NS: Final = 1_000_000_000
#: Points of each geometry of a robot that must be drawn.
_PROBES_A_MESH: Final = 2


def write_unity_scenes(folder: Path) -> None:
    """Write the folders `aloha` and `lab`."""
    for name, write in (("aloha", _write_aloha), ("lab", _write_lab)):
        target = folder / name
        target.mkdir(parents=True)
        write(target)


def _write_scene(folder: Path, spec: SceneSpec, addresses: Any, store: AssetStore) -> None:
    (folder / "scene").write_bytes(encode_scene(spec))
    (folder / "assets").mkdir()
    for address in addresses:
        (folder / "assets" / address).write_bytes(store.get(address))


def _join(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)


class _Frames:
    """Lines of one scene."""

    def __init__(self, ids: list[int]) -> None:
        self.lines: list[str] = []
        self.ids = ids
        self.encoder = RigidEncoder(len(ids))
        self.now_ns = _FIRST_NS

    def add_state(self, poses: Floats) -> None:
        self.now_ns += _STEP_NS
        frame = self.encoder.encode(poses, 1)
        self.lines.append(f"state\t{frame.state_seq}\t{frame.base_seq}\t{frame.payload.hex()}\t1\t{self.now_ns}")
        self.lines += [f"body\t{body}\t{_join(row)}" for body, row in zip(self.ids, poses, strict=True)]

    def add_media(self, stream: str, seq: int, encoding: str, payload: bytes) -> None:
        header = MediaHeader(stream, "full", 1, seq, self.now_ns, self.now_ns, encoding)
        self.lines.append(f"media\t{encode_media_header(header).hex()}\t{payload.hex()}")

    def add_probes(self, points: Any) -> None:
        self.lines += [f"probe\t{_join(point)}" for point in points]

    def write(self, folder: Path) -> None:
        (folder / "frames").write_text("\n".join([*self.lines, ""]), encoding="utf-8")


def _write_aloha(folder: Path) -> None:
    """Write two arms on a table: where MuJoCo has the points of their meshes in two poses."""
    wheel = find_wheel_folder()
    if wheel is None:
        raise ToolchainError(f"{WHEEL} has the robots of these tests: pip install -e '.[all,dev]'")
    model = mujoco.MjModel.from_xml_path(str(wheel / "aloha" / "scene.xml"))
    data = mujoco.MjData(model)
    store = AssetStore(folder / "store")
    parsed = parse_mujoco(model, store, options=_OPTIONS)
    _write_scene(folder, parsed.spec, parsed.addresses, store)
    moving = [body.id for body in parsed.spec.bodies if body.id > 0]
    frames = _Frames(moving)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for angle in (0.0, 0.4):
        data.qpos[:6] += angle * np.array([1.0, 0.5, -0.5, 1.0, 0.5, -1.0])
        mujoco.mj_forward(model, data)
        frames.add_state(np.concatenate([data.xpos[moving], data.xquat[moving]], axis=1))
        frames.add_probes(_probe_meshes(model, data, parsed.spec))
    frames.write(folder)


def _probe_meshes(model: mujoco.MjModel, data: mujoco.MjData, spec: SceneSpec) -> Iterator[Floats]:
    """Yield points of the meshes that are shown, where MuJoCo has them."""
    for geom in range(model.ngeom):
        mesh = model.geom_dataid[geom]
        is_shown = model.geom_group[geom] in spec.groups_shown and model.geom_rgba[geom, 3] > 0
        if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH or not is_shown:
            continue
        first = model.mesh_vertadr[mesh]
        first_face = model.mesh_faceadr[mesh]
        used = np.unique(model.mesh_face[first_face : first_face + model.mesh_facenum[mesh]])
        for vertex in used[:: max(1, len(used) // _PROBES_A_MESH)][:_PROBES_A_MESH]:
            local = model.mesh_vert[first + vertex].astype(np.float64)
            yield data.geom_xpos[geom] + data.geom_xmat[geom].reshape(3, 3) @ local


def _write_lab(folder: Path) -> None:
    """Write a scene with everything else: instances, textures, transparency, a cloth, a rope and a cloud."""
    scene = SceneBuilder("Lab")
    picture = np.zeros((4, 8, 3), np.uint8)
    picture[0, :4] = (255, 0, 0)  # the upper left corner
    scene.add_plane("floor", half_size=(2, 2), rgba=(0.7, 0.7, 0.7, 1.0))
    for number in range(30):
        place = (0.1 * number - 1.5, 1.0, 0.5)
        scene.add_sphere(f"ball {number}", radius=0.03, movable=True, position=place, rgba=(0.9, 0.4, 0.1, 1.0))
    scene.add_box("box", half_size=(0.1, 0.2, 0.3), movable=True, position=(1.0, -0.5, 0.3), texture=picture)
    scene.add_box("glass", half_size=(0.2, 0.2, 0.01), position=(0.0, -1.0, 0.4), rgba=(0.2, 0.5, 1.0, 0.4))
    grid = np.stack(np.meshgrid(np.linspace(0.0, 1.0, 12), np.linspace(-0.4, 0.4, 9), indexing="ij"), axis=-1)
    rest = np.concatenate([grid.reshape(-1, 2), np.full((grid.size // 2, 1), 1.2)], axis=1)
    corner = np.arange(12 * 9).reshape(12, 9)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    triangles = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    scene.add_deformable("cloth", rest, triangles, radius=0.002, rgba=(0.2, 0.6, 0.9, 1.0))
    rope = np.stack([np.linspace(0.0, 1.0, 20), np.full(20, -0.8), np.full(20, 1.0)], axis=1)
    scene.add_deformable("rope", rope, edges=np.stack([np.arange(19), np.arange(1, 20)], axis=1), radius=0.004)
    scene.add_light(position=(0.0, 0.0, 3.0), direction=(0.0, 0.0, -1.0))
    store = AssetStore(folder / "store")
    made = scene.build(store, options=_OPTIONS)
    _write_scene(folder, made.spec, made.addresses, store)
    frames = _Frames([body.id for body in made.spec.bodies if body.moving])
    poses = np.array([[*body.T_world_body.p, *body.T_world_body.q] for body in made.spec.bodies if body.moving])
    for number in range(3):
        poses[:, :3] += (0.0, 0.01 * number, 0.02 * number)
        poses[-1, 3:] = (np.cos(0.2 * number), 0.0, np.sin(0.2 * number), 0.0)
        frames.add_state(poses)
    rng = np.random.default_rng(34)
    bent = rest + np.stack([0.0 * rest[:, 0], 0.0 * rest[:, 0], 0.1 * np.sin(3.0 * rest[:, 0])], axis=1)
    for name, vertices in (("cloth", bent), ("rope", rope + np.array([0.0, 0.0, 0.05]))):
        part = made.deformables[name]
        encoded = DeformableEncoder(part.topology).encode(vertices)
        assert encoded is not None
        frames.add_media(part.stream, 1, "deformable", encoded["full"])
    frames.lines += [f"vertex\t{_join(vertex)}" for vertex in bent]
    points, colors = rng.uniform(-1.0, 1.0, (10_000, 3)), rng.integers(0, 256, (10_000, 3), np.uint8)
    frames.add_media("table", 1, "cloud", encode_cloud(points, colors, voxel_m=0.01)["full"])
    frames.lines += [f"point\t{_join(point)}" for point in points]
    frames.write(folder)
