"""Casts of the demos with real physics and control, delayed and noisy; and people with two hands."""

from __future__ import annotations

import random

import pytest

from iris_session.demo.demos import make_demo
from iris_session.emulator.behaviours import CombinedBehaviour, HandInput, OperatorView
from tests.emulator.handover_rig import LateView, Rig, demo


@pytest.mark.long
@pytest.mark.usefixtures("untraced")
def test_every_object_is_handed_over() -> None:
    """By friction, in mid-air, onto a table. Two panda, and ALOHA: `tests/e2e/test_demo_scenes.py`."""
    rig = demo(make_demo("panda", 4), seed=0)
    rig.run(60.0, until=Rig.over)
    assert rig.verdict() == ""
    assert rig.fastest_hand < 0.5


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
