"""`World`: the plant of a session. One MuJoCo model and its data, advanced tick by tick, saved and restored exactly.

A tick is `mj_step2` then `mj_step1`: the arithmetic of `mj_step` shifted by half a step, so that after a tick every
derived quantity (poses, contacts) belongs to the new state. Write `ctrl` and `xfrc_applied` between ticks as usual.

In a user's loop the world is a twin that `restore_state` brings up to date, because after `mj_step` the user's own
derived quantities are those of the state before it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Final, NoReturn

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.physics.contacts import ContactTables
from iris_session.physics.errors import (
    ModelUnsupportedError,
    SimulationDivergedError,
    SnapshotError,
    SpecError,
    UnknownNameError,
    one_line,
)
from iris_session.physics.load import compute_scene_hash, encode_model
from iris_session.physics.names import find_element_id, list_body_names, list_element_names
from iris_session.physics.robot_signals import RobotSignals, RobotStateReader, describe_actuators
from iris_session.physics.tip import Tip
from iris_session.physics.tree import KinematicTree
from iris_session.physics.view import Flexes, MujocoView
from iris_session.protocol.common import Pose
from iris_session.protocol.server_messages import BodyInfo, RobotInfo
from iris_session.protocol.specs import ObjectSpec, RobotSpec

STATE: Final = int(mujoco.mjtState.mjSTATE_INTEGRATION)
HOME: Final = "home"

#: Integrators whose `mj_step2` does exactly what `mj_step` does; others (RK4) take `mj_step` and `mj_step1`.
_SPLIT_INTEGRATORS: Final = frozenset(
    int(getattr(mujoco.mjtIntegrator, name))
    for name in ("mjINT_EULER", "mjINT_IMPLICIT", "mjINT_IMPLICITFAST", "mjINT_DISCRETE")
    if hasattr(mujoco.mjtIntegrator, name)
)
_BAD: Final = tuple(
    (int(getattr(mujoco.mjtWarning, f"mjWARN_{name}")), text)
    for name, text in (
        ("BADQPOS", "positions are NaN or huge"),
        ("BADQVEL", "velocities are NaN or huge"),
        ("BADQACC", "accelerations are NaN or huge"),
        ("BADCTRL", "ctrl is NaN or huge, MuJoCo used zero instead"),
    )
)
_FULL: Final = {
    "contacts dropped, memory is full": int(mujoco.mjtWarning.mjWARN_CONTACTFULL),
    "constraints dropped, memory is full": int(mujoco.mjtWarning.mjWARN_CNSTRFULL),
}


class _Saved(msgspec.Struct, frozen=True, array_like=True):
    """Wire form of a snapshot: everything that a tick or the view depends on beyond the model."""

    scene_hash: str
    tick: int
    forces: tuple[float, ...]
    diverged: str
    state: bytes


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(_Saved)


class World:
    """The simulated scene.

    It begins with keyframe `home`, else the first keyframe, else the model's default state.
    Raises `UnknownNameError` for specs that do not fit the model, `SpecError` for those that do not fit each other, and
    `ModelUnsupportedError` for sleeping islands, whose hidden state MuJoCo cannot restore. The model must not be
    changed afterwards.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        robots: Sequence[RobotSpec],
        objects: Sequence[ObjectSpec],
    ) -> None:
        self.model = model
        self.objects = tuple(objects)
        _require_exact(model)
        _check_specs(model, robots, objects)
        #: What control writes to, and what the view shows.
        self.data: Any = mujoco.MjData(model)
        self._keyframe = _initial_keyframe(model)
        self._split = int(model.opt.integrator) in _SPLIT_INTEGRATORS
        self._state: NDArray[np.float64] = np.empty(mujoco.mj_stateSize(model, STATE))
        tree = KinematicTree(model)
        self._tables = ContactTables(model, robots, objects, tree)
        self._view = MujocoView(model, self.data, robots, objects, self._tables)
        #: Deformables: where their vertices are after the last tick, and who touches them.
        self.flexes = Flexes(model, self.data, robots, self._tables)
        self.bodies = _body_infos(model, tree, objects)
        ids = [b.id for b in self.bodies]
        whole = bool(ids) and ids == list(range(ids[0], ids[0] + len(ids)))
        #: Rows of `xpos` to stream: a slice unless flexes lie between the bodies, which is much cheaper to copy.
        self._rows: Any = slice(ids[0], ids[0] + len(ids)) if whole else np.array(ids, np.int64)
        self._free_joints = find_free_joints(model, objects)
        self.robot_infos = tuple(_robot_info(model, spec) for spec in robots)
        #: Measured values of the robots, for recordings.
        self.robot_signals = RobotSignals(model, robots)
        #: Measured and commanded values of the robots, for clients.
        self.robot_states = RobotStateReader(model, robots)
        self.tick_period_ns = self._view.tick_period_ns
        #: BLAKE2b of the model bytes, 32 hex characters.
        self.scene_hash = compute_scene_hash(encode_model(model))
        self._tick = 0
        self._forces: tuple[float, ...] = (0.0,) * len(robots)
        self._shown_state = b""
        #: Empty while all is well, else what went wrong, until `reset` or `restore`.
        self.diverged = ""
        self.reset()

    def make_initial_data(self, state: bytes = b"") -> Any:
        """Return new data at the beginning, positions derived: `state` (`mjSTATE_INTEGRATION`), or the initial one."""
        data = mujoco.MjData(self.model)
        self._reset_data(data)
        if state:
            # A copy: MuJoCo 3.3 refuses arrays that are read-only.
            mujoco.mj_setState(self.model, data, np.frombuffer(state, np.float64).copy(), STATE)
        mujoco.mj_fwdPosition(self.model, data)
        return data

    def _reset_data(self, data: Any) -> None:
        if self._keyframe >= 0:
            mujoco.mj_resetDataKeyframe(self.model, data, self._keyframe)
        else:
            mujoco.mj_resetData(self.model, data)

    def reset(self) -> None:
        """Return to the initial keyframe (or default state), tick 0."""
        self._reset_data(self.data)
        self._forces = (0.0,) * len(self._forces)
        self._derive_state(0)

    def place_objects(self, objects: Sequence[str], poses: Sequence[Pose]) -> None:
        """Put free objects at rest at `T_world_object`, right after a reset. Others, and unknown ones, stay."""
        model, data = self.model, self.data
        for name, pose in zip(objects, poses, strict=False):
            joint = self._free_joints.get(name)
            if joint is not None:
                at, velocity = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
                data.qpos[at : at + 7] = (*pose.p, *pose.q)
                data.qvel[velocity : velocity + 6] = 0.0
        self._derive_state(self._tick)

    def tick(self) -> None:
        """Take one timestep with the present `ctrl` and applied forces.

        Raises `SimulationDivergedError`, again and again until `reset` or `restore`.
        """
        model, data = self.model, self.data
        if self.diverged:
            raise SimulationDivergedError(self._tick, float(data.time), self.diverged)
        try:
            if self._split:
                mujoco.mj_step2(model, data)
            else:
                mujoco.mj_step(model, data)
            # Contact forces exist only until mj_step1 rebuilds the constraints.
            self._forces = self._tables.gripper_forces(model, data)
            mujoco.mj_step1(model, data)
        except mujoco.FatalError as error:  # out of memory in the middle of a step
            self._raise_diverged(error)
        self._set_tick(self._tick + 1)
        self._check_diverged(data)

    def restore_state(self, state: bytes) -> None:
        """Show a plant that is advanced elsewhere (`save_state` of the same model). The tick follows from its time.

        Everything the view shows afterwards, contact forces included, is a function of `state` alone.
        """
        self._load_state(state)
        if state == self._shown_state:  # shown already: only inputs may have been written since
            mujoco.mj_setState(self.model, self.data, self._state, STATE)
            self.diverged = ""
            return
        time = float(self._state[0])
        self._show_state(round(time / float(self.model.opt.timestep)) if math.isfinite(time) else self._tick)

    def _show_state(self, tick: int) -> None:
        """Put `_state` into the shown data with everything derived, contact forces too; the state itself stays as it
        is.
        """
        model, data = self.model, self.data
        self.diverged = "" if np.isfinite(self._state).all() else "the state holds numbers that are not finite"
        if self.diverged:
            raise SimulationDivergedError(tick, float(self._state[0]), self.diverged)
        mujoco.mj_setState(model, data, self._state, STATE)
        mujoco.mj_forward(model, data)
        # MuJoCo 3.3.0 puts its solution into the warm start, which is part of the state.
        mujoco.mj_setState(model, data, self._state, STATE)
        self._forces = self._tables.gripper_forces(model, data)
        self._set_tick(tick)
        self._shown_state = self._state.tobytes()

    # --- what others see ----------------------------------------------------------------------------------------------

    def view(self) -> MujocoView:
        """Return the world after the last tick; one live object, see `MujocoView`."""
        return self._view

    @property
    def ctrl(self) -> NDArray[np.float64]:
        """Actuator inputs, shape (nu,), writable."""
        array: NDArray[np.float64] = self.data.ctrl
        return array

    def read_poses(self, out: NDArray[np.float64]) -> None:
        """Write world poses of `bodies`, `x y z qw qx qy qz`, into `out`, shape (len(bodies), 7)."""
        out[:, :3] = self.data.xpos[self._rows]
        out[:, 3:] = self.data.xquat[self._rows]

    @property
    def dropped_counts(self) -> dict[str, int]:
        """Number of times that MuJoCo ran out of room since the last reset, by what it dropped. Empty when never."""
        counts = self.data.warning.number.tolist()
        return {text: counts[i] for text, i in _FULL.items() if counts[i]}

    def encode_model(self) -> bytes:
        """Return the model as MJB, asset paths blanked (see `load.encode_model`); made anew by every call."""
        return bytes(encode_model(self.model))

    # --- saving -------------------------------------------------------------------------------------------------------

    def save_state(self) -> bytes:
        """Return `mjSTATE_INTEGRATION` as little-endian float64: time, positions, velocities, warm
        start, inputs, ...
        """
        mujoco.mj_getState(self.model, self.data, self._state, STATE)
        return self._state.tobytes()

    def snapshot(self) -> bytes:
        """Return everything that later ticks and the view depend on."""
        return _encoder.encode(_Saved(self.scene_hash, self._tick, self._forces, self.diverged, self.save_state()))

    def restore(self, snapshot: bytes) -> None:
        """Restore a `snapshot`, bit for bit. Raises `SnapshotError` for other bytes or another model's."""
        try:
            saved = _decoder.decode(snapshot)
        except msgspec.DecodeError as error:
            raise SnapshotError(f"these {len(snapshot)} bytes are no world snapshot: {error}") from error
        if saved.scene_hash != self.scene_hash:
            raise SnapshotError(f"snapshot of scene {saved.scene_hash}, but this world is scene {self.scene_hash}")
        if len(saved.forces) != len(self._forces):
            raise SnapshotError(f"snapshot with {len(saved.forces)} robots, but this world has {len(self._forces)}")
        self._load_state(saved.state)
        mujoco.mj_resetData(self.model, self.data)  # clears warnings and everything outside the state
        mujoco.mj_setState(self.model, self.data, self._state, STATE)
        self._forces = saved.forces
        self._derive_state(saved.tick)
        self.diverged = saved.diverged

    # --- inside -------------------------------------------------------------------------------------------------------

    def _load_state(self, state: bytes) -> None:
        if len(state) != self._state.nbytes:
            raise SnapshotError(f"state of {len(state)} bytes, but this model's has {self._state.nbytes}")
        self._state[:] = np.frombuffer(state, np.float64)

    def _derive_state(self, tick: int) -> None:
        """Compute positions, contacts and velocities of the state that was just put into the shown data."""
        try:
            mujoco.mj_step1(self.model, self.data)
        except mujoco.FatalError as error:
            self._raise_diverged(error)
        self.diverged = ""
        self._set_tick(tick)

    def _set_tick(self, tick: int) -> None:
        self._tick = tick
        self._shown_state = b""
        self._view.advance(tick, self._forces)

    def _check_diverged(self, data: Any) -> None:
        """Raise when MuJoCo met bad numbers in this tick. For those it has reset `data` itself."""
        counts = data.warning.number.tolist()
        found = [text for index, text in _BAD if counts[index]]
        if found:
            self.diverged = "; ".join(found)
            raise SimulationDivergedError(self._tick, float(data.time), self.diverged)

    def _raise_diverged(self, error: mujoco.FatalError) -> NoReturn:
        self.diverged = one_line(error)
        raise SimulationDivergedError(self._tick, float(self.data.time), self.diverged) from error


