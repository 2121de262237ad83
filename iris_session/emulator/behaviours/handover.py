"""Handover tasks: the giver offers an object in mid-air, the receiver takes its free end and lays it down."""

from __future__ import annotations

import math

from anchors.pose import PoseTuple, Vec3, apply, compose, distance, inverse, quat_angle, quat_rotate
from iris_session.emulator.behaviours.objects import (
    ARM,
    CLEAR_ABOVE,
    COMMON_OBJECTS,
    ArmKind,
    HandoverObject,
    compute_grasps,
    compute_tilt,
    find_object,
    get_face_up,
    make_level_pose,
    raise_pose,
)
from iris_session.emulator.behaviours.perception import Perception
from iris_session.emulator.behaviours.phases import PhasedTask
from iris_session.protocol.names import Device

#: Speed of the last centimetres before a grasp [m/s].
CAREFUL_SPEED = 0.16


class HandoverTask(PhasedTask):
    """Base of both tasks: it grasps an object, and has a partner. A subclass adds its phases to `self._steps`.

    `perception`: of an object that is not one of `objects`; it has no `object_model` then, and a subclass knows how it
    is grasped.
    """

    object_model: HandoverObject

    def __init__(
        self,
        robot: str,
        object: str,
        partner: str,
        device: str,
        arm: ArmKind = ARM,
        perception: Perception | None = None,
    ) -> None:
        if perception is None:
            others = tuple(name for name in COMMON_OBJECTS if name != object)
            perception = Perception((object,), (robot, partner), others, arm)
            self.object_model = find_object(object)
        super().__init__(robot, device, perception, arm)
        self.object, self.partner = object, partner
        self._steps |= {
            "approach": self._approach,
            "descend": self._descend,
            "close": self._close,
            "back_off": self._back_off,
            "rise": lambda: self._rise(CLEAR_ABOVE, "step_back"),
            "step_back": self._step_back,
        }
        self._clutched_again = 0
        self._take_x = 0.0  # position of the grasp along the object [m]
        self._after_close = ""
        self._closed_s = 0.0  # when the object was last seen in the closed gripper

    # --- phases that both know ----------------------------------------------------------------------------------------

    def _approach(self) -> None:
        fault = f"{self.robot} cannot reach the {self.object}"
        self._reach(self._compute_approach, "descend", (0.008, 0.06), 8.0, fault, trigger=0.0)

    def _descend(self) -> None:
        if self._entering_now:
            self.hand.move_to(self._compute_grasp(), CAREFUL_SPEED)
        if self.hand.has_arrived(self.arm.near_m, self.arm.near_rad) or (
            self._has_lasted(4.0) and self.hand.has_arrived(0.006, 0.06)
        ):
            self._enter("close")
        elif self._has_lasted(6.0):
            self._retry(f"{self.robot} cannot reach down to the {self.object}")

    def _close(self) -> None:
        if self._entering_now:
            self.hand.hold_still()
            self.hand.trigger_goal = 1.0
        if self.hand.is_trigger_done() and self._has_lasted(0.7) and self._is_holding():
            self._closed_s = self.hand.now_s
            self._enter(self._after_close)
        elif self._has_lasted(2.5):
            self._retry(f"{self.robot} closed its gripper beside the {self.object}")

    def _back_off(self) -> None:
        if self._entering_now:
            self.hand.trigger_goal = 0.0
            self.hand.move_to(self.perception.get_tip(self.robot))
        if self.hand.is_trigger_done() and self._has_lasted(0.8):
            self._enter("rise")

    def _step_back(self) -> None:
        """Move back to where the hand began: there nothing leans on the arm, and both operators can see the object."""
        self._reach(lambda: self._home or self.perception.get_tip(self.robot), self.first_phase, (0.02, 0.1), 4.0)

    def _open_gripper(self, then: str) -> None:
        """Open the gripper and continue with `then`. If it does not follow, the engagement was lost: clutch again."""
        if self._entering_now:
            self._clutched_again = 0
        self.hand.hold_still()
        self.hand.trigger_goal = 0.0
        if self.hand.is_trigger_done() and self._is_open(self.robot):
            self._enter(then)
        elif self._has_lasted(8.0):
            self._fail(f"the gripper of {self.robot} does not open")
        elif self._has_lasted(1.5 * (self._clutched_again + 1)):
            self._clutched_again += 1
            self.hand.reclutch()

    # --- geometry as seen ---------------------------------------------------------------------------------------------

    def _compute_grasp(self) -> PoseTuple:
        """Return the tip pose that grasps the object where it is displayed, with the least turn of the wrist."""
        T_world_thing = self.perception.get_body(self.object)
        return min(
            compute_grasps(T_world_thing, self._take_x, self.arm.lean),
            key=lambda tip: self._compute_turn(tip, T_world_thing),
        )

    def _compute_approach(self) -> PoseTuple:
        """Return the tip pose at which the straight approach to the grasp begins."""
        return raise_pose(self._compute_grasp(), CLEAR_ABOVE)

    def _compute_turn(self, T_world_tip: PoseTuple, T_world_thing: PoseTuple) -> float:
        """Return the turn of the wrist from home [rad] for a grasp with this tip pose."""
        return quat_angle(T_world_tip[1], (self._home or self.perception.get_tip(self.robot))[1])

    def _is_holding(self) -> bool:
        return self._is_held_by(self.robot)

    def _is_held_by(self, robot: str) -> bool:
        return self.perception.is_holding(robot, self.object, self.object_model.half_width)

    def _is_open(self, robot: str) -> bool:
        """Return True if the gripper of `robot` is open around the object."""
        return self.perception.compute_gap(robot) > 2.0 * self.object_model.half_width + 0.010

    def _has_lost_object(self) -> bool:
        """Return True if the object is no longer between the fingers."""
        taken_at = apply(self.perception.get_body(self.object), (self._take_x, 0.0, 0.0))
        return distance(taken_at, self.perception.get_tip(self.robot)[0]) > 0.05

    def _describe_slip(self) -> str:
        held_s = self.hand.now_s - self._closed_s
        return f"the {self.object} slipped out of the gripper of {self.robot} {held_s:.1f} s after it closed"

    def _compute_tip(self, T_world_thing: PoseTuple) -> PoseTuple:
        """Return the tip pose that brings the object, as it lies in the gripper, to `T_world_thing`."""
        T_tip_thing = compose(inverse(self.perception.get_tip(self.robot)), self.perception.get_body(self.object))
        return compose(T_world_thing, inverse(T_tip_thing))

    def _compute_exchange(self) -> tuple[Vec3, Vec3]:
        """Return the place of the handover (world), and the horizontal direction to the partner."""
        mine, other = self.perception.get_base(self.robot), self.perception.get_base(self.partner)
        (ax, ay, az), (bx, by, bz) = mine[0], other[0]
        (fx, fy, _), (gx, gy, _) = (quat_rotate(base[1], (1.0, 0.0, 0.0)) for base in (mine, other))
        inward = self.arm.exchange_inward / 2.0
        apart = max(((bx - ax) ** 2 + (by - ay) ** 2) ** 0.5, 1e-6)
        place = ((ax + bx) / 2.0 + inward * (fx + gx), (ay + by) / 2.0 + inward * (fy + gy))
        return (*place, (az + bz) / 2.0 + self.arm.exchange_height), ((bx - ax) / apart, (by - ay) / apart, 0.0)


