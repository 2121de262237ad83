"""Grippers: closing share 0..1 to `ctrl`, at a bounded speed; unchanged in hold and in the first engaged step."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from iris_session.control.arm_model import named_id
from iris_session.control.config import ControlConfig
from iris_session.protocol.specs import RobotSpec


class Grippers:
    """Gripper `ctrl` of all robots that have one. `ctrl`, `goal`: shape (n_grippers,), in actuator units."""

    def __init__(self, model: mujoco.MjModel, robots: Sequence[RobotSpec], config: ControlConfig, dt: float) -> None:
        fitted = [(i, r) for i, r in enumerate(robots) if r.gripper_actuator]
        self._row = {i: k for k, (i, _) in enumerate(fitted)}
        self._open = [r.gripper_open for _, r in fitted]
        self._closed = [r.gripper_closed for _, r in fitted]
        self._actuators = np.array(
            [named_id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, r.gripper_actuator, "actuator") for _, r in fitted],
            dtype=np.intp,
        )
        self._step = np.abs(np.subtract(self._closed, self._open)) * (config.gripper_speed * dt)
        self.ctrl = np.zeros(len(fitted))
        self.goal = np.zeros(len(fitted))

    def reset(self, data: mujoco.MjData) -> None:
        """Where the grippers' `ctrl` stands is where they stay."""
        self.ctrl[:] = data.ctrl[self._actuators]
        self.goal[:] = self.ctrl

    def command(self, robot: int, closed: float | None) -> None:
        """Closing share 0 (open) to 1 (closed); `None` leaves the goal as it is."""
        row = self._row.get(robot)
        if row is not None and closed is not None and math.isfinite(closed):
            share = min(max(closed, 0.0), 1.0)
            self.goal[row] = (1.0 - share) * self._open[row] + share * self._closed[row]

    def stop(self, robot: int) -> None:
        """Stays at the present `ctrl`."""
        row = self._row.get(robot)
        if row is not None:
            self.goal[row] = self.ctrl[row]

    def tick(self, data: mujoco.MjData) -> None:
        if not self._actuators.size:
            return
        error = self.goal - self.ctrl
        near = np.abs(error) <= self._step
        self.ctrl += np.minimum(np.maximum(error, -self._step), self._step)
        self.ctrl[near] = self.goal[near]
        data.ctrl[self._actuators] = self.ctrl

    def state(self) -> list[bytes]:
        return [self.ctrl.tobytes(), self.goal.tobytes()]

    def set_state(self, arrays: list[bytes]) -> None:
        self.ctrl[:], self.goal[:] = (np.frombuffer(raw) for raw in arrays)
