"""Perception of a scripted operator: poses smoothed over a few frames, and how long a body has been at rest."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from anchors.pose import PoseTuple, Vec3, apply, distance, quat_conj, quat_from_rotvec, quat_mul, quat_to_rotvec
from iris_session.emulator.behaviours.base import OperatorView
from iris_session.emulator.behaviours.objects import ARM, ArmKind

#: Smoothing time of vision [s]: averages 1 mm of noise at 60-90 Hz to about 0.4 mm.
SMOOTHING_S = 0.07
#: A body that stays within this distance [m] is at rest.
STILL_M = 0.005


class TrackedPose:
    """A pose smoothed over `SMOOTHING_S`, and the time since which it is at rest."""

    def __init__(self, pose: PoseTuple, now_s: float) -> None:
        self.pose = pose
        self._now_s = now_s
        self._rest = pose[0]
        self.rest_since_s = now_s

    def update(self, pose: PoseTuple, now_s: float) -> None:
        a = 1.0 - math.exp(-(now_s - self._now_s) / SMOOTHING_S)
        (x, y, z), q = self.pose
        rx, ry, rz = quat_to_rotvec(quat_mul(pose[1], quat_conj(q)))
        p = (x + a * (pose[0][0] - x), y + a * (pose[0][1] - y), z + a * (pose[0][2] - z))
        self.pose = (p, quat_mul(quat_from_rotvec((a * rx, a * ry, a * rz)), q))
        self._now_s = now_s
        if distance(p, self._rest) > STILL_M:
            self._rest, self.rest_since_s = p, now_s

    @property
    def still_s(self) -> float:
        """Time for which it has been at rest [s]."""
        return self._now_s - self.rest_since_s


class Perception:
    """Tracks bodies and robot tips by name. `missing`: those that have not been in the scene so far.

    `arm`: the kind of the robots. `perhaps`: bodies that may be absent. `pads`: by robot, instead of those of `arm`:
    the bodies of two fingers, each with the point in its frame that touches what it holds [m]; bases are not tracked
    then.
    """

    def __init__(
        self,
        bodies: tuple[str, ...],
        robots: tuple[str, ...],
        perhaps: tuple[str, ...] = (),
        arm: ArmKind = ARM,
        pads: Mapping[str, Sequence[tuple[str, Vec3]]] | None = None,
    ) -> None:
        self._arm = arm
        bases = () if pads is not None else tuple(f"{robot}/{arm.base}" for robot in robots)
        self._pads = pads or {
            robot: [(f"{robot}/{finger}", pad) for finger, pad in zip(arm.fingers, arm.pads, strict=True)]
            for robot in robots
        }
        self._bodies = (*bodies, *dict.fromkeys(finger for both in self._pads.values() for finger, _ in both), *bases)
        self._robots = robots
        self._optional = perhaps
        self._tracked: dict[str, TrackedPose] = {}
        self._others: list[Vec3] = []
        self.missing: tuple[str, ...] = self._bodies

    def observe(self, view: OperatorView) -> None:
        """Process the present frame. Bodies that it lacks keep their last pose."""
        now_s = view.session_time_ns * 1e-9
        poses = [(name, view.body_pose(name)) for name in self._bodies]
        poses += [(f"tip {robot}", view.tip_pose(robot)) for robot in self._robots]
        for name, pose in poses:
            if pose is None:
                continue
            if name in self._tracked:
                self._tracked[name].update(pose, now_s)
            else:
                self._tracked[name] = TrackedPose(pose, now_s)
        self.missing = tuple(name for name, _ in poses if name not in self._tracked)
        self._others = [pose[0] for pose in map(view.body_pose, self._optional) if pose is not None]

    @property
    def is_complete(self) -> bool:
        """True when every required body has been in the scene."""
        return not self.missing

    def list_obstacles(self) -> list[Vec3]:
        """Return the positions [m] of the optional bodies in the scene."""
        return self._others

    def get_body(self, name: str) -> PoseTuple:
        return self._tracked[name].pose

    def get_tip(self, robot: str) -> PoseTuple:
        return self._tracked[f"tip {robot}"].pose

    def get_base(self, robot: str) -> PoseTuple:
        return self._tracked[f"{robot}/{self._arm.base}"].pose

    def get_still_s(self, name: str) -> float:
        """Return how long [s] the body `name` has been at rest."""
        return self._tracked[name].still_s

    def compute_pads(self, robot: str) -> tuple[Vec3, Vec3]:
        """Return the positions of the two finger pads [m], world frame."""
        one, other = (apply(self._tracked[finger].pose, pad) for finger, pad in self._pads[robot])
        return one, other

    def compute_gap(self, robot: str) -> float:
        """Distance between the finger pads [m]."""
        return distance(*self.compute_pads(robot))

    def is_holding(self, robot: str, name: str, half_width: float) -> bool:
        """Return True if the pads of `robot` lie on the two sides of `name` (half width [m] along its y), closed on
        it."""
        (px, py, pz), q = self.get_body(name)
        inverse_q = quat_conj(q)
        local = [
            apply(((0.0, 0.0, 0.0), inverse_q), (p[0] - px, p[1] - py, p[2] - pz)) for p in self.compute_pads(robot)
        ]
        low, high = sorted(p[1] for p in local)
        on_both_sides = abs(low + half_width) < 0.006 and abs(high - half_width) < 0.006
        along = all(abs(p[0]) < 0.15 and abs(p[2]) < 0.02 for p in local)
        return on_both_sides and along
