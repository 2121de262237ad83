"""Robots are driven with the base install, whose solver of inverse kinematics needs numpy alone."""

from __future__ import annotations

import sys

import pytest

from iris_session.control.config import SOLVER_NUMPY
from tests.rig.session import Rig


@pytest.mark.parametrize("user_loop", [False, True])
def test_a_robot_follows_by_five_centimetres_without_mink(user_loop: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mink", None)
    monkeypatch.setitem(sys.modules, "daqp", None)
    with Rig(timestep=0.01, user_loop=user_loop) as rig:
        hand = rig.drive("ann", "left")
        before = hand.tip
        hand.velocity = (0.0, 0.1, 0.0)
        rig.run(0.5)
        hand.velocity = (0.0, 0.0, 0.0)
        rig.run(1.0)
        moved = [b - a for a, b in zip(before[0], hand.tip[0], strict=True)]
        assert moved == pytest.approx([0.0, 0.05, 0.0], abs=0.003)
        assert rig.journal.config.control.solver == SOLVER_NUMPY
    monkeypatch.undo()
    assert rig.journal.verify() > 100