#: Time for which the partner must be seen to hold the object before the giver opens [s].
SURE_S = 0.35
#: Maximum tilt of an object that is picked up [rad].
MOST_TILT = 0.3


class Giver(HandoverTask):
    """Grasps `object` near its heavy end with `robot` and hands it to the operator of `partner`.

    `patience_s`: time for which the object is offered before the giver fails [s].
    """

    _lift_m = CLEAR_ABOVE

    def __init__(
        self,
        robot: str,
        object: str,
        partner: str,
        device: str = Device.CONTROLLER_RIGHT,
        arm: ArmKind = ARM,
        patience_s: float = 150.0,
        perception: Perception | None = None,
    ) -> None:
        super().__init__(robot, object, partner, device, arm, perception)
        self._after_close = "lift"
        self._patience_s = patience_s
        self._taken_since_s = math.inf
        self._steps |= {
            "look": self._choose_grasp,
            "lift": self._lift,
            "present": self._present,
            "offer": self._offer,
            "release": self._release,
            "retreat": lambda: self._rise(CLEAR_ABOVE + 0.02, "return", 0.3),
        }

    def _choose_grasp(self) -> None:
        """Wait until the object lies still, and choose the end to grasp: the one that turns the wrist least."""
        if self.perception.get_still_s(self.object) < 0.3:
            return
        if compute_tilt(self.perception.get_body(self.object)) > MOST_TILT:
            if self._has_lasted(3.0):
                self._fail(f"the {self.object} does not lie flat, it cannot be taken from above")
            return
        ends = (
            (self.object_model.giver_x, -self.object_model.giver_x)
            if self.object_model.symmetric
            else (self.object_model.giver_x,)
        )
        self._take_x = min(ends, key=self._compute_effort)
        self._enter("approach")

    def _compute_grasp(self) -> PoseTuple:
        return raise_pose(super()._compute_grasp(), self.arm.grasp_above)

    def _compute_effort(self, take_x: float) -> float:
        """Return the turn of the wrist [rad] to grasp the object at this end and to offer the other."""
        self._take_x = take_x
        return self._compute_turn(self._compute_grasp(), self.perception.get_body(self.object))

    def _lift(self) -> None:
        if self._entering_now:
            self.hand.move_to(raise_pose(self.perception.get_tip(self.robot), self._lift_m))
        if self._has_lost_object():
            self._retry(self._describe_slip())
        elif self.hand.has_arrived(0.015, 0.06) or self._has_lasted(4.0):
            self._enter("present")

    def _present(self) -> None:
        if self._entering_now:
            self.hand.move_to(self._compute_tip(self._compute_offer_pose()))
        if self._has_lost_object():
            self._retry(self._describe_slip())
        elif self.hand.has_arrived(0.008, 0.05) or self._has_lasted(8.0):
            self._enter("offer")

    def _compute_offer_pose(self) -> PoseTuple:
        """Return the pose of the object when it is offered: its free end towards the partner."""
        place, (dx, dy, _) = self._compute_exchange()
        towards = math.atan2(dy, dx) if self._take_x < 0.0 else math.atan2(-dy, -dx)
        return make_level_pose(place, towards, get_face_up(self.perception.get_body(self.object)))

    def _compute_turn(self, T_world_tip: PoseTuple, T_world_thing: PoseTuple) -> float:
        """Return the turn of the wrist for a grasp. The same grasp must do for the offer, so the turn between the
        two counts too.
        """
        offered = self._compute_offer_pose()
        offering = compose(offered, compose(inverse(T_world_thing), T_world_tip))
        farthest = max(
            super()._compute_turn(T_world_tip, T_world_thing), super()._compute_turn(offering, T_world_thing)
        )
        return farthest + 0.5 * quat_angle(offered[1], T_world_thing[1])

    def _offer(self) -> None:
        if distance(self.perception.get_tip(self.partner)[0], self._find_partner_grasp()) < 0.07:
            self.hand.hold_still()
        if self._has_lost_object():
            self._retry(self._describe_slip())
        elif not self._is_held_by(self.partner):
            self._taken_since_s = math.inf
            if self._has_lasted(self._patience_s):
                self._fail(f"{self.partner} did not take the {self.object} within {self._patience_s:.0f} s")
        else:
            self._taken_since_s = min(self._taken_since_s, self.hand.now_s)
            if self.hand.now_s - self._taken_since_s >= SURE_S:
                self._enter("release")

    def _find_partner_grasp(self) -> Vec3:
        """Return where the partner will grasp the object [m]."""
        x = self.object_model.receiver_x
        return apply(self.perception.get_body(self.object), (x if self._take_x < 0.0 else -x, 0.0, 0.0))

    def _release(self) -> None:
        self._open_gripper("retreat")


