"""Feedback to holders: on change, at most 20 times a second, with force, limits and rejection counts."""

from __future__ import annotations

import math
from itertools import pairwise

import msgspec
import pytest

from iris_session.protocol.server_messages import Feedback
from iris_session.protocol.steps import ControlStatus

from .table import MS, Table


def test_feedback_on_change_and_at_most_every_50_ms() -> None:
    t = Table()
    anna = t.operator("left")
    t.wait(100 * MS)
    assert anna.told["left"] == Feedback("left", "hold", "no_sample")
    seen = []
    for i in range(100):
        anna.sends("left", clutch=i > 0 and i % 2 == 1)
        seen += [t.now_ns for _ in anna.feedback()]
    assert all(b - a >= 50 * MS for a, b in pairwise(seen))
    assert len(seen) >= 1
    t.wait(100 * MS)
    t.step()
    assert anna.feedback() == []


def test_feedback_tells_force_limits_and_rejections() -> None:
    t = Table()
    anna = t.operator("left")
    t.view = msgspec.structs.replace(t.view, forces={"left": 3.3})
    t.control = (ControlStatus("right"), ControlStatus("left", ("left/joint1",)))
    anna.sends("left", scene_epoch=7)
    t.wait(100 * MS)
    assert anna.told["left"] == Feedback("left", "hold", "rejected", 3.5, ("left/joint1",), {"scene_epoch": 1})
    assert anna.told.keys() == {"left"}


@pytest.mark.parametrize("force", [math.nan, math.inf])
def test_forces_of_physics_that_diverged_are_not_felt(force: float) -> None:
    t = Table()
    anna = t.operator("left")
    t.view = msgspec.structs.replace(t.view, forces={"left": force})
    t.wait(100 * MS)
    assert anna.told["left"].contact_n == 0.0
