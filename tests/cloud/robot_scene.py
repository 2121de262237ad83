"""Scenes with robots as clients know them, and their bodies as the test places them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco

from anchors.pose import PoseTuple
from iris_session.demo.named_scenes import scene_by_name
from iris_session.physics import find_objects, find_robots
from iris_session.physics.names import list_body_names
from iris_session.protocol.common import Pose
from iris_session.protocol.scene import SceneSpec
from iris_session.protocol.server_messages import BodyInfo, RobotInfo
from iris_session.scene import AssetStore, EncodeOptions, MeshArrays, decode_mesh
from iris_session.scene.mujoco_scene import parse_mujoco

IDENTITY = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


@dataclass
class RobotScene:
    """A scene in its first keyframe. `spec` to `streamed`: what `RobotPoints` and `RobotSurface` take; the first object
    is known to the session."""

    model: mujoco.MjModel
    data: mujoco.MjData
    spec: SceneSpec
    meshes: dict[int, MeshArrays]
    robots: tuple[RobotInfo, ...]
    streamed: tuple[BodyInfo, ...]

    def read_pose(self, body: str) -> PoseTuple:
        """Return `T_world_body` as it is in `data`."""
        x, y, z = self.data.body(body).xpos.tolist()
        w, i, j, k = self.data.body(body).xquat.tolist()
        return (x, y, z), (w, i, j, k)


def load_robots(scene: str, folder: Path) -> RobotScene:
    """Load a named scene; its assets are stored in `folder`."""
    model = scene_by_name(scene).model
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    names, robots, thing = list_body_names(model), find_robots(model).robots, find_objects(model)[0].body
    store = AssetStore(folder)
    spec = parse_mujoco(model, store, options=EncodeOptions(levels=False)).spec
    return RobotScene(
        model,
        data,
        spec,
        {number: decode_mesh(store.get(mesh.levels[0].address)) for number, mesh in enumerate(spec.meshes)},
        tuple(RobotInfo(one.name, (), names.index(one.base_body), 1, IDENTITY, True) for one in robots),
        tuple(BodyInfo(k, name, True, name == thing) for k, name in enumerate(names) if k),
    )