#: An object closer to the place of exchange than this is offered [m].
OFFERED_M = 0.10
#: A giver whose tip is further than this from where it held the object has left [m].
LEFT_M = 0.08


class Receiver(HandoverTask):
    """Takes `object` with `robot` from the operator of `partner` and lays it on the table.

    `place`: position (x, y [m], world); default: in front of the robot, on its freer side. `patience_s`: time to wait
    for an offer before it fails [s].
    """

    first_phase = "watch"

    def __init__(
        self,
        robot: str,
        object: str,
        partner: str,
        device: str = Device.CONTROLLER_RIGHT,
        arm: ArmKind = ARM,
        place: tuple[float, float] | None = None,
        patience_s: float = 150.0,
        perception: Perception | None = None,
    ) -> None:
        super().__init__(robot, object, partner, device, arm, perception)
        self._after_close = "secure"
        self._place = place
        self._patience_s = patience_s
        self._laid: PoseTuple | None = None
        self._steps |= {
            "watch": self._watch,
            "raise": self._raise_hand,
            "secure": self._secure,
            "carry": self._carry,
            "lower": self._lower,
            "put": self._touch_down,
            "open": self._open,
            "leave": self._leave,
        }

    def _watch(self) -> None:
        if self._entering_now and self._home is not None:
            self.hand.move_to(self._home)
        is_still = self.perception.get_still_s(self.object) > 0.4
        if is_still and self._is_offered() and self._is_held_by(self.partner):
            self._take()
        elif self._has_lasted(self._patience_s):
            self._fail(f"{self.partner} did not offer the {self.object} within {self._patience_s:.0f} s")

    def _is_offered(self) -> bool:
        """Return True if the object is where it changes hands."""
        return distance(self.perception.get_body(self.object)[0], self._compute_exchange()[0]) < OFFERED_M

    def _take(self) -> None:
        """Begin to take the object that is offered."""
        self._take_x = self._find_free_end()
        self._enter("raise")

    def _raise_hand(self) -> None:
        """Move straight up to the start of the approach: on a slant, the fingers could push the object away."""

        def goal() -> PoseTuple:
            (x, y, z), q = self.perception.get_tip(self.robot)
            return ((x, y, max(z, self._compute_grasp()[0][2] + CLEAR_ABOVE)), q)

        self._reach(goal, "approach", (0.03, 0.1), 4.0)

    def _find_free_end(self) -> float:
        """Return where to grasp the object [m along its x]: for a symmetric thing the end away from the giver's
        fingers."""
        x = self.object_model.receiver_x
        if not self.object_model.symmetric:
            return x
        thing, giver = self.perception.get_body(self.object), self.perception.get_tip(self.partner)[0]
        return max((x, -x), key=lambda end: distance(apply(thing, (end, 0.0, 0.0)), giver))

    def _secure(self) -> None:
        """Keep hold until the giver has opened and left. Both robots hold the object, so there are no corrections."""
        if self._entering_now:
            self.hand.hold_still()
        away = distance(self.perception.get_tip(self.partner)[0], self._find_partner_grasp())
        if self._is_open(self.partner) and away > LEFT_M:
            self._enter("carry")
        elif self._has_lasted(1.0) and not self._is_holding():
            self._retry(self._describe_slip())
        elif self._has_lasted(15.0):
            self._retry(f"{self.partner} did not release the {self.object}")

    def _find_partner_grasp(self) -> Vec3:
        """Return where the giver has held the object [m]."""
        return apply(self.perception.get_body(self.object), (-self._take_x, 0.0, 0.0))

    def _carry(self) -> None:
        if self._entering_now:
            x, y = self._place if self._place is not None else self._find_free_place()
            bx, by, _ = self.perception.get_base(self.robot)[0]
            yaw = math.atan2(by - y, bx - x) if self._take_x > 0.0 else math.atan2(y - by, x - bx)
            up = get_face_up(self.perception.get_body(self.object))
            self._laid = make_level_pose(
                (x, y, self._compute_table_height() + self.object_model.half_thickness), yaw, up
            )
            self.hand.move_to(self._compute_tip(raise_pose(self._laid, CLEAR_ABOVE)))
        if self._has_lost_object():
            self._fail(f"{self.robot} dropped the {self.object} on the way")
        elif self.hand.has_arrived(0.01, 0.06) or self._has_lasted(8.0):
            self._enter("lower")

    def _lower(self) -> None:
        """Move down to a finger's breadth above the table, levelled for how the object now hangs in the gripper."""
        if self._entering_now and self._laid is not None:
            self.hand.move_to(self._compute_tip(raise_pose(self._laid, 0.015)), CAREFUL_SPEED)
        if self._has_lost_object():
            self._fail(f"{self.robot} dropped the {self.object} on the way")
        elif self.hand.has_arrived(0.004, 0.03) or self._has_lasted(5.0):
            self._enter("put")

    def _touch_down(self) -> None:
        """Move down the last centimetre, by the displayed height of the lowest point."""
        if self._entering_now:
            below = (
                self.object_model.compute_lowest(self.perception.get_body(self.object)) - self._compute_table_height()
            )
            self.hand.move_to(
                raise_pose(self.perception.get_tip(self.robot), -max(below - 0.0005, 0.0)), 0.05, correct=False
            )
        if self.hand.has_moved() and self._has_lasted(0.9):
            self._enter("open")

    def _open(self) -> None:
        self._open_gripper("leave")

    def _leave(self) -> None:
        if self._entering_now:
            self.hand.move_to(raise_pose(self.perception.get_tip(self.robot), CLEAR_ABOVE), 0.3, correct=False)
        if not self.hand.has_moved():
            return
        p_world = self.perception.get_body(self.object)[0]
        if self._laid is None or distance(p_world, self._laid[0]) > 0.06:
            self._fail(f"the {self.object} did not stay where {self.robot} put it")
        else:
            self._enter("return")

    def _find_free_place(self) -> tuple[float, float]:
        """Return a place in front of the robot, on the side of the shared table that is further from other objects."""
        base, q = self.perception.get_base(self.robot)
        dx, dy, _ = quat_rotate(q, (self.arm.reach, 0.0, 0.0))
        aside = 0.2 / self.arm.reach
        sides = [(base[0] + dx - s * aside * dy, base[1] + dy + s * aside * dx, base[2]) for s in (1.0, -1.0)]
        others = self.perception.list_obstacles()

        def room(place: Vec3) -> float:
            return min((distance(place, other) for other in others), default=1.0)

        best = max(sides, key=room)
        return best[0], best[1]
