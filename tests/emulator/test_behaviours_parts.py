"""Parts of the operators: reaches, the clutched hand, and perception."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchors.pose import (
    IDENTITY_POSE,
    IDENTITY_QUAT,
    PoseTuple,
    distance,
    quat_angle,
    quat_conj,
    quat_from_rotvec,
    quat_from_yaw,
    quat_mul,
)
from iris_session.emulator.behaviours.hand import LONGEST_STEP_S, REARM_S, ClutchedHand, HandMovement
from iris_session.emulator.behaviours.objects import find_object
from iris_session.emulator.behaviours.perception import Perception, TrackedPose

STEP_NS = 13_888_889  # 72 Hz
_metres = st.floats(-1.0, 1.0)
_poses = st.tuples(st.tuples(_metres, _metres, _metres), st.tuples(_metres, _metres, _metres).map(quat_from_rotvec))


class PerfectRobot:
    """`OperatorView` of a robot that follows the hand at once, unless `holds`; the hand starts anywhere."""

    def __init__(self, tip: PoseTuple, hand: PoseTuple) -> None:
        self.session_time_ns = 1
        self.estop = False
        self.lease: int | None = 1
        self.tip, self.hand = tip, hand
        self.holds = False
        self._latch: tuple[PoseTuple, PoseTuple] | None = None

    def body_pose(self, name: str) -> PoseTuple | None:
        return None

    def tip_pose(self, robot: str) -> PoseTuple | None:
        return self.tip

    def lease_version(self, robot: str) -> int | None:
        return self.lease

    def device_pose(self, device: str) -> PoseTuple:
        return self.hand

    def run(self, hand: ClutchedHand, seconds: float) -> list[bool]:
        """Run the hand for a while; return the clutch over time."""
        clutches = []
        for _ in range(round(seconds * 1e9 / STEP_NS)):
            self.session_time_ns += STEP_NS
            hand.update(self, self.tip)
            given_input = hand.make_input()
            self.hand = given_input.pose_world
            clutches.append(given_input.clutch)
            if not given_input.clutch:
                self.holds, self._latch = False, None  # an opened clutch re-arms the session
            elif self._latch is None:
                self._latch = (self.hand, self.tip)
            elif not self.holds:
                (h0, t0), (p, q) = self._latch, self.hand
                moved = (t0[0][0] + p[0] - h0[0][0], t0[0][1] + p[1] - h0[0][1], t0[0][2] + p[2] - h0[0][2])
                self.tip = (moved, quat_mul(quat_mul(q, quat_conj(h0[1])), t0[1]))
        return clutches


@settings(max_examples=60, deadline=None)
@given(_poses, _poses)
def test_reach_keeps_its_speed_limits(start: PoseTuple, goal: PoseTuple) -> None:
    reach = HandMovement.plan(start, goal, 5.0, speed=0.4, turn=1.5)
    assert distance(reach.compute_pose(5.0)[0], start[0]) < 1e-12
    assert distance(reach.compute_pose(100.0)[0], goal[0]) < 1e-12
    assert quat_angle(reach.compute_pose(100.0)[1], goal[1]) < 1e-7
    n, last = 200, reach.compute_pose(5.0)
    step_s = reach.duration_s / n
    for i in range(1, n + 1):
        pose = reach.compute_pose(5.0 + i * step_s)
        assert distance(last[0], pose[0]) <= 0.4 * step_s * 1.001
        assert quat_angle(last[1], pose[1]) <= 1.5 * step_s * 1.001 + 1e-9
        last = pose
    assert reach.is_finished(5.0 + reach.duration_s)
    assert not reach.is_finished(5.0 + 0.99 * reach.duration_s)


@settings(max_examples=12, deadline=None)
@given(_poses, _poses, _poses)
def test_hand_brings_the_tip_to_the_goal_from_any_pose(tip: PoseTuple, hand_at: PoseTuple, goal: PoseTuple) -> None:
    """Relative motion moves the tip there at any position and orientation of the hand."""
    robot, hand = PerfectRobot(tip, hand_at), ClutchedHand("controller/right", "left")
    hand.move_to(goal)
    robot.run(hand, 16.0)
    assert distance(robot.tip[0], goal[0]) < 1e-3
    assert quat_angle(robot.tip[1], goal[1]) < 5e-3
    assert not hand.has_arrived()  # first observation there
    robot.run(hand, 0.2)
    assert hand.has_arrived()
    assert hand.reclutches == 0


def test_hand_clutches_again_when_the_robot_does_not_follow() -> None:
    robot, hand = PerfectRobot(IDENTITY_POSE, IDENTITY_POSE), ClutchedHand("controller/right", "left")
    hand.move_to(((0.3, 0.0, 0.0), IDENTITY_QUAT))
    robot.run(hand, 0.2)
    robot.holds = True
    clutches = robot.run(hand, 6.0)
    open_s = clutches.count(False) * STEP_NS * 1e-9
    assert hand.reclutches == 1
    assert open_s == pytest.approx(REARM_S, abs=0.05)
    assert distance(robot.tip[0], (0.3, 0.0, 0.0)) < 1e-3


def test_estop_and_lost_lease_open_the_clutch() -> None:
    robot, hand = PerfectRobot(IDENTITY_POSE, IDENTITY_POSE), ClutchedHand("controller/right", "left")
    hand.move_to(((0.2, 0.0, 0.0), IDENTITY_QUAT))
    robot.run(hand, 0.3)
    robot.estop = True
    before = robot.tip
    assert not any(robot.run(hand, 1.0))
    assert robot.tip == before
    robot.estop, robot.lease = False, None
    assert not any(robot.run(hand, 1.0))
    robot.lease = 2
    robot.run(hand, 3.0)
    assert distance(robot.tip[0], (0.2, 0.0, 0.0)) < 1e-3


def test_hand_does_not_jump_after_a_stall() -> None:
    """The computer stalled for 2 s in the middle of a movement: the operator continues from the same pose."""
    robot, hand = PerfectRobot(IDENTITY_POSE, IDENTITY_POSE), ClutchedHand("controller/right", "left")
    hand.move_to(((0.4, 0.0, 0.0), IDENTITY_QUAT))
    robot.run(hand, 0.8)
    before = robot.hand
    robot.session_time_ns += 2_000_000_000
    robot.run(hand, 0.02)
    assert distance(before[0], robot.hand[0]) <= 0.4 * LONGEST_STEP_S + 0.4 * STEP_NS * 1e-9


def test_perceived_pose_is_smoothed_and_follows() -> None:
    seen, rng = TrackedPose(IDENTITY_POSE, 0.0), np.random.default_rng(1)
    errors = []
    for i in range(1, 720):
        noisy = (tuple(map(float, rng.normal(0, 1e-3, 3))), quat_from_rotvec(tuple(map(float, rng.normal(0, 5e-3, 3)))))
        seen.update(noisy, i / 72)  # type: ignore[arg-type]
        errors.append(distance(seen.pose[0], (0.0, 0.0, 0.0)))
    assert np.mean(errors) < 0.75e-3
    assert seen.still_s > 5.0
    for i in range(720, 760):
        seen.update(((0.1, 0.0, 0.0), quat_from_yaw(0.5)), i / 72)
    assert seen.pose[0][0] == pytest.approx(0.1, abs=1e-3)
    assert quat_angle(seen.pose[1], quat_from_yaw(0.5)) < 5e-3
    assert seen.still_s < 0.6


class FixedView:
    """`OperatorView` that shows fixed poses."""

    session_time_ns = 0
    estop = False

    def __init__(self, poses: dict[str, PoseTuple]) -> None:
        self.poses = poses

    def body_pose(self, name: str) -> PoseTuple | None:
        return self.poses.get(name)

    def tip_pose(self, robot: str) -> PoseTuple | None:
        return self.poses.get(f"tip:{robot}")

    def lease_version(self, robot: str) -> int | None:
        return 1

    def device_pose(self, device: str) -> PoseTuple:
        return IDENTITY_POSE


def _gripper_at(x: float, y: float, half_gap: float) -> dict[str, PoseTuple]:
    """Fingers of `left` that point down from 45 mm above height 0.3, closing along y."""
    down = (0.0, 1.0, 0.0, 0.0)
    return {
        "left/finger_left": ((x, y - half_gap, 0.345), down),
        "left/finger_right": ((x, y + half_gap, 0.345), quat_mul(quat_from_yaw(math.pi), down)),
        "left/base": IDENTITY_POSE,
        "tip:left": ((x, y, 0.3), down),
        "hammer": ((0.0, 0.0, 0.3), IDENTITY_QUAT),
    }


@pytest.mark.parametrize(
    ("x", "y", "half_gap", "holds"),
    [
        (0.08, 0.0, 0.0123, True),
        (-0.08, 0.002, 0.0120, True),
        (0.08, 0.0, 0.030, False),  # open around it
        (0.08, 0.03, 0.0123, False),  # closed beside it
        (0.20, 0.0, 0.0123, False),  # closed beyond its end
        (0.08, 0.0, 0.0, False),  # closed on nothing
    ],
)
def test_holder_of_an_object_is_perceived(x: float, y: float, half_gap: float, holds: bool) -> None:
    eyes = Perception(("hammer",), ("left",))
    eyes.observe(FixedView(_gripper_at(x, y, half_gap)))
    assert eyes.is_complete
    assert eyes.compute_gap("left") == pytest.approx(2 * half_gap)
    assert eyes.is_holding("left", "hammer", find_object("hammer").half_width) is holds
