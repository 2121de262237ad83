"""Stated errors of alignments: from the covariance of a headset's frame to the error of a position at a robot."""

from __future__ import annotations

import math
from typing import Final

from iris_session.authority.context import Context
from iris_session.authority.state import Participant
from iris_session.protocol.common import Vec3

#: 95 % quantile of the standard normal distribution.
Z95: Final = 1.6448536269514722


def position_p95(covariance: tuple[float, ...], pivot: Vec3, point: Vec3) -> float:
    """95 % quantile [m] of the length of the position error at `point`, from a 6x6 covariance stated at `pivot`.

    The error at the point is dp + dtheta x r with r = point - pivot. Its squared length is a weighted sum of chi-square
    variables, approximated by one with the same mean and variance (Satterthwaite), its quantile by Wilson-Hilferty.
    """
    r = (point[0] - pivot[0], point[1] - pivot[1], point[2] - pivot[2])
    # Rows of [I | -[r]x]: how (dp, dtheta) moves the point.
    J = (
        (1.0, 0.0, 0.0, 0.0, r[2], -r[1]),
        (0.0, 1.0, 0.0, -r[2], 0.0, r[0]),
        (0.0, 0.0, 1.0, r[1], -r[0], 0.0),
    )
    CJ = [[sum(covariance[6 * i + k] * row[k] for k in range(6)) for i in range(6)] for row in J]
    C = [[sum(J[i][k] * CJ[j][k] for k in range(6)) for j in range(3)] for i in range(3)]
    mean = C[0][0] + C[1][1] + C[2][2]
    if not (0.0 < mean < math.inf):
        return 0.0 if mean == 0.0 else math.inf
    spread = sum(c * c for row in C for c in row)
    freedom = min(3.0, max(1.0, mean * mean / spread)) if math.isfinite(spread) and spread > 0.0 else 1.0
    a = 2.0 / (9.0 * freedom)
    return math.sqrt(mean * (1.0 - a + Z95 * math.sqrt(a)) ** 3)


def at_robot(ctx: Context, p: Participant, robot: str) -> float:
    """Stated p95 position error [m] of `p` at the end effector of `robot`; 0 where none is stated (placed, offset)."""
    alignment = p.alignment
    if alignment is None or not alignment.covariance:
        return 0.0
    return position_p95(alignment.covariance, p.pivot_world, ctx.view.tip_pose(robot).p)


def at_robots(
    ctx: Context, p: Participant, covariance: tuple[float, ...], pivot_world: Vec3, error_at_anchor_m: float
) -> float:
    """At the robots that `p` holds (the worst of them), else at the robot nearest to the anchor."""
    held = [g.target for g in ctx.state.robots.values() if any(h.participant == p.id for h in g.grants)]
    points = {name: ctx.view.tip_pose(name).p for name in held or ctx.robots}
    errors = [position_p95(covariance, pivot_world, point) for point in points.values()]
    return max(errors) if held else min(errors, default=error_at_anchor_m)


def widened(covariance: tuple[float, ...], away: tuple[float, ...]) -> tuple[float, ...]:
    """A covariance with an error (3 m, 3 rad, at its pivot) that is still to be corrected: C + v v^T.

    Its p95 is never less than that error itself, at any lever arm.
    """
    return tuple(c + away[i // 6] * away[i % 6] for i, c in enumerate(covariance))
