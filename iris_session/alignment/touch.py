"""Touched marks of one connection: kept, bounded, and registered together. The mathematics is `anchors.touch`'s."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from anchors.alignment import AlignmentEstimate
from anchors.pose import PoseTuple, Vec3, is_place
from anchors.touch import Registration, Touch, register

#: Touches kept of one point, and points: the last ones. Eight points that fit nowhere take 15 ms to blame.
KEPT_TOUCHES: Final = 5
KEPT_POINTS: Final = 8
_ENOUGH_POINTS: Final = 3


class TouchDesk:
    """Touches in, estimates out. `anchors`: `T_world_anchor`, of which touches count the position."""

    def __init__(self, anchors: Mapping[str, PoseTuple]) -> None:
        self._anchors = anchors
        self._touches: dict[str, deque[Vec3]] = {}
        self._suspects: frozenset[str] = frozenset()
        self._tracking_epoch = 0
        self.pending = False

    def touch(self, point: str, p_tracking_tip: Vec3, tracking_epoch: int) -> bool:
        """Takes one touch. False: of an older tracking frame, or nowhere."""
        if tracking_epoch < self._tracking_epoch or not is_place(p_tracking_tip):
            return False
        if tracking_epoch > self._tracking_epoch:
            self.forget()
            self._tracking_epoch = tracking_epoch
        kept = self._touches.pop(point, None) or deque(maxlen=KEPT_TOUCHES)
        if point in self._suspects:  # it was to be touched again: what was touched before is what was wrong
            kept.clear()
            self._suspects -= {point}
        kept.append(p_tracking_tip)
        self._touches[point] = kept
        while len(self._touches) > KEPT_POINTS:
            del self._touches[next(iter(self._touches))]
        self.pending = len(self._touches) >= _ENOUGH_POINTS
        return True

    @property
    def advice(self) -> str:
        """What is to be touched before there can be an estimate, empty for nothing."""
        if not 0 < len(self._touches) < _ENOUGH_POINTS:
            return ""
        return f"{len(self._touches)} points touched, {_ENOUGH_POINTS} are needed"

    def anchors_moved(self) -> None:
        self.pending = len(self._touches) >= _ENOUGH_POINTS

    def forget(self) -> None:
        self._touches.clear()
        self._suspects = frozenset()
        self.pending = False

    def estimate(self) -> AlignmentEstimate:
        """From all touches that are kept. May raise what linear algebra raises."""
        self.pending = False
        touches = [Touch(point, p) for point, kept in self._touches.items() for p in kept]
        marks = {point: self._anchors[point][0] for point in self._touches}
        got = register(marks, touches, self._tracking_epoch)
        self._suspects = frozenset(got.suspects)
        return replace(got.estimate, advice=got.estimate.advice or _residuals(got))


def _residuals(got: Registration) -> str:
    told = ", ".join(f"'{point}' {off * 1e3:.1f} mm" for point, off in sorted(got.residuals_m.items()))
    return f"touched points miss their marks by: {told}" if told else ""
