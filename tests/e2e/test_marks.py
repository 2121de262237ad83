"""A client without sheets in view: it calibrates the tip of its controller, touches four printed marks, and drives.

Everything passes real sockets: the tip, the touches, the answers, and what the session allows afterwards.
"""

from __future__ import annotations

import numpy as np
import pytest

from anchors.lie import Array, quat_exp, quat_to_matrix
from anchors.persistent import covariance_at_anchor
from anchors.pose import PoseTuple, Vec3, apply, compose, distance, inverse, quat_from_yaw
from iris_session.client import Client
from iris_session.protocol.common import Alignment
from iris_session.protocol.names import AlignmentKind, DenialReason, HoldReason, RejectReason
from iris_session.protocol.server_messages import Notice, SamplesRejected, TipCalibrated
from tests.e2e.scenario import Hand, Scenario

pytestmark = pytest.mark.e2e

RIGHT = "controller/right"
FINGER = "hand/right"
T_WORLD_TRACKING: PoseTuple = ((1.2, -0.7, 0.3), quat_from_yaw(2.0))
T_TRACKING_P: PoseTuple = ((0.3, 0.2, -0.1), quat_from_yaw(0.7))
TIP: Vec3 = (0.01, -0.02, -0.12)
TOUCH_SIGMA_M = 0.0015


@pytest.fixture
def scenario(marked_scenario: Scenario) -> Scenario:
    return marked_scenario


class Toucher:
    """A person who touches the marks of the sheet; `client` knows nothing of the true frames."""

    def __init__(self, scenario: Scenario, name: str, device: str) -> None:
        log = scenario.events[name] = []
        self.scenario = scenario
        self.device = device
        self.T_world_tracking = T_WORLD_TRACKING
        self.rng = np.random.default_rng(len(name))
        self.client = scenario.add(
            Client(
                scenario.server.address,
                role="operator",
                name=name,
                devices=("head", RIGHT, FINGER),
                alignment="measured",
                on_event=log.append,
            )
        )

    def events(self, kind: type) -> list[object]:
        return [event.body for event in self.scenario.events[self.client.name] if isinstance(event.body, kind)]

    def turn_in_a_hole(self) -> TipCalibrated:
        """Report a hundred poses of the controller with its tip in a hole; return the answer of the session."""
        q = quat_exp(self.rng.uniform(-0.6, 0.6, (150, 3)))
        at = np.array([0.5, 0.2, -0.3]) - quat_to_matrix(q) @ np.array(TIP) + self.rng.normal(0.0, 0.001, (150, 3))
        before = len(self.events(TipCalibrated))
        poses = [(_to_tuple(p), _to_tuple(turn)) for p, turn in zip(at, q, strict=True)]
        self.client.alignment.report_tip_poses(self.device, poses)
        self.scenario.run_until(lambda: len(self.events(TipCalibrated)) > before, "the session answers")
        answer = self.events(TipCalibrated)[-1]
        assert isinstance(answer, TipCalibrated)
        return answer

    def touch_marks(self, p_grip_tip: Vec3, names: str, sigma_m: float = TOUCH_SIGMA_M) -> None:
        """Touch marks as the session lists them. `p_grip_tip`: the tip as it was calibrated."""
        anchor = self.client.mirror.anchors["table"]
        marks = {mark.id: mark.p_anchor for mark in anchor.marks}
        place = (anchor.T_world_anchor.p, anchor.T_world_anchor.q)
        for name in names:
            q = quat_exp(self.rng.uniform(-0.4, 0.4, 3))
            mark = np.array(apply(inverse(self.T_world_tracking), apply(place, marks[name])))
            grip = mark - quat_to_matrix(q) @ np.array(TIP)
            p = grip + quat_to_matrix(q) @ np.array(p_grip_tip) + self.rng.normal(0.0, sigma_m, 3)
            self.client.alignment.observe(
                "table", (_to_tuple(p), _to_tuple(q)), kind="touch", device=self.device, mark=name
            )

    def wait_for_alignment(self, kind: str) -> Alignment:
        self.scenario.run_until(lambda: self.current_kind == kind, f"an alignment of kind {kind}")
        current = self.client.alignment.current
        assert current is not None
        return current

    @property
    def current_kind(self) -> str:
        current = self.client.alignment.current
        return "" if current is None else current.kind

    def error_at(self, point: Vec3, alignment: Alignment) -> float:
        T = (alignment.T_world_tracking.p, alignment.T_world_tracking.q)
        return distance(apply(T, apply(inverse(self.T_world_tracking), point)), point)

    def hold_robot(self, robot: str) -> Hand:
        self.scenario.run_until(lambda: self.client.scene.tip_pose(robot) is not None, "the scene is there")
        self.client.acquire([robot])
        hand = Hand(self.client, robot, self.device)
        self.scenario.hands.append(hand)
        return hand


def _to_tuple(values: Array) -> tuple[float, ...]:
    return tuple(values.tolist())


