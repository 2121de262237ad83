"""Actuators: from commanded joint motion and gripper closure to `ctrl`.

Joints by actuator type; at rest this is the hold law of each type:

* position (affine bias in the position): the `ctrl` whose equilibrium is the commanded position; at rest constant.
* velocity (also integrated velocity): commanded velocity plus a correction of the joint error beyond a deadband. At
  rest: exactly zero within the deadband; outside it (gravity on a soft servo) the correction bounds the drift to
  `deadband + torque / (kv * gain)` where zero alone would creep without end.
* torque: only with the declared law `gravity_pd`: inertia-weighted PD about the commanded motion plus the bias force
  (gravity, Coriolis), less what the model's own gravity compensation gives. At rest: PD on the held position.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.control.arm_model import Floats, find_id
from iris_session.control.config import ControlConfig, ControlError
from iris_session.control.hold import Servos
from iris_session.physics.names import get_reference
from iris_session.protocol.specs import RobotSpec

GRAVITY_PD = "gravity_pd"

POSITION = "position"
VELOCITY = "velocity"
TORQUE = "torque"

_JOINT_TRANSMISSIONS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_GAIN_FIXED = int(mujoco.mjtGain.mjGAIN_FIXED)
_BIAS_NONE, _BIAS_AFFINE = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)
_DYN_NONE, _DYN_INTEGRATOR = int(mujoco.mjtDyn.mjDYN_NONE), int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
_DYN_FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))


class _Group(NamedTuple):
    """Actuators of one type. `columns`: their joints among all commanded joints; `ctrl = x * scale + offset`."""

    columns: NDArray[np.intp]
    actuators: NDArray[np.intp]
    scale: Floats
    offset: Floats
    qpos: NDArray[np.intp]
    dof: NDArray[np.intp]


class ActuatorLaws:
    """Writer of `data.ctrl` of all robots' arm joints. `lower`, `upper`: joint positions that can be
    commanded, (n,).
    """

    def __init__(self, model: mujoco.MjModel, robots: Sequence[RobotSpec], config: ControlConfig) -> None:
        """Raise `ControlError` for an actuator that has no law."""
        self._model = model
        self._config = config
        rows: list[tuple[str, int, int, float, float]] = []  # type, actuator, joint, scale and offset
        bounds: list[tuple[float, float]] = []
        servos: list[tuple[float, ...]] = []
        for robot in robots:
            if not robot.actuators:
                raise ControlError(
                    f"robot {robot.name!r} has no actuators, so only its owner's program can move it: give that the "
                    'end-effector targets, ControlConfig(output="targets")'
                )
            if len(robot.actuators) != len(robot.joints):
                raise ControlError(
                    f"robot {robot.name!r} has {len(robot.joints)} joints and {len(robot.actuators)} actuators; "
                    "it must have one actuator per joint, in the same order"
                )
            for joint_name, name in zip(robot.joints, robot.actuators, strict=True):
                actuator = find_id(model, "actuator", name)
                joint = find_id(model, "joint", joint_name)
                kind, scale, offset = _find_law(model, robot, actuator, joint)
                rows.append((kind, actuator, joint, scale, offset))
                bounds.append(_find_bounds(model, kind, actuator, joint, scale, offset))
                servos.append(_find_servo(model, kind, actuator, joint, config))
        limits = np.array(bounds, dtype=np.float64).reshape(-1, 2)
        self.lower, self.upper = limits[:, 0].copy(), limits[:, 1].copy()
        #: Actuator of every joint, shape (n,).
        self.actuators: NDArray[np.intp] = np.array([row[1] for row in rows], dtype=np.intp)
        self._position, self._velocity, self._torque = (
            _make_group(model, rows, kind) for kind in (POSITION, VELOCITY, TORQUE)
        )
        # Integrated velocity actuators: their rows in the velocity group, and their activations.
        dynamics = np.asarray(model.actuator_dyntype)[self._velocity.actuators]
        self._integrators = np.flatnonzero(dynamics == _DYN_INTEGRATOR)
        self._act = np.asarray(model.actuator_actadr, dtype=np.intp)[self._velocity.actuators[self._integrators]]
        stiffness, lag, reach, slack, droops = np.array(servos, dtype=np.float64).reshape(-1, 5).T
        integrators = self._velocity.columns[self._integrators]
        supports = np.isin(np.arange(len(rows)), self._position.columns)
        low, high = _find_command_ranges(model, self._position, len(rows))
        self.servos = Servos(stiffness, lag, reach, slack, droops, integrators, supports, low, high)
        self._dt = float(model.opt.timestep)
        self._acceleration = np.zeros(model.nv)
        self._force = np.zeros(model.nv)

    def find_position_laws(self) -> tuple[Floats, Floats]:
        """Return scale and offset of joints with position actuators: `ctrl = q * scale + offset`. NaN for all others,
        shape (n,) each.
        """
        scale, offset = np.full((2, len(self.actuators)), np.nan)
        scale[self._position.columns], offset[self._position.columns] = self._position.scale, self._position.offset
        return scale, offset

    def read_activations(self, data: mujoco.MjData) -> Floats:
        """Return the activations of integrated velocity actuators as joint positions, shape (n_integrators,)."""
        act = data.act[self._act] / self._velocity.scale[self._integrators]
        return np.where(np.isfinite(act), act, 0.0)

    def write(self, data: mujoco.MjData, q: Floats, v: Floats, speed: Floats, act_range: Floats | None = None) -> None:
        """`ctrl` for commanded positions `q` and velocities `v` of all joints; velocity commands stay within `speed`.

        All shape (n,). `data` must hold what MuJoCo computes from the present positions and velocities. `act_range`:
        joint positions between which the activations of integrators are kept, shape (2, n_integrators).
        """
        ctrl = data.ctrl
        g = self._position
        if g.columns.size:
            ctrl[g.actuators] = q[g.columns] * g.scale + g.offset
        g = self._velocity
        if g.columns.size:
            error = q[g.columns] - data.qpos[g.qpos]
            dead = self._config.velocity_deadband
            correction = error - np.minimum(np.maximum(error, -dead), dead)
            wanted, limit = v[g.columns] + self._config.velocity_gain * correction, speed[g.columns]
            if act_range is not None and self._integrators.size:
                rows = self._integrators
                low, high = (act_range - self.read_activations(data)) / self._dt
                wanted[rows] = np.minimum(np.maximum(wanted[rows], low), high)
            ctrl[g.actuators] = np.minimum(np.maximum(wanted, -limit), limit) * g.scale
        if self._torque.columns.size:
            self._write_torque(data, q, v)

    def find_commanded(self, ctrl: Floats, measured: Floats) -> Floats:
        """Return the positions that joints with position actuators are commanded to by `ctrl` (nu,), and `measured`
        for all others, shape (n,).
        """
        q, g = measured.copy(), self._position
        q[g.columns] = (ctrl[g.actuators] - g.offset) / g.scale
        return q

    def compute_ctrl_rates(self, velocity: Floats, acceleration: Floats) -> Floats:
        """Return how fast the `ctrl` of every joint may change [1/s] within joint velocity and acceleration, shape
        (n,); infinite for torque actuators, whose `ctrl` has no such bound.
        """
        rates = np.full(len(self.actuators), np.inf)
        for g, limit in ((self._position, velocity), (self._velocity, acceleration)):
            rates[g.columns] = limit[g.columns] * np.abs(g.scale)
        return rates

    def _write_torque(self, data: mujoco.MjData, q: Floats, v: Floats) -> None:
        g, w = self._torque, self._config.torque_frequency
        self._acceleration[g.dof] = w * w * (q[g.columns] - data.qpos[g.qpos]) + 2.0 * w * (
            v[g.columns] - data.qvel[g.dof]
        )
        mujoco.mj_mulM(self._model, data, self._force, self._acceleration)
        torque = self._force + data.qfrc_bias - data.qfrc_gravcomp
        data.ctrl[g.actuators] = torque[g.dof] * g.scale


def _make_group(model: mujoco.MjModel, rows: list[tuple[str, int, int, float, float]], kind: str) -> _Group:
    own = [(column, *row[1:]) for column, row in enumerate(rows) if row[0] == kind]
    columns, actuators, joints = (np.array([row[k] for row in own], dtype=np.intp) for k in range(3))
    scale, offset = (np.array([row[k] for row in own], dtype=np.float64) for k in (3, 4))
    qpos, dof = (np.asarray(one, dtype=np.intp)[joints] for one in (model.jnt_qposadr, model.jnt_dofadr))
    return _Group(columns, actuators, scale, offset, qpos, dof)


def _find_command_ranges(model: mujoco.MjModel, g: _Group, n: int) -> tuple[Floats, Floats]:
    """Return the joint positions that position actuators can be commanded to, shape (n,) each; infinite for others."""
    low, high = np.full(n, -np.inf), np.full(n, np.inf)
    ends = (np.asarray(model.actuator_ctrlrange)[g.actuators] - g.offset[:, None]) / g.scale[:, None]
    limited = np.asarray(model.actuator_ctrllimited)[g.actuators].astype(bool)
    low[g.columns] = np.where(limited, ends.min(axis=1), -np.inf)
    high[g.columns] = np.where(limited, ends.max(axis=1), np.inf)
    return low, high


def _find_law(model: mujoco.MjModel, robot: RobotSpec, actuator: int, joint: int) -> tuple[str, float, float]:
    """Type of one actuator, and scale and offset of its `ctrl`. MuJoCo: force = gain * (ctrl or act) + bias."""
    what = f"robot {robot.name!r}: actuator {get_reference(model, 'actuator', actuator)!r}"
    if int(model.actuator_trntype[actuator]) not in _JOINT_TRANSMISSIONS or model.actuator_trnid[actuator, 0] != joint:
        raise ControlError(f"{what} must act on the joint of the same place in the robot's list of joints")
    gear, gain = float(model.actuator_gear[actuator, 0]), float(model.actuator_gainprm[actuator, 0])
    bias = [float(b) for b in model.actuator_biasprm[actuator, :3]]
    dynamics, bias_type = int(model.actuator_dyntype[actuator]), int(model.actuator_biastype[actuator])
    if int(model.actuator_gaintype[actuator]) != _GAIN_FIXED or gain == 0.0 or gear == 0.0:
        raise ControlError(f"{what} needs a fixed gain and a gear other than zero")
    if bias_type == _BIAS_AFFINE and bias[1] != 0.0 and dynamics in (_DYN_NONE, *_DYN_FILTERS):
        return POSITION, -bias[1] * gear / gain, -bias[0] / gain
    if bias_type == _BIAS_AFFINE and bias[1] != 0.0 and dynamics == _DYN_INTEGRATOR:
        return VELOCITY, -bias[1] * gear / gain, 0.0
    if bias_type == _BIAS_AFFINE and bias[2] != 0.0 and dynamics == _DYN_NONE:
        return VELOCITY, -bias[2] * gear / gain, 0.0
    if bias_type == _BIAS_NONE and dynamics == _DYN_NONE:
        if robot.hold != GRAVITY_PD:
            raise ControlError(
                f"{what} is a torque actuator, which cannot hold by itself: declare hold = {GRAVITY_PD!r} for the robot"
            )
        return TORQUE, 1.0 / (gear * gain), 0.0
    raise ControlError(f"{what} must be a position, velocity, integrated velocity or motor actuator")


def _find_servo(
    model: mujoco.MjModel, kind: str, actuator: int, joint: int, config: ControlConfig
) -> tuple[float, float, float, float, float]:
    """Return stiffness, lag, reach, slack and droop of one servo: see `Servos`."""
    gear, dof = float(model.actuator_gear[actuator, 0]), int(model.jnt_dofadr[joint])
    bias = [float(b) for b in model.actuator_biasprm[actuator, :3]]
    dynamics = int(model.actuator_dyntype[actuator])
    damping, friction = float(np.max(model.dof_damping[dof])), float(model.dof_frictionloss[dof])
    lag, dead, droops = 0.0, 0.0, 1.0
    if kind == TORQUE:  # a PD about the measured joint whose gravity is compensated
        stiffness, droops = config.torque_frequency**2 * float(model.dof_M0[dof]), 0.0
        reach = config.joint_acceleration / config.torque_frequency**2
    else:
        reach = math.inf
        if kind == VELOCITY and dynamics != _DYN_INTEGRATOR:
            stiffness = -bias[2] * gear * gear * config.velocity_gain
            dead = config.velocity_deadband
        else:
            stiffness = -bias[1] * gear * gear
            damping -= bias[2] * gear * gear
            if dynamics in _DYN_FILTERS:
                lag = float(model.actuator_dynprm[actuator, 0])
            if kind == VELOCITY:
                dead, droops = config.velocity_deadband, 0.0
    stiffness = max(abs(stiffness), 1e-9)
    forces = []
    if model.actuator_forcelimited[actuator]:
        forces.append(float(np.abs(model.actuator_forcerange[actuator]).max()) * abs(gear))
    if model.jnt_actfrclimited[joint]:
        forces.append(float(np.abs(model.jnt_actfrcrange[joint]).max()))
    reach = min([reach, *(force / stiffness for force in forces)])
    return stiffness, lag + max(damping, 0.0) / stiffness, reach, friction / stiffness + dead, droops


def _find_bounds(
    model: mujoco.MjModel, kind: str, actuator: int, joint: int, scale: float, offset: float
) -> tuple[float, float]:
    low, high = (float(x) for x in model.jnt_range[joint]) if model.jnt_limited[joint] else (-np.inf, np.inf)
    if kind == POSITION and model.actuator_ctrllimited[actuator]:
        ends = sorted((float(c) - offset) / scale for c in model.actuator_ctrlrange[actuator])
        low, high = max(low, ends[0]), min(high, ends[1])
    return low, high


class Grippers:
    """Gripper `ctrl` of all robots that have one. `ctrl`, `goal`: shape (n_actuators,), in actuator units.

    With output `targets` nothing is written: the environment asks for `read_share`.

    The closing share 0..1 follows its goal at a bounded speed; it is unchanged in hold and in the first engaged step.
    """

    def __init__(self, model: mujoco.MjModel, robots: Sequence[RobotSpec], config: ControlConfig, dt: float) -> None:
        fitted = [(i, one) for i, robot in enumerate(robots) for one in robot.gripper_actuators]
        self._rows = {i: [k for k, (j, _) in enumerate(fitted) if j == i] for i, _ in fitted}
        self._open = [one.open for _, one in fitted]
        self._closed = [one.closed for _, one in fitted]
        self._actuators = np.array([find_id(model, "actuator", one.actuator) for _, one in fitted], dtype=np.intp)
        self._step = np.abs(np.subtract(self._closed, self._open)) * (config.gripper_speed * dt)
        self.ctrl = np.zeros(len(fitted))
        self.goal = np.zeros(len(fitted))

    def reset(self, data: mujoco.MjData) -> None:
        """Hold the grippers at their present `ctrl`."""
        self.ctrl[:] = data.ctrl[self._actuators]
        self.goal[:] = self.ctrl

    def place(self, robot: int, ctrl: Floats) -> None:
        """Hold the gripper of one robot at its value in `ctrl` (nu,)."""
        for row in self._rows.get(robot, ()):
            self.ctrl[row] = self.goal[row] = ctrl[self._actuators[row]]

    def find_output(self, robot: int, dt: float) -> tuple[list[int], list[float]]:
        """Return the actuators of a robot's gripper and how fast their `ctrl` may change [1/s]; empty without one."""
        rows = self._rows.get(robot, [])
        return [int(self._actuators[row]) for row in rows], [float(self._step[row]) / dt for row in rows]

    def set_goal(self, robot: int, closed: float | None) -> None:
        """Set the closing share 0 (open) to 1 (closed); `None` leaves the goal as it is."""
        if closed is None or not math.isfinite(closed):
            return
        share = min(max(closed, 0.0), 1.0)
        for row in self._rows.get(robot, ()):
            self.goal[row] = (1.0 - share) * self._open[row] + share * self._closed[row]

    def stop(self, robot: int) -> None:
        """Hold the gripper at its present `ctrl`."""
        for row in self._rows.get(robot, ()):
            self.goal[row] = self.ctrl[row]

    def read_share(self, robot: int) -> float | None:
        """Return how far the gripper of a robot is closed: 0 (open) to 1 (closed), `None` without one."""
        rows = self._rows.get(robot)
        if not rows or self._closed[rows[0]] == self._open[rows[0]]:
            return None
        first = rows[0]
        share = (float(self.ctrl[first]) - self._open[first]) / (self._closed[first] - self._open[first])
        return min(max(share, 0.0), 1.0) + 0.0 if math.isfinite(share) else None

    def tick(self, data: mujoco.MjData) -> None:
        """Move the grippers by a tick and write `data.ctrl`."""
        self.advance()
        data.ctrl[self._actuators] = self.ctrl

    def advance(self) -> None:
        """Move the grippers towards their goals by a tick."""
        if not self._actuators.size:
            return
        error = self.goal - self.ctrl
        near = np.abs(error) <= self._step
        self.ctrl += np.minimum(np.maximum(error, -self._step), self._step)
        self.ctrl[near] = self.goal[near]

    def save_state(self) -> list[bytes]:
        return [self.ctrl.tobytes(), self.goal.tobytes()]

    def restore_state(self, arrays: list[bytes]) -> None:
        self.ctrl[:], self.goal[:] = (np.frombuffer(raw) for raw in arrays)
