"""`JointTargets`: what the drives of a robot's joints are given, within limits and at bounded speed; and fingers."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from iris_session.simulators.adapter import Floats

#: Largest speed of a target [rad/s or m/s]: inverse kinematics may jump from one solution to another.
MAX_SPEED: Final = 3.0
#: Steps after which a robot counts as not driven in between: its target then begins where it stands.
_FRESH_STEPS: Final = 2.5
#: A joint that is slower stands [rad/s or m/s]; PhysX says 0.05 of an arm at rest.
_REST_SPEED: Final = 0.2
#: Most that a load takes as a lead of a drive's target [rad or m].
_MAX_LOAD_LEAD: Final = 0.2


class Joints(NamedTuple):
    """Joints of a robot, shape (n,) each [rad or m, and per second].

    `q`, `v`: measured positions and speeds. `targets`: of their drives, as they are in force; `q` where a simulator
    does not say. `low`, `high`: limits; those without low < high are none. `speeds`: largest speeds; 0 and more than
    `MAX_SPEED` mean `MAX_SPEED`.
    """

    q: ArrayLike
    v: ArrayLike
    targets: ArrayLike
    low: ArrayLike
    high: ArrayLike
    speeds: ArrayLike = MAX_SPEED


class JointTargets:
    """Bounds the targets of the joints of robots, from step to step. Pure.

    A drive that is a spring carries the weight of an arm by the lead of its target. That lead is measured when a robot
    that stands is taken, and belongs to all targets: else the arm would sag by it, once when it is taken, and again
    when it is given back.
    """

    def __init__(self) -> None:
        self._given: dict[str, tuple[float, Floats, Floats]] = {}  # time, targets and leads of the newest step

    def limit(self, robot: str, at: tuple[float, float], joints: Joints, found: ArrayLike | None) -> Floats:
        """Return the targets for the drives of a robot.

        They may always return to where the joints are, and lead further than in the step before by speed x time.

        Args:
            robot: Its name.
            at: Time of the simulation, and that of a step [s].
            joints: Its joints.
            found: Positions that inverse kinematics found, shape (n,); `None`: the robot stays where it is.
        """
        (time_s, dt_s), now = at, np.asarray(joints.q, np.float64)
        then_s, before, lead = self._given.get(robot, (-math.inf, now, np.zeros_like(now)))
        if not 0.0 <= time_s - then_s <= _FRESH_STEPS * dt_s:
            load = np.asarray(joints.targets, np.float64) - now
            carries = (np.abs(joints.v) < _REST_SPEED) & (np.abs(load) <= _MAX_LOAD_LEAD)
            lead = np.where(carries, load, lead)
            before = now + lead
        rest = now + lead
        goal = rest if found is None else np.where(np.isfinite(found), np.asarray(found) + lead, before)
        low, high, speeds = (np.asarray(given, np.float64) for given in (joints.low, joints.high, joints.speeds))
        is_limited = low < high
        goal = np.clip(goal, np.where(is_limited, low, -np.inf), np.where(is_limited, high, np.inf))
        step = np.where(speeds > 0.0, np.minimum(speeds, MAX_SPEED), MAX_SPEED) * dt_s
        goal = np.clip(goal, np.minimum(before, rest) - step, np.maximum(before, rest) + step)
        self._given[robot] = time_s, goal, lead
        return goal


def place_fingers(fingers: Iterable[tuple[int, float, float, bool]], closed: float) -> dict[int, float]:
    """Return positions of the joints of fingers: those that slide close towards 0, others by turning up.

    Args:
        fingers: Number of each joint, its lower and upper limit [m or rad], and whether it is prismatic. Left out are
            those without finite limits, which have no closed position.
        closed: From 0, open, to 1, closed.
    """
    places = {}
    for joint, low, high, slides in fingers:
        if math.isfinite(low) and math.isfinite(high) and low < high:
            a, b = (high, low) if slides and abs(low) <= abs(high) else (low, high)
            places[joint] = a + closed * (b - a)
    return places
