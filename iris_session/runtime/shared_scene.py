"""The scene as clients draw it: specification and assets of a world, in a store of files that the front serves.

What a model became is remembered on the disk, so only the first session with a model encodes anything.
"""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np

from iris_session.physics import World
from iris_session.protocol.scene import SceneSpec, asset_addresses, encode_scene
from iris_session.scene import AssetStore, Hold, SceneBuildError
from iris_session.scene.mujoco_scene import parse_mujoco
from iris_session.transport import SceneInfo


class SharedScenes:
    """Makes what clients get of each scene of one session. `notes`: what people should know; one line each.

    `where`: True for the store of this user, a folder for another one, False for none: clients then get bodies and
    poses, nothing to draw them with.
    """

    def __init__(self, where: bool | str | Path, name: str) -> None:
        self.notes: list[str] = []
        self.spec: SceneSpec | None = None
        self._name = name
        self._lock = threading.Lock()  # the next scene is made in a thread of its own
        self._holds: list[Hold] = []
        self._store: AssetStore | None = None
        if where is not False:
            try:
                self._store = AssetStore(None if where is True else where)
            except OSError as error:
                self._without(f"{error.filename or where}: {error.strerror or error}")

    def info(self, world: World) -> SceneInfo:
        """Of a world in its initial state. Takes long for a model that was never shared before."""
        poses = np.zeros((len(world.bodies), 7))
        world.poses(poses)
        plain = SceneInfo(world.scene_hash, world.robot_infos, world.bodies, poses.tobytes())
        with self._lock:
            store = self._store
            if store is None:
                return plain
            try:
                parsed = parse_mujoco(world.model, store, data=world.data, name=self._name)
                address = store.put(encode_scene(parsed.spec))
            except (OSError, SceneBuildError) as error:  # the session is worth more than its picture
                self._without(str(error))
                return plain
            self.spec = parsed.spec
            self.notes += [f"clients do not see {what}" for what in parsed.skipped]
            addresses = (address, *asset_addresses(parsed.spec))
            self._holds.append(store.hold(addresses))
            if len(self._holds) > 2:  # the front serves the scene before too, until everybody has left it
                self._holds.pop(0).release()
            return SceneInfo(
                address, plain.robots, plain.bodies, plain.poses, asset_root=str(store.root), assets=addresses
            )

    def close(self) -> None:
        """Lets go of the files."""
        with self._lock:
            for hold in self._holds:
                hold.release()
            self._holds.clear()

    def _without(self, why: str) -> None:
        self._store = None
        self.notes.append(f"clients get no meshes and textures: {why}")
