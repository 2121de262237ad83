"""A client without sheets in view: it calibrates the tip of its controller, touches four printed marks, and drives."""

from __future__ import annotations

from typing import Final

import numpy as np

from anchors.ageing import AgeingLaw
from anchors.lie import Array, quat_exp, quat_to_matrix
from anchors.persistent import covariance_at_anchor
from anchors.pose import PoseTuple, Vec3, apply, compose, distance, inverse, quat_from_yaw
from iris_session.authority import AuthorityConfig
from iris_session.protocol.common import Alignment
from iris_session.protocol.names import AlignmentKind, DenialReason, HoldReason, RejectReason
from iris_session.protocol.server_messages import EngagementChanged, Notice, SamplesRejected, TipCalibrated
from tests.rig.session import Hand, Rig

RIGHT: Final = "controller/right"
FINGER: Final = "hand/right"
T_WORLD_TRACKING: Final[PoseTuple] = ((1.2, -0.7, 0.3), quat_from_yaw(2.0))
T_TRACKING_P: Final[PoseTuple] = ((0.3, 0.2, -0.1), quat_from_yaw(0.7))
TIP: Final[Vec3] = (0.01, -0.02, -0.12)
#: In the frame of the sheet [m], as `iris-session anchors example --marks` prints them.
MARKS: Final = {
    "1": (-0.0924, 0.1316, 0.0), "2": (0.0924, 0.1316, 0.0), "3": (0.0924, -0.056, 0.0), "4": (-0.0924, -0.1316, 0.0),
}  # fmt: skip


def make_rig() -> Rig:
    return Rig(timestep=0.01, anchor_marks={"table": MARKS})


class Toucher:
    """A person who touches the marks of the sheet; `client` knows nothing of the true frames."""

    def __init__(self, rig: Rig, device: str = RIGHT) -> None:
        self.rig = rig
        self.device = device
        self.T_world_tracking = T_WORLD_TRACKING
        self.rng = np.random.default_rng(3)
        self.client = rig.join("ann", devices=("head", RIGHT, FINGER), alignment="measured")

    def turn_in_a_hole(self) -> TipCalibrated:
        """Report poses of the controller with its tip in a hole; return the answer of the session."""
        q = quat_exp(self.rng.uniform(-0.6, 0.6, (150, 3)))
        at = np.array([0.5, 0.2, -0.3]) - quat_to_matrix(q) @ np.array(TIP) + self.rng.normal(0.0, 0.001, (150, 3))
        self.client.alignment.report_tip_poses(
            self.device, [(_to_tuple(p), _to_tuple(turn)) for p, turn in zip(at, q, strict=True)]
        )
        self.rig.run(0.3)
        return self.rig.list_events("ann", TipCalibrated)[-1][1]

    def touch_marks(self, p_grip_tip: Vec3, names: str, sigma_m: float = 0.0015) -> Alignment:
        """Touch marks. `p_grip_tip`: the tip as it was calibrated. Return the alignment then."""
        place = self.client.mirror.anchors["table"].T_world_anchor
        for name in names:
            q = quat_exp(self.rng.uniform(-0.4, 0.4, 3))
            mark = np.array(apply(inverse(self.T_world_tracking), apply((place.p, place.q), MARKS[name])))
            p = mark + quat_to_matrix(q) @ (np.array(p_grip_tip) - np.array(TIP)) + self.rng.normal(0.0, sigma_m, 3)
            self.client.alignment.observe(
                "table", (_to_tuple(p), _to_tuple(q)), kind="touch", device=self.device, mark=name
            )
        self.rig.run(0.5)
        return self.get_alignment()

    def get_alignment(self) -> Alignment:
        current = self.client.alignment.current
        assert current is not None
        return current

    def error_at(self, point: Vec3, alignment: Alignment) -> float:
        T = (alignment.T_world_tracking.p, alignment.T_world_tracking.q)
        return distance(apply(T, apply(inverse(self.T_world_tracking), point)), point)

    def hold_robot(self) -> Hand:
        self.client.acquire(["left"])
        return self.rig.add_hand(self.client, "left", self.device)


def _to_tuple(values: Array) -> tuple[float, ...]:
    return tuple(values.tolist())


def test_tip_four_touches_and_a_robot_that_follows() -> None:
    with make_rig() as rig:
        ann = Toucher(rig)
        sheet = ann.client.mirror.anchors["table"]
        assert {mark.id: mark.p_anchor for mark in sheet.marks} == MARKS
        without_turning = [((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))] * 40
        ann.client.alignment.report_tip_poses(RIGHT, without_turning)
        rig.run(0.3)
        answer = rig.list_events("ann", TipCalibrated)[-1][1]
        assert answer.refused
        assert answer.advice
        found = ann.turn_in_a_hole()
        assert not found.refused
        assert found.participant == ann.client.participant_id
        assert distance(found.p_grip_tip, TIP) < found.error_m < 0.003
        got = ann.touch_marks(found.p_grip_tip, "1234")
        assert got.kind == AlignmentKind.MEASURED
        assert 0.0 < got.error_at_anchor_m < 0.006
        assert ann.error_at(sheet.T_world_anchor.p, got) < 2.0 * got.error_at_anchor_m
        assert 0.0 < got.error_at_robot_m < 0.05
        hand = ann.hold_robot()
        rig.engage(hand)
        # The hand moves in the tracking frame: the tip moves as the true frames say, to within the angle of the error.
        start, hand.velocity = hand.tip, (0.1, 0.0, 0.0)
        rig.run(0.5)
        hand.velocity = (0.0, 0.0, 0.0)
        rig.run(0.5)
        moved = np.subtract(hand.tip[0], start[0])
        turn = quat_to_matrix(np.array(T_WORLD_TRACKING[1])) @ np.array([0.05, 0.0, 0.0])
        assert np.linalg.norm(moved - turn) < 3e-3