def test_tip_four_touches_and_a_robot_that_follows(scenario: Scenario) -> None:
    ann = Toucher(scenario, "ann", RIGHT)
    assert {mark.id for mark in ann.client.mirror.anchors["table"].marks} == set("1234")
    found = ann.turn_in_a_hole()
    assert not found.refused
    assert found.participant == ann.client.connection.participant_id
    assert distance(found.p_grip_tip, TIP) < found.error_m < 0.003
    ann.touch_marks(found.p_grip_tip, "1234")
    got = ann.wait_for_alignment(AlignmentKind.MEASURED)
    anchor = ann.client.mirror.anchors["table"].T_world_anchor.p
    assert 0.0 < got.error_at_anchor_m < 0.006
    assert ann.error_at(anchor, got) < 2.0 * got.error_at_anchor_m
    assert 0.0 < got.error_at_robot_m < 0.05
    hand = ann.hold_robot("left")
    scenario.engage(hand)
    scenario.server.finish()


def test_fingertip_may_look_and_is_denied_to_drive_until_a_tip_is_calibrated(scenario: Scenario) -> None:
    bob = Toucher(scenario, "bob", FINGER)
    bob.touch_marks(TIP, "1234", 0.005)
    got = bob.wait_for_alignment(AlignmentKind.FINGERTIP)
    assert 0.008 < got.error_at_anchor_m < 0.03
    hand = bob.hold_robot("left")
    scenario.run_for(0.3)
    hand.clutch = True

    def was_told() -> bool:
        rejected = [one.reason for one in bob.events(SamplesRejected) if isinstance(one, SamplesRejected)]
        notices = [one.reason for one in bob.events(Notice) if isinstance(one, Notice)]
        return RejectReason.VIEW_ONLY in rejected and DenialReason.VIEW_ONLY in notices

    scenario.run_until(was_told, "the session says why")

    def is_held_because_of_it() -> bool:
        """On a busy machine the robot may hold for another reason meanwhile: samples came too late."""
        return "left" in bob.client.feedback and bob.client.feedback["left"].hold_reason == HoldReason.VIEW_ONLY

    scenario.run_until(is_held_because_of_it, "feedback says why the robot holds")
    assert not scenario.is_following(hand)
    hand.clutch, hand.device, bob.device = False, RIGHT, RIGHT
    found = bob.turn_in_a_hole()
    bob.touch_marks(found.p_grip_tip, "1234")
    bob.wait_for_alignment(AlignmentKind.MEASURED)
    scenario.engage(hand)
    scenario.server.finish()


@pytest.mark.long
def test_kept_place_comes_back_for_looking_and_a_touch_confirms_it(scenario: Scenario) -> None:
    dan = Toucher(scenario, "dan", RIGHT)
    found = dan.turn_in_a_hole()
    dan.touch_marks(found.p_grip_tip, "1234")
    aligned = dan.wait_for_alignment(AlignmentKind.MEASURED)
    world = dan.client.mirror.anchors["table"].T_world_anchor
    T_tracking_anchor = compose(inverse((aligned.T_world_tracking.p, aligned.T_world_tracking.q)), (world.p, world.q))
    T_P_anchor = compose(inverse(T_TRACKING_P), T_tracking_anchor)
    covariance = covariance_at_anchor(aligned.covariance, aligned.pivot_world, (world.p, world.q))

    # The page is loaded again: another tracking frame, in which the place P is found 5 mm off.
    dan.T_world_tracking = ((0.4, 0.9, -0.2), quat_from_yaw(-1.0))
    dan.client.alignment.report_tracking_jump()
    scenario.run_until(lambda: dan.current_kind == "", "the old alignment is void")
    (x, y, z), q = compose(compose(inverse(dan.T_world_tracking), T_WORLD_TRACKING), T_TRACKING_P)
    seen = compose(((x + 0.005, y, z), q), T_P_anchor)
    dan.client.alignment.observe("table", seen, kind="persistent", covariance=covariance)
    kept = dan.wait_for_alignment(AlignmentKind.PERSISTENT)
    assert kept.error_at_anchor_m > 0.01
    hand = dan.hold_robot("left")
    scenario.run_for(0.3)
    assert not scenario.is_following(hand)
    dan.touch_marks(found.p_grip_tip, "1")
    confirmed = dan.wait_for_alignment(AlignmentKind.MEASURED)
    assert confirmed.error_at_anchor_m < kept.error_at_anchor_m
    assert dan.error_at(world.p, confirmed) < 2.0 * confirmed.error_at_anchor_m
    scenario.engage(hand)
    scenario.server.finish()


def test_too_little_turning_is_refused_with_advice(scenario: Scenario) -> None:
    cay = Toucher(scenario, "cay", RIGHT)
    cay.client.alignment.report_tip_poses(RIGHT, [((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))] * 40)
    scenario.run_until(lambda: cay.events(TipCalibrated), "the session answers")
    answer = cay.events(TipCalibrated)[-1]
    assert isinstance(answer, TipCalibrated)
    assert answer.refused
    assert "tilt the controller" in answer.advice
