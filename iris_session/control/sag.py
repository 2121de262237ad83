"""Compensation of what position servos sag by: gravity, springs, payloads, friction.

A position servo gives its force by a lead of its command on the joint. The command is therefore `aim + support`: `aim`
is where the joint shall stand, which inverse kinematics solves for, and `support` the lead that carries the load there.
Per joint, in rad (m for slides), with `droop`, lag and static bound as in `hold`:

* In a hold the command stays as it is, so `support` is the lead that is in force, as far as droop and load explain it,
  and the aim is where the joint stands: an engagement latches the tip where it is measured, and changes no command.
* While engaged, `support` follows `droop + load` of the measured joints, within what the actuator can do: its force
  limit, its range of commands. Both move the goal of the interpolator, so that limits of speed and acceleration hold.
* `load` is what the model does not know: a payload, friction. It is learned slowly (`_LEARN_S`) from how far the joint
  stands from its aim, and shared with the hold law, whose holds keep it.

A load and a hand that presses against the robot look alike. What tells them apart:

* It is learned at rest only, and for `_WINDOW_S` after a motion of the aim since the engagement began: who presses
  against a robot that stands, before or after it is engaged, is not learned, who presses for long neither.
* A joint that is pushed further from its aim than it stood ends its window.
* Once a joint meets its bound (`hold`), its robot is blocked: windows end, and what was learned in them is forgotten.
* Nothing is learned where the actuator can give no more.
* At any time at rest, less is learned: a joint that has stood for `_SHED_S` beyond its aim, in the direction in which
  it is supported, loses of that support what it does not need. A payload was put down, or a hand let go.

In every case the command stays within the bound of `hold`, with or without compensation: a blocked joint pushes with no
more than the static bound, at most the actuator's force limit.

What is left is said: `sag`, when a robot stands for `_SAID_S` further than `_SAG_M` from where it shall.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from iris_session.control.arm_model import Floats
from iris_session.control.hold import HoldLaw
from iris_session.control.interpolate import JointInterpolator

#: Limit of a robot that stands short of its target.
SAG: Final = "sag"
#: Time constants of droop, which is known, of what is unexplained of the lead at engagement, and of the load [s].
_FOLLOW_S: Final = 0.02
_FADE_S: Final = 0.3
_LEARN_S: Final = 0.25
#: A load is learned from this time after a motion of the aim on [s], and so many times the lag, for at most so long.
_SETTLE_S: Final = 0.2
_SETTLE_LAGS: Final = 3.0
_WINDOW_S: Final = 2.0
#: A joint that stands beyond its aim for so long outside a window is supported too much [s].
_SHED_S: Final = 0.5
#: Shares of the speed limit: a joint is at rest below the first; a load is learned by at most the second.
_REST_SPEED: Final = 0.1
_LEARN_SPEED: Final = 0.05
#: Times at the speed limit: an aim has moved from the first on (10 mrad at 2.5 rad/s); smaller errors than the second
#: (0.5 mrad) are not corrected: noise, and what friction holds.
_MOVED_S: Final = 0.004
_DEAD_S: Final = 0.0002
#: A change of support that is as good as none [rad or m].
_TINY: Final = 1e-7
#: A robot whose tip, or a hand whose joint, stands this far from where it shall [m, rad], for so long [s], is said to
#: sag, until it is nearer than this share.
_SAG_M: Final = 0.003
_SAG_RAD: Final = 0.03
_SAID_S: Final = 0.3
_CLEAR: Final = 0.7


class SagCompensation:
    """Moves the goals of a `JointInterpolator` by what position servos sag by.

    Arrays of shape (n,), part of the snapshot, besides `support` of the interpolator and `load` of the hold law:
    `window`: time left to learn [s], `mark`: the aim for which it began, `known`: load at its beginning, `nearest`:
    smallest error in it, `beyond`: time for which it has been supported too much, at rest and outside windows [s],
    `error`: how far the joint stands from its aim, `trim`: the part of `support` that neither droop nor load explain
    when an engagement begins. Of each robot: `standing`: time for which it has been at rest too far from its target
    [s], `said`: 1 when it is said to sag.
    """

    def __init__(self, joints: JointInterpolator, hold: HoldLaw, columns: Sequence[slice]) -> None:
        n, servos = len(joints.q), hold.servos
        self._joints, self._hold, self._servos, self._columns = joints, hold, servos, columns
        speed, self._dt = joints.velocity, joints.dt
        self._rest_speed, self._moved, self._dead = _REST_SPEED * speed, _MOVED_S * speed, _DEAD_S * speed
        self._step = _LEARN_SPEED * speed * joints.dt
        self._follow, self._fade = min(1.0, joints.dt / _FOLLOW_S), min(1.0, joints.dt / _FADE_S)
        self._wait = _WINDOW_S + _SETTLE_S + _SETTLE_LAGS * servos.lag
        joints.support = self.support = np.zeros(n)
        self.window, self.mark, self.known, self.nearest, self.beyond = (np.zeros(n) for _ in range(5))
        self.error, self.trim = np.zeros(n), np.zeros(n)
        self.standing, self.said = np.zeros(len(columns)), np.zeros(len(columns))

    def reset(self) -> None:
        """Forget everything: the joints were placed."""
        for array in self._arrays():
            array[:] = 0.0

    def begin_support(self, columns: slice, x: Floats, droop: Floats) -> None:
        """Let some joints, placed where `ctrl` in force commands them, aim at where they are measured."""
        low, high = self._hold.find_band(droop)
        support = _clip(self._joints.q - x, low, high) * self._servos.supports
        self.support[columns] = support[columns]
        self.trim[columns] = (support - droop * self._servos.supports)[columns]

    def engage(self, columns: slice) -> None:
        """Begin an engagement of some joints: their aim is as it is, no motion of it is to be learned from."""
        self.mark[columns] = self._joints.get_goal(columns)
        self.window[columns] = self.beyond[columns] = 0.0

    def update(
        self, x: Floats, v: Floats, droop: Floats, latched: NDArray[np.bool_], driven: NDArray[np.bool_]
    ) -> None:
        """Follow the loads by one tick, after the commands were bounded. All shape (n,).

        Args:
            x, v: Measured positions and velocities.
            droop: Leads that carry gravity where the joints stand.
            latched: Joints of robots whose clutch is closed.
            driven: Those of them that may move: not in the step in which their clutch closes.
        """
        hold, joints, support = self._hold, self._joints, self.support
        lead = joints.q - x
        resting = self._servos.supports & ~latched
        if resting.any():
            low, high = hold.find_band(droop)
            support[resting] = _clip(lead, low, high)[resting]
            self.trim[resting] = (support - droop - hold.load)[resting]
        driven = driven & self._servos.supports
        if not driven.any():
            return
        aim = joints.goal - support
        spare = self.trim - _clip(self.trim, -hold.dead, hold.dead)
        if spare.any():
            self.trim[driven] -= (spare * self._fade)[driven]
        wanted = droop + hold.load + self.trim
        low = np.maximum(np.minimum(self._servos.low - aim, 0.0), -self._servos.reach)
        high = np.minimum(np.maximum(self._servos.high - aim, 0.0), self._servos.reach)
        possible = _clip(wanted, low, high)
        change = (possible - support) * self._follow
        change = _clip(change, low - support, high - support)  # no command leaves its range
        change *= driven & (np.abs(change) >= _TINY)
        if change.any():
            support += change
            joints.goal += change
            joints.moving = True
        np.subtract(lead, support, out=self.error)
        moved = driven & (np.abs(aim - self.mark) > self._moved)
        if moved.any():
            self.window[moved], self.nearest[moved] = self._wait[moved], np.inf
            self.mark[moved], self.known[moved] = aim[moved], hold.load[moved]
        if hold.strained.any():
            blocked = driven & self._find_blocked()
            ended = blocked & (self.window > 0.0)
            self.window[ended], hold.load[ended] = 0.0, self.known[ended]
            driven &= ~blocked
        self._learn(v, wanted - possible, driven)

    def _learn(self, v: Floats, surplus: Floats, free: NDArray[np.bool_]) -> None:
        """Learn the loads of driven joints that are not blocked.

        `surplus`: of the support that is wanted, what the actuator cannot give.
        """
        hold, joints = self._hold, self._joints
        window = free & (self.window > 0.0)
        if not (window.any() or (np.abs(self.error) > self._dead).any()):
            self.beyond[:] = 0.0
            return
        self.window[window] = np.maximum(self.window - self._dt, 0.0)[window]
        error = self.error - self._servos.lag * v
        size = np.abs(error)
        change = _clip(error * min(1.0, self._dt / _LEARN_S), -self._step, self._step)
        rests = free & (np.abs(v) <= self._rest_speed) & (np.abs(joints.goal - joints.q) <= self._moved)
        wrong = rests & (size > self._dead) & (surplus * error <= 0.0)

        learning = window & rests & (self.window <= _WINDOW_S)
        self.window[learning & (size > self.nearest + 6.0 * self._dead)] = 0.0
        self.nearest[learning] = np.minimum(self.nearest, size)[learning]
        learning &= wrong & (self.window > 0.0)
        hold.load[learning] = _clip(hold.load + change, -hold.static, hold.static)[learning]

        wrong &= ~window & ((error * hold.load < 0.0) | (error * self.trim < 0.0))
        self.beyond[:] = np.where(wrong, self.beyond + self._dt, 0.0)
        shedding = self.beyond > _SHED_S
        if shedding.any():
            for part in (self.trim, hold.load):
                shed = _clip(change, -np.maximum(part, 0.0), -np.minimum(part, 0.0))  # towards zero
                part[shedding] += shed[shedding]
                change -= shed

    def _find_blocked(self) -> NDArray[np.bool_]:
        """Return the joints of robots of which one met its bound: all of them carry what it presses against."""
        blocked = self._hold.strained > 0.0
        for columns in self._columns:
            blocked[columns] = blocked[columns].any()
        return blocked

    # --- what is left -------------------------------------------------------------------------------------------------

    def is_near(self, robot: int) -> bool:
        """Return true while all joints of a robot are where they shall stand, closely enough for any arm."""
        columns = self._columns[robot]
        return bool((np.abs(self.error[columns]) <= self._dead[columns]).all())

    def is_standing(self, robot: int, v: Floats) -> bool:
        """Return true when a robot is at rest, as measured and as commanded. `v`: measured, shape (n,)."""
        columns = self._columns[robot]
        fastest = np.maximum(np.abs(v[columns]), np.abs(self._joints.v[columns]))
        return bool((fastest <= self._rest_speed[columns]).all())

    def note(self, robot: int, distance: float, angle: float, elapsed: float) -> None:
        """Note how far a standing robot is from where it shall stand [m, rad], `elapsed` [s] after the last time."""
        left = max(distance / _SAG_M, angle / _SAG_RAD)
        self.standing[robot] = self.standing[robot] + elapsed if left > 1.0 else 0.0
        if self.standing[robot] >= _SAID_S:
            self.said[robot] = 1.0
        elif left < _CLEAR:
            self.said[robot] = 0.0

    def forget(self, robot: int) -> None:
        """Forget what was noted of a robot that is not driven."""
        self.standing[robot] = self.said[robot] = 0.0

    # --- snapshots ----------------------------------------------------------------------------------------------------

    def save_state(self) -> list[bytes]:
        """Return the arrays as raw bytes, for snapshots."""
        return [a.tobytes() for a in self._arrays()]

    def restore_state(self, arrays: Sequence[bytes]) -> None:
        """Restore the arrays of `save_state`."""
        for array, raw in zip(self._arrays(), arrays, strict=True):
            array[:] = np.frombuffer(raw)

    def _arrays(self) -> tuple[Floats, ...]:
        robots = (self.standing, self.said)
        learned = (self.support, self.window, self.mark, self.known, self.nearest, self.beyond)
        return (*learned, self.error, self.trim, *robots)


def _clip(a: Floats, low: Floats, high: Floats) -> Floats:
    return np.minimum(np.maximum(a, low), high)
