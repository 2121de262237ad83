"""The clutch alone: relative motion, blending without jumps, workspace, twists."""

from __future__ import annotations

import math

import pytest

from anchors.pose import PoseTuple, quat_angle, quat_from_rotvec, quat_mul
from iris_session.control import clutch
from iris_session.protocol.common import Pose
from iris_session.protocol.steps import Command, CommandSource

BASE: PoseTuple = ((0.5, 0.1, 0.8), quat_from_rotvec((0.3, -1.0, 0.2)))
TURN = quat_from_rotvec((0.0, 0.0, 0.4))
ONE = (1.0, 0.0, 0.0, 0.0)


def source(name: str, p: tuple[float, float, float], q: tuple[float, float, float, float] = ONE, **more: object):  # type: ignore[no-untyped-def]
    fields = {"engagement": 1, "seq": 1, "capture_ns": 0, "receive_ns": 0, "pose_world": Pose(p, q), **more}
    return CommandSource(name, "controller/right", **fields)


def command(*sources: CommandSource) -> Command:
    return Command("r", "pose", sources=sources)


def test_translation_is_scaled_and_rotation_is_about_the_worlds_axes() -> None:
    start = quat_from_rotvec((1.0, 0.5, 0.0))
    state = clutch.latch(command(source("a", (9.0, 9.0, 9.0), start)), 2.0, BASE)
    clutch.follow(state, [source("a", (9.1, 9.0, 8.9), quat_mul(TURN, start))], None)
    assert state.target[0] == pytest.approx((0.7, 0.1, 0.6))
    assert quat_angle(state.target[1], quat_mul(TURN, BASE[1])) < 1e-12


def test_back_at_the_latch_the_target_is_the_base_exactly() -> None:
    first = source("a", (1.0, 2.0, 3.0), TURN)
    state = clutch.latch(command(first), 1.0, BASE)
    for k in range(100):
        clutch.follow(state, [source("a", (1.0 + 0.01 * k, 2.0, 3.0), quat_from_rotvec((0.01 * k, 0.0, 1.0)))], None)
    clutch.follow(state, [first], None)
    assert state.target == BASE


def test_two_sources_are_blended_by_weight() -> None:
    a, b = source("a", (0.0, 0.0, 0.0), weight=0.75), source("b", (5.0, 0.0, 0.0), weight=0.25)
    state = clutch.latch(command(a, b), 1.0, BASE)
    clutch.follow(
        state, [source("a", (0.1, 0.0, 0.0), weight=0.75), source("b", (5.0, 0.2, 0.0), TURN, weight=0.25)], None
    )
    assert state.target[0] == pytest.approx((0.575, 0.15, 0.8))
    assert quat_angle(state.target[1], BASE[1]) == pytest.approx(0.1)


def test_joining_and_leaving_moves_nothing_and_loses_nothing() -> None:
    state = clutch.latch(command(source("a", (0.0, 0.0, 0.0))), 1.0, BASE)
    clutch.follow(state, [source("a", (0.1, 0.0, 0.0))], None)
    before = state.target
    both = [source("a", (0.1, 0.0, 0.0), weight=0.5), source("b", (7.0, 7.0, 7.0), weight=0.5)]
    state = clutch.latch(command(*both), 1.0, state.target, state)
    clutch.follow(state, both, None)
    assert state.target[0] == pytest.approx(before[0], abs=1e-15)
    # b moves, then a leaves in the same step in which b moves on: b's motion goes on from its last sample.
    clutch.follow(state, [both[0], source("b", (7.0, 7.2, 7.0), weight=0.5)], None)
    assert state.target[0] == pytest.approx((0.6, 0.2, 0.8))
    alone = source("b", (7.0, 7.3, 7.0))
    assert not clutch.same_sources(state, command(alone), 1.0)
    state = clutch.latch(command(alone), 1.0, state.target, state)
    clutch.follow(state, [alone], None)
    assert state.target[0] == pytest.approx((0.6, 0.3, 0.8))


