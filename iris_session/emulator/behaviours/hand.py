"""The hand of a scripted operator: moves a robot's tip by clutched relative motion with visual feedback.

While the clutch is closed the tip follows the *changes* of the hand. The operator therefore moves the hand as the
tip should move, and corrects the remaining error after the movement. When the robot does not follow (the session holds
it, or the engagement was lost), the operator opens the clutch, waits a moment and closes it again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from anchors.pose import (
    IDENTITY_POSE,
    PoseTuple,
    Vec3,
    distance,
    quat_angle,
    quat_conj,
    quat_from_rotvec,
    quat_mul,
    quat_normalize,
    quat_to_rotvec,
)
from iris_session.emulator.behaviours.base import HandInput, OperatorView

#: Peak speeds of free movements; the hand itself stays below 0.5 m/s with corrections added.
SPEED = 0.40  # m/s
TURN = 1.6  # rad/s
#: Visual corrections: per second of remaining error. Times the loop delay (0.1-0.2 s) well below 1, so it is stable.
CORRECTION_RATE = 3.0
CORRECTION_SPEED = 0.06  # m/s
CORRECTION_TURN = 0.3  # rad/s
CORRECTION_MOST = 0.05  # m, and rad times ten
#: The tip is this far from where it should be, for so long: the robot does not follow.
LOST_M = 0.08
LOST_RAD = 0.4
LOST_S = 0.7
#: After the movement the tip is still this far away, for so long: the same.
STUCK_M = 0.012
STUCK_S = 1.5
#: The clutch stays open so long before it is closed again [s].
REARM_S = 0.25
#: Pulling or releasing the trigger takes so long [s].
TRIGGER_S = 0.4
#: Longest step of the operator's own clock [s]: after a stall of the computer the hand goes on, it does not jump.
LONGEST_STEP_S = 0.05


class ClutchedHand:
    """One hand on one robot. Call `update` once per sample, then `input`; goals are tip poses in the world."""

    def __init__(self, device: str, robot: str, speed: float = SPEED) -> None:
        self.device, self.robot = device, robot
        self._free_speed = speed  # m/s
        self.now_s = 0.0  # the operator's own clock: runs only while the operator can act
        self.reclutches = 0
        self.trigger_goal = 0.0
        self._trigger = 0.0
        self._last_ns: int | None = None
        self._engaged = False
        self._rearm_s = 0.0
        self._hand: PoseTuple = IDENTITY_POSE
        self._hand_at_engage: PoseTuple = IDENTITY_POSE
        self._tip_at_engage: PoseTuple = IDENTITY_POSE
        self._correction_p: Vec3 = (0.0, 0.0, 0.0)
        self._correction_r: Vec3 = (0.0, 0.0, 0.0)
        self._goal: PoseTuple | None = None
        self._speed, self._turn = speed, TURN
        self._movement: HandMovement | None = None
        self._correcting = True
        self._missing_m, self._missing_rad = math.inf, math.inf
        self._close_since_s = math.inf
        self._trouble_since_s = [math.inf, math.inf]  # since when lost, since when stuck
        self._still = False

    def update(self, view: OperatorView, tip: PoseTuple | None) -> bool:
        """Advance the hand to the present. `tip`: displayed tip pose. Returns True if the operator can act."""
        step_s = self._advance_clock(view.session_time_ns)
        if tip is None or view.estop or view.lease_version(self.robot) is None:
            self._open()
            self._hand = view.device_pose(self.device)
            return False
        self.now_s += step_s
        rate = step_s / TRIGGER_S
        if not self._engaged:
            self._hand = view.device_pose(self.device)
            if self.now_s >= self._rearm_s:
                self._engage(tip)
        else:
            self._trigger += min(max(self.trigger_goal - self._trigger, -rate), rate)
            self._follow(tip, step_s)
        return True

    def move_to(self, goal: PoseTuple, speed: float | None = None, turn: float = TURN, correct: bool = True) -> None:
        """Start a movement of the tip to `goal`. `correct`: correct the remaining error after it."""
        speed = self._free_speed if speed is None else min(speed, self._free_speed)
        self._goal, self._speed, self._turn, self._correcting = goal, speed, turn, correct
        self._still = False
        self._close_since_s = math.inf
        if self._engaged:
            self._movement = HandMovement.plan(self._compute_reference(), goal, self.now_s, speed, turn)

    def hold_still(self) -> None:
        """Keep the hand still: no corrections while two robots hold the same object."""
        self._correcting, self._still = False, True

    def has_arrived(self, within_m: float = 0.003, within_rad: float = 0.02, for_s: float = 0.12) -> bool:
        """Return True if the movement is over and the tip was at the goal for `for_s` seconds."""
        if not self.has_moved():
            return False
        if self._missing_m > within_m or self._missing_rad > within_rad:
            self._close_since_s = math.inf
            return False
        self._close_since_s = min(self._close_since_s, self.now_s)
        return self.now_s - self._close_since_s >= for_s

    def has_moved(self) -> bool:
        """Return True if the movement is over, independent of the tip."""
        return self._engaged and self._movement is not None and self._movement.is_finished(self.now_s)

    def is_trigger_done(self) -> bool:
        return self._engaged and self._trigger == self.trigger_goal

    def open_clutch(self, for_s: float) -> None:
        """Open the clutch for `for_s` seconds; the last goal stays."""
        self._open()
        self._rearm_s = self.now_s + for_s

    def reclutch(self) -> None:
        """Open the clutch and close it again, because the robot does not follow."""
        self.reclutches += 1
        self._open()

    def release_robot(self, view: OperatorView) -> HandInput:
        """Open the clutch for good; the robot holds."""
        self._open()
        self._hand = view.device_pose(self.device)
        self._goal = self._movement = None
        return self.make_input()

    def make_input(self) -> HandInput:
        return HandInput(self.device, self.robot, self._hand, self._engaged, self._trigger)

    def _advance_clock(self, now_ns: int) -> float:
        step_s = 0.0 if self._last_ns is None else (now_ns - self._last_ns) * 1e-9
        self._last_ns = now_ns
        return min(max(step_s, 0.0), LONGEST_STEP_S)

    def _open(self) -> None:
        self._engaged = False
        self._rearm_s = self.now_s + REARM_S

    def _engage(self, tip: PoseTuple) -> None:
        self._engaged = True
        self._hand_at_engage, self._tip_at_engage = self._hand, tip
        self._correction_p = self._correction_r = (0.0, 0.0, 0.0)
        self._trouble_since_s = [math.inf, math.inf]
        self._movement = (
            None if self._goal is None else HandMovement.plan(tip, self._goal, self.now_s, self._speed, self._turn)
        )

    def _compute_reference(self) -> PoseTuple:
        """Return the planned tip pose, before corrections."""
        return self._tip_at_engage if self._movement is None else self._movement.compute_pose(self.now_s)

    def _follow(self, tip: PoseTuple, step_s: float) -> None:
        reference = self._compute_reference()
        miss_p = (reference[0][0] - tip[0][0], reference[0][1] - tip[0][1], reference[0][2] - tip[0][2])
        miss_r = quat_to_rotvec(quat_mul(reference[1], quat_conj(tip[1])))
        self._missing_m, self._missing_rad = math.hypot(*miss_p), math.hypot(*miss_r)
        if self._correcting and self.has_moved():
            self._correction_p = _move_correction(self._correction_p, miss_p, step_s, CORRECTION_SPEED, CORRECTION_MOST)
            self._correction_r = _move_correction(
                self._correction_r, miss_r, step_s, CORRECTION_TURN, 10.0 * CORRECTION_MOST
            )
        self._note_trouble(0, self._missing_m > LOST_M or self._missing_rad > LOST_RAD)
        self._note_trouble(1, self.has_moved() and not self._still and self._missing_m > STUCK_M)
        if self.now_s - self._trouble_since_s[0] > LOST_S or self.now_s - self._trouble_since_s[1] > STUCK_S:
            self.reclutch()
            return
        self._hand = self._compute_hand(reference)

    def _note_trouble(self, trouble: int, present: bool) -> None:
        """Record since when a fault has lasted."""
        since = self._trouble_since_s
        since[trouble] = min(since[trouble], self.now_s) if present else math.inf

    def _compute_hand(self, reference: PoseTuple) -> PoseTuple:
        """Return the hand pose that brings the tip to `reference` plus corrections, by the motion since the
        engagement."""
        p0, h0, c = self._tip_at_engage[0], self._hand_at_engage[0], self._correction_p
        p = reference[0]
        q_tip = quat_mul(quat_from_rotvec(self._correction_r), reference[1])
        q = quat_mul(quat_mul(q_tip, quat_conj(self._tip_at_engage[1])), self._hand_at_engage[1])
        moved = (h0[0] + p[0] + c[0] - p0[0], h0[1] + p[1] + c[1] - p0[1], h0[2] + p[2] + c[2] - p0[2])
        return (moved, quat_normalize(q))


def _move_correction(correction: Vec3, miss: Vec3, step_s: float, speed: float, most: float) -> Vec3:
    """Return `correction` moved towards `miss`, at a limited speed and to a limited length."""
    rate = CORRECTION_RATE * math.hypot(*miss)
    scale = CORRECTION_RATE * step_s * (min(1.0, speed / rate) if rate > 0.0 else 0.0)
    moved = (correction[0] + scale * miss[0], correction[1] + scale * miss[1], correction[2] + scale * miss[2])
    length = math.hypot(*moved)
    if length <= most:
        return moved
    return (moved[0] * most / length, moved[1] * most / length, moved[2] * most / length)


#: Peak over mean speed of a minimum-jerk movement.
PEAK_TO_MEAN = 1.875
#: Shortest voluntary movement [s].
SHORTEST_S = 0.3


def compute_min_jerk(s: float) -> float:
    """Return the fraction of the way after the fraction `s` of the time; 0 to 1, with zero speed and acceleration at
    the ends."""
    s = min(max(s, 0.0), 1.0)
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))


@dataclass(frozen=True, slots=True)
class HandMovement:
    """One movement from `start` to `goal`, from time `start_s`, lasting `duration_s` seconds."""

    start: PoseTuple
    goal: PoseTuple
    start_s: float
    duration_s: float

    @classmethod
    def plan(cls, start: PoseTuple, goal: PoseTuple, start_s: float, speed: float, turn: float) -> HandMovement:
        """Plan a movement whose peak speeds are at most `speed` [m/s] and `turn` [rad/s]."""
        mean_s = max(distance(start[0], goal[0]) / speed, quat_angle(start[1], goal[1]) / turn)
        return cls(start, goal, start_s, max(SHORTEST_S, PEAK_TO_MEAN * mean_s))

    def compute_pose(self, now_s: float) -> PoseTuple:
        s = compute_min_jerk((now_s - self.start_s) / self.duration_s)
        (ax, ay, az), (bx, by, bz) = self.start[0], self.goal[0]
        r = quat_to_rotvec(quat_mul(self.goal[1], quat_conj(self.start[1])))
        q = quat_mul(quat_from_rotvec((s * r[0], s * r[1], s * r[2])), self.start[1])
        return ((ax + s * (bx - ax), ay + s * (by - ay), az + s * (bz - az)), q)

    def is_finished(self, now_s: float) -> bool:
        return now_s >= self.start_s + self.duration_s
