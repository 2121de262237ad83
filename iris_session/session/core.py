"""`SessionCore`: the session as a pure function of (initial state, configuration, journal).

Composes authority, control and the plant for one step and takes the digest that replay compares. Reads no clock, no
random source, no socket. Two classes (docs/architecture.md): `closed`, where our own physics advances, and `open`,
where the plant's state comes from outside (a user's loop, a real robot) and is part of the journal.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import msgspec
import mujoco
import numpy as np

from anchors.pose import is_rigid
from iris_session.authority import Authority, AuthorityConfig
from iris_session.control import ControlConfig, ControlError, Controller
from iris_session.control.solvers import name_solver
from iris_session.physics import SimulationDivergedError, World
from iris_session.physics.world import STATE
from iris_session.protocol.common import Alignment
from iris_session.protocol.entries import HOST, Entry, ExternalReset, ObjectsPlaced, SceneLoaded
from iris_session.protocol.names import LateCause
from iris_session.protocol.server_messages import (
    AlignmentChanged,
    EpisodeChanged,
    Event,
    ParticipantChanged,
    ParticipantJoined,
    Snapshot,
)
from iris_session.protocol.specs import ObjectSpec, RobotSpec, TaskSpec
from iris_session.protocol.steps import ControlStatus, Decision, OutgoingMessage
from iris_session.session.config import SessionConfig
from iris_session.session.ctrl_sharing import CtrlSharing
from iris_session.session.errors import ConfigError


def ignore_lap(cause: str) -> None:
    """Ignore a lap: the default of `SessionCore.step`."""


#: Entries of a step from which on its ticks solve less: the samples of two participants with three devices. Eight
#: participants at 72 Hz send so many in a third of the steps; a robot is still solved at 62 Hz if all steps have them.
CROWDED_ENTRIES: Final = 6
_encoder = msgspec.msgpack.Encoder()
#: Fields of `Snapshot` and `Alignment` in digests: those that they had when the recording format was made.
_DIGESTED_FIELDS: Final = tuple(name for name in Snapshot.__struct_fields__ if name != "anchors")
_DigestedSnapshot: Final = msgspec.defstruct("Snapshot", _DIGESTED_FIELDS, tag_field="type", tag="snapshot")
_ALIGNMENT_FIELDS: Final = tuple(name for name in Alignment.__struct_fields__ if name != "pivot_world")
_DigestedAlignment: Final = msgspec.defstruct("Alignment", _ALIGNMENT_FIELDS)
#: Of an episode, in recordings before `AuthorityConfig.episode_rules`.
_DigestedEpisode: Final = msgspec.defstruct(
    "EpisodeChanged", ("number", "state", "label", "participant"), tag_field="event", tag="episode_changed"
)
_decode_status = msgspec.msgpack.Decoder(tuple[ControlStatus, ...]).decode
_decode_shared = msgspec.msgpack.Decoder(tuple[bytes, bytes]).decode


class CoreConfig(msgspec.Struct, frozen=True):
    """Everything besides the model that the session function depends on. Stored in the recording's header."""

    authority: AuthorityConfig
    control: ControlConfig
    robots: tuple[RobotSpec, ...]
    objects: tuple[ObjectSpec, ...]
    #: `mjSTATE_INTEGRATION` to begin with and to reset to; empty: the model's own initial state.
    initial_state: bytes = b""


_decode_config = msgspec.msgpack.Decoder(CoreConfig).decode


class StepOutcome(msgspec.Struct, frozen=True):
    """Outcome of one step: decision of the authority, report of control, digest of all of it (16 bytes, or none)."""

    decision: Decision
    status: tuple[ControlStatus, ...]
    digest: bytes
    #: Why physics stands still (numbers that are not finite), empty while all is well. A reset ends it.
    diverged: str = ""


class CoreState(msgspec.Struct, frozen=True):
    """Snapshots of the three stateful parts, and the encoded control report that the next step's authority sees.

    In a user loop `controller` holds two: that of the controller, and that of `CtrlSharing`.
    """

    plant: bytes
    authority: bytes
    controller: bytes
    status: bytes


