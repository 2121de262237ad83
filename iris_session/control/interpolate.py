"""Joint motion at the tick rate: all robots' commanded joints follow their goals in one vectorised pass.

Goals come at 60-100 Hz. Towards a goal the joints move evenly, so that they arrive one and a half sample intervals
later: when samples keep coming, the next goal is there before they have to slow down. Velocity and acceleration never
exceed their limits, and every joint can always stop at its goal without passing it.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.control.arm_model import ArmModel, Floats
from iris_session.control.config import ControlConfig, ControlError
from iris_session.protocol.specs import RobotSpec

#: Arrival after this many sample intervals: above 1, so that motion between regular samples is even.
ARRIVAL_INTERVALS = 1.5


class JointInterpolator:
    """Commanded positions `q` and velocities `v` of n joints, moving to `goal`. All arrays float64, shape (n,).

    `cap`: velocity limit in force now (ramps lower it); `near`: the one that proximity sets, apart from `cap` so that
    neither undoes the other; the lower of both counts. `one_way`: `near` has a sign, and forbids the other direction;
    infinite where it limits nothing. `remaining`: time to arrive in [s].
    `before`, `before_v`: `q` and `v` before this tick. `support`: the part of `q` and `goal` that carries loads: the
    joints shall stand at `goal - support` (`sag`). `None` without compensation.
    """

    def __init__(self, velocity: Floats, acceleration: Floats, dt: float, one_way: bool = False) -> None:
        n = len(velocity)
        self.q, self.v, self.goal, self.remaining = np.zeros(n), np.zeros(n), np.zeros(n), np.full(n, dt)
        self.before, self.before_v = np.zeros(n), np.zeros(n)
        self.one_way = one_way
        self.free = np.full(n, np.inf) if one_way else velocity
        self.velocity, self.cap, self.near = velocity, velocity.copy(), self.free.copy()
        self.acceleration = acceleration
        self.dt = dt
        self._dv = acceleration * dt
        self._unit = acceleration * dt * dt
        self.moving = False
        self.support: Floats | None = None

    def place(self, q: Floats) -> None:
        """Stand still at `q`."""
        self.q[:] = q
        self.goal[:] = q
        self.v[:] = 0.0
        self.remaining[:] = self.dt
        self.cap[:], self.near[:] = self.velocity, self.free
        self.moving = False
        if self.support is not None:
            self.support[:] = 0.0

    def place_part(self, joints: slice | NDArray[np.intp], q: Floats) -> None:
        """Let some joints stand still at `q`, their positions; the others go on."""
        self.q[joints] = q
        self.goal[joints] = q
        self.v[joints] = 0.0
        self.remaining[joints] = self.dt
        self.cap[joints], self.near[joints] = self.velocity[joints], self.free[joints]
        if self.support is not None:
            self.support[joints] = 0.0

    def get_goal(self, joints: slice) -> Floats:
        """Return where some joints shall stand once they have arrived."""
        return self.goal[joints] if self.support is None else self.goal[joints] - self.support[joints]

    def get_position(self, joints: slice) -> Floats:
        """Return where some joints shall stand now."""
        return self.q[joints] if self.support is None else self.q[joints] - self.support[joints]

    def set_goal(self, joints: slice, goal: Floats, interval: float) -> None:
        """Set where some joints shall stand, to arrive `ARRIVAL_INTERVALS` times `interval` [s] from now."""
        self.goal[joints] = goal if self.support is None else goal + self.support[joints]
        self.remaining[joints] = ARRIVAL_INTERVALS * interval
        self.moving = True

    def stop(self, joints: slice) -> None:
        """Set the goal to where these joints can stop, but not beyond the goal they already had."""
        q, v = self.q[joints], self.v[joints]
        reach = self.find_stop_distance(self.v)[joints]
        distance = np.minimum(reach, np.abs(self.goal[joints] - q))
        ahead = np.sign(self.goal[joints] - q) == np.sign(v)
        # Standing joints finish the last step of their motion, if any is left, only when they already move.
        self.goal[joints] = q + np.sign(v) * np.where(ahead, distance, reach)
        self.remaining[joints] = self.dt
        self.moving = True

    def find_stop_distance(self, v: Floats) -> Floats:
        """Return the distances in which joints stop from speeds `v` of either sign, shape (n,).

        Slowing down from the next tick on, by dv a tick: k dv, (k - 1) dv, ...
        """
        speed = np.maximum(np.abs(v) / self._dv - 1.0, 0.0)
        ticks = np.floor(speed)
        return (0.5 * ticks * (ticks + 1.0) + (speed - ticks) * (ticks + 1.0)) * self._unit

    def advance(self) -> None:
        """Advance by one tick."""
        self.before[:], self.before_v[:] = self.q, self.v
        if not self.moving:
            return
        error = self.goal - self.q
        # Fastest speed from which a joint still stops at its goal: the inverse of the sum in `stop`, exact in ticks.
        distance = np.abs(error) / self._unit
        ticks = np.floor(0.5 * (np.sqrt(1.0 + 8.0 * distance) - 1.0))
        brake = (ticks + (distance - 0.5 * ticks * (ticks + 1.0)) / (ticks + 1.0)) * self._dv
        limit = np.minimum(brake, np.minimum(self.cap, np.abs(self.near)))
        wanted = np.minimum(np.maximum(error / self.remaining, -limit), limit)
        if self.one_way:
            wanted[np.isfinite(self.near) & (np.sign(wanted) == -np.sign(self.near))] = 0.0
        self.v += np.minimum(np.maximum(wanted - self.v, -self._dv), self._dv)
        self.q += self.v * self.dt
        np.maximum(self.remaining - self.dt, self.dt, out=self.remaining)
        arrived = (np.abs(self.goal - self.q) < 1e-9) & (np.abs(self.v) <= self._dv)
        if arrived.any():
            self.q[arrived] = self.goal[arrived]
            # The speed of arrival ends in the next tick, within the acceleration limit for any next target.
            self.moving = not bool((arrived & (self.v == 0.0)).all())

    def save_state(self) -> list[bytes]:
        """Return the arrays as raw bytes, for snapshots."""
        return [a.tobytes() for a in self._arrays()]

    def restore_state(self, arrays: list[bytes], moving: bool) -> None:
        """Restore the arrays of `save_state`."""
        for array, raw in zip(self._arrays(), arrays, strict=True):
            array[:] = np.frombuffer(raw)
        self.moving = moving

    def _arrays(self) -> tuple[Floats, ...]:
        return (self.q, self.v, self.goal, self.remaining, self.cap, self.near)


def read_speed_limits(
    model: mujoco.MjModel, robots: Sequence[RobotSpec], arms: Sequence[ArmModel], config: ControlConfig
) -> tuple[Floats, Floats]:
    """Return velocity and acceleration limits of all robots' joints, shape (n,) each.

    Raises `ControlError` when the configuration names a joint that no robot has.
    """
    names = [name for robot in robots for name in robot.joints]
    for name in (*config.velocity_limits, *config.acceleration_limits):
        if name not in names:
            raise ControlError(f"limit of joint {name!r}: no robot has it. Available joints: {', '.join(names)}")
    slide = int(mujoco.mjtJoint.mjJNT_SLIDE)
    slides = [int(model.jnt_type[j]) == slide for arm in arms for j in arm.joint_ids]
    velocity = [
        config.velocity_limits.get(name, config.slide_velocity if s else config.joint_velocity)
        for name, s in zip(names, slides, strict=True)
    ]
    acceleration = [
        config.acceleration_limits.get(name, config.slide_acceleration if s else config.joint_acceleration)
        for name, s in zip(names, slides, strict=True)
    ]
    return np.array(velocity), np.array(acceleration)
