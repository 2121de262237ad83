"""Tasks: the file of a task, its progress over sessions, and the places of its objects in each episode.

Here is what the pure core must not do: reading and writing files, and drawing places. They are drawn ahead of time in a
thread, free of contact, and come to the core as entries (`ObjectsPlaced`), so that a recording replays without them.
The place of an object follows from the seed of the task and the number of the episode.
"""

from __future__ import annotations

import json
import logging
import math
import tomllib
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from anchors.pose import quat_from_yaw, quat_mul
from iris_session.physics import World
from iris_session.physics.world import find_free_joints
from iris_session.protocol.client_messages import Marker
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import Entry, ObjectsPlaced
from iris_session.protocol.names import EpisodeState
from iris_session.protocol.server_messages import EpisodeChanged
from iris_session.protocol.specs import ObjectRange, TaskSpec
from iris_session.protocol.steps import Decision
from iris_session.session.errors import ConfigError
from iris_session.session.stepper import Stepper
from iris_session.system.files import Replacement

#: Places that are tried for one episode.
MAX_TRIES: Final = 500
#: Objects that lie on something press into it by less than this [m].
PRESSED_M: Final = 1e-3
#: Final states that count as an episode of the task.
_ENDED: Final = (EpisodeState.SUCCESS, EpisodeState.FAILURE, EpisodeState.DISCARDED, EpisodeState.UNKNOWN)

_log = logging.getLogger(__name__)


class _Range(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Range of an object in a task file, as `ObjectRange`."""

    x: tuple[float, float]
    y: tuple[float, float]
    z: tuple[float, float] | None = None
    yaw: tuple[float, float] = (0.0, 0.0)


class _TaskFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a task file, as `TaskSpec`."""

    name: str
    instruction: str = ""
    wanted: int = 0
    robots: tuple[str, ...] = ()
    seed: int = 0
    reset: bool = True
    objects: dict[str, _Range] = {}


class _Progress(msgspec.Struct, frozen=True):
    """Content of a progress file: number of the last episode of the task, and of its successes."""

    task: str
    recorded: int = 0
    successes: int = 0


def find_progress_path(task_file: Path) -> Path:
    """Return where the progress of a task is kept: beside its file, `pour.progress.json` of `pour.toml`."""
    return task_file.with_name(f"{task_file.stem}.progress.json")


def load_task(given: str | Path | TaskSpec | None) -> TaskSpec | None:
    """Return the task of a file with its progress so far; a `TaskSpec` as it is.

    Raises:
        ConfigError: The file, or that of its progress, cannot be read or used; one line says what would be right.
    """
    if given is None or isinstance(given, TaskSpec):
        return given
    path = Path(given).expanduser()
    try:
        found = msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), _TaskFile)
        objects = tuple(ObjectRange(name, r.x, r.y, r.z, r.yaw) for name, r in found.objects.items())
        spec = TaskSpec(
            found.name, found.instruction, found.wanted, found.robots, objects, found.seed, reset=found.reset
        )
        task = msgspec.convert(msgspec.to_builtins(spec), TaskSpec)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise ConfigError(f"task file {str(path)!r} cannot be used: {why}; docs/guide.md has an example") from error
    for one in task.objects:
        for axis in ("x", "y", "z", "yaw"):
            low, high = getattr(one, axis) or (0.0, 0.0)
            if not -1e3 <= low <= high <= 1e3:
                raise ConfigError(f"{path.name}: objects.{one.object}.{axis} is [{low:g}, {high:g}]: lower bound first")
    progress = find_progress_path(path)
    try:
        so_far = msgspec.json.decode(progress.read_bytes(), type=_Progress)
    except FileNotFoundError:
        return task
    except (OSError, msgspec.DecodeError) as error:
        raise ConfigError(f"{progress} cannot be read: {error}; delete it to begin the task anew") from error
    if so_far.task != task.name:
        raise ConfigError(f"{progress} is of task {so_far.task!r}, not {task.name!r}: delete it to begin anew")
    return msgspec.structs.replace(task, recorded=so_far.recorded, successes=so_far.successes)


def check_same_task(given: TaskSpec, recorded: TaskSpec | None) -> None:
    """Raise `ConfigError` unless a resumed session has the task that is given."""
    if recorded is None or recorded.name != given.name:
        had = "no task" if recorded is None else f"task {recorded.name!r}"
        raise ConfigError(f"the session that is resumed has {had}, not {given.name!r}: give the file that it had")


class PlacementError(Exception):
    """No places for the objects of a task are free of contact, or one of them cannot be moved."""