class Plant(NamedTuple):
    """A scene that can be stepped: its world in the initial state, its controller, and what it was made of."""

    world: World
    controller: Controller
    scene: SceneLoaded


def make_plant(model: mujoco.MjModel, scene: SceneLoaded, control: ControlConfig) -> Plant:
    """Make world and controller of a scene, without touching any session.

    Raises:
        PhysicsError, ControlError: The model cannot be driven, for example a torque actuator without a hold law.
        SnapshotError: The initial state is of another model.
    """
    world = World(model, scene.robots, scene.objects)
    if scene.initial_state:
        world.restore_state(scene.initial_state)
    return Plant(world, Controller(model, scene.robots, scene.objects, control), scene)


def raise_no_model(model_hash: str) -> mujoco.MjModel:
    """Raise `KeyError`: the default of a session whose scene never changed."""
    raise KeyError(f"the recording does not hold the model {model_hash}")


class SessionCore:
    """One session: robots and objects of one model, their authority and their control. Raises as `make_plant`.

    `models`: the model of a scene that was loaded later, by `SceneLoaded.model_hash`, unless it was `prepared`.
    `sharing`: in a user loop, whose `ctrl` counts; `None` in ours, where control writes that of every robot.
    """

    sharing: CtrlSharing | None

    def __init__(
        self,
        model: mujoco.MjModel,
        config: CoreConfig,
        models: Callable[[str], mujoco.MjModel] = raise_no_model,
    ) -> None:
        #: Decoded as from a recording: a whole number in a float field would change `round(x / step)` and the digest.
        config = msgspec.structs.replace(config, control=name_solver(config.control))
        self.config = config = _decode_config(_encoder.encode(config))
        self._models = models
        #: Plants that were made off the loop, for the `SceneLoaded` to come, by `model_hash`.
        self.prepared: dict[str, Plant] = {}
        self._model = model
        self._set_plant(self._make_first_plant())
        self.authority = Authority(_limit_scales(config), config.robots, config.objects)
        self._status: tuple[ControlStatus, ...] = ()

    @property
    def driven(self) -> tuple[str, ...]:
        """Robots of a user loop that are not wholly their owner's."""
        return () if self.sharing is None else self.sharing.driven

    def step(
        self,
        now_ns: int,
        entries: Sequence[Entry],
        n_ticks: int,
        plant: bytes = b"",
        *,
        digest: bool = True,
        lap: Callable[[str], None] = ignore_lap,
    ) -> StepOutcome:
        """Take one step at session time `now_ns` with `n_ticks` >= 0 ticks of physics.

        Without `digest` the outcome has an empty one: it takes a sixth of a step, and only a recording needs it.
        `lap` is called after each part with the `LateCause` that its time counts as; it has no influence.

        `plant` (open sessions): `mjSTATE_INTEGRATION` of the user's plant at the start of this step, with the owner's
        `ctrl`. The ticks then write `world.data.ctrl` for the caller to apply, of the robots in `sharing.driven`, and
        do not advance physics.
        """
        self._load_scenes(entries)
        world = self.world
        if plant:
            world.restore_state(plant)
        decision = self.authority.step(now_ns, entries, n_ticks, world.view(), self._status)
        if decision.reset:
            self._reset_world(entries)
            self._reset_control()
        elif any(entry.connection == HOST and isinstance(entry.message, ExternalReset) for entry in entries):
            self._reset_control()  # the owner moved the robots: they are where they stand now
        lap(LateCause.AUTHORITY)
        owner_ctrl = world.ctrl if self.sharing is None else world.ctrl.copy()
        if self.sharing is not None:
            self.sharing.begin(decision, self.authority.list_holders(), world.data, owner_ctrl)
        self.controller.begin(now_ns, n_ticks, decision, world.view())
        is_crowded = len(entries) >= CROWDED_ENTRIES
        for _ in range(0 if world.diverged else n_ticks):
            self.controller.tick(world.data, is_crowded)
            lap(LateCause.CONTROL)
            if not plant:
                try:
                    world.tick()
                except SimulationDivergedError:  # physics stands still until a reset
                    break
            lap(LateCause.PHYSICS)
        if self.sharing is not None and n_ticks:
            self.sharing.apply(world.ctrl, owner_ctrl, n_ticks, estop=decision.estop)
        self._status = self.controller.get_status()
        return StepOutcome(decision, self._status, self._digest(decision) if digest else b"", world.diverged)

    def show(self, entries: Sequence[Entry], plant: bytes) -> None:
        """Show the plant of a step of an open session without taking the step; empty: as it was.

        Scenes in `entries` are loaded. For reading a recording: authority and control stay as they were.
        """
        self._load_scenes(entries)
        if plant:
            self.world.restore_state(plant)

    def write_rest_controls(self, plant: bytes) -> None:
        """Write the last `world.data.ctrl` for the plant in state `plant`: driven robots at rest, objects released.

        No step may follow: this is in no journal.
        """
        self.world.restore_state(plant)
        owner_ctrl = self.world.ctrl.copy()
        self.controller.write_rest(self.world.data)
        if self.sharing is not None:
            self.sharing.restore_owner_ctrl(self.world.ctrl, owner_ctrl)

    def _reset_world(self, entries: Sequence[Entry]) -> None:
        """Return to the initial state, with objects where `entries` place them."""
        self.world.reset()
        if self.scene.initial_state:
            self.world.restore_state(self.scene.initial_state)
        for entry in entries:
            m = entry.message
            if not isinstance(m, ObjectsPlaced) or not entry.connection == entry.connection_epoch == HOST:
                continue
            if all(is_rigid((pose.p, pose.q)) for pose in m.poses):
                self.world.place_objects(m.objects, m.poses)

    def _make_first_plant(self) -> Plant:
        config = self.config
        scene = SceneLoaded("", config.robots, config.objects, config.initial_state)
        return make_plant(self._model, scene, config.control)

    def _load_scenes(self, entries: Sequence[Entry]) -> None:
        for entry in entries:
            if isinstance(entry.message, SceneLoaded) and entry.connection == entry.connection_epoch == HOST:
                self._load_scene(entry.message)

    def _load_scene(self, scene: SceneLoaded) -> None:
        """Replace the scene, from the beginning of this step on."""
        plant = self.prepared.pop(scene.model_hash, None)
        if plant is None or plant.scene != scene:
            plant = make_plant(self._models(scene.model_hash), scene, self.config.control)
        self._set_plant(plant)
        self._status = ()

    def _set_plant(self, plant: Plant) -> None:
        self.world, self.controller, self.scene = plant
        self.sharing = None
        if self.config.authority.user_owned_loop:
            names = [robot.name for robot in self.scene.robots]
            self.sharing = CtrlSharing(names, self.controller, float(self.world.model.opt.timestep))
        self._reset_control()

    def _reset_control(self) -> None:
        self.controller.reset(self.world.data)
        if self.sharing is not None:
            self.sharing.reset()

    def current_config(self) -> CoreConfig:
        """Return the configuration of a session that begins with the present scene."""
        scene = self.scene
        return msgspec.structs.replace(
            self.config, robots=scene.robots, objects=scene.objects, initial_state=scene.initial_state
        )

    def _digest(self, decision: Decision) -> bytes:
        h = hashlib.blake2b(digest_size=16)
        h.update(encode_for_digest(decision))
        h.update(_encoder.encode(self._status))
        h.update(self.world.save_state())
        return h.digest()

    def snapshot(self) -> CoreState:
        """Return the state after the last step; restoring it is invisible to everything that follows."""
        controller = self.controller.snapshot()
        if self.sharing is not None:
            controller = _encoder.encode((controller, self.sharing.snapshot()))
        return CoreState(self.world.snapshot(), self.authority.snapshot(), controller, _encoder.encode(self._status))

    def restore(self, state: CoreState) -> None:
        """Restore a snapshot into a core that was built with the same model and configuration.

        A scene that was loaded since then is replaced by the one of the snapshot.
        """
        self.authority.restore(state.authority)
        scene = self.authority.scene
        if scene is None and self.scene.model_hash:
            self._set_plant(self._make_first_plant())
        elif scene is not None and scene != msgspec.structs.replace(self.scene, model_hash=self.world.scene_hash):
            self._load_scene(scene)
        self.world.restore(state.plant)
        controller = state.controller
        if self.sharing is not None:
            controller, sharing = _decode_shared(controller)
            self.sharing.restore(sharing)
        self.controller.restore(controller)
        self._status = _decode_status(state.status)


