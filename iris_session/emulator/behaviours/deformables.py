"""What a person sees and knows of deformables: where points of them are, and which points are the corners.

Vertices are numbered as in the model: a MuJoCo grid counts its last axis fastest.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

from anchors.pose import IDENTITY_QUAT, PoseTuple, Vec3
from iris_session.emulator.behaviours.arms import ARM, ArmKind
from iris_session.emulator.behaviours.base import OperatorView
from iris_session.emulator.behaviours.eyes import Eyes, Seen

#: Vertices at the corners of each deformable of the demo scenes.
CORNERS: Final[Mapping[str, tuple[int, ...]]] = {
    "cloth": (0, 16, 272, 288),  # 17 x 17
    "rose": (0, 3, 12, 15, 96, 99, 108, 111),  # 7 x 4 x 4, the first half of them at the -x end
    "mint": (0, 3, 12, 15, 96, 99, 108, 111),
}


class SoftEyes(Eyes):
    """Watches the corners of one deformable, robots, and bodies. `missing`: which of them were never seen so far."""

    def __init__(
        self, deformable: str, robots: tuple[str, ...], bodies: tuple[str, ...] = (), arm: ArmKind = ARM
    ) -> None:
        if deformable not in CORNERS:
            raise ValueError(f"no operator knows the deformable '{deformable}'. Known: {', '.join(CORNERS)}")
        super().__init__(bodies, robots, arm=arm)
        self.deformable = deformable
        self._corners: dict[int, Seen] = {}

    def look(self, view: OperatorView) -> None:
        super().look(view)
        now_s = view.session_time_ns * 1e-9
        for index in CORNERS[self.deformable]:
            p_world = view.vertex(self.deformable, index)
            if p_world is None:
                continue
            pose: PoseTuple = (p_world, IDENTITY_QUAT)
            if index in self._corners:
                self._corners[index].update(pose, now_s)
            else:
                self._corners[index] = Seen(pose, now_s)
        if len(self._corners) < len(CORNERS[self.deformable]):
            self.missing = (*self.missing, self.deformable)

    def corner(self, index: int) -> Vec3:
        """Where a corner is [m], smoothed."""
        return self._corners[index].pose[0]

    @property
    def corners(self) -> dict[int, Vec3]:
        """Where all corners are [m], smoothed, by vertex."""
        return {index: seen.pose[0] for index, seen in self._corners.items()}

    @property
    def middle(self) -> Vec3:
        """Between all corners [m]."""
        return mean(self.corners.values())

    @property
    def corners_still_s(self) -> float:
        """For how long [s] all corners have kept still."""
        return min(seen.still_s for seen in self._corners.values())


def mean(points: Iterable[Vec3]) -> Vec3:
    """The point in the middle of `points`."""
    xs, ys, zs = zip(*points, strict=True)
    return (sum(xs) / len(xs), sum(ys) / len(ys), sum(zs) / len(zs))
