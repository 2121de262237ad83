"""Motion scaling from one person's request to what everybody sees the robot do, with real processes; then verified."""

from __future__ import annotations

import pytest

from anchors.pose import distance
from iris_session.client import DeniedError
from tests.e2e.conftest import Hand, Stage

pytestmark = pytest.mark.e2e


def sweep(stage: Stage, hand: Hand, metres: float, scale: float) -> None:
    """Moves the hand along y by `metres`; the tip must come `scale` times as far, and stay there."""
    start, y = hand.tip[0], hand.pose[0][1]
    hand.velocity = (0.0, 0.1, 0.0)
    stage.run(lambda: hand.pose[0][1] >= y + metres, "the hand has moved")
    hand.velocity = (0.0, 0.0, 0.0)
    expected = scale * (hand.pose[0][1] - y)
    stage.run(lambda: abs(distance(hand.tip[0], start) - expected) < 1e-3, f"the tip has moved by {expected:.3f} m")
    stage.seconds(0.4)
    assert distance(hand.tip[0], start) == pytest.approx(expected, abs=2e-3)


def test_a_robot_moves_a_fifth_as_far_as_the_hand(stage: Stage) -> None:
    ann, bob = stage.join("ann"), stage.join("bob")
    ann.acquire(["left"])
    hand = stage.hand(ann, "left")
    ann.set_scale(["left"], 0.2)
    stage.engage(hand)
    sweep(stage, hand, 0.1, 0.2)
    with pytest.raises(DeniedError, match="held by ann"):
        bob.set_scale(["left"], 1.0)

    before = hand.tip[0]
    ann.set_scale(scale=1.0)  # far from where the clutch closed, and still closed
    stage.seconds(0.6)
    assert stage.following(hand)
    assert distance(hand.tip[0], before) < 1e-3
    sweep(stage, hand, 0.05, 1.0)

    ann.set_scale(["left"], 0.5)
    late = stage.join("late", role="observer")
    stage.run(lambda: len({c.mirror.event_seq for c in stage.clients}) == 1, "all know the same")
    assert [c.mirror.leases["left"].scale for c in stage.clients] == [0.5] * 3
    assert len({c.mirror.mirror_hash() for c in stage.clients}) == 1
    assert stage.bodies("bob").count("ScaleChanged") == 3
    ann.release()
    stage.run(lambda: late.mirror.leases["left"].scale == 1.0, "the next holder begins at 1")
    assert stage.server.finish()["ok"]
