"""Success criteria of tasks with a deformable: pure functions of its vertices and contacts.

The criteria are those of the IRIS paper: a cloth is folded when its corners meet, a soft body is stowed when it was
lifted and lies in the box. Both count only when no robot touches the deformable and it is at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.common import Vec3

#: A deformable is at rest when no vertex moves farther than this [m] for this time [s].
STILL_M: Final = 0.005
STILL_S: Final = 0.5

Vertices = NDArray[np.float64]


@dataclass(frozen=True)
class FoldGoal:
    """Every pair of vertices of `pairs`, apart at first, comes closer than `within_m`.

    `name`: one word for the state in which the goal is reached. Vertices: world [m], shape (n, 3), in model order.
    """

    deformable: str
    pairs: tuple[tuple[int, int], ...]
    within_m: float = 0.05
    name: str = "folded"

    def has_begun(self, vertices: Vertices) -> bool:
        """Return True for a state that must occur before the goal counts."""
        return all(gap > 2.0 * self.within_m for gap in self._measure_gaps(vertices))

    def is_met(self, vertices: Vertices) -> bool:
        """Return True if the deformable lies as it should."""
        return all(gap <= self.within_m for gap in self._measure_gaps(vertices))

    def _measure_gaps(self, vertices: Vertices) -> list[float]:
        return [float(np.linalg.norm(vertices[a] - vertices[b])) for a, b in self.pairs]


@dataclass(frozen=True)
class StowGoal:
    """The whole body was `lifted_m` above the table, and lies within the box.

    `low`, `high`: corners of the inside of the box [m, world]; it stands square to the world. `table_z`: of its top.
    """

    deformable: str
    low: Vec3
    high: Vec3
    table_z: float = 0.0
    lifted_m: float = 0.10
    name: str = "stowed"

    def has_begun(self, vertices: Vertices) -> bool:
        return bool(vertices[:, 2].min() >= self.table_z + self.lifted_m)

    def is_met(self, vertices: Vertices) -> bool:
        return bool((vertices >= self.low).all() and (vertices <= self.high).all())


Goal = FoldGoal | StowGoal


class GoalMonitor:
    """Monitors one goal from tick to tick. `at_s`: simulated time at which it was reached, `None` until then."""

    def __init__(self, goal: Goal) -> None:
        self.goal = goal
        self.at_s: float | None = None
        self._begun = False
        self._rest: Vertices | None = None
        self._rest_since_s = 0.0

    def update(self, now_s: float, vertices: Vertices, touching: Sequence[str]) -> bool:
        """Process the state after a tick. Returns True in the tick in which the goal is reached."""
        if self.at_s is not None:
            return False
        self._begun = self._begun or self.goal.has_begun(vertices)
        moved = self._rest is None or float(np.abs(vertices - self._rest).max()) > STILL_M
        if moved or touching:
            self._rest, self._rest_since_s = vertices, now_s
        elif self._begun and now_s - self._rest_since_s >= STILL_S and self.goal.is_met(vertices):
            self.at_s = now_s
            return True
        return False