def encode_for_digest(decision: Decision) -> bytes:
    """Return the bytes of a decision that are part of the digest of its step.

    Fields that `Snapshot` and `Alignment` got after the recording format are left out, so that earlier recordings of
    this format keep their digests. The events say the same as the snapshot, and keyframes hold every pivot.
    """
    if decision.outgoing or decision.events:
        outgoing = tuple(OutgoingMessage(one.connection, _to_digested(one.message)) for one in decision.outgoing)
        events = tuple(_to_digested(event) for event in decision.events)
        decision = msgspec.structs.replace(decision, outgoing=outgoing, events=events)
    return _encoder.encode(decision)


def _to_digested(message: Any) -> Any:
    """Return a message without the fields that are not in digests."""
    if isinstance(message, Snapshot):
        values = {name: getattr(message, name) for name in _DIGESTED_FIELDS}
        values["participants"] = tuple(_without_pivot(one) for one in message.participants)
        values["episode"] = _to_digested_episode(message.episode)
        return _DigestedSnapshot(**values)
    if not isinstance(message, Event):
        return message
    body: Any = message.body
    if isinstance(body, AlignmentChanged):
        body = _without_pivot(body)
    elif isinstance(body, EpisodeChanged):
        body = _to_digested_episode(body)
    elif isinstance(body, ParticipantJoined | ParticipantChanged):
        body = msgspec.structs.replace(body, participant=_without_pivot(body.participant))
    return msgspec.structs.replace(message, body=body)


