"""Growth of the uncertainty of an alignment since the last look that confirmed it: by time, and by the distance that
the head has walked.

Pure arithmetic on tuples, as the authority needs it: no numpy. Covariances are 6x6 row-major, (x, y, z [m], rx, ry, rz
[rad]), world frame with Z up, stated at a pivot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

Covariance = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class AgeingLaw:
    """Drift of a headset's tracking frame that no look has measured, one sigma.

    The translation by time is the drift that the estimator assumes (docs/anchors.md, "Noise"), per axis. All others are
    assumed: a headset that recognises its room loses most of what an open path of odometry adds (0.5 to 1 % of its
    length), so what walking adds grows with the root of the distance. Yaw turns about a point that is not known, as far
    from the anchor as `lever_m`; roll and pitch are held by gravity.
    """

    drift_m_per_min: float = 0.003 / math.sqrt(3.0)  # each axis
    yaw_rad_per_min: float = math.radians(0.2)
    walk_m: float = 0.001  # each axis, after one metre
    walk_yaw_rad: float = math.radians(0.03)  # after one metre
    lever_m: float = 1.0
    stride_m: float = 0.1  # shorter motions of a head are no walk: noise must not add up


def compute_growth(law: AgeingLaw, minutes: float, walked_m: float) -> tuple[float, float, float]:
    """Return by how much variances have grown: of x and y each [m^2], of z [m^2], of the yaw [rad^2]."""
    minutes, walked_m = max(0.0, minutes), max(0.0, walked_m)
    drift = (law.drift_m_per_min * minutes) ** 2 + law.walk_m**2 * walked_m
    yaw = (law.yaw_rad_per_min * minutes) ** 2 + law.walk_yaw_rad**2 * walked_m
    return drift + 0.5 * law.lever_m**2 * yaw, drift, yaw


def grow_covariance(covariance: Covariance, law: AgeingLaw, minutes: float, walked_m: float) -> Covariance:
    """Return a 6x6 covariance that includes the drift since the last look.

    Args:
        covariance: Of the alignment when it was confirmed, at its pivot.
        law: How a tracking frame drifts.
        minutes: Since the last look that confirmed it.
        walked_m: Distance that the head has walked meanwhile [m].
    """
    level, upright, yaw = compute_growth(law, minutes, walked_m)
    grown = list(covariance)
    for i, more in ((0, level), (7, level), (14, upright), (35, yaw)):
        grown[i] += more
    return tuple(grown)
