"""Perception of deformables, and the base of tasks with them.

The vertices may be older than the poses of the robots, even stand still for a while: a deformable counts as held until
newer vertices show otherwise. Vertices are numbered as in the
model: a MuJoCo grid counts its last axis fastest.
"""

from __future__ import annotations

import itertools
import math
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from typing import Final

from anchors.pose import IDENTITY_QUAT, PoseTuple, Quat, Vec3, quat_angle, quat_from_yaw, quat_mul
from iris_session.emulator.behaviours.base import OperatorView
from iris_session.emulator.behaviours.objects import ARM, CLEAR_ABOVE, DOWN, ArmKind
from iris_session.emulator.behaviours.perception import Perception, TrackedPose
from iris_session.emulator.behaviours.phases import PhasedTask

#: Vertices at the corners of each deformable of the demo scenes.
CORNERS: Final[Mapping[str, tuple[int, ...]]] = {
    "cloth": (0, 16, 272, 288),  # 17 x 17
    "rose": (0, 3, 12, 15, 96, 99, 108, 111),  # 7 x 4 x 4, the first half of them at the -x end
    "mint": (0, 3, 12, 15, 96, 99, 108, 111),
}
#: Vertices next to a corner on the way to the middle, by the vertex at the corner: the first and the second.
INNER: Final[Mapping[str, Mapping[int, tuple[int, int]]]] = {
    "cloth": {0: (18, 36), 16: (32, 48), 272: (256, 240), 288: (270, 252)},
}


def list_observed_vertices(deformable: str) -> tuple[int, ...]:
    """Return the vertices of `deformable` that operators track."""
    return (*CORNERS[deformable], *itertools.chain(*INNER.get(deformable, {}).values()))


class DeformablePerception(Perception):
    """Tracks the corners of one deformable with the vertices beside them, robots, and bodies.

    `missing`: those that have not been in the scene so far.
    """

    def __init__(
        self, deformable: str, robots: tuple[str, ...], bodies: tuple[str, ...] = (), arm: ArmKind = ARM
    ) -> None:
        if deformable not in CORNERS:
            raise ValueError(f"unknown deformable '{deformable}'. Known: {', '.join(CORNERS)}")
        super().__init__(bodies, robots, arm=arm)
        self.deformable = deformable
        self._indices = list_observed_vertices(deformable)
        self._vertices: dict[int, TrackedPose] = {}
        #: Session time of the displayed frame, and of the displayed vertices [s].
        self.now_s = self.captured_s = 0.0

    def observe(self, view: OperatorView) -> None:
        super().observe(view)
        self.now_s = now_s = view.session_time_ns * 1e-9
        self.captured_s = view.vertices_ns(self.deformable) * 1e-9
        for index in self._indices:
            p_world = view.vertex(self.deformable, index)
            if p_world is None:
                continue
            pose: PoseTuple = (p_world, IDENTITY_QUAT)
            if index in self._vertices:
                self._vertices[index].update(pose, now_s)
            else:
                self._vertices[index] = TrackedPose(pose, now_s)
        if len(self._vertices) < len(self._indices):
            self.missing = (*self.missing, self.deformable)

    def get_corner(self, index: int) -> Vec3:
        """Return the position of a corner [m], smoothed."""
        return self._vertices[index].pose[0]

    def compute_inner_point(self, corner: int, cells: float) -> Vec3:
        """Return a point this far from a corner towards the middle [m], in cells of the grid along both edges, 1 to
        2.
        """
        (ax, ay, az), (bx, by, bz) = (self._vertices[index].pose[0] for index in INNER[self.deformable][corner])
        w = cells - 1.0
        return (ax + w * (bx - ax), ay + w * (by - ay), az + w * (bz - az))

    @property
    def corners(self) -> dict[int, Vec3]:
        """Positions of all corners [m], smoothed, by vertex."""
        return {index: self._vertices[index].pose[0] for index in CORNERS[self.deformable]}

    @property
    def middle(self) -> Vec3:
        """Between all corners [m]."""
        return compute_mean(self.corners.values())

    @property
    def corners_still_s(self) -> float:
        """Time for which all corners have been at rest [s], by the capture times of the vertices."""
        return max(0.0, self.captured_s - max(self._vertices[index].rest_since_s for index in CORNERS[self.deformable]))


def compute_mean(points: Iterable[Vec3]) -> Vec3:
    """Return the mean of `points`."""
    xs, ys, zs = zip(*points, strict=True)
    return (sum(xs) / len(xs), sum(ys) / len(ys), sum(zs) / len(zs))


#: Maximum delay of the vertices of a deformable behind the poses of the fingers that hold it [s].
PICTURE_LATE_S: float = 10.0
#: Time for which the vertices must show that the deformable is not held [s].
SEEN_S: float = 0.6


class DeformableTask(PhasedTask):
    """Phases of a task with what `eyes` watch."""

    perception: DeformablePerception

    def __init__(self, robot: str, device: str, eyes: DeformablePerception, arm: ArmKind) -> None:
        super().__init__(robot, device, eyes, arm)
        self._steps["back_off"] = lambda: self._rise(CLEAR_ABOVE, "look", trigger=0.0)
        self._lost_s: float | None = None  # session time since which it seems to stay behind
        self._phase_s = 0.0  # session time of the start of the phase

    def _enter(self, phase: str) -> None:
        super()._enter(phase)
        self._phase_s = self.perception.now_s

    def _is_shown_for(self, seconds: float) -> bool:
        """Return True if the vertices show the first `seconds` of this phase, or are too late for that."""
        return self.perception.captured_s > self._phase_s + seconds or self._has_lasted(seconds + PICTURE_LATE_S)

    def _open(self, trigger: float) -> None:
        """Open the fingers, and continue with `leave`."""
        if self._entering_now:
            self.hand.hold_still()
            self.hand.trigger_goal = trigger
        if self.hand.is_trigger_done() and self._has_lasted(0.8):
            self._enter("leave")

    def _turn_down(self, yaw: float) -> Quat:
        """Return the rotation of a tip that points down and closes across `yaw` [rad], with the least wrist turn."""
        home = (self._home or self.perception.get_tip(self.robot))[1]
        turns = [quat_mul(quat_from_yaw(yaw + half), DOWN) for half in (0.0, math.pi)]
        return min(turns, key=lambda turn: quat_angle(turn, home))

    @abstractmethod
    def _is_holding(self) -> bool:
        """Return True if the displayed deformable moves with the fingers."""

    def _check_slip(self, reason: str) -> bool:
        """Return True while the displayed deformable does not move with the fingers.

        Its vertices may only be late: the hand stops until they show the same moment, then the phase starts again. If
        the deformable was lost, another attempt starts with `reason`."""
        now_s, lost_s = self.perception.now_s, self._lost_s
        if self._is_holding():
            if lost_s is not None:
                self._lost_s = None
                self._enter(self.phase)
            return lost_s is not None
        if lost_s is None:
            self._lost_s = now_s
            self.hand.move_to(self.perception.get_tip(self.robot), correct=False)
        elif self.perception.captured_s > lost_s + SEEN_S or now_s > lost_s + PICTURE_LATE_S:
            self._lost_s = None
            self._retry(reason)
        return True
