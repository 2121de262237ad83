"""Plan of a handover between two arms: how each grasps the object, and where they meet. Plain data.

`demo/handover_plan` makes it from a model; `planned` follows it. Nothing here depends on the kind of arm or object.
"""

from __future__ import annotations

import msgspec

from anchors.pose import IDENTITY_QUAT, PoseTuple, Vec3, compose


class ArmPlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The part of one arm.

    `fingers`, `pads`: its two fingers: names of bodies, and the point of each that touches what it holds, in the frame
    of the body [m]. `T_object_tip`: the grasp. `back`: from the grasp to where its straight approach begins, in the
    frame of the tip [m]. `width`: of the object between the pads [m].
    """

    robot: str
    fingers: tuple[str, str]
    pads: tuple[Vec3, Vec3]
    T_object_tip: PoseTuple
    back: Vec3
    width: float

    def compute_grasp(self, T_world_object: PoseTuple) -> PoseTuple:
        """Return `T_world_tip` of the grasp."""
        return compose(T_world_object, self.T_object_tip)

    def compute_start(self, T_world_object: PoseTuple) -> PoseTuple:
        """Return `T_world_tip` where the approach begins."""
        return self.back_off(self.compute_grasp(T_world_object))

    def back_off(self, T_world_tip: PoseTuple) -> PoseTuple:
        """Return the tip pose after it has backed off."""
        return compose(T_world_tip, (self.back, IDENTITY_QUAT))


class HandoverPlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The whole plan. Poses are those of the object: where it lies, and where it is offered. `lift`: how far straight
    up it is lifted first [m].
    """

    object: str
    giver: ArmPlan
    receiver: ArmPlan
    T_world_lying: PoseTuple
    T_world_meeting: PoseTuple
    lift: float