def test_fingertip_may_look_and_is_denied_to_drive_until_a_tip_is_calibrated() -> None:
    with make_rig() as rig:
        ann = Toucher(rig, FINGER)
        got = ann.touch_marks(TIP, "1234", 0.005)
        assert got.kind == AlignmentKind.FINGERTIP
        assert 0.008 < got.error_at_anchor_m < 0.03
        hand = ann.hold_robot()
        rig.run(0.3)
        before, hand.clutch, hand.velocity = hand.tip, True, (0.1, 0.0, 0.0)
        rig.run(0.5)
        assert RejectReason.VIEW_ONLY in {body.reason for _, body in rig.list_events("ann", SamplesRejected)}
        assert DenialReason.VIEW_ONLY in {body.reason for _, body in rig.list_events("ann", Notice)}
        assert ann.client.feedback["left"].hold_reason == HoldReason.VIEW_ONLY
        assert distance(before[0], hand.tip[0]) < 1e-4
        hand.clutch, hand.velocity, hand.device, ann.device = False, (0.0, 0.0, 0.0), RIGHT, RIGHT
        found = ann.turn_in_a_hole()
        assert ann.touch_marks(found.p_grip_tip, "1234").kind == AlignmentKind.MEASURED
        rig.engage(hand)


def test_three_touches_confirm_an_alignment_that_has_grown_old() -> None:
    """Four hundred times as fast as it drifts in use."""
    law = AgeingLaw(drift_m_per_min=0.8, yaw_rad_per_min=1.6)
    config = AuthorityConfig(ageing=law, age_check_ns=10_000_000)
    with Rig(timestep=0.01, anchor_marks={"table": MARKS}, authority=config) as rig:
        ann = Toucher(rig)
        found = ann.turn_in_a_hole()
        ann.touch_marks(found.p_grip_tip, "1234")
        hand = ann.hold_robot()
        rig.run(5.0)
        hand.clutch = True
        rig.run(0.3)
        assert ann.client.feedback["left"].hold_reason == HoldReason.UNCONFIRMED
        hand.clutch = False
        ann.touch_marks(found.p_grip_tip, "123")
        rig.engage(hand)


def test_kept_place_comes_back_for_looking_and_a_touch_confirms_it() -> None:
    with make_rig() as rig:
        ann = Toucher(rig)
        found = ann.turn_in_a_hole()
        aligned = ann.touch_marks(found.p_grip_tip, "1234")
        world = ann.client.mirror.anchors["table"].T_world_anchor
        believed: PoseTuple = (aligned.T_world_tracking.p, aligned.T_world_tracking.q)
        T_P_anchor = compose(inverse(T_TRACKING_P), compose(inverse(believed), (world.p, world.q)))
        covariance = covariance_at_anchor(aligned.covariance, aligned.pivot_world, (world.p, world.q))

        # The page is loaded again, with the clutch closed: another tracking frame, in which P is found 5 mm off.
        hand = ann.hold_robot()
        rig.engage(hand)
        before, jumped_ns = hand.tip, rig.session.clock()
        ann.T_world_tracking = ((0.4, 0.9, -0.2), quat_from_yaw(-1.0))
        ann.client.alignment.report_tracking_jump()
        hand.pose = ((1.5, -0.6, 0.7), hand.pose[1])
        rig.run(0.3)
        held_ns, ended = rig.list_events("ann", EngagementChanged)[-1]
        assert (ended.engaged, ended.reason) == (False, HoldReason.REARM)
        assert held_ns - jumped_ns <= 20_000_000
        assert distance(before[0], hand.tip[0]) < 1e-4
        assert ann.client.alignment.current is None, "the old alignment is void"
        (x, y, z), q = compose(compose(inverse(ann.T_world_tracking), T_WORLD_TRACKING), T_TRACKING_P)
        seen = compose(((x + 0.005, y, z), q), T_P_anchor)
        ann.client.alignment.observe("table", seen, kind="persistent", covariance=covariance)
        rig.run(0.5)
        kept = ann.get_alignment()
        assert kept.kind == AlignmentKind.PERSISTENT
        assert kept.error_at_anchor_m > 0.01
        hand.clutch = False
        rig.run(0.1)
        hand.clutch = True
        rig.run(0.3)
        assert not hand.is_following
        confirmed = ann.touch_marks(found.p_grip_tip, "1")
        assert confirmed.kind == AlignmentKind.MEASURED
        assert confirmed.error_at_anchor_m < kept.error_at_anchor_m
        assert ann.error_at(world.p, confirmed) < 2.0 * confirmed.error_at_anchor_m
        rig.engage(hand)
