"""`JointTargets`: what the drives of a robot's joints are given, within limits and at bounded speed; and fingers."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from iris_session.simulators.adapter import Floats

#: Largest speed of a target [rad/s or m/s]: inverse kinematics may jump from one solution to another.
MAX_SPEED: Final = 3.0
#: Steps after which a robot counts as not driven in between: its target then begins where it stands.
_FRESH_STEPS: Final = 2.5


class JointTargets:
    """Bounds the targets of the joints of robots, from step to step. Pure."""

    def __init__(self) -> None:
        self._given: dict[str, tuple[float, Floats]] = {}  # time and targets of the newest step, by robot

    def limit(
        self,
        robot: str,
        at: tuple[float, float],
        now: ArrayLike,
        found: ArrayLike,
        limits: tuple[ArrayLike, ArrayLike],
        speeds: ArrayLike = MAX_SPEED,
    ) -> Floats:
        """Return the targets for the drives of a robot.

        They may always return to where the joints are, and lead further than in the step before by speed x time.

        Args:
            robot: Its name.
            at: Time of the simulation, and that of a step [s].
            now: Positions of its joints, shape (n,) [rad or m].
            found: Positions that inverse kinematics found, shape (n,).
            limits: Lower and upper limits, shape (n,) each; those without low < high are none.
            speeds: Largest speeds [rad/s or m/s]; 0 and more than `MAX_SPEED` mean `MAX_SPEED`.
        """
        (time_s, dt_s), now = at, np.asarray(now, np.float64)
        then_s, before = self._given.get(robot, (-math.inf, now))
        if not 0.0 <= time_s - then_s <= _FRESH_STEPS * dt_s:
            before = now
        goal = np.where(np.isfinite(found), found, before)
        low, high = (np.asarray(limit, np.float64) for limit in limits)
        is_limited = low < high
        goal = np.clip(goal, np.where(is_limited, low, -np.inf), np.where(is_limited, high, np.inf))
        speeds = np.asarray(speeds, np.float64)
        step = np.where(speeds > 0.0, np.minimum(speeds, MAX_SPEED), MAX_SPEED) * dt_s
        goal = np.clip(goal, np.minimum(before, now) - step, np.maximum(before, now) + step)
        self._given[robot] = time_s, goal
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
