"""From commanded joint motion to `ctrl`, by actuator type; with the joints at rest this is the hold law of each type.

* position (affine bias in the position): the `ctrl` whose equilibrium is the commanded position; at rest constant.
* velocity (also integrated velocity): commanded velocity plus a correction of the joint error beyond a deadband. At
  rest: exactly zero within the deadband; outside it (gravity on a soft servo) the correction bounds the drift to
  `deadband + torque / (kv * gain)` where zero alone would creep without end.
* torque: only with the declared law `gravity_pd`: inertia-weighted PD about the commanded motion plus the bias force
  (gravity, Coriolis), less what the model's own gravity compensation gives. At rest: PD on the held position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.control.arm_model import Floats, named_id
from iris_session.control.config import ControlConfig
from iris_session.control.errors import ControlError
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


@dataclass
class _Group:
    """Actuators of one type. `columns`: their joints among all commanded joints; `ctrl = x * scale + offset`."""

    columns: NDArray[np.intp]
    actuators: NDArray[np.intp]
    scale: Floats
    offset: Floats
    qpos: NDArray[np.intp]
    dof: NDArray[np.intp]


@dataclass
class _Rows:
    columns: list[int] = field(default_factory=list)
    actuators: list[int] = field(default_factory=list)
    scale: list[float] = field(default_factory=list)
    offset: list[float] = field(default_factory=list)
    joints: list[int] = field(default_factory=list)

    def group(self, model: mujoco.MjModel) -> _Group:
        joints = np.array(self.joints, dtype=np.intp)
        return _Group(
            np.array(self.columns, dtype=np.intp),
            np.array(self.actuators, dtype=np.intp),
            np.array(self.scale),
            np.array(self.offset),
            np.asarray(model.jnt_qposadr, dtype=np.intp)[joints],
            np.asarray(model.jnt_dofadr, dtype=np.intp)[joints],
        )


class ActuatorLaws:
    """Writes `data.ctrl` of all robots' arm joints. `lower`, `upper`: joint positions that can be commanded, (n,)."""

    def __init__(self, model: mujoco.MjModel, robots: Sequence[RobotSpec], config: ControlConfig) -> None:
        """Raises `ControlError` for an actuator that has no law."""
        self._model = model
        self._config = config
        rows = {POSITION: _Rows(), VELOCITY: _Rows(), TORQUE: _Rows()}
        bounds: list[tuple[float, float]] = []
        for robot in robots:
            if len(robot.actuators) != len(robot.joints):
                raise ControlError(
                    f"robot {robot.name!r} has {len(robot.joints)} joints and {len(robot.actuators)} actuators; "
                    "it must have one actuator per joint, in the same order"
                )
            for joint_name, name in zip(robot.joints, robot.actuators, strict=True):
                actuator = named_id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name, "actuator")
                joint = named_id(model, mujoco.mjtObj.mjOBJ_JOINT, joint_name, "joint")
                kind, scale, offset = _law(model, robot, actuator, joint)
                row = rows[kind]
                row.columns.append(len(bounds))
                row.actuators.append(actuator)
                row.scale.append(scale)
                row.offset.append(offset)
                row.joints.append(joint)
                bounds.append(_commandable(model, kind, actuator, joint, scale, offset))
        limits = np.array(bounds, dtype=np.float64).reshape(-1, 2)
        self.lower, self.upper = limits[:, 0].copy(), limits[:, 1].copy()
        self._position = rows[POSITION].group(model)
        self._velocity = rows[VELOCITY].group(model)
        self._torque = rows[TORQUE].group(model)
        self._acceleration = np.zeros(model.nv)
        self._force = np.zeros(model.nv)

    def write(self, data: mujoco.MjData, q: Floats, v: Floats, speed: Floats) -> None:
        """`ctrl` for commanded positions `q` and velocities `v` of all joints; velocity commands stay within `speed`.

        All shape (n,). `data` must hold what MuJoCo computes from the present positions and velocities.
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
            ctrl[g.actuators] = np.minimum(np.maximum(wanted, -limit), limit) * g.scale
        if self._torque.columns.size:
            self._write_torque(data, q, v)

    def _write_torque(self, data: mujoco.MjData, q: Floats, v: Floats) -> None:
        g, w = self._torque, self._config.torque_frequency
        self._acceleration[g.dof] = w * w * (q[g.columns] - data.qpos[g.qpos]) + 2.0 * w * (
            v[g.columns] - data.qvel[g.dof]
        )
        mujoco.mj_mulM(self._model, data, self._force, self._acceleration)
        torque = self._force + data.qfrc_bias - data.qfrc_gravcomp
        data.ctrl[g.actuators] = torque[g.dof] * g.scale


def _law(model: mujoco.MjModel, robot: RobotSpec, actuator: int, joint: int) -> tuple[str, float, float]:
    """Type of one actuator, and scale and offset of its `ctrl`. MuJoCo: force = gain * (ctrl or act) + bias."""
    name = mujoco.mj_id2name(model, int(mujoco.mjtObj.mjOBJ_ACTUATOR), actuator)
    what = f"robot {robot.name!r}: actuator {name!r}"
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


def _commandable(
    model: mujoco.MjModel, kind: str, actuator: int, joint: int, scale: float, offset: float
) -> tuple[float, float]:
    low, high = (float(x) for x in model.jnt_range[joint]) if model.jnt_limited[joint] else (-np.inf, np.inf)
    if kind == POSITION and model.actuator_ctrllimited[actuator]:
        ends = sorted((float(c) - offset) / scale for c in model.actuator_ctrlrange[actuator])
        low, high = max(low, ends[0]), min(high, ends[1])
    return low, high
