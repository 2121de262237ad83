"""Several operators in one session: denial, following, holding, invalid input, late joiners, e-stop, pause, scaling."""

from __future__ import annotations

import logging
import math

import numpy as np
import pytest

from anchors.pose import PoseTuple, distance, quat_angle
from iris_session.authority.config import AuthorityConfig
from iris_session.client import DeniedError
from iris_session.protocol.names import DenialReason, HoldReason, RejectReason
from iris_session.protocol.server_messages import EngagementChanged, LeaseChanged, SamplesRejected
from tests.rig.session import Hand, Rig

MS = 1_000_000
TICK = 0.01  # [s]


def get_applied_ns(rig: Rig, hand: Hand) -> int:
    """Return the session time at which the newest sample that moves the robot of `hand` was received [ns]."""
    assert hand.client.scene.state is not None
    return max(a.receive_ns for a in hand.client.scene.state.header.applied if a.robot == hand.robot)


def test_second_operator_is_denied_with_the_holder_and_moves_nothing() -> None:
    with Rig(timestep=TICK) as rig:
        ann, bob = rig.join("ann"), rig.join("bob")
        ann.acquire(["left"])
        with pytest.raises(DeniedError) as denied:
            bob.acquire(["left", "right"])
        denial = denied.value.denial
        assert (denial.reason, denial.holder, denial.holder_name) == (DenialReason.HELD, ann.participant_id, "ann")
        assert denial.advice
        assert bob.lease_version("right") is None, "all or none"
        hand = rig.add_hand(bob, "left")
        rig.run(0.5)
        hand.clutch, hand.velocity = True, (0.2, 0.0, 0.0)
        rig.check_rest(bob, "left", 0.7)


def test_log_has_joins_denials_holds_and_leaves_once_each(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "iris_session.session"), Rig(timestep=TICK) as rig:
        hand, bob = rig.drive("ann", "left"), rig.join("bob")
        caplog.clear()
        with pytest.raises(DeniedError) as denied:
            bob.acquire(["left"])
        hand.sending = False
        rig.run(0.5)
        bob.close()
        rig.run(0.2)
        rig.join("carl")
        told = caplog.messages
    assert [HoldReason.STALE in text and "left" in text for text in told].count(True) == 1
    assert [bob.participant_id in text for text in told].count(True) == 1
    assert ["carl" in text for text in told].count(True) == 1
    assert [denied.value.denial.message in text for text in told].count(True) == 1


def test_robot_follows_its_hand_and_holds_150_ms_after_the_last_sample() -> None:
    with Rig(timestep=0.004) as rig:
        hand = rig.drive("ann", "left")
        before, began_y = hand.tip, hand.pose[0][1]
        hand.velocity = (0.0, 0.1, 0.0)
        rig.run(1.0)
        assert 0.08 < hand.tip[0][1] - before[0][1] < 0.1, "it lags by at most a fifth of a second"
        hand.velocity = (0.0, 0.0, 0.0)
        rig.run(0.5)
        moved = hand.pose[0][1] - began_y
        assert hand.tip[0][1] - before[0][1] == pytest.approx(moved, abs=1e-3)
        hand.velocity, hand.sending = (0.0, 0.1, 0.0), False
        rig.run_until(lambda: not rig.list_events("ann", EngagementChanged)[-1][1].engaged, "the robot holds", 1.0)
        held_ns, ended = rig.list_events("ann", EngagementChanged)[-1]
        assert 150 * MS <= held_ns - get_applied_ns(rig, hand) <= 154 * MS
        assert ended.reason == HoldReason.STALE
        rig.check_rest(hand.client, "left", 1.0)


def test_late_client_has_the_same_state() -> None:
    with Rig(timestep=TICK) as rig:
        ann = rig.drive("ann", "left", (0.0, 0.05, 0.0)).client
        director = rig.join("director", "director")
        director.marker("before")
        director.set_mode("right", "request")
        ann.episode("start", "one")
        late = rig.join("late", "observer")
        director.marker("after")
        rig.run(0.1)
        assert len({(c.mirror.event_seq, c.mirror.mirror_hash()) for c in (ann, director, late)}) == 1
        assert late.mirror.leases["left"].holder == ann.participant_id
        assert late.mirror.episode is not None

        def are_poses_equal() -> bool:
            a, b = ann.scene.state, late.scene.state
            is_same_tick = a is not None and b is not None and a.header.tick == b.header.tick
            return is_same_tick and bool(np.abs(a.poses - b.poses).max() < 3e-4)  # type: ignore[union-attr]

        rig.run_until(are_poses_equal, "the late client has the same poses", 0.5)


