"""The giver: takes a thing from the table, offers it in mid-air, and lets go when it sees that the other has it."""

from __future__ import annotations

import math

from anchors.pose import PoseTuple, apply, compose, distance, inverse, quat_angle
from iris_session.emulator.behaviours.arms import ARM, ArmKind
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
        arm: ArmKind = ARM,
        patience_s: float = 60.0,
    ) -> None:
        super().__init__(robot, object, partner, device, arm)
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
        """Waits until the thing lies still, and chooses the end to take: the one that turns the wrist least."""
        if self.eyes.still_s(self.object) < 0.3:
            return
        if tilt(self.eyes.body(self.object)) > MOST_TILT:
            if self._waited(3.0):
                self._give_up(f"the {self.object} does not lie flat, it cannot be taken from above")
            return
        ends = (self.thing.giver_x, -self.thing.giver_x) if self.thing.symmetric else (self.thing.giver_x,)
        self._take_x = min(ends, key=self._effort)
        self._enter("approach")

    def _effort(self, take_x: float) -> float:
        """How far [rad] the wrist must turn to take the thing at this end, and then to offer the other."""
        self._take_x = take_x
        return self._turn(self._grasp_pose(), self.eyes.body(self.object))

    def _lift(self) -> None:
        if self._entering_now:
            self.hand.move_to(above(self.eyes.tip(self.robot), CLEAR_ABOVE))
        if self._lost():
            self._retry(f"the {self.object} slipped out of the gripper of {self.robot}")
        elif self.hand.arrived(0.015, 0.06) or self._waited(4.0):
            self._enter("present")

    def _present(self) -> None:
        if self._entering_now:
            self.hand.move_to(self._tip_for(self._offered()))
        if self._lost():
            self._retry(f"the {self.object} slipped out of the gripper of {self.robot}")
        elif self.hand.arrived(0.008, 0.05) or self._waited(8.0):
            self._enter("offer")

    def _offered(self) -> PoseTuple:
        """Pose of the thing when it is offered: its free end towards the partner."""
        place, (dx, dy, _) = self._exchange()
        towards = math.atan2(dy, dx) if self._take_x < 0.0 else math.atan2(-dy, -dx)
        return level(place, towards, face_up(self.eyes.body(self.object)))

    def _turn(self, T_world_tip: PoseTuple, T_world_thing: PoseTuple) -> float:
        """The same way has to do for offering it, and the turn between the two is work as well."""
        offered = self._offered()
        offering = compose(offered, compose(inverse(T_world_thing), T_world_tip))
        farthest = max(super()._turn(T_world_tip, T_world_thing), super()._turn(offering, T_world_thing))
        return farthest + 0.5 * quat_angle(offered[1], T_world_thing[1])

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
