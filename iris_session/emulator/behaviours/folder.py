"""Fold a cloth with a partner: each operator pinches the closer corner on their side, and both carry these over the
corners behind at the same time.
"""

from __future__ import annotations

import math

from anchors.pose import PoseTuple, Vec3, distance
from iris_session.emulator.behaviours.deformables import DeformablePerception, DeformableTask
from iris_session.emulator.behaviours.objects import ARM, ArmKind
from iris_session.protocol.names import Device

#: Distance of the pinch from the corner of the cloth, along both edges, in cells of 22.5 mm.
INSET_CELLS: float = 1.42
#: Height of the tip above the table at which the finger tips, 12 mm below it, press the cloth of 8 mm onto the table
#: [m]. The hand is not steady enough for that, so it aims at the table itself; on every new attempt a little deeper.
PRESS: float = 0.0115
DEEPER: float = 0.0015
#: Trigger while the fingers come down, which are 60 mm apart then: both must land on the cloth.
TRIGGER_BEFORE: float = 0.25
#: Height of the tip above the table at which the corner is released [m]: much lower, the cloth would heap up around the
#: fingers; higher, it would swing back as it falls.
RELEASE: float = 0.036
#: Distance by which a released corner falls back towards the partner, because it was pinched into a wrinkle [m].
FALLS_BACK: float = 0.006
#: Maximum distance by which the fingers are carried outwards [m]: a taut cloth flies inwards when its first corner is
#: released.
APART: float = 0.01
#: Maximum distance of the fingers beyond the other corner [m]: a corner tucked under them may unfold when it is
#: released.
BEYOND: float = 0.01
#: Trigger after the release of the corner: the fingers slide off the wrinkle upwards. Wide open fingers would sweep the
#: cloth along.
TRIGGER_AFTER: float = 0.75
CLEAR_ABOVE: float = 0.10
CAREFUL_SPEED: float = 0.12
CARRY_SPEED: float = 0.22
#: Corners closer to each other than this are folded [m]; when laid down they must be closer, because a cloth settles
#: for a while.
FOLDED: float = 0.047
LAID: float = 0.044
#: Distance of the finger pads below which a gripper is closed on cloth [m].
SHUT: float = 0.02
#: Height above the table at which a corner hangs on a finger [m], and number of times that it is laid down again.
HANGING: float = 0.03
SHAKES: int = 3
#: Height above the table at which a hand is back at its start [m], and time after which the cloth is checked again [s].
HOME_ABOVE: float = 0.22
SETTLED_S: float = 1.5
#: Height above the table at which the partner's corner is lifted [m]: it hangs up to 45 mm below the fingers, which are
#: 90 mm above the table then.
LIFTED: float = 0.03
#: Time to wait for a partner [s], and time to wait before the release, which also succeeds alone [s].
PATIENCE_S: float = 45.0
TOGETHER_S: float = 6.0