@pytest.mark.parametrize("change", [{"engagement": 2}, {"weight": 0.5}, {"device": "hand/left"}, {"participant": "z"}])
def test_any_change_of_a_source_is_seen(change: dict[str, object]) -> None:
    import msgspec

    first = source("a", (0.0, 0.0, 0.0))
    state = clutch.latch(command(first), 1.0, BASE)
    assert clutch.same_sources(state, command(first), 1.0)
    assert not clutch.same_sources(state, command(first), 2.0)
    assert not clutch.same_sources(state, command(msgspec.structs.replace(first, **change)), 1.0)


def test_absolute_poses_are_the_target_themselves() -> None:
    first = source("a", (0.2, 0.3, 0.4), TURN, absolute=True)
    state = clutch.latch(command(first), 1.0, BASE)
    assert state.target == BASE
    clutch.follow(state, [first], None)
    assert state.target == ((0.2, 0.3, 0.4), TURN)


def test_the_motion_of_an_absolute_source_is_blended_without_the_scale() -> None:
    hand, policy = source("a", (0.0, 0.0, 0.0), weight=0.5), source("b", (2.0, 0.0, 0.0), weight=0.5, absolute=True)
    state = clutch.latch(command(hand, policy), 4.0, BASE)
    clutch.follow(state, [hand, source("b", (2.2, 0.0, 0.0), weight=0.5, absolute=True)], None)
    assert state.target[0] == pytest.approx((0.6, 0.1, 0.8))
    clutch.follow(state, [source("a", (0.0, 0.1, 0.0), weight=0.5), policy], None)
    assert state.target[0] == pytest.approx((0.5, 0.3, 0.8))


def test_the_workspace_bounds_the_target_and_never_throws_it_in() -> None:
    box = ((0.0, 0.0, 0.0), (0.4, 1.0, 0.9))  # the robot stands outside in x
    state = clutch.latch(command(source("a", (0.0, 0.0, 0.0))), 1.0, BASE)
    clutch.follow(state, [source("a", (0.1, 0.0, 0.5))], box)
    assert state.target[0] == (0.5, 0.1, 0.9)
    assert state.clamped
    clutch.follow(state, [source("a", (-0.2, 0.0, 0.0))], box)
    assert state.target[0] == pytest.approx((0.3, 0.1, 0.8))
    assert not state.clamped


def test_twists_are_integrated_within_their_limits() -> None:
    turn = CommandSource("a", "desktop", 1, 1, 0, 0, twist_world=(3.0, 0.0, 0.0, 0.0, 0.0, 9.0))
    state = clutch.latch(command(turn), 1.0, BASE)
    assert not clutch.integrate(state, 0.002, 1.0, 2.0, None)  # the latching sample has not been taken yet
    clutch.follow(state, [turn], None)
    for _ in range(100):
        assert clutch.integrate(state, 0.002, 1.0, 2.0, None)
    assert state.target[0] == pytest.approx((0.7, 0.1, 0.8))
    assert quat_angle(state.target[1], BASE[1]) == pytest.approx(0.4)
    clutch.follow(state, [CommandSource("a", "desktop", 1, 2, 0, 0, twist_world=(0.0,) * 6)], None)
    assert not clutch.integrate(state, 0.002, 1.0, 2.0, None)


def test_toward_stops_on_the_way_and_arrives() -> None:
    goal: PoseTuple = ((0.5, 0.1, 1.8), quat_mul(quat_from_rotvec((0.0, 0.5, 0.0)), BASE[1]))
    part = clutch.toward(BASE, goal, 0.1, 1.0)
    assert clutch.separation(BASE, part) == pytest.approx((0.1, 0.05))
    assert clutch.separation(BASE, clutch.toward(BASE, goal, 10.0, 0.05)) == pytest.approx((0.1, 0.05))
    assert clutch.toward(BASE, goal, 2.0, 1.0) == goal


def test_scales_are_kept_within_limits() -> None:
    assert clutch.clip_scale(100.0, 0.1, 5.0) == 5.0
    assert clutch.clip_scale(-1.0, 0.1, 5.0) == 0.1
    assert clutch.clip_scale(math.nan, 0.1, 5.0) == 1.0
