"""Human-like point-to-point motion: minimum-jerk paths (Flash and Hogan 1985) between poses."""

from __future__ import annotations

from dataclasses import dataclass

from anchors.pose import PoseTuple, distance, quat_angle, quat_conj, quat_from_rotvec, quat_mul, quat_to_rotvec

#: Peak over mean speed of a minimum-jerk movement.
PEAK_TO_MEAN = 1.875
#: Shortest voluntary movement [s].
SHORTEST_S = 0.3


def min_jerk(s: float) -> float:
    """Fraction of the way after the fraction `s` of the time; 0 to 1, with zero speed and acceleration at the ends."""
    s = min(max(s, 0.0), 1.0)
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))


@dataclass(frozen=True, slots=True)
class Reach:
    """One movement from `start` to `goal`, from time `start_s`, lasting `duration_s` seconds."""

    start: PoseTuple
    goal: PoseTuple
    start_s: float
    duration_s: float

    @classmethod
    def plan(cls, start: PoseTuple, goal: PoseTuple, start_s: float, speed: float, turn: float) -> Reach:
        """A movement whose peak speeds are at most `speed` [m/s] and `turn` [rad/s]."""
        mean_s = max(distance(start[0], goal[0]) / speed, quat_angle(start[1], goal[1]) / turn)
        return cls(start, goal, start_s, max(SHORTEST_S, PEAK_TO_MEAN * mean_s))

    def pose(self, now_s: float) -> PoseTuple:
        s = min_jerk((now_s - self.start_s) / self.duration_s)
        (ax, ay, az), (bx, by, bz) = self.start[0], self.goal[0]
        r = quat_to_rotvec(quat_mul(self.goal[1], quat_conj(self.start[1])))
        q = quat_mul(quat_from_rotvec((s * r[0], s * r[1], s * r[2])), self.start[1])
        return ((ax + s * (bx - ax), ay + s * (by - ay), az + s * (bz - az)), q)

    def finished(self, now_s: float) -> bool:
        return now_s >= self.start_s + self.duration_s