class Folder(DeformableTask):
    """Folds `cloth` with `robot`, together with the operator of `partner`."""

    max_attempts = 5  # a cloth that is crumpled after these is folded sooner after a reset

    def __init__(
        self, robot: str, cloth: str, partner: str, device: str = Device.CONTROLLER_RIGHT, arm: ArmKind = ARM
    ) -> None:
        super().__init__(robot, device, DeformablePerception(cloth, (robot, partner), arm=arm), arm)
        self.cloth, self.partner = cloth, partner
        self._slipped = f"the {cloth} slipped out of the gripper of {robot}"
        self._mine = self._onto = self._other = -1  # vertices: own corner, its target, and the partner's corner
        self._pinch: Vec3 = (0.0, 0.0, 0.0)
        self._goal: Vec3 = (0.0, 0.0, 0.0)
        self._outward: Vec3 = (0.0, 0.0, 0.0)  # from the partner's corner to mine
        self._ahead: Vec3 = (0.0, 0.0, 0.0)  # from my corner to its target
        self._shakes = 0
        self._since_s = 0.0  # session time since which both hands are back
        self._mending = False  # the corners were laid down apart and are brought together
        self._alone = False  # the partner does not take part any more
        self._diagonal = 0.0  # yaw from my corner to the middle [rad]
        self._steps |= {
            "look": self._choose_pinch,
            "approach": self._approach,
            "descend": self._descend,
            "press": self._press,
            "pinch": self._pinching,
            "lift": self._lift,
            "together": self._wait_for_partner,
            "over": self._carry_over,
            "across": self._carry_across,
            "sight": self._sight,
            "aim": self._aim,
            "lower": self._lower,
            "ready": self._wait_for_release,
            "open": lambda: self._open(TRIGGER_AFTER),
            "leave": lambda: self._rise(CLEAR_ABOVE, "judge", 0.12),
            "judge": self._judge,
            "watch": self._watch,
            "shake": self._shake,
        }

    def _choose_pinch(self) -> None:
        """Wait until the cloth lies still, and choose the corners on the own side."""
        if self.perception.corners_still_s < 0.3:
            return
        if self._mine < 0:
            self._choose_corners()
        mine = self.perception.get_corner(self._mine)
        self._pinch = self.perception.compute_inner_point(
            self._mine, INSET_CELLS
        )  # wherever and however the corner lies
        self._goal = self.perception.compute_inner_point(self._onto, INSET_CELLS)
        self._diagonal = math.atan2(self._pinch[1] - mine[1], self._pinch[0] - mine[0])
        self._enter("approach")

    def _choose_corners(self) -> None:
        """Choose the corners on the own side, and the directions of the fold, while the cloth lies flat."""
        corners, base = self.perception.corners, self.perception.get_base(self.robot)[0]
        near = sorted(corners, key=lambda index: distance(corners[index], base))[:2]
        self._mine, self._onto = sorted(near, key=lambda index: corners[index][1])
        self._other = min(set(corners) - set(near), key=lambda index: corners[index][1])
        mine, onto, other = corners[self._mine], corners[self._onto], corners[self._other]
        self._outward, self._ahead = _compute_direction(other, mine), _compute_direction(mine, onto)

    def _approach(self) -> None:
        fault = f"{self.robot} cannot reach the corner of the {self.cloth}"
        self._reach(
            lambda: self._compute_tip(self._pinch, CLEAR_ABOVE),
            "descend",
            (0.006, 0.06),
            8.0,
            fault,
            trigger=TRIGGER_BEFORE,
        )

    def _descend(self) -> None:
        """Move down to a finger's breadth above the cloth."""
        if self._entering_now:
            self.hand.move_to(self._compute_tip(self._pinch, PRESS + 0.014), CAREFUL_SPEED)
        if self.hand.has_arrived(0.0025, 0.03) or (self._has_lasted(4.0) and self.hand.has_arrived(0.005, 0.06)):
            self._enter("press")
        elif self._has_lasted(6.0):
            self._retry(f"{self.robot} cannot reach down to the {self.cloth}")

    def _press(self) -> None:
        """Move down onto the cloth by the remaining height; the table stops the fingers."""
        if self._entering_now:
            (x, y, z), q = self.perception.get_tip(self.robot)
            self.hand.move_to(
                ((x, y, min(z, self._compute_table_height() + PRESS - DEEPER * (self.attempts - 1))), q),
                0.04,
                correct=False,
            )
        if self.hand.has_moved() and self._has_lasted(0.6):
            self._enter("pinch")

    def _pinching(self) -> None:
        """Close the fingers, which push a wrinkle up between them."""
        if self._entering_now:
            self.hand.hold_still()
            self.hand.trigger_goal = 1.0
        both = (
            (self._alone or self.perception.compute_gap(self.partner) < SHUT)
            and self.hand.is_trigger_done()
            and self._has_lasted(0.9)
        )
        if both:
            self._enter("lift")
        elif self._has_lasted(PATIENCE_S):
            self._fail(f"{self.partner} did not take the other corner within {PATIENCE_S:.0f} s")

    def _lift(self) -> None:
        """Lift both corners at once: one alone would drag the other from under the fingers that press on it."""
        if self._entering_now:
            (x, y, _), q = self.perception.get_tip(self.robot)
            self.hand.move_to(((x, y, self._compute_table_height() + PRESS + 0.08), q), CAREFUL_SPEED, correct=False)
        if self.hand.has_moved() and self._has_lasted(1.0) and not self._check_slip(self._slipped):
            self._enter("together")

    def _wait_for_partner(self) -> None:
        """Wait until the partner has lifted the other corner."""
        if self._entering_now:
            self.hand.hold_still()
        if self._check_slip(self._slipped):
            return
        lifted = (
            self.perception.get_corner(self._other)[2] > self._compute_table_height() + LIFTED
            and self.perception.compute_gap(self.partner) < SHUT
        )
        if lifted or self._alone:
            self._alone = True  # the partner may have laid the other corner down before a new attempt
            self._enter("sight" if self._mending else "over")
        elif self._has_lasted(PATIENCE_S):
            self._fail(f"{self.partner} did not lift the other corner within {PATIENCE_S:.0f} s")

    def _carry_over(self) -> None:
        """Move up to above the fold."""
        if self._entering_now:
            self.hand.move_to(self._compute_tip(_compute_middle(self._pinch, self._goal), 0.17), CARRY_SPEED)
        self._finish_carry("across", 0.02)

    def _carry_across(self) -> None:
        if self._entering_now:
            self.hand.move_to(self._compute_tip(self._goal, 0.08), CARRY_SPEED)
        self._finish_carry("sight", 0.02)

    def _sight(self) -> None:
        """Wait for vertices of the cloth that are newer than the movement."""
        if self._is_shown_for(0.2):
            self._finish_carry("aim", math.inf)

    def _aim(self) -> None:
        """Move by sight the corner itself over the other one, which may have moved meanwhile."""
        if self._entering_now:
            tip = self.perception.get_tip(self.robot)[0]
            mine, onto = self.perception.get_corner(self._mine), self.perception.get_corner(self._onto)
            self._goal = (tip[0] + onto[0] - mine[0], tip[1] + onto[1] - mine[1], 0.0)
            if not self._mending:
                self._goal = self._limit_goal(onto)
            self.hand.move_to(self._compute_tip(self._goal, RELEASE + 0.015), CAREFUL_SPEED)
        self._finish_carry("lower", 0.006)

    def _limit_goal(self, onto: Vec3) -> Vec3:
        """Return the goal, a little outwards because the corner falls back, but not so far that the cloth becomes
        taut.
        """
        (x, y, _), (ox, oy, _), (fx, fy, _) = self._goal, self._outward, self._ahead
        x, y = x + FALLS_BACK * ox, y + FALLS_BACK * oy
        apart = min(0.0, APART - (x - self._pinch[0]) * ox - (y - self._pinch[1]) * oy)
        back = min(0.0, BEYOND - (x - onto[0]) * fx - (y - onto[1]) * fy)
        return (x + apart * ox + back * fx, y + apart * oy + back * fy, 0.0)

    def _finish_carry(self, then: str, within_m: float) -> None:
        if self._check_slip(f"{self.robot} dropped the {self.cloth} on the way"):
            return
        if self.hand.has_arrived(within_m, 0.06) or self._has_lasted(6.0):
            self._enter(then)

    def _lower(self) -> None:
        if self._entering_now:
            self.hand.move_to(self._compute_tip(self._goal, RELEASE), CAREFUL_SPEED)
        self._finish_carry("ready", 0.005)

    def _wait_for_release(self) -> None:
        """Release both corners at once: the cloth between them pulls on the one that is released first."""
        if self._entering_now:
            self.hand.hold_still()
        low = self.perception.get_tip(self.partner)[0][2] < self._compute_table_height() + RELEASE + 0.008
        if low or self.perception.compute_gap(self.partner) > SHUT or self._has_lasted(TOGETHER_S):
            self._enter("open")

    def _judge(self) -> None:
        """Check that the corner stayed where it was laid."""
        if self.perception.corners_still_s < 0.3 and not self._is_shown_for(5.0):
            return
        if self.perception.get_corner(self._mine)[2] > self._compute_table_height() + HANGING and self._shakes < SHAKES:
            self._shakes += 1
            self._enter("shake")
        elif self._is_folded(LAID):
            self._enter("return")

    def _is_folded(self, within_m: float) -> bool:
        """Return True if the corners lie together. If not, start to bring them together: the outer one is grasped,
        which lies by
        itself and not on the other layer."""
        mine, onto = self.perception.get_corner(self._mine), self.perception.get_corner(self._onto)
        missing = distance(mine, onto)
        if missing <= within_m:
            return True
        ox, oy, _ = self._outward
        if (mine[0] - onto[0]) * ox + (mine[1] - onto[1]) * oy < 0.0:
            self._mine, self._onto = self._onto, self._mine
        self._mending = True
        self._retry(f"the corners of the {self.cloth} lie {missing * 100:.1f} cm apart")
        return False

    def _on_returned(self) -> None:
        self._enter("watch")

    def _watch(self) -> None:
        """Wait until the partner is back too: the partner may still move the own corner."""
        busy = self.perception.get_tip(self.partner)[0][2] < self._compute_table_height() + HOME_ABOVE
        if self._entering_now or busy:
            self._since_s = self.perception.now_s
        settled = self.perception.captured_s > self._since_s + SETTLED_S
        if (settled or self._has_lasted(PATIENCE_S)) and self._is_folded(FOLDED):
            self._finish()

    def _shake(self) -> None:
        """Move down to the target and move the fingers, so that the corner slips off."""
        if self._entering_now:
            self.hand.trigger_goal = 0.0 if self._shakes % 2 else TRIGGER_AFTER
            self.hand.move_to(self._compute_tip(self._goal, RELEASE), CAREFUL_SPEED)
        if self.hand.has_moved() and self.hand.is_trigger_done() and self._has_lasted(1.2):
            self._enter("leave")

    # --- geometry as seen ---------------------------------------------------------------------------------------------

    def _is_holding(self) -> bool:
        """Return True if the corner moves with the fingers."""
        tip = self.perception.get_tip(self.robot)[0]
        return (
            distance(self.perception.get_corner(self._mine), tip) < 0.06
            and self.perception.compute_gap(self.robot) < SHUT
        )

    def _compute_tip(self, place: Vec3, height: float) -> PoseTuple:
        """Return a tip pose `height` above the table, fingers down, closing across the diagonal, with the least
        wrist turn.
        """
        q = self._turn_down(self._diagonal)
        return ((place[0], place[1], self._compute_table_height() + height), q)


def _compute_direction(a: Vec3, b: Vec3) -> Vec3:
    """Return the horizontal unit vector from `a` to `b`."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    apart = max(math.hypot(dx, dy), 1e-6)
    return (dx / apart, dy / apart, 0.0)


def _compute_middle(a: Vec3, b: Vec3) -> Vec3:
    return ((a[0] + b[0]) / 2.0, (a[1] + b[1]) / 2.0, (a[2] + b[2]) / 2.0)
