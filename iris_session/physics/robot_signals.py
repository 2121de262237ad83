"""Values of robots of one model after a tick: for recordings (`RobotSignals`), and for clients (`RobotStateReader`)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.physics.names import find_element_id
from iris_session.physics.tip import Tip
from iris_session.physics.view import MujocoView
from iris_session.protocol.common import Pose
from iris_session.protocol.server_messages import ActuatorInfo, RobotState
from iris_session.protocol.specs import RobotSpec

Rows = NDArray[np.intp]
#: Dynamics with which `ctrl` is a position: none, and filters of it.
FOLLOWS: Final = (
    int(mujoco.mjtDyn.mjDYN_NONE),
    int(mujoco.mjtDyn.mjDYN_FILTER),
    int(mujoco.mjtDyn.mjDYN_FILTEREXACT),
)


class RobotSignals:
    """Measured values of the robots of one model: joints, openings of grippers, positions of tips.

    `units`: of the joints of each robot, `rad` or `m`.
    """

    def __init__(self, model: mujoco.MjModel, robots: Sequence[RobotSpec]) -> None:
        def find(kind: str, names: Sequence[str], robot: RobotSpec) -> list[int]:
            return [find_element_id(model, kind, name, f"robot {robot.name!r}: ") for name in names]

        joints = [find("joint", robot.joints, robot) for robot in robots]
        slide = int(mujoco.mjtJoint.mjJNT_SLIDE)
        self.units = tuple(tuple("m" if int(model.jnt_type[j]) == slide else "rad" for j in one) for one in joints)
        self._qpos = np.array([int(model.jnt_qposadr[j]) for one in joints for j in one], np.int64)
        self._tips = [Tip(model, robot) for robot in robots]
        sites = [tip.site for tip in self._tips]
        #: All end effectors at once, where each is a site.
        self._sites = np.array(sites, np.int64) if all(site >= 0 for site in sites) else None
        laws = [
            (i, actuator, *law)
            for i, robot in enumerate(robots)
            for actuator in find("actuator", [robot.gripper_actuator] if robot.gripper_actuator else [], robot)
            if (law := find_opening_law(model, actuator, robot)) is not None
        ]
        self._grippers = np.array([law[:2] for law in laws], np.int64).reshape(-1, 2).T
        self._scale, self._offset = np.array([law[2:] for law in laws]).reshape(-1, 2).T
        n = len(robots)
        self._values: NDArray[np.float64] = np.full(len(self._qpos) + 4 * n, np.nan)
        self._openings = self._values[len(self._qpos) : len(self._qpos) + n]

    def read(self, data: Any) -> bytes:
        """Return the values of the present state as float64, empty without robots.

        In this order: the joints of all robots [rad or m]; the opening of the gripper of each robot, 0 closed and 1
        open, NaN without one that is controlled by position; the position of each tip, x y z [m], world frame.
        """
        values = self._values
        values[: len(self._qpos)] = data.qpos[self._qpos]
        if len(self._scale):
            self._openings[self._grippers[0]] = data.actuator_length[self._grippers[1]] * self._scale + self._offset
        tips = values[len(self._qpos) + len(self._tips) :]
        if self._sites is not None:
            tips[:] = data.site_xpos[self._sites].ravel()
        else:
            tips[:] = np.concatenate([tip.read_position(data) for tip in self._tips])
        return values.tobytes()


class RobotStateReader:
    """Reads `RobotState` of the robots of one model."""

    def __init__(self, model: mujoco.MjModel, robots: Sequence[RobotSpec]) -> None:
        self._robots = [(robot.name, *_find_rows(model, robot)) for robot in robots]

    def read(self, data: Any, view: MujocoView, targets: Mapping[str, Pose]) -> tuple[RobotState, ...]:
        """Return the states of all robots after the newest tick.

        Args:
            data: Of the world.
            view: Of the same data.
            targets: `T_world_tip` that control moves each driven robot to.
        """
        states = []
        for name, qpos, qvel, ctrl, gripper, law in self._robots:
            closed = None
            if law is not None:
                closed = 1.0 - (float(data.actuator_length[gripper]) * law[0] + law[1])
            q, qd, commanded = data.qpos[qpos].tolist(), data.qvel[qvel].tolist(), data.ctrl[ctrl].tolist()
            tip, force, target = view.tip_pose(name), view.gripper_force(name), targets.get(name)
            states.append(RobotState(name, tuple(q), tuple(qd), tip, closed, force, target, tuple(commanded)))
        return tuple(states)


def find_opening_law(model: mujoco.MjModel, actuator: int, robot: RobotSpec) -> tuple[float, float] | None:
    """Return scale and offset from the length of a position actuator to the opening; `None` for other actuators.

    The length is that at which the actuator rests for some `ctrl`; the opening is where that lies between `ctrl` closed
    and open: 0 closed, 1 open.
    """
    span, law = robot.gripper_open - robot.gripper_closed, _find_position_law(model, actuator)
    if law is None or span == 0.0:
        return None
    scale, offset = law
    return scale / span, (offset - robot.gripper_closed) / span


def describe_actuators(model: mujoco.MjModel, robot: RobotSpec) -> tuple[ActuatorInfo, ...]:
    """Return the actuators of a robot as clients need them, those of its gripper last."""
    found = []
    for name in robot.actuators:
        actuator = find_element_id(model, "actuator", name)
        scale, offset = _find_position_law(model, actuator) or (0.0, 0.0)
        found.append(
            ActuatorInfo(name, *_find_range(model, actuator), scale * float(model.actuator_gear[actuator, 0]), offset)
        )
    for one in robot.gripper_actuators:
        low, high = _find_range(model, find_element_id(model, "actuator", one.actuator))
        found.append(ActuatorInfo(one.actuator, low, high, one.closed - one.open, one.open))
    return tuple(found)


def _find_range(model: mujoco.MjModel, actuator: int) -> tuple[float, float]:
    if not model.actuator_ctrllimited[actuator]:
        return -math.inf, math.inf
    low, high = model.actuator_ctrlrange[actuator].tolist()
    return low, high


def _find_position_law(model: mujoco.MjModel, actuator: int) -> tuple[float, float] | None:
    """Return scale and offset from the length of an actuator to the `ctrl` with which it rests there; `None` where it
    is not controlled by position."""
    gain, (constant, slope) = float(model.actuator_gainprm[actuator, 0]), model.actuator_biasprm[actuator, :2].tolist()
    is_position = (
        int(model.actuator_gaintype[actuator]) == int(mujoco.mjtGain.mjGAIN_FIXED)
        and int(model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
        and int(model.actuator_dyntype[actuator]) in FOLLOWS
        and 0.0 not in (gain, slope)
    )
    return (-slope / gain, -constant / gain) if is_position else None


def _find_rows(model: mujoco.MjModel, robot: RobotSpec) -> tuple[Rows, Rows, Rows, int, tuple[float, float] | None]:
    """Return the rows of a robot in `qpos`, `qvel` and `ctrl`, and its gripper's actuator with its law."""
    joints = [find_element_id(model, "joint", joint) for joint in robot.joints]
    names = (*robot.actuators, *(one.actuator for one in robot.gripper_actuators))
    ctrl = [find_element_id(model, "actuator", name) for name in names]
    gripper = find_element_id(model, "actuator", robot.gripper_actuator) if robot.gripper_actuator else -1
    law = find_opening_law(model, gripper, robot) if gripper >= 0 else None
    qpos, qvel = model.jnt_qposadr[joints].astype(np.intp), model.jnt_dofadr[joints].astype(np.intp)
    return qpos, qvel, np.array(ctrl, np.intp), gripper, law