def find_free_joints(model: mujoco.MjModel, objects: Sequence[ObjectSpec]) -> dict[str, int]:
    """Return the free joint of each object that has one."""
    found: dict[str, int] = {}
    for one in objects:
        joint = int(model.body_jntadr[find_element_id(model, "body", one.body)])
        if joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            found[one.name] = joint
    return found


def _require_exact(model: mujoco.MjModel) -> None:
    """Refuse models that cannot be restored bit for bit: sleeping islands keep timers outside every `mjtState`."""
    sleep = getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", None)
    if sleep is not None and int(model.opt.enableflags) & int(sleep):
        raise ModelUnsupportedError(
            'sleeping islands cannot be saved and restored exactly: remove <flag sleep="enable"/> from the model'
        )


def _initial_keyframe(model: mujoco.MjModel) -> int:
    names = list_element_names(model, "keyframe")
    return names.index(HOME) if HOME in names else min(0, model.nkey - 1)


def _body_infos(model: mujoco.MjModel, tree: KinematicTree, objects: Sequence[ObjectSpec]) -> tuple[BodyInfo, ...]:
    """Return all bodies but the world and the vertices of flexes, by id."""
    vertices = tree.find_flex_vertex_bodies()
    taken = {spec.body for spec in objects}
    moving = tree.find_moving_bodies()
    return tuple(
        BodyInfo(index, name, moving=moving[index], object=name in taken)
        for index, name in enumerate(list_body_names(model))
        if index and index not in vertices
    )


