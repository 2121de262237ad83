"""Inverse kinematics: when an arm's solve is due, one bounded differential step of it, and the limits that were active.

A step starts at the last solution (the joint goal), not at the measured joints, so sag and lag never feed back. While a
target is not reached, solving continues without new samples, at the rate of the slowest device so that a refinement
never delays a new sample, until the target is reached or no more progress is made (`reach`).

The step itself is in `solvers`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anchors.pose import PoseTuple, compose, inverse
from iris_session.control import clutch
from iris_session.control.arm_model import ArmModel, Floats
from iris_session.control.config import OUTPUT_CTRL, ControlConfig
from iris_session.control.interpolate import JointInterpolator
from iris_session.control.solvers import make_solver
from iris_session.control.state import RobotControlState
from iris_session.protocol.names import CommandKind
from iris_session.protocol.specs import HAND, RobotSpec

_MAX_STALLS = 5  # solves in a row without progress after which a target counts as out of reach
_WAYPOINTS, _HALVINGS = 8, 10  # how finely the way to a joint goal is searched for the edge of the workspace
_PROGRESS = 0.02  # share of the remaining error that a solve must go to count as progress
#: Limit of a robot that no pose moves.
JOINTS_ONLY = "joints_only"


class InverseKinematics:
    """Inverse kinematics of all robots at their rates. `rest`: posture that redundant joints drift to, shape (n,)."""

    def __init__(
        self,
        robots: Sequence[RobotSpec],
        arms: Sequence[ArmModel],
        columns: Sequence[slice],
        joints: JointInterpolator,
        bounds: tuple[Floats, Floats],
        config: ControlConfig,
    ) -> None:
        """Take over joints and bounds. `bounds`: joint positions that may be commanded, lower and upper, shape (n,)
        each.
        """
        self._robots, self._arms, self._columns = robots, arms, columns
        self._joints, self._config = joints, config
        self._lower, self._upper = bounds
        #: By robot that follows poses.
        self._solvers = {
            i: make_solver(arm, config)
            for i, (robot, arm) in enumerate(zip(robots, arms, strict=True))
            if config.output == OUTPUT_CTRL and robot.kind != HAND
        }
        self.rest: Floats = np.zeros(len(joints.q))
        self._solve_ticks = max(1, math.ceil(1.0 / (config.solve_rate_hz * joints.dt) - 1e-9))
        self._slow_interval = max(1.0 / config.sample_rate_min_hz, self._solve_ticks * joints.dt)
        self._refine_ticks = math.ceil(self._slow_interval / joints.dt - 1e-9)

    def solves_per_tick(self, check_ticks: int) -> tuple[int, int]:
        """Return how many robots may be solved in a tick, and in one with other work: each `check_ticks`th also checks
        distances.

        Two, or as many as all robots at their rate need (eight at 100 Hz: 1.6 in a tick of 2 ms, 4 in one of 5 ms), up
        to `max_solves_per_tick`; one less in a tick with a check, where the others make up for it.
        """
        needed = len(self._robots) / self._solve_ticks
        most = min(self._config.max_solves_per_tick, max(2, math.ceil(needed)))
        spare = most > 1 and most * check_ticks - 1 >= needed * check_ticks
        return most, most - spare

    def is_due(self, r: RobotControlState, tick: int) -> bool:
        """Return true when this robot may be solved in this tick."""
        if not r.want_solve:
            return False
        fed = r.pending is not None or (r.latch is not None and r.latch.kind == CommandKind.TWIST)
        return tick - r.last_solve >= (self._solve_ticks if fed else self._refine_ticks)

    def get_interval(self, r: RobotControlState, tick: int) -> float:
        """Return the time since the last goal [s], within the sample intervals of devices: the time to arrive at the
        next one.
        """
        return min(max(tick - r.last_solve, self._solve_ticks) * self._joints.dt, self._slow_interval)

    def compute_tip(self, i: int, r: RobotControlState) -> PoseTuple:
        """Return `T_world_tip` of the joint goal: where the robot will stand without further commands."""
        return compose(r.T_world_root, self._arms[i].forward_kinematics(self._joints.get_goal(self._columns[i])))

    def clip_to_workspace(
        self, i: int, r: RobotControlState, base: PoseTuple, goal: Floats, box: clutch.Box | None
    ) -> tuple[Floats, bool]:
        """Return the joint goal clipped to the workspace, and true when it was cut short.

        It is the last place on the way from the present goal at which the tip is inside the workspace `box`, widened to
        `base` where the robot was at the latch.
        """
        if box is None:
            return goal, False
        start = self._joints.get_goal(self._columns[i]).copy()
        low, high = 0.0, 0.0
        for k in range(1, _WAYPOINTS + 1):
            high = k / _WAYPOINTS
            if not self._is_inside(i, r, base, start + high * (goal - start), box):
                break
            low = high
        if low == 1.0:
            return goal, False
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            if self._is_inside(i, r, base, start + middle * (goal - start), box):
                low = middle
            else:
                high = middle
        return start + low * (goal - start), True

    def _is_inside(self, i: int, r: RobotControlState, base: PoseTuple, q: Floats, box: clutch.Box) -> bool:
        p, b = compose(r.T_world_root, self._arms[i].forward_kinematics(q))[0], base[0]
        slack = self._config.position_tolerance
        return all(min(box[0][k], b[k]) - slack <= p[k] <= max(box[1][k], b[k]) + slack for k in range(3))

    def solve(self, i: int, r: RobotControlState, state: clutch.Latch, tick: int) -> None:
        """Take one step from the last solution toward the target; the joints arrive about one sample later.

        A hand follows joints only: a pose does not move it, and that is one of its limits.
        """
        if i not in self._solvers:
            r.want_solve, r.last_solve, r.solver_limits = False, tick, (JOINTS_ONLY,)
            return
        columns, joints, config = self._columns[i], self._joints, self._config
        interval = self.get_interval(r, tick)
        goal, commanded, speed = joints.get_goal(columns), joints.get_position(columns), joints.velocity[columns]
        T_world_now = self.compute_tip(i, r)
        r.commanded = clutch.step_toward(
            T_world_now, state.target, config.tip_speed * interval, config.tip_angular_speed * interval
        )
        lead, step = speed * config.lead_s, speed * interval
        lower = np.maximum(self._lower[columns], commanded - lead) - goal
        upper = np.minimum(self._upper[columns], commanded + lead) - goal
        # A joint outside its range may stay there, and may come back at its own speed; it is never thrown back.
        lower = np.minimum(np.maximum(lower, -step), 0.0)
        upper = np.maximum(np.minimum(upper, step), 0.0)
        T_root_target = compose(inverse(r.T_world_root), r.commanded)
        q, singular = self._solvers[i].step(goal, self.rest[columns], T_root_target, lower, upper)
        bounded = (q - goal <= lower + 1e-9) | (q - goal >= upper - 1e-9)
        joints.set_goal(columns, q, interval)
        r.last_solve = tick
        self._update_limits(i, r, T_world_now, state.target, bounded, singular)

    def _update_limits(
        self,
        i: int,
        r: RobotControlState,
        T_world_before: PoseTuple,
        T_world_target: PoseTuple,
        bounded: NDArray[np.bool_],
        singular: bool,
    ) -> None:
        """Decide whether solving continues without new samples, and name the active limits."""
        goal, T_world_now = self._joints.get_goal(self._columns[i]), self.compute_tip(i, r)
        error = self._count_tolerances(T_world_now, T_world_target)
        progress = self._count_tolerances(T_world_before, T_world_now)
        reached = error <= 1.0
        r.stalls = 0 if reached or progress > _PROGRESS * error else min(r.stalls + 1, _MAX_STALLS)
        stuck = r.stalls == _MAX_STALLS
        r.want_solve = not (reached or stuck)
        at_range = (goal <= self._lower[self._columns[i]] + 1e-6) | (goal >= self._upper[self._columns[i]] - 1e-6)
        limits = [name for name, at in zip(self._robots[i].joints, at_range.tolist(), strict=True) if at]
        if not reached and bool((bounded & ~at_range).any()):
            limits.append("speed")
        if stuck:
            limits.append("reach")
        if singular:
            limits.append("singular")
        r.solver_limits = tuple(limits)

    def _count_tolerances(self, T_a: PoseTuple, T_b: PoseTuple) -> float:
        """Return the separation of two poses in tolerances: 1 = just within those that count as reached."""
        distance, angle = clutch.measure_separation(T_a, T_b)
        return max(distance / self._config.position_tolerance, angle / self._config.rotation_tolerance)
