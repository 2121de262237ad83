"""What giver and receiver have in common: phases, patience, and taking a thing with the gripper from above."""

from __future__ import annotations

from abc import abstractmethod

from anchors.pose import PoseTuple, Vec3, apply, compose, distance, inverse, quat_angle, quat_rotate
from iris_session.emulator.behaviours.arms import ARM, ArmKind
from iris_session.emulator.behaviours.eyes import Eyes
from iris_session.emulator.behaviours.phases import Phases
from iris_session.emulator.behaviours.things import COMMON_THINGS, Thing, above, grasps, thing_named

#: How far above a grasp the hand first goes, and how far it backs off afterwards [m].
CLEAR_ABOVE = 0.11
#: Speed of the last centimetres before a grasp [m/s].
CAREFUL_SPEED = 0.16


class Operator(Phases):
    """Takes a thing, and has a partner. A subclass adds its phases to `self._steps`, and says where to take it."""

    def __init__(self, robot: str, object: str, partner: str, device: str, arm: ArmKind = ARM) -> None:
        self.eyes = Eyes((object,), (robot, partner), tuple(name for name in COMMON_THINGS if name != object), arm)
        super().__init__(robot, device, self.eyes, arm)
        self.object, self.partner = object, partner
        self.thing: Thing = thing_named(object)
        self._steps |= {
            "wait": self._wait,
            "approach": self._approach,
            "descend": self._descend,
            "close": self._close,
            "back_off": self._back_off,
            "rise": self._rise,
            "step_back": self._step_back,
        }
        self._clutched_again = 0
        self._take_x = 0.0  # where along the thing it is taken [m]
        self._after_close = ""

    # --- phases that both know ----------------------------------------------------------------------------------------

    @abstractmethod
    def _first_phase(self) -> str:
        """The phase in which taking the thing begins, and begins again after a failed attempt."""

    def _wait(self) -> None:
        self._home = self.eyes.tip(self.robot)
        self._enter(self._first_phase())

    def _approach(self) -> None:
        if self._entering_now:
            self.hand.trigger_goal = 0.0
            self.hand.move_to(above(self._grasp_pose(), CLEAR_ABOVE))
        if self.hand.arrived(0.008, 0.06) and self.hand.trigger_done():
            self._enter("descend")
        elif self._waited(8.0):
            self._retry(f"{self.robot} cannot reach the {self.object}")

    def _descend(self) -> None:
        if self._entering_now:
            self.hand.move_to(self._grasp_pose(), CAREFUL_SPEED)
        if self.hand.arrived(self.arm.near_m, self.arm.near_rad) or (
            self._waited(4.0) and self.hand.arrived(0.006, 0.06)
        ):
            self._enter("close")
        elif self._waited(6.0):
            self._retry(f"{self.robot} cannot reach down to the {self.object}")

    def _close(self) -> None:
        if self._entering_now:
            self.hand.hold_still()
            self.hand.trigger_goal = 1.0
        if self.hand.trigger_done() and self._waited(0.7) and self._holding():
            self._enter(self._after_close)
        elif self._waited(2.5):
            self._retry(f"{self.robot} closed its gripper beside the {self.object}")

    def _back_off(self) -> None:
        if self._entering_now:
            self.hand.trigger_goal = 0.0
            self.hand.move_to(self.eyes.tip(self.robot))
        if self.hand.trigger_done() and self._waited(0.8):
            self.hand.move_to(above(self.eyes.tip(self.robot), CLEAR_ABOVE), correct=False)
            self._enter("rise")

    def _rise(self) -> None:
        if self.hand.moved():
            self._enter("step_back")

    def _step_back(self) -> None:
        """Back to where the hand began: nothing leans on the arm there, and both people can see the thing."""
        if self._entering_now and self._home is not None:
            self.hand.move_to(self._home)
        if self.hand.arrived(0.02, 0.1) or self._waited(4.0):
            self._enter(self._first_phase())

    def _open_gripper(self, then: str) -> None:
        """Opens, goes on with `then`. A gripper that does not follow: the engagement was lost, clutch again."""
        if self._entering_now:
            self._clutched_again = 0
        self.hand.hold_still()
        self.hand.trigger_goal = 0.0
        if self.hand.trigger_done() and self.eyes.gap(self.robot) > 2.0 * self.thing.half_width + 0.010:
            self._enter(then)
        elif self._waited(8.0):
            self._give_up(f"the gripper of {self.robot} does not open")
        elif self._waited(1.5 * (self._clutched_again + 1)):
            self._clutched_again += 1
            self.hand.take_anew()

    # --- geometry as seen ---------------------------------------------------------------------------------------------

    def _grasp_pose(self) -> PoseTuple:
        """Tip pose that takes the thing where it is seen now, and turns the wrist least."""
        T_world_thing = self.eyes.body(self.object)
        return min(grasps(T_world_thing, self._take_x, self.arm.lean), key=lambda tip: self._turn(tip, T_world_thing))

    def _turn(self, T_world_tip: PoseTuple, T_world_thing: PoseTuple) -> float:
        """How far [rad] the wrist is from home when the tip takes the thing like this."""
        return quat_angle(T_world_tip[1], (self._home or self.eyes.tip(self.robot))[1])

    def _holding(self) -> bool:
        return self.eyes.holds(self.robot, self.object, self.thing.half_width)

    def _lost(self) -> bool:
        """Whether the thing is no longer between the fingers."""
        taken_at = apply(self.eyes.body(self.object), (self._take_x, 0.0, 0.0))
        return distance(taken_at, self.eyes.tip(self.robot)[0]) > 0.05

    def _tip_for(self, T_world_thing: PoseTuple) -> PoseTuple:
        """Tip pose that brings the thing, as it now lies in the gripper, to `T_world_thing`."""
        T_tip_thing = compose(inverse(self.eyes.tip(self.robot)), self.eyes.body(self.object))
        return compose(T_world_thing, inverse(T_tip_thing))

    def _exchange(self) -> tuple[Vec3, Vec3]:
        """Where things change hands (world), and the horizontal direction from me to my partner."""
        mine, other = self.eyes.base(self.robot), self.eyes.base(self.partner)
        (ax, ay, az), (bx, by, bz) = mine[0], other[0]
        (fx, fy, _), (gx, gy, _) = (quat_rotate(base[1], (1.0, 0.0, 0.0)) for base in (mine, other))
        inward = self.arm.exchange_inward / 2.0
        apart = max(((bx - ax) ** 2 + (by - ay) ** 2) ** 0.5, 1e-6)
        place = ((ax + bx) / 2.0 + inward * (fx + gx), (ay + by) / 2.0 + inward * (fy + gy))
        return (*place, (az + bz) / 2.0 + self.arm.exchange_height), ((bx - ax) / apart, (by - ay) / apart, 0.0)

    def _table(self) -> float:
        """Height of the table [m], world frame."""
        return self.eyes.base(self.robot)[0][2] - self.arm.above_table
