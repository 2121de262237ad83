"""`SharedScenes`: what clients draw of each scene, as a specification and assets in a store that the front serves.

The result for a model is kept on the disk, so only the first session with a model encodes anything.
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
from iris_session.scene.mujoco_looks import ModelLooks
from iris_session.scene.mujoco_scene import parse_mujoco
from iris_session.scene.mujoco_visuals import Shown
from iris_session.scene.report import check_model_units
from iris_session.scene.result import ComposedScene

#: Specifications of patches that are kept: more than can be pending for the loop, and as long as a slow disk may need
#: to read them for the recording. A session that is patched ten times a second must not fill the disk.
KEPT_PATCHES: Final = 96
KEPT_PATCHES_S: Final = 10.0
NO_SPECIFICATION: Final = "clients get no meshes and textures"


class SharedScene(NamedTuple):
    """One scene as clients get it.

    `spec`: `None` where only bodies and poses are shared. `notes`: what is left out, a line each. `looks`: of the model
    that the specification was read off. `advice`: what its author should look at, a line each.
    """

    info: SceneInfo
    spec: SceneSpec | None = None
    patches: tuple[PatchOp, ...] = ()
    notes: tuple[str, ...] = ()
    looks: ModelLooks | None = None
    advice: tuple[str, ...] = ()


class SharedScenes:
    """Makes the specifications and assets of the scenes of one session, and keeps scenes and patches in order.

    Args:
        where: True for the store of this user, a folder for another one, False for none: clients then get bodies and
            poses, and nothing to draw them with.
        name: Name of the scenes.
        composed: The scene of every world, where it is not read off its model.
        shown: What clients see of a model.

    Attributes:
        lock: Held for the moment in which a scene or patch becomes the newest.
        newest: The newest scene or patch.
    """

    def __init__(
        self,
        where: bool | str | Path,
        name: str,
        composed: ComposedScene | None = None,
        shown: Shown | None = None,
    ) -> None:
        self._store_notes: list[str] = []
        self.lock = threading.RLock()
        self.newest: SharedScene | None = None
        self._name = name
        self._composed = composed
        self._shown = Shown() if shown is None else shown
        self._holds: list[Hold] = []
        self._patched: deque[_PatchedSpec] = deque()  # oldest first
        self._closed = False
        self._store: AssetStore | None = None
        if where is not False:
            try:
                store = AssetStore(None if where is True else where)
                store.root.mkdir(parents=True, exist_ok=True)
                store.trim()  # a scan of the folder takes a while, and is not to happen in a running session
                self._store = store
            except OSError as error:
                self.add_note(f"{NO_SPECIFICATION}: {error.filename or where}: {error.strerror or error}")

    @property
    def asset_root(self) -> str:
        """Folder of the asset store, empty without one."""
        return "" if self._store is None else str(self._store.root)

    @property
    def notes(self) -> list[str]:
        """Messages for people about the newest scene and about the store, one line each."""
        newest = self.newest
        return list(dict.fromkeys((*(() if newest is None else newest.notes), *self.advice, *self._store_notes)))

    @property
    def advice(self) -> tuple[str, ...]:
        """Advice about the newest scene for who made it, one line each."""
        return () if self.newest is None else self.newest.advice

    def make(
        self,
        world: World,
        initial_state: bytes = b"",
        patches: Sequence[PatchOp] = (),
        shown: Shown | None = None,
    ) -> SharedScene:
        """Make specification and assets of a scene. Slow for a model that was never shared before. From any thread.

        Args:
            world, initial_state: Of the scene; `mjSTATE_INTEGRATION`, empty for the model's own.
            patches: Patches since then, so that a resumed session shows what it showed.
            shown: What clients see of the model; `None` for what they see of every one.
        """
        poses = np.zeros((len(world.bodies), 7))
        world.read_poses(poses)
        plain = SceneInfo(
            world.scene_hash, world.robot_infos, world.bodies, poses.tobytes(), tick_period_ns=world.tick_period_ns
        )
        store = self._store
        if store is None:
            return SharedScene(plain)
        shown = self._shown if shown is None else shown
        looks = None if self._composed else ModelLooks(world.model, shown)
        try:
            parsed = self._composed or parse_mujoco(
                world.model,
                store,
                data=world.make_initial_data(initial_state),
                name=self._name,
                groups=shown.groups,
                sites=shown.sites,
            )
            made = _store_spec(store, apply_patch(parsed.spec, patches), plain, tuple(patches))
        except (OSError, SceneBuildError, SceneError) as error:  # the session works without its picture
            return SharedScene(plain, notes=(f"{NO_SPECIFICATION}: {error}",))
        notes = tuple(f"left out for clients: {what}" for what in parsed.skipped)
        return made._replace(notes=notes, looks=looks, advice=() if looks is None else check_model_units(parsed.spec))

    def patch(self, ops: Sequence[PatchOp]) -> SharedScene:
        """Return the newest scene with `ops` applied. Raises `SceneError`, `OSError`. Hold `lock` until `show`."""
        newest = self.newest
        if self._store is None or newest is None or newest.spec is None:
            reasons = [note for note in self.notes if NO_SPECIFICATION in note]
            why = "; ".join(reasons) or "`assets` of SessionConfig is False"
            raise SceneError(f"this session shares no specification of its scene: {why}")
        merging = merge_patches(newest.patches, ops)
        if len(merging) > MAX_PATCHES:
            raise SceneError(
                f"{len(merging)} operations since the scene was loaded, at most {MAX_PATCHES}, of which those on one "
                "visual count once: load the scene anew"
            )
        info = msgspec.structs.replace(newest.info, patches=newest.info.patches + 1)
        patched = _store_spec(self._store, apply_patch(newest.spec, ops), info, merging)
        return patched._replace(notes=newest.notes, looks=newest.looks, advice=newest.advice)

    def show(self, shown: SharedScene) -> SceneInfo:
        """Make a scene the newest. Its files are held, and those of the one before, which the front still serves.

        Raises nothing: what clients see has changed already, and a full disk does not change it back.
        """
        with self.lock:
            self.newest = shown
            store = self._store
            if store is not None and shown.spec is not None and not self._closed:  # a thread may come after the end
                self._hold(store, shown.info.assets)
                if shown.patches:
                    address = shown.info.scene_hash
                    self._patched.append(_PatchedSpec(address, store.last_used_ns(address), time.monotonic()))
                self._discard_replaced(store)
            while len(self._holds) > 2:
                self._holds.pop(0).release()
        return shown.info

    def close(self) -> None:
        """Release the files."""
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
            self.add_note(f"scene files in {store.root} cannot be held, so other processes may remove them: {why}")

    def _discard_replaced(self, store: AssetStore) -> None:
        """Discard specifications that later patches have replaced for all clients."""
        patched_specs, now = self._patched, time.monotonic()
        while len(patched_specs) > KEPT_PATCHES and now - patched_specs[0].shown_s > KEPT_PATCHES_S:
            old = patched_specs.popleft()
            store.discard(old.address, old.used_at)

    def add_note(self, text: str) -> None:
        """Add a note about the store or about changes, once: a session may load and patch scenes for days."""
        if text not in self._store_notes:
            self._store_notes.append(text)


class _PatchedSpec(NamedTuple):
    """The specification after a patch. `used_at`: as the store says; `shown_s`: monotonic."""

    address: str
    used_at: int
    shown_s: float


def _store_spec(store: AssetStore, spec: SceneSpec, info: SceneInfo, patches: tuple[PatchOp, ...]) -> SharedScene:
    named = list_assets(spec)
    if missing := next((address for address in named if address not in store), ""):
        raise SceneError(f"asset {missing} is not in {store.root}: put it there (AssetStore.put) before it is shown")
    address = store.put(encode_scene(spec))
    addresses = (address, *named)
    info = msgspec.structs.replace(info, scene_hash=address, asset_root=str(store.root), assets=addresses)
    return SharedScene(info, spec, patches)
