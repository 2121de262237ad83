"""The scene as clients draw it: specification and assets of a world, in a store of files that the front serves.

What a model became is remembered on the disk, so only the first session with a model encodes anything.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import numpy as np

from iris_session.link import SceneInfo
from iris_session.physics import World
from iris_session.protocol.scene import (
    MAX_PATCHES,
    PatchOp,
    SceneError,
    SceneSpec,
    apply_patch,
    encode_scene,
    list_assets,
    merge_patches,
)
from iris_session.scene import AssetStore, Hold, SceneBuildError
from iris_session.scene.composed import ComposedScene
from iris_session.scene.mujoco_scene import parse_mujoco

#: Specifications of patches that are kept: more than can wait for the loop, and as long as a slow disk may take to read
#: them for the recording. A session that is patched ten times a second must not fill the disk.
KEPT_LOOKS: Final = 96
KEPT_LOOKS_S: Final = 10.0
NOTHING_TO_SEE: Final = "clients get no meshes and textures"


class Shown(NamedTuple):
    """What clients get of one scene. `spec`: None where nothing is shared but bodies and poses. `notes`: what they do
    not get, a line each."""

    info: SceneInfo
    spec: SceneSpec | None = None
    patches: tuple[PatchOp, ...] = ()
    notes: tuple[str, ...] = ()


class SharedScenes:
    """Makes what clients get of each scene of one session.

    `where`: True for the store of this user, a folder for another one, False for none: clients then get bodies and
    poses, nothing to draw them with. `lock`: held while a scene or patch takes its place in the order of both, which is
    short; `newest`: the last one that did. `composed`: the scene of every world, which then is not read off its model.
    `sites`, `tendons`: those of a model are in its specification too.
    """

    def __init__(
        self,
        where: bool | str | Path,
        name: str,
        composed: ComposedScene | None = None,
        *,
        sites: bool = False,
        tendons: bool = False,
    ) -> None:
        self._said: list[str] = []  # of the store, whatever the scene
        self.lock = threading.RLock()
        self.newest: Shown | None = None
        self._name = name
        self._composed = composed
        self._sites, self._tendons = sites, tendons
        self._holds: list[Hold] = []
        self._looks: deque[_Look] = deque()  # of patches, the oldest first
        self._closed = False
        self._store: AssetStore | None = None
        if where is not False:
            try:
                self._store = AssetStore(None if where is True else where)
            except OSError as error:
                self._say(f"{NOTHING_TO_SEE}: {error.filename or where}: {error.strerror or error}")

    @property
    def notes(self) -> list[str]:
        """What people should know of the newest scene, and of where its files are kept; one line each."""
        newest = self.newest
        return list(dict.fromkeys((*(() if newest is None else newest.notes), *self._said)))

    def make(self, world: World, initial_state: bytes = b"", patches: Sequence[PatchOp] = ()) -> Shown:
        """Of the scene as it begins (`initial_state` empty: as the model says) and what has changed in it since: so
        a session that goes on shows what it showed. Takes long for a model that was never shared before. From any
        thread."""
        poses = np.zeros((len(world.bodies), 7))
        world.read_poses(poses)
        plain = SceneInfo(
            world.scene_hash, world.robot_infos, world.bodies, poses.tobytes(), tick_period_ns=world.tick_period_ns
        )
        store = self._store
        if store is None:
            return Shown(plain)
        try:
            parsed = self._composed or parse_mujoco(
                world.model,
                store,
                data=world.make_initial_data(initial_state),
                name=self._name,
                sites=self._sites,
                tendons=self._tendons,
            )
            shown = _stored(store, apply_patch(parsed.spec, patches), plain, tuple(patches))
        except (OSError, SceneBuildError, SceneError) as error:  # the session is worth more than its picture
            return Shown(plain, notes=(f"{NOTHING_TO_SEE}: {error}",))
        return shown._replace(notes=tuple(f"left out for clients: {what}" for what in parsed.skipped))

    def patch(self, ops: Sequence[PatchOp]) -> Shown:
        """The newest scene with `ops`. Raises `SceneError`, `OSError`. Hold `lock` until `take`."""
        newest = self.newest
        if self._store is None or newest is None or newest.spec is None:
            why = (
                "; ".join(note for note in self.notes if NOTHING_TO_SEE in note) or "`assets` of SessionConfig is False"
            )
            raise SceneError(f"this session shares no specification of its scene: {why}")
        merging = merge_patches(newest.patches, ops)
        if len(merging) > MAX_PATCHES:
            raise SceneError(
                f"{len(merging)} operations since the scene was loaded, at most {MAX_PATCHES}, of which those on one "
                "visual count once: load the scene anew"
            )
        info = msgspec.structs.replace(newest.info, patches=newest.info.patches + 1)
        return _stored(self._store, apply_patch(newest.spec, ops), info, merging)._replace(notes=newest.notes)

    def take(self, shown: Shown) -> SceneInfo:
        """It is the newest from now on; its files stay, and those of the one before, which the front still serves.

        Raises nothing: what is shown has changed already, and a full disk must not make it look as if it had not.
        """
        with self.lock:
            self.newest = shown
            store = self._store
            if store is not None and shown.spec is not None and not self._closed:  # a thread may be later than the end
                self._hold(store, shown.info.assets)
                if shown.patches:
                    address = shown.info.scene_hash
                    self._looks.append(_Look(address, store.last_used_ns(address), time.monotonic()))
                self._forget_looks(store)
            while len(self._holds) > 2:
                self._holds.pop(0).release()
        return shown.info

    def close(self) -> None:
        """Lets go of the files."""
        with self.lock:
            self._closed = True
            for hold in self._holds:
                hold.release()
            self._holds.clear()

    def _hold(self, store: AssetStore, addresses: Sequence[str]) -> None:
        try:
            self._holds.append(store.hold(addresses))
        except OSError as error:
            why = error.strerror or error
            self._say(f"files of the scene in {store.root} cannot be held, so others may take them away: {why}")

    def _forget_looks(self, store: AssetStore) -> None:
        """Specifications that patches after them have replaced, for everybody."""
        looks, now = self._looks, time.monotonic()
        while len(looks) > KEPT_LOOKS and now - looks[0].shown_s > KEPT_LOOKS_S:
            look = looks.popleft()
            store.discard(look.address, look.used_at)

    def _say(self, text: str) -> None:
        """Once: a session may load its scenes, and patch them, for days."""
        if text not in self._said:
            self._said.append(text)


class _Look(NamedTuple):
    """The specification after a patch. `used_at`: as the store says; `shown_s`: monotonic."""

    address: str
    used_at: int
    shown_s: float


def _stored(store: AssetStore, spec: SceneSpec, info: SceneInfo, patches: tuple[PatchOp, ...]) -> Shown:
    named = list_assets(spec)
    if missing := next((address for address in named if address not in store), ""):
        raise SceneError(f"asset {missing} is not in {store.root}: put it there (AssetStore.put) before it is shown")
    address = store.put(encode_scene(spec))
    addresses = (address, *named)
    info = msgspec.structs.replace(info, scene_hash=address, asset_root=str(store.root), assets=addresses)
    return Shown(info, spec, patches)
