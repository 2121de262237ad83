"""Apply new estimates to an alignment: small corrections slide in unnoticed, larger ones are announced first.

The scene must not jump visibly, and no robot may move because an estimate changed. While a clutch is engaged nothing
changes; the correction gathered meanwhile is reported as `pending_m`. Pure: times are passed in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from anchors.alignment import AlignmentEstimate
from anchors.pose import (
    PoseTuple,
    Vec3,
    apply,
    compose,
    distance,
    inverse,
    quat_angle,
    quat_conj,
    quat_from_rotvec,
    quat_mul,
    quat_rotate,
    quat_to_rotvec,
)

CorrectionStep = Literal["none", "first", "slide", "announced", "jump"]


@dataclass(frozen=True)
class CorrectionConfig:
    """Limits of corrections.

    `slide_m_per_s`, `slide_rad_per_s`: slow enough not to be noticed in a headset. Corrections above `announce_m` or
    `announce_rad` would be visible and wait until `accept`.
    """

    slide_m_per_s: float = 0.004
    slide_rad_per_s: float = math.radians(0.3)
    announce_m: float = 0.010
    announce_rad: float = math.radians(2.0)


@dataclass(frozen=True)
class CorrectedAlignment:
    """The alignment to use now. `pending_m`, `pending_rad`: distance of the estimate, at its pivot."""

    T_world_tracking: PoseTuple
    step: CorrectionStep
    pending_m: float
    pending_rad: float


@dataclass
class CorrectionFilter:
    """Filter that follows the estimates of one headset."""

    config: CorrectionConfig = field(default_factory=CorrectionConfig)
    _T_world_tracking: PoseTuple | None = None
    _epoch: int = 0
    _last_ns: int = 0
    _accepted: bool = False

    def accept(self) -> None:
        """Accept the announced correction; it is applied with the next update."""
        self._accepted = True

    def update(self, estimate: AlignmentEstimate, now_ns: int, engaged: bool = False) -> CorrectedAlignment | None:
        """Return the alignment to use, `None` if there is none (refused and none before, or a new tracking frame)."""
        seconds, self._last_ns = max(0.0, (now_ns - self._last_ns) * 1e-9), now_ns
        if estimate.tracking_epoch != self._epoch:
            self._T_world_tracking, self._epoch, self._accepted = None, estimate.tracking_epoch, False
        if estimate.refused:
            return (
                None if self._T_world_tracking is None else CorrectedAlignment(self._T_world_tracking, "none", 0.0, 0.0)
            )
        old, new = self._T_world_tracking, estimate.T_world_tracking
        if old is None:
            self._T_world_tracking = new
            return CorrectedAlignment(new, "first", 0.0, 0.0)
        pivot_tracking = apply(inverse(new), estimate.pivot_world)
        away, turn = distance(apply(old, pivot_tracking), estimate.pivot_world), quat_angle(old[1], new[1])
        if engaged:
            return CorrectedAlignment(old, "none", away, turn)
        if away > self.config.announce_m or turn > self.config.announce_rad:
            if not self._accepted:
                return CorrectedAlignment(old, "announced", away, turn)
            self._T_world_tracking, self._accepted = new, False
            return CorrectedAlignment(new, "jump", 0.0, 0.0)
        self._accepted = False
        share = min(1.0, self._slide_share(away, turn, seconds))
        self._T_world_tracking = interpolate_about_pivot(old, new, pivot_tracking, share)
        return CorrectedAlignment(
            self._T_world_tracking, "slide" if share > 0.0 else "none", (1.0 - share) * away, (1.0 - share) * turn
        )

    def _slide_share(self, away: float, turn: float, seconds: float) -> float:
        needed = max(away / self.config.slide_m_per_s, turn / self.config.slide_rad_per_s, 1e-9)
        return min(seconds, 1.0) / needed  # after a pause it continues to slide and does not jump


def interpolate_about_pivot(old: PoseTuple, new: PoseTuple, pivot_tracking: Vec3, share: float) -> PoseTuple:
    """Interpolate `T_world_tracking`: the pivot moves on a straight line and everything rotates about it, so that a
    small rotation moves nothing far at the anchor."""
    r = quat_to_rotvec(quat_mul(new[1], quat_conj(old[1])))
    q = quat_mul(quat_from_rotvec((share * r[0], share * r[1], share * r[2])), old[1])
    a, b = apply(old, pivot_tracking), apply(new, pivot_tracking)
    turned = quat_rotate(q, pivot_tracking)
    p = (
        a[0] + share * (b[0] - a[0]) - turned[0],
        a[1] + share * (b[1] - a[1]) - turned[1],
        a[2] + share * (b[2] - a[2]) - turned[2],
    )
    return compose((p, q), ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
