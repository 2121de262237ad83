"""Operators in one session: following, holding, the e-stop, and what the log has of them."""

from __future__ import annotations

import logging

import pytest

from anchors.pose import distance
from iris_session.client import DeniedError
from iris_session.protocol.names import HoldReason
from iris_session.protocol.server_messages import EngagementChanged
from tests.rig.session import Hand, Rig

MS = 1_000_000
TICK = 0.01  # [s]


def get_applied_ns(rig: Rig, hand: Hand) -> int:
    """Return the session time at which the newest sample that moves the robot of `hand` was received [ns]."""
    assert hand.client.scene.state is not None
    return max(a.receive_ns for a in hand.client.scene.state.header.applied if a.robot == hand.robot)


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
