"""Casts of `demo cloth` and `demo soft` with real physics and control, delayed and noisy, and recovery from faults."""

from __future__ import annotations

import random

import pytest

from anchors.pose import IDENTITY_POSE
from iris_session.demo.demos import make_demo
from iris_session.emulator.behaviours import Folder, Stower, make_behaviour
from iris_session.emulator.behaviours.deformables import SEEN_S
from iris_session.emulator.behaviours.phases import SEARCH_S
from tests.emulator.deformable_rig import SoftRig, soft_demo
from tests.emulator.handover_rig import LateView


@pytest.mark.long
@pytest.mark.usefixtures("untraced")
def test_two_people_fold_a_cloth() -> None:
    rig = soft_demo(make_demo("cloth"), seed=1)
    rig.run(30.0, until=SoftRig.over)
    assert rig.verdict() == ""
    assert rig.world.dropped_counts == {}


@pytest.mark.long
@pytest.mark.usefixtures("untraced")
def test_two_people_stow_soft_bodies_and_recover_dropped_ones() -> None:
    """At the first attempt a gripper is opened halfway."""
    rig = soft_demo(make_demo("soft"), seed=2)
    left = rig.behaviours["left"]
    rig.run(20.0, until=lambda rig: left.phase == "carry")
    assert left.phase == "carry"
    rig.run(0.4, until=lambda rig: False)
    left.hand.trigger_goal = 0.0  # type: ignore[attr-defined]
    rig.run(40.0, until=SoftRig.over)
    assert rig.verdict() == ""
    assert left.attempts == 2  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["folder", "stower"])
def test_deformable_that_is_not_visible_is_named(name: str) -> None:
    thing = {"folder": "cloth", "stower": "rose"}[name]
    behaviour = make_behaviour(name, "left", thing)
    view = LateView(random.Random(1))
    for k in range(int(SEARCH_S * 72) + 10):
        view.receive_frame(k / 72.0)
        behaviour.update(view)
    assert behaviour.done
    assert thing in behaviour.failed


@pytest.mark.parametrize("behaviour", [Folder, Stower])
def test_unknown_deformable_is_rejected(behaviour: type) -> None:
    with pytest.raises(ValueError, match=r"'jelly'.*: cloth, rose, mint"):
        behaviour("left", "jelly", *(["right"] if behaviour is Folder else []))


def stower(monkeypatch: pytest.MonkeyPatch) -> Stower:
    """Hand and box are at the origin, the fingers 3 cm apart; the tests place the body."""
    made = Stower("left", "rose")
    for name, value in {"get_tip": IDENTITY_POSE, "get_body": IDENTITY_POSE, "compute_gap": 0.03}.items():
        monkeypatch.setattr(made.perception, name, lambda _, value=value: value)
    return made


def test_old_picture_is_not_used_for_a_newer_phase(monkeypatch: pytest.MonkeyPatch) -> None:
    one = stower(monkeypatch)
    monkeypatch.setattr(one, "_is_holding", lambda: False)
    eyes = one.perception
    eyes.now_s = eyes.captured_s = 5.0
    one._enter("carry")
    eyes.now_s = 9.0
    assert not one._is_shown_for(2.5)
    assert one._check_slip("lost")
    eyes.now_s, eyes.captured_s = 11.0, 9.0 + SEEN_S
    assert one._check_slip("lost")
    assert one._is_shown_for(2.5)
    assert (one.phase, one.attempts) == ("carry", 1), "the picture is not yet of the time since"
    eyes.captured_s += 0.01
    assert one._check_slip("lost")
    assert (one.phase, one.attempts) == ("back_off", 2)
