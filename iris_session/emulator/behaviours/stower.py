"""Stow a soft body: pick it up from the table, lift it clear, lay it into an open box and release it."""

from __future__ import annotations

import math

from anchors.pose import PoseTuple, Vec3, apply, distance, inverse
from iris_session.emulator.behaviours.deformables import CORNERS, DeformablePerception, DeformableTask, compute_mean
from iris_session.emulator.behaviours.handover import CAREFUL_SPEED
from iris_session.emulator.behaviours.objects import ARM, CLEAR_ABOVE, DOWN, ArmKind, raise_pose
from iris_session.protocol.names import Device

#: The body of the box; its origin is in the middle of the inner floor.
BOX: str = "box"
#: Inside of the box: half length and half width, and depth [m].
BOX_INSIDE: Vec3 = (0.240, 0.095, 0.070)
#: Height of its lowest corner above the table when lifted [m]: above the walls of the box, and more than 10 cm.
LIFTED: float = 0.12
#: Height above the floor of the box at which the body is released [m].
DROP: float = 0.006
#: Gap between the pads that hold the body [m]: squeezed, it is narrower than the first; without it they close below the
#: second.
SQUEEZED: float = 0.050
EMPTY: float = 0.012


class Stower(DeformableTask):
    """Stows `soft` with `robot`. `place`: where in the box its middle comes to lie (x, y [m], world)."""

    def __init__(
        self,
        robot: str,
        soft: str,
        device: str = Device.CONTROLLER_RIGHT,
        arm: ArmKind = ARM,
        place: tuple[float, float] | None = None,
    ) -> None:
        super().__init__(robot, device, DeformablePerception(soft, (robot,), (BOX,), arm), arm)
        self.soft = soft
        self._place = place
        self._grip: PoseTuple = ((0.0, 0.0, 0.0), DOWN)
        self._steps |= {
            "look": self._choose_grip,
            "approach": self._approach,
            "descend": self._descend,
            "close": self._close,
            "lift": self._lift,
            "carry": self._carry,
            "lower": self._lower,
            "open": lambda: self._open(0.0),
            "leave": lambda: self._rise(CLEAR_ABOVE, "judge", 0.25),
            "judge": self._judge,
        }

    def _choose_grip(self) -> None:
        """Wait until the body lies still, and choose the grip."""
        if self.perception.corners_still_s >= 0.3:
            self._grip = (self.perception.middle, self._compute_grip_turn(self.perception.corners))
            self._enter("approach")

    def _approach(self) -> None:
        fault = f"{self.robot} cannot reach the {self.soft}"
        self._reach(lambda: raise_pose(self._grip, CLEAR_ABOVE), "descend", (0.008, 0.06), 8.0, fault, trigger=0.0)

    def _descend(self) -> None:
        fault = f"{self.robot} cannot reach down to the {self.soft}"
        self._reach(lambda: self._grip, "close", (0.004, 0.04), 6.0, fault, speed=CAREFUL_SPEED)

    def _close(self) -> None:
        if self._entering_now:
            self.hand.hold_still()
            self.hand.trigger_goal = 1.0
        if self.hand.is_trigger_done() and self._has_lasted(0.9) and self._is_holding():
            self._enter("lift")
        elif self._is_shown_for(2.5):
            self._retry(f"{self.robot} closed its gripper beside the {self.soft}")

    def _lift(self) -> None:
        if self._entering_now:
            self.hand.move_to(raise_pose(self._grip, LIFTED + 0.03))
        self._finish_carry("carry", 0.01)

    def _carry(self) -> None:
        if self._entering_now:
            (x, y), z = self._compute_goal(), self.perception.get_tip(self.robot)[0][2]
            self.hand.move_to(((x, y, z), self._grip[1]))
        self._finish_carry("lower", 0.006)

    def _lower(self) -> None:
        """Lower the body until its lowest corner is just above the floor of the box."""
        if self._entering_now:
            lowest = min(corner[2] for corner in self.perception.corners.values())
            down = lowest - self.perception.get_body(BOX)[0][2] - DROP
            self.hand.move_to(raise_pose(self.perception.get_tip(self.robot), -down), CAREFUL_SPEED)
        self._finish_carry("open", 0.005)

    def _finish_carry(self, then: str, within_m: float) -> None:
        if self._check_slip(f"the {self.soft} slipped out of the gripper of {self.robot}"):
            return
        if self.hand.has_arrived(within_m, 0.06):
            self._enter(then)
        elif self._has_lasted(8.0):
            self._retry(f"{self.robot} cannot move the {self.soft}")

    def _judge(self) -> None:
        """Check that it lies in the box."""
        if self.perception.corners_still_s < 0.3 and not self._is_shown_for(5.0):
            return
        if all(self._is_inside_box(corner) for corner in self.perception.corners.values()):
            self._enter("return")
        else:
            self._retry(f"the {self.soft} does not lie in the box")

    # --- geometry as seen ---------------------------------------------------------------------------------------------

    def _compute_grip_turn(self, corners: dict[int, Vec3]) -> tuple[float, float, float, float]:
        """Return the rotation of a tip that grasps the body from above across its length, with the least turn of the
        wrist.
        """
        order = CORNERS[self.soft]
        (ax, ay, _), (bx, by, _) = (compute_mean(corners[i] for i in end) for end in (order[:4], order[4:]))
        return self._turn_down(math.atan2(by - ay, bx - ax))

    def _compute_goal(self) -> tuple[float, float]:
        """Return where to lay it: the given place, else the half of the box on this side."""
        if self._place is not None:
            return self._place
        T_world_box = self.perception.get_body(BOX)
        mine = apply(inverse(T_world_box), self.perception.get_base(self.robot)[0])
        x, y, _ = apply(T_world_box, (math.copysign(0.5 * BOX_INSIDE[0], mine[0]), 0.0, 0.0))
        return (x, y)

    def _is_holding(self) -> bool:
        """Return True if it is between the pads and moves with them."""
        near = distance(self.perception.middle, self.perception.get_tip(self.robot)[0]) < 0.04
        return near and EMPTY < self.perception.compute_gap(self.robot) < SQUEEZED

    def _is_inside_box(self, p_world: Vec3) -> bool:
        x, y, z = apply(inverse(self.perception.get_body(BOX)), p_world)
        return abs(x) < BOX_INSIDE[0] and abs(y) < BOX_INSIDE[1] and z < BOX_INSIDE[2]
