"""People with two hands, and deformables that are not there."""

from __future__ import annotations

import random

import pytest

from iris_session.emulator.behaviours import CombinedBehaviour, Folder, HandInput, OperatorView, Stower, make_behaviour
from iris_session.emulator.behaviours.phases import SEARCH_S
from tools.handover_rig import LateView


class ScriptedHand:
    """One hand that is done after some updates."""

    def __init__(self, robot: str, updates: int, failed: str = "") -> None:
        self.phase, self.done, self.failed = "busy", False, ""
        self._robot, self._left, self._end = robot, updates, failed

    def update(self, view: OperatorView) -> tuple[HandInput, ...]:
        self._left -= 1
        if self._left <= 0:
            self.phase, self.done, self.failed = "done", True, self._end
        return (HandInput(f"controller/{self._robot}", self._robot, view.device_pose(""), False, 0.0),)


def view() -> LateView:
    return LateView(random.Random(1))


def test_both_hands_work_in_parallel_until_both_are_done() -> None:
    hands = CombinedBehaviour([ScriptedHand("left", 2), ScriptedHand("right", 3)])
    assert [i.robot for i in hands.update(view())] == ["left", "right"]
    assert (hands.phase, hands.done) == ("busy", False)
    hands.update(view())
    assert not hands.done
    assert [i.robot for i in hands.update(view())] == ["left", "right"]  # the idle hand is still sent
    assert (hands.phase, hands.done, hands.failed) == ("done", True, "")


def test_failure_of_one_hand_is_a_failure_of_the_person() -> None:
    hands = CombinedBehaviour([ScriptedHand("left", 9), ScriptedHand("right", 1, "dropped it")])
    hands.update(view())
    assert hands.failed == "dropped it"
    assert not hands.done


@pytest.mark.parametrize("name", ["folder", "stower"])
def test_deformable_that_is_not_visible_is_named(name: str) -> None:
    thing = {"folder": "cloth", "stower": "rose"}[name]
    behaviour = make_behaviour(name, "left", thing)
    seen = view()
    for k in range(int(SEARCH_S * 72) + 10):
        seen.receive_frame(k / 72.0)
        behaviour.update(seen)
    assert behaviour.done
    assert thing in behaviour.failed


@pytest.mark.parametrize("behaviour", [Folder, Stower])
def test_unknown_deformable_is_rejected(behaviour: type) -> None:
    with pytest.raises(ValueError, match=r"'jelly'.*: cloth, rose, mint"):
        behaviour("left", "jelly", *(["right"] if behaviour is Folder else []))