def _robot_info(model: mujoco.MjModel, spec: RobotSpec) -> RobotInfo:
    tip = Tip(model, spec)
    return RobotInfo(
        name=spec.name,
        joints=spec.joints,
        base_body=find_element_id(model, "body", spec.base_body, f"robot {spec.name!r}: "),
        site_body=tip.body,
        T_body_site=tip.T_body_tip,
        gripper=bool(spec.gripper_actuator),
        actuators=describe_actuators(model, spec),
        kind=spec.kind,
    )


def _check_specs(model: mujoco.MjModel, robots: Sequence[RobotSpec], objects: Sequence[ObjectSpec]) -> None:
    """Raise `SpecError` for anything that two robots or two objects share, `UnknownNameError` for finger bodies."""
    _check_claims("robot", ((robot.name, _list_owned(robot)) for robot in robots))
    bodies = list_body_names(model)
    for robot in robots:
        for body in robot.finger_bodies:
            if body not in bodies:
                raise UnknownNameError("body", body, bodies[1:], f"robot {robot.name!r}: ")
    _check_claims("object", ((item.name, (("name", item.name), ("body", item.body))) for item in objects))


def _list_owned(robot: RobotSpec) -> list[tuple[str, str]]:
    actuators = [*robot.actuators, *(one.actuator for one in robot.gripper_actuators)]
    return [("name", robot.name), *(("joint", j) for j in robot.joints), *(("actuator", a) for a in actuators)]


def _check_claims(kind: str, claims: Iterable[tuple[str, Iterable[tuple[str, str]]]]) -> None:
    owner: dict[tuple[str, str], str] = {}
    for claimant, claimed in claims:
        for key in claimed:
            if key in owner:
                raise SpecError(f"{key[0]} {key[1]!r} belongs to {kind} {owner[key]!r} and to {kind} {claimant!r}")
            owner[key] = claimant