def draw_places(world: World, initial_state: bytes, task: TaskSpec, number: int) -> ObjectsPlaced:
    """Return places of the objects of `task` for episode `number`, always the same ones for a seed and a number.

    They touch nothing that they do not touch in the initial state of the scene, such as the table they lie on, and
    press into nothing. Reads the model only, so it may run in a thread of its own. Raises `PlacementError`.
    """
    model = world.model
    data = world.make_initial_data(initial_state)
    free = find_free_joints(model, world.objects)
    if fixed := [one.object for one in task.objects if one.object not in free]:
        raise PlacementError(f"{', '.join(fixed)} cannot be placed: only free bodies can")
    joints = {one.object: free[one.object] for one in task.objects}
    bodies = np.array([model.jnt_bodyid[joint] for joint in joints.values()])
    home = {name: data.qpos[(at := int(model.jnt_qposadr[joint])) : at + 7].copy() for name, joint in joints.items()}
    allowed = _list_touching(model, data, bodies, 0.0)
    random = np.random.default_rng([task.seed, number])
    for _ in range(MAX_TRIES):
        poses = []
        for one in task.objects:
            x, y, yaw = (float(random.uniform(*bounds)) for bounds in (one.x, one.y, one.yaw))
            z = float(home[one.object][2] if one.z is None else random.uniform(*one.z))
            qw, qx, qy, qz = map(float, home[one.object][3:])
            q = quat_mul(quat_from_yaw(yaw), (qw, qx, qy, qz))
            norm = math.sqrt(sum(c * c for c in q))
            poses.append(Pose((x, y, z), (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)))
            at = int(model.jnt_qposadr[joints[one.object]])
            data.qpos[at : at + 7] = (*poses[-1].p, *poses[-1].q)
        mujoco.mj_fwdPosition(model, data)
        is_free = _list_touching(model, data, bodies, 0.0) <= allowed
        if is_free and not _list_touching(model, data, bodies, -PRESSED_M):
            return ObjectsPlaced(tuple(joints), tuple(poses), number, task.seed)
    names = ", ".join(joints)
    raise PlacementError(f"no places of {names} are free of contact in {MAX_TRIES} tries: make their ranges wider")


def _list_touching(
    model: mujoco.MjModel, data: Any, bodies: NDArray[np.int64], distance_m: float
) -> set[tuple[int, int]]:
    """Return the pairs of geoms that are at most so far apart, one of them of an object or of what its body carries."""
    contact = data.contact
    pairs = contact.geom[contact.dist <= distance_m]
    of_object = np.isin(model.body_rootid[model.geom_bodyid[pairs]], model.body_rootid[bodies]).any(axis=1)
    return {(int(a), int(b)) for a, b in pairs[of_object]}


class TaskRunner:
    """Companion of the core of a session with a task: gives places for each episode, and keeps the progress on disk.

    Args:
        stepper: Gets the places, and calls `follow` after every step.
        progress: File of the progress; `None` keeps none.
        is_new: False for a session that resumes: its objects lie where they were, unless they were to be placed when it
            ended.

    Raises:
        ConfigError: An object cannot be placed.
    """

    def __init__(self, stepper: Stepper, progress: Path | None, *, is_new: bool = True) -> None:
        task = stepper.core.config.authority.task
        assert task is not None
        self._task = task
        self._stepper = stepper
        self._progress = progress
        self._scene = stepper.core.scene
        self._thread = ThreadPoolExecutor(1, "iris-session-task")
        self._draws: dict[int, Future[ObjectsPlaced]] = {}
        if task.objects:
            self._prepare(stepper.core.authority.next_episode)
            try:
                placed = self._draws[stepper.core.authority.next_episode].result()
            except PlacementError as error:
                raise ConfigError(f"task {task.name!r}: {error}") from error
            episode = stepper.core.authority.episode
            if is_new or (episode is not None and episode.verdict):
                stepper.inputs.post_own(placed)
        stepper.on_decision = self.follow

    def _prepare(self, number: int) -> None:
        """Draw the places of an episode in the thread, if that is not under way."""
        core = self._stepper.core
        if number not in self._draws:
            self._draws = {n: draw for n, draw in self._draws.items() if abs(n - number) <= 1}
            work = (core.world, core.scene.initial_state, self._task, number)
            self._draws[number] = self._thread.submit(draw_places, *work)

    def follow(self, decision: Decision, entries: Sequence[Entry]) -> None:
        """Follow a step: place objects when an episode closes, or the scene was reset or is another one; keep the
        progress.
        """
        episodes = [event.body for event in decision.events if isinstance(event.body, EpisodeChanged)]
        for one in episodes:
            if one.state in _ENDED and self._progress is not None:
                self._thread.submit(write_progress, self._progress, one)
        if not self._task.objects:
            return
        core = self._stepper.core
        is_new = core.scene is not self._scene
        if is_new:
            self._scene, self._draws = core.scene, {}
        if any(one.state == EpisodeState.RUNNING for one in episodes):
            self._prepare(core.authority.next_episode)
        is_closing = any(one.state == EpisodeState.CLOSING and one.verdict for one in episodes)
        is_placed = any(isinstance(entry.message, ObjectsPlaced) for entry in entries)
        if is_new or is_closing or (decision.reset and not is_placed):
            self._place(core.authority.next_episode)

    def _place(self, number: int) -> None:
        self._prepare(number)
        try:
            placed = self._draws[number].result()  # drawn while the episode ran
        except PlacementError as error:
            _log.warning("%s", error)
            self._stepper.inputs.post_own(Marker(request_id=0, text=str(error)))
            placed = ObjectsPlaced((), (), number, self._task.seed)
        self._stepper.inputs.post_own(placed)

    def close(self) -> None:
        """Wait until the progress is on disk."""
        self._thread.shutdown()


def write_progress(path: Path, episode: EpisodeChanged) -> None:
    """Write how far a task is after an episode; an error is logged, as the session must go on."""
    content = {"task": episode.task, "recorded": episode.number, "successes": episode.successes}
    try:
        with Replacement(path, durable=True, permissions=None) as replacement:
            replacement.file.write(json.dumps(content, indent=2).encode() + b"\n")
    except OSError as error:
        _log.warning("the progress of task %r cannot be written to %s: %s", episode.task, path, error.strerror)
