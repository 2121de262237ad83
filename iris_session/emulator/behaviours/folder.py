"""Folds a cloth with a partner: each pinches the corner on his side that is nearer to the people, and both carry
theirs over the corners behind at the same time."""

from __future__ import annotations

import math

from anchors.pose import PoseTuple, Vec3, distance, quat_angle, quat_from_yaw, quat_mul
from iris_session.emulator.behaviours.arms import ARM, ArmKind
from iris_session.emulator.behaviours.deformables import SoftEyes
from iris_session.emulator.behaviours.phases import Phases
from iris_session.emulator.behaviours.things import DOWN, above
from iris_session.protocol.names import Device

#: The cloth is pinched so far from its corner, along both edges [m].
INSET: float = 0.032
#: Height of the tip above the table at which the finger tips, 12 mm below it, press the cloth of 8 mm onto the table
#: [m]. The hand is only so steady, so it aims at the table itself; on every new attempt a little deeper.
PRESS: float = 0.0115
DEEPER: float = 0.0015
#: How far the trigger is pulled when the fingers come down, 60 mm apart then: both must land on the cloth.
TRIGGER_BEFORE: float = 0.25
#: Height of the tip above the table at which the corner is let go [m]: much lower, and cloth heaps up around the
#: fingers; higher, and it swings back as it falls.
RELEASE: float = 0.036
#: So far towards the partner a corner falls back when it is let go, because it was pinched into a wrinkle [m].
FALLS_BACK: float = 0.006
#: So far at most the fingers go beyond the other corner [m]: the one that is tucked under them may unfold when it is
#: let go.
BEYOND: float = 0.01
#: How far the trigger stays pulled when the corner is let go: the fingers slide off the wrinkle upwards. Fingers that
#: open wide sweep the cloth along.
TRIGGER_AFTER: float = 0.75
CLEAR_ABOVE: float = 0.10
CAREFUL_SPEED: float = 0.12
CARRY_SPEED: float = 0.22
#: Corners that lie nearer to each other than this are folded onto each other [m].
FOLDED: float = 0.05
#: Distance of the finger pads below which a gripper is shut on cloth [m].
SHUT: float = 0.02
#: A corner that stays so far above the table hangs on a finger [m]; so often it is laid down again.
HANGING: float = 0.03
SHAKES: int = 3
#: How long a partner is waited for [s].
PATIENCE_S: float = 60.0


