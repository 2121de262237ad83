"""Another scene in a running session: made off the loop, swapped between two steps, journaled with its model."""

from __future__ import annotations

import copy
import threading
from abc import abstractmethod
from collections.abc import Sequence
from concurrent.futures import Future
from pathlib import Path

import msgspec
import mujoco

from iris_session.authority.config import check_config
from iris_session.physics import Pacer, find_objects, find_robots
from iris_session.physics.load import compute_scene_hash, encode_model, load_model
from iris_session.protocol.entries import HOST, Entry, SceneLoaded, ScenePatched, decode_entry, encode_entry
from iris_session.protocol.scene import PatchOp, SceneError, SceneSpec
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.recording import pack_model
from iris_session.session.config import SessionConfig
from iris_session.session.config_checks import check_arguments, check_objects, check_robots, check_timestep
from iris_session.session.core import SessionCore, make_plant, plant_state
from iris_session.session.deformables import flexes
from iris_session.session.errors import ConfigError, OwnershipError
from iris_session.session.patch_ops import checked_ops
from iris_session.session.processes import SessionProcesses
from iris_session.session.shared_scene import SharedScenes
from iris_session.session.stepper import MAX_SCENES, NextPatch, NextScene, Stepper
from iris_session.session.tick_times import TickTimes
from iris_session.session.user_loop import UserLoop


class ScenePatches:
    """Part of every session: its scene as it is drawn."""

    _stepper: Stepper | None
    _early_patches: list[NextPatch]  # asked for before anybody drove the session; with the lock of the scenes

    def patch_scene(self, *ops: PatchOp) -> None:
        """Changes how the scene is drawn, for everybody: colours, visibility, poses of visuals, decoration. Physics
        does not know of it. `session.scene` is the specification that `ops` refer to, at most 64 at once.

        Everything of one call is seen together, with the next step. Raises `ConfigError` for what does not fit (nothing
        is changed then), `OwnershipError` before `start()`. From any thread.
        """
        scenes = self._live().scenes
        try:
            checked = checked_ops(ops)
            with scenes.lock:
                shown = scenes.patch(checked)
                patch = NextPatch(ScenePatched(checked, shown.info.scene_hash), shown)
                self._queue(patch)
                scenes.take(shown)
        except (SceneError, OSError, RuntimeError) as error:
            raise ConfigError(f"patch_scene: {error}") from error

    @property
    def scene(self) -> SceneSpec | None:
        """What clients draw, with all patches that were asked for; None when the session shares no specification."""
        newest = self._live().scenes.newest
        return None if newest is None else newest.spec

    def _queue(self, patch: NextPatch) -> None:
        if self._stepper is not None:
            self._stepper.change_scene(patch)
        elif len(self._early_patches) < MAX_SCENES:
            self._early_patches.append(patch)
        else:
            raise SceneError(f"{MAX_SCENES} changes wait for the first step: call run() first")

    @abstractmethod
    def _live(self) -> SessionProcesses: ...


class SceneChanges(ScenePatches):
    """Part of `Session`."""

    model: mujoco.MjModel
    data: mujoco.MjData | None
    robots: tuple[RobotSpec, ...]
    objects: tuple[ObjectSpec, ...]
    config: SessionConfig
    _user_loop: UserLoop | None

    def load_scene(
        self,
        model: mujoco.MjModel | str | Path,
        data: mujoco.MjData | None = None,
        *,
        robots: Sequence[RobotSpec] | None = None,
        objects: Sequence[ObjectSpec] | None = None,
    ) -> Future[None]:
        """Loads another scene into the running session: a new `scene_epoch`, in which everybody stays.

        Arguments as of `Session`. Who holds a robot whose name the new scene has too keeps it and must clutch again;
        other leases end. The model is compiled and prepared in a thread while the session goes on with the old scene;
        the future is done when the new one waits for the next step, and raises what would be wrong with it:
        `ModelNotFoundError`, `ModelInvalidError`, `AmbiguousModelError`, `ControlError`, `ConfigError` for a timestep
        that no loop can keep. It may be another one than the session's: ticks are of that length from then on, and
        clients are told.

        Call it once `run()` has begun: from another thread, from `until`, or between two of them (the next takes the
        scene). Raises at once: `OwnershipError` in a user's loop, whose model is not ours, and before the first
        `run()`; `TypeError` for what is no model; `ConfigError` for what are no robots or objects.
        """
        if self._user_loop is not None:
            raise OwnershipError("load_scene: your own loop owns the model; end this session and begin another with it")
        if not isinstance(model, str | Path):
            check_arguments(model, data, self.config)
        stepper = self._stepper
        if stepper is None:
            raise OwnershipError(
                "load_scene needs a session that has begun to run: call it after the first run(), or during it; "
                "what a session begins with is given to Session(model)"
            )
        done: Future[None] = Future()
        scenes = self._live().scenes
        known = check_robots(robots), check_objects(objects)
        begun = copy.copy(data)  # the caller may go on with theirs

        def work() -> None:
            try:
                loaded = load_model_of(model)
                check_arguments(loaded, begun, self.config)
                state = b"" if begun is None else plant_state(loaded, begun)
                scene = prepare(stepper.core, scenes, loaded, state, *known)
                with scenes.lock:
                    stepper.change_scene(scene)
                    scenes.take(scene.shown)
            except BaseException as error:  # of whoever asks for the result
                done.set_exception(error)
            else:
                done.set_result(None)

        done.set_running_or_notify_cancel()
        threading.Thread(target=work, name="iris-scene", daemon=True).start()
        return done

    def _take_scene(self, scene: NextScene | NextPatch) -> None:
        if isinstance(scene, NextPatch):
            return
        plant = scene.plant
        self.model, self.data = plant.world.model, plant.world.data
        self.robots, self.objects = plant.scene.robots, plant.scene.objects


def follow_timestep(stepper: Stepper, pacer: Pacer, times: TickTimes, began_ns: int) -> bool:
    """Whether the step that began at `began_ns` has taken a scene with another timestep: the loop then keeps that, and
    the tick is accounted."""
    period_ns = stepper.core.world.tick_period_ns
    if period_ns == pacer.period_ns:
        return False
    pacer.change_period(period_ns, began_ns, stepper.clock())
    times.change_period(period_ns)
    return True


def load_model_of(model: mujoco.MjModel | str | Path) -> mujoco.MjModel:
    """A compiled model of either."""
    return load_model(model) if isinstance(model, str | Path) else model


def prepare(
    core: SessionCore,
    scenes: SharedScenes,
    model: mujoco.MjModel,
    state: bytes,
    robots: tuple[RobotSpec, ...] | None,
    objects: tuple[ObjectSpec, ...] | None,
) -> NextScene:
    """Everything that takes long, without touching the session that `core` is of. None: found in the model."""
    binary = encode_model(model)
    found = tuple(find_robots(model) if robots is None else robots)
    things = tuple(find_objects(model) if objects is None else objects)
    message = SceneLoaded(compute_scene_hash(binary), found, things, state)
    # What is journaled is what is used: whole numbers in float fields become floats, lists tuples.
    scene = decode_entry(encode_entry(Entry(HOST, HOST, 0, message))).message
    assert isinstance(scene, SceneLoaded)
    try:
        check_config(msgspec.structs.replace(core.config.authority, assignments={}), found, things)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    check_timestep(model)
    plant = make_plant(model, scene, core.config.control)
    shown = scenes.make(plant.world, state)
    return NextScene(plant, scene.model_hash, pack_model(bytes(binary)), shown, flexes(plant.world))
