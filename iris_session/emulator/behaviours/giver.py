"""The giver: takes a thing from the table, offers it in mid-air, and lets go when it sees that the other has it."""

from __future__ import annotations

import math

from anchors.pose import apply, distance
from iris_session.emulator.behaviours.operator import CLEAR_ABOVE, Operator
from iris_session.emulator.behaviours.things import above, face_up, level, tilt
from iris_session.protocol.names import Device

#: The other must be seen to hold the thing for so long [s] before the giver opens.
SURE_S = 0.35
#: A thing that lies more askew than this is left alone [rad].
MOST_TILT = 0.3


class Giver(Operator):
    """Grasps `object` near its heavy end with `robot` and hands it to the operator of `partner`.

    `patience_s`: how long the thing is offered before the giver gives up.
    """

    def __init__(
        self,
        robot: str,
        object: str,
        partner: str,
        device: str = Device.CONTROLLER_RIGHT,
        patience_s: float = 60.0,
    ) -> None:
        super().__init__(robot, object, partner, device)
        self._after_close = "lift"
        self._patience_s = patience_s
        self._taken_since_s = math.inf
        self._steps |= {
            "look": self._look,
            "lift": self._lift,
            "present": self._present,
            "offer": self._offer,
            "release": self._release,
            "retreat": self._retreat,
        }

    def _first_phase(self) -> str:
        return "look"

    def _look(self) -> None:
        """Waits until the thing lies still, and chooses the end to take: the free end must point at the partner."""
        if self.eyes.still_s(self.object) < 0.3:
            return
        if tilt(self.eyes.body(self.object)) > MOST_TILT:
            if self._waited(3.0):
                self._give_up(f"the {self.object} does not lie flat, it cannot be taken from above")
            return
        self._take_x = self.thing.giver_x
        if self.thing.symmetric:
            _, direction = self._exchange()
            (ox, oy, _), (tx, ty, _) = (apply(self.eyes.body(self.object), (x, 0.0, 0.0)) for x in (0.0, self._take_x))
            if (tx - ox) * direction[0] + (ty - oy) * direction[1] > 0.0:
                self._take_x = -self._take_x
        self._enter("approach")

    def _lift(self) -> None:
        if self._entering_now:
            self.hand.move_to(above(self.eyes.tip(self.robot), CLEAR_ABOVE))
        if self._lost():
            self._retry(f"the {self.object} slipped out of the gripper of {self.robot}")
        elif self.hand.arrived(0.015, 0.06) or self._waited(4.0):
            self._enter("present")

    def _present(self) -> None:
        if self._entering_now:
            place, (dx, dy, _) = self._exchange()
            towards = math.atan2(dy, dx) if self._take_x < 0.0 else math.atan2(-dy, -dx)
            self.hand.move_to(self._tip_for(level(place, towards, face_up(self.eyes.body(self.object)))))
        if self._lost():
            self._retry(f"the {self.object} slipped out of the gripper of {self.robot}")
        elif self.hand.arrived(0.008, 0.05) or self._waited(8.0):
            self._enter("offer")

    def _offer(self) -> None:
        thing = self.eyes.body(self.object)
        near = apply(thing, (self.thing.receiver_x if self._take_x < 0.0 else -self.thing.receiver_x, 0.0, 0.0))
        if distance(self.eyes.tip(self.partner)[0], near) < 0.07:
            self.hand.hold_still()
        if self._lost():
            self._retry(f"the {self.object} slipped out of the gripper of {self.robot}")
        elif not self.eyes.holds(self.partner, self.object, self.thing.half_width):
            self._taken_since_s = math.inf
            if self._waited(self._patience_s):
                self._give_up(f"nobody took the {self.object} within {self._patience_s:.0f} s")
        else:
            self._taken_since_s = min(self._taken_since_s, self.hand.now_s)
            if self.hand.now_s - self._taken_since_s >= SURE_S:
                self._enter("release")

    def _release(self) -> None:
        self._open_gripper("retreat")

    def _retreat(self) -> None:
        if self._entering_now:
            self.hand.move_to(above(self.eyes.tip(self.robot), CLEAR_ABOVE + 0.02), 0.3, correct=False)
        if self.hand.moved():
            self._enter("return")
