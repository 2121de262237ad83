"""Handover by a plan: any object, any two arms. The phases are those of `handover`, the poses those of the plan.

The giver takes the object and offers it where the plan says. The receiver takes it there, waits until the giver has
opened and left, and backs off with it. It keeps the object.
"""

from __future__ import annotations

import math
from typing import Final

from anchors.pose import PoseTuple, Vec3, distance, quat_angle
from iris_session.emulator.behaviours.handover import Giver, HandoverTask, Receiver
from iris_session.emulator.behaviours.objects import ArmKind
from iris_session.emulator.behaviours.perception import Perception
from iris_session.emulator.behaviours.plan import ArmPlan, HandoverPlan
from iris_session.protocol.names import Device

#: Arms of unknown servos are moved slowly.
PLANNED_ARM: Final = ArmKind(speed=0.25, near_m=0.004, near_rad=0.04)
#: Pads that hold something are its width apart, up to this [m]: what they press yields, and may lie askew.
GAP_ERROR_M: Final = 0.008
#: How far a held object may be from its planned place in the gripper [m].
SLIP_M: Final = 0.025
#: An object that lies further from its planned place is not taken by this plan [m], [rad].
MOVED_M, MOVED_RAD = 0.05, math.radians(25.0)
#: An object so near to the planned place is offered [m], [rad].
OFFERED_M, OFFERED_RAD = 0.05, 0.35


class PlannedTask(HandoverTask):
    """Base of giver and receiver: they know fingers and grasps of both from the plan."""

    plan: HandoverPlan
    mine: ArmPlan
    other: ArmPlan

    def _set_plan(self, plan: HandoverPlan, mine: ArmPlan, other: ArmPlan) -> None:
        self.plan, self.mine, self.other = plan, mine, other
        self._steps["rise"] = lambda: self._back_away("step_back")

    def _compute_grasp(self) -> PoseTuple:
        return self.mine.compute_grasp(self.perception.get_body(self.object))

    def _compute_approach(self) -> PoseTuple:
        return self.mine.compute_start(self.perception.get_body(self.object))

    def _find_partner_grasp(self) -> Vec3:
        return self.other.compute_grasp(self.perception.get_body(self.object))[0]

    def _back_away(self, then: str) -> None:
        """Move the tip straight back, without a look at where it gets, and continue."""
        if self._entering_now:
            self.hand.move_to(self.mine.back_off(self.perception.get_tip(self.robot)), correct=False)
        if self.hand.has_moved():
            self._enter(then)

    def _is_open(self, robot: str) -> bool:
        return self.perception.compute_gap(robot) > self._get_arm(robot).width + 0.5 * GAP_ERROR_M

    def _is_held_by(self, robot: str) -> bool:
        width = self._get_arm(robot).width
        return self._measure_slip(robot) < SLIP_M and abs(self.perception.compute_gap(robot) - width) < GAP_ERROR_M

    def _has_lost_object(self) -> bool:
        return self._measure_slip(self.robot) > 2.0 * SLIP_M

    def _get_arm(self, robot: str) -> ArmPlan:
        return self.mine if robot == self.robot else self.other

    def _measure_slip(self, robot: str) -> float:
        """Return the distance of the tip of `robot` from its grasp of the object [m]."""
        T_world_grasp = self._get_arm(robot).compute_grasp(self.perception.get_body(self.object))
        return distance(T_world_grasp[0], self.perception.get_tip(robot)[0])


class PlannedGiver(PlannedTask, Giver):
    """Gives the object of `plan`. `patience_s`: time for which it is offered before the giver fails [s]."""

    def __init__(self, plan: HandoverPlan, device: str = Device.CONTROLLER_RIGHT, patience_s: float = 150.0) -> None:
        give, take = plan.giver, plan.receiver
        super().__init__(give.robot, plan.object, take.robot, device, PLANNED_ARM, patience_s, _make_perception(plan))
        self._set_plan(plan, give, take)
        self._lift_m = plan.lift
        self._steps["retreat"] = lambda: self._back_away("return")

    def _choose_grasp(self) -> None:
        """Wait until the object lies still, about where it lay when the plan was made."""
        if self.perception.get_still_s(self.object) < 0.3:
            return
        (p, q), (p_planned, q_planned) = self.perception.get_body(self.object), self.plan.T_world_lying
        away, turn = distance(p, p_planned), quat_angle(q, q_planned)
        if away < MOVED_M and turn < MOVED_RAD:
            self._enter("approach")
        elif self._has_lasted(2.0):
            off = f"{1e3 * away:.0f} mm and {math.degrees(turn):.0f} degrees"
            self._fail("; ".join(filter(None, (self.fault, f"the {self.object} lies {off} from its planned place"))))

    def _compute_offer_pose(self) -> PoseTuple:
        return self.plan.T_world_meeting


class PlannedReceiver(PlannedTask, Receiver):
    """Takes the object of `plan` and keeps it. `patience_s`: time to wait for an offer before it fails [s]."""

    def __init__(self, plan: HandoverPlan, device: str = Device.CONTROLLER_RIGHT, patience_s: float = 150.0) -> None:
        give, take, eyes = plan.giver, plan.receiver, _make_perception(plan)
        super().__init__(take.robot, plan.object, give.robot, device, PLANNED_ARM, None, patience_s, eyes)
        self._set_plan(plan, take, give)
        self._steps["carry"] = lambda: self._back_away("keep")
        self._steps["keep"] = self._keep

    def _is_offered(self) -> bool:
        (p, q), (p_planned, q_planned) = self.perception.get_body(self.object), self.plan.T_world_meeting
        return distance(p, p_planned) < OFFERED_M and quat_angle(q, q_planned) < OFFERED_RAD

    def _take(self) -> None:
        self._enter("approach")

    def _keep(self) -> None:
        """Make sure that it is still held."""
        if self._has_lost_object():
            self._fail(self._describe_slip())
        elif self._has_lasted(0.5):
            self._finish()


def _make_perception(plan: HandoverPlan) -> Perception:
    """Return eyes for the object and both grippers."""
    pads = {arm.robot: tuple(zip(arm.fingers, arm.pads, strict=True)) for arm in (plan.giver, plan.receiver)}
    return Perception((plan.object,), tuple(pads), pads=pads)