class Folder(Phases):
    """Folds `cloth` with `robot`, together with the operator of `partner`."""

    def __init__(
        self, robot: str, cloth: str, partner: str, device: str = Device.CONTROLLER_RIGHT, arm: ArmKind = ARM
    ) -> None:
        self.eyes = SoftEyes(cloth, (robot, partner), arm=arm)
        super().__init__(robot, device, self.eyes, arm)
        self.cloth, self.partner = cloth, partner
        self._mine = self._onto = self._other = -1  # vertices: to take, to bring it to, and the one the partner takes
        self._pinch: Vec3 = (0.0, 0.0, 0.0)
        self._goal: Vec3 = (0.0, 0.0, 0.0)
        self._outward: Vec3 = (0.0, 0.0, 0.0)  # from the partner's corner to mine
        self._ahead: Vec3 = (0.0, 0.0, 0.0)  # from my corner to where it goes
        self._shakes = 0
        self._diagonal = 0.0  # yaw from my corner to the middle [rad]
        self._steps |= {
            "wait": self._wait,
            "look": self._look,
            "approach": self._approach,
            "descend": self._descend,
            "press": self._press,
            "pinch": self._pinching,
            "lift": self._lift,
            "together": self._together,
            "over": self._over,
            "across": self._across,
            "aim": self._aim,
            "lower": self._lower,
            "open": self._open,
            "leave": self._leave,
            "judge": self._judge,
            "shake": self._shake,
            "back_off": self._back_off,
        }

    def _wait(self) -> None:
        self._home = self.eyes.tip(self.robot)
        self._enter("look")

    def _look(self) -> None:
        """Waits until the cloth lies still; chooses the corners on the own side."""
        if self.eyes.corners_still_s < 0.3:
            return
        corners = self.eyes.corners
        base = self.eyes.base(self.robot)[0]
        near = sorted(corners, key=lambda index: distance(corners[index], base))[:2]
        self._mine, self._onto = sorted(near, key=lambda index: corners[index][1])
        self._other, beyond = sorted(set(corners) - set(near), key=lambda index: corners[index][1])
        mine, onto, other = corners[self._mine], corners[self._onto], corners[self._other]
        self._pinch = _inset(mine, onto, other)
        self._goal = _inset(onto, mine, corners[beyond])
        self._outward, self._ahead = _toward(other, mine), _toward(mine, onto)
        self._diagonal = math.atan2(self._pinch[1] - mine[1], self._pinch[0] - mine[0])
        self._enter("approach")

    def _approach(self) -> None:
        if self._entering_now:
            self.hand.trigger_goal = TRIGGER_BEFORE
            self.hand.move_to(self._tip_at(self._pinch, CLEAR_ABOVE))
        if self.hand.arrived(0.006, 0.06) and self.hand.trigger_done():
            self._enter("descend")
        elif self._waited(8.0):
            self._retry(f"{self.robot} cannot reach the corner of the {self.cloth}")

    def _descend(self) -> None:
        """To a finger's breadth above the cloth."""
        if self._entering_now:
            self.hand.move_to(self._tip_at(self._pinch, PRESS + 0.014), CAREFUL_SPEED)
        if self.hand.arrived(0.0025, 0.03) or (self._waited(4.0) and self.hand.arrived(0.005, 0.06)):
            self._enter("press")
        elif self._waited(6.0):
            self._retry(f"{self.robot} cannot reach down to the {self.cloth}")

    def _press(self) -> None:
        """Down onto the cloth by what is still missing in height; the table stops the fingers."""
        if self._entering_now:
            (x, y, z), q = self.eyes.tip(self.robot)
            self.hand.move_to(
                ((x, y, min(z, self._table() + PRESS - DEEPER * (self.attempts - 1))), q), 0.04, correct=False
            )
        if self.hand.moved() and self._waited(0.6):
            self._enter("pinch")

    def _pinching(self) -> None:
        """The closing fingers push a wrinkle up between them."""
        if self._entering_now:
            self.hand.hold_still()
            self.hand.trigger_goal = 1.0
        both = self.eyes.gap(self.partner) < SHUT and self.hand.trigger_done() and self._waited(0.9)
        if both:
            self._enter("lift")
        elif self._waited(PATIENCE_S):
            self._give_up(f"{self.partner} did not take the other corner within {PATIENCE_S:.0f} s")

    def _lift(self) -> None:
        """Both at once: a corner that goes up alone drags the other from under the fingers that press on it."""
        if self._entering_now:
            self.hand.move_to(above(self.eyes.tip(self.robot), 0.08), CAREFUL_SPEED, correct=False)
        if not self.hand.moved() or not self._waited(1.0):
            return
        if self._holding():
            self._enter("together")
        else:
            self._retry(f"the {self.cloth} slipped out of the gripper of {self.robot}")

    def _together(self) -> None:
        """Waits until the partner has lifted his corner too."""
        if self._entering_now:
            self.hand.hold_still()
        if not self._holding():
            self._retry(f"the {self.cloth} slipped out of the gripper of {self.robot}")
        elif self.eyes.corner(self._other)[2] > self._table() + 0.05 and self.eyes.gap(self.partner) < SHUT:
            self._enter("over")
        elif self._waited(PATIENCE_S):
            self._give_up(f"{self.partner} did not lift the other corner within {PATIENCE_S:.0f} s")

    def _over(self) -> None:
        """Up to above the fold."""
        if self._entering_now:
            self.hand.move_to(self._tip_at(_between(self._pinch, self._goal), 0.17), CARRY_SPEED)
        self._carried("across", 0.02)

    def _across(self) -> None:
        if self._entering_now:
            self.hand.move_to(self._tip_at(self._goal, 0.08), CARRY_SPEED)
        self._carried("aim", 0.02)

    def _aim(self) -> None:
        """By sight: the corner itself over the other, which may have moved meanwhile."""
        if self._entering_now:
            tip = self.eyes.tip(self.robot)[0]
            mine, onto = self.eyes.corner(self._mine), self.eyes.corner(self._onto)
            ox, oy, _ = self._outward
            x, y = tip[0] + onto[0] - mine[0] + FALLS_BACK * ox, tip[1] + onto[1] - mine[1] + FALLS_BACK * oy
            fx, fy, _ = self._ahead
            back = min(0.0, BEYOND - (x - onto[0]) * fx - (y - onto[1]) * fy)
            self._goal = (x + back * fx, y + back * fy, 0.0)
            self.hand.move_to(self._tip_at(self._goal, RELEASE + 0.015), CAREFUL_SPEED)
        self._carried("lower", 0.006)

    def _carried(self, then: str, within_m: float) -> None:
        if not self._holding():
            self._give_up(f"{self.robot} dropped the {self.cloth} on the way")
        elif self.hand.arrived(within_m, 0.06) or self._waited(6.0):
            self._enter(then)

    def _lower(self) -> None:
        if self._entering_now:
            self.hand.move_to(self._tip_at(self._goal, RELEASE), CAREFUL_SPEED)
        self._carried("open", 0.005)

    def _open(self) -> None:
        if self._entering_now:
            self.hand.hold_still()
            self.hand.trigger_goal = TRIGGER_AFTER
        if self.hand.trigger_done() and self._waited(0.8):
            self._enter("leave")

    def _leave(self) -> None:
        if self._entering_now:
            self.hand.move_to(above(self.eyes.tip(self.robot), CLEAR_ABOVE), 0.12, correct=False)
        if self.hand.moved():
            self._enter("judge")

    def _judge(self) -> None:
        """Whether the corner stayed where it was laid."""
        if self.eyes.corners_still_s < 0.3 and not self._waited(5.0):
            return
        if self.eyes.corner(self._mine)[2] > self._table() + HANGING and self._shakes < SHAKES:
            self._shakes += 1
            self._enter("shake")
            return
        missing = distance(self.eyes.corner(self._mine), self.eyes.corner(self._onto))
        if missing > FOLDED:
            self._give_up(f"the corners of the {self.cloth} lie {missing * 100:.0f} cm apart")
        else:
            self._enter("return")

    def _shake(self) -> None:
        """Down to where it belongs, and the fingers moved, so that it slips off."""
        if self._entering_now:
            self.hand.trigger_goal = 0.0 if self._shakes % 2 else TRIGGER_AFTER
            self.hand.move_to(self._tip_at(self._goal, RELEASE), CAREFUL_SPEED)
        if self.hand.moved() and self.hand.trigger_done() and self._waited(1.2):
            self._enter("leave")

    def _back_off(self) -> None:
        if self._entering_now:
            self.hand.trigger_goal = 0.0
            self.hand.move_to(above(self.eyes.tip(self.robot), CLEAR_ABOVE), correct=False)
        if self.hand.moved() and self.hand.trigger_done() and self._waited(1.5):
            self._enter("look")

    # --- geometry as seen ---------------------------------------------------------------------------------------------

    def _table(self) -> float:
        """Height of the table [m], world frame."""
        return self.eyes.base(self.robot)[0][2] - self.arm.above_table

    def _holding(self) -> bool:
        """Whether the corner goes with the fingers."""
        tip = self.eyes.tip(self.robot)[0]
        return distance(self.eyes.corner(self._mine), tip) < 0.06 and self.eyes.gap(self.robot) < SHUT

    def _tip_at(self, place: Vec3, height: float) -> PoseTuple:
        """Fingers down, closing across the diagonal of the corner; `height` above the table. Turns the wrist least."""
        home = (self._home or self.eyes.tip(self.robot))[1]
        turns = [quat_mul(quat_from_yaw(self._diagonal + half), DOWN) for half in (0.0, math.pi)]
        q = min(turns, key=lambda turn: quat_angle(turn, home))
        return ((place[0], place[1], self._table() + height), q)


def _toward(a: Vec3, b: Vec3) -> Vec3:
    """Horizontal unit vector from `a` to `b`."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    apart = max(math.hypot(dx, dy), 1e-6)
    return (dx / apart, dy / apart, 0.0)


def _inset(corner: Vec3, one: Vec3, other: Vec3) -> Vec3:
    """The point to pinch near a corner between two others: `INSET` along both edges."""
    (ax, ay, _), (bx, by, _) = _toward(corner, one), _toward(corner, other)
    return (corner[0] + INSET * (ax + bx), corner[1] + INSET * (ay + by), corner[2])


def _between(a: Vec3, b: Vec3) -> Vec3:
    return ((a[0] + b[0]) / 2.0, (a[1] + b[1]) / 2.0, (a[2] + b[2]) / 2.0)