@pytest.mark.parametrize(
    ("pose", "reason"),
    [
        (((math.nan, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)), RejectReason.NOT_FINITE),
        (((0.0, math.inf, 1.0), (1.0, 0.0, 0.0, 0.0)), RejectReason.NOT_FINITE),
        (((0.0, 0.0, 1.0), (0.5, 0.0, 0.0, 0.0)), RejectReason.NOT_UNIT),
        (((2.5, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)), RejectReason.TOO_FAST),
    ],
)
def test_invalid_pose_ends_the_engagement_and_moves_nothing(pose: PoseTuple, reason: str) -> None:
    with Rig(timestep=TICK) as rig:
        hand = rig.drive("ann", "left")
        before, begun = hand.tip, len(rig.events["ann"])
        hand.sending = False
        sent_ns = rig.session.clock()
        hand.client.send_sample(hand.device, pose, robots=[hand.robot], clutch=True)
        hand.sending = True  # further samples with the clutch closed must not engage again
        rig.run(0.4)
        events = rig.events["ann"][begun:]
        rejected = [e.body for e in events if isinstance(e.body, SamplesRejected)]
        assert [(r.participant, r.device, r.reason) for r in rejected] == [
            (hand.client.participant_id, hand.device, reason)
        ]
        ((held_ns, ended),) = [(e.session_time, e.body) for e in events if isinstance(e.body, EngagementChanged)]
        assert (ended.engaged, ended.reason) == (False, HoldReason.REJECTED)
        assert 0 < held_ns - sent_ns <= 11 * MS, "in the next step"
        assert distance(before[0], hand.tip[0]) < 1e-4
        assert quat_angle(before[1], hand.tip[1]) < 1e-3
        rig.engage(hand)


def test_takeover_ends_the_engagement_of_the_first_holder() -> None:
    with Rig(timestep=TICK, authority=AuthorityConfig(default_mode="takeover")) as rig:
        anns = rig.drive("ann", "left", (0.0, 0.05, 0.0))
        bob = rig.join("bob")
        bob.acquire(["left"])
        rig.run(0.05)
        assert anns.client.lease_version("left") is None
        assert [body.cause for _, body in rig.list_events("ann", LeaseChanged)][-1] == "takeover"
        rig.run(0.5)
        rig.check_rest(bob, "left", 0.5)  # the first holder goes on sending with the clutch closed
        rig.engage(rig.add_hand(bob, "left"))


def test_estop_holds_until_a_director_clears_it_and_the_clutch_was_open() -> None:
    with Rig(timestep=TICK) as rig:
        hand, director = rig.drive("ann", "left", (0.0, 0.1, 0.0)), rig.join("director", "director")
        rig.run(0.5)
        begun = hand.tip
        hand.client.estop("test")
        rig.run(0.4)
        assert director.mirror.estop
        assert distance(begun[0], hand.tip[0]) < 0.02, "at 0.1 m/s it stops within 2 cm"
        rig.check_rest(director, "left", 0.4)
        with pytest.raises(DeniedError):
            hand.client.clear_estop()
        director.clear_estop()
        rig.check_rest(director, "left", 0.5)  # the clutch is still closed
        rig.engage(hand)


def test_pause_steps_and_reset() -> None:
    with Rig(timestep=TICK) as rig:
        hand, director = rig.drive("ann", "left", (0.0, 0.1, 0.0)), rig.join("director", "director")

        def read_tick() -> int:
            assert director.scene.state is not None
            return director.scene.state.header.tick

        director.control("pause")
        rig.run(0.1)
        assert hand.client.mirror.paused
        tick = read_tick()
        rig.run(0.5)
        assert read_tick() == tick
        director.control("step", 5)
        rig.run(0.5)
        assert read_tick() == tick + 5
        director.control("resume")
        rig.run(1.0)
        assert read_tick() == pytest.approx(tick + 105, abs=6)
        assert rig.list_events("ann", EngagementChanged)[-1][1].reason == HoldReason.GAP, "the hand may have moved on"
        hand.velocity = (0.0, 0.0, 0.0)
        rig.engage(hand)
        epoch = director.mirror.scene_epoch
        director.control("reset")
        rig.run(0.1)
        assert hand.client.mirror.scene_epoch == epoch + 1
        assert hand.client.lease_version("left") is not None, "leases stay"
        ended = rig.list_events("ann", EngagementChanged)[-1][1]
        assert (ended.engaged, ended.reason) == (False, HoldReason.SCENE_CHANGED)
        rig.engage(hand)


def test_scaled_robot_moves_a_fifth_as_far_as_the_hand() -> None:
    with Rig(timestep=TICK) as rig:
        ann, bob = rig.join("ann"), rig.join("bob")
        ann.acquire(["left"])
        hand = rig.add_hand(ann, "left")
        ann.set_scale(["left"], 0.2)
        rig.engage(hand)

        def sweep(seconds: float) -> tuple[float, float]:
            """Move the hand. Return how far it and the tip have moved [m]."""
            y, tip_y = hand.pose[0][1], hand.tip[0][1]
            hand.velocity = (0.0, 0.1, 0.0)
            rig.run(seconds)
            hand.velocity = (0.0, 0.0, 0.0)
            rig.run(0.5)
            return hand.pose[0][1] - y, hand.tip[0][1] - tip_y

        moved, tip = sweep(1.0)
        assert tip == pytest.approx(0.2 * moved, abs=5e-4)
        with pytest.raises(DeniedError):
            bob.set_scale(["left"], 1.0)
        before = hand.tip
        ann.set_scale(scale=1.0)  # far from where the clutch closed, and still closed
        rig.run(0.6)
        assert hand.is_following
        assert distance(hand.tip[0], before[0]) < 5e-4
        moved, tip = sweep(0.5)
        assert tip == pytest.approx(moved, abs=1e-3)
        ann.set_scale(["left"], 0.5)
        late = rig.join("late", "observer")
        assert {c.mirror.leases["left"].scale for c in rig.clients} == {0.5}
        assert rig.list_event_kinds("bob").count("ScaleChanged") == 3
        ann.release()
        rig.run(0.05)
        assert late.mirror.leases["left"].scale == 1.0
