"""The receiver: waits until a thing is offered, takes its free end, waits until the giver has left, puts it down."""

from __future__ import annotations

import math

from anchors.pose import PoseTuple, Vec3, apply, distance, quat_rotate
from iris_session.emulator.behaviours.arms import ARM, ArmKind
from iris_session.emulator.behaviours.operator import CAREFUL_SPEED, CLEAR_ABOVE, Operator
from iris_session.emulator.behaviours.things import above, face_up, level
from iris_session.protocol.names import Device

#: A thing nearer to the place of exchange than this is offered [m].
OFFERED_M = 0.10
#: A giver whose tip is farther than this from where it held the thing has left [m].
LEFT_M = 0.08


class Receiver(Operator):
    """Takes `object` with `robot` from the operator of `partner` and lays it on the table.

    `place`: where (x, y [m] in the world); default: in front of the robot, on its freer side. `patience_s`: how long it
    waits for an offer before it gives up.
    """

    def __init__(
        self,
        robot: str,
        object: str,
        partner: str,
        device: str = Device.CONTROLLER_RIGHT,
        arm: ArmKind = ARM,
        place: tuple[float, float] | None = None,
        patience_s: float = 120.0,
    ) -> None:
        super().__init__(robot, object, partner, device, arm)
        self._after_close = "secure"
        self._place = place
        self._patience_s = patience_s
        self._laid: PoseTuple | None = None
        self._steps |= {
            "watch": self._watch,
            "raise": self._raise,
            "secure": self._secure,
            "carry": self._carry,
            "lower": self._lower,
            "put": self._put,
            "open": self._open,
            "leave": self._leave,
        }

    def _first_phase(self) -> str:
        return "watch"

    def _watch(self) -> None:
        if self._entering_now and self._home is not None:
            self.hand.move_to(self._home)
        middle, _ = self._exchange()
        offered = (
            distance(self.eyes.body(self.object)[0], middle) < OFFERED_M
            and self.eyes.still_s(self.object) > 0.4
            and self.eyes.holds(self.partner, self.object, self.thing.half_width)
        )
        if offered:
            self._take_x = self._free_end()
            self._enter("raise")
        elif self._waited(self._patience_s):
            self._give_up(f"nobody offered the {self.object} within {self._patience_s:.0f} s")

    def _raise(self) -> None:
        """Straight up to where the thing will be approached from: on a slant, the fingers could push it away."""
        if self._entering_now:
            (x, y, z), q = self.eyes.tip(self.robot)
            height = self._grasp_pose()[0][2] + CLEAR_ABOVE
            self.hand.move_to(((x, y, max(z, height)), q))
        if self.hand.arrived(0.03, 0.1) or self._waited(4.0):
            self._enter("approach")

    def _free_end(self) -> float:
        """Where to take the thing [m along its x]: for a symmetric thing the end away from the giver's fingers."""
        x = self.thing.receiver_x
        if not self.thing.symmetric:
            return x
        thing, giver = self.eyes.body(self.object), self.eyes.tip(self.partner)[0]
        return max((x, -x), key=lambda end: distance(apply(thing, (end, 0.0, 0.0)), giver))

    def _secure(self) -> None:
        """Keeps hold until the giver has opened and left. Both robots hold the thing: no corrections."""
        if self._entering_now:
            self.hand.hold_still()
        given_at = apply(self.eyes.body(self.object), (-self._take_x, 0.0, 0.0))
        opened = self.eyes.gap(self.partner) > 2.0 * self.thing.half_width + 0.010
        if opened and distance(self.eyes.tip(self.partner)[0], given_at) > LEFT_M:
            self._enter("carry")
        elif self._waited(1.0) and not self._holding():
            self._retry(f"the {self.object} slipped out of the gripper of {self.robot}")
        elif self._waited(15.0):
            self._retry(f"{self.partner} did not let go of the {self.object}")

    def _carry(self) -> None:
        if self._entering_now:
            x, y = self._place if self._place is not None else self._free_place()
            bx, by, _ = self.eyes.base(self.robot)[0]
            yaw = math.atan2(by - y, bx - x) if self._take_x > 0.0 else math.atan2(y - by, x - bx)
            up = face_up(self.eyes.body(self.object))
            self._laid = level((x, y, self._table() + self.thing.half_thickness), yaw, up)
            self.hand.move_to(self._tip_for(above(self._laid, CLEAR_ABOVE)))
        if self._lost():
            self._give_up(f"{self.robot} dropped the {self.object} on the way")
        elif self.hand.arrived(0.01, 0.06) or self._waited(8.0):
            self._enter("lower")

    def _lower(self) -> None:
        """Down to a finger's breadth above the table, level again as the thing now hangs in the gripper."""
        if self._entering_now and self._laid is not None:
            self.hand.move_to(self._tip_for(above(self._laid, 0.015)), CAREFUL_SPEED)
        if self._lost():
            self._give_up(f"{self.robot} dropped the {self.object} on the way")
        elif self.hand.arrived(0.004, 0.03) or self._waited(5.0):
            self._enter("put")

    def _put(self) -> None:
        """The last centimetre, by the height that is seen below the lowest point."""
        if self._entering_now:
            below = self.thing.lowest(self.eyes.body(self.object)) - self._table()
            self.hand.move_to(above(self.eyes.tip(self.robot), -max(below - 0.0005, 0.0)), 0.05, correct=False)
        if self.hand.moved() and self._waited(0.9):
            self._enter("open")

    def _open(self) -> None:
        self._open_gripper("leave")

    def _leave(self) -> None:
        if self._entering_now:
            self.hand.move_to(above(self.eyes.tip(self.robot), CLEAR_ABOVE), 0.3, correct=False)
        if not self.hand.moved():
            return
        p_world = self.eyes.body(self.object)[0]
        if self._laid is None or distance(p_world, self._laid[0]) > 0.06:
            self._give_up(f"the {self.object} did not stay where {self.robot} put it")
        else:
            self._enter("return")

    def _free_place(self) -> tuple[float, float]:
        """A place in front of the robot, on the side of the shared table that is farther from other things."""
        base, q = self.eyes.base(self.robot)
        dx, dy, _ = quat_rotate(q, (self.arm.reach, 0.0, 0.0))
        aside = 0.2 / self.arm.reach
        sides = [(base[0] + dx - s * aside * dy, base[1] + dy + s * aside * dx, base[2]) for s in (1.0, -1.0)]
        others = self.eyes.others()

        def room(place: Vec3) -> float:
            return min((distance(place, other) for other in others), default=1.0)

        best = max(sides, key=room)
        return best[0], best[1]