def _to_digested_episode(episode: EpisodeChanged | None) -> Any:
    """Return an episode of earlier rules, which do not say who has started it, as digests have it."""
    if episode is None or episode.started_by or episode.task:
        return episode
    return _DigestedEpisode(episode.number, episode.state, episode.label, episode.participant)


def _without_pivot(holder: Any) -> Any:
    """Return what has an `alignment`, with that as digests have it."""
    if holder.alignment is None:
        return holder
    alignment = _DigestedAlignment(*(getattr(holder.alignment, name) for name in _ALIGNMENT_FIELDS))
    return msgspec.structs.replace(holder, alignment=alignment)


def _limit_scales(config: CoreConfig) -> AuthorityConfig:
    """Return the authority's configuration without the motion scales that control would not follow."""
    authority, control = config.authority, config.control
    low, high = max(authority.min_scale, control.min_scale), min(authority.max_scale, control.max_scale)
    return msgspec.structs.replace(authority, min_scale=low, max_scale=high)


def read_plant_state(model: mujoco.MjModel, data: mujoco.MjData) -> bytes:
    """Return `mjSTATE_INTEGRATION` of `data`, for `step(plant=...)` and `CoreConfig.initial_state`."""
    state = np.empty(mujoco.mj_stateSize(model, STATE))
    mujoco.mj_getState(model, data, state, STATE)
    return state.tobytes()


def make_session_core(
    session: SessionConfig,
    model: mujoco.MjModel,
    data: mujoco.MjData | None,
    robots: tuple[RobotSpec, ...],
    objects: tuple[ObjectSpec, ...],
    user_owned: bool,
    known: SessionCore | None = None,
    task: TaskSpec | None = None,
) -> SessionCore:
    """Return the core of a session that begins with `data` as it is now; `known` when it is the same."""
    anchors, task = session.anchor_poses(), task or session.authority.task
    authority = msgspec.structs.replace(session.authority, user_owned_loop=user_owned, anchors=anchors, task=task)
    initial = b"" if data is None else read_plant_state(model, data)
    config = CoreConfig(authority, name_solver(session.control), robots, objects, initial)
    if known is not None and known.config == config:
        return known
    try:
        return SessionCore(model, config)
    except ControlError:
        raise
    except ValueError as error:  # the authority's own check of its numbers and names
        raise ConfigError(str(error)) from error
